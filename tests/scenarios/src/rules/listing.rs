//! The paper's listing, and what it says of arguments and names.

use cara_core::distribution::parameters::Parameters;
use cara_core::error::Error;

use super::{met, pair, paper_services};
use crate::scenario::scenarios;
use crate::{Gate, Service, Spec, World, millis, number, numbers, position, secs, variable};

scenarios![
    the_listing_runs_line_by_line: "29–39, 43, 45–46", Rough, [], ["WhoHasSent", "Joined", "RequestsRun"];
    broadcasting_ends_once_an_agv_is_up: "32", Rough, [], ["WhoHasSent", "agv came later"];
    an_unknown_function_is_an_error: "47", Rough, [], ["RequestsWithheld"];
    a_missing_argument_is_an_error: "40", Rough, [], ["RequestsWithheld"];
    an_argument_of_another_type_is_an_error: "41", Rough, [], ["RequestsWithheld"];
    an_argument_of_another_size_is_an_error: "42", Rough, [], ["RequestsWithheld"];
    more_arguments_than_needed_are_allowed: "24–25", Rough, [], ["RequestsRun"];
];

fn the_listing_runs_line_by_line(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1));
    assert_eq!(manager.number_of_s_units(), 0);
    let (pos_info, go_to) = paper_services();
    // A request that waited for its end would not return.
    let gate = Gate::default();
    let go_to = go_to.waits_at(&gate);
    let agv = world.add(Spec::agv("agv", 7).service(&pos_info).service(&go_to));
    while manager.number_of_s_units() < 1 {
        manager.broadcast();
        let _ = world.run_until(&|| manager.number_of_s_units() == 1, secs(2));
    }
    let list = "pos_info(position: int[2]) -> (position: int[2])\ngo_to(position: int[2])\n";
    assert_eq!(manager.their_function_list("agv"), list);

    let mut pos = Parameters::new();
    pos.add_int("position", 2).expect("there is room");
    assert_eq!(world.ask(&manager, "agv", "pos_info", &mut pos), Ok(()));
    assert_eq!(variable(&pos, "position"), [3, 4]);
    pos.set_value("position", [1, 2]).expect("it is there");
    manager.request("agv", "go_to", &pos).expect("it is accepted");
    assert_eq!(variable(&pos, "position"), [1, 2]);
    gate.open();
    world.wait("go_to has run", || go_to.log().ended().len() == 1, secs(10));
    let mut reported = position();
    assert_eq!(world.ask(&manager, "agv", "pos_info", &mut reported), Ok(()));
    assert_eq!(variable(&reported, "position"), [1, 2]);

    let call_mechanic = Service::new("call_mechanic(place: int[2])");
    manager.add_service(&call_mechanic).expect("there is room");
    assert!(!agv.knows("manager", "call_mechanic"), "adding makes nothing visible");
    manager.publish().expect("it can be published");
    met(world, &agv, "manager", "call_mechanic");
    let mut place = numbers("place", &[5, 6]);
    assert_eq!(world.ask(&agv, "manager", "call_mechanic", &mut place), Ok(()));
    assert_eq!(call_mechanic.log().runs(), 1);
}

fn broadcasting_ends_once_an_agv_is_up(world: &mut dyn World) {
    let manager = world.add(Spec::manager("manager", 1));
    for _ in 0..3 {
        manager.broadcast();
        world.run_for(millis(300));
        assert_eq!(manager.number_of_s_units(), 0);
    }
    let later = world.now();
    world.add(Spec::agv("agv", 7));
    while manager.number_of_s_units() < 1 {
        manager.broadcast();
        let _ = world.run_until(&|| manager.number_of_s_units() == 1, secs(2));
        assert!(world.now().since(later) < secs(20), "the AGV is not found");
    }
    world.reached("agv came later");
}

fn an_unknown_function_is_an_error(world: &mut dyn World) {
    let (manager, agv) = pair(world, &Service::new("ping()"));
    assert_eq!(world.ask(&manager, "agv", "no_such", &mut position()), Err(Error::UnknownFunction));
    assert_eq!(manager.request("agv", "no_such", &position()), Err(Error::UnknownFunction));
    agv.add_service(&Service::new("secret()")).expect("there is room");
    assert_eq!(world.ask(&manager, "agv", "secret", &mut position()), Err(Error::UnknownFunction));
    assert_eq!(manager.request("nobody", "ping", &position()), Err(Error::NotConnected));
}

/// Asks for `go_to` with parameters that do not fit, both ways; the service must not run.
fn refused(world: &mut dyn World, mut parameters: Parameters, error: Error) {
    let service = Service::new("go_to(position: int[2])");
    let (manager, _agv) = pair(world, &service);
    assert_eq!(world.ask(&manager, "agv", "go_to", &mut parameters), Err(error));
    assert_eq!(manager.request("agv", "go_to", &parameters), Err(error));
    world.run_for(millis(100));
    assert_eq!(service.log().runs(), 0);
}

fn a_missing_argument_is_an_error(world: &mut dyn World) {
    refused(world, numbers("place", &[1, 2]), Error::MissingArgument { index: 0 });
}

fn an_argument_of_another_type_is_an_error(world: &mut dyn World) {
    let mut parameters = Parameters::new();
    parameters.add_float("position", 2).expect("there is room");
    refused(world, parameters, Error::WrongType { index: 0 });
}

fn an_argument_of_another_size_is_an_error(world: &mut dyn World) {
    refused(world, numbers("position", &[1, 2, 3]), Error::WrongSize { index: 0, expected: 2, found: 3 });
}

fn more_arguments_than_needed_are_allowed(world: &mut dyn World) {
    let service = Service::numbered("note");
    let (manager, _agv) = pair(world, &service);
    let mut parameters = number("n", 5);
    parameters.add_string("remark", 9).expect("there is room");
    assert_eq!(world.ask(&manager, "agv", "note", &mut parameters), Ok(()));
    assert_eq!(service.log().values(), [5]);
}
