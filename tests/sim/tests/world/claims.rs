//! Claims: of two managers of one identity the higher claim commands, and nothing that one vehicle says ends a manager.

use super::*;
use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::error::Error;
use cara_core::services::session::RequestOptions;
use cara_sim::{Crash, Direction, Storing, UnitEvent};

/// What another manager of the same identity, with a store of its own, has stored: nothing, a lower term, the one before that of
/// the live manager, its own, and a higher one.
const KEPT: [u64; 5] = [0, 1, 4, 5, 9];

/// A live manager that has been started five times, with a vehicle.
fn fifth(seed: u64) -> (World, UnitHandle, UnitHandle) {
    let mut world = World::secured(seed);
    let manager = world.m_unit("manager", 1).kept_term(4).start();
    let agv = start_agv(&world, "agv", 7);
    assert!(world.run_until(|_| manager.knows("agv", "go_to") && agv.is_connected("manager"), secs(10)));
    assert_eq!((manager.term(), agv.claim()), (5, manager.claim()));
    (world, manager, agv)
}

fn has_stepped_down(unit: &UnitHandle) -> bool {
    unit.count(|event| matches!(event, UnitEvent::Fenced { .. })) == 1 && !unit.is_running()
}

#[test]
fn a_manager_that_takes_over_gets_the_vehicle_and_the_other_one_steps_down() {
    for kept in KEPT {
        for seed in 0..5 {
            let (mut world, manager, agv) = fifth(seed);
            let newer = world.m_unit("manager", 1).kept_term(kept).takes_over().start();
            let is_obeyed = |_: &World| newer.knows("agv", "go_to") && agv.claim() == newer.claim();
            assert!(world.run_until(is_obeyed, secs(30)), "{kept}, {seed}: {:?}", agv.log());
            assert!(world.run_until(|_| has_stepped_down(&manager), secs(30)), "{kept}, {seed}: {:?}", manager.log());
            assert_eq!((newer.is_running(), agv.claim()), (true, newer.claim()), "{kept}, {seed}");
        }
    }
}

/// It has been thawed, or cut off, while another one with a store of its own took over: what it commands from then on is refused.
#[test]
fn a_manager_that_hangs_and_goes_on_leaves_the_fleet_whole() {
    for kept in KEPT {
        for seed in 0..5 {
            let (mut world, manager, agv) = fifth(seed);
            world.suspend(&manager, secs(20));
            let newer = world.m_unit("manager", 1).kept_term(kept).takes_over().start();
            assert!(world.run_until(|_| newer.is_connected("agv"), secs(19)), "{kept}, {seed}: {:?}", newer.log());
            assert!(world.run_until(|_| has_stepped_down(&manager), secs(60)), "{kept}, {seed}: {:?}", manager.log());
            for _ in 0..3 {
                world.crash(&agv, Crash::PowerCut);
                world.restart(&agv);
                assert!(world.run_until(|_| newer.is_connected("agv") && agv.claim() == newer.claim(), secs(30)));
            }
            assert!(newer.is_running() && agv.claim() == newer.claim());
        }
    }
}

/// Without a take-over, as a supervisor on another host starts it.
#[test]
fn a_manager_that_starts_beside_one_that_hangs_raises_its_claim() {
    for kept in KEPT {
        for seed in 0..5 {
            let (mut world, manager, agv) = fifth(seed);
            // A claim that it has commanded with is stored.
            world.block_request(&manager, "agv", "go_to", &mut position()).unwrap();
            world.suspend(&manager, secs(60));
            let newer = world.m_unit("manager", 1).kept_term(kept).start();
            let is_obeyed = |_: &World| newer.is_connected("agv") && agv.claim() == newer.claim();
            assert!(world.run_until(is_obeyed, secs(40)), "{kept}, {seed}: {:?}", newer.log());
            assert!(newer.claim() > manager.claim());
            assert!(world.run_until(|_| has_stepped_down(&manager), secs(90)), "{kept}, {seed}: {:?}", manager.log());
            assert!(newer.is_running());
        }
    }
}

/// Its other vehicle hears of the raised claim on the link that it has.
#[test]
fn a_raised_claim_is_announced_on_live_links() {
    for seed in 0..5 {
        let (mut world, dead, agv) = fifth(seed);
        world.block_request(&dead, "agv", "go_to", &mut position()).unwrap();
        world.crash(&dead, Crash::PowerCut);
        let newer = world.m_unit("manager", 1).start();
        let other = start_agv(&world, "other", 8);
        assert!(world.run_until(|_| other.is_connected("manager") && other.claim() == newer.claim(), secs(10)));
        assert!(world.run_until(|_| newer.claim() > dead.claim(), secs(40)), "{seed}: {:?}", newer.log());
        assert!(world.run_until(|_| other.claim() == newer.claim(), secs(1)), "{seed}: {:?}", other.log());
        assert!(world.run_until(|_| agv.claim() == newer.claim(), secs(10)), "{seed}: {:?}", agv.log());
    }
}

