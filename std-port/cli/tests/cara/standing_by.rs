//! Two managers on one host that stand by for each other, and what a user of `cara` sees of them.

use std::fs::{File, read_to_string};
use std::path::PathBuf;

use cara_std::{Definition, ParametersView, Served, ServiceError, ServiceOptions, Unit};
use tempfile::TempDir;

use crate::support::{Running, Stage, agv, private_folder, until};

struct Host {
    vehicle: Unit,
    stage: Stage,
    /// Each standby's state and log.
    folders: [TempDir; 2],
}

impl Host {
    fn new() -> Self {
        let stage = Stage::empty();
        stage.know("agv-1", 11);
        Self { vehicle: agv(stage.vehicle("agv-1", 11)), stage, folders: [private_folder(), private_folder()] }
    }

    fn path(&self, which: usize) -> PathBuf {
        self.folders[which].path().join("log")
    }

    fn start(&self, which: usize) -> Running {
        let mut standby = self.spawn(which);
        standby.expect(" is up: ");
        standby
    }

    fn spawn(&self, which: usize) -> Running {
        let state = self.folders[which].path().to_str().unwrap();
        let mut command =
            self.stage.command(&["node", "--name", "manager", "--id", "1", "--standby", "--state", state]);
        command.stderr(File::create(self.path(which)).unwrap());
        Running::start(command)
    }

    fn says(&self, which: usize, text: &str) -> bool {
        read_to_string(self.path(which)).unwrap().contains(text)
    }

    /// As its log says.
    fn commands(&self, which: usize) -> bool {
        let log = read_to_string(self.path(which)).unwrap();
        log.rfind("this standby commands") > log.rfind("stands by again")
    }

    /// Whoever is asked commands the vehicle, with a claim above `term`.
    fn is_led_above(&self, term: u64) -> bool {
        let scan = self.stage.cara(&["scan", "--json"]);
        let scan: serde_json::Value = serde_json::from_str(scan.out.trim()).unwrap_or_default();
        self.vehicle.claim().term > term && scan["nodes"][0]["connected"] == true
    }

    /// Nothing in a log is an error, or tells that somebody has made a mistake.
    fn is_calm(&self) {
        for which in [0, 1] {
            let log = read_to_string(self.path(which)).unwrap();
            assert!(!log.contains("ERROR") && !log.contains("same name"), "{log}");
        }
    }
}

#[test]
fn whichever_commands_is_asked() {
    let host = Host::new();
    let first = host.start(0);
    until("it commands", || host.is_led_above(0));
    let mut second = host.start(1);
    until("the other one waits", || host.says(1, "stands by"));
    assert!(!host.says(1, "WARN"), "that is in order");
    host.stage.ends(0, &["ping", "agv-1", "--count", "1", "--timeout", "20s"]);
    let term = host.vehicle.claim().term;
    first.freeze();
    until("the second one commands, and is asked", || host.is_led_above(term));
    host.stage.ends(0, &["ping", "agv-1", "--count", "1", "--timeout", "20s"]);
    first.thaw();
    until("the first one waits", || host.says(0, "stands by again"));
    until("the second one is asked as before", || host.is_led_above(term));
    let term = host.vehicle.claim().term;
    second.kill();
    until("the first one commands again, and is asked", || host.is_led_above(term));
}

#[test]
fn two_that_start_at_once_settle_it_without_an_error() {
    let host = Host::new();
    let both = [0, 1].map(|which| host.spawn(which));
    until("one commands", || host.is_led_above(0));
    // Meanwhile they meet, and the vehicle may change over.
    host.stage.cara(&["ping", "agv-1", "--count", "20", "--interval", "100ms"]);
    until("the other one waits", || host.commands(0) != host.commands(1));
    for standby in both {
        standby.interrupt();
        assert_eq!(standby.end(), 0);
    }
    host.is_calm();
}

#[test]
fn a_standby_without_a_folder_of_state_does_not_start() {
    let stage = Stage::empty();
    let mut command = stage.command(&["node", "--name", "manager", "--id", "1", "--standby"]);
    command.env_remove("CARA_STATE").env_remove("STATE_DIRECTORY");
    let ran = crate::support::Ran::of(command.output().unwrap());
    assert_eq!(ran.code, 2, "{}", ran.everything());
    ran.says("a standby needs a folder of state").says("--state");
}

/// It finds nobody who commands, then the new manager without its vehicle, then the vehicle.
#[test]
fn a_stop_reaches_the_vehicle_through_the_standby() {
    let host = Host::new();
    let functions = host.vehicle.my_function_list();
    let wheels = functions.actuator(|| ()).unwrap();
    let nothing = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    functions
        .add_service(&Definition::parse("halt()").unwrap(), ServiceOptions::new().stops(&wheels), nothing)
        .unwrap();
    host.vehicle.publish_my_function_list().unwrap();
    let mut first = host.start(0);
    until("it commands", || host.is_led_above(0));
    let second = host.start(1);
    until("the other one waits", || host.says(1, "stands by"));
    first.kill();
    let stopped = host.stage.ends(0, &["stop", "--all"]);
    stopped.says("should a standby take over").says("1 of 1 acknowledged");
    until("it commands", || host.commands(1));
    // Of one that hangs it is heard no sooner than it is asked.
    let _first = host.start(0);
    until("the other one waits", || host.says(0, "stands by"));
    second.freeze();
    let stopped = host.stage.ends(0, &["stop", "--all"]);
    stopped.says("does not answer").says("1 of 1 acknowledged");
}
