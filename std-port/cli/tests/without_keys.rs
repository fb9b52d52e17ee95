//! Units for which there are no keys: what they say, that the one command in it is enough, and that plain mode is asked for
//! in words and warns.

use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

use cara_processes::{Process, random_fleet};
use cara_std::{BuildError, CommunicationSystem, Unit};
use tempfile::TempDir;

/// Longest wait for anything that is to happen.
const PATIENCE: Duration = Duration::from_secs(60);

/// A user with an empty home, and a fleet.
struct User {
    home: TempDir,
    fleet: u32,
}

impl User {
    fn new() -> Self {
        let user = Self { home: TempDir::new().unwrap(), fleet: random_fleet() };
        let vehicle = "name = \"agv 7\"\nid = 7\nrole = \"s_unit\"\n[manager]\nname = \"yard\"\nid = 3\n";
        std::fs::write(user.home.path().join("vehicle.toml"), vehicle).unwrap();
        user
    }

    fn variables(&self) -> [String; 4] {
        let (home, own) = (self.home.path().display(), Path::new(env!("CARGO_BIN_EXE_cara")).parent().unwrap());
        let path = std::env::var("PATH").unwrap_or_default();
        [
            format!("HOME={home}"),
            format!("PATH={}:{path}", own.display()),
            format!("CARA_CONTROL_DIR={home}/control"),
            "CARA_INTERFACES=lo".into(),
        ]
    }

    /// What is typed in a shell.
    fn types(&self, command: &str) -> Output {
        let unset = ["-u", "CARA_KEYS", "-u", "XDG_CONFIG_HOME"];
        let mut env = Command::new("env");
        env.args(unset).args(self.variables()).args(["sh", "-c", command]).current_dir(self.home.path());
        env.output().unwrap()
    }

    /// The command that a unit without keys says.
    #[track_caller]
    fn reported(&self, unit: &str) -> String {
        let refused = self.types(&self.node(unit));
        let text = String::from_utf8(refused.stderr).unwrap();
        assert_eq!(refused.status.code(), Some(1), "{text}");
        assert!(text.contains("has no keys here") && text.contains(".config/cara/keys/"), "{text}");
        text.split('`').nth(1).unwrap().to_owned()
    }

    #[track_caller]
    fn succeeds(&self, command: &str) {
        let ran = self.types(command);
        assert!(ran.status.success(), "{command}: {}", String::from_utf8_lossy(&ran.stderr));
    }

    /// A node that runs, with what it says on both of its outputs.
    fn runs(&self, unit: &str) -> Process {
        let script = format!("cd; exec 2>&1; exec {}", self.node(unit));
        let unset = ["-u", "CARA_KEYS", "-u", "XDG_CONFIG_HOME"].map(String::from);
        let words = unset.into_iter().chain(self.variables()).chain(["sh".into(), "-c".into(), script]);
        Process::start(unit, Path::new("env"), words).unwrap()
    }

    fn node(&self, unit: &str) -> String {
        format!("cara node {unit} --fleet {}", self.fleet)
    }
}

const MANAGER: &str = "--name yard --id 3";
const VEHICLE: &str = "vehicle.toml";

fn meet(user: &User) {
    let mut manager = user.runs(MANAGER);
    manager.expect(&format!("fleet {}, secured, discovery port 21971", user.fleet), PATIENCE).unwrap();
    let vehicle = user.runs(VEHICLE);
    vehicle.seen("secured, discovery port 21971", PATIENCE).unwrap();
    manager.seen("joined node=agv 7/7", PATIENCE).unwrap();
    assert!(!manager.has("plain mode"));
}

#[test]
fn the_command_that_a_manager_says_is_enough_and_then_its_vehicle_s() {
    let user = User::new();
    let command = user.reported(MANAGER);
    assert_eq!(command, format!("cara keys new-fleet --fleet {} yard/3@m_unit", user.fleet));
    user.succeeds(&command);
    let command = user.reported(VEHICLE);
    assert_eq!(command, format!("cara keys derive --fleet {} --manager yard/3 'agv 7/7'", user.fleet));
    user.succeeds(&command);
    meet(&user);
}

