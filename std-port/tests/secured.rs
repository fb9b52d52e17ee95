//! Units with keys, over real sockets on loopback: only a peer with the pair's key gets in.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use cara_std::keys::{FleetKeys, Store, location};
use cara_std::{
    BuildError, Builder, CloseReason, CommunicationSystem, Constraints, Definition, Fleet, Identity, Interfaces, MUnit,
    Parameters, ParametersView, Refusal, SUnit, Served, ServiceError, ServiceOptions, StartError, Unit, UnitEvent,
};

const PATIENCE: Duration = Duration::from_secs(20);
/// Long enough for a vehicle to search, to be answered and to dial several times.
const LONG_ENOUGH: Duration = Duration::from_secs(3);

fn until(what: &str, condition: impl Fn() -> bool) {
    let end = Instant::now() + PATIENCE;
    while !condition() {
        assert!(Instant::now() < end, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn fleet() -> Fleet {
    Fleet(RandomState::new().build_hasher().finish() as u32)
}

fn depot() -> Identity {
    Identity::m_unit("depot", 1).unwrap()
}

fn agv(id: u32) -> Identity {
    Identity::s_unit("agv", id).unwrap()
}

/// The keys of a depot and its vehicles.
fn keys(fleet: Fleet, vehicles: &[u32]) -> FleetKeys {
    let mut keys = FleetKeys::draw(fleet).unwrap();
    keys.add(&depot(), &[]).unwrap();
    vehicles.iter().for_each(|id| keys.add(&agv(*id), &[]).unwrap());
    keys
}

/// Without a control socket, which would tell of it beside the network.
fn manager(fleet: Fleet) -> Builder<(), MUnit> {
    let builder = CommunicationSystem::builder("depot", 1).unwrap().fleet(fleet.0);
    // A call ends after longer than a thread waits for its turn on a busy machine.
    let constraints = Constraints { request_timeout: PATIENCE.into(), ..Constraints::M_UNIT };
    builder.interfaces(Interfaces::Loopback).control(cara_std::control::Control::Off).constraints(constraints)
}

fn vehicle(fleet: Fleet, id: u32) -> Builder<(), SUnit> {
    Unit::builder("agv", id, "depot", 1).unwrap().fleet(fleet.0).interfaces(Interfaces::Loopback)
}

fn started_manager(builder: Builder<(), MUnit>) -> CommunicationSystem {
    let manager = builder.build().unwrap();
    manager.start().unwrap();
    manager
}

/// A vehicle that doubles a number and sends a text back.
fn started_vehicle(builder: Builder<(), SUnit>) -> Unit {
    serving(builder.build().unwrap())
}

fn serving(agv: Unit) -> Unit {
    let double = |_: &Served, view: &mut ParametersView| -> Result<(), ServiceError> {
        let number: i64 = view.variable("number").map_err(|_| ServiceError::BadResults)?;
        view.set_value("number", 2 * number).map_err(|_| ServiceError::BadResults)
    };
    agv.my_function_list().add_function("double", &number(0), double).unwrap();
    let echo = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
    agv.my_function_list().add_function("echo", &text(""), echo).unwrap();
    agv.publish_my_function_list().unwrap();
    agv.start().unwrap();
    agv
}

fn number(value: i64) -> Parameters {
    let mut number = Parameters::new();
    number.add_int("number", 1).unwrap();
    number.set_value("number", value).unwrap();
    number
}

fn text(value: &str) -> Parameters<40_000> {
    let mut text = Parameters::<40_000>::sized();
    text.add_string("text", 20_000).unwrap();
    text.set_value("text", value).unwrap();
    text
}

fn joined(manager: &CommunicationSystem, count: usize) {
    until("the vehicles have joined", || manager.number_of_s_units() == count);
    for peer in manager.s_units() {
        assert!(peer.wait_for_function("echo", PATIENCE));
    }
}

fn stays_out(manager: &CommunicationSystem) {
    std::thread::sleep(LONG_ENOUGH);
    assert_eq!(manager.number_of_s_units(), 0);
}

#[test]
fn units_with_the_pair_s_key_meet_and_call_each_other() {
    let fleet = fleet();
    let keys = keys(fleet, &[7]);
    let manager = started_manager(manager(fleet).keys(keys.ring(&depot()).unwrap()));
    let agv = started_vehicle(vehicle(fleet, 7).keys(keys.ring(&agv(7)).unwrap()));
    joined(&manager, 1);
    let peer = manager.s_units().remove(0);
    for value in 0..100 {
        let mut parameters = number(value);
        peer.block_request("double", &mut parameters).unwrap();
        assert_eq!(parameters.variable::<i64>("number"), Ok(2 * value));
    }
    let long = "x".repeat(20_000);
    let mut parameters = text(&long);
    peer.block_request("echo", &mut parameters).unwrap();
    assert_eq!(parameters.variable::<&str>("text"), Ok(&*long));
    // Keep-alives are sealed as well: the link outlives the time in which silence would end it.
    std::thread::sleep(Duration::from_secs(4));
    assert!(peer.is_connected() && agv.is_connected());
}

/// The link is rekeyed about once a second, while several threads call and a message of many frames is in flight.
#[test]
fn calls_go_on_while_the_keys_of_their_link_are_made_anew() {
    let fleet = fleet();
    let keys = keys(fleet, &[7]);
    let manager = started_manager(manager(fleet).keys(keys.ring(&depot()).unwrap()));
    let agv = vehicle(fleet, 7).keys(keys.ring(&agv(7)).unwrap()).build().unwrap();
    agv.renew_keys_every(cara_std::Duration::from_secs(1));
    let agv = serving(agv);
    joined(&manager, 1);
    let peer = manager.s_units().remove(0);
    let renewed = || peer.counters().iter().find(|(name, _)| *name == "KeysRenewed").map_or(0, |(_, count)| *count);
    let over = AtomicBool::new(false);
    let long = "x".repeat(20_000);
    std::thread::scope(|scope| {
        for first in [0, 1_000_000] {
            let (peer, over) = (&peer, &over);
            scope.spawn(move || {
                let calls = (first..).take_while(|_| !over.load(Ordering::Relaxed));
                for value in calls {
                    let mut parameters = number(value);
                    peer.block_request("double", &mut parameters).unwrap();
                    assert_eq!(parameters.variable::<i64>("number"), Ok(2 * value));
                }
            });
        }
        let end = Instant::now() + PATIENCE;
        while renewed() < 4 && Instant::now() < end {
            let mut parameters = text(&long);
            peer.block_request("echo", &mut parameters).unwrap();
            assert_eq!(parameters.variable::<&str>("text"), Ok(&*long));
        }
        over.store(true, Ordering::Relaxed);
    });
    assert!(renewed() >= 4, "{} renewals", renewed());
    assert!(peer.is_connected() && agv.is_connected());
}

/// A live manager shows that it is one with the key that its identity alone has, or with the fleet's where its file has
/// none; keys of another fleet show nothing.
#[test]
fn a_manager_starts_once_and_again_when_the_first_has_stopped() {
    let (fleet, other) = (fleet(), fleet());
    let root = keys(fleet, &[7]);
    let first = started_manager(manager(fleet).keys(root.ring(&depot()).unwrap()));
    let second = manager(fleet).keys(root.ring(&depot()).unwrap()).build().unwrap();
    let running = second.start();
    assert!(
        matches!(running, Err(StartError::AlreadyRunning { at, .. }) if at.port() == first.tcp_port()),
        "{running:?}"
    );
    started_manager(manager(fleet).keys(keys(fleet, &[7]).ring(&depot()).unwrap())).stop();
    started_manager(manager(other).keys(keys(other, &[]).ring(&depot()).unwrap())).stop();
    started_manager(manager(fleet).keys(root.ring(&depot()).unwrap()).beside_another()).stop();
    first.stop();
    second.start().unwrap();
}

#[test]
fn of_two_managers_that_start_at_once_one_stays() {
    let fleet = fleet();
    let root = keys(fleet, &[7]);
    let managers: Vec<_> = (0..2).map(|_| manager(fleet).keys(root.ring(&depot()).unwrap()).build().unwrap()).collect();
    let begin = std::sync::Barrier::new(2);
    let started: Vec<_> = std::thread::scope(|scope| {
        let threads: Vec<_> = managers
            .iter()
            .map(|manager| {
                scope.spawn(|| {
                    begin.wait();
                    manager.start().is_ok()
                })
            })
            .collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    });
    assert_eq!(started.iter().filter(|started| **started).count(), 1);
}

#[test]
fn a_vehicle_of_another_root_stays_out() {
    let fleet = fleet();
    let manager = started_manager(manager(fleet).keys(keys(fleet, &[7]).ring(&depot()).unwrap()));
    let _foreign = started_vehicle(vehicle(fleet, 7).keys(keys(fleet, &[7]).ring(&agv(7)).unwrap()));
    stays_out(&manager);
}

#[test]
fn plain_and_secured_units_do_not_meet_even_on_one_port() {
    let fleet = fleet();
    let keys = keys(fleet, &[7, 8]);
    fn on<R>(port: Option<u16>, builder: Builder<(), R>) -> Builder<(), R> {
        port.into_iter().fold(builder, Builder::discovery_port)
    }
    for port in [None, Some(cara_processes::discovery_port())] {
        let secured = started_manager(on(port, manager(fleet).keys(keys.ring(&depot()).unwrap())));
        let plain = started_vehicle(on(port, vehicle(fleet, 7).insecure()));
        stays_out(&secured);
        secured.stop();
        plain.stop();
        let plain = started_manager(on(port, manager(fleet).insecure()));
        let _secured = started_vehicle(on(port, vehicle(fleet, 8).keys(keys.ring(&agv(8)).unwrap())));
        stays_out(&plain);
    }
}

/// Adding a vehicle restarts nothing, and a revoked one is disconnected.
#[test]
fn a_running_manager_follows_its_key_file() {
    let fleet = fleet();
    let folder = tempfile::tempdir().unwrap();
    let mut store = Store::create(folder.path(), keys(fleet, &[7])).unwrap();
    store.save().unwrap();
    let file = |node: &Identity| folder.path().join(location::file_name(node, fleet));
    let manager = started_manager(manager(fleet).key_file(file(&depot())));
    let events = manager.events();
    let start = |id| started_vehicle(vehicle(fleet, id).key_file(file(&agv(id))));
    let _first = start(7);
    joined(&manager, 1);

    store.keys_mut().add(&agv(8), &[]).unwrap();
    store.save().unwrap();
    let _second = start(8);
    joined(&manager, 2);

    store.keys_mut().revoke(&[agv(7)]).unwrap();
    store.save().unwrap();
    until("the revoked one is gone", || manager.number_of_s_units() == 1);
    assert!(manager.s_units().iter().all(|peer| peer.is_connected() == (peer.identity() == &agv(8))));
    let left = UnitEvent::Left { peer: agv(7), reason: CloseReason::Refused(Refusal::NoKey) };
    assert!(events.try_iter().any(|event| event == left));
}

/// The dial of a vehicle with other keys makes the manager look at its file between two looks: what was revoked is found then as well.
#[test]
fn an_unknown_vehicle_that_dials_saves_no_revoked_one() {
    let fleet = fleet();
    let folder = tempfile::tempdir().unwrap();
    let mut store = Store::create(folder.path(), keys(fleet, &[7, 8])).unwrap();
    store.save().unwrap();
    let manager = started_manager(manager(fleet).key_file(store.file_of(&depot())));
    let start = |id| started_vehicle(vehicle(fleet, id).key_file(store.file_of(&agv(id))));
    let (first, _second) = (start(7), start(8));
    joined(&manager, 2);
    until("it knows its manager", || first.manager().is_some_and(|manager| manager.address().is_some()));
    let address = first.manager().unwrap().address().unwrap();
    let of_others = keys(fleet, &[99]).ring(&agv(99)).unwrap();
    let unknown = vehicle(fleet, 99).keys(of_others).manager_address(address).build().unwrap();

    store.keys_mut().revoke(&[agv(7)]).unwrap();
    store.save().unwrap();
    unknown.start().unwrap();
    until("the revoked one is gone", || manager.number_of_s_units() == 1);
    assert!(manager.s_units().iter().all(|peer| peer.is_connected() == (peer.identity() == &agv(8))));
}

/// Whatever is stored with the old key is worth nothing once that has gone, so it is stored anew with the new one.
#[test]
fn a_claim_that_is_obeyed_outlives_a_change_of_keys() {
    let (fleet, folder) = (fleet(), tempfile::tempdir().unwrap());
    let mut store = Store::create(&folder.path().join("keys"), keys(fleet, &[7])).unwrap();
    store.save().unwrap();
    let [office, board] = ["office", "board"].map(|name| folder.path().join(name));
    let manager = started_manager(manager(fleet).key_file(store.file_of(&depot())).state_folder(&office));
    let start = |store: &Store| {
        let agv = vehicle(fleet, 7).key_file(store.file_of(&agv(7))).state_folder(&board).build().unwrap();
        agv.renew_keys_every(cara_std::Duration::from_secs(1));
        let drive = agv.my_function_list().actuator(|| ()).unwrap();
        let go = |_: &Served, _: &mut ParametersView| -> Result<(), ServiceError> { Ok(()) };
        let options = ServiceOptions::new().moves(&drive, Duration::from_secs(1));
        agv.my_function_list().add_service(&Definition::parse("go()").unwrap(), options, go).unwrap();
        serving(agv)
    };
    let first = start(&store);
    let moves = || manager.peer("agv").is_ok_and(|agv| agv.block_request("go", &mut Parameters::new()).is_ok());
    until("it moves", moves);
    let claim = manager.claim();
    let kept_with = |store: &Store| {
        let key = store.keys().ring(&agv(7)).unwrap().pair(&depot()).unwrap().fingerprint();
        let key: String = key.iter().map(|byte| format!("{byte:02x}")).collect();
        let files = std::fs::read_dir(&board).unwrap().map(|file| file.unwrap().path());
        let claims = files.filter(|path| path.extension().is_some_and(|extension| extension == "claims"));
        claims.map(|path| std::fs::read_to_string(path).unwrap()).collect::<String>().contains(&key)
    };
    assert!(kept_with(&store));
    for step in [FleetKeys::rotate, FleetKeys::switch] {
        step(store.keys_mut()).unwrap();
        store.save().unwrap();
    }
    assert!(!kept_with(&store), "the key is another one");
    until("it is stored with the new key", || kept_with(&store));
    store.keys_mut().finish().unwrap();
    store.save().unwrap();
    drop(first);
    assert_eq!(start(&store).claim(), claim, "it counts after the next start");
}

#[test]
fn without_keys_the_error_says_which_command_makes_them() {
    let missing = Path::new("/nonexistent/depot.keys");
    let error = manager(fleet()).key_file(missing).build().map(drop).unwrap_err();
    assert!(matches!(error, BuildError::Keys(_)), "{error}");
}
