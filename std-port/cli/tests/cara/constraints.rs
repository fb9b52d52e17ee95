//! `cara set`.

use crate::support::Stage;

#[test]
fn a_constraint_of_the_unit_is_set_while_it_runs() {
    let stage = Stage::with(&["agv-1"]);
    stage.ends(0, &["set", ".", "request_timeout", "50ms"]).says("request_timeout").says("50 ms");
    stage.ends(1, &["call", "agv-1", "slow"]).says("TimedOut");
    for name in ["manager", "manager/1"] {
        let reported = stage.ends(0, &["set", name, "minimum-interval", "0", "--json"]).json();
        assert_eq!((&reported["minimum_interval_us"], &reported["request_timeout_us"]), (&0.into(), &50_000.into()));
    }
    assert_eq!(stage.ends(0, &["set", ".", "message_size", "32KiB", "--json"]).json()["message_size"], 32_768);
    assert_eq!(stage.ends(0, &["set", ".", "calls_per_peer", "64", "--json"]).json()["calls_per_peer"], 64);
}

#[test]
fn the_side_towards_one_node_is_set_for_it_alone() {
    let stage = Stage::with(&["agv-1", "agv-2"]);
    let reported = stage.ends(0, &["set", "agv-1", "request_timeout", "100ms", "--json"]).json();
    assert_eq!(reported["request_timeout_us"], 100_000);
    stage.ends(1, &["call", "agv-1", "slow"]).says("TimedOut");
    let own = stage.ends(0, &["scan", "--json"]).json()["unit"]["constraints"]["request_timeout_us"].clone();
    assert_eq!(own, 20_000_000);
}

#[test]
fn a_wrong_constraint_or_value_ends_with_2() {
    let stage = Stage::with(&[]);
    stage.ends(2, &["set", ".", "request_time", "2s"]).says("`request_timeout`");
    stage.ends(2, &["set", ".", "request_timeout", "2"]).says("a time with its unit");
    stage.ends(2, &["set", ".", "message_size", "1s"]).says("a size");
    stage.ends(2, &["set", ".", "maximum_nodes", "many"]).says("a whole number");
    stage.ends(2, &["set", ".", "chunk_size", "1MiB"]);
    stage.ends(2, &["set", ".", "request_timeout", "0s"]).says("at least 1000 microseconds");
    stage.ends(2, &["set", ".", "message_size", "1"]).says("it is 16 to ");
    stage.ends(2, &["set", ".", "maximum_nodes", "99999999"]);
    stage.ends(1, &["set", "agv-9", "request_timeout", "2s"]).says("no node `agv-9`");
}
