//! `cara stop` and `cara reset`: by attribute, whatever the functions are called, with an outcome for each s_unit.

use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use cara_std::{Constraints, Definition, ParametersView, Priority, Served, ServiceError, ServiceOptions, Unit};

use crate::support::{Ran, Stage, until};

/// A vehicle that moves by `go()`, and whose reset is refused while it is not safe.
struct Vehicle {
    unit: Unit,
    is_safe: Arc<AtomicBool>,
}

impl Vehicle {
    /// With as many drives as there are names of functions that stop one each; `free()` resets all.
    fn start(stage: &Stage, name: &str, id: u32, stops: &[&str]) -> Self {
        let is_safe = Arc::new(AtomicBool::new(true));
        stage.know(name, id);
        let constraints = Constraints { calls_per_peer: 2, ..Constraints::S_UNIT };
        let unit = stage.vehicle(name, id).constraints(constraints).build().unwrap();
        let functions = unit.my_function_list();
        let define = |text: String| Definition::parse(&text).unwrap();
        // So that the calls of several functions meet.
        let slow = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
            std::thread::sleep(std::time::Duration::from_millis(100));
            Ok(())
        };
        let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        for (number, stop) in stops.iter().enumerate() {
            let drive = functions.actuator(|| ()).unwrap();
            let moves = ServiceOptions::new().moves(&drive, std::time::Duration::from_secs(600));
            let go = if number == 0 { "go()".to_owned() } else { format!("go_{number}()") };
            functions.add_service(&define(go), moves, nothing).unwrap();
            let options = ServiceOptions::new().stops(&drive).priority(Priority::Emergency);
            functions.add_service(&define(format!("{stop}()")), options, slow).unwrap();
        }
        let safe = is_safe.clone();
        let free = move |_: &Served, _: &mut ParametersView| match safe.load(Ordering::SeqCst) {
            true => Ok(()),
            false => Err(ServiceError::Failed(2)),
        };
        functions.add_service(&define("free()".into()), ServiceOptions::new().resets_all(), free).unwrap();
        unit.publish_my_function_list().unwrap();
        unit.start().unwrap();
        Self { unit, is_safe }
    }
}

impl Drop for Vehicle {
    fn drop(&mut self) {
        self.unit.stop();
    }
}

/// Waits until the manager knows what each node offers.
fn known(stage: &Stage, nodes: &[&str]) {
    for node in nodes {
        until("it has published", || stage.cara(&["functions", node]).out.contains("free()"));
    }
}

fn is_stopped(stage: &Stage, node: &str, by: u32) {
    stage.ends(1, &["call", node, "go"]).says("Inhibited").says(&format!("by the unit with the ID {by}, "));
}

/// A reset counts from the earliest time at which it can have been asked for: one right behind the stop is refused.
fn reset(stage: &Stage, of: &str) {
    until("it is reset", || stage.cara(&["reset", of]).code == 0);
}

#[test]
fn all_are_stopped_whatever_their_functions_are_called_until_they_are_reset() {
    let stage = Stage::with(&[]);
    let _vehicles = [Vehicle::start(&stage, "agv", 21, &["halt"]), Vehicle::start(&stage, "lift", 22, &["stand"])];
    known(&stage, &["agv", "lift"]);
    let shown = stage.ends(0, &["stop", "--all"]);
    shown.says("agv/21  acknowledged after ").says("lift/22  acknowledged after ");
    assert!(shown.out.lines().last().unwrap().starts_with("2 of 2 acknowledged, the last after "), "{}", shown.out);
    is_stopped(&stage, "agv", 1);
    is_stopped(&stage, "lift", 1);
    // One of them alone.
    reset(&stage, "lift");
    stage.ends(0, &["call", "lift", "go"]);
    is_stopped(&stage, "agv", 1);
    let reported = stage.ends(0, &["stop", "lift", "--json"]).lines();
    assert_eq!(
        (reported.len(), &reported[0]["node"], &reported[0]["error"]),
        (2, &"lift/22".into(), &serde_json::Value::Null)
    );
    assert_eq!((&reported[1]["nodes"], &reported[1]["acknowledged"]), (&1.into(), &1.into()));
    assert!(reported[0]["took_us"].is_u64() && reported[1]["last_us"] == reported[0]["took_us"], "{reported:?}");
    is_stopped(&stage, "lift", 1);
    reset(&stage, "--all");
    stage.ends(0, &["call", "--all", "go"]);
}

