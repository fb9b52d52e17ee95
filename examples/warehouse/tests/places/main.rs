//! Shared places: the record alone, in every order of calls, losses and restarts, and real units of two managers.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use cara_processes::{Process, random_fleet};
use cara_std::{CommunicationSystem, Error, Identity, Interfaces, Manager, Peer, ServiceError, Unit};
use cara_test_keys::KeyFolder;
use cara_warehouse::places::{Occupant, OpenError, Pass, Places, Record, SharedClient, SharedPlace, refusal};
use proptest::prelude::*;

const VEHICLES: usize = 2;
const MANAGERS: usize = 2;
const GATE: &str = "gate";

fn vehicle(number: usize) -> Identity {
    Identity::s_unit("agv", number as u32).unwrap()
}

/// What can happen. Calls stay in flight, so that they also arrive late, twice, or never.
#[derive(Clone, Debug)]
enum Step {
    /// A vehicle's manager asks for a pass.
    Ask(usize),
    /// A call arrives at the unit of the places, which writes its record and answers, or dies at one of these points.
    Arrive(usize, Death),
    /// An answer arrives at the manager that asked, if it still waits for it.
    Answer(usize),
    /// A vehicle drives in, if its manager has a pass.
    Enter(usize),
    /// It drives out.
    Leave(usize),
    /// Its manager sees it outside and gives the pass back; it may say so again.
    Left(usize),
    /// The manager dies and starts again, with nothing.
    Restart(usize),
    /// The vehicle has another manager.
    HandOver(usize),
    /// A manager loses the unit of the places or the vehicle, and so the lease of a pass.
    Lose(usize),
    /// An operator looks whether the occupant is inside, where no lease is live.
    Look,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Death {
    None,
    BeforeWriting,
    BeforeAnswering,
}

#[derive(Clone, Copy, Debug)]
enum Call {
    Enter { vehicle: usize, number: u32 },
    Left { vehicle: usize, pass: i64 },
}

#[derive(Clone, Copy, Debug, Default)]
struct Vehicle {
    inside: bool,
    manager: usize,
    /// What its manager has.
    pass: Option<i64>,
    /// That pass has a live lease: without one the vehicle is let in no more.
    is_live: bool,
    /// What its manager has given back, and may give back again.
    gone: Option<i64>,
    /// The call that its manager waits for.
    waits: Option<u32>,
}

struct World {
    /// As on disk.
    kept: Record,
    vehicles: [Vehicle; VEHICLES],
    calls: Vec<Call>,
    answers: Vec<(usize, u32, i64)>,
    asked: u32,
}

impl World {
    fn new() -> Self {
        let mut record = Record::default();
        record.add(GATE);
        record.release(GATE, &Occupant::Unknown).unwrap();
        let vehicles = std::array::from_fn(|number| Vehicle { manager: number % MANAGERS, ..Vehicle::default() });
        Self { kept: record, vehicles, calls: Vec::new(), answers: Vec::new(), asked: 0 }
    }

    fn occupant(&self) -> Occupant {
        self.kept.occupant(GATE).unwrap().clone()
    }

    fn step(&mut self, step: &Step) {
        match *step {
            Step::Ask(number) => {
                self.asked += 1;
                // Whatever it had does not count from here on.
                let vehicle = &mut self.vehicles[number];
                *vehicle = Vehicle {
                    inside: vehicle.inside,
                    manager: vehicle.manager,
                    waits: Some(self.asked),
                    ..Vehicle::default()
                };
                self.calls.push(Call::Enter { vehicle: number, number: self.asked });
            }
            Step::Arrive(which, death) => {
                if let Some(call) = recent(&self.calls, which) {
                    self.arrive(call, death);
                }
            }
            Step::Answer(which) => {
                let Some((number, call, pass)) = recent(&self.answers, which) else { return };
                let vehicle = &mut self.vehicles[number];
                if vehicle.waits == Some(call) {
                    (vehicle.pass, vehicle.is_live, vehicle.waits) = (Some(pass), true, None);
                }
            }
            Step::Enter(number) => {
                let vehicle = &mut self.vehicles[number];
                vehicle.inside |= vehicle.pass.is_some() && vehicle.is_live;
            }
            Step::Leave(number) => self.vehicles[number].inside = false,
            Step::Left(number) => {
                let vehicle = &mut self.vehicles[number];
                if !vehicle.inside {
                    vehicle.gone = vehicle.pass.take().or(vehicle.gone);
                    vehicle.is_live = false;
                    self.calls.extend(vehicle.gone.map(|pass| Call::Left { vehicle: number, pass }));
                }
            }
            Step::Restart(manager) => {
                for vehicle in self.vehicles.iter_mut().filter(|vehicle| vehicle.manager == manager) {
                    *vehicle = Vehicle { inside: vehicle.inside, manager, ..Vehicle::default() };
                }
            }
            Step::HandOver(number) => {
                let vehicle = &mut self.vehicles[number];
                let manager = (vehicle.manager + 1) % MANAGERS;
                *vehicle = Vehicle { inside: vehicle.inside, manager, ..Vehicle::default() };
            }
            Step::Lose(number) => self.vehicles[number].is_live = false,
            Step::Look => {
                let occupant = self.occupant();
                let is = |number: &usize| occupant == Occupant::Vehicle(vehicle(*number));
                let blocks = (0..VEHICLES).find(is).map(|number| self.vehicles[number]);
                if blocks.is_some_and(|blocks| !blocks.inside && !blocks.is_live && blocks.waits.is_none()) {
                    self.kept.release(GATE, &occupant).unwrap();
                }
            }
        }
    }

