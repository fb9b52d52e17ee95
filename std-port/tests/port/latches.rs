//! A stop lasts until a reset, through every change of a unit's services and through its restart.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Barrier};

use cara_std::{
    CommunicationSystem, Definition, Error, Parameters, ParametersView, Peer, Priority, Renew, Served, ServiceError,
    ServiceOptions, Unit,
};

use crate::support::{PATIENCE, fleet, meet, system, unit, until};

/// So long that nothing here ends by time.
const LEASE: cara_std::Duration = cara_std::Duration::from_secs(600);

fn nothing(_: &Served, _: &mut ParametersView) -> Result<(), ServiceError> {
    Ok(())
}

fn define(text: &str) -> Definition {
    Definition::parse(text).unwrap()
}

fn moves() -> ServiceOptions<()> {
    ServiceOptions::new().lease(LEASE, || {})
}

/// A vehicle whose `go()` moves; `halt()` stops all and `free()` resets all.
fn offer(agv: &Unit) {
    let functions = agv.my_function_list();
    functions.add_service(&define("go()"), moves(), nothing).unwrap();
    let stops = ServiceOptions::new().stops_all().priority(Priority::Emergency);
    functions.add_service(&define("halt()"), stops, nothing).unwrap();
    functions.add_service(&define("free()"), ServiceOptions::new().resets_all(), nothing).unwrap();
}

fn joined(manager: &CommunicationSystem, agv: &Unit) -> Peer<()> {
    offer(agv);
    let (peer, _) = meet(manager, agv);
    assert!(peer.wait_for_function("free", PATIENCE));
    peer
}

fn ask(peer: &Peer<()>, function: &str) -> Result<(), Error> {
    // A stop and a reset of the same moment are told apart by 3 ms.
    std::thread::sleep(std::time::Duration::from_millis(5));
    peer.call(function, &mut Parameters::new()).renewing(Renew::Process).wait().map_err(Error::from)
}

#[test]
fn what_is_replaced_and_what_is_added_stays_stopped() {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).build().unwrap());
    let peer = joined(&manager, &agv);
    let stopped = Err(Error::Inhibited { by: 1, reason: 0 });
    assert_eq!((ask(&peer, "go"), ask(&peer, "halt")), (Ok(()), Ok(())));
    let functions = agv.my_function_list();
    functions.replace(&define("go()"), moves(), nothing).unwrap();
    functions.add_service(&define("lift()"), moves(), nothing).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(peer.wait_for_function("lift", PATIENCE));
    until("the new one is known", || ask(&peer, "go") != Err(Error::StaleFunction));
    assert_eq!((ask(&peer, "go"), ask(&peer, "lift")), (stopped, stopped));
    functions.remove("lift").unwrap();
    functions.add_service(&define("tilt()"), moves(), nothing).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(peer.wait_for_function("tilt", PATIENCE));
    assert_eq!(ask(&peer, "tilt"), stopped);
    assert_eq!((ask(&peer, "free"), ask(&peer, "go"), ask(&peer, "tilt")), (Ok(()), Ok(()), Ok(())));
}

/// Whether the folder says that a unit is stopped.
fn is_kept(folder: &Path) -> bool {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter(|entry| entry.path().extension().is_some_and(|extension| extension == "stopped")).count() > 0
}

#[test]
fn a_vehicle_with_a_folder_of_state_starts_stopped_if_it_was() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let manager = system(fleet).build().unwrap();
    let life = || unit("agv", 7, fleet).state_folder(folder.path()).build().unwrap();
    let first = life();
    let peer = joined(&manager, &first);
    assert_eq!((ask(&peer, "go"), ask(&peer, "halt")), (Ok(()), Ok(())));
    until("it is kept", || is_kept(folder.path()));
    drop(first);
    let second = life();
    offer(&second);
    second.publish_my_function_list().unwrap();
    second.start().unwrap();
    assert!(peer.wait_for_function("free", PATIENCE));
    until("it is stopped as before", || ask(&peer, "go") == Err(Error::Inhibited { by: 1, reason: 0 }));
    assert!(is_kept(folder.path()));
    assert_eq!((ask(&peer, "free"), ask(&peer, "go")), (Ok(()), Ok(())));
    until("its end is kept", || !is_kept(folder.path()));
    drop(second);
    let third = life();
    offer(&third);
    third.publish_my_function_list().unwrap();
    third.start().unwrap();
    until("it goes on", || ask(&peer, "go") == Ok(()));
}

