//! An old command does not run.

use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::session::RequestOptions;

use super::{Bystander, keep_alives_pass, pair};
use crate::scenario::scenarios;
use crate::{Fault, Seen, Service, Unit, World, millis, number, secs};

scenarios![
    a_stale_command_from_a_frozen_link_does_not_run: "age of a command", Light, [Freeze],
        ["freeze", "RequestsExpired", "expired reported"];
    a_blocking_command_from_a_frozen_link_does_not_run: "age of a command", Light, [Freeze],
        ["freeze", "RequestsExpired", "CallsTimedOut"];
    without_a_deadline_a_frozen_command_runs_late: "age of a command (deadline removed)", Light, [Freeze],
        ["freeze", "ran late"];
    a_command_that_waited_too_long_does_not_run: "age of a command", Rough, [], ["RequestsExpired"];
    without_a_deadline_a_waiting_command_runs: "age of a command (deadline removed)", Rough, [], ["ran late"];
];

fn life(seconds: u64) -> RequestOptions {
    RequestOptions { timeout: Some(secs(seconds)), ..RequestOptions::default() }
}

/// A command into a stream that is frozen for eight seconds, while keep-alives pass.
fn frozen(world: &mut dyn World, service: &Service, options: RequestOptions) -> (Unit, Unit) {
    let (manager, agv) = pair(world, service);
    keep_alives_pass(world, [&manager, &agv]);
    let mut bystander = Bystander::add(world, &manager);
    let calm = millis(world.random(1_000));
    world.run_for(calm);
    world.fault(Fault::FreezeStreams(&manager, &agv, secs(8)));
    manager.request_with("agv", "go", &number("n", 1), options).expect("it is accepted");
    for _ in 0..12 {
        world.run_for(secs(1));
        bystander.continues(world, &manager);
    }
    assert!(agv.is_connected("manager"), "keep-alives passed");
    (manager, agv)
}

fn a_stale_command_from_a_frozen_link_does_not_run(world: &mut dyn World) {
    let service = Service::numbered("go");
    let (manager, agv) = frozen(world, &service, RequestOptions::default());
    assert_eq!(service.log().runs(), 0);
    assert_eq!(agv.counted(LinkCounter::RequestsExpired), 1);
    let expired = || manager.count(|event| matches!(event, Seen::Failed(_, Error::Expired)));
    world.wait("the caller is told", || expired() == 1, secs(10));
    world.reached("expired reported");
}

fn a_blocking_command_from_a_frozen_link_does_not_run(world: &mut dyn World) {
    let service = Service::numbered("go");
    let (manager, agv) = pair(world, &service);
    keep_alives_pass(world, [&manager, &agv]);
    world.fault(Fault::FreezeStreams(&manager, &agv, secs(8)));
    let start = world.now();
    let asked = world.ask_with(&manager, "agv", "go", &mut number("n", 1), life(2));
    let took = world.now().since(start);
    assert_eq!(asked, Err(Error::TimedOut));
    assert!(took >= secs(2) && took <= secs(2) + world.slack().unwrap_or(secs(5)), "{} us", took.as_micros());
    world.run_for(secs(10));
    assert_eq!(service.log().runs(), 0);
    assert_eq!(agv.counted(LinkCounter::RequestsExpired), 1);
}

fn without_a_deadline_a_frozen_command_runs_late(world: &mut dyn World) {
    let service = Service::numbered("go");
    let _units = frozen(world, &service, life(3_600));
    assert_eq!(service.log().runs(), 1);
    world.reached("ran late");
}

/// A command with this life behind as many slow ones as run side by side, and one that waits; whether it ran.
fn waiting(world: &mut dyn World, options: RequestOptions) -> (Service, Unit, Unit) {
    let manager = world.add(crate::Spec::manager("manager", 1));
    let (slow, go) = (Service::new("slow()").takes(secs(4)), Service::numbered("go"));
    let agv = world.add(crate::Spec::agv("agv", 7).service(&slow).service(&go));
    super::met(world, &manager, "agv", "slow");
    super::met(world, &manager, "agv", "go");
    // More than have a slot to run in.
    agv.change(|limits| limits.calls_per_peer = 256);
    let waits = || agv.counted(LinkCounter::RequestsRun) < agv.counted(LinkCounter::RequestsReceived);
    for sent in 1.. {
        manager.request_with("agv", "slow", &number("n", 0), life(60)).expect("it is accepted");
        world.wait("it arrives", || agv.counted(LinkCounter::RequestsReceived) >= sent, secs(10));
        // One that runs begins at once; a thread of a busy machine may take its time.
        world.run_for(millis(20));
        if waits() {
            world.run_for(millis(200));
        }
        if waits() {
            break;
        }
    }
    manager.request_with("agv", "go", &number("n", 1), options).expect("it is accepted");
    world.run_for(millis(900));
    (go, manager, agv)
}

fn a_command_that_waited_too_long_does_not_run(world: &mut dyn World) {
    let options = RequestOptions { timeout: Some(millis(100)), ..RequestOptions::default() };
    let (go, manager, agv) = waiting(world, options);
    world.wait("it is refused", || agv.counted(LinkCounter::RequestsExpired) == 1, secs(10));
    world.wait(
        "the caller is told",
        || manager.count(|event| matches!(event, Seen::Failed(_, Error::Expired))) == 1,
        secs(10),
    );
    assert_eq!(go.log().runs(), 0);
}

fn without_a_deadline_a_waiting_command_runs(world: &mut dyn World) {
    let (go, _manager, _agv) = waiting(world, life(3_600));
    world.wait("it runs", || go.log().runs() == 1, secs(10));
    world.reached("ran late");
}
