//! The maximum message size limits number and size of arguments.

use cara_core::distribution::function::Definition;
use cara_core::error::{Error, Limit};
use cara_sim::{BoxedParameters, boxed_parameters};

use super::met;
use crate::scenario::scenarios;
use crate::{Service, Spec, Unit, World, millis, secs, text};

scenarios![
    the_longest_message_passes_and_one_byte_more_is_an_error: "52", Rough, [], ["RequestsWithheld", "RequestsRun"];
    the_message_size_can_be_changed_while_running: "52", Rough, [], ["RequestsWithheld"];
    an_order_of_nodes_comes_back_whole_and_a_longer_one_is_an_error: "52", Rough, [], ["RequestsWithheld", "RequestsRun"];
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
    let reported = || manager.request("agv", "echo", &text(900)) == Err(Error::TooLarge { limit: 600 });
    world.wait("the change is told", reported, secs(10));
    assert_eq!(ask_behind_others(world, &manager, 500), Ok(()));
    agv.change(|limits| limits.message_size = 1_024);
    world.wait("the change is told", || manager.request("agv", "echo", &text(900)).is_ok(), secs(10));
}

const ORDER: &str = "order(nodes: {id: string[8], x: float}[..50]) -> (nodes: {id: string[8], x: float}[..50])";

/// An order of so many nodes.
fn order(nodes: u8) -> BoxedParameters {
    let definition = Definition::parse(ORDER).expect("it is a signature");
    let mut parameters = boxed_parameters(8 * 1_024);
    for argument in definition.signature().arguments() {
        parameters.add_spec(argument).expect("there is room");
    }
    let set = parameters.set_list("nodes", |list| {
        (0..nodes).try_for_each(|number| {
            list.push_record(|node| {
                node.set("id", if number.is_multiple_of(2) { "even" } else { "an odd 1" })?;
                node.set("x", f64::from(number) / 2.0)
            })
        })
    });
    set.expect("it fits");
    parameters
}

fn an_order_of_nodes_comes_back_whole_and_a_longer_one_is_an_error(world: &mut dyn World) {
    let service = Service::new(ORDER);
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("agv", 7).service(&service).limits(|limits| limits.message_size = 1_024));
    met(world, &manager, "agv", "order");
    assert!(manager.their_function_list("agv").contains(ORDER));
    for nodes in [0, 1, 40] {
        let mut parameters = order(nodes);
        assert_eq!(world.ask(&manager, "agv", "order", &mut parameters), Ok(()));
        assert_eq!(parameters, order(nodes));
    }
    let runs = service.log().runs();
    let too_large = Err(Error::TooLarge { limit: 1_024 });
    assert_eq!(world.ask(&manager, "agv", "order", &mut order(50)), too_large);
    world.run_for(millis(100));
    assert_eq!(service.log().runs(), runs);
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
