//! Crashes, restarts, partitions, frozen streams and changed addresses, seen from a fleet.

use super::*;
use cara_core::error::{CloseReason, Error, Refusal};
use cara_core::host::connections::LinkCounter;
use cara_sim::{Crash, Direction, LogEvent, UnitEvent};

#[test]
fn a_restarted_vehicle_comes_back_with_its_state_lost() {
    let (mut world, manager, agv) = pair(1);
    let mut pos = position();
    pos.set_value("position", [3, 4]).unwrap();
    world.block_request(&manager, "agv", "go_to", &mut pos).unwrap();
    world.crash(&agv, Crash::PowerCut);
    assert!(!agv.is_running());
    assert_eq!(agv.request("manager", "x", &pos), Err(Error::NotRunning));
    world.run_for(millis(100));
    world.restart(&agv);
    let back = |manager: &UnitHandle| manager.count(|event| matches!(event, UnitEvent::Joined { .. })) == 2;
    assert!(world.run_until(|_| back(&manager) && manager.knows("agv", "pos_info"), secs(10)));
    world.block_request(&manager, "agv", "pos_info", &mut pos).unwrap();
    assert_eq!(pos.variable::<[i64; 2]>("position"), Ok([0, 0]));
    assert_eq!(manager.s_units().len(), 1);
}

#[test]
fn a_call_whose_callee_dies_is_interrupted() {
    let (mut world, manager, agv) = pair(1);
    agv.my_function_list().add_service("lift()", Service::new(|_, _| Ok(())).takes(secs(60))).unwrap();
    agv.publish_my_function_list().unwrap();
    assert!(world.run_until(|_| manager.knows("agv", "lift"), secs(1)));
    let (done, result) = shared(None);
    let caller = manager.clone();
    manager.spawn(async move {
        *done.borrow_mut() = Some(caller.block_request("agv", "lift", &mut Parameters::new()).await);
    });
    world.run_for(millis(100));
    world.crash(&agv, Crash::Process);
    world.run_for(millis(10));
    assert_eq!(*result.borrow(), Some(Err(Error::Interrupted)));
}

#[test]
fn a_silent_peer_is_lost_after_three_keep_alives_and_found_again() {
    let (mut world, manager, agv) = pair(2);
    world.run_for(secs(3));
    let cut = world.network(|network| network.partition(&[manager.host()], &[agv.host()], Direction::Both));
    world.run_for(secs(5));
    let silent = |event: &UnitEvent| matches!(event, UnitEvent::Left { reason: CloseReason::Silent, .. });
    assert_eq!((manager.count(silent), agv.count(silent)), (1, 1));
    world.network(|network| network.heal(cut));
    assert!(world.run_until(|_| manager.is_connected("agv") && agv.is_connected("manager"), secs(30)));
}

#[test]
fn the_manager_restarts_and_the_whole_fleet_returns() {
    let mut world = World::new(4);
    let manager = world.m_unit("manager", 1).start();
    let agvs: Vec<_> = (0..10).map(|id| start_agv(&world, "agv", 10 + id)).collect();
    assert!(world.run_until(|_| manager.nodes_offering("go_to").len() == 10, secs(30)));
    world.crash(&manager, Crash::PowerCut);
    world.run_for(secs(10));
    assert!(agvs.iter().all(|agv| !agv.is_connected("manager")));
    world.restart(&manager);
    assert!(world.run_until(|_| manager.nodes_offering("go_to").len() == 10, secs(30)));
}

#[test]
fn a_stale_command_on_a_frozen_stream_is_not_run() {
    let (mut world, manager, agv) = pair(5);
    world.run_for(secs(3));
    world.network(|network| {
        network.inject(cara_sim::Action::FreezeStreams { from: manager.host(), to: agv.host(), span: secs(8) });
    });
    manager.request("agv", "go_to", &position()).unwrap();
    world.run_for(secs(10));
    assert_eq!(agv.log().iter().filter(|(_, event)| matches!(event, LogEvent::Called { .. })).count(), 0);
    assert!(agv.is_connected("manager"), "keep-alives passed as datagrams");
}

#[test]
fn a_vehicle_whose_address_changed_is_found_at_the_new_one() {
    let (mut world, manager, agv) = pair(6);
    world.network(|network| network.change_address(agv.host(), [10, 0, 200, 200].into()));
    assert!(world.run_until(|_| !manager.is_connected("agv"), secs(30)));
    assert!(world.run_until(|_| manager.knows("agv", "go_to"), secs(60)));
    world.block_request(&manager, "agv", "pos_info", &mut position()).unwrap();
}

#[test]
fn a_second_vehicle_of_the_same_identity_is_refused() {
    let (mut world, manager, agv) = pair(7);
    let duplicate = start_agv(&world, "agv", 7);
    world.run_for(secs(5));
    let refused = CloseReason::Refused(Refusal::DuplicateIdentity);
    assert!(
        duplicate.count(|event| matches!(event, UnitEvent::NotJoined { reason, .. } if *reason == refused)) > 0,
        "{:?}",
        duplicate.log()
    );
    assert!(agv.is_connected("manager") && !duplicate.is_connected("manager"));
    assert_eq!(manager.s_units().len(), 1);
}

#[test]
fn a_unit_that_is_stopped_says_so() {
    let (mut world, manager, agv) = pair(8);
    agv.stop();
    world.run_for(millis(10));
    let stopped = UnitEvent::Left { peer: agv.identity(), reason: CloseReason::Stopped };
    assert_eq!(manager.count(|event| *event == stopped), 1, "{:?}", manager.log());
    agv.start();
    assert!(world.run_until(|_| manager.knows("agv", "go_to"), secs(10)));
}

#[test]
fn a_suspended_manager_counts_one_missed_keep_alive_and_its_vehicles_come_back() {
    let (mut world, manager, agv) = pair(9);
    world.run_for(secs(3));
    world.suspend(&manager, secs(60));
    world.run_for(secs(61));
    let silent = UnitEvent::Left { peer: manager.identity(), reason: CloseReason::Silent };
    assert_eq!(agv.count(|event| *event == silent), 1, "the vehicle heard nothing for a minute");
    assert!(manager.counted(LinkCounter::KeepAlivesMissed) <= 1, "the vehicle says that it left");
    assert!(world.run_until(|_| manager.knows("agv", "go_to"), secs(20)));
}
