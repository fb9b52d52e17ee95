//! What happens when a link ends, and when it does not.

use cara_core::error::{CloseReason, Error};
use cara_core::services::session::RequestOptions;

use super::{keep_alives_pass, met, pair};
use crate::scenario::scenarios;
use crate::{Fault, Seen, Service, Unit, World, millis, number, secs};

scenarios![
    a_call_is_interrupted_when_its_peer_stops: "execution", Rough, [], ["interrupted"];
    a_call_is_interrupted_when_its_link_is_reset: "execution", Rough, [Reset], ["reset", "interrupted"];
    a_silent_peer_is_lost_after_three_keep_alives: "liveness, 4", Own, [Partition, LongTime],
        ["partition", "KeepAlivesMissed", "lost", "found again"];
    a_half_open_link_is_noticed_on_both_sides: "half-open TCP", Own, [Partition, LongTime], ["partition", "lost"];
    a_dead_stream_ends_the_link_though_datagrams_pass: "liveness, 24", Own, [Freeze, LongTime], ["freeze", "StreamsDied", "found again"];
    a_stream_held_for_a_while_is_not_dead: "liveness, 24", Own, [Freeze, LongTime], ["freeze"];
    the_hook_for_a_lost_manager_runs_once: "s_unit without manager", Rough, [], ["lost", "found again"];
    the_hook_runs_once_for_each_cut_cable: "s_unit without manager", Own, [Partition, LongTime], ["partition", "lost"];
    a_suspended_machine_ends_nothing: "liveness", Light, [Suspend, LongTime], ["suspend", "woke up"];
    a_crashed_peer_leaves_and_comes_back: "4, 68", Rough, [Crash], ["process-killed", "restart", "found again"];
];

fn interrupted(world: &mut dyn World, end: impl Fn(&mut dyn World, &Unit)) -> (Unit, Unit) {
    let service = Service::numbered("slow").takes(secs(1));
    let (manager, agv) = pair(world, &service);
    let options = RequestOptions { timeout: Some(secs(30)), ..RequestOptions::default() };
    let call = manager.begin("agv", "slow", &number("n", 1), options);
    world.wait("it runs", || service.log().runs() == 1, secs(20));
    end(world, &agv);
    assert_eq!(world.finish(&call).map(drop), Err(Error::Interrupted));
    world.reached("interrupted");
    (manager, agv)
}

fn a_call_is_interrupted_when_its_peer_stops(world: &mut dyn World) {
    interrupted(world, |_, agv| agv.stop());
}

fn a_call_is_interrupted_when_its_link_is_reset(world: &mut dyn World) {
    let (manager, _agv) = interrupted(world, |world, agv| world.fault(Fault::Reset(agv)));
    met(world, &manager, "agv", "slow");
}

fn silent(event: &Seen) -> bool {
    matches!(event, Seen::Left(_, CloseReason::Silent))
}

fn a_silent_peer_is_lost_after_three_keep_alives(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::numbered("note"));
    keep_alives_pass(world, [&manager, &agv]);
    let calm = millis(world.random(2_000));
    world.run_for(calm);
    let cut = world.now();
    world.fault(Fault::Cut(&manager, &agv));
    world.run_for(secs(6));
    for unit in [&manager, &agv] {
        let lost = unit.when(silent).expect("the loss is noticed").since(cut);
        assert!(lost >= secs(2) && lost <= secs(4) + millis(500), "{} ms", lost.as_millis());
        world.measured("cut path to loss", lost);
    }
    world.reached("lost");
    assert_eq!((manager.count(silent), agv.count(silent)), (1, 1));
    world.fault(Fault::Heal);
    met(world, &manager, "agv", "note");
    world.reached("found again");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
}

fn a_half_open_link_is_noticed_on_both_sides(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::numbered("note"));
    world.run_for(secs(3));
    world.fault(Fault::CutOneWay(&agv, &manager));
    let cut = world.now();
    world.wait("both notice", || manager.peers().is_empty() && agv.peers().is_empty(), secs(20));
    world.measured("half-open link to loss on both sides", world.now().since(cut));
    world.reached("lost");
    world.fault(Fault::Heal);
    met(world, &manager, "agv", "note");
}

fn stream_dead(event: &Seen) -> bool {
    matches!(event, Seen::Left(_, CloseReason::StreamDead { .. }))
}

