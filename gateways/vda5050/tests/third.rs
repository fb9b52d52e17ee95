//! What 3.0 has otherwise than 2.x: errors by name and level, lists of actions, and a few rules. Clauses are those of 3.0.

mod fake;

use std::collections::BTreeMap;

use cara_vda5050::errors::Kind;
use cara_vda5050::message::ErrorLevel::{Critical, Fatal, Urgent, Warning};
use cara_vda5050::message::{
    ActionParameter, BlockingType, Deviation, EStop, Edge, ErrorLevel, InstantActions, NodePosition, OperatingMode,
    Reference, State, write,
};
use cara_vda5050::state::Command;
use cara_vda5050::version::Version;
use fake::{Fake, Pair, header, instant, order};
use serde_json::Value;

/// The document's table of errors (6.6.5.4).
const PREDEFINED: [(&str, ErrorLevel); 22] = [
    ("UNSUPPORTED_PARAMETER", Critical),
    ("NO_ORDER_TO_CANCEL", Warning),
    ("VALIDATION_FAILURE", Warning),
    ("INVALID_ORDER_ACTION", Warning),
    ("INVALID_INSTANT_ACTION", Warning),
    ("OUTDATED_ORDER_UPDATE", Warning),
    ("SAME_ORDER_UPDATE_ID", Warning),
    ("ORDER_UPDATE_FOLLOWING_CANCEL", Warning),
    ("OUTSIDE_OF_CORRIDOR", Critical),
    ("INSUFFICIENT_MEMORY", Urgent),
    ("DUPLICATE_MAP", Warning),
    ("BLOCKED_ZONE_VIOLATION", Critical),
    ("DUPLICATE_ZONE_SET", Warning),
    ("RELEASE_LOST", Critical),
    ("ZONE_ACTION_CONFLICT", Critical),
    ("NODE_UNREACHABLE", Critical),
    ("LOCALIZATION_ERROR", Fatal),
    ("NO_ROUTE_TO_TARGET", Warning),
    ("OTHER_ORDER_ACTIVE", Warning),
    ("START_NODE_OUT_OF_RANGE", Warning),
    ("MOBILE_ROBOT_NOT_AVAILABLE", Warning),
    ("UNKNOWN_MAP_ID", Warning),
];
/// Names that the table lacks: the first is in the list of 7.8, the others are the gateway's.
const OWN: [(&str, ErrorLevel); 7] = [
    ("INVALID_ORDER", Warning),
    ("ACTION_ERROR", Urgent),
    ("VEHICLE_STOPPED", Fatal),
    ("CERTIFICATE_EXPIRES", Warning),
    ("OUT_OF_SERVICE", Fatal),
    ("BROKER_LOST", Urgent),
    ("DRIVE_REFUSED", Urgent),
];

#[test]
fn errors_have_the_names_and_levels_of_their_version() {
    let third: BTreeMap<&str, ErrorLevel> = PREDEFINED.into_iter().chain(OWN).collect();
    let second = [
        ("validationError", Warning),
        ("orderError", Warning),
        ("orderUpdateError", Warning),
        ("noOrderToCancel", Warning),
        ("actionError", Warning),
        ("vehicleStopped", Fatal),
        ("certificateExpires", Warning),
        ("outOfService", Fatal),
        ("brokerLost", Warning),
        ("driveRefused", Warning),
    ];
    let second: BTreeMap<&str, ErrorLevel> = second.into_iter().collect();
    for kind in Kind::all() {
        for (version, names) in [(Version::V2, &second), (Version::V3, &third)] {
            let (name, level) = (kind.name(version), kind.level(version));
            assert_eq!(names.get(name), Some(&level), "{kind:?} {version:?}: {name}");
        }
    }
    assert!(OWN.iter().all(|(name, _)| Kind::all().any(|kind| kind.name(Version::V3) == *name)));
}

/// As it is sent.
fn state(pair: &Pair) -> Value {
    let report = pair.machine.report().unwrap();
    serde_json::from_slice(&write(Version::V3, &State { header: header("3.0.0"), report })).unwrap()
}

fn ids(list: &Value) -> Vec<&str> {
    list.as_array().unwrap().iter().map(|action| action["actionId"].as_str().unwrap()).collect()
}

