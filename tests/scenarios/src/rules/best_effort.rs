//! Telemetry: now or never.

use cara_core::error::Error;
use cara_sim::Path;

use super::{BEST_EFFORT, best_effort_passes, pair, sent};
use crate::scenario::scenarios;
use crate::{Fault, Service, Unit, World, millis, number, secs, text};

scenarios![
    best_effort_loses_without_blocking: "delivery", Own, [Path], ["loss", "lost some"];
    best_effort_arrives_in_one_datagram: "delivery, 3", Light, [], ["DatagramsReceived"];
    best_effort_is_for_short_messages_without_a_reply: "delivery", Rough, [], ["RequestsWithheld"];
];

fn live_pair(world: &mut dyn World, service: &Service) -> (Unit, Unit) {
    let (manager, agv) = pair(world, service);
    best_effort_passes(world, &manager, "agv", "telemetry");
    (manager, agv)
}

fn best_effort_loses_without_blocking(world: &mut dyn World) {
    let service = Service::numbered("telemetry").in_turns();
    let (manager, agv) = live_pair(world, &service);
    world.fault(Fault::Path(&manager, &agv, Path::LAN.loss_percent(40.0)));
    let before = service.log().runs();
    for n in 0..100 {
        manager.request_with("agv", "telemetry", &number("n", n), BEST_EFFORT).expect("it is accepted at once");
        world.run_for(millis(1));
    }
    world.run_for(millis(200));
    let runs = service.log().runs() - before;
    assert!((20..100).contains(&runs), "{runs} of 100");
    assert!(service.log().values().windows(2).all(|pair| pair[0] < pair[1]), "nothing comes again later");
    world.reached("lost some");
}

fn best_effort_arrives_in_one_datagram(world: &mut dyn World) {
    let service = Service::numbered("telemetry");
    let (manager, _agv) = live_pair(world, &service);
    let (before, ran) = (sent(&manager), service.log().runs());
    for n in 0..20 {
        manager.request_with("agv", "telemetry", &number("n", n), BEST_EFFORT).expect("it is accepted");
        world.run_for(millis(5));
    }
    let [in_the_stream, in_datagrams] = [0, 1].map(|at| sent(&manager)[at] - before[at]);
    // The acknowledgement of a list may be among them.
    assert!(in_the_stream < 10, "{in_the_stream} messages over TCP for 20 requests");
    assert!(in_datagrams >= 20, "{in_datagrams} datagrams for 20 requests");
    world.wait("most of it arrives", || service.log().runs() >= ran + 5, secs(10));
}

fn best_effort_is_for_short_messages_without_a_reply(world: &mut dyn World) {
    let service = Service::new("store(text: string[3000])");
    let (manager, agv) = pair(world, &service);
    let asked = world.ask_with(&manager, "agv", "store", &mut text(10), BEST_EFFORT);
    assert_eq!(asked, Err(Error::BadConstraint));
    assert!(matches!(manager.request_with("agv", "store", &text(2_000), BEST_EFFORT), Err(Error::TooLarge { .. })));
    drop(agv);
}
