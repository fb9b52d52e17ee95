//! Which functions are visible to which peers.

use cara_core::distribution::identity::Identity;
use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;

use super::{keep_alives_pass, met, pair};
use crate::scenario::scenarios;
use crate::{Fault, Seen, Service, Spec, World, millis, number, secs};

scenarios![
    published_to_one_is_hidden_from_others: "43–44", Rough, [ThirdUnit], ["RequestsRun"];
    published_to_all_reaches_those_that_come_later: "45–46", Rough, [ThirdUnit], ["RequestsRun"];
    published_to_one_survives_its_reconnection: "44", Rough, [ThirdUnit], ["RequestsRun", "agv came back"];
    publishing_waits_until_everybody_has_read: "45", Rough, [ThirdUnit], ["MessagesSent"];
    publishing_returns_at_once_or_waits_as_asked: "45b", Light, [Freeze], ["freeze"];
    a_changed_function_is_stale_until_it_is_published_again: "12", Rough, [], ["RequestsRejected"];
    a_removed_function_is_gone_and_the_others_stay: "12", Rough, [], ["RequestsRun"];
    what_a_peer_has_no_room_for_is_counted: "12", Rough, [], ["FunctionsSkipped"];
];

fn published_to_one_is_hidden_from_others(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1));
    let one = world.add(Spec::agv("one", 1));
    let other = world.add(Spec::agv("other", 2));
    let joined = || manager.number_of_s_units() == 2 && other.is_connected("manager");
    world.wait("both have joined", joined, secs(40));
    let call_mechanic = Service::new("call_mechanic()");
    manager.add_service(&call_mechanic).expect("there is room");
    manager.publish_to("one").expect("it can be published");
    met(world, &one, "manager", "call_mechanic");
    assert_eq!(world.ask(&one, "manager", "call_mechanic", &mut number("n", 0)), Ok(()));
    let late = world.add(Spec::agv("late", 3));
    world.wait("a third has joined", || late.is_connected("manager"), secs(40));
    world.run_for(millis(200));
    assert!(!other.knows("manager", "call_mechanic") && !late.knows("manager", "call_mechanic"));
    assert_eq!(other.request("manager", "call_mechanic", &number("n", 0)), Err(Error::UnknownFunction));
}

fn published_to_all_reaches_those_that_come_later(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7));
    let station = world.add(Spec::manager("station", 2));
    world.wait("both have joined", || manager.is_connected("agv") && manager.is_connected("station"), secs(40));
    manager.add_service(&Service::new("call_mechanic()")).expect("there is room");
    manager.publish().expect("it can be published");
    met(world, &agv, "manager", "call_mechanic");
    met(world, &station, "manager", "call_mechanic");
    let late = world.add(Spec::agv("late", 8));
    met(world, &late, "manager", "call_mechanic");
    assert_eq!(world.ask(&late, "manager", "call_mechanic", &mut number("n", 0)), Ok(()));
}

fn published_to_one_survives_its_reconnection(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7));
    let other = world.add(Spec::agv("other", 8));
    world.wait("both have joined", || manager.number_of_s_units() == 2, secs(40));
    manager.add_service(&Service::new("call_mechanic()")).expect("there is room");
    manager.publish_to("agv").expect("it can be published");
    met(world, &agv, "manager", "call_mechanic");
    agv.stop();
    world.wait("it has left", || !manager.is_connected("agv"), secs(10));
    agv.start();
    met(world, &agv, "manager", "call_mechanic");
    world.reached("agv came back");
    assert_eq!(world.ask(&agv, "manager", "call_mechanic", &mut number("n", 0)), Ok(()));
    assert!(!other.knows("manager", "call_mechanic"));
}

fn publishing_waits_until_everybody_has_read(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1));
    let agvs = [world.add(Spec::agv("one", 1)), world.add(Spec::agv("two", 2))];
    world.wait("both have joined", || manager.number_of_s_units() == 2, secs(40));
    manager.add_service(&Service::new("late()")).expect("there is room");
    let reported = manager.begin_publish();
    let missing = world.finish(&reported).expect("the manager can publish");
    // An AGV that has not read the list is named, which needs a link that ended meanwhile, as on a rough network.
    for agv in &agvs {
        let knows = agv.knows("manager", "late");
        assert!(knows || missing.contains(&agv.identity()), "it returned before all had read");
    }
    let events = manager.events();
    let has_left = |node: &Identity| events.iter().any(|(_, seen)| matches!(seen, Seen::Left(left, _) if left == node));
    assert!(missing.iter().all(has_left), "{missing:?} had not read");
    world.wait("all have read in the end", || agvs.iter().all(|agv| agv.knows("manager", "late")), secs(40));
}

/// While the stream to the AGV holds everything, the AGV cannot read what is published.
fn publishing_returns_at_once_or_waits_as_asked(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7));
    world.wait("it has joined", || manager.is_connected("agv") && agv.is_connected("manager"), secs(40));
    keep_alives_pass(world, [&manager, &agv]);
    manager.add_service(&Service::new("late()")).expect("there is room");
    world.fault(Fault::FreezeStreams(&manager, &agv, secs(6)));
    manager.publish().expect("it can be published");
    assert!(!agv.knows("manager", "late"), "it has returned before the AGV has read");
    let reported = manager.begin_publish();
    world.run_for(secs(1));
    assert!(!reported.is_over() && !agv.knows("manager", "late"), "it waits for the AGV");
    assert_eq!(world.finish(&reported), Ok(vec![]));
    assert!(agv.knows("manager", "late"));
}

fn a_changed_function_is_stale_until_it_is_published_again(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::numbered("note"));
    let changed = Service::numbered("note");
    agv.replace_service(&changed).expect("it is there");
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Err(Error::StaleFunction));
    assert_eq!(changed.log().runs(), 0);
    agv.publish().expect("it can be published");
    let mut asked = Err(Error::StaleFunction);
    for _ in 0..200 {
        asked = world.ask(&manager, "agv", "note", &mut number("n", 2));
        if asked.is_ok() {
            break;
        }
        world.run_for(millis(20));
    }
    assert_eq!((asked, changed.log().values()), (Ok(()), vec![2]));
}

fn a_removed_function_is_gone_and_the_others_stay(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1));
    let (kept, gone) = (Service::numbered("kept"), Service::numbered("gone"));
    let agv = world.add(Spec::agv("agv", 7).service(&gone).service(&kept));
    met(world, &manager, "agv", "kept");
    met(world, &manager, "agv", "gone");
    agv.remove_service("gone").expect("it is there");
    world.wait("the news has come", || !manager.knows("agv", "gone"), secs(10));
    assert_eq!(world.ask(&manager, "agv", "gone", &mut number("n", 1)), Err(Error::UnknownFunction));
    assert_eq!(world.ask(&manager, "agv", "kept", &mut number("n", 1)), Ok(()));
    assert_eq!((gone.log().runs(), kept.log().runs()), (0, 1));
}

fn what_a_peer_has_no_room_for_is_counted(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1).their_functions(4));
    let spec = (0..10).fold(Spec::agv("agv", 7), |spec, index| spec.service(&Service::numbered(&format!("f{index}"))));
    world.add(spec);
    world.wait("the list has been read", || manager.counted(LinkCounter::FunctionsSkipped) >= 6, secs(40));
    assert_eq!(manager.their_function_list("agv").lines().count(), 4);
    assert_eq!(world.ask(&manager, "agv", "f0", &mut number("n", 1)), Ok(()));
    assert_eq!(world.ask(&manager, "agv", "f9", &mut number("n", 1)), Err(Error::UnknownFunction));
}
