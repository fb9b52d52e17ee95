//! Two managers that hand vehicles over to each other, in runs drawn from seeds: managers and vehicles crash and hang, the network
//! parts, disks fail. A vehicle executes commands of another manager only where it has agreed to go there, under claims of each that
//! never decrease, with live orders of one at most. Once all run and reach each other each vehicle has one manager within the time of a
//! hand-over that turns back.
//!
//! `cargo xtask orders` runs more seeds.

mod faults;

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use cara_core::config::HAND_OVER_TIMEOUT;
use cara_core::distribution::claim::Claim;
use cara_core::distribution::connection_handler::HandOverStage;
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::Parameters;
use cara_core::random::Random;
use cara_core::time::Duration;
use cara_sim::{Crash, LogEvent, Service, Storing, UnitEvent, UnitHandle, World, for_each_seed};
use faults::{Fallible, Fault, between, is_awake, millis};

const MANAGERS: [(&str, u32); 2] = [("depot", 1), ("yard", 2)];
/// So long everything fails.
const FAULTS: Duration = Duration::from_secs(60);
/// A vehicle joins the manager that it searches for within this time; a dial that a cut has swallowed is given up after 6 s.
const JOINS: Duration = Duration::from_secs(8);
const LEASE: Duration = Duration::from_millis(400);

struct Fleet {
    world: World,
    managers: Vec<UnitHandle>,
    vehicles: Vec<UnitHandle>,
    lives: Vec<Rc<RefCell<Lives>>>,
}

impl Fallible for Fleet {
    fn world(&mut self) -> &mut World {
        &mut self.world
    }

    fn managers(&self) -> &[UnitHandle] {
        &self.managers
    }

    fn vehicles(&self) -> &[UnitHandle] {
        &self.vehicles
    }

    /// Lets everybody work for a while; each manager has its vehicles drive now and then, so that some stand.
    fn run(&mut self, span: Duration) {
        let end = self.world.now() + span;
        while self.world.now() < end {
            for manager in self.managers.iter().filter(|manager| is_awake(&self.world, manager)) {
                for vehicle in manager.nodes_offering("drive") {
                    let _ = manager.request(&vehicle, "drive", &Parameters::new());
                    let _ = manager.release(&vehicle, "drive");
                }
            }
            self.world.run_for(millis(50));
        }
    }
}

impl Fleet {
    /// All vehicles are the depot's. Disks of some fail.
    fn new(seed: u64, vehicles: u32) -> Self {
        let world = World::secured(seed);
        let mut random = Random::new(seed ^ 0x4A4D_0E12);
        let vehicle = |number: u32| {
            let storing = if random.below(8) == 0 { Storing::Fails } else { Storing::Works };
            let new = world.s_unit(&format!("agv-{number}"), 10 + number).joins("depot", 1).storing(storing);
            let lives = Rc::<RefCell<Lives>>::default();
            let (executing, leaving) = (Rc::clone(&lives), Rc::clone(&lives));
            let vehicle = new.program(move |unit| drives(unit, &executing)).start();
            vehicle.on_event(move |_, event| {
                if let UnitEvent::HandOver { peer, stage: HandOverStage::Leaves } = event {
                    leaving.borrow_mut().agreed.push(peer.clone());
                }
            });
            (vehicle, lives)
        };
        let (vehicles, lives) = (0..vehicles).map(vehicle).unzip();
        let managers = MANAGERS.map(|(name, id)| world.m_unit(name, id).start()).into();
        Self { world, managers, vehicles, lives }
    }

    fn something_happens(&mut self, random: &mut Random) {
        let victims = self.victims(random);
        let fault = match random.below(9) {
            0 => Fault::ManagerCrashes,
            1 => Fault::ManagerHangs,
            2 => Fault::ManagerIsCutOff,
            3 => Fault::VehicleHangs,
            4 => Fault::VehicleCrashes,
            _ => return self.hand_over(random),
        };
        self.suffer(&victims, fault, random);
    }

    /// Both managers may be asked at once for all that each of them has.
    fn hand_over(&self, random: &mut Random) {
        for (manager, (name, id)) in self.managers.iter().zip(MANAGERS.into_iter().rev()) {
            let to = Manager::new(name, id).expect("it is short");
            for vehicle in &self.vehicles {
                if is_awake(&self.world, manager) && random.below(3) > 0 {
                    let _ = manager.hand_over(&vehicle.identity(), &to);
                }
            }
        }
    }

    /// Which managers have each vehicle, unless it has executed no command of one of them since the last [`forget`](Self::forget).
    fn commanding(&self) -> impl Iterator<Item = Vec<Identity>> {
        self.vehicles.iter().zip(&self.lives).map(|(vehicle, lives)| {
            let recent = lives.borrow().recent.clone();
            let has = |manager: &&UnitHandle| {
                manager.knows(&vehicle.identity(), "drive") && vehicle.is_connected(&manager.identity())
            };
            let managers: Vec<_> = self.managers.iter().filter(has).map(UnitHandle::identity).collect();
            if recent.is_some_and(|recent| managers.contains(&recent)) { managers } else { Vec::new() }
        })
    }

    fn forget(&self) {
        self.lives.iter().for_each(|lives| lives.borrow_mut().recent = None);
    }