#[test]
fn who_was_not_reached_and_who_cannot_be_stopped_is_told_by_name() {
    let mut stage = Stage::with(&[]);
    stage.ends(1, &["stop", "--all"]).says("no s_unit is known");
    stage.ends(2, &["stop"]).says("cara stop --all");
    stage.ends(2, &["reset"]).says("cara reset --all");
    stage.ends(2, &["stop", "agv", "--all"]);
    let vehicle = Vehicle::start(&stage, "agv", 21, &["halt"]);
    stage.start_agv("depot", 30);
    stage.know("gone", 31);
    known(&stage, &["agv"]);
    until("depot has published", || stage.cara(&["functions", "depot"]).out.contains("echo"));
    until("the key file was read", || stage.cara(&["scan"]).out.contains("gone"));
    let shown = stage.ends(1, &["stop", "--all"]);
    shown.says("agv/21  acknowledged").says("gone/31: not reached: it was not connected").says("depot/30: NoStop: ");
    shown.says("1 of 3 acknowledged, the last after ").says("; not acknowledged: depot/30, gone/31");
    is_stopped(&stage, "agv", 1);
    let reported = stage.ends(1, &["reset", "--all", "--json"]).lines();
    let error =
        |node: &str| reported.iter().find(|line| line["node"] == node).map(|line| line["error"]["error"].clone());
    assert_eq!((error("depot/30"), error("gone/31")), (Some("NoReset".into()), Some("NotConnected".into())));
    assert_eq!(reported.last().unwrap()["nodes"], 3);
    stage.ends(1, &["stop", "depot"]).says("NoStop");
    stage.ends(1, &["stop", "gone"]).says("not reached");
    drop(vehicle);
    until("it has left", || stage.cara(&["stop", "agv"]).out.contains("agv/21: not reached"));
}

#[test]
fn a_vehicle_may_refuse_the_reset() {
    let stage = Stage::with(&[]);
    let vehicle = Vehicle::start(&stage, "agv", 21, &["halt"]);
    known(&stage, &["agv"]);
    vehicle.is_safe.store(false, Ordering::SeqCst);
    stage.ends(0, &["stop", "agv"]);
    stage.ends(1, &["reset", "--all"]).says("agv/21: Service:").says("code 2").says("0 of 1 acknowledged");
    is_stopped(&stage, "agv", 1);
    vehicle.is_safe.store(true, Ordering::SeqCst);
    reset(&stage, "agv");
    stage.ends(0, &["call", "agv", "go"]);
}

/// As many at the same time as the vehicle takes of other calls, and more.
#[test]
fn each_drive_of_a_vehicle_is_stopped() {
    let stage = Stage::with(&[]);
    let _vehicle = Vehicle::start(&stage, "agv", 21, &["stop_a", "stop_b", "stop_c", "stop_d", "stop_e"]);
    known(&stage, &["agv"]);
    stage.ends(0, &["stop", "--all"]).says("1 of 1 acknowledged");
    for go in ["go", "go_1", "go_2", "go_3", "go_4"] {
        stage.ends(1, &["call", "agv", go]).says("Inhibited");
    }
}

#[test]
fn without_the_right_to_a_function_nothing_is_reset() {
    let mut stage = Stage::empty();
    let table = stage.control().join("access.toml");
    let rules = "[[allow]]\nwho = \"s_units\"\nfunctions = \"*\"\nverbs = \"publish\"\n\
                 [[allow]]\nwho = \"operator\"\nfunctions = [\"halt\", \"go\"]\nverbs = [\"list\", \"call\"]\n\
                 [[allow]]\nwho = \"operator\"\nfunctions = [\"free\"]\nverbs = \"list\"\n";
    std::fs::write(&table, rules).unwrap();
    stage.start_manager_with(&["--access", table.to_str().unwrap()]);
    let _vehicle = Vehicle::start(&stage, "agv", 21, &["halt"]);
    known(&stage, &["agv"]);
    stage.ends(0, &["stop", "--all"]);
    stage.ends(1, &["reset", "--all"]).says("agv/21: NotAllowed:").says("does not let the operator call 'free'");
    is_stopped(&stage, "agv", 1);
}

#[test]
fn a_stop_outlasts_the_manager() {
    let mut stage = Stage::with(&[]);
    let _vehicle = Vehicle::start(&stage, "agv", 21, &["halt"]);
    known(&stage, &["agv"]);
    stage.ends(0, &["stop", "agv"]);
    stage.kill_manager();
    stage.start_manager();
    known(&stage, &["agv"]);
    is_stopped(&stage, "agv", 1);
    reset(&stage, "agv");
    stage.ends(0, &["call", "agv", "go"]);
}

