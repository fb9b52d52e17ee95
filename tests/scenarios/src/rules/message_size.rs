//! The maximum message size limits number and size of arguments.

use cara_core::error::{Error, Limit};

use super::met;
use crate::scenario::scenarios;
use crate::{Service, Spec, Unit, World, millis, secs, text};

scenarios![
    the_longest_message_passes_and_one_byte_more_is_an_error: "52", Rough, [], ["RequestsWithheld", "RequestsRun"];
    the_message_size_can_be_changed_while_running: "52", Rough, [], ["RequestsWithheld"];
    twenty_thousand_characters_cross_whole: "58", Rough, [], ["MessagesReceived"];
];

fn echo(size: usize) -> Service {
    Service::new(&format!("echo(text: string[{size}])"))
}

fn ask(world: &mut dyn World, manager: &Unit, length: usize) -> Result<(), Error> {
    world.ask(manager, "agv", "echo", &mut text(length))
}

/// The same, where requests from before may still fill the send queue.
fn ask_behind_others(world: &mut dyn World, manager: &Unit, length: usize) -> Result<(), Error> {
    const FULL: Result<(), Error> = Err(Error::Full(Limit::SendQueue));
    for _ in 0..100 {
        match ask(world, manager, length) {
            FULL => world.run_for(millis(100)),
            outcome => return outcome,
        }
    }
    FULL
}

/// The longest string that passes.
fn longest(world: &mut dyn World, manager: &Unit, limit: usize) -> usize {
    let (mut passes, mut fails) = (1, limit + 1);
    while fails - passes > 1 {
        let middle = (passes + fails) / 2;
        match ask(world, manager, middle) {
            Ok(()) => passes = middle,
            Err(Error::TooLarge { .. }) => fails = middle,
            Err(other) => panic!("{other:?}"),
        }
    }
    passes
}

fn the_longest_message_passes_and_one_byte_more_is_an_error(world: &mut dyn World) {
    let service = echo(2_000);
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("agv", 7).service(&service).limits(|limits| limits.message_size = 1_024));
    met(world, &manager, "agv", "echo");
    let length = longest(world, &manager, 1_024);
    assert!((1_000..=1_024).contains(&length), "{length}");
    let runs = service.log().runs();
    assert_eq!(ask(world, &manager, length), Ok(()));
    assert_eq!(ask(world, &manager, length + 1), Err(Error::TooLarge { limit: 1_024 }));
    assert_eq!(manager.request("agv", "echo", &text(length + 1)), Err(Error::TooLarge { limit: 1_024 }));
    world.run_for(millis(100));
    assert_eq!(service.log().runs(), runs + 1);
}

fn the_message_size_can_be_changed_while_running(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1));
    let agv = world.add(Spec::agv("agv", 7).service(&echo(2_000)).limits(|limits| limits.message_size = 1_024));
    met(world, &manager, "agv", "echo");
    assert_eq!(ask(world, &manager, 900), Ok(()));
    agv.change(|limits| limits.message_size = 600);
    let told = || manager.request("agv", "echo", &text(900)) == Err(Error::TooLarge { limit: 600 });
    world.wait("the change is told", told, secs(10));
    assert_eq!(ask_behind_others(world, &manager, 500), Ok(()));
    agv.change(|limits| limits.message_size = 1_024);
    world.wait("the change is told", || manager.request("agv", "echo", &text(900)).is_ok(), secs(10));
}

fn twenty_thousand_characters_cross_whole(world: &mut dyn World) {
    let service = Service::new("echo(text: string[20000]) -> (text: string[20000])");
    let large = |spec: Spec| {
        spec.limits(|limits| {
            limits.message_size = 32 * 1_024;
            limits.chunk_size = 4_096;
        })
    };
    let manager = world.add(large(Spec::manager("manager", 1)));
    world.add(large(Spec::agv("agv", 7)).service(&service));
    met(world, &manager, "agv", "echo");
    let sent = text(20_000);
    let mut parameters = text(20_000);
    for _ in 0..3 {
        assert_eq!(world.ask(&manager, "agv", "echo", &mut parameters), Ok(()));
        assert!(parameters == sent, "the string came back changed");
    }
}
