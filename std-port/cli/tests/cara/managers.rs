//! `cara node` as the manager of a fleet: a second one of its identity, few descriptors, and missing nodes.

use std::io::{BufRead, BufReader};
use std::net::TcpStream;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use cara_std::{Claim, ParametersView, Served, ServiceError, ServiceOptions};
use serde_json::Value;

use crate::support::{PATIENCE, Ran, Running, Stage, agv, private_folder, until};

const NODE: [&str; 5] = ["node", "--name", "manager", "--id", "1"];

#[test]
fn a_second_manager_of_one_identity_does_not_start_and_the_first_goes_on() {
    let mut stage = Stage::with(&["agv-1"]);
    let connected = |stage: &Stage| stage.ends(0, &["scan", "--json"]).json()["nodes"][0].clone();
    let before = connected(&stage);
    for json in [false, true] {
        let arguments: Vec<&str> = NODE.into_iter().chain(json.then_some("--json")).collect();
        let refused = stage.ends(5, &arguments);
        refused.says("manager/1 of fleet").says(" is running already, at 127.0.0.1:").says("stop it first");
        assert!(!json || refused.says("\"AlreadyRunning\"").err.contains("\"exit\":5"), "{}", refused.everything());
    }
    let after = connected(&stage);
    assert_eq!((&after["epoch"], &after["connected"]), (&before["epoch"], &Value::Bool(true)));
    assert!(after["connected_ms"].as_u64() >= before["connected_ms"].as_u64(), "it has not left: {before} {after}");
    // One that was killed does not keep the next one from starting.
    stage.kill_manager();
    stage.start_manager();
    until("the vehicle is back", || stage.ready() == 1);
}

/// A port of its file is taken by the running one: no other port helps, and no restart.
#[test]
fn a_second_manager_with_fixed_ports_ends_as_one_without() {
    let folder = tempfile::tempdir().unwrap();
    let stage = Stage::empty();
    let free = || std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    for ports in [format!("tcp_port = {}", free()), format!("[metrics]\nlisten = \"127.0.0.1:{}\"", free())] {
        let file = folder.path().join("node.toml");
        std::fs::write(&file, format!("name = \"manager\"\nid = 1\n{ports}\n")).unwrap();
        let arguments = ["node", file.to_str().unwrap()];
        let mut first = Running::start(stage.command(&arguments));
        first.expect(" is up: ");
        stage.ends(5, &arguments).says("manager/1 of fleet").says(" is running already on this host, and port");
        assert_eq!(first.interrupted(), 0);
    }
}

/// The running one ends with a code of its own, also when it has been frozen meanwhile, and the vehicle changes over.
#[test]
fn a_manager_takes_over_and_the_other_one_ends_with_its_own_code() {
    let stage = Stage::empty();
    stage.know("agv-1", 11);
    let state = private_folder();
    let start = |more: &[&str]| {
        let mut command = stage.command(&[&NODE[..], more].concat());
        command.env("CARA_STATE", state.path());
        let mut node = Running::start(command);
        node.expect(" is up: ");
        node
    };
    let first = start(&[]);
    let vehicle = agv(stage.vehicle("agv-1", 11));
    until("the vehicle has joined", || vehicle.is_connected() && vehicle.claim().term == 1);
    let second = start(&["--take-over"]);
    assert_eq!(first.end(), 6);
    until("the vehicle has changed over", || vehicle.is_connected() && vehicle.claim().term == 2);
    stage.ends(0, &["scan", "--json"]);
    second.freeze();
    let third = start(&["--take-over"]);
    until("the vehicle has changed over again", || vehicle.is_connected() && vehicle.claim().term == 3);
    second.thaw();
    assert_eq!(second.end(), 6);
    assert!(vehicle.is_connected() && vehicle.claim().term == 3);
    third.interrupt();
    assert_eq!(third.end(), 0);
    vehicle.stop();
}

#[test]
fn no_manager_starts_beside_one_that_hangs_or_has_other_keys() {
    let mut stage = Stage::with(&[]);
    // A node that starts would run on.
    let refused = |stage: &Stage, arguments: &[&str]| {
        let node = stage.command(arguments);
        let mut limited = Command::new("timeout");
        limited.arg("30").arg(node.get_program()).args(node.get_args());
        limited.envs(node.get_envs().filter_map(|(name, value)| Some((name, value?)))).env_remove("CARA_INTERFACES");
        let ran = Ran::of(limited.output().unwrap());
        assert_eq!(ran.code, 5, "{}", ran.everything());
        ran
    };
    let plain = [&NODE[..], &["--insecure"]].concat();
    refused(&stage, &plain).says("manager/1 of fleet").says("control socket").says("manager-1-");
    stage.freeze_manager();
    for arguments in [&NODE[..], &plain, &[&NODE[..], &["--json"]].concat()] {
        let refused = refused(&stage, arguments);
        refused.says("manager/1 of fleet").says("stopped (state T").says("end it first");
        assert!(!arguments.contains(&"--json") || refused.error()["name"] == "AlreadyRunning");
    }
    // A socket without a process holds nothing up.
    stage.kill_manager();
    stage.start_manager();
}