    fn logs(&self) -> String {
        let log = |unit: &UnitHandle| {
            let log: Vec<_> =
                unit.log().into_iter().filter(|(_, event)| !matches!(event, LogEvent::Called { .. })).collect();
            format!("{:?}: {log:?}\n", unit.identity())
        };
        self.units().map(log).collect()
    }
}

/// What is known of a vehicle in all of its lives.
#[derive(Default)]
struct Lives {
    /// The claim of each manager under which it has executed a command last.
    claims: BTreeMap<Identity, Claim>,
    commanded_by: Option<Identity>,
    /// The same, unless that was [forgotten](Fleet::forget).
    recent: Option<Identity>,
    /// Where it has agreed to go since another manager began to command it.
    agreed: Vec<Identity>,
}

/// `drive` moves the vehicle. What it executes is checked against what it has executed.
fn drives(unit: &UnitHandle, lives: &Rc<RefCell<Lives>>) {
    let live = Rc::<RefCell<Option<Identity>>>::default();
    let (ended, obeying, lives) = (Rc::clone(&live), unit.clone(), Rc::clone(lives));
    let drive = Service::new(move |call, _| {
        let (caller, claim, mut lives) = (&call.caller, obeying.claim(), lives.borrow_mut());
        let before = lives.claims.insert(caller.clone(), claim).unwrap_or_default();
        assert!(claim >= before, "a command of {caller} and {claim:?} is executed after one of {before:?}");
        lives.recent = Some(caller.clone());
        if lives.commanded_by.replace(caller.clone()).is_some_and(|by| by != *caller) {
            assert!(lives.agreed.contains(caller), "{caller} commands a vehicle that was not handed over");
            lives.agreed.clear();
        }
        let live = live.borrow_mut().replace(caller.clone());
        assert!(live.is_none_or(|live| live == *caller), "a vehicle is moved by two managers");
        Ok(())
    });
    let drive = drive.lease(LEASE, move |_| *ended.borrow_mut() = None);
    unit.my_function_list().add_service("drive()", drive).expect("there is room");
    unit.publish_my_function_list().expect("it runs");
}

/// How long it took until each had a manager, and until those that were handed over to a dead one were back; how many vehicles have
/// moved, and have turned back.
fn run(seed: u64, vehicles: u32) -> ([Duration; 2], [usize; 2]) {
    let mut fleet = Fleet::new(seed, vehicles);
    let mut random = Random::new(seed ^ 0x0FA1_77E5);
    let end = fleet.world.now() + FAULTS;
    while fleet.world.now() < end {
        fleet.something_happens(&mut random);
        fleet.run(between(&mut random, 20, 4_000));
    }
    // What was begun ends.
    fleet.world.network(|network| network.heal_all());
    let calm = |fleet: &Fleet| fleet.units().all(|unit| is_awake(&fleet.world, unit));
    assert!(fleet.until(Duration::from_secs(10), calm).is_some());
    fleet.forget();
    let has_one = |fleet: &Fleet| fleet.commanding().all(|managers| managers.len() == 1);
    let whole = fleet.until(HAND_OVER_TIMEOUT + JOINS, has_one);
    assert!(whole.is_some(), "{seed}: not each vehicle has one manager\n{}", fleet.logs());
    // One manager is gone for good, and gets the other one's vehicles.
    let dead = random.below(2) as usize;
    let (left, gone) = (fleet.managers[1 - dead].identity(), fleet.managers[dead].clone());
    let stay: Vec<bool> = fleet.commanding().map(|managers| managers.contains(&left)).collect();
    fleet.world.crash(&gone, Crash::PowerCut);
    let to = Manager::new(MANAGERS[dead].0, MANAGERS[dead].1).expect("it is short");
    for vehicle in fleet.vehicles.iter().zip(&stay).filter(|(_, stay)| **stay).map(|(vehicle, _)| vehicle) {
        fleet.managers[1 - dead].hand_over(&vehicle.identity(), &to).expect("it is there");
    }
    fleet.world.run_for(millis(50));
    fleet.forget();
    let are_back =
        |fleet: &Fleet| fleet.commanding().zip(&stay).all(|(managers, stay)| !stay || managers.contains(&left));
    let back = fleet.until(HAND_OVER_TIMEOUT + JOINS, are_back);
    assert!(back.is_some(), "{seed}: not each vehicle is back\n{}", fleet.logs());
    let stage = |wanted: HandOverStage| {
        let is = |event: &UnitEvent| matches!(event, UnitEvent::HandOver { stage, .. } if *stage == wanted);
        fleet.vehicles.iter().map(|vehicle| vehicle.count(is)).sum()
    };
    ([whole, back].map(Option::unwrap_or_default), [HandOverStage::Moved, HandOverStage::Returns].map(stage))
}

fn runs(seeds: u64, vehicles: u32) {
    let ends = for_each_seed(seeds, |seed| run(seed, vehicles));
    let [whole, back] = [0, 1].map(|which| ends.iter().map(|end| end.0[which]).max());
    let [moved, returned] = [0, 1].map(|stage| ends.iter().map(|end| end.1[stage]).sum::<usize>());
    println!(
        "{} seeds: {moved} vehicles moved, {returned} turned back; each has one manager within {whole:?}, or is back within {back:?}",
        ends.len()
    );
    assert!(ends.len() < 2 || moved > ends.len() && returned > 0, "{moved} {returned}");
}

#[test]
fn whatever_fails_a_vehicle_that_is_handed_over_has_one_manager() {
    runs(2, 5);
}
