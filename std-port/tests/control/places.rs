//! Where the socket is, and what a unit does that cannot have one: it runs.

use std::fs::{Permissions, set_permissions};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::os::unix::net::UnixListener;

use cara_std::control::{Client, Control, ControlError};

use crate::support::{Depot, directory, manager, until, vehicle, vehicle_of};

#[test]
fn the_socket_is_its_owners_alone_and_goes_with_the_unit() {
    let depot = Depot::new();
    let path = depot.directory.path().join("made").join("x.sock");
    let second = manager("second", 2, depot.fleet).control(Control::Path(path.clone())).build().unwrap();
    assert_eq!(second.control_path(), None, "not before it is started");
    second.start().unwrap();
    assert_eq!(second.control_path(), Some(path.clone()));
    let mode = |path: &std::path::Path| path.symlink_metadata().unwrap().mode() & 0o777;
    assert_eq!((mode(path.parent().unwrap()), mode(&path)), (0o700, 0o600));
    second.stop();
    assert!(!path.exists() && second.control_path().is_none());
    assert!(depot.path().exists());
}

#[test]
fn a_unit_that_is_started_twice_keeps_its_socket() {
    let depot = Depot::new();
    depot.system.start().unwrap();
    assert_eq!(depot.system.control_path(), Some(depot.path()));
    assert_eq!(depot.client().unit().fleet, depot.fleet);
    depot.system.stop();
    assert!(!depot.path().exists());
    depot.system.start().unwrap_err();
    assert_eq!((depot.system.control_path(), depot.path().exists()), (None, false));
}

#[test]
fn a_directory_that_others_enter_is_refused_and_the_unit_runs() {
    let above = directory();
    let open = above.path().join("open");
    std::fs::create_dir(&open).unwrap();
    set_permissions(&open, Permissions::from_mode(0o755)).unwrap();
    let depot = Depot::new();
    let lone = manager("lone", 2, depot.fleet).control(Control::Path(open.join("x.sock"))).build().unwrap();
    lone.start().unwrap();
    assert_eq!((lone.control_path(), open.join("x.sock").exists()), (None, false));
    let agv = vehicle_of(("lone", 2), "lone-agv", 9, depot.fleet).build().unwrap();
    agv.start().unwrap();
    until("it is a manager as any other", || lone.number_of_s_units() == 1);
    match Client::find_in(&open, None) {
        Err(error @ ControlError::NotAllowed { .. }) => assert!(error.to_string().contains("chmod 700"), "{error}"),
        other => panic!("{:?}", other.err()),
    }
}

#[test]
fn a_second_unit_of_the_same_name_runs_without_a_socket_and_the_first_keeps_its_own() {
    let depot = Depot::new();
    let duplicate = manager("manager", 1, depot.fleet ^ 1).control(Control::Path(depot.path())).build().unwrap();
    duplicate.start().unwrap();
    assert_eq!(duplicate.control_path(), None);
    assert_eq!(depot.client().unit().fleet, depot.fleet);
    drop(duplicate);
    assert_eq!(depot.client().unit().fleet, depot.fleet, "it removes nothing that is not its own");
}

#[test]
fn a_socket_that_a_killed_process_has_left_is_replaced() {
    let directory = directory();
    let path = directory.path().join("x.sock");
    drop(UnixListener::bind(&path).unwrap());
    assert!(matches!(Client::connect(&path), Err(ControlError::NoneRunning(_))));
    let depot = Depot::new();
    let system = manager("second", 2, depot.fleet).control(Control::Path(path.clone())).build().unwrap();
    system.start().unwrap();
    assert_eq!(Client::connect(&path).unwrap().unit().unit, "second/2");
}

#[test]
fn an_s_unit_has_no_socket() {
    let depot = Depot::new();
    let agv = vehicle("agv", 7, depot.fleet).build().unwrap();
    agv.start().unwrap();
    let running = cara_std::control::running().unwrap();
    assert!(running.iter().all(|unit| unit.fleet != depot.fleet || !unit.is("agv/7")), "{running:?}");
}

/// A unit that is started and stopped with clients leaves no file and no thread behind, which are counted elsewhere.
#[test]
fn stopping_ends_every_connection() {
    let (depot, _agv) = Depot::with_agv();
    let mut clients: Vec<_> = (0..8).map(|_| depot.client()).collect();
    depot.system.stop();
    assert!(!depot.path().exists());
    for client in &mut clients {
        let asked = client.ask(&cara_std::control::protocol::Question::Unit);
        assert!(asked.is_err() || asked.is_ok_and(|mut answers| answers.all(|answer| answer.is_err())));
    }
}