/// The vehicles hear both. They stay together, under one of the two.
#[test]
fn two_managers_that_cannot_hear_each_other_do_not_split_the_fleet() {
    for kept in KEPT {
        for seed in 0..4 {
            let mut world = World::secured(seed);
            let manager = world.m_unit("manager", 1).kept_term(4).start();
            let agvs: Vec<_> = (7..10).map(|id| start_agv(&world, &format!("agv-{id}"), id)).collect();
            let has = |unit: &UnitHandle| agvs.iter().filter(|agv| unit.is_connected(agv.identity().name())).count();
            assert!(world.run_until(|_| has(&manager) == 3, secs(10)));
            let rival = world.m_unit("manager", 1).kept_term(kept);
            let rival = rival.start();
            world.network(|network| network.partition(&[manager.host()], &[rival.host()], Direction::Both));
            let mut together = 0;
            for round in 0..8 {
                let agv = &agvs[round % 3];
                world.crash(agv, Crash::PowerCut);
                world.restart(agv);
                world.run_for(secs(40));
                let counts = [has(&manager), has(&rival)];
                together += usize::from(counts == [3, 0] || counts == [0, 3]);
            }
            assert!(manager.is_running() && rival.is_running(), "neither has heard of the other one");
            let highest = manager.claim().max(rival.claim());
            assert!(agvs.iter().all(|agv| agv.claim() == highest), "{kept}, {seed}");
            assert!(together >= 7, "{kept}, {seed}: {together:?} of 8, {:?} {:?}", agvs[0].log(), agvs[1].log());
        }
    }
}

#[test]
fn a_manager_that_is_suspended_for_an_hour_commands_nothing_behind_another_one() {
    for seed in 0..5 {
        let (mut world, manager, agv) = fifth(seed);
        world.suspend(&manager, secs(3_600));
        world.run_for(secs(60));
        let newer = world.m_unit("manager", 1).start();
        assert!(world.run_until(|_| newer.is_connected("agv"), secs(60)));
        let claim = newer.claim();
        world.run_for(secs(3_600));
        assert!(world.run_until(|_| has_stepped_down(&manager), secs(60)), "{seed}: {:?}", manager.log());
        assert_eq!((newer.claim(), agv.claim(), newer.is_running()), (claim, claim, true));
    }
}

/// By accident, or with the stolen key of one vehicle: a claim without a genuine tag, and one that a manager made once.
#[test]
fn a_vehicle_that_says_it_obeys_another_manager_ends_no_manager() {
    for (seed, term) in [(0, 100), (1, u64::MAX), (2, 6)] {
        let (mut world, manager, agv) = fifth(seed);
        let forged = TaggedClaim { claim: Claim { term, claimant: 1 }, tag: [term as u8; 16] };
        let thief = world.s_unit("thief", 8).joins("manager", 1).has_obeyed("manager", 1, forged).start();
        world.run_for(secs(120));
        assert!(manager.is_running() && manager.is_connected("agv") && !manager.is_connected("thief"));
        assert_eq!(
            (manager.claim(), thief.claim(), agv.count(left)),
            (agv.claim(), forged.claim, 0),
            "not raised above"
        );
    }
    for seed in 0..5 {
        // A bench manager of the same name and keys, whose vehicle is switched on beside production.
        let mut bench = World::secured(seed);
        let other = bench.m_unit("manager", 1).kept_term(40).start();
        let vehicle = start_agv(&bench, "bench", 8);
        assert!(bench.run_until(|_| other.knows("bench", "go_to"), secs(10)));
        assert_eq!(vehicle.stored_claim(), None, "it has only joined");
        let claim = other.tagged_claim();
        let (mut world, manager, agv) = fifth(seed);
        let visitor = world.s_unit("bench", 8).joins("manager", 1).has_obeyed("manager", 1, claim).start();
        assert!(world.run_until(|_| manager.is_connected("bench"), secs(60)), "{seed}: {:?}", manager.log());
        assert!(manager.claim() > claim.claim && agv.count(left) == 0, "raised, and no order has ended");
        assert!(world.run_until(|_| agv.claim() == manager.claim() && visitor.claim() == manager.claim(), secs(5)));
    }
}

fn left(event: &UnitEvent) -> bool {
    matches!(event, UnitEvent::Left { .. })
}