#[test]
fn who_is_missing_is_shown_until_it_is_retired() {
    let mut stage = Stage::with(&["agv-1", "agv-2"]);
    stage.know("agv-9", 19);
    let state = |stage: &Stage, name: &str| {
        let reported = stage.ends(0, &["scan", "--json"]).json();
        let nodes = reported["nodes"].as_array().unwrap().clone();
        nodes.into_iter().find(|node| node["name"] == name)
    };
    let expected = |node: &Value| (node["connected"].as_bool().unwrap(), node["expected"].as_bool().unwrap());
    until("the new keys are taken", || state(&stage, "agv-9").is_some());
    assert_eq!(expected(&state(&stage, "agv-9").unwrap()), (false, true));
    assert_eq!(expected(&state(&stage, "agv-1").unwrap()), (true, true));
    stage.ends(0, &["scan"]).says("absent").says("1 of 3 s_units of the roster: agv-9/19").says("cara retire");
    let to_all = ["call", "--all", "go_to(position: [1, 2])"];
    stage.ends(1, &to_all).says("agv-9/19: NotConnected").says("agv-1/11  go_to(").says("agv-2/12  go_to(");
    // A function that no node offers: each is told of all the same.
    let none = stage.ends(1, &["call", "--all", "fly"]);
    none.says("agv-1/11: UnknownFunction").says("agv-2/12: UnknownFunction").says("agv-9/19: NotConnected");
    none.says("no connected node has published `fly`");
    let reported = stage.ends(1, &["call", "--all", "fly", "--json"]).lines();
    let mut reported: Vec<_> =
        reported.iter().map(|line| (line["node"].to_string(), line["error"]["error"].to_string())).collect();
    reported.sort();
    let of = |node: &str, error: &str| (format!("\"{node}\""), format!("\"{error}\""));
    let unknown = ["agv-1/11", "agv-2/12"].map(|node| of(node, "UnknownFunction"));
    assert_eq!(reported, [&unknown[..], &[of("agv-9/19", "NotConnected")]].concat());
    stage.ends(1, &["functions", "agv-9"]).says("has not joined");
    stage.ends(2, &["retire", "agv-1"]).says("is connected");
    stage.ends(1, &["retire", "agv-70"]).says("no node `agv-70`");
    assert_eq!(stage.ends(0, &["retire", "agv-9", "--json"]).json()["retired"], "agv-9/19");
    stage.ends(0, &to_all);
    assert!(!stage.ends(0, &["scan"]).out.contains("missing") && state(&stage, "agv-9").is_none());
    // It counts again once it has joined.
    let back = agv(stage.vehicle("agv-9", 19));
    until("it is expected again", || state(&stage, "agv-9").is_some_and(|node| expected(&node) == (true, true)));
    back.stop();
    until("it is missed", || state(&stage, "agv-9").is_some_and(|node| expected(&node) == (false, true)));
    stage.stop_agvs();
    until("all are missed", || stage.ends(0, &["scan"]).out.contains("3 of 3 s_units"));
}

/// 64 descriptors, and a client without keys that keeps 300 connections open: the operator is answered, and a vehicle joins.
#[test]
fn idle_connections_take_no_descriptor_from_the_operator_and_from_vehicles() {
    let stage = Stage::empty();
    stage.know("agv-1", 11);
    let node = stage.command(&[&NODE[..], &["--json"]].concat());
    // A shell sets the limit, for that process alone.
    let mut limited = Command::new("sh");
    limited.args(["-c", "ulimit -n 64; exec \"$@\"", "sh"]).arg(node.get_program()).args(node.get_args());
    limited.envs(node.get_envs().filter_map(|(name, value)| Some((name, value?)))).env_remove("CARA_INTERFACES");
    let mut manager = limited.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut first = String::new();
    BufReader::new(manager.stdout.take().unwrap()).read_line(&mut first).unwrap();
    let up: Value = serde_json::from_str(&first).unwrap_or_else(|error| panic!("{first}: {error}"));
    let port = up["tcp_port"].as_u64().unwrap() as u16;
    let log = BufReader::new(manager.stderr.take().unwrap());
    let (over, lines, opened) = (AtomicBool::new(false), AtomicUsize::new(0), AtomicUsize::new(0));
    std::thread::scope(|scope| {
        scope.spawn(|| log.lines().map_while(Result::ok).for_each(|_| _ = lines.fetch_add(1, Ordering::Relaxed)));
        scope.spawn(|| {
            let mut held = std::collections::VecDeque::new();
            while !over.load(Ordering::Relaxed) {
                if let Ok(stream) = TcpStream::connect(("127.0.0.1", port)) {
                    held.push_back(stream);
                    opened.fetch_add(1, Ordering::Relaxed);
                }
                if held.len() > 300 {
                    held.pop_front();
                    std::thread::sleep(Duration::from_millis(20));
                }
            }
        });
        let ended = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            until("300 are open", || opened.load(Ordering::Relaxed) > 300);
            let (start, lines_before) = (Instant::now(), lines.load(Ordering::Relaxed));
            // Again and again: one lucky moment is not enough.
            for _ in 0..20 {
                stage.ends(0, &["scan", "--unit", "manager/1"]);
            }
            let vehicle = agv(stage.vehicle("agv-1", 11));
            until("the vehicle has joined", || vehicle.is_connected());
            until("the manager has its list", || stage.ready() == 1);
            std::thread::sleep(Duration::from_secs(2));
            assert!(vehicle.is_connected() && start.elapsed() < PATIENCE * 3);
            let (reported, seconds) = (lines.load(Ordering::Relaxed) - lines_before, start.elapsed().as_secs() + 1);
            assert!(reported <= 6 * seconds as usize, "{reported} lines in {seconds} s");
            vehicle.stop();
        }));
        over.store(true, Ordering::Relaxed);
        manager.kill().unwrap();
        manager.wait().unwrap();
        if let Err(panic) = ended {
            std::panic::resume_unwind(panic);
        }
    });
}

