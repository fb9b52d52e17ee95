//! Claims: a manager that takes over, one that steps down, and what is stored across starts.

use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, Mutex};

use cara_std::control::Control;
use cara_std::{
    Actuator, Claim, CommunicationSystem, Definition, Error, LeaseEnd, Parameters, ParametersView, Renew, Served,
    ServiceError, ServiceOptions, StartError, Unit, UnitEvent,
};

use crate::support::{PATIENCE, fleet, system, unit, until};

fn manager(fleet: u32, state: &Path, takes_over: bool) -> CommunicationSystem {
    system(fleet).control(Control::Off).take_over(takes_over).state_folder(state).build().unwrap()
}

fn vehicle(fleet: u32, state: &Path) -> Unit {
    vehicle_with_drive(fleet, state).0
}

fn vehicle_with_drive(fleet: u32, state: &Path) -> (Unit, Actuator) {
    let agv = unit("agv", 7, fleet).state_folder(state).build().unwrap();
    let drive = agv.my_function_list().actuator(|| ()).unwrap();
    let options = ServiceOptions::new().moves(&drive, std::time::Duration::from_secs(1));
    let go = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    agv.my_function_list().add_service(&Definition::parse("go()").unwrap(), options, go).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    (agv, drive)
}

/// Has the vehicle move, before which it stores the claim.
fn move_it(manager: &CommunicationSystem) {
    until("it moves", || {
        let peer = manager.peer("agv");
        peer.is_ok_and(|agv| agv.block_request("go", &mut Parameters::new()).is_ok())
    });
}

/// The claim of the one that commands, of a manager that has stepped down.
fn stepped_down(events: &Receiver<UnitEvent>) -> Claim {
    loop {
        if let UnitEvent::Fenced { claim } = events.recv_timeout(PATIENCE).unwrap() {
            return claim;
        }
    }
}

#[test]
fn a_manager_that_takes_over_gets_the_vehicle_and_the_other_one_steps_down() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let [here, there, board] = ["here", "there", "board"].map(|name| folder.path().join(name));
    let first = manager(fleet, &here, false);
    let events = first.events();
    first.start().unwrap();
    let agv = vehicle(fleet, &board);
    until("it has joined the first", || first.number_of_s_units() == 1 && agv.claim() == first.claim());

    let unwanted = manager(fleet, &there, false).start();
    assert!(matches!(unwanted, Err(StartError::AlreadyRunning { .. })), "{unwanted:?}");
    let second = manager(fleet, &there, true);
    second.start().unwrap();
    assert!(second.claim() > first.claim());
    let claim = stepped_down(&events);
    assert_eq!(claim, second.claim());
    let kept = std::fs::read_dir(&here).unwrap().map(|file| std::fs::read_to_string(file.unwrap().path()).unwrap());
    let line = format!("own {} {}", claim.term, claim.claimant);
    assert!(kept.collect::<String>().contains(&line), "what it has heard is stored before it says that it has stopped");
    assert_eq!(first.start(), Err(Error::NotRunning.into()), "it has stopped");
    until("it has joined the second", || second.number_of_s_units() == 1 && agv.claim() == second.claim());

    // Another one within a minute is forced, or refused.
    let hasty = manager(fleet, &here, true).start();
    assert!(matches!(hasty, Err(StartError::JustTakenOver { .. })), "{hasty:?}");

    // What was heard is stored: where no live one answers, the next start claims above it.
    let claim = second.claim();
    second.stop();
    let third = manager(fleet, &here, false);
    third.start().unwrap();
    assert!(third.claim() > claim && third.claim().term == claim.term + 1);
    until("it has joined the third", || third.number_of_s_units() == 1 && agv.claim() == third.claim());
}

