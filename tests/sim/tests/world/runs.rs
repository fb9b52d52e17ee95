//! Whole runs under random faults.

use super::*;
use cara_core::error::Error;
use cara_core::services::unit::RequestOptions;
use cara_sim::{FaultCounts, FaultPlan, seeds};

/// A manager that asks three vehicles for their positions under a plan's faults; afterwards all must be back, nothing
/// leaked and every call ended. Returns the hash of the run.
fn run(seed: u64, plan: FaultPlan) -> (u64, FaultCounts) {
    let mut world = World::new(seed);
    let (ended, outcomes) = shared(0_u32);
    let manager = world.m_unit("manager", 1).program(move |unit| {
        let (unit, ended) = (unit.clone(), Rc::clone(&ended));
        unit.clone().spawn(async move {
            loop {
                let options = RequestOptions { timeout: Some(millis(300)), ..RequestOptions::default() };
                for agv in unit.nodes_offering("pos_info") {
                    let asked = unit.now();
                    let outcome = unit.block_request_with(&agv, "pos_info", &mut position(), options).await;
                    assert!(unit.now().since(asked) <= millis(300), "{outcome:?}");
                    *ended.borrow_mut() += 1;
                }
                unit.sleep(millis(50)).await;
            }
        });
    });
    let manager = manager.start();
    for id in 0..3 {
        start_agv(&world, "agv", 10 + id);
    }
    let end = plan.ends_after();
    world.inject(plan);
    world.run_for(end);
    assert!(world.run_until(|_| manager.nodes_offering("pos_info").len() == 3, secs(60)), "all come back");
    world.run_for(secs(1));
    assert!(*outcomes.borrow() > 0);
    assert_eq!(manager.s_units().len(), 3);
    (world.trace_hash(), world.counts())
}

#[test]
fn a_seed_replays_the_run_of_a_fleet() {
    assert_eq!(run(11, FaultPlan::harsh(11)), run(11, FaultPlan::harsh(11)));
    assert_ne!(run(11, FaultPlan::harsh(11)).0, run(12, FaultPlan::harsh(12)).0);
}

#[test]
fn a_fleet_recovers_from_whatever_was_injected() {
    let mut sum = FaultCounts::default();
    for seed in seeds(40) {
        sum += run(seed, if seed % 2 == 0 { FaultPlan::mild(seed) } else { FaultPlan::harsh(seed) }).1;
    }
    assert_eq!(sum.missing().collect::<Vec<_>>(), [], "{sum}");
}

#[test]
fn errors_of_a_unit_that_is_down_are_typed() {
    let (mut world, manager, agv) = pair(1);
    world.crash(&agv, cara_sim::Crash::PowerCut);
    assert_eq!(world.block_request(&agv, &manager, "x", &mut position()), Err(Error::NotRunning));
    assert_eq!(agv.publish(), Err(Error::NotRunning));
    assert!(agv.peers().is_empty());
}