#[test]
fn who_moves_what_is_shown_with_what_inhibits_it() {
    let stage = Stage::with(&[]);
    stage.ends(0, &["orders"]).says("no node has published a function with a lease");
    let _vehicle = Vehicle::start(&stage, "agv", 21, &["halt"]);
    known(&stage, &["agv"]);
    let row = || {
        stage
            .cara(&["orders", "agv"])
            .out
            .lines()
            .nth(1)
            .unwrap_or_default()
            .split_whitespace()
            .collect::<Vec<_>>()
            .join(" ")
    };
    assert_eq!(row(), "agv/21 go none - - -");
    stage.ends(0, &["call", "agv", "go"]);
    until("it runs", || row() == "agv/21 go runs 1 - -");
    stage.ends(0, &["stop", "agv"]);
    until("it is stopped", || row() == "agv/21 go stopped 1 - by unit 1");
    let reported = &stage.ends(0, &["orders", "--json"]).lines()[0]["orders"][0];
    assert_eq!(
        (&reported["node"], &reported["order"], &reported["inhibited"]["by"]),
        (&"agv".into(), &"stopped".into(), &1.into())
    );
    reset(&stage, "agv");
    until("it is free", || row() == "agv/21 go stopped 1 - -");
    stage.ends(1, &["orders", "lift"]);
}

/// Its handler answers nothing, as where the way back is cut or the handler hangs.
#[test]
fn a_stop_that_is_not_answered_is_sent_one_way_as_well_and_says_so() {
    let mut stage = Stage::with(&[]);
    stage.know("agv", 21);
    let unit = stage.vehicle("agv", 21).build().unwrap();
    let count = Arc::<AtomicU32>::default();
    let (counted, hangs) = (count.clone(), Arc::<AtomicBool>::new(true.into()));
    let continues = hangs.clone();
    let halt = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        counted.fetch_add(1, Ordering::SeqCst);
        while continues.load(Ordering::SeqCst) {
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
        Ok(())
    };
    let wheels = unit.my_function_list().actuator(|| ()).unwrap();
    let stops = ServiceOptions::new().stops(&wheels).priority(Priority::Emergency);
    unit.my_function_list().add_service(&Definition::parse("halt()").unwrap(), stops, halt).unwrap();
    unit.publish_my_function_list().unwrap();
    unit.start().unwrap();
    stage.start_agv("depot", 30);
    until("it has published", || stage.cara(&["functions", "agv"]).out.contains("halt()"));
    stage.ends(0, &["set", ".", "request_timeout", "2s"]);
    let shown = stage.ends(1, &["stop", "agv"]);
    shown.says("agv/21: TimedOut: ").says("sent one way as well").says("0 of 1 acknowledged; not acknowledged: agv/21");
    hangs.store(false, Ordering::SeqCst);
    until("what was sent one way runs when the handler is free", || count.load(Ordering::SeqCst) > 1);
    unit.stop();
}

#[test]
fn a_stop_whose_output_has_no_room_is_carried_out_and_told() {
    let mut stage = Stage::with(&[]);
    let _vehicles = [Vehicle::start(&stage, "agv", 21, &["halt"]), Vehicle::start(&stage, "lift", 22, &["stand"])];
    known(&stage, &["agv", "lift"]);
    let full = || std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let stop = |stage: &Stage| {
        let child = stage.command(&["stop", "--all"]).stdout(full()).stderr(Stdio::piped()).spawn().unwrap();
        Ran::of(child.wait_with_output().unwrap())
    };
    let ran = stop(&stage);
    assert_eq!(ran.code, 1, "{}", ran.everything());
    ran.says("No space left").says("2 of 2 acknowledged, the last after ");
    is_stopped(&stage, "agv", 1);
    is_stopped(&stage, "lift", 1);
    stage.know("gone", 31);
    until("the key file was read", || stage.cara(&["scan"]).out.contains("gone"));
    stop(&stage).says("2 of 3 acknowledged").says("not acknowledged: gone/31");
    // A reader that has gone hides no failure.
    let (reader, unread) = std::io::pipe().unwrap();
    drop(reader);
    assert_eq!(stage.command(&["stop", "--all"]).stdout(unread).status().unwrap().code(), Some(1));
    stage.stop_agvs();
}

/// A door is an m_unit, and no m_unit is on the roster.
#[test]
fn all_are_stopped_also_those_that_are_not_on_the_roster() {
    let mut stage = Stage::empty();
    stage.start_manager_with(&["--m-unit", "other/2"]);
    let door = stage.m_unit("other", 2).m_units([("manager", 1)]).unwrap().build().unwrap();
    let count = Arc::<AtomicU32>::default();
    let counted = count.clone();
    let halt = move |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        counted.fetch_add(1, Ordering::SeqCst);
        Ok(())
    };
    let wings = door.my_function_list().actuator(|| ()).unwrap();
    let stops = ServiceOptions::new().stops(&wings).priority(Priority::Emergency);
    door.my_function_list().add_service(&Definition::parse("halt()").unwrap(), stops, halt).unwrap();
    door.publish_my_function_list().unwrap();
    door.start().unwrap();
    until("it has published", || stage.cara(&["functions", "other"]).out.contains("halt()"));
    stage.ends(0, &["stop", "--all"]).says("other/2  acknowledged").says("1 of 1 acknowledged");
    assert!(count.load(Ordering::SeqCst) > 0);
    door.stop();
}
