//! A restarted node and a second one of the same identity are told apart.

use cara_core::error::{CloseReason, Refusal};

use super::{met, pair};
use crate::scenario::scenarios;
use crate::{Fault, Seen, Service, Spec, World, millis, number, secs};

scenarios![
    a_restart_and_a_twin_are_told_apart: "known identity, new epoch", Light, [Crash, ThirdUnit],
        ["power-cut", "restart", "Restarted", "RefusedDuplicate", "challenged", "twin took over"];
    a_twin_is_refused_while_the_first_lives: "known identity, new epoch", Light, [ThirdUnit], ["RefusedDuplicate"];
    a_board_that_draws_the_same_numbers_comes_back: "known identity, new epoch", Light, [Crash, SameSeed],
        ["restart", "Restarted"];
];

const DUPLICATE: CloseReason = CloseReason::Refused(Refusal::DuplicateIdentity);

fn a_restart_and_a_twin_are_told_apart(world: &mut dyn World) {
    let service = Service::numbered("note");
    let (manager, agv) = pair(world, &service);

    // It loses power and is back before the loss could be noticed otherwise: the old link is challenged and dropped.
    world.fault(Fault::PowerCut(&agv));
    world.run_for(millis(200));
    world.fault(Fault::Restart(&agv));
    let restarted = world.now();
    let joins = || manager.count(|event| matches!(event, Seen::Joined(_)));
    world.wait("it is back", || joins() >= 2 && manager.knows("agv", "note"), secs(40));
    world.measured("power back to usable again", world.now().since(restarted));
    world.reached("challenged");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
    assert_eq!(agv.count(|event| *event == Seen::NotJoined(DUPLICATE)), 0, "a restarted node is no duplicate");

    // A second one of the same identity: the first answers the challenge and stays.
    let twin = world.add(Spec::agv("agv", 7).service(&service));
    world.wait("the twin is refused", || twin.count(|event| *event == Seen::NotJoined(DUPLICATE)) > 0, secs(40));
    assert!(agv.is_connected("manager") && !twin.is_connected("manager"));
    assert_eq!(manager.number_of_s_units(), 1);

    world.fault(Fault::PowerCut(&agv));
    world.wait("the twin is taken", || twin.is_connected("manager"), secs(60));
    world.reached("twin took over");
    world.wait("the twin counts", || manager.number_of_s_units() == 1, secs(10));
}

fn a_twin_is_refused_while_the_first_lives(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::numbered("note"));
    let twin = world.add(Spec::agv("agv", 7));
    world.wait("the twin is refused", || twin.count(|event| *event == Seen::NotJoined(DUPLICATE)) > 0, secs(40));
    assert!(agv.is_connected("manager") && !twin.is_connected("manager"));
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
}

fn a_board_that_draws_the_same_numbers_comes_back(world: &mut dyn World) {
    let service = Service::numbered("note");
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7).service(&service).same_seed());
    met(world, &manager, "agv", "note");
    for life in 1..4 {
        world.fault(Fault::PowerCut(&agv));
        world.run_for(millis(100));
        world.fault(Fault::Restart(&agv));
        let joins = || manager.count(|event| matches!(event, Seen::Joined(_)));
        world.wait("it is back", || joins() > life && manager.knows("agv", "note"), secs(40));
        assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", life as i64)), Ok(()));
    }
    assert_eq!(service.log().values(), [1, 2, 3], "no call of an earlier life is answered or run in a later one");
}