    fn arrive(&mut self, call: Call, death: Death) {
        let before = self.occupant();
        let mut record = self.kept.clone();
        let granted = match call {
            Call::Enter { vehicle: number, .. } => record.enter(GATE, &vehicle(number)).ok(),
            Call::Left { vehicle: number, pass } => {
                let done = record.left(GATE, &vehicle(number), pass);
                assert!(done.is_err() || before == Occupant::Vehicle(vehicle(number)) || before == Occupant::Nobody);
                None
            }
        };
        if death != Death::BeforeWriting {
            self.kept = record.to_string().parse().unwrap();
        }
        if let (Call::Enter { vehicle, number }, Some(pass), Death::None) = (call, granted, death) {
            self.answers.push((vehicle, number, pass));
        }
        // Whoever dies, the place changes hands only through nobody.
        let after = self.occupant();
        assert!(after == before || before == Occupant::Nobody || after == Occupant::Nobody);
    }

    fn check(&self) {
        let inside = (0..VEHICLES).filter(|number| self.vehicles[*number].inside).collect::<Vec<_>>();
        assert!(inside.len() <= 1, "{inside:?} are in one place");
        for number in inside {
            assert_eq!(self.occupant(), Occupant::Vehicle(vehicle(number)), "it is inside");
        }
    }
}

/// One of the last few, as what is late is late by a few calls: much later ones would seldom arrive when it matters.
fn recent<T: Copy>(all: &[T], which: usize) -> Option<T> {
    all.iter().rev().nth(which).copied()
}

/// A step of a number: drawn so, a sequence is quick to make and to shrink.
fn step(number: u32) -> Step {
    let (kind, which) = (number % 32, (number >> 8) as usize % 4);
    let vehicle = which % VEHICLES;
    match kind {
        0..4 => Step::Ask(vehicle),
        4..10 => Step::Arrive(which, Death::None),
        10 => Step::Arrive(which, Death::BeforeWriting),
        11 => Step::Arrive(which, Death::BeforeAnswering),
        12..17 => Step::Answer(which),
        17..21 => Step::Enter(vehicle),
        21..24 => Step::Leave(vehicle),
        24..28 => Step::Left(vehicle),
        28 => Step::Restart(which % MANAGERS),
        29 => Step::HandOver(vehicle),
        30 => Step::Lose(vehicle),
        _ => Step::Look,
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1_000))]

    #[test]
    fn no_two_vehicles_are_ever_in_one_place(steps in prop::collection::vec(any::<u32>(), 1..200)) {
        let mut world = World::new();
        for number in steps {
            world.step(&step(number));
            world.check();
        }
    }
}

/// How long a step may take on a machine that does other things as well.
const STEP: Duration = Duration::from_secs(30);

/// A fleet of two managers, a unit of places that is a process, and vehicles.
struct Fleet {
    number: u32,
    keys: KeyFolder,
    folder: tempfile::TempDir,
}

impl Fleet {
    fn new() -> Self {
        let number = random_fleet();
        let nodes = ["depot/1@m_unit", "yard/2@m_unit", "places/3@m_unit", "agv-1/101", "agv-2/102"];
        Self { number, keys: KeyFolder::draw(number, &nodes).unwrap(), folder: tempfile::tempdir().unwrap() }
    }

    fn places(&self) -> Process {
        let keys = format!("CARA_KEYS={}", self.keys.path().display());
        let (fleet, state) = (self.number.to_string(), self.folder.path().join("places").display().to_string());
        let words = [&keys, env!("CARGO_BIN_EXE_warehouse"), "places", "--fleet", &fleet, "--state", &state, GATE];
        Process::start("places", Path::new("env"), words).unwrap()
    }