#[test]
fn actions_at_once_stay_in_their_list_until_they_are_cleared() {
    let mut pair = Pair::of("a", Version::V3);
    pair.machine.order(order("o1", 0, 0, "a!:beep b!"));
    pair.machine.instant_actions(instant("beep", "i1"));
    pair.turns(20);
    pair.machine.order(order("o2", 0, 0, "b!:beep a!"));
    pair.turns(20);
    let sent = state(&pair);
    assert_eq!((ids(&sent["actionStates"]), ids(&sent["instantActionStates"])), (vec!["o2-b0n-beep"], vec!["i1"]));
    // A copy does nothing, neither before it is cleared nor behind that.
    pair.machine.instant_actions(instant("beep", "i1"));
    pair.machine.instant_actions(instant("clearInstantActions", "i2"));
    let sent = state(&pair);
    assert_eq!((ids(&sent["actionStates"]), ids(&sent["instantActionStates"])), (vec!["o2-b0n-beep"], vec!["i2"]));
    assert_eq!(sent["instantActionStates"][0]["actionStatus"], "FINISHED");
    pair.machine.instant_actions(instant("beep", "i1"));
    pair.turns(5);
    assert_eq!(pair.vehicle.began, ["o1-a0n-beep", "i1", "o2-b0n-beep"]);
    // What runs stays.
    pair.machine.instant_actions(instant("beep", "i3"));
    pair.tell();
    pair.machine.instant_actions(instant("clearInstantActions", "i4"));
    assert_eq!(ids(&state(&pair)["instantActionStates"]), ["i3", "i4"]);
    // An order whose action has the id of one that is listed is refused.
    pair.turns(5);
    let mut twice = order("o3", 0, 0, "a!:beep b!");
    twice.nodes[0].actions[0].action_id = "i3".into();
    pair.machine.order(twice);
    assert_eq!(pair.errors(), ["VALIDATION_FAILURE"]);
    // In 2.x there is no such action, and one list.
    let mut pair = Pair::new("a");
    pair.machine.instant_actions(instant("clearInstantActions", "i1"));
    assert_eq!((pair.errors(), pair.actions()), (vec!["orderError"], vec!["i1 FAILED".to_owned()]));
    assert_eq!(pair.machine.report().unwrap().instant_action_states, None);
}

fn cancel(order: &str, id: &str) -> InstantActions {
    let mut message = instant("cancelOrder", id);
    let parameter = ActionParameter { key: "orderId".into(), value: order.into() };
    message.actions[0].action_parameters = Some(vec![parameter]);
    message
}

#[test]
fn no_update_goes_on_from_a_node_that_was_forgotten() {
    let mut pair = Pair::of("a", Version::V3);
    pair.machine.order(order("o1", 0, 0, "a!"));
    for mode in [OperatingMode::Service, OperatingMode::Automatic] {
        pair.vehicle.status.mode = mode;
        pair.turn();
    }
    let mut update = order("o1", 1, 0, "a! b!");
    update.nodes[0].node_id.clear();
    update.edges[0].start_node_id.clear();
    pair.machine.order(update);
    assert_eq!((pair.machine.record().order_update_id, pair.left()), (0, String::new()), "{:?}", pair.errors());
}

#[test]
fn an_order_is_cancelled_by_its_name() {
    let mut pair = Pair::of("a", Version::V3);
    pair.machine.order(order("o1", 0, 0, "a! b! c!"));
    pair.turn();
    pair.machine.instant_actions(cancel("o2", "i1"));
    pair.turn();
    assert_eq!((pair.errors(), pair.left().is_empty()), (vec!["NO_ORDER_TO_CANCEL"], false));
    pair.machine.instant_actions(cancel("o1", "i2"));
    pair.turns(3);
    assert_eq!((pair.actions(), pair.left().as_str()), (vec!["i1 FAILED".into(), "i2 FINISHED".into()], ""));
}

/// Long from a to c, and narrow across (6.6.2.1).
#[test]
fn a_node_is_reached_within_its_ellipse() {
    let turned = std::f64::consts::FRAC_PI_2;
    for (a, b, theta, is_taken) in
        [(3.0, 0.1, 0.0, true), (3.0, 0.1, turned, false), (0.1, 3.0, turned, true), (1.9, 1.9, 0.0, false)]
    {
        let mut pair = Pair::of("a", Version::V3);
        let mut far = order("o1", 0, 0, "b! c!");
        let ellipse = Some(Deviation::Ellipse { a, b, theta });
        let at = NodePosition { x: 2.0, map_id: "hall".into(), allowed_deviation_xy: ellipse, ..Default::default() };
        far.nodes[0].node_position = Some(at.clone());
        far.nodes[1].node_position = Some(NodePosition { x: 4.0, ..at });
        pair.machine.order(far);
        assert_eq!(pair.errors().is_empty(), is_taken, "{a} {b} {theta}: {:?}", pair.errors());
        if is_taken {
            // The state of 3.0 has no deviations, and the vehicle keeps to the narrow side.
            assert_eq!(state(&pair)["nodeStates"][0]["nodePosition"].get("allowedDeviationXY"), None);
            let Some(Command::Drive { legs, .. }) = pair.machine.next(pair.now) else { panic!("it does not drive") };
            assert_eq!(legs[0].1.node_position.as_ref().unwrap().allowed_deviation_xy.unwrap().radius(), 0.1);
        }
    }
}

