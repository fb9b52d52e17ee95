//! Whatever comes in, on purpose or not, ends in an error that says what to do, and everything else goes on.

use cara_core::config::Priority;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{CloseReason, Error, Limit, Refusal, ServiceError};
use cara_core::host::connections::LinkCounter;
use cara_core::services::session::RequestOptions;

use super::{Bystander, met, pair};
use crate::scenario::scenarios;
use crate::{
    Fault, Port, Seen, Service, Spec, Unit, UnknownClient, World, millis, number, numbers, position, secs, text,
};

scenarios![
    bad_arguments_harm_nobody_else: "40–42, 47", Rough, [ThirdUnit], ["RequestsWithheld"];
    what_is_too_long_is_an_error_in_either_direction: "52", Rough, [ThirdUnit], ["RequestsWithheld"];
    a_full_list_of_functions_names_its_limit: "full tables", Rough, [ThirdUnit], ["RequestsRun"];
    full_tables_of_calls_name_their_limit: "full tables", Rough, [ThirdUnit], ["RequestsBusy", "CallsTimedOut"];
    two_units_with_few_buffers_do_not_stop_each_other: "full tables", Light, [], ["answered"];
    a_second_manager_of_a_name_is_told_on_its_own_side: "known identity, new epoch", Rough, [ThirdUnit], ["OwnIdentity"];
    another_fleet_that_dials_is_refused_by_name: "fleet", Rough, [UnknownClients, UnprovenClients, ThirdUnit],
        ["DatagramFleet", "RefusedFleet", "client was told"];
    garbage_on_every_port_harms_nobody: "garbage", Rough, [UnknownClients, ThirdUnit], ["DatagramMagic", "DatagramFleet"];
    a_peer_that_closes_in_mid_chunk_harms_nobody_else: "half a message", Rough, [UnknownClients, UnprovenClients, ThirdUnit], ["left"];
    a_thousand_silent_connections_keep_nobody_out: "half-open connections", Light, [UnknownClients, Backlog, ThirdUnit], ["GaveWay"];
    a_reader_of_one_byte_a_second_harms_nobody_else: "slow reader", Own, [SlowReader, ThirdUnit], ["SendRefused"];
    a_unit_without_an_interface_finds_its_manager_when_it_has_one: "no interface", Light, [Interface, ThirdUnit],
        ["SendFailed", "unplugged"];
];

const DUPLICATE: CloseReason = CloseReason::Refused(Refusal::DuplicateIdentity);

/// A manager, an AGV with one service, and an uninvolved AGV.
fn three(world: &mut dyn World, service: &Service) -> (Unit, Unit, Bystander) {
    let (manager, agv) = pair(world, service);
    let bystander = Bystander::add(world, &manager);
    (manager, agv, bystander)
}

fn bad_arguments_harm_nobody_else(world: &mut dyn World) {
    let service = Service::new("go_to(position: int[2])");
    let (manager, _agv, mut bystander) = three(world, &service);
    let mut other_type = Parameters::new();
    other_type.add_float("position", 2).expect("there is room");
    let cases = [
        ("no_such", position(), Error::UnknownFunction),
        ("go_to", numbers("place", &[1, 2]), Error::MissingArgument { index: 0 }),
        ("go_to", other_type, Error::WrongType { index: 0 }),
        ("go_to", numbers("position", &[1, 2, 3]), Error::WrongSize { index: 0, expected: 2, found: 3 }),
    ];
    for (function, mut parameters, error) in cases {
        assert_eq!(manager.request("agv", function, &parameters), Err(error));
        bystander.continues(world, &manager);
        assert_eq!(world.ask(&manager, "agv", function, &mut parameters), Err(error));
        bystander.continues(world, &manager);
    }
    assert_eq!(service.log().runs(), 0);
    assert_eq!(world.ask(&manager, "agv", "go_to", &mut position()), Ok(()));
}

