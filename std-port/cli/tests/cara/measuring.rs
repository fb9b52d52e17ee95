//! `cara ping` and `cara bench`.

use crate::support::{Running, Stage};

#[test]
fn a_ping_tells_each_round_trip_and_a_summary() {
    let stage = Stage::with(&["agv-1"]);
    let shown = stage.ends(0, &["ping", "agv-1", "--count", "3", "--interval", "1ms", "--timeout", "20s"]);
    shown.says("agv-1/11 3: ").says("3 of 3 answered: median ").says("p99").says("max");
    let told = stage.ends(0, &["ping", "agv-1", "-c", "4", "-i", "1ms", "--timeout", "20s", "--json"]).json();
    assert_eq!(
        (&told["node"], &told["times"]["tried"], &told["times"]["failed"]),
        (&"agv-1/11".into(), &4.into(), &0.into())
    );
    assert_eq!(told["times"]["samples_us"].as_array().unwrap().len(), 4);
    assert!(told["times"]["median_us"].as_f64().unwrap() > 0.0);
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

const SHORT: [&str; 8] = ["--count", "5", "--pause", "1ms", "--periods", "5ms", "--group", "10"];

#[test]
fn a_bench_runs_both_experiments() {
    let stage = Stage::with(&["agv-1"]);
    let mut arguments = vec!["bench", "agv-1", "--sizes", "1,20000,30000", "--json"];
    arguments.extend(SHORT);
    let told = stage.ends(0, &arguments).json();
    assert!(told["function"].as_str().unwrap().starts_with("echo("), "{told}");
    let response = told["response"].as_array().unwrap();
    let sizes: Vec<_> = response.iter().map(|row| row["characters"].as_u64().unwrap()).collect();
    assert_eq!((sizes, &told["left_out"]), (vec![1, 20_000], &serde_json::json!([30_000])));
    assert!(response.iter().all(|row| row["times"]["samples_us"].as_array().unwrap().len() == 5), "{told}");
    let availability = told["availability"].as_array().unwrap();
    assert_eq!(availability.len(), 2);
    for row in availability {
        assert_eq!((&row["groups"][0]["sent"], &row["period_us"]), (&10.into(), &5_000.into()), "{row}");
        assert_eq!(row["availability"], 1.0, "{row}");
    }
}

#[test]
fn a_bench_shows_distributions() {
    let stage = Stage::with(&["agv-1"]);
    let mut arguments = vec!["bench", "agv-1", "--function", "swallow", "--sizes", "10,1000"];
    arguments.extend(SHORT);
    let shown = stage.ends(0, &arguments);
    shown.says("swallow(text: string[100])").says("left out").says("1000 characters");
    shown.says("response time").says("median").says("p99").says("max").says("availability");
}

#[test]
fn requests_that_are_not_executed_lower_availability() {
    let stage = Stage::with(&["agv-1"]);
    // One request a minute, so that all but the first of a group are refused.
    stage.ends(0, &["set", "agv-1", "minimum_interval", "1min"]);
    let arguments = ["bench", "agv-1", "--sizes", "1", "--count", "1", "--periods", "1ms", "--group", "5", "--json"];
    let told = stage.ends(1, &arguments).json();
    let group = &told["availability"][0]["groups"][0];
    assert!(
        group["refused"].as_u64().unwrap() >= 4 && told["availability"][0]["availability"].as_f64() < Some(0.3),
        "{told}"
    );
    assert!(group["error"].as_str().is_some_and(|error| error.contains(": ")), "{told}");
}

#[test]
fn availability_can_be_left_out() {
    let stage = Stage::with(&["agv-1"]);
    let told = stage.ends(0, &["bench", "agv-1", "--sizes", "1", "--count", "2", "--groups", "0", "--json"]).json();
    assert_eq!((told["availability"].as_array().unwrap().len(), told["response"].as_array().unwrap().len()), (0, 1));
}

#[test]
fn a_function_that_cannot_be_measured_ends_with_2() {
    let stage = Stage::with(&["agv-1"]);
    stage.ends(2, &["bench", "agv-1", "--function", "go_to"]).says("does not take one string").says("go_to(position");
    stage.ends(2, &["bench", "agv-1", "--function", "ecco"]).says("did you mean `echo`?");
}
