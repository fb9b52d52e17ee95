//! A thousand s_units on one manager: how soon they are together, how much they broadcast for it, whether each call
//! runs once, and what a restart of the manager costs.

use std::cell::Cell;
use std::rc::Rc;

use cara_core::config::Constraints;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::parameters::Parameters;
use cara_core::time::Duration;
use cara_sim::{Crash, Service, UnitHandle, World, for_each_seed};

const NODES: u32 = 1_000;
/// Functions that a list has room for: a thousand lists at both ends take memory.
const FUNCTIONS: usize = 4;

/// Broadcasts are counted for so long after all have joined: a manager asks four times after its start.
const COUNTED: Duration = Duration::from_secs(10);

struct Fleet {
    world: World,
    manager: UnitHandle,
    agvs: Vec<UnitHandle>,
    /// How often each was called.
    runs: Vec<Rc<Cell<u32>>>,
}

impl Fleet {
    fn start(seed: u64) -> Self {
        let world = World::new(seed);
        let constraints = Constraints { maximum_nodes: NODES as u16, ..Constraints::M_UNIT };
        let manager = world.m_unit("depot", 1).constraints(constraints).functions(FUNCTIONS).start();
        let runs: Vec<Rc<Cell<u32>>> = (0..NODES).map(|_| Rc::default()).collect();
        let agvs = (10..).zip(&runs).map(|(id, runs)| start_agv(&world, id, runs)).collect();
        Self { world, manager, agvs, runs }
    }

    /// Runs until every s_unit is connected; how long that took, to some milliseconds. They offer their function then.
    fn join(&mut self) -> Duration {
        let began = self.world.now();
        while self.manager.s_units().len() < NODES as usize {
            assert!(self.world.now().since(began) < Duration::from_secs(60), "not all have joined");
            self.world.run_for(Duration::from_millis(10));
        }
        let took = self.world.now().since(began);
        self.world.run_for(Duration::from_millis(100));
        assert_eq!(self.manager.nodes_offering("touch").len(), NODES as usize);
        took
    }

    /// Calls all at the same time, for the `times`th time; each must have run so often.
    fn call_all(&mut self, times: u32) {
        let manager = self.manager.clone();
        let outcomes = self.world.block_on(async move { manager.block_request_all("touch", &number()).await });
        let failed: Vec<_> =
            outcomes.iter().filter_map(|(peer, outcome)| Some((peer, outcome.as_ref().err()?))).collect();
        assert_eq!(outcomes.len(), NODES as usize);
        assert!(failed.is_empty(), "{} failed, among them {:?}", failed.len(), failed.first());
        assert!(self.runs.iter().all(|runs| runs.get() == times), "each ran once");
    }

    fn broadcasts(&self) -> u64 {
        let of = |unit: &UnitHandle| {
            unit.node_counted(NodeCounter::WhoHasSent) + unit.node_counted(NodeCounter::AnnounceBroadcast)
        };
        of(&self.manager) + self.searches()
    }

    fn searches(&self) -> u64 {
        self.agvs.iter().map(|agv| agv.node_counted(NodeCounter::WhoHasSent)).sum()
    }
}

fn start_agv(world: &World, id: u32, runs: &Rc<Cell<u32>>) -> UnitHandle {
    let runs = runs.clone();
    let program = move |unit: &UnitHandle| {
        let runs = runs.clone();
        let touch = Service::new(move |_, _| {
            runs.set(runs.get() + 1);
            Ok(())
        });
        unit.my_function_list().add_service("touch(number: int) -> (number: int)", touch).expect("the list is empty");
        unit.publish_my_function_list().expect("it runs");
    };
    world.s_unit(&format!("agv-{id}"), id).joins("depot", 1).functions(FUNCTIONS).program(program).start()
}

fn number() -> Parameters {
    let mut number = Parameters::new();
    number.add_int("number", 1).expect("there is room");
    number
}

/// Restarts the manager `away` after a crash, waits for all, and returns how long they took and what they broadcast.
fn restart(fleet: &mut Fleet, crash: Crash, away: Duration) -> (Duration, u64) {
    let searches = fleet.searches();
    let manager = fleet.manager.clone();
    fleet.world.crash(&manager, crash);
    fleet.world.run_for(away);
    fleet.world.restart(&manager);
    let took = fleet.join();
    fleet.world.run_for(COUNTED);
    (took, fleet.broadcasts() - searches)
}

#[test]
fn a_thousand_nodes_join_are_called_once_each_and_return_after_a_restart() {
    for_each_seed(4, |seed| {
        let mut fleet = Fleet::start(seed);
        let took = fleet.join();
        fleet.world.run_for(COUNTED);
        let sent = fleet.broadcasts();
        println!("seed {seed}: joined after {} ms, {sent} broadcasts", took.as_millis());
        assert!(took <= Duration::from_secs(5) && sent <= 20, "{} ms, {sent} broadcasts", took.as_millis());
        fleet.call_all(1);
        let faults = [(Crash::Process, 1), (Crash::PowerCut, 1), (Crash::PowerCut, 6), (Crash::Process, 20)];
        for (calls, (crash, away)) in (2..).zip(faults) {
            let (took, sent) = restart(&mut fleet, crash, Duration::from_secs(away));
            println!("seed {seed}: {crash:?} for {away} s: back after {} ms, {sent} broadcasts", took.as_millis());
            assert!(took <= Duration::from_secs(10) && sent <= 20, "{} ms, {sent} broadcasts", took.as_millis());
            fleet.call_all(calls);
        }
    });
}