/// Two hosts: a state folder and a control folder each, and so the same term. One hangs, the other one starts, with a take-over or
/// without; then the first goes on. Every restart of the vehicles ends with all of them at one manager.
#[test]
fn two_managers_with_equal_terms_do_not_split_the_fleet() {
    for flag in [Some("--take-over"), None] {
        let stage = Stage::empty();
        let names = ["agv-1", "agv-2", "agv-3"];
        names.iter().zip(11..).for_each(|(name, id)| stage.know(name, id));
        let [here, there, state_here, state_there] = std::array::from_fn(|_| private_folder());
        let start = |control: &tempfile::TempDir, state: &tempfile::TempDir, flag: Option<&str>| {
            let mut command = stage.command(&NODE.into_iter().chain(flag).collect::<Vec<_>>());
            command.env("CARA_STATE", state.path()).env("CARA_CONTROL_DIR", control.path());
            let mut node = Running::start(command);
            node.expect(" is up: ");
            node
        };
        let has = |control: &tempfile::TempDir| {
            let mut scan = stage.command(&["scan", "--json"]);
            let scan = scan.env("CARA_CONTROL_DIR", control.path()).output().unwrap();
            let scan: Value = serde_json::from_slice(&scan.stdout).unwrap_or_default();
            let nodes = scan["nodes"].as_array().cloned().unwrap_or_default();
            nodes.iter().filter(|node| node["connected"] == true && node["role"] != "m_unit").count()
        };
        let vehicles = || names.iter().zip(11..).map(|(name, id)| agv(stage.vehicle(name, id))).collect::<Vec<_>>();
        let first = start(&here, &state_here, None);
        let mut agvs = vehicles();
        until("all have joined the first", || has(&here) == 3);
        first.freeze();
        let second = start(&there, &state_there, flag);
        until("all have joined the second", || has(&there) == 3);
        first.thaw();
        assert_eq!(first.end(), 6, "the lower claim steps down");
        for _ in 0..3 {
            agvs.drain(..).for_each(|agv| agv.stop());
            agvs = vehicles();
            until("all have joined the second again", || has(&there) == 3);
        }
        assert_eq!(has(&here), 0);
        drop(second);
    }
}

#[test]
fn what_a_vehicle_has_obeyed_is_forgotten_while_it_does_not_run() {
    let mut stage = Stage::empty();
    stage.know("agv-1", 11);
    stage.start_manager();
    let state = private_folder();
    let start = |stage: &Stage| {
        let agv = stage.vehicle("agv-1", 11).state_folder(state.path()).build().unwrap();
        let options = ServiceOptions::new().lease(Duration::from_secs(5), || {});
        let drive = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        agv.my_function_list().add_service(&"drive()".parse().unwrap(), options, drive).unwrap();
        agv.publish_my_function_list().unwrap();
        agv.start().unwrap();
        agv
    };
    let agv = start(&stage);
    until("it drives", || stage.cara(&["call", "agv-1", "drive"]).code == 0);
    let obeyed = agv.claim();
    let folder = state.path().to_str().unwrap();
    stage.ends(1, &["forget-claim", "agv-1/11", "--state", folder]).says("agv-1/11 runs: stop its program first");
    agv.stop();
    drop(agv);
    stage.ends(1, &["forget-claim", "agv-2/12", "--state", folder]).says("no claim that agv-2/12 has obeyed");
    stage.ends(2, &["forget-claim", "agv-1/11"]).says("--state FOLDER");
    // What is kept counts at its next start, until it is forgotten.
    stage.kill_manager();
    assert_eq!(start(&stage).claim(), obeyed);
    let reported = stage.ends(0, &["forget-claim", "agv-1/11", "--state", folder]);
    reported.says(&format!("agv-1/11 (fleet {}) has forgotten claim {obeyed} of manager/1", stage.fleet));
    let audit = std::fs::read_to_string(state.path().join("audit.log")).unwrap();
    assert!(audit.contains("\"ask\":\"forget-claim\"") && audit.contains("agv-1/11"), "{audit}");
    assert_eq!(start(&stage).claim(), Claim::NONE);
    stage.ends(1, &["forget-claim", "agv-1/11", "--state", folder]).says("no claim");
}