/// As behind a firewall that has forgotten the connection.
fn a_dead_stream_ends_the_link_though_datagrams_pass(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::numbered("note"));
    world.wait("both are connected", || agv.is_connected("manager") && manager.is_connected("agv"), secs(40));
    keep_alives_pass(world, [&manager, &agv]);
    let calm = millis(world.random(5_000));
    world.run_for(calm);
    let one_way = world.random(3);
    if one_way != 1 {
        world.fault(Fault::FreezeStreams(&manager, &agv, secs(30)));
    }
    if one_way != 2 {
        world.fault(Fault::FreezeStreams(&agv, &manager, secs(30)));
    }
    let cut = world.now();
    world.wait("both notice", || manager.count(stream_dead) + agv.count(stream_dead) >= 2, secs(40));
    for unit in [&manager, &agv] {
        let lost = unit.when(stream_dead).expect("the loss is noticed").since(cut);
        assert!(lost >= secs(7) && lost <= secs(25), "{} ms", lost.as_millis());
        world.measured("dead stream to loss", lost);
    }
    met(world, &manager, "agv", "note");
    world.reached("found again");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
}

fn a_stream_held_for_a_while_is_not_dead(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::numbered("note"));
    world.wait("both are connected", || agv.is_connected("manager") && manager.is_connected("agv"), secs(40));
    keep_alives_pass(world, [&manager, &agv]);
    for _ in 0..5 {
        world.fault(Fault::FreezeStreams(&manager, &agv, secs(7)));
        world.fault(Fault::FreezeStreams(&agv, &manager, secs(7)));
        let span = secs(7) + millis(200 + world.random(3_000));
        world.run_for(span);
    }
    let left = |event: &Seen| matches!(event, Seen::Left(..));
    assert_eq!((manager.count(left), agv.count(left)), (0, 0), "{}", world.story());
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
}

fn the_hook_for_a_lost_manager_runs_once(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::numbered("note"));
    world.wait("it has a manager to lose", || agv.is_connected("manager"), secs(10));
    assert_eq!(agv.manager_losses().len(), 0);
    manager.stop();
    world.wait("the hook runs", || agv.manager_losses().len() == 1, secs(10));
    world.reached("lost");
    world.run_for(millis(600));
    assert_eq!(agv.manager_losses().len(), 1);
    manager.start();
    met(world, &manager, "agv", "note");
    world.wait("it has a manager to lose again", || agv.is_connected("manager"), secs(10));
    world.reached("found again");
    assert_eq!(agv.manager_losses().len(), 1);
    manager.stop();
    world.wait("the hook runs again", || agv.manager_losses().len() == 2, secs(10));
}

fn the_hook_runs_once_for_each_cut_cable(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::numbered("note"));
    for times in 1..4 {
        let calm = millis(world.random(3_000));
        world.run_for(calm);
        world.fault(Fault::Cut(&manager, &agv));
        world.run_for(secs(10));
        assert_eq!(agv.manager_losses().len(), times);
        world.reached("lost");
        world.fault(Fault::Heal);
        met(world, &manager, "agv", "note");
    }
    assert_eq!(agv.manager_losses().len(), 3);
}

fn a_suspended_machine_ends_nothing(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::numbered("note"));
    let left = |event: &Seen| matches!(event, Seen::Left(..));
    let calm = secs(2) + millis(world.random(2_000));
    world.run_for(calm);
    let span = secs(10) + millis(world.random(50_000));
    world.fault(Fault::Suspend(&manager, span));
    world.fault(Fault::Suspend(&agv, span));
    let woken = world.now() + span;
    world.run_for(span + secs(10));
    assert_eq!((manager.count(left), agv.count(left)), (0, 0), "woken at {woken:?}{}", world.story());
    world.reached("woke up");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
}

fn a_crashed_peer_leaves_and_comes_back(world: &mut dyn World) {
    let service = Service::numbered("note");
    let (manager, agv) = pair(world, &service);
    world.fault(Fault::Kill(&agv));
    world.wait("it has left", || !manager.is_connected("agv"), secs(20));
    assert_eq!(manager.request("agv", "note", &number("n", 1)), Err(Error::NotConnected));
    world.fault(Fault::Restart(&agv));
    met(world, &manager, "agv", "note");
    world.reached("found again");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
}
