//! What `cara call` tells of a call beside its results: how far it is, and why it fails.

use cara_std::{Failure, Parameters, ParametersView, Served, ServiceError, ServiceOptions};

use crate::support::{Stage, until};

/// An AGV that tells the metres that are left until `cara` has surely heard the last one, and then that its way is blocked,
/// or that it has arrived.
fn stage() -> (Stage, cara_std::Unit) {
    let stage = Stage::with(&[]);
    stage.know("agv-1", 11);
    let agv = stage.vehicle("agv-1", 11).build().unwrap();
    let definition = "go(free: bool) -> (free: bool) progress (left: int) fails (at: int[2])".parse().unwrap();
    agv.my_function_list().add_service(&definition, ServiceOptions::new(), go).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    until("it is known", || stage.cara(&["functions", "agv-1"]).everything().contains("go("));
    (stage, agv)
}

fn go(call: &Served, parameters: &mut ParametersView) -> Result<(), ServiceError> {
    let mut left = Parameters::new();
    left.add_int("left", 1)?;
    for metres in [12, 5] {
        left.set_value("left", metres)?;
        // The same again and again, so that one of them comes however busy the machine is.
        for _ in 0..50 {
            call.progress(&left).map_err(|_| ServiceError::Failed(1))?;
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
    }
    if parameters.variable("free")? {
        return Ok(());
    }
    let mut blocked = Failure::new(7, "the way is \u{1b}[2Jblocked");
    blocked.values_mut().add_int("at", 2)?;
    blocked.values_mut().set_value("at", [3, 4])?;
    Err(call.fail(blocked))
}

#[test]
fn a_call_tells_how_far_it_is_and_why_it_fails() {
    let (stage, agv) = stage();
    let ran = stage.ends(0, &["call", "agv-1", "go(free: true)"]);
    ran.says("…(left: 12)\n").says("…(left: 5)\n").says("go(free: true)\n");
    let ran = stage.ends(1, &["call", "agv-1", "go(free: false)"]);
    ran.says("…(left: 5)\n").says("agv-1/11: Service: ").says("blocked (code 7) (at: [3, 4])");
    assert!(!ran.everything().contains('\u{1b}'), "{:?}", ran.everything());
    agv.stop();
}

#[test]
fn programs_read_progress_and_failure_as_json() {
    let (stage, agv) = stage();
    let lines = stage.ends(1, &["call", "agv-1", "go(free: false)", "--json"]).lines();
    let (reported, ended) = lines.split_at(lines.len() - 1);
    let left: Vec<i64> = reported.iter().map(|line| line["progress"][0]["value"].as_i64().unwrap()).collect();
    assert!(left.contains(&12) && left.contains(&5) && left.is_sorted_by(|a, b| a >= b), "{left:?}");
    assert_eq!(reported[0]["node"], "agv-1/11");
    let error = &ended[0]["error"];
    assert_eq!((&error["error"], &error["values"][0]["value"]), (&"Service".into(), &serde_json::json!([3, 4])));
    assert_eq!((&error["code"], &error["reason"]), (&7.into(), &"the way is \u{1b}[2Jblocked".into()));
    agv.stop();
}