#[test]
fn what_a_vehicle_has_obeyed_outlives_it_and_a_lost_claim_locks_no_manager_out() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let board = folder.path().join("board");
    let [kept, lost, copy] = ["kept", "lost", "copy"].map(|name| folder.path().join(name));
    let copied = |from: &Path, to: &Path| {
        std::fs::create_dir_all(to).unwrap();
        for file in std::fs::read_dir(from).unwrap().map(Result::unwrap) {
            std::fs::copy(file.path(), to.join(file.file_name())).unwrap();
        }
    };
    let mut obeyed = Claim::NONE;
    for life in 1..4 {
        let manager = manager(fleet, &kept, false);
        manager.start().unwrap();
        let agv = vehicle(fleet, &board);
        move_it(&manager);
        obeyed = manager.claim();
        assert_eq!((obeyed.term, agv.claim()), (life, obeyed));
        if life == 1 {
            copied(&board, &copy);
        }
    }
    let agv = vehicle(fleet, &board);
    assert_eq!(agv.claim(), obeyed, "stored across its lives");
    // With another folder it begins with the first term, hears of the third, and is alone.
    let manager = manager(fleet, &lost, false);
    manager.start().unwrap();
    assert_eq!(manager.claim().term, 1);
    until("it has raised its claim", || manager.claim().term == 4);
    until("it has joined", || manager.number_of_s_units() == 1 && agv.claim() == manager.claim());
    move_it(&manager);
    // From a copy of its folder it starts with what it obeyed then, and obeys the one that commands.
    drop(agv);
    copied(&copy, &board);
    let agv = vehicle(fleet, &board);
    assert_eq!(agv.claim().term, 1);
    move_it(&manager);
    assert_eq!((agv.claim().term, agv.claim()), (4, manager.claim()));
}

/// Its manager cannot raise its claim, which cannot be stored, and shows whom the vehicle is under.
#[test]
fn a_vehicle_under_another_manager_is_shown_with_its_claim_and_address() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let [board, first, second] = ["board", "first", "second"].map(|name| folder.path().join(name));
    let agv = vehicle(fleet, &board);
    let claim = {
        // The second life's claim is above that of a manager that starts for the first time.
        let _ = manager(fleet, &first, false).start();
        let manager = manager(fleet, &first, false);
        manager.start().unwrap();
        move_it(&manager);
        manager.claim()
    };
    let manager = manager(fleet, &second, false);
    manager.start().unwrap();
    std::fs::remove_dir_all(&second).unwrap();
    std::fs::write(&second, "").unwrap();
    assert!(manager.claim() < claim);
    let identity = agv.identity().clone();
    let under = || manager.roster().iter().find(|peer| *peer.identity() == identity).and_then(|peer| peer.under());
    until("it is under another one", || under().is_some());
    let (shown, address) = under().unwrap();
    assert_eq!((shown, address.ip().is_loopback()), (claim, true));
    assert_eq!(manager.number_of_s_units(), 0);
}

/// It cannot say whether it was stopped, so it starts stopped. Once it is reset, it obeys the claim until its next start, and says
/// so.
#[test]
fn a_vehicle_that_cannot_store_moves_all_the_same() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    let manager = manager(fleet, &folder.path().join("kept"), false);
    manager.start().unwrap();
    let (agv, drive) = vehicle_with_drive(fleet, &file.join("state"));
    let events = agv.events();
    let stopped = Err(Error::Inhibited { by: 0, reason: 0 });
    let go = || manager.peer("agv").and_then(|agv| agv.block_request("go", &mut Parameters::new()));
    until("it is stopped", || go() == stopped);
    drive.reset();
    move_it(&manager);
    let not_kept = |event: UnitEvent| matches!(event, UnitEvent::ClaimNotKept { .. });
    assert!(std::iter::from_fn(|| events.recv_timeout(PATIENCE).ok()).any(not_kept));
}

#[test]
fn a_manager_that_cannot_store_its_claim_does_not_start() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let file = folder.path().join("file");
    std::fs::write(&file, "").unwrap();
    let manager = manager(fleet, &file.join("state"), false);
    let error = manager.start().unwrap_err();
    assert!(matches!(error, StartError::Claim(_)) && error.to_string().contains("CARA_STATE"), "{error}");
}