    fn manager(&self, name: &str, id: u32) -> CommunicationSystem {
        let file = self.keys.file(&Identity::m_unit(name, id).unwrap()).unwrap();
        let builder = CommunicationSystem::builder(name, id).unwrap().fleet(self.number).key_file(file);
        let builder = builder.interfaces(Interfaces::Loopback).control(cara_std::control::Control::Off);
        let manager = builder.state_folder(self.folder.path().join(name)).build().unwrap();
        manager.start().unwrap();
        manager
    }

    fn vehicle(&self, name: &str, id: u32, manager: (&str, u32)) -> Unit {
        let file = self.keys.file(&Identity::s_unit(name, id).unwrap()).unwrap();
        let builder = Unit::builder(name, id, manager.0, manager.1).unwrap().fleet(self.number).key_file(file);
        let state = self.folder.path().join(name);
        let vehicle = builder.interfaces(Interfaces::Loopback).state_folder(state).build().unwrap();
        vehicle.start().unwrap();
        vehicle
    }
}

fn until<R>(what: &str, mut act: impl FnMut() -> Option<R>) -> R {
    let end = Instant::now() + STEP;
    loop {
        if let Some(result) = act() {
            return result;
        }
        assert!(Instant::now() < end, "not in time: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The gate as a manager sees it, once its unit has answered.
fn gate(system: &CommunicationSystem) -> (Peer, SharedPlace) {
    let peer = until("the places are there", || {
        system.broadcast();
        system.m_unit("places").ok().filter(|peer| peer.is_connected())
    });
    let gate = SharedPlace::new(peer.clone(), GATE);
    until("the gate answers", || gate.shown().ok());
    (peer, gate)
}

fn joined(system: &CommunicationSystem, vehicle: &str) -> Peer {
    until("a vehicle joins", || {
        system.broadcast();
        system.s_unit(vehicle).ok().filter(Peer::is_connected)
    })
}

fn entered(gate: &SharedPlace, system: &CommunicationSystem, vehicle: &Peer) -> Pass {
    until("a vehicle may enter", || gate.enter(system, vehicle).ok())
}

fn refused(code: u16) -> Option<Error> {
    Some(Error::Service(ServiceError::Failed(code)))
}

#[test]
fn a_place_is_held_through_losses_and_freed_only_by_its_vehicle() {
    let fleet = Fleet::new();
    let mut places = fleet.places();
    let (depot, yard) = (fleet.manager("depot", 1), fleet.manager("yard", 2));
    let (_one, two) = (fleet.vehicle("agv-1", 101, ("depot", 1)), fleet.vehicle("agv-2", 102, ("yard", 2)));
    places.expect("gate blocked unknown", STEP).unwrap();
    let (operator, depot_gate) = gate(&depot);
    let (_, yard_gate) = gate(&yard);
    let (agv_1, agv_2) = (joined(&depot, "agv-1"), joined(&yard, "agv-2"));
    let taken = |manager: &CommunicationSystem, gate: &SharedPlace, vehicle: &Peer| {
        assert_eq!(gate.enter(manager, vehicle).err().map(|failed| failed.error), refused(refusal::TAKEN));
    };
    let release = |occupant| {
        SharedClient::at(&operator).release(GATE, occupant, "looked").wait().err().map(|failed| failed.error)
    };

    // A new place: nobody knows whether it is empty.
    taken(&depot, &depot_gate, &agv_1);
    assert_eq!(release("unknown"), None);
    places.expect("gate free", STEP).unwrap();
    let mut pass = entered(&depot_gate, &depot, &agv_1);
    assert!(pass.keep());
    places.expect("gate held agv-1/101", STEP).unwrap();
    taken(&yard, &yard_gate, &agv_2);
    assert_eq!(release("agv-1/101"), refused(refusal::LIVE));

    // A hand-over while it is held: the vehicle is the same.
    assert_eq!(agv_1.hand_over(&Manager::new("yard", 2).unwrap(), STEP), Ok(()));
    let here = joined(&yard, "agv-1");
    assert!(yard_gate.has(&here).unwrap());
    let mut newer = until("the yard takes it up", || {
        pass.keep();
        yard_gate.enter(&yard, &here).ok()
    });
    assert_eq!(pass.left().err().map(|failed| failed.error), refused(refusal::OLD_PASS));
    drop(pass);
    taken(&yard, &yard_gate, &agv_2);
    assert!(newer.keep());

    // The unit of the places dies.
    places.kill().unwrap();
    until("the lease is lost", || (!newer.keep()).then_some(()));
    places = fleet.places();
    places.expect("gate blocked agv-1/101", STEP).unwrap();
    until("the places are there again", || yard_gate.shown().ok());
    taken(&yard, &yard_gate, &agv_2);
    let newest = entered(&yard_gate, &yard, &here);
    until("it is given back", || newest.left().ok());
    assert_eq!(newest.left().err(), None, "twice");

    // The vehicle's link is lost: its manager renews no more.
    let mut pass = entered(&yard_gate, &yard, &agv_2);
    places.expect("gate held agv-2/102", STEP).unwrap();
    two.stop();
    until("the link is lost", || (!pass.keep()).then_some(()));
    places.expect("gate blocked agv-2/102", STEP).unwrap();

    // Its manager dies, and one that starts takes the place up.
    drop(pass);
    yard.stop();
    drop(yard);
    let yard = fleet.manager("yard", 2);
    let (_, yard_gate) = gate(&yard);
    taken(&yard, &yard_gate, &joined(&yard, "agv-1"));
    let _two = fleet.vehicle("agv-2", 102, ("yard", 2));
    let agv_2 = joined(&yard, "agv-2");
    assert!(yard_gate.has(&agv_2).unwrap());
    entered(&yard_gate, &yard, &agv_2).left().unwrap();
    places.expect("gate free", STEP).unwrap();
}

/// By command: `cargo test -p cara-warehouse --test places -- --ignored`.
#[test]
#[ignore = "takes 15 seconds"]
fn no_two_vehicles_meet_while_the_unit_of_the_places_is_killed() {
    const KILLS: usize = 10;
    let fleet = Fleet::new();
    let mut places = fleet.places();
    let systems = [fleet.manager("depot", 1), fleet.manager("yard", 2)];
    let _units = [fleet.vehicle("agv-1", 101, ("depot", 1)), fleet.vehicle("agv-2", 102, ("yard", 2))];
    let (operator, _) = gate(&systems[0]);
    until("it is released", || SharedClient::at(&operator).release(GATE, "unknown", "new").wait().ok());
    let (inside, entries, over) = (AtomicUsize::new(0), AtomicUsize::new(0), AtomicBool::new(false));
    std::thread::scope(|scope| {
        for (system, vehicle) in systems.iter().zip(["agv-1", "agv-2"]) {
            let (inside, entries, over) = (&inside, &entries, &over);
            scope.spawn(move || {
                let (_, gate) = gate(system);
                let vehicle = joined(system, vehicle);
                while !over.load(Ordering::Relaxed) {
                    let Ok(pass) = gate.enter(system, &vehicle) else { continue };
                    assert_eq!(inside.fetch_add(1, Ordering::SeqCst), 0, "two are in one place");
                    // Some stay until the unit is back, so that another one could come in.
                    let stays = if entries.fetch_add(1, Ordering::Relaxed) % 3 == 2 { 1_000 } else { 2 };
                    std::thread::sleep(Duration::from_millis(stays));
                    inside.fetch_sub(1, Ordering::SeqCst);
                    // If the answer was lost it is given back by the next pass.
                    let _ = pass.left();
                }
            });
        }
        for kill in 0..KILLS {
            let before = entries.load(Ordering::Relaxed);
            until("vehicles enter", || (entries.load(Ordering::Relaxed) > before + 2).then_some(()));
            std::thread::sleep(Duration::from_micros(731 * kill as u64));
            places.kill().unwrap();
            places = fleet.places();
        }
        over.store(true, Ordering::Relaxed);
    });
    println!("{} entries", entries.load(Ordering::Relaxed));
}

#[test]
fn a_record_is_open_once_and_a_damaged_one_not_at_all() {
    let folder = tempfile::tempdir().unwrap();
    let names = [GATE.to_owned()];
    let places = Places::open(folder.path(), &names).unwrap();
    assert!(matches!(Places::open(folder.path(), &names), Err(OpenError::InUse(_))));
    drop(places);
    // A process that another test starts has the lock as well until it is another program.
    let open = || {
        until("nobody has it", || match Places::open(folder.path(), &names) {
            Err(OpenError::InUse(_)) => None,
            opened => Some(opened),
        })
    };
    drop(open().unwrap());
    let file = folder.path().join("places");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), "gate 0 unknown\n");
    std::fs::write(&file, "gate 7 agv 1/101\nlift 2 nobody\n").unwrap();
    let places = open().unwrap();
    assert_eq!(places.shown(GATE).unwrap().occupant, "agv 1/101");
    drop(places);
    for damaged in ["gate 7 agv-1/1", "gate", "gate 7 agv", "gate x nobody\n"] {
        std::fs::write(&file, damaged).unwrap();
        assert!(matches!(open(), Err(OpenError::Damaged { .. })), "{damaged}");
        assert_eq!(std::fs::read_to_string(&file).unwrap(), damaged);
    }
}
