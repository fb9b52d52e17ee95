//! Terms: a manager that takes over, one that is fenced, and what is kept across starts.

use std::path::Path;
use std::sync::mpsc::Receiver;

use cara_std::control::Control;
use cara_std::{CommunicationSystem, Error, StartError, Term, Unit, UnitEvent};

use crate::support::{PATIENCE, fleet, system, unit, until};

fn manager(fleet: u32, state: Option<&Path>, takes_over: bool) -> CommunicationSystem {
    let builder = system(fleet).control(Control::Off).take_over(takes_over);
    match state {
        Some(folder) => builder.state_folder(folder).build().unwrap(),
        None => builder.build().unwrap(),
    }
}

fn vehicle(fleet: u32, state: &Path) -> Unit {
    let agv = unit("agv", 7, fleet).state_folder(state).build().unwrap();
    agv.start().unwrap();
    agv
}

/// The term by which a manager is fenced; its unit has stopped then.
fn fenced(events: &Receiver<UnitEvent>) -> Term {
    loop {
        if let UnitEvent::Fenced { term } = events.recv_timeout(PATIENCE).unwrap() {
            return term;
        }
    }
}

#[test]
fn a_manager_that_takes_over_gets_the_vehicle_and_the_other_one_steps_down() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let [here, there, board] = ["here", "there", "board"].map(|name| folder.path().join(name));
    let first = manager(fleet, Some(&here), false);
    let events = first.events();
    first.start().unwrap();
    let agv = vehicle(fleet, &board);
    until("it has joined the first", || first.number_of_s_units() == 1);
    assert_eq!((first.term(), agv.term()), (Term(1), Term(1)));

    let unwanted = manager(fleet, Some(&there), false).start();
    assert!(matches!(unwanted, Err(StartError::AlreadyRunning { .. })), "{unwanted:?}");
    let second = manager(fleet, Some(&there), true);
    second.start().unwrap();
    assert_eq!(second.term(), Term(2));
    assert_eq!(fenced(&events), Term(2));
    assert_eq!(first.start(), Err(Error::NotRunning.into()), "it has stopped");
    until("it has joined the second", || second.number_of_s_units() == 1 && agv.term() == Term(2));

    // What was heard is kept: where no live one answers, the next start claims the term behind it.
    second.stop();
    let third = manager(fleet, Some(&here), false);
    third.start().unwrap();
    assert_eq!(third.term(), Term(3));
    until("it has joined the third", || third.number_of_s_units() == 1 && agv.term() == Term(3));
}

#[test]
fn what_a_vehicle_has_obeyed_outlives_it_and_a_lost_term_locks_no_manager_out() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let board = folder.path().join("board");
    let [kept, lost] = ["kept", "lost"].map(|name| folder.path().join(name));
    for life in 1..4 {
        let manager = manager(fleet, Some(&kept), false);
        manager.start().unwrap();
        let agv = vehicle(fleet, &board);
        until("it has joined", || manager.number_of_s_units() == 1 && agv.term() == Term(life));
    }
    let agv = vehicle(fleet, &board);
    assert_eq!(agv.term(), Term(3), "kept across its lives");
    // With another folder it begins with the first term, hears of the third, and is alone.
    let manager = manager(fleet, Some(&lost), false);
    manager.start().unwrap();
    assert_eq!(manager.term(), Term(1));
    until("it has claimed again", || manager.term() == Term(4));
    until("it has joined", || manager.number_of_s_units() == 1 && agv.term() == Term(4));
}

#[test]
fn a_manager_that_cannot_keep_its_term_does_not_start() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    let manager = manager(fleet, Some(&file.join("state")), false);
    let error = manager.start().unwrap_err();
    assert!(matches!(error, StartError::Term(_)) && error.to_string().contains("CARA_STATE"), "{error}");
}
