//! A vehicle is handed over from its manager to another one, over loopback.

mod keyed;

use std::hash::{BuildHasher, Hasher, RandomState};
use std::path::Path;
use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use cara_std::control::Control;
use cara_std::{
    CommunicationSystem, Definition, HandOverError, HandOverRefusal, HandOverStage, Identity, Interfaces, Manager,
    Parameters, ParametersView, Served, ServiceError, ServiceOptions, Unit, UnitEvent,
};
use keyed::keyed;

const PATIENCE: Duration = Duration::from_secs(20);

fn until(what: &str, condition: impl Fn() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < end, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn fleet() -> u32 {
    RandomState::new().build_hasher().finish() as u32
}

fn nodes() -> [Identity; 3] {
    [Identity::m_unit("depot", 1).unwrap(), Identity::m_unit("yard", 2).unwrap(), Identity::s_unit("agv", 7).unwrap()]
}

fn yard() -> Manager {
    Manager::new("yard", 2).unwrap()
}

/// One of the two managers; no socket beside the network tells of it.
fn manager(fleet: u32, which: usize) -> CommunicationSystem {
    let own = &nodes()[which];
    let builder = CommunicationSystem::builder(own.name(), own.id()).unwrap().interfaces(Interfaces::Loopback);
    let manager = keyed(builder.control(Control::Off), fleet, own, &nodes()).build().unwrap();
    manager.start().unwrap();
    manager
}

/// The depot's vehicle, whose `go()` moves it.
fn vehicle(fleet: u32, board: &Path) -> Unit {
    let builder = Unit::builder("agv", 7, "depot", 1).unwrap().interfaces(Interfaces::Loopback).state_folder(board);
    let agv = keyed(builder, fleet, &nodes()[2], &nodes()).build().unwrap();
    let drive = agv.my_function_list().actuator(|| ()).unwrap();
    let go = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    let options = ServiceOptions::new().moves(&drive, Duration::from_secs(1));
    agv.my_function_list().add_service(&Definition::parse("go()").unwrap(), options, go).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    agv
}

fn moves(manager: &CommunicationSystem) -> bool {
    manager.peer("agv").is_ok_and(|agv| agv.block_request("go", &mut Parameters::new()).is_ok())
}

/// What is reported next of a hand-over.
fn reported(events: &Receiver<UnitEvent>) -> (Identity, HandOverStage) {
    loop {
        if let UnitEvent::HandOver { peer, stage } = events.recv_timeout(PATIENCE).unwrap() {
            return (peer, stage);
        }
    }
}

#[test]
fn a_vehicle_goes_over_at_standstill_and_belongs_there_after_a_restart() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let (depot, yard_system) = (manager(fleet, 0), manager(fleet, 1));
    let agv = vehicle(fleet, folder.path());
    until("it moves", || moves(&depot));
    let (depots, agvs) = (depot.events(), agv.events());
    let peer = depot.peer("agv").unwrap();
    let refused = |refusal| Err(HandOverError::Refused(refusal));
    assert_eq!(peer.hand_over(&yard(), PATIENCE), refused(HandOverRefusal::Moves));
    peer.release("go").unwrap();
    let stranger = Manager::new("stranger", 3).unwrap();
    until("it has no key for a stranger", || peer.hand_over(&stranger, PATIENCE) == refused(HandOverRefusal::NoKey));
    assert_eq!(peer.hand_over(&yard(), PATIENCE), Ok(()));
    until("it has joined there", || yard_system.number_of_s_units() == 1);
    assert!(!peer.is_connected());
    until("it moves there", || moves(&yard_system));
    let [_, yard, seven] = nodes();
    assert_eq!(reported(&depots), (seven, HandOverStage::Leaves));
    assert_eq!(reported(&agvs), (yard.clone(), HandOverStage::Leaves));
    assert_eq!(reported(&agvs), (yard, HandOverStage::Moved));
    drop(agv);
    let _agv = vehicle(fleet, folder.path());
    until("it is there again", || moves(&yard_system));
    assert_eq!(depot.number_of_s_units(), 0);
}

/// By command, since it waits for the ten seconds of `HAND_OVER_TIMEOUT`.
#[test]
#[ignore = "takes ten seconds"]
fn a_vehicle_whose_new_manager_is_not_there_goes_back() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let depot = manager(fleet, 0);
    let _agv = vehicle(fleet, folder.path());
    until("it joins", || depot.number_of_s_units() == 1);
    let left = Instant::now();
    assert_eq!(depot.peer("agv").unwrap().hand_over(&yard(), PATIENCE), Ok(()));
    until("it has left", || depot.number_of_s_units() == 0);
    until("it is back", || moves(&depot));
    println!("back after {:?}", left.elapsed());
}