/// A manager that takes 1,024 bytes and an AGV that takes 12,000, with services for more.
fn what_is_too_long_is_an_error_in_either_direction(world: &mut dyn World) {
    let fill = |_: &crate::Asked, parameters: &mut ParametersView| {
        parameters.set_value("text", "x".repeat(9_000).as_str()).map_err(|_| ServiceError::BadResults)
    };
    let store = Service::new("store(text: string[20000])");
    let dump = Service::new("dump() -> (text: string[9000])").does(fill);
    let manager = world.add(Spec::manager("manager", 1).limits(|limits| limits.message_size = 16_384));
    let agv = Spec::agv("agv", 7).service(&store).service(&dump).limits(|limits| limits.message_size = 12_000);
    world.add(agv);
    met(world, &manager, "agv", "dump");
    let mut bystander = Bystander::add(world, &manager);

    // A request that is longer than the callee takes is not sent.
    let too_large = Error::TooLarge { limit: 12_000 };
    assert_eq!(world.ask(&manager, "agv", "store", &mut text(13_000)), Err(too_large));
    assert_eq!(manager.request("agv", "store", &text(13_000)), Err(too_large));
    bystander.continues(world, &manager);
    // A result for which the caller has no room is not even asked for.
    let mut small = Parameters::<64>::sized();
    let refused = world.ask(&manager, "agv", "dump", &mut small);
    assert!(matches!(refused, Err(Error::ResultWouldNotFit { need, have }) if need > have), "{refused:?}");
    assert_eq!((store.log().runs(), dump.log().runs()), (0, 0));
    bystander.continues(world, &manager);
    // A result that is longer than the caller takes is not sent.
    manager.change(|limits| limits.message_size = 1_024);
    asked_until(world, &manager, Err(Error::TooLarge { limit: 1_024 }));
    let mut roomy = text(9_000);
    assert_eq!(world.ask(&manager, "agv", "dump", &mut roomy), Err(Error::TooLarge { limit: 1_024 }));
    assert_eq!(roomy, text(9_000), "an error leaves the parameters as they are");
    bystander.continues(world, &manager);
    // What the text says helps, once the AGV has been told.
    manager.change(|limits| limits.message_size = 16_384);
    asked_until(world, &manager, Ok(()));
}

/// Asks for the long text until the AGV has been told of a change.
fn asked_until(world: &mut dyn World, manager: &Unit, wanted: Result<(), Error>) {
    let mut asked = Err(Error::NotConnected);
    for _ in 0..200 {
        asked = world.ask(manager, "agv", "dump", &mut text(9_000));
        if asked == wanted {
            return;
        }
        world.run_for(millis(20));
    }
    assert_eq!(asked, wanted);
}

fn a_full_list_of_functions_names_its_limit(world: &mut dyn World) {
    let (manager, agv, mut bystander) = three(world, &Service::numbered("note"));
    let mut added = 0;
    let full = loop {
        match agv.add_service(&Service::numbered(&format!("f{added}"))) {
            Ok(()) => added += 1,
            Err(error) => break error,
        }
    };
    assert!(matches!(full, Error::Full(Limit::Functions | Limit::SignatureBytes)), "{full:?} after {added}");
    assert_eq!(agv.add_service(&Service::numbered("note")), Err(Error::NameTaken));
    bystander.continues(world, &manager);
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
    agv.remove_service("f0").expect("it is there");
    assert_eq!(agv.add_service(&Service::numbered("other")), Ok(()), "what the text says helps");
}

fn full_tables_of_calls_name_their_limit(world: &mut dyn World) {
    let service = Service::numbered("slow").takes(millis(300));
    let manager = world.add(Spec::manager("manager", 1));
    world.add(Spec::agv("agv", 7).service(&service).limits(|limits| limits.calls_per_peer = 4));
    met(world, &manager, "agv", "slow");
    let mut bystander = Bystander::add(world, &manager);
    let options = RequestOptions { timeout: Some(secs(1)), ..RequestOptions::default() };
    let calls: Vec<_> = (0..100).map(|n| manager.begin("agv", "slow", &number("n", n), options)).collect();
    bystander.continues(world, &manager);
    let outcomes: Vec<_> = calls.iter().map(|call| world.finish(call).map(drop)).collect();
    let named = |outcome: &&Result<(), Error>| matches!(outcome, Err(Error::Busy | Error::Full(Limit::Calls)));
    assert!(outcomes.iter().filter(named).count() > 0, "{outcomes:?}");
    let expected = |outcome: &Result<(), Error>| {
        matches!(outcome, Ok(()) | Err(Error::Busy | Error::Full(_) | Error::TimedOut | Error::Expired))
    };
    assert!(outcomes.iter().all(expected), "{outcomes:?}");
    bystander.continues(world, &manager);
    world.run_for(millis(700));
    assert_eq!(world.ask(&manager, "agv", "slow", &mut number("n", 0)), Ok(()), "every slot is free again");
}