/// A vehicle whose `drive` lasts as long as it is wanted, with a store like this.
fn driven(world: &World, storing: Storing) -> UnitHandle {
    let program = |unit: &UnitHandle| {
        let drive = Service::new(|_, _| Ok(())).lease(millis(400), |_| {});
        unit.my_function_list().add_service("drive()", drive).unwrap();
        unit.publish_my_function_list().unwrap();
    };
    world.s_unit("agv", 7).joins("manager", 1).storing(storing).program(program).start()
}

#[test]
fn a_claim_is_stored_before_a_call_moves_and_a_store_that_fails_holds_up_nothing() {
    let not_kept = |event: &UnitEvent| matches!(event, UnitEvent::ClaimNotKept { .. });
    for (storing, at_least, at_most) in
        [(Storing::Works, 0, 100), (Storing::Fails, 0, 100), (Storing::Hangs, 1_900, 2_200)]
    {
        let mut world = World::secured(3);
        let manager = world.m_unit("manager", 1).start();
        let agv = driven(&world, storing);
        assert!(world.run_until(|_| manager.knows("agv", "drive"), secs(10)));
        world.run_for(secs(10));
        assert_eq!((agv.stored_claim(), agv.claim()), (None, manager.claim()), "not at joining");
        let began = world.now();
        if storing == Storing::Hangs {
            // What waits for longer than its lease is not wanted any more: its caller is told, and asks again.
            let refused = world.block_request(&manager, "agv", "drive", &mut Parameters::new());
            assert!(matches!(refused, Err(Error::Expired | Error::TimedOut)), "{refused:?}");
        }
        let options = RequestOptions { timeout: Some(secs(5)), ..RequestOptions::default() };
        let mut none = Parameters::new();
        let reply = world.block_on(manager.block_request_with("agv", "drive", &mut none, options));
        assert!(reply.is_ok(), "{storing:?}: {reply:?}");
        let took = world.now().since(began).as_millis();
        assert!((at_least..at_most).contains(&took), "{storing:?}: {took} ms");
        let stored = (storing == Storing::Works).then(|| manager.tagged_claim());
        assert_eq!(agv.stored_claim(), stored, "{storing:?}");
        assert_eq!(agv.count(not_kept), usize::from(storing != Storing::Works), "{storing:?}");
        let began = world.now();
        assert!(world.block_request(&manager, "agv", "drive", &mut none).is_ok());
        assert!(world.now().since(began) < millis(100), "the next one waits for nothing");
    }
}

#[test]
fn what_a_vehicle_executes_is_of_claims_that_never_decrease() {
    for seed in 0..10 {
        let mut world = World::secured(seed);
        let agv = start_agv(&world, "agv", 7);
        let executed = Rc::new(RefCell::new(Vec::new()));
        let (note, vehicle) = (Rc::clone(&executed), agv.clone());
        let service = Service::new(move |_, _| {
            note.borrow_mut().push(vehicle.claim());
            Ok(())
        });
        agv.my_function_list().add_service("note()", service).unwrap();
        agv.publish_my_function_list().unwrap();
        let mut managers = Vec::new();
        for kept in [0, 3, 1, 4, u64::MAX - 1, u64::MAX] {
            managers.push(world.m_unit("manager", 1).kept_term(kept).takes_over().start());
            for _ in 0..20 {
                world.run_for(millis(500));
                for manager in managers.iter().filter(|manager| manager.knows("agv", "note")) {
                    let _ = manager.request("agv", "note", &Parameters::new());
                }
            }
        }
        let executed = executed.borrow();
        assert!(executed.is_sorted(), "seed {seed}: {executed:?}");
        assert_eq!(executed.last(), Some(&managers[5].claim()), "seed {seed}");
    }
}

/// A manager that has lost what it stored is fenced by its own vehicles, and is alone.
#[test]
fn no_counter_locks_a_manager_out() {
    for (seed, obeyed) in [1, 7, u64::MAX - 1, u64::MAX].into_iter().enumerate() {
        let mut world = World::secured(seed as u64);
        let manager = world.m_unit("manager", 1).kept_term(obeyed - 1).start();
        let agv = driven(&world, Storing::Works);
        assert!(world.run_until(|_| manager.knows("agv", "drive"), secs(10)));
        assert!(world.block_request(&manager, "agv", "drive", &mut Parameters::new()).is_ok());
        world.crash(&manager, Crash::PowerCut);
        world.crash(&agv, Crash::PowerCut);
        manager.keep_term(0);
        world.restart(&manager);
        world.restart(&agv);
        assert!(world.run_until(|_| manager.is_connected("agv"), secs(30)), "{obeyed}: {:?}", manager.log());
        assert!(world.run_until(|_| agv.is_connected("manager"), secs(1)));
        assert!(manager.claim() >= Claim { term: obeyed, claimant: 0 } && agv.claim() == manager.claim());
    }
}
