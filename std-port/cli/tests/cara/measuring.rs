//! `cara ping`.

use crate::support::{Running, Stage};

#[test]
fn a_ping_tells_each_round_trip_and_a_summary() {
    let stage = Stage::with(&["agv-1"]);
    let shown = stage.ends(0, &["ping", "agv-1", "--count", "3", "--interval", "1ms", "--timeout", "20s"]);
    shown.says("agv-1/11 3: ").says("3 of 3 answered: median ").says("p99").says("max");
    let reported = stage.ends(0, &["ping", "agv-1", "-c", "4", "-i", "1ms", "--timeout", "20s", "--json"]).json();
    assert_eq!(
        (&reported["node"], &reported["times"]["tried"], &reported["times"]["failed"]),
        (&"agv-1/11".into(), &4.into(), &0.into())
    );
    assert_eq!(reported["times"]["samples_us"].as_array().unwrap().len(), 4);
    assert!(reported["times"]["median_us"].as_f64().unwrap() > 0.0);
    stage.ends(2, &["ping", "agv-1", "--count", "0"]);
}

#[test]
fn ctrl_c_ends_a_ping_with_its_summary() {
    let stage = Stage::with(&["agv-1"]);
    let mut ping = Running::start(stage.command(&["ping", "agv-1", "--count", "1000", "--interval", "1h"]));
    ping.expect("agv-1/11 1: ");
    ping.interrupt();
    ping.expect("1 of 1 answered: median ");
    assert_eq!(ping.end(), 0);
}