/// What a vehicle tells a manager that joins of the order before: under which claim, by which call, and how it ended.
#[test]
fn a_vehicle_that_joins_tells_claim_and_trace_id_of_its_last_order() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let [here, board] = ["here", "board"].map(|name| folder.path().join(name));
    let first = manager(fleet, &here, false);
    first.start().unwrap();
    let agv = vehicle(fleet, &board);
    move_it(&first);
    let kept = first.peer("agv").unwrap().trace_of("go").unwrap();
    let claim = first.claim();
    first.stop();

    let second = manager(fleet, &here, false);
    second.start().unwrap();
    assert!(second.claim() > claim);
    let reported = || second.peer("agv").ok()?.actuator_state("go")?.last;
    until("it tells", || reported().is_some_and(|last| last.end.is_some()));
    let last = reported().unwrap();
    assert_eq!((last.claim, last.trace(), last.end), (claim, kept, Some(LeaseEnd::Expired)));
    move_it(&second);
    until("it tells of the next", || reported().is_some_and(|last| last.claim == second.claim()));
    assert_eq!(reported().map(|last| last.trace()), second.peer("agv").unwrap().trace_of("go"));
    assert_ne!(reported().unwrap().trace(), kept);
    drop(agv);
}

/// A handler of the earlier manager hangs. What the next one moves begins once the order of that call is dead and its hook has run,
/// and the handler changes nothing any more.
#[test]
fn a_handler_that_hangs_is_cut_off_before_the_next_manager_moves_anything() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let [here, there] = ["here", "there"].map(|name| folder.path().join(name));
    let agv = unit("agv", 7, fleet).build().unwrap();
    let log = Arc::new(Mutex::new(Vec::new()));
    let note = |what: &'static str| {
        let log = log.clone();
        move || log.lock().unwrap().push(what)
    };
    let options = ServiceOptions::new().lease(std::time::Duration::from_secs(30), note("hook"));
    let (continues, may_go_on) = channel::<()>();
    let (first_runs, next_runs, late, refused) =
        (note("first runs"), note("next runs"), note("a late commit"), note("no late commit"));
    let (runs, may_go_on) = (AtomicUsize::new(0), Mutex::new(may_go_on));
    let go = move |call: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
        if runs.fetch_add(1, Ordering::Relaxed) > 0 {
            return Ok(call.commit(&next_runs)?);
        }
        first_runs();
        may_go_on.lock().unwrap().recv().unwrap();
        call.commit(&late).inspect_err(|_| refused())?;
        Ok(())
    };
    agv.my_function_list().add_service(&Definition::parse("go()").unwrap(), options, go).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    let first = manager(fleet, &here, false);
    first.start().unwrap();
    until("it is told of the function", || first.peer("agv").is_ok_and(|agv| agv.their_function_list().contains("go")));
    first.peer("agv").unwrap().call("go", &mut Parameters::new()).renewing(Renew::Process).send().unwrap();
    until("its handler runs", || log.lock().unwrap().len() == 1);

    let second = manager(fleet, &there, true);
    second.start().unwrap();
    move_it(&second);
    assert_eq!(*log.lock().unwrap(), ["first runs", "hook", "next runs"]);
    continues.send(()).unwrap();
    until("the handler ends", || log.lock().unwrap().len() == 4);
    assert_eq!(log.lock().unwrap()[3], "no late commit");
}

/// Without a folder of state nothing but the clock ranks a manager's starts.
#[test]
fn a_manager_without_a_folder_claims_above_its_start_of_the_same_second() {
    let fleet = fleet();
    let claims = (0..12).map(|_| {
        let manager = system(fleet).control(Control::Off).beside_another().build().unwrap();
        manager.start().unwrap();
        // No process starts twice within a millisecond.
        std::thread::sleep(std::time::Duration::from_millis(1));
        manager.claim()
    });
    let claims: Vec<_> = claims.collect();
    assert!(claims.is_sorted_by(|one, next| one < next), "{claims:?}");
}
