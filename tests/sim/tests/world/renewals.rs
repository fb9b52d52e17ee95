//! Secured links that are rekeyed every second or two while the fleet works, under faults. That no
//! number is ever sealed twice with one key, each of these worlds checks by itself.

use super::*;
use cara_core::config::{Constraints, Priority};
use cara_core::error::{CloseReason, Refusal};
use cara_core::host::connections::LinkCounter;
use cara_core::services::heart::Renew;
use cara_core::services::session::RequestOptions;
use cara_sim::{Action, FaultPlan, Path, UnitEvent};
use std::collections::BTreeSet;

const EVERY: Duration = Duration::from_secs(1);
const LEASE: Duration = Duration::from_millis(900);

/// A manager and a vehicle whose services note what they were called with.
struct Fleet {
    world: World,
    manager: UnitHandle,
    agv: UnitHandle,
    ran: Rc<RefCell<Vec<i64>>>,
    stops: Rc<RefCell<u32>>,
}

fn number(n: i64) -> Parameters {
    let mut parameters = Parameters::new();
    parameters.add_int("n", 1).unwrap();
    parameters.set_value("n", n).unwrap();
    parameters
}

fn options(priority: Priority) -> RequestOptions {
    RequestOptions { timeout: Some(secs(60)), priority: Some(priority), ..RequestOptions::default() }
}

fn fleet(seed: u64) -> Fleet {
    let mut world = World::secured(seed);
    let manager = world.m_unit("manager", 1).start();
    let ((ran, recorded), (stops, stopped)) = (shared(Vec::new()), shared(0));
    let program = move |unit: &UnitHandle| {
        let (ran, stops) = (Rc::clone(&ran), Rc::clone(&stops));
        let note = Service::new(move |_, parameters| {
            ran.borrow_mut().push(parameters.variable::<i64>("n").expect("the core checked it"));
            Ok(())
        });
        unit.my_function_list().add_service("note(n: int)", note).unwrap();
        let drive = Service::new(|_, _| Ok(())).lease(LEASE, move |_| *stops.borrow_mut() += 1);
        unit.my_function_list().add_service("drive()", drive).unwrap();
        unit.publish_my_function_list().unwrap();
    };
    let constraints = Constraints { calls_per_peer: 64, ..Constraints::S_UNIT };
    let agv = world
        .s_unit("agv", 7)
        .joins("manager", 1)
        .renews_every(EVERY)
        .constraints(constraints)
        .program(program)
        .start();
    assert!(world.run_until(|_| manager.knows("agv", "drive"), secs(20)));
    Fleet { world, manager, agv, ran: recorded, stops: stopped }
}

fn renewed(unit: &UnitHandle) -> u64 {
    unit.counted(LinkCounter::KeysRenewed)
}

fn left(unit: &UnitHandle) -> usize {
    unit.count(|event| matches!(event, UnitEvent::Left { .. }))
}

/// Asks for the numbers up to `end`, every 40 ms, some of them in an emergency. Returns how many were accepted.
fn ask(fleet: &mut Fleet, numbers: std::ops::Range<i64>) -> usize {
    let mut accepted = 0;
    for n in numbers {
        let priority = if n % 7 == 0 { Priority::Emergency } else { Priority::Normal };
        accepted += usize::from(fleet.manager.request_with("agv", "note", &number(n), options(priority)).is_ok());
        fleet.world.run_for(millis(40));
    }
    accepted
}

/// What did not run was reported.
fn reported(fleet: &Fleet) -> usize {
    fleet.manager.count(|event| matches!(event, UnitEvent::RequestFailed { .. }))
}

#[test]
fn nothing_is_lost_and_no_lease_ends_while_links_are_rekeyed_under_faults() {
    let figures = cara_sim::for_each_seed(20, |seed| {
        let mut fleet = fleet(seed);
        let path = Path::LAN.delay(millis(3)).jitter(millis(4)).loss_percent(2.0);
        let path = path.duplicate_percent(10.0).reorder_percent(10.0);
        fleet.world.network(|network| network.set_fault_profile(path, secs(3_600)));
        fleet
            .manager
            .request_with("agv", "drive", &Parameters::new(), RequestOptions::renewing(Renew::Process))
            .unwrap();
        fleet.world.run_for(millis(100));
        let accepted = ask(&mut fleet, 0..500);
        assert!(fleet.agv.lease_is_live("drive"), "the lease is renewed across keys, seed {seed}");
        fleet.world.run_for(secs(20));
        let ran = fleet.ran.borrow();
        let once: BTreeSet<i64> = ran.iter().copied().collect();
        assert_eq!(ran.len(), once.len(), "none runs twice, seed {seed}");
        assert_eq!(ran.len() + reported(&fleet), accepted, "each runs or is reported, seed {seed}");
        assert!(accepted == 500 && ran.len() > 450, "{accepted} {} with seed {seed}", ran.len());
        let calm: Vec<i64> = ran.iter().copied().filter(|n| n % 7 != 0).collect();
        assert!(calm.is_sorted(), "in the order of asking, seed {seed}");
        assert_eq!((left(&fleet.manager), left(&fleet.agv)), (0, 0), "no link ends, seed {seed}");
        assert_eq!(*fleet.stops.borrow(), 0, "seed {seed}");
        (renewed(&fleet.manager), renewed(&fleet.agv), fleet.world.sealed())
    });
    for (manager, agv, sealed) in figures {
        assert!(manager.abs_diff(agv) <= 1 && manager > 25 && sealed > 1_000, "{manager} {agv} {sealed}");
    }
}