#[test]
fn what_is_offered_and_not_there_is_refused() {
    // (what is sent, the error, a member in its references)
    type Change = fn(&mut Edge);
    let edges: [(Change, &str); 3] = [
        (|edge| edge.reach_orientation_before_entering = Some(true), "reachOrientationBeforeEntering"),
        (|edge| edge.max_height = Some(2.0), "maximumMobileRobotHeight"),
        (|edge| edge.corridor = Some(Default::default()), "corridor"),
    ];
    for (change, member) in edges {
        let mut pair = Pair::of("a", Version::V3);
        let mut sent = order("o1", 0, 0, "a! b!");
        change(&mut sent.edges[0]);
        pair.machine.order(sent);
        let sent = state(&pair);
        let (error, has) = (&sent["errors"][0], |of: &Value| of["referenceKey"] == member);
        assert_eq!((&error["errorType"], &error["errorLevel"]), (&"UNSUPPORTED_PARAMETER".into(), &"CRITICAL".into()));
        assert!(error["errorReferences"].as_array().unwrap().iter().any(has), "{error}");
    }
    let mut pair = Pair::of("a", Version::V3);
    let mut again = order("o1", 0, 0, "a!:pick b!");
    again.nodes[0].actions[0].retriable = Some(true);
    pair.machine.order(again);
    assert_eq!(pair.errors(), ["UNSUPPORTED_PARAMETER"]);
    for kind in
        ["startHibernation", "shutdown", "retry", "trigger", "downloadZoneSet", "updateCertificate", "logReport"]
    {
        let mut pair = Pair::of("a", Version::V3);
        pair.machine.instant_actions(instant(kind, "i1"));
        assert_eq!((pair.errors(), pair.actions()), (vec!["INVALID_INSTANT_ACTION"], vec!["i1 FAILED".to_owned()]));
        // Until an action at once is taken, whatever order comes (6.6.5.4).
        pair.machine.order(order("o1", 0, 0, "a! b!"));
        pair.machine.order(order("o1", 1, 2, "b! c!"));
        assert_eq!((pair.errors(), pair.left().contains("c!")), (vec!["INVALID_INSTANT_ACTION"], true), "{kind}");
        let mut both = instant("stateRequest", "i2");
        both.actions.extend(instant(kind, "i3").actions);
        pair.machine.instant_actions(both);
        let errors = &pair.machine.record().errors;
        let of_i3 = |of: &Reference| of.reference_key == "actionId" && of.reference_value == "i3";
        assert!(errors.len() == 1 && errors[0].error_references.iter().flatten().any(of_i3), "{kind}: {errors:?}");
        pair.machine.instant_actions(instant("stateRequest", "i4"));
        assert!(pair.errors().is_empty(), "{kind}");
    }
    // An action at once blocks nothing (6.2.1), but what stops the vehicle does so however it comes.
    for (kind, status) in [("beep", "FAILED"), ("startPause", "FINISHED")] {
        let mut pair = Pair::of("a", Version::V3);
        let mut hard = instant(kind, "i1");
        hard.actions[0].blocking_type = BlockingType::Hard;
        pair.machine.instant_actions(hard);
        pair.turn();
        assert_eq!(pair.actions(), [format!("i1 {status}")]);
    }
}

#[test]
fn modes_change_what_is_reported() {
    let mode = |pair: &mut Pair, mode: OperatingMode| {
        pair.vehicle.status.mode = mode;
        pair.machine.status(pair.vehicle.status.clone());
    };
    let mut pair = Pair::of("a", Version::V3);
    pair.machine.order(order("o1", 0, 0, "a! b!"));
    pair.turns(10);
    mode(&mut pair, OperatingMode::Manual);
    assert_eq!(state(&pair)["lastNodeId"], "b");
    pair.machine.order(order("o2", 0, 0, "b! a!"));
    assert_eq!(pair.errors(), ["MOBILE_ROBOT_NOT_AVAILABLE"]);
    mode(&mut pair, OperatingMode::Teachin);
    let sent = state(&pair);
    assert_eq!((&sent["operatingMode"], &sent["lastNodeId"]), (&"TEACH_IN".into(), &"".into()));
    mode(&mut pair, OperatingMode::Automatic);
    assert!(pair.errors().is_empty() && state(&pair)["lastNodeId"] == "", "until the mode allows orders");
    pair.vehicle.status.e_stop = EStop::AutoAck;
    pair.machine.status(pair.vehicle.status.clone());
    let safety = state(&pair)["safetyState"].clone();
    assert_eq!(safety, serde_json::json!({"activeEmergencyStop": "NONE", "fieldViolation": true}));
}

