//! Terms: of two managers of one identity the newer one commands, and no counter locks a manager out.

use super::*;
use cara_core::error::{CloseReason, Refusal};
use cara_core::term::Term;
use cara_sim::{Crash, Direction, UnitEvent};

/// Another manager of the same identity, which claims the term behind this one.
fn rival(world: &World, kept: u32) -> UnitHandle {
    world.m_unit("manager", 1).kept_term(kept).start()
}

fn is_fenced(unit: &UnitHandle, by: u32) -> bool {
    unit.count(|event| *event == UnitEvent::Fenced { term: Term(by) }) == 1 && !unit.is_running()
}

#[test]
fn a_manager_that_takes_over_gets_the_vehicle_and_the_other_one_steps_down() {
    for seed in 0..20 {
        let (mut world, manager, agv) = pair(seed);
        assert_eq!((manager.term(), agv.term()), (Term(1), Term(1)));
        let newer = rival(&world, manager.term().0);
        assert!(world.run_until(|_| newer.knows("agv", "go_to"), secs(30)), "seed {seed}: {:?}", agv.log());
        assert!(is_fenced(&manager, 2), "seed {seed}: {:?}", manager.log());
        assert_eq!((newer.term(), agv.term(), newer.is_running()), (Term(2), Term(2), true));
        let stopped = UnitEvent::Left { peer: manager.identity(), reason: CloseReason::Stopped };
        assert_eq!(agv.count(|event| *event == stopped), 1, "it released what it held: {:?}", agv.log());
    }
}

/// It has been thawed, or cut off, while another one took over. What it commands from then on is refused.
#[test]
fn a_manager_that_comes_back_behind_another_one_is_fenced() {
    for seed in 0..20 {
        let (mut world, manager, agv) = pair(seed);
        world.suspend(&manager, secs(20));
        let newer = rival(&world, 1);
        assert!(world.run_until(|_| newer.is_connected("agv"), secs(19)), "seed {seed}");
        assert!(world.run_until(|_| is_fenced(&manager, 2), secs(60)), "seed {seed}: {:?}", manager.log());
        assert!(newer.is_connected("agv"));
        manager.keep_term(Term::NONE);
        manager.start();
        assert!(world.run_until(|_| is_fenced_again(&manager), secs(60)), "seed {seed}: {:?}", manager.log());
        assert!(newer.is_connected("agv") && agv.term() == Term(2));
    }
}

fn is_fenced_again(unit: &UnitHandle) -> bool {
    unit.count(|event| matches!(event, UnitEvent::Fenced { .. })) == 2 && !unit.is_running()
}

/// The newer one is out of reach: the vehicle itself fences the older one, also after a restart of its own.
#[test]
fn a_vehicle_fences_by_itself_and_keeps_what_it_has_obeyed() {
    for seed in 0..20 {
        let (mut world, manager, agv) = pair(seed);
        world.crash(&manager, Crash::PowerCut);
        let newer = rival(&world, 1);
        assert!(world.run_until(|_| agv.term() == Term(2), secs(30)));
        world.network(|network| {
            network.partition(&[newer.host()], &[agv.host(), manager.host()], Direction::Both);
        });
        world.crash(&agv, Crash::PowerCut);
        manager.keep_term(Term::NONE);
        world.restart(&agv);
        world.restart(&manager);
        assert!(world.run_until(|_| is_fenced(&manager, 2), secs(60)), "seed {seed}: {:?}", manager.log());
        // What the manager said last is on its way.
        world.run_for(secs(1));
        let fenced = CloseReason::Refused(Refusal::Fenced);
        let told = |event: &UnitEvent| matches!(event, UnitEvent::NotJoined { reason, .. } if *reason == fenced);
        assert!(agv.count(told) > 0 && agv.term() == Term(2), "seed {seed}: {:?}", agv.log());
        // What the vehicle has obeyed is heard: the next start claims the one behind it.
        manager.keep_term(Term(2));
        world.restart(&manager);
        assert!(world.run_until(|_| manager.is_connected("agv") && agv.term() == Term(3), secs(60)), "seed {seed}");
    }
}

#[test]
fn what_a_vehicle_executes_is_of_terms_that_never_decrease() {
    for seed in 0..20 {
        let mut world = World::new(seed);
        let agv = start_agv(&world, "agv", 7);
        let executed = Rc::new(RefCell::new(Vec::new()));
        let (note, vehicle) = (Rc::clone(&executed), agv.clone());
        let service = Service::new(move |_, _| {
            note.borrow_mut().push(vehicle.term());
            Ok(())
        });
        agv.my_function_list().add_service("note()", service).unwrap();
        agv.publish_my_function_list().unwrap();
        let mut managers = Vec::new();
        for kept in [0, 3, 1, 4, u32::MAX - 1, u32::MAX] {
            managers.push(rival(&world, kept));
            for _ in 0..20 {
                world.run_for(millis(500));
                for manager in managers.iter().filter(|manager| manager.knows("agv", "note")) {
                    let _ = manager.request("agv", "note", &Parameters::new());
                }
            }
        }
        let executed = executed.borrow();
        let sinks = executed.windows(2).find(|pair| pair[0].is_newer_than(pair[1]));
        assert_eq!(sinks, None, "seed {seed}: {executed:?}");
        assert_eq!(executed.last(), Some(&Term(5)), "seed {seed}: {executed:?}");
    }
}

#[test]
fn a_counter_that_has_wrapped_or_was_never_set_locks_nobody_out() {
    for (seed, (managers, vehicles)) in
        [(u32::MAX, u32::MAX), (u32::MAX - 1, u32::MAX), (0, u32::MAX), (0, 1 << 31), (7, 0)].into_iter().enumerate()
    {
        let mut world = World::new(seed as u64);
        let agv = world.s_unit("agv", 7).joins("manager", 1).kept_term(vehicles).start();
        let manager = rival(&world, managers);
        // Where its own is older, it hears the vehicle's once, and claims the one behind it.
        let joins =
            |world: &mut World| world.run_until(|_| manager.is_connected("agv") || !manager.is_running(), secs(20));
        assert!(joins(&mut world), "{managers}, {vehicles}: {:?}", agv.log());
        if is_fenced(&manager, vehicles) {
            manager.keep_term(Term(vehicles));
            world.restart(&manager);
            assert!(joins(&mut world), "{managers}, {vehicles}: {:?}", agv.log());
        }
        assert!(manager.is_connected("agv"), "{managers}, {vehicles}: {:?}", manager.log());
    }
}
