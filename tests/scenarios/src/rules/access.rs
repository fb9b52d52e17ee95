//! Access control.

use cara_core::error::Error;
use cara_core::services::access::{Functions, Rate, Rule, Verbs, Who};

use super::{met, pair};
use crate::scenario::scenarios;
use crate::{Service, Spec, World, number, secs};

scenarios![
    a_peer_without_permission_is_refused_and_sees_nothing: "access control", Rough, [ThirdUnit], ["RequestsForbidden"];
    a_change_of_the_access_table_takes_effect: "access control", Rough, [], ["RequestsRun"];
    what_a_peer_may_not_publish_is_not_seen: "access control", Rough, [ThirdUnit], ["FunctionsForbidden"];
    no_rate_refuses_a_stop: "access control, stop and reset", Light, [], ["RequestsTooSoon"];
];

/// `one` may call the mechanic.
const ONE: &[Rule] = &[Rule::new(Who::node("one", 1), Functions::Named(&["call_mechanic"]), Verbs::CALL)];
const MANAGER: &[Rule] = &[Rule::new(Who::node("manager", 1), Functions::All, Verbs::CALL)];
/// One call of each function in a minute.
const SLOWLY: &[Rule] = &[Rule::new(Who::node("manager", 1), Functions::All, Verbs::CALL).at(Rate::new(1, secs(60)))];
const NOBODY: &[Rule] = &[];
const ANYTHING_BUT_NOTES: &[Rule] = &[Rule::new(Who::S_UNITS, Functions::Named(&["go_to"]), Verbs::ALL)];

fn a_peer_without_permission_is_refused_and_sees_nothing(world: &mut dyn World) {
    let mechanic = Service::numbered("call_mechanic");
    let manager = world.add(Spec::manager("manager", 1).service(&mechanic));
    let one = world.add(Spec::agv("one", 1));
    let other = world.add(Spec::agv("other", 2));
    met(world, &one, "manager", "call_mechanic");
    met(world, &other, "manager", "call_mechanic");
    manager.set_access(Some(ONE)).expect("the manager runs");
    // It may have read the news by now, or not.
    let refused = world.ask(&other, "manager", "call_mechanic", &mut number("n", 1));
    assert!(matches!(refused, Err(Error::NotAllowed | Error::UnknownFunction)), "{refused:?}{}", world.story());
    assert_eq!(mechanic.log().runs(), 0);
    world.wait("it is not seen any more", || !other.knows("manager", "call_mechanic"), secs(20));
    assert_eq!(world.ask(&one, "manager", "call_mechanic", &mut number("n", 2)), Ok(()));
    let late = world.add(Spec::agv("late", 3));
    world.wait("the late one has joined", || late.is_connected("manager"), secs(40));
    world.run_for(secs(1));
    assert!(!late.knows("manager", "call_mechanic"));
    assert_eq!(mechanic.log().runs(), 1);
}

fn a_change_of_the_access_table_takes_effect(world: &mut dyn World) {
    let note = Service::numbered("note");
    let (manager, agv) = pair(world, &note);
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
    agv.set_access(Some(NOBODY)).expect("the AGV runs");
    world.wait("it is not seen any more", || !manager.knows("agv", "note"), secs(20));
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 2)), Err(Error::UnknownFunction));
    for table in [Some(MANAGER), None] {
        agv.set_access(table).expect("the AGV runs");
        met(world, &manager, "agv", "note");
        assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 3)), Ok(()));
    }
    assert_eq!(note.log().runs(), 3);
}

fn what_a_peer_may_not_publish_is_not_seen(world: &mut dyn World) {
    let note = Service::numbered("note");
    let (manager, _agv) = pair(world, &note);
    manager.set_access(Some(ANYTHING_BUT_NOTES)).expect("the manager runs");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Err(Error::UnknownFunction));
    let other = Service::numbered("note");
    world.add(Spec::agv("other", 8).service(&other));
    world.wait("the other has joined", || manager.is_connected("other"), secs(40));
    world.run_for(secs(1));
    assert!(!manager.knows("other", "note"));
    manager.set_access(None).expect("the manager runs");
    met(world, &manager, "other", "note");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 2)), Ok(()));
    assert_eq!((note.log().runs(), other.log().runs()), (1, 0));
}

fn no_rate_refuses_a_stop(world: &mut dyn World) {
    let drive = Service::new("drive(n: int[1])").lease(secs(60));
    let stop = Service::new("stop()").stops_all();
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7).service(&drive).service(&stop));
    agv.set_access(Some(SLOWLY)).expect("the AGV runs");
    met(world, &manager, "agv", "drive");
    met(world, &manager, "agv", "stop");
    let ask = |world: &mut dyn World, function| world.ask(&manager, "agv", function, &mut number("n", 1));
    assert_eq!(ask(world, "drive"), Ok(()));
    assert!(matches!(ask(world, "drive"), Err(Error::TooSoon { .. })), "the rate holds");
    for stops in 1..=3 {
        assert_eq!(ask(world, "stop"), Ok(()), "a stop never comes too often");
        assert_eq!((stop.log().runs(), agv.lease_is_live("drive")), (stops, false));
    }
    assert_eq!(drive.log().runs(), 1);
}
