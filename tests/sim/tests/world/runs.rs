//! Whole runs under random faults.

use super::*;
use cara_core::config::Priority;
use cara_core::error::Error;
use cara_core::services::session::RequestOptions;
use cara_sim::{FaultCounts, FaultPlan, for_each_seed};
use std::collections::BTreeSet;

/// A manager that asks three vehicles for their positions under a plan's faults, and stops them with numbered
/// emergencies. Afterwards all must be back, nothing leaked, every call ended in time and no number seen twice.
fn run(seed: u64, plan: FaultPlan) -> (u64, FaultCounts) {
    let mut world = World::new(seed);
    let (ended, outcomes) = shared(0_u32);
    let manager = world.m_unit("manager", 1).program(move |unit| {
        let (unit, ended) = (unit.clone(), Rc::clone(&ended));
        unit.clone().spawn(async move {
            loop {
                let options = RequestOptions { timeout: Some(millis(300)), ..RequestOptions::default() };
                for agv in unit.nodes_offering("stop") {
                    let asked = unit.now();
                    let outcome = unit.block_request_with(&agv, "pos_info", &mut position(), options).await;
                    let in_time = unit.now().since(asked) <= millis(300);
                    assert!(in_time || unit.suspended_until() > asked, "{outcome:?}");
                    *ended.borrow_mut() += 1;
                    let mut number = Parameters::<128>::sized();
                    number.add_int("number", 1).unwrap();
                    number.set_value("number", i64::from(*ended.borrow())).unwrap();
                    let _ = unit.request_with(&agv, "stop", &number, options);
                }
                unit.sleep(millis(50)).await;
            }
        });
    });
    let manager = manager.start();
    let (seen, stops) = shared(BTreeSet::new());
    let agvs: Vec<_> = (0..3).map(|id| start_stoppable(&world, 10 + id, &seen)).collect();
    let end = plan.ends_after();
    world.inject(plan);
    // A link that leads nowhere is noticed after a few keep-alives.
    world.run_for(end + secs(5));
    assert!(world.run_until(|_| manager.nodes_offering("stop").len() == 3, secs(60)), "all come back");
    world.run_for(secs(1));
    assert!(*outcomes.borrow() > 0 && !stops.borrow().is_empty());
    assert_eq!(manager.s_units().len(), 3, "{:#?}", manager.log());
    let idle = |unit: &UnitHandle| unit.calls_held() == 0 && unit.free_buffers() == BUFFERS;
    assert!(world.run_until(|_| agvs.iter().all(idle), secs(1)), "what was taken is given back");
    (world.trace_hash(), world.counts())
}

const BUFFERS: usize = 16;

fn start_stoppable(world: &World, id: u32, seen: &Rc<RefCell<BTreeSet<i64>>>) -> UnitHandle {
    let seen = Rc::clone(seen);
    let program = move |unit: &UnitHandle| {
        let seen = Rc::clone(&seen);
        let stop = Service::new(move |_, parameters| {
            let number = parameters.variable("number").expect("the core checked it");
            assert!(seen.borrow_mut().insert(number), "{number} was run twice");
            Ok(())
        });
        unit.my_function_list().add_service("stop(number: int)", stop.priority(Priority::Emergency)).unwrap();
        agv(unit);
    };
    world.s_unit("agv", id).joins("manager", 1).message_buffers(BUFFERS).program(program).start()
}

#[test]
fn a_seed_replays_the_run_of_a_fleet() {
    assert_eq!(run(11, FaultPlan::harsh(11)), run(11, FaultPlan::harsh(11)));
    assert_ne!(run(11, FaultPlan::harsh(11)).0, run(12, FaultPlan::harsh(12)).0);
}

#[test]
fn a_fleet_recovers_from_whatever_was_injected() {
    let mut sum = FaultCounts::default();
    for counts in for_each_seed(200, |seed| {
        run(seed, if seed % 2 == 0 { FaultPlan::mild(seed) } else { FaultPlan::harsh(seed) }).1
    }) {
        sum += counts;
    }
    assert_eq!(sum.missing().collect::<Vec<_>>(), [], "{sum}");
}

#[test]
fn errors_of_a_unit_that_is_down_are_typed() {
    let (mut world, manager, agv) = pair(1);
    world.crash(&agv, cara_sim::Crash::PowerCut);
    assert_eq!(world.block_request(&agv, &manager, "x", &mut position()), Err(Error::NotRunning));
    assert_eq!(agv.publish_my_function_list(), Err(Error::NotRunning));
    assert!(agv.peers().is_empty());
}
