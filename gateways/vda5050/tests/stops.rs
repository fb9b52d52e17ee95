//! What makes a vehicle stand, and when that is said.

mod fake;

use std::time::Duration;

use cara_vda5050::machine::Machine;
use cara_vda5050::message::{ActionStatus, InstantActions};
use cara_vda5050::state::{Command, Failure, OnBrokerLoss, Policy, Record};
use fake::{Pair, instant, order, policy};

/// Drives an order's first edge; the vehicle has not said yet that it moves.
fn just_told() -> Pair {
    let mut pair = Pair::new("a");
    pair.vehicle.ramp = 2;
    pair.machine.order(order("o1", 0, 0, "a! b! c!"));
    pair.tell();
    assert!(pair.vehicle.status.is_driving);
    pair
}

fn at_once(kind: &str, id: &str, header_id: u32) -> InstantActions {
    let mut message = instant(kind, id);
    message.header.header_id = header_id;
    message
}

#[test]
fn a_stop_right_behind_a_drive_ends_when_the_vehicle_stands() {
    for kind in ["startPause", "cancelOrder"] {
        let mut pair = just_told();
        pair.machine.instant_actions(instant(kind, "i1"));
        // The vehicle is told to stop, and brakes.
        pair.begin_turn();
        assert!(
            pair.vehicle.status.is_driving && pair.actions().contains(&"i1 RUNNING".into()),
            "{:?}",
            pair.actions()
        );
        assert!(!pair.left().is_empty());
        let status = pair.vehicle.status.clone();
        pair.machine.status(status);
        assert!(pair.actions().contains(&"i1 RUNNING".into()), "{kind}: {:?}", pair.actions());
        pair.turns(3);
        assert!(pair.actions().contains(&"i1 FINISHED".into()), "{kind}: {:?}", pair.actions());
        assert_eq!(pair.left().is_empty(), kind == "cancelOrder");
    }
}

#[test]
fn a_pause_stops_the_vehicle_and_keeps_the_order() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a! b! c!"));
    pair.turn();
    pair.machine.instant_actions(instant("startPause", "p1"));
    assert_eq!(pair.actions(), ["p1 RUNNING"], "it still drives");
    pair.turns(5);
    assert_eq!(pair.actions(), ["p1 FINISHED"]);
    let report = pair.machine.report().unwrap();
    assert_eq!((report.paused, report.driving, pair.left().as_str()), (Some(true), false, "ab! b! bc! c!"));
    pair.machine.instant_actions(instant("stopPause", "p2"));
    pair.turns(10);
    assert_eq!((pair.left().as_str(), pair.vehicle.reached.len()), ("", 2));
}

/// Started again, the gateway waits for its broker, and needs no stopPause.
#[test]
fn before_the_first_connection_nothing_was_stopped() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a! b!"));
    let policy = Policy { on_broker_loss: OnBrokerLoss::Stop, ..policy() };
    pair.machine = Machine::new(pair.machine.record().clone(), policy, pair.now);
    pair.machine.status(pair.vehicle.status.clone());
    pair.turns(5);
    assert_eq!((pair.vehicle.reached.len(), pair.machine.record().is_paused), (0, false));
    pair.machine.broker(true, pair.now);
    pair.turns(5);
    assert_eq!(pair.left(), "");
}

/// A pause after a refusal is for what is tried again.
#[test]
fn the_end_of_an_action_waits_for_no_pause_after_a_refusal() {
    let mut pair = Pair::new("a");
    pair.vehicle.steps = 100;
    pair.machine.order(order("o1", 0, 0, "a!:beep b!"));
    let mut is_refused = false;
    while let Some(command) = pair.machine.next(pair.now) {
        is_refused |= matches!(command, Command::Drive { .. });
        let answer = match command {
            Command::Drive { .. } => Err(Failure::Refused("not now".into())),
            _ => pair.vehicle.command(&command),
        };
        pair.machine.answered(&command, answer, pair.now);
    }
    assert!(is_refused);
    pair.machine.status(pair.vehicle.status.clone());
    pair.machine.instant_actions(instant("cancelOrder", "c1"));
    assert_eq!(pair.machine.next(pair.now), Some(Command::EndAction { number: 1 }));
}

#[test]
fn a_drive_that_is_refused_is_in_the_state_until_it_is_taken() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a! b!"));
    let errors = |pair: &Pair| pair.machine.report().unwrap().errors;
    for _ in 0..20 {
        pair.now += Duration::from_millis(100);
        while let Some(command) = pair.machine.next(pair.now) {
            let is_drive = matches!(command, Command::Drive { .. });
            let answer = if is_drive { Err(Failure::Refused("no way there".into())) } else { Ok(()) };
            pair.machine.answered(&command, answer, pair.now);
        }
        pair.machine.status(pair.vehicle.status.clone());
    }
    let shown = errors(&pair);
    assert_eq!((shown.len(), shown[0].error_type.as_str()), (1, "driveRefused"));
    assert_eq!(shown[0].error_description.as_deref(), Some("no way there"));
    assert_eq!(pair.machine.record().errors, [], "it is not kept: it is told again after a restart");
    pair.turns(10);
    assert!(errors(&pair).is_empty() && pair.left().is_empty());
}

