//! Shared places: the record alone, in every order of calls, losses and restarts, and real units of two managers.

use cara_std::Identity;
use cara_warehouse::places::{Occupant, Record};
use proptest::prelude::*;
use proptest::sample::Index;

const VEHICLES: usize = 3;
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
    Arrive(Index, Death),
    /// An answer arrives at the manager that asked, if it still waits for it.
    Answer(Index),
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
    /// An operator looks whether the occupant is inside.
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
    /// What its manager has given back, and may give back again.
    gone: Option<i64>,
    /// The call that its manager waits for.
    waits: Option<u32>,
}

struct World {
    /// As on disk.
    kept: String,
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
        Self { kept: record.to_string(), vehicles, calls: Vec::new(), answers: Vec::new(), asked: 0 }
    }

    fn record(&self) -> Record {
        self.kept.parse().unwrap()
    }

    fn occupant(&self) -> Occupant {
        self.record().occupant(GATE).unwrap().clone()
    }

    fn step(&mut self, step: &Step) {
        match *step {
            Step::Ask(number) => {
                self.asked += 1;
                // Whatever it had does not count from here on.
                let vehicle = &mut self.vehicles[number];
                (vehicle.pass, vehicle.gone, vehicle.waits) = (None, None, Some(self.asked));
                self.calls.push(Call::Enter { vehicle: number, number: self.asked });
            }
            Step::Arrive(index, death) if !self.calls.is_empty() => self.arrive(*index.get(&self.calls), death),
            Step::Answer(index) if !self.answers.is_empty() => {
                let (number, call, pass) = *index.get(&self.answers);
                let vehicle = &mut self.vehicles[number];
                if vehicle.waits == Some(call) {
                    (vehicle.pass, vehicle.waits) = (Some(pass), None);
                }
            }
            Step::Enter(number) => {
                let vehicle = &mut self.vehicles[number];
                vehicle.inside |= vehicle.pass.is_some();
            }
            Step::Leave(number) => self.vehicles[number].inside = false,
            Step::Left(number) => {
                let vehicle = &mut self.vehicles[number];
                if !vehicle.inside {
                    vehicle.gone = vehicle.pass.take().or(vehicle.gone);
                    self.calls.extend(vehicle.gone.map(|pass| Call::Left { vehicle: number, pass }));
                }
            }
            Step::Restart(manager) => {
                for vehicle in self.vehicles.iter_mut().filter(|vehicle| vehicle.manager == manager) {
                    (vehicle.pass, vehicle.gone, vehicle.waits) = (None, None, None);
                }
            }
            Step::HandOver(number) => {
                let vehicle = &mut self.vehicles[number];
                let manager = (vehicle.manager + 1) % MANAGERS;
                *vehicle = Vehicle { inside: vehicle.inside, manager, ..Vehicle::default() };
            }
            Step::Look => {
                let occupant = self.occupant();
                let is = |number: &usize| occupant == Occupant::Vehicle(vehicle(*number));
                // With a pass its manager still renews: the unit refuses.
                let blocks = (0..VEHICLES).find(is).map(|number| self.vehicles[number]);
                if blocks.is_some_and(|blocks| !blocks.inside && blocks.pass.is_none() && blocks.waits.is_none()) {
                    let mut record = self.record();
                    record.release(GATE, &occupant).unwrap();
                    self.kept = record.to_string();
                }
            }
            Step::Arrive(..) | Step::Answer(_) => {}
        }
    }

    fn arrive(&mut self, call: Call, death: Death) {
        let before = self.occupant();
        let mut record = self.record();
        let granted = match call {
            Call::Enter { vehicle: number, .. } => record.enter(GATE, &vehicle(number)).ok(),
            Call::Left { vehicle: number, pass } => {
                let done = record.left(GATE, &vehicle(number), pass);
                assert!(done.is_err() || before == Occupant::Vehicle(vehicle(number)) || before == Occupant::Nobody);
                None
            }
        };
        if death != Death::BeforeWriting {
            self.kept = record.to_string();
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

fn step() -> impl Strategy<Value = Step> {
    let vehicle = || 0..VEHICLES;
    let death = prop_oneof![4 => Just(Death::None), 1 => Just(Death::BeforeWriting), 1 => Just(Death::BeforeAnswering)];
    prop_oneof![
        3 => vehicle().prop_map(Step::Ask),
        6 => (any::<Index>(), death).prop_map(|(index, death)| Step::Arrive(index, death)),
        4 => any::<Index>().prop_map(Step::Answer),
        4 => vehicle().prop_map(Step::Enter),
        3 => vehicle().prop_map(Step::Leave),
        3 => vehicle().prop_map(Step::Left),
        1 => (0..MANAGERS).prop_map(Step::Restart),
        1 => vehicle().prop_map(Step::HandOver),
        1 => Just(Step::Look),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, ..ProptestConfig::default() })]

    #[test]
    fn no_two_vehicles_are_ever_in_one_place(steps in prop::collection::vec(step(), 1..200)) {
        let mut world = World::new();
        for step in &steps {
            world.step(step);
            world.check();
        }
    }
}
