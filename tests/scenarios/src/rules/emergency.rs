//! An emergency overtakes what is being sent.

use cara_core::config::Priority;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_sim::Path;

use super::met;
use crate::scenario::scenarios;
use crate::{Fault, Pending, Service, Spec, World, millis, number, secs, text};

scenarios![
    an_emergency_overtakes_a_long_message: "73, emergency", Own, [Path], ["bandwidth", "loss", "overtook"];
    without_its_priority_a_stop_waits_for_the_long_message: "73 (priority removed)", Own, [Path],
        ["bandwidth", "waited"];
    an_emergency_ignores_the_interval_and_finds_room: "73, emergency", Rough, [], ["RequestsRun"];
    emergencies_leave_when_all_calls_are_in_flight: "nothing holds up a stop", Light, [], ["left"];
];

/// A stop behind 20,000 characters on a 1 Mbit/s path with 1 % loss. Returns when each of the two arrived.
fn stop_behind_a_message(world: &mut dyn World, priority: Priority) -> (Duration, Duration) {
    let stop = Service::numbered("stop").priority(priority);
    let store = Service::new("store(text: string[20000])");
    let large = |spec: Spec| {
        spec.limits(|limits| {
            limits.message_size = 32 * 1_024;
            limits.chunk_size = 4_096;
        })
    };
    let manager = world.add(large(Spec::manager("manager", 1)));
    let agv = world.add(large(Spec::agv("agv", 7)).service(&stop).service(&store));
    met(world, &manager, "agv", "store");
    met(world, &manager, "agv", "stop");
    let path = Path::LAN.delay(millis(2)).loss_percent(1.0).bits_per_second(1_000_000);
    world.fault(Fault::Path(&manager, &agv, path));
    let calm = millis(world.random(1_000));
    world.run_for(calm);
    let options = RequestOptions { timeout: Some(secs(30)), ..RequestOptions::default() };
    let sent = world.now();
    manager.request_with("agv", "store", &text(20_000), options).expect("it is accepted");
    let wait = Duration::from_micros(world.random(100_000));
    world.run_for(wait);
    let asked = world.now();
    manager.request_with("agv", "stop", &number("n", 1), options).expect("it is accepted");
    world.wait("both ran", || stop.log().runs() == 1 && store.log().runs() == 1, secs(60));
    (stop.log().began()[0].since(asked), store.log().began()[0].since(sent))
}

fn an_emergency_overtakes_a_long_message(world: &mut dyn World) {
    let (stop, message) = stop_behind_a_message(world, Priority::Emergency);
    world.measured("emergency behind 20,000 bytes at 1 Mbit/s", stop);
    world.measured("the message itself", message);
    // Two losses in a row of the datagram and of its copy in the stream are beyond any bound; one is not.
    assert!(stop < secs(2), "{} ms", stop.as_millis());
    if stop < message {
        world.reached("overtook");
    }
}

fn without_its_priority_a_stop_waits_for_the_long_message(world: &mut dyn World) {
    let (stop, message) = stop_behind_a_message(world, Priority::Normal);
    world.measured("a normal request behind 20,000 bytes at 1 Mbit/s", stop);
    assert!(message >= millis(150), "20,000 bytes take 160 ms: {}", message.as_millis());
    assert!(stop >= millis(50), "{} ms", stop.as_millis());
    world.reached("waited");
}

fn an_emergency_ignores_the_interval_and_finds_room(world: &mut dyn World) {
    let (stop, slow) = (Service::numbered("stop").priority(Priority::Emergency), Service::numbered("slow"));
    let slow = slow.takes(millis(600));
    let manager = world.add(Spec::manager("manager", 1).limits(|limits| limits.minimum_interval = millis(1)));
    let agv = Spec::agv("agv", 7).service(&stop).service(&slow).limits(|limits| limits.calls_per_peer = 2);
    world.add(agv);
    met(world, &manager, "agv", "stop");
    met(world, &manager, "agv", "slow");
    let options = RequestOptions { timeout: Some(secs(30)), ..RequestOptions::default() };
    let calls: Vec<_> = (0..4).map(|n| manager.begin("agv", "slow", &number("n", n), options)).collect();
    world.wait("the AGV is full", || slow.log().runs() >= 1, secs(20));
    manager.change(|limits| limits.minimum_interval = secs(60));
    let asked = world.now();
    manager.request_with("agv", "stop", &number("n", 1), options).expect("neither interval nor limit stops it");
    world.wait("it runs", || stop.log().runs() == 1, secs(20));
    if world.is_virtual() {
        world.measured("emergency at a full vehicle", world.now().since(asked));
    }
    manager.change(|limits| limits.minimum_interval = millis(0));
    for call in &calls {
        let _ = world.finish(call);
    }
}

/// Of 80 calls as many are in flight as the manager has room for, and the others wait for it.
fn emergencies_leave_when_all_calls_are_in_flight(world: &mut dyn World) {
    let stops = ["stop", "halt"].map(|name| Service::numbered(name).priority(Priority::Emergency));
    let slow = Service::numbered("slow").takes(secs(4));
    let manager = world.add(Spec::manager("manager", 1));
    let agv = Spec::agv("agv", 7).service(&stops[0]).service(&stops[1]).service(&slow);
    world.add(agv.limits(|limits| limits.calls_per_peer = 64));
    for function in ["stop", "halt", "slow"] {
        met(world, &manager, "agv", function);
    }
    let patient = RequestOptions { timeout: Some(secs(12)), ..RequestOptions::default() };
    let calls: Vec<_> = (0..80).map(|n| manager.begin("agv", "slow", &number("n", n), patient)).collect();
    world.wait("the AGV works", || slow.log().runs() >= 1, secs(20));
    world.run_for(millis(100));
    let asked = world.now();
    let stopping: Vec<_> =
        ["stop", "halt"].map(|function| manager.begin("agv", function, &number("n", 1), patient)).into();
    world.wait("both are answered", || stopping.iter().all(Pending::is_over), secs(6));
    assert!(stopping.iter().all(|call| call.outcome() == Some(Ok(()))), "{}", world.story());
    assert!(stops.iter().all(|stop| stop.log().runs() == 1));
    if calls.iter().filter(|call| !call.is_over()).count() > 0 {
        world.measured("emergency of a caller whose calls are all in flight", world.now().since(asked));
        world.reached("left");
    }
    for call in &calls {
        let _ = world.finish(call);
    }
}