/// Some masters number actions of orders and those at once each from 1, or use one id for each pause.
#[test]
fn no_id_refuses_a_stop() {
    let long = "i".repeat(65);
    let mut pair = just_told();
    pair.turn();
    let beep = order("o1", 1, 4, "c! d!:beep");
    let used = beep.nodes[1].actions[0].action_id.clone();
    pair.machine.order(beep);
    for (kind, id, header_id) in [("startPause", used.as_str(), 10), ("startPause", "p", 12), ("startPause", &long, 14)]
    {
        pair.machine.instant_actions(at_once(kind, id, header_id));
        assert!(pair.machine.record().is_paused, "{id}");
        pair.turns(3);
        assert!(!pair.vehicle.status.is_driving, "{id}");
        // The same id for the end of the pause, as one of a button.
        pair.machine.instant_actions(at_once("stopPause", "p", header_id + 1));
        pair.turn();
        assert!(!pair.machine.record().is_paused, "{id}: {:?}", pair.errors());
        // A late copy of the stop does nothing.
        pair.machine.instant_actions(at_once(kind, id, header_id));
        assert!(!pair.machine.record().is_paused, "{id}");
    }
    assert!(pair.errors().contains(&"validationError"), "the fault of numbering is told");
    pair.machine.instant_actions(at_once("cancelOrder", "p", 20));
    pair.turns(3);
    assert!(pair.left().is_empty() && !pair.vehicle.status.is_driving);
}

/// A pause, its end, and the same pause again before the vehicle stands.
#[test]
fn a_pause_counts_again_before_the_last_one_has_ended() {
    let mut pair = just_told();
    pair.turn();
    pair.machine.instant_actions(at_once("startPause", "p", 10));
    pair.begin_turn();
    pair.machine.instant_actions(at_once("stopPause", "q", 11));
    assert!(!pair.machine.record().is_paused);
    pair.machine.instant_actions(at_once("startPause", "p", 12));
    assert!(pair.machine.record().is_paused);
    pair.turns(4);
    assert!(!pair.vehicle.status.is_driving && pair.actions().contains(&"p FINISHED".into()), "{:?}", pair.actions());
}

/// However many stops wait for the vehicle to stand, the next one stops.
#[test]
fn no_number_of_stops_refuses_a_stop() {
    let mut pair = just_told();
    pair.turn();
    pair.vehicle.ramp = 1_000;
    (0..200).for_each(|index| pair.machine.instant_actions(at_once("startPause", &format!("p{index}"), 10 + index)));
    pair.turn();
    assert!(!pair.machine.record().is_cancelled);
    pair.machine.instant_actions(at_once("cancelOrder", "c1", 999));
    assert!(pair.machine.record().is_cancelled);
    assert!(pair.machine.record().actions.len() < 200);
}

/// The limit counts from where the vehicle was when the broker went, or from its first word after that.
#[test]
fn the_way_without_a_broker_counts_from_where_the_vehicle_is_heard() {
    let mut pair = Pair::new("a");
    pair.vehicle.status.driven = 5_000.0;
    pair.machine.order(order("o1", 0, 0, "a! b!"));
    pair.machine.vehicle_lost();
    pair.machine.broker(false, pair.now);
    assert_eq!(pair.machine.next(pair.now), None);
    pair.turns(8);
    assert!(pair.left().is_empty() && !pair.machine.record().is_paused, "{:?}", pair.errors());

    let record = Record { order_id: "o1".into(), ..pair.machine.record().clone() };
    let mut machine = Machine::new(record, policy(), Duration::ZERO);
    assert_eq!(machine.next(Duration::ZERO), None);
    machine.status(pair.vehicle.status.clone());
    assert_eq!(machine.next(Duration::ZERO), None);
    machine.order(order("o2", 0, 0, "b! c!"));
    assert!(matches!(machine.next(Duration::ZERO), Some(Command::Drive { .. })), "{:?}", machine.record().errors);
    // And it does count.
    let mut far = pair.vehicle.status.clone();
    (far.is_ordered, far.is_driving) = (true, true);
    far.driven += 100.5;
    machine.status(far);
    assert_eq!(machine.next(Duration::ZERO), Some(Command::Halt));
}

/// One that runs is given up with the order.
#[test]
fn what_is_given_up_is_told_once() {
    let mut pair = Pair::new("a");
    pair.vehicle.steps = 100;
    pair.machine.order(order("o1", 0, 0, "a!:pick=HARD b!"));
    pair.turns(2);
    pair.machine.instant_actions(instant("cancelOrder", "c1"));
    let stop = pair.machine.next_stop(pair.now).unwrap();
    assert!(stop.is_stop() && pair.machine.next_stop(pair.now).is_none());
    // It did not get there: it is told again.
    pair.machine.answered(&stop, Err(Failure::Lost("no place".into())), pair.now);
    assert_eq!(pair.machine.next_stop(pair.now), Some(stop.clone()));
    let answer = pair.vehicle.command(&stop);
    pair.machine.answered(&stop, answer, pair.now);
    assert_eq!(pair.machine.next_stop(pair.now), None);
    pair.turns(2);
    let is_failed = pair.machine.record().actions.iter().any(|entry| entry.status == ActionStatus::Failed);
    assert!(is_failed && pair.actions().contains(&"c1 FINISHED".into()), "{:?}", pair.actions());
}