#[test]
fn a_stop_is_kept_though_only_the_reset_of_what_was_stopped_is_left() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let agv = unit("agv", 7, fleet).state_folder(folder.path()).build().unwrap();
    let functions = agv.my_function_list();
    let drive = functions.actuator(|| {}).unwrap();
    functions.add_service(&define("go()"), ServiceOptions::new().moves(&drive, LEASE), nothing).unwrap();
    functions.add_service(&define("free_drive()"), ServiceOptions::new().resets(&drive), nothing).unwrap();
    drive.inhibit(3);
    until("it is kept", || is_kept(folder.path()));
    functions.remove("go").unwrap();
    // Longer than the time after which what is kept is looked at again.
    std::thread::sleep(std::time::Duration::from_millis(1_300));
    assert!(is_kept(folder.path()));
    drive.reset();
    until("its end is kept", || !is_kept(folder.path()));
}

#[test]
fn a_vehicle_without_one_starts_stopped_if_its_program_says_so_and_its_program_resets_it() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let agv = unit("agv", 7, fleet).starts_stopped(3).build().unwrap();
    let drive = agv.my_function_list().actuator(|| {}).unwrap();
    let move_it = || ServiceOptions::new().moves(&drive, LEASE);
    agv.my_function_list().add_service(&define("go()"), move_it(), nothing).unwrap();
    let (peer, _) = meet(&manager, &agv);
    assert!(peer.wait_for_function("go", PATIENCE));
    assert_eq!(ask(&peer, "go"), Err(Error::Inhibited { by: 0, reason: 3 }));
    drive.reset();
    assert_eq!(ask(&peer, "go"), Ok(()));
    agv.my_function_list().add_service(&define("lift()"), moves(), nothing).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(peer.wait_for_function("lift", PATIENCE));
    assert_eq!(ask(&peer, "lift"), Ok(()), "all that was stopped has been reset");
}

/// The stop waits for the first actuator's lock, behind which all are dead.
#[test]
fn a_stop_of_all_reaches_all_behind_a_handler_that_hangs_in_a_commit() {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).build().unwrap());
    let (is_inside, continues) = (Arc::new(AtomicBool::new(false)), Arc::new(Barrier::new(2)));
    let hangs = {
        let (is_inside, continues) = (is_inside.clone(), continues.clone());
        move |call: &Served, _: &mut ParametersView| -> Result<(), ServiceError> {
            let wait = || {
                is_inside.store(true, Ordering::SeqCst);
                continues.wait();
            };
            Ok(call.commit(wait).map(drop)?)
        }
    };
    let functions = agv.my_function_list();
    let drive = functions.add_service(&define("drive()"), moves(), hangs).unwrap();
    let lift = functions.add_service(&define("lift()"), moves(), nothing).unwrap();
    let peer = joined(&manager, &agv);
    assert_eq!(ask(&peer, "lift"), Ok(()));
    peer.call("drive", &mut Parameters::new()).renewing(Renew::Process).send().unwrap();
    until("it hangs", || is_inside.load(Ordering::SeqCst));
    assert!(drive.is_live() && lift.is_live());
    peer.request("halt", &Parameters::new()).unwrap();
    until("both are dead", || !drive.is_live() && !lift.is_live());
    continues.wait();
    until("it is stopped for its caller", || ask(&peer, "lift") == Err(Error::Inhibited { by: 1, reason: 0 }));
}

/// Two services move one thing: the end of the one that has started nothing ends no order of the other.
#[test]
fn a_service_that_goes_ends_its_own_order_only() {
    let fleet = fleet();
    let (manager, agv) = (system(fleet).build().unwrap(), unit("agv", 7, fleet).build().unwrap());
    let functions = agv.my_function_list();
    let stops = Arc::new(AtomicUsize::new(0));
    let counted = stops.clone();
    let drive = functions
        .actuator(move || {
            counted.fetch_add(1, Ordering::SeqCst);
        })
        .unwrap();
    let moves = || ServiceOptions::new().moves(&drive, LEASE);
    for name in ["creep()", "go()"] {
        functions.add_service(&define(name), moves(), nothing).unwrap();
    }
    let (peer, _) = meet(&manager, &agv);
    assert!(peer.wait_for_function("go", PATIENCE));
    ask(&peer, "go").unwrap();
    functions.replace(&define("creep()"), moves(), nothing).unwrap();
    functions.remove("creep").unwrap();
    std::thread::sleep(std::time::Duration::from_millis(50));
    assert!(drive.watch().is_live() && stops.load(Ordering::SeqCst) == 0);
    functions.remove("go").unwrap();
    until("it is safe", || stops.load(Ordering::SeqCst) == 1);
    assert!(!drive.watch().is_live());
}