/// Both pools are full of what the other one is to read.
fn two_units_with_few_buffers_do_not_stop_each_other(world: &mut dyn World) {
    // Longer than what the network between two units takes by itself.
    let length = if world.port() == Port::Embassy { 20_000 } else { 110_000 };
    let service = Service::new(&format!("store(text: string[{length}])"));
    let few = |spec: Spec| {
        spec.service(&service).message_buffers(3).limits(|limits| limits.message_size = length as u32 + 8_000)
    };
    let (one, two) = (world.add(few(Spec::manager("one", 1))), world.add(few(Spec::manager("two", 2))));
    met(world, &one, "two", "store");
    met(world, &two, "one", "store");
    for _ in 0..3 {
        // While each of them sends all it can, each may have no room for any of a round's calls, and say so: not every time.
        assert!((0..20).any(|_| some_at_once_run(world, &one, &two, length)), "none ran{}", world.story());
    }
    for (unit, other) in [(&one, "two"), (&two, "one")] {
        let asked = world.ask(unit, other, "store", &mut text(length));
        assert_eq!(asked, Ok(()), "{}", world.story());
    }
    world.reached("answered");
}

/// Three calls in each direction at once; all are answered, and whether any ran.
fn some_at_once_run(world: &mut dyn World, one: &Unit, two: &Unit, length: usize) -> bool {
    let mut calls = Vec::new();
    for priority in [Priority::High, Priority::Normal, Priority::Low] {
        let options = RequestOptions { timeout: Some(secs(8)), priority: Some(priority), ..RequestOptions::default() };
        calls.push(one.begin("two", "store", &text(length), options));
        calls.push(two.begin("one", "store", &text(length), options));
    }
    let outcomes: Vec<_> = calls.iter().map(|call| world.finish(call).map(drop)).collect();
    let answered = |outcome: &Result<(), Error>| matches!(outcome, Ok(()) | Err(Error::Busy | Error::Full(_)));
    assert!(outcomes.iter().all(answered), "{outcomes:?}{}", world.story());
    outcomes.contains(&Ok(()))
}

/// Of two live managers that hear each other the lower claim steps down. Each claims for the first time here, so that what they have
/// drawn decides which one it is.
fn a_second_manager_of_a_name_is_told_on_its_own_side(world: &mut dyn World) {
    let (manager, agv, mut bystander) = three(world, &Service::numbered("note"));
    world.run_for(secs(1));
    let second = world.add(Spec::manager("manager", 1).beside_another());
    let reported = |unit: &Unit| unit.count(|event| *event == Seen::NotJoined(DUPLICATE));
    let fenced = |unit: &Unit| unit.count(|event| matches!(event, Seen::Fenced(_)));
    world.wait("the second is told", || reported(&second) > 0, secs(40));
    world.wait("so is the first", || reported(&manager) > 0, secs(40));
    world.wait("one steps down", || fenced(&manager) + fenced(&second) > 0, secs(40));
    let (stays, leaves) = if fenced(&second) > 0 { (&manager, &second) } else { (&second, &manager) };
    met(world, stays, "agv", "note");
    met(world, stays, "bystander", "count");
    bystander.continues(world, stays);
    world.run_for(secs(3));
    assert_eq!((reported(&manager), reported(&second)), (1, 1), "once");
    assert_eq!((fenced(stays), stays.count(|event| matches!(event, Seen::Left(..)))), (0, 0), "it keeps what it has");
    assert!(agv.is_connected("manager") && leaves.peers().is_empty());
    assert_eq!(world.ask(stays, "agv", "note", &mut number("n", 1)), Ok(()));
}

fn another_fleet_that_dials_is_refused_by_name(world: &mut dyn World) {
    let (manager, _agv, mut bystander) = three(world, &Service::numbered("note"));
    world.fault(Fault::UnknownClient(&manager, UnknownClient::OtherFleet));
    let refused = Seen::NotJoined(CloseReason::Refused(Refusal::Fleet));
    world.wait("this side shows it", || manager.count(|event| *event == refused) == 1, secs(20));
    assert_eq!(manager.node_counted(NodeCounter::RefusedFleet), 1);
    bystander.continues(world, &manager);
}

fn garbage_on_every_port_harms_nobody(world: &mut dyn World) {
    let (manager, agv, mut bystander) = three(world, &Service::numbered("note"));
    bystander.continues(world, &manager);
    world.fault(Fault::UnknownClient(&manager, UnknownClient::Garbage));
    bystander.continues(world, &manager);
    let counted = || manager.node_counted(NodeCounter::DatagramMagic) > 0;
    world.wait("datagrams are counted", counted, secs(20));
    let typed = |event: &Seen| {
        matches!(event, Seen::NotJoined(CloseReason::Refused(_) | CloseReason::Oversize | CloseReason::Protocol))
    };
    world.wait("streams end with a reason", || manager.count(typed) > 0, secs(20));
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
    assert!(agv.is_connected("manager") && manager.number_of_s_units() == 2);
    assert_eq!(manager.count(|event| matches!(event, Seen::Left(..))), 0);
}