/// It runs beside driving, and beside nothing else (6.2.2).
#[test]
fn a_single_action_does_not_stop_the_vehicle() {
    let mut pair = Pair::of("a", Version::V3);
    pair.machine.order(order("o1", 0, 0, "a!:beep=SINGLE b!:pick=SINGLE c!"));
    pair.tell();
    assert_eq!((pair.vehicle.began.len(), pair.vehicle.status.is_driving), (1, true));
    pair.turns(20);
    assert_eq!((pair.left().as_str(), pair.vehicle.reached.len(), pair.vehicle.began.len()), ("", 2, 2));
}

/// A record outlives a change of the version: an order with a circle and one with an ellipse are reported as the version has it.
#[test]
fn a_record_of_another_version_is_read() {
    let mut pair = Pair::new("a");
    let mut sent = order("o1", 0, 0, "a! b! c");
    let deviations = [Deviation::Radius(0.5), Deviation::Ellipse { a: 1.0, b: 0.5, theta: 0.1 }];
    for (node, deviation) in sent.nodes[1..].iter_mut().zip(deviations) {
        node.node_position.as_mut().unwrap().allowed_deviation_xy = Some(deviation);
    }
    pair.machine.order(sent.clone());
    pair.machine.order(order("o2", 0, 0, "a!"));
    assert_eq!(pair.errors(), ["orderError"]);
    let mut text = serde_json::to_value(pair.machine.record()).unwrap();
    text.as_object_mut().unwrap().remove("content");
    let reported = pair.machine.report().unwrap().node_states;
    let deviation = |index: usize| reported[index].node_position.as_ref().unwrap().allowed_deviation_xy.unwrap();
    assert_eq!([deviation(0), deviation(1)], [Deviation::Radius(0.5); 2]);
    let record = serde_json::from_value(text).unwrap();
    let policy = cara_vda5050::state::Policy { version: Version::V3, ..fake::policy() };
    pair.machine = cara_vda5050::machine::Machine::new(record, policy, pair.now);
    pair.machine.broker(true, pair.now);
    pair.machine.status(Fake::at("a").status);
    // Its content is not known: it is not compared.
    pair.machine.order(order("o1", 0, 0, "a! b! d"));
    assert_eq!(pair.errors(), ["orderError"]);
    pair.machine.order(order("o1", 1, 2, "b! c!"));
    assert!(pair.errors().is_empty());
    pair.machine.order(order("o1", 1, 2, "b! d!"));
    assert_eq!(pair.errors(), ["SAME_ORDER_UPDATE_ID"]);
}

/// In both versions: neither an order nor what stops it fails for actions at once that have ended.
#[test]
fn what_has_ended_takes_no_place() {
    for version in [Version::V2, Version::V3] {
        let mut pair = Pair::of("a", version);
        let ask = |pair: &mut Pair, from: u32| {
            (from..from + 80)
                .for_each(|number| pair.machine.instant_actions(instant("stateRequest", &format!("s{number}"))));
        };
        ask(&mut pair, 0);
        // As many actions as the vehicle holds.
        let all = ["beep"; 20].join(",");
        let mut full = order("o1", 0, 0, &format!("a! b! c!:{all}"));
        let actions = full.nodes[2].actions.iter_mut();
        actions.enumerate().for_each(|(number, action)| action.action_id = format!("b{number}"));
        pair.machine.order(full);
        assert_eq!(pair.errors(), Vec::<&str>::new(), "{version:?}");
        ask(&mut pair, 100);
        pair.machine.instant_actions(instant("startPause", "p1"));
        pair.machine.instant_actions(instant("cancelOrder", "c1"));
        pair.turns(10);
        assert_eq!(pair.errors(), Vec::<&str>::new(), "{version:?}");
        let report = pair.machine.report().unwrap();
        assert_eq!((report.paused, pair.left().as_str()), (Some(true), ""), "{version:?}");
    }
}