#[test]
fn frozen_links_and_sleeping_machines_are_outlived() {
    for seed in 0..10 {
        let mut fleet = fleet(seed);
        let (manager, agv) = (fleet.manager.host(), fleet.agv.host());
        let mut accepted = 0;
        for round in 0..20_u64 {
            let (from, to) = if round % 2 == 0 { (manager, agv) } else { (agv, manager) };
            let span = millis(200 + 150 * (round % 9));
            fleet.world.network(|network| match round % 3 {
                0 => network.inject(Action::FreezeStreams { from, to, span }),
                1 => network.inject(Action::Freeze { from, to, span }),
                _ => network.suspend(from, span),
            });
            let first = 40 * round as i64;
            accepted += ask(&mut fleet, first..first + 40);
        }
        fleet.world.run_for(secs(30));
        assert_eq!((left(&fleet.manager), left(&fleet.agv)), (0, 0), "no link ends, seed {seed}");
        let ran = fleet.ran.borrow();
        let once: BTreeSet<i64> = ran.iter().copied().collect();
        assert_eq!(ran.len(), once.len(), "none runs twice, seed {seed}");
        assert_eq!(ran.len() + reported(&fleet), accepted, "each runs or is reported, seed {seed}");
        assert!(ran.len() > 500, "{} with seed {seed}", ran.len());
        assert!(renewed(&fleet.agv) > 20, "{} with seed {seed}", renewed(&fleet.agv));
    }
}

#[test]
fn under_faults_that_end_links_nothing_runs_twice() {
    let renewals = cara_sim::for_each_seed(20, |seed| {
        let mut fleet = fleet(seed);
        fleet.world.inject(FaultPlan::harsh(seed).without_crashes().over(secs(30)));
        ask(&mut fleet, 0..900);
        fleet.world.run_for(secs(60));
        let ran = fleet.ran.borrow();
        let once: BTreeSet<i64> = ran.iter().copied().collect();
        assert_eq!(ran.len(), once.len(), "seed {seed}");
        assert!(fleet.manager.is_connected("agv"), "they are together again, seed {seed}");
        renewed(&fleet.agv)
    });
    assert!(renewals.iter().sum::<u64>() > 300, "{renewals:?}");
}

#[test]
fn two_renewals_of_a_fleet_do_not_fall_together() {
    let mut world = World::secured(3);
    let manager = world.m_unit("manager", 1).start();
    let every = secs(800);
    for id in 0..40 {
        world.s_unit("agv", id).joins("manager", 1).renews_every(every).start();
    }
    assert!(world.run_until(|_| manager.s_units().len() == 40, secs(60)));
    let renewed = |manager: &UnitHandle| manager.counted(LinkCounter::KeysRenewed);
    world.run_for(secs(640));
    assert_eq!(renewed(&manager), 0);
    let mut busiest = 0;
    for _ in 0..200 {
        let before = renewed(&manager);
        world.run_for(secs(1));
        busiest = busiest.max(renewed(&manager) - before);
    }
    assert_eq!(renewed(&manager), 40, "all in an eighth of the time, before it is over");
    assert!(busiest <= 8, "{busiest} in one second");
}

#[test]
fn the_keys_of_a_fleet_change_under_its_live_links_and_who_is_revoked_goes() {
    let mut fleet = fleet(5);
    fleet.manager.change_keys(2, Some(1)).unwrap();
    fleet.world.run_for(secs(5));
    fleet.agv.change_keys(2, None).unwrap();
    fleet.world.run_for(secs(5));
    fleet.manager.change_keys(2, None).unwrap();
    fleet.world.run_for(secs(5));
    assert_eq!((left(&fleet.manager), left(&fleet.agv)), (0, 0));
    assert!(renewed(&fleet.agv) >= 12);
    fleet.manager.forget_key_of("agv").unwrap();
    fleet.world.run_for(secs(5));
    let revoked = CloseReason::Refused(Refusal::NoKey);
    assert_eq!(fleet.manager.count(|e| matches!(e, UnitEvent::Left { reason, .. } if *reason == revoked)), 1);
    let refused = |e: &UnitEvent| matches!(e, UnitEvent::Left { reason: CloseReason::BadProof, .. });
    assert_eq!(fleet.agv.count(refused), 1);
    assert!(!fleet.manager.is_connected("agv"));
}