fn a_peer_that_closes_in_mid_chunk_harms_nobody_else(world: &mut dyn World) {
    let (manager, _agv, mut bystander) = three(world, &Service::numbered("note"));
    for visit in 1..=3 {
        world.fault(Fault::UnknownClient(&manager, UnknownClient::ClosesInMidChunk));
        let left = |event: &Seen| matches!(event, Seen::Left(peer, CloseReason::Reset) if peer.name() == "stranger");
        world.wait("it has left", || manager.count(left) == visit, secs(20));
        bystander.continues(world, &manager);
    }
    world.reached("left");
    world.wait("both count", || manager.number_of_s_units() == 2, secs(10));
}

/// A client opens connections and stays silent; a node joins meanwhile.
fn a_thousand_silent_connections_keep_nobody_out(world: &mut dyn World) {
    // With room for fewer links than there are unknown clients.
    let manager = world.add(Spec::manager("manager", 1).limits(|limits| limits.maximum_nodes = 64));
    let service = Service::numbered("note");
    let agv = world.add(Spec::agv("agv", 7).service(&service));
    met(world, &manager, "agv", "note");
    let mut bystander = Bystander::add(world, &manager);
    let newcomer = world.add(Spec::agv("newcomer", 8).service(&service));
    met(world, &manager, "newcomer", "note");
    newcomer.stop();
    world.wait("it has left", || !manager.is_connected("newcomer"), secs(20));
    world.fault(Fault::UnknownClient(&manager, UnknownClient::Silent(1_000)));
    newcomer.start();
    for _ in 0..10 {
        bystander.continues(world, &manager);
        world.run_for(millis(20));
    }
    met(world, &manager, "newcomer", "note");
    assert_eq!(world.ask(&manager, "newcomer", "note", &mut number("n", 1)), Ok(()));
    assert!(manager.node_counted(NodeCounter::GaveWay) > 0, "{}", world.story());
    let silent = |event: &Seen| *event == Seen::NotJoined(CloseReason::HelloTimeout);
    world.wait("all are shown out", || manager.count(silent) == 1_000, secs(20));
    assert!(agv.is_connected("manager"));
    assert_eq!(manager.count(|event| matches!(event, Seen::Left(..))), 1, "only the newcomer, before");
}

fn a_reader_of_one_byte_a_second_harms_nobody_else(world: &mut dyn World) {
    let (manager, agv, mut bystander) = three(world, &Service::new("store(text: string[900])"));
    world.fault(Fault::SlowReader(&manager, &agv, 1));
    let (mut accepted, mut full) = (0_usize, None);
    // What the kernels on the way keep comes first.
    for round in 0..4_000 {
        match manager.request("agv", "store", &text(900)) {
            Ok(_) => accepted += 1,
            Err(error) => {
                full = Some(error);
                break;
            }
        }
        if round % 10 == 0 {
            bystander.continues(world, &manager);
        }
    }
    assert!(matches!(full, Some(Error::Full(Limit::SendQueue))), "{full:?} after {accepted}");
    assert!(manager.counted(LinkCounter::SendRefused) > 0);
    let options = RequestOptions { timeout: Some(millis(500)), ..RequestOptions::default() };
    let asked = world.ask_with(&manager, "agv", "store", &mut text(900), options);
    assert!(matches!(asked, Err(Error::TimedOut | Error::Full(Limit::SendQueue))), "{asked:?}");
    for _ in 0..20 {
        bystander.continues(world, &manager);
    }
}

fn a_unit_without_an_interface_finds_its_manager_when_it_has_one(world: &mut dyn World) {
    let (manager, agv, mut bystander) = three(world, &Service::numbered("note"));
    world.fault(Fault::Unplug(&agv));
    world.wait("it is told", || agv.count(|event| *event == Seen::InterfaceChanged(false)) == 1, secs(1));
    let lost = |unit: &Unit| unit.count(|event| matches!(event, Seen::Left(..)));
    world.wait("both sides see it", || lost(&agv) == 1 && lost(&manager) == 1, secs(30));
    // Pauses between searches grow meanwhile.
    for _ in 0..10 {
        world.run_for(secs(6));
        bystander.continues(world, &manager);
    }
    assert!(agv.node_counted(NodeCounter::SendFailed) > 0);
    world.reached("unplugged");
    world.fault(Fault::Plug(&agv));
    let back = world.now();
    met(world, &manager, "agv", "note");
    assert!(world.now().since(back) < secs(2), "it searches as soon as it can");
    assert_eq!(agv.count(|event| *event == Seen::InterfaceChanged(true)), 1);
    assert_eq!(world.ask(&manager, "agv", "note", &mut number("n", 1)), Ok(()));
}