#[test]
fn the_command_that_a_vehicle_says_is_enough_for_both() {
    let user = User::new();
    let command = user.reported(VEHICLE);
    assert_eq!(command, format!("cara keys new-fleet --fleet {} yard/3@m_unit 'agv 7/7'", user.fleet));
    user.succeeds(&command);
    meet(&user);
}

/// What is read at the first alarm lets a stolen vehicle in again only where that is said to be on purpose.
#[test]
fn a_vehicle_that_was_revoked_is_told_so() {
    let user = User::new();
    user.succeeds(&format!("cara keys new-fleet --fleet {} yard/3@m_unit 'agv 7/7'", user.fleet));
    user.succeeds(&format!("cara keys revoke --fleet {} 'agv 7/7'", user.fleet));
    let refused = user.types(&user.node(VEHICLE));
    let text = String::from_utf8(refused.stderr).unwrap();
    assert_eq!(refused.status.code(), Some(1), "{text}");
    assert!(text.contains("was revoked") && text.contains("Leave it so") && !text.contains("Make them"), "{text}");
    let way = format!("`cara keys derive --fleet {} --manager yard/3 'agv 7/7'` admits it on purpose", user.fleet);
    assert!(text.contains(&way), "{text}");
}

/// A fleet that has keys, of another manager than the one that a vehicle joins.
#[test]
fn a_vehicle_of_a_manager_without_keys_says_a_command_that_makes_both() {
    let user = User::new();
    user.succeeds(&format!("cara keys new-fleet --fleet {} other/1@m_unit", user.fleet));
    let command = user.reported(VEHICLE);
    user.succeeds(&command);
    meet(&user);
}

/// The library's own default, in this process: whatever keys its user has, there are none of a random fleet.
#[test]
fn a_program_that_says_nothing_about_keys_is_not_built_without() {
    let fleet = random_fleet();
    let manager = CommunicationSystem::builder("yard", 3).unwrap().fleet(fleet).build().map(drop);
    let vehicle = Unit::builder("agv", 7, "yard", 3).unwrap().fleet(fleet).build().map(drop);
    for error in [manager.unwrap_err(), vehicle.unwrap_err()] {
        assert!(matches!(error, BuildError::Keys(_)), "{error}");
        let text = error.to_string();
        assert!(text.contains("`cara keys ") && text.contains(&format!("--fleet {fleet} ")), "{text}");
    }
}

#[test]
fn plain_mode_is_asked_for_and_warns_once() {
    let user = User::new();
    let mut manager = user.runs(&format!("{MANAGER} --insecure"));
    manager.expect(&format!("fleet {}, plain, discovery port 21970", user.fleet), PATIENCE).unwrap();
    // It comes on another stream, which may be read later.
    manager.seen("plain mode", PATIENCE).unwrap();
    let lines = manager.lines();
    let warnings: Vec<_> = lines.iter().filter(|line| line.text.contains("plain mode")).collect();
    let [warning] = warnings[..] else { panic!("{lines:?}") };
    for part in ["WARN", "yard/3", "21970", "can read"] {
        assert!(warning.text.contains(part), "{}", warning.text);
    }
    let file = format!("{VEHICLE} --insecure");
    let vehicle = user.runs(&file);
    vehicle.seen("plain, discovery port 21970", PATIENCE).unwrap();
    manager.seen("joined node=agv 7/7", PATIENCE).unwrap();
    drop((vehicle, manager));

    let command = format!("cara scan --as own/9 --insecure --wait 1ms --fleet {}", user.fleet);
    let reported = String::from_utf8(user.types(&command).stderr).unwrap();
    assert!(reported.starts_with("warning: own/9 is in plain mode, on port 21970: "), "{reported}");
    let both = user.types("cara node --name a --id 1 --insecure --key-file x");
    assert_eq!(both.status.code(), Some(2));
}
