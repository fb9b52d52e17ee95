//! The order handling of the standard (2.0 and 2.1: 6.6, 6.8 to 6.12; 3.0: 6.1), box by box.

mod fake;

use std::time::Duration;

use cara_vda5050::errors::Kind;
use cara_vda5050::message::{
    ActionScope, BlockingType, Corridor, Deviation, EStop, Edge, NodePosition, OperatingMode, Order, Trajectory,
};
use cara_vda5050::state::{Command, Failure, OnBrokerLoss, Policy};
use cara_vda5050::version::Version;
use fake::{Fake, Pair, instant, order, policy};

const VERSIONS: [&str; 3] = ["2.0.0", "2.1.0", "3.0.0"];

/// A way of preparing, what comes then, and what is reported in 2.x and in 3.0.
type Row = (&'static str, fn(&mut Pair), Order, [Option<Kind>; 2]);

const TAKEN: [Option<Kind>; 2] = [None, None];

const fn refused(kind: Kind) -> [Option<Kind>; 2] {
    [Some(kind), Some(kind)]
}

fn nothing(_: &mut Pair) {}

/// Drives a, b; c is the horizon.
fn half_way(pair: &mut Pair) {
    pair.machine.order(order("o1", 0, 0, "a! b! c"));
    pair.turns(10);
    assert_eq!(pair.left(), "bc c");
}

/// Has driven all of a, b.
fn done(pair: &mut Pair) {
    pair.machine.order(order("o1", 0, 0, "a!"));
    pair.machine.order(order("o1", 3, 0, "a! b!"));
    pair.turns(10);
    assert_eq!(pair.left(), "");
}

fn cancelled(pair: &mut Pair) {
    half_way(pair);
    pair.machine.instant_actions(instant("cancelOrder", "c1"));
    pair.turns(5);
    assert_eq!(pair.left(), "");
}

fn replaced(pair: &mut Pair) {
    done(pair);
    pair.machine.order(order("o2", 0, 0, "b! a!"));
    pair.turns(10);
}

fn changed(change: impl FnOnce(&mut Order)) -> Order {
    let mut order = order("o1", 0, 0, "a! b! c");
    change(&mut order);
    order
}

fn edge(change: impl FnOnce(&mut Edge)) -> Order {
    changed(|order| change(&mut order.edges[0]))
}

#[test]
fn each_box_of_the_order_handling() {
    let rows: Vec<Row> = vec![
        // Box 1: validity.
        (
            "no node",
            nothing,
            changed(|order| {
                order.nodes.clear();
                order.edges.clear();
            }),
            refused(Kind::Validation),
        ),
        (
            "an edge too few",
            nothing,
            changed(|order| {
                order.edges.pop();
            }),
            refused(Kind::Validation),
        ),
        ("a gap of sequence ids", nothing, changed(|order| order.nodes[1].sequence_id = 4), refused(Kind::Validation)),
        ("an edge's sequence id", nothing, changed(|order| order.edges[0].sequence_id = 2), refused(Kind::Validation)),
        (
            "the highest sequence id",
            nothing,
            changed(|order| order.nodes[0].sequence_id = u32::MAX),
            refused(Kind::Validation),
        ),
        (
            "an edge from elsewhere",
            nothing,
            changed(|order| order.edges[0].start_node_id = "x".into()),
            refused(Kind::Validation),
        ),
        (
            "an edge to elsewhere",
            nothing,
            changed(|order| order.edges[1].end_node_id = "x".into()),
            refused(Kind::Validation),
        ),
        ("no base", nothing, order("o1", 0, 0, "a b c"), refused(Kind::Validation)),
        ("a base behind the horizon", nothing, order("o1", 0, 0, "a! b c!"), refused(Kind::Validation)),
        (
            "an edge ahead of its node",
            nothing,
            changed(|order| order.edges[1].released = true),
            refused(Kind::Validation),
        ),
        (
            "an action id twice",
            nothing,
            changed(|order| {
                order.nodes = fake::order("o1", 0, 0, "a!:pick b!:pick c").nodes;
                order.nodes[1].actions[0].action_id = order.nodes[0].actions[0].action_id.clone();
            }),
            refused(Kind::Validation),
        ),
        ("one node", nothing, order("o1", 0, 0, "a!"), TAKEN),
        // What the vehicle cannot do (6.6.4.2).
        ("an action that it does not have", nothing, order("o1", 0, 0, "a!:dance b!"), refused(Kind::OrderAction)),
        (
            "an id that is too long",
            nothing,
            changed(|order| order.edges[0].edge_id = "e".repeat(65)),
            refused(Kind::Text),
        ),
        ("no position", nothing, changed(|order| order.nodes[1].node_position = None), refused(Kind::NoWay)),
        (
            "a trajectory",
            nothing,
            edge(|edge| edge.trajectory = Some(Trajectory::default())),
            refused(Kind::Unsupported),
        ),
        ("a corridor", nothing, edge(|edge| edge.corridor = Some(Corridor::default())), refused(Kind::Unsupported)),
        ("an orientation", nothing, edge(|edge| edge.orientation = Some(0.0)), refused(Kind::Unsupported)),
        ("a direction", nothing, edge(|edge| edge.direction = Some("left".into())), refused(Kind::Unsupported)),
        ("a height", nothing, edge(|edge| edge.max_height = Some(2.0)), refused(Kind::Unsupported)),
        ("a least height", nothing, edge(|edge| edge.min_height = Some(2.0)), refused(Kind::Unsupported)),
        ("no rotation", nothing, edge(|edge| edge.rotation_allowed = Some(false)), refused(Kind::Unsupported)),
        ("a speed of rotation", nothing, edge(|edge| edge.max_rotation_speed = Some(1.0)), refused(Kind::Unsupported)),
        (
            "rotation, a speed, a length",
            nothing,
            edge(|edge| {
                (edge.rotation_allowed, edge.max_speed, edge.length) = (Some(true), Some(1.0), Some(2.0));
            }),
            TAKEN,
        ),
        ("a speed of nothing", nothing, edge(|edge| edge.max_speed = Some(0.0)), refused(Kind::Unsupported)),
        (
            "from the last node, after it was moved by hand",
            |pair| {
                done(pair);
                pair.vehicle.status.position = Fake::at("d").status.position;
                pair.machine.status(pair.vehicle.status.clone());
            },
            order("o2", 0, 0, "b! c!"),
            refused(Kind::OutOfRange),
        ),
        ("too many nodes", nothing, order("o1", 0, 0, &"a! ".repeat(21)), refused(Kind::Space)),
        ("too many actions", nothing, order("o1", 0, 0, &"a!:pick,beep,drop ".repeat(7)), refused(Kind::Space)),
        // Boxes 2, 3 and 4: a new order.
        ("a new order", nothing, order("o1", 0, 0, "a! b!"), TAKEN),
        ("a new order with an update", nothing, order("o1", 7, 0, "a! b!"), [None, Some(Kind::Replaced)]),
        ("while one is executed", half_way, order("o2", 0, 0, "b! c!"), refused(Kind::OtherOrder)),
        (
            "while an action runs, with no node left",
            |pair| {
                pair.machine.order(order("o1", 0, 0, "a!:pick"));
                pair.tell();
            },
            order("o2", 0, 0, "a! b!"),
            refused(Kind::OtherOrder),
        ),
        (
            "in another mode",
            |pair| {
                pair.vehicle.status.mode = OperatingMode::Manual;
                pair.machine.status(pair.vehicle.status.clone());
            },
            order("o1", 0, 0, "a! b!"),
            refused(Kind::NotAvailable),
        ),
        (
            "of a vehicle without a link",
            |pair| pair.machine.vehicle_lost(),
            order("o1", 0, 0, "a! b!"),
            refused(Kind::NotAvailable),
        ),
        ("behind one", done, order("o2", 0, 0, "b! c!"), TAKEN),
        ("far away", nothing, order("o1", 0, 0, "c! b!"), refused(Kind::OutOfRange)),
        (
            "within its deviation",
            nothing,
            changed(|order| {
                let at = NodePosition {
                    x: 1.9,
                    allowed_deviation_xy: Some(Deviation::Radius(2.0)),
                    map_id: "hall".into(),
                    ..NodePosition::default()
                };
                order.nodes[0].node_position = Some(at);
            }),
            TAKEN,
        ),
        (
            "on another map",
            nothing,
            changed(|order| {
                order.nodes[0].node_position.as_mut().unwrap().map_id = "roof".into();
            }),
            refused(Kind::OutOfRange),
        ),
        ("one that was replaced", replaced, order("o1", 9, 0, "a! b!"), refused(Kind::Replaced)),
        // Boxes 5 and 6.
        ("a lower update", done, order("o1", 2, 2, "b! c!"), refused(Kind::Outdated)),
        ("the same again", done, order("o1", 3, 0, "a! b!"), TAKEN),
        ("the same update with other content", done, order("o1", 3, 2, "b! c!"), [None, Some(Kind::SameUpdate)]),
        ("the same while it drives", half_way, order("o1", 0, 0, "a! b! c"), TAKEN),
        (
            "a lower update while it drives",
            |pair| {
                half_way(pair);
                pair.machine.order(order("o1", 2, 2, "b! c! d"));
            },
            order("o1", 1, 2, "b! c!"),
            refused(Kind::Outdated),
        ),
        // Box 7.
        ("from the decision point", half_way, order("o1", 1, 2, "b! c!"), TAKEN),
        ("with another horizon", half_way, order("o1", 1, 2, "b! d e"), TAKEN),
        ("without a horizon", half_way, order("o1", 5, 2, "b!"), TAKEN),
        ("from an earlier node", half_way, order("o1", 1, 0, "a! b! c!"), refused(Kind::NoContinuation)),
        ("from the horizon", half_way, order("o1", 1, 4, "c! d!"), refused(Kind::NoContinuation)),
        (
            "from the right node at another sequence id",
            half_way,
            order("o1", 1, 6, "b! c!"),
            refused(Kind::NoContinuation),
        ),
        (
            "with another zone set",
            half_way,
            {
                let mut update = order("o1", 1, 2, "b! c!");
                update.zone_set_id = Some("zones".into());
                update
            },
            refused(Kind::NoContinuation),
        ),
        // Box 8.
        ("from the last node", done, order("o1", 4, 2, "b! c!"), TAKEN),
        ("from another node", done, order("o1", 4, 2, "c! d!"), refused(Kind::NoContinuation)),
        // Behind cancelOrder (6.6.3.1).
        ("an update of a cancelled order", cancelled, order("o1", 1, 2, "b! c!"), refused(Kind::Cancelled)),
        ("a copy of a cancelled order", cancelled, order("o1", 0, 0, "a! b! c"), [None, Some(Kind::Cancelled)]),
        ("a new order behind a cancelled one", cancelled, order("o2", 0, 0, "b! c!"), TAKEN),
    ];
    for version in VERSIONS {
        for (name, prepare, order, expected) in &rows {
            let of = Version::of(version).unwrap();
            let mut pair = Pair::of("a", of);
            prepare(&mut pair);
            let before = pair.machine.record().clone();
            let mut order = order.clone();
            order.header.version = version.into();
            pair.machine.order(order.clone());
            let expected: Vec<&str> = expected[of as usize].iter().map(|kind| kind.name(of)).collect();
            assert_eq!(pair.errors(), expected, "{version}: {name}");
            let after = pair.machine.record();
            if let Some(error) = after.errors.first() {
                let references = error.error_references.as_ref().unwrap();
                let has = |key: &str, value: &str| {
                    references.iter().any(|of| of.reference_key == key && of.reference_value == value)
                };
                assert!(has("orderId", &order.order_id) && has("headerId", "1") && has("topic", "order"), "{name}");
                let untouched = (&after.nodes, &after.edges, &after.order_id, after.order_update_id, &after.actions);
                assert_eq!(
                    untouched,
                    (&before.nodes, &before.edges, &before.order_id, before.order_update_id, &before.actions)
                );
            }
            // The next order that is taken clears it.
            if *name == "far away" {
                pair.machine.order(fake::order("o9", 0, 0, "a! b!"));
                assert!(pair.errors().is_empty(), "{name}");
            }
        }
    }
}

#[test]
fn an_order_is_driven_node_by_node_and_not_beyond_its_base() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a! b! c! d e"));
    assert_eq!(pair.left(), "ab! b! bc! c! cd d de e");
    pair.turns(20);
    assert_eq!((pair.left().as_str(), pair.machine.record().last_node_id.as_str()), ("cd d de e", "c"));
    assert!(pair.machine.report().unwrap().new_base_request == Some(true));
    pair.machine.order(order("o1", 1, 4, "c! x! y"));
    assert_eq!(pair.left(), "cx! x! xy y");
    pair.turns(20);
    let reached: Vec<&str> = pair.vehicle.reached.iter().map(|(node, _)| node.as_str()).collect();
    assert_eq!(reached, ["b", "c", "x"]);
}

#[test]
fn blocking_types_decide_what_runs_beside_what() {
    // The way, and what the log of the vehicle is: nodes and actions as they begin.
    let rows = [
        ("a!:beep=SINGLE b!", "beep b"),
        ("a!:beep,pick=SINGLE b!", "beep b|pick"),
        ("a!:beep=HARD b!", "beep|b"),
        ("a!:beep=SOFT b!", "beep|b"),
        ("a!:beep b!", "beep b"),
        ("a!:beep,pick=HARD b!", "beep|pick|b"),
        ("a! b!/beep", "beep b"),
        ("a! b!/beep=SOFT", "beep|b"),
    ];
    for (way, expected) in rows {
        let mut pair = Pair::new("a");
        pair.machine.order(order("o1", 0, 0, way));
        let mut log = Vec::new();
        for _ in 0..20 {
            let (began, reached) = (pair.vehicle.began.len(), pair.vehicle.reached.len());
            pair.tell();
            let actions = pair.vehicle.began[began..].iter().map(|id| id.rsplit('-').next().unwrap().to_owned());
            let turn: Vec<String> =
                actions.chain(pair.vehicle.reached[reached..].iter().map(|(node, _)| node.clone())).collect();
            log.extend((!turn.is_empty()).then(|| turn.join(" ")));
            pair.turn();
        }
        assert_eq!(log.join("|"), expected, "{way}");
        assert!(pair.actions().iter().all(|action| action.ends_with("FINISHED")), "{way}: {:?}", pair.actions());
    }
}

#[test]
fn actions_run_side_by_side_where_the_vehicle_can() {
    use cara_vda5050::actions::{Entry, Place, block_driving, startable};
    let entry = |blocking: BlockingType, number: u64| {
        let action = cara_vda5050::message::Action { blocking_type: blocking, ..Default::default() };
        let mut entry = Entry::new(action, Place::Node(0));
        (entry.is_triggered, entry.number) = (true, number);
        entry
    };
    let (none, soft, hard) = (BlockingType::None, BlockingType::Soft, BlockingType::Hard);
    let single = BlockingType::Single;
    // (actions with whether they run, how many at once, the next, whether it stands)
    type Case<'c> = (&'c [(BlockingType, u64)], usize, Option<usize>, bool);
    let rows: [Case<'_>; 12] = [
        (&[(none, 1), (single, 0)], 4, None, false),
        (&[(single, 1), (none, 0)], 4, None, false),
        (&[(single, 0)], 4, Some(0), false),
        (&[(none, 0), (soft, 0)], 4, Some(0), true),
        (&[(none, 1), (soft, 0)], 4, Some(1), true),
        (&[(none, 1), (soft, 0)], 1, None, true),
        (&[(none, 1), (hard, 0)], 4, None, true),
        (&[(hard, 0), (none, 0)], 4, Some(0), true),
        (&[(hard, 1), (none, 0)], 4, None, true),
        (&[(none, 1), (none, 2), (none, 0)], 3, Some(2), false),
        (&[(none, 1), (none, 2), (none, 0)], 2, None, false),
        (&[], 1, None, false),
    ];
    for (actions, at_once, next, stands) in rows {
        let entries: Vec<Entry> = actions.iter().map(|(blocking, number)| entry(*blocking, *number)).collect();
        assert_eq!((startable(&entries, at_once), block_driving(&entries)), (next, stands), "{actions:?}");
    }
}

#[test]
fn an_edges_action_ends_with_the_edge() {
    let mut pair = Pair::new("a");
    pair.vehicle.steps = 2;
    pair.machine.order(order("o1", 0, 0, "a! b!/beep,pick c!"));
    pair.tell();
    // It lasts longer than the drive.
    pair.vehicle.steps = 50;
    pair.turns(10);
    // Only one runs at once: the other one never began.
    assert_eq!(pair.actions()[1], "o1-b2e-pick FAILED");
    assert_eq!(pair.actions()[0], "o1-b2e-beep FINISHED");
    assert_eq!(pair.vehicle.began, ["o1-b2e-beep"]);
}

#[test]
fn a_cancelled_order_ends_when_the_vehicle_stands_and_its_actions_have_ended() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a!:beep b! c!:pick"));
    pair.turn();
    pair.machine.instant_actions(instant("cancelOrder", "c1"));
    assert_eq!(pair.actions(), ["o1-a0n-beep RUNNING", "o1-c4n-pick FAILED", "c1 RUNNING"]);
    pair.turns(3);
    assert_eq!(pair.actions(), ["o1-a0n-beep FAILED", "o1-c4n-pick FAILED", "c1 FINISHED"]);
    let report = pair.machine.report().unwrap();
    assert_eq!((report.order_id.as_str(), report.node_states.len(), report.edge_states.len()), ("o1", 0, 0));
    assert!(!report.driving && pair.errors().is_empty());
    // What cannot be cancelled is awaited.
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a!:drop=HARD b!"));
    pair.vehicle.steps = 8;
    pair.turn();
    pair.machine.instant_actions(instant("cancelOrder", "c1"));
    pair.turns(3);
    assert_eq!(pair.actions(), ["o1-a0n-drop RUNNING", "c1 RUNNING"]);
    pair.turns(10);
    assert_eq!(pair.actions(), ["o1-a0n-drop FINISHED", "c1 FINISHED"]);
}

#[test]
fn what_is_not_there_cannot_be_cancelled() {
    for prepare in [nothing, done, cancelled] {
        let mut pair = Pair::new("a");
        prepare(&mut pair);
        pair.machine.instant_actions(instant("cancelOrder", "c9"));
        assert_eq!(pair.actions().last().unwrap(), "c9 FAILED");
        assert_eq!(pair.errors(), ["noOrderToCancel"]);
        let error = &pair.machine.record().errors[0];
        let references = error.error_references.as_ref().unwrap();
        assert!(references.iter().any(|of| of.reference_key == "actionId" && of.reference_value == "c9"));
    }
}

#[test]
fn instant_actions_are_done_once() {
    let mut pair = Pair::new("a");
    for (kind, id, expected) in [
        ("stateRequest", "i1", "FINISHED"),
        ("factsheetRequest", "i2", "FINISHED"),
        ("initPosition", "i3", "FINISHED"),
        ("beep", "i4", "FINISHED"),
        ("dance", "i5", "FAILED"),
    ] {
        pair.machine.take_report_due();
        pair.machine.take_factsheet_due();
        pair.machine.instant_actions(instant(kind, id));
        assert!(pair.machine.take_report_due(), "{kind}");
        assert_eq!(pair.machine.take_factsheet_due(), kind == "factsheetRequest");
        pair.turns(5);
        assert_eq!(pair.actions().last().unwrap(), &format!("{id} {expected}"));
    }
    assert_eq!(pair.errors(), ["orderError"]);
    pair.machine.instant_actions(instant("beep", "i4"));
    // A late copy behind the next order does nothing either, above all no cancelOrder.
    pair.machine.instant_actions(instant("cancelOrder", "i6"));
    pair.machine.order(order("o1", 0, 0, "a! b! c!"));
    pair.turn();
    for (kind, id) in [("cancelOrder", "i6"), ("beep", "i4")] {
        pair.machine.instant_actions(instant(kind, id));
    }
    pair.turns(10);
    assert_eq!((pair.vehicle.began.as_slice(), pair.vehicle.reached.len()), (["i4".to_owned()].as_slice(), 2));
}

/// vda5050-sdk sends each pause and each cancel under the same id.
#[test]
fn an_id_of_a_new_message_counts_again_for_what_the_gateway_does() {
    let mut pair = Pair::new("a");
    let mut header_id = 10;
    let mut again = |kind: &str, id: &str| {
        header_id += 1;
        let mut message = instant(kind, id);
        message.header.header_id = header_id;
        message
    };
    for round in 0..3 {
        let (from, to) = if round % 2 == 0 { ("a", "c") } else { ("c", "a") };
        pair.machine.order(order(&format!("o{round}"), 0, 0, &format!("{from}! {to}!")));
        pair.turn();
        let pause = again("startPause", "pause");
        pair.machine.instant_actions(pause.clone());
        pair.turns(2);
        assert!(pair.machine.record().is_paused && pair.actions().contains(&"pause FINISHED".to_owned()), "{round}");
        pair.machine.instant_actions(again("stopPause", "resume"));
        pair.machine.instant_actions(pause);
        assert!(!pair.machine.record().is_paused, "a copy");
        if round == 1 {
            pair.machine.instant_actions(again("cancelOrder", "cancel"));
            pair.turns(2);
            assert_eq!((pair.left().as_str(), pair.vehicle.status.is_driving), ("", false));
            // Driven on by hand.
            pair.vehicle.status.position = Fake::at("a").status.position;
            pair.machine.status(pair.vehicle.status.clone());
        }
        pair.turns(10);
    }
    assert!(pair.errors().is_empty() && pair.left().is_empty());
    // What the vehicle does is done once.
    for _ in 0..2 {
        pair.machine.instant_actions(again("beep", "beep"));
        pair.turns(5);
    }
    assert_eq!((pair.vehicle.began.len(), pair.errors()), (1, vec!["validationError"]));
}

/// As behind a record of a backup: the vehicle takes no number that is lower than its last.
#[test]
fn numbers_go_on_above_those_of_the_vehicle() {
    let mut pair = Pair::new("a");
    (pair.vehicle.status.drive, pair.vehicle.status.action) = (50, 70);
    pair.machine.status(pair.vehicle.status.clone());
    pair.machine.order(order("o1", 0, 0, "a!:beep b!"));
    pair.turns(10);
    assert_eq!((pair.left().as_str(), pair.vehicle.status.action, pair.vehicle.status.drive), ("", 71, 72));
}

#[test]
fn a_drive_without_an_answer_is_given_up_before_it_is_asked_again() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a! b!"));
    let drive = pair.machine.next(pair.now).unwrap();
    assert!(matches!(drive, Command::Drive { number: 1, .. }));
    pair.machine.answered(&drive, Err(Failure::Lost("time-out".into())), pair.now);
    let halt = pair.machine.next(pair.now).unwrap();
    assert_eq!(halt, Command::Halt);
    pair.machine.answered(&halt, Ok(()), pair.now);
    assert_eq!(pair.machine.next(pair.now), None, "not at once");
    assert_eq!(pair.machine.next(pair.now + Duration::from_secs(1)), Some(drive));
}

#[test]
fn nothing_is_done_late() {
    let mut pair = Pair::new("a");
    pair.machine.vehicle_lost();
    for (kind, id) in [("beep", "i1"), ("initPosition", "i2")] {
        pair.machine.instant_actions(instant(kind, id));
    }
    assert_eq!(pair.actions(), ["i1 FAILED", "i2 FAILED"]);
    pair.vehicle.status.mode = OperatingMode::Manual;
    pair.machine.status(pair.vehicle.status.clone());
    pair.machine.instant_actions(instant("beep", "i3"));
    pair.vehicle.status.mode = OperatingMode::Automatic;
    pair.turns(5);
    assert_eq!((pair.actions()[2].as_str(), pair.vehicle.began.len()), ("i3 FAILED", 0));
}

#[test]
fn another_mode_ends_the_order() {
    for mode in [OperatingMode::Manual, OperatingMode::Service, OperatingMode::Teachin] {
        let mut pair = Pair::new("a");
        pair.machine.order(order("o1", 0, 0, "a! b!:pick c!"));
        pair.turn();
        pair.vehicle.status.mode = mode;
        pair.machine.status(pair.vehicle.status.clone());
        pair.tell();
        assert_eq!((pair.left().as_str(), pair.actions()), ("", vec!["o1-b2n-pick FAILED".to_owned()]));
        assert!(!pair.vehicle.status.is_driving);
        pair.machine.order(order("o2", 0, 0, "a! b!"));
        assert_eq!(pair.errors(), ["orderError"]);
    }
}

#[test]
fn a_stopped_vehicle_keeps_its_order() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a! b! c!"));
    pair.turn();
    let stops: [fn(&mut Fake); 2] = [
        |vehicle| vehicle.status.stopped = Some("stopped by its operator".into()),
        |vehicle| vehicle.status.e_stop = EStop::Manual,
    ];
    for stop in stops {
        stop(&mut pair.vehicle);
        pair.vehicle.unlink();
        pair.machine.status(pair.vehicle.status.clone());
        pair.turns(5);
        assert!(!pair.vehicle.status.is_driving && pair.left() == "ab! b! bc! c!");
        let fatal: Vec<_> = pair.machine.report().unwrap().errors;
        assert_eq!(fatal.len(), usize::from(pair.vehicle.status.stopped.is_some()));
        (pair.vehicle.status.stopped, pair.vehicle.status.e_stop) = (None, EStop::None);
        pair.machine.status(pair.vehicle.status.clone());
        pair.tell();
        assert!(pair.vehicle.status.is_driving, "it goes on once it is reset");
    }
}

#[test]
fn an_action_of_unknown_outcome_fails_and_is_not_repeated() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a!:pick=HARD b!"));
    pair.turn();
    pair.machine.vehicle_lost();
    pair.vehicle.reboot();
    pair.machine.status(pair.vehicle.status.clone());
    pair.turns(10);
    assert_eq!((pair.actions(), pair.errors()), (vec!["o1-a0n-pick FAILED".to_owned()], vec!["actionError"]));
    assert_eq!((pair.vehicle.began.len(), pair.left().as_str()), (1, ""));
}

#[test]
fn nothing_is_reported_of_a_vehicle_that_is_not_linked() {
    let mut pair = Pair::new("a");
    half_way(&mut pair);
    pair.machine.vehicle_lost();
    assert!(pair.machine.report().is_none());
    pair.machine.order(order("o1", 1, 2, "b! c!"));
    assert_eq!(pair.errors(), ["orderError"]);
    pair.machine.status(pair.vehicle.status.clone());
    assert_eq!(pair.left(), "bc c");
}

/// For each policy: how far the vehicle gets while the broker is away, and whether it goes on when it is back.
#[test]
fn the_loss_of_the_broker_is_bounded() {
    let far = OnBrokerLoss::FinishBase { seconds: 600.0, metres: 600.0 };
    let short = OnBrokerLoss::FinishBase { seconds: 600.0, metres: 3.0 };
    let brief = OnBrokerLoss::FinishBase { seconds: 0.3, metres: 600.0 };
    for (on_broker_loss, by_itself, reached, goes_on) in [
        (far, false, "d", true),
        (short, false, "d", false),
        (short, true, "d", true),
        (brief, false, "d", false),
        (OnBrokerLoss::Stop, false, "b", false),
        (OnBrokerLoss::Stop, true, "b", true),
    ] {
        let mut pair = Pair::with("a", Policy { on_broker_loss, resumes_by_itself: by_itself, ..policy() });
        pair.machine.order(order("o1", 0, 0, "a! b! c! d! e"));
        pair.turn();
        pair.machine.broker(false, pair.now);
        pair.turns(30);
        let last = pair.vehicle.reached.last().unwrap().0.clone();
        assert!(!pair.vehicle.status.is_driving, "{on_broker_loss:?}");
        assert_eq!(last, reached, "{on_broker_loss:?}");
        let stopped = pair.left() != "de e";
        pair.machine.broker(true, pair.now);
        pair.turns(30);
        assert_eq!(pair.left() == "de e", goes_on, "{on_broker_loss:?} {by_itself}");
        assert_eq!(pair.errors().contains(&"brokerLost"), stopped && !by_itself, "{on_broker_loss:?}");
        pair.machine.instant_actions(instant("stopPause", "p1"));
        pair.turns(30);
        assert_eq!((pair.left().as_str(), pair.errors().len()), ("de e", 0));
    }
}

#[test]
fn scopes_of_actions_are_kept() {
    let mut policy = policy();
    policy.can.actions.get_mut("pick").unwrap().scopes = vec![ActionScope::Node];
    for (way, expected) in [("a!:pick b!", 0), ("a! b!/pick", 1)] {
        let mut pair = Pair::with("a", policy.clone());
        pair.machine.order(order("o1", 0, 0, way));
        assert_eq!(pair.errors().len(), expected, "{way}");
    }
}

/// An action at once that blocks driving stops the vehicle first.
#[test]
fn a_blocking_action_at_once_waits_until_the_vehicle_stands() {
    for (blocking, stops) in [(BlockingType::None, false), (BlockingType::Soft, true), (BlockingType::Hard, true)] {
        let mut pair = Pair::new("a");
        pair.vehicle.steps = 6;
        pair.machine.order(order("o1", 0, 0, "a! b! c!"));
        pair.turn();
        let mut message = instant("beep", "i1");
        message.actions[0].blocking_type = blocking;
        pair.machine.instant_actions(message);
        if stops {
            let halt = pair.machine.next(pair.now).unwrap();
            assert_eq!(halt, Command::Halt);
            pair.machine.answered(&halt, pair.vehicle.command(&halt), pair.now);
            assert_eq!(pair.machine.next(pair.now), None, "it has not said that it stands");
            pair.machine.status(pair.vehicle.status.clone());
        }
        pair.turn();
        assert_eq!(pair.vehicle.status.is_driving, !stops, "{blocking:?}");
        pair.turns(30);
        assert_eq!((pair.left().as_str(), pair.vehicle.began.len()), ("", 1), "{blocking:?}");
        assert_eq!(pair.vehicle.reached.len(), 2, "the same drive goes on");
    }
}

#[test]
fn no_action_begins_where_the_vehicle_may_not_move() {
    let stops: [fn(&mut Fake); 4] = [
        |vehicle| vehicle.status.mode = OperatingMode::Manual,
        |vehicle| vehicle.status.mode = OperatingMode::Service,
        |vehicle| vehicle.status.e_stop = EStop::Manual,
        |vehicle| vehicle.status.stopped = Some("stopped by its operator".into()),
    ];
    for stop in stops {
        let mut pair = Pair::new("a");
        // The second one waits for the first.
        for id in ["i1", "i2"] {
            pair.machine.instant_actions(instant("beep", id));
        }
        pair.tell();
        stop(&mut pair.vehicle);
        pair.machine.status(pair.vehicle.status.clone());
        pair.turns(10);
        assert_eq!(pair.vehicle.began, ["i1"]);
        if pair.vehicle.status.mode != OperatingMode::Automatic {
            assert_eq!(pair.actions(), ["i1 FAILED", "i2 FAILED"]);
        }
    }
}

/// What was wanted at once is not wanted an hour later.
#[test]
fn an_action_at_once_that_had_not_begun_fails_with_the_link() {
    let mut pair = Pair::new("a");
    pair.machine.instant_actions(instant("initPosition", "i0"));
    let init = pair.machine.next(pair.now).unwrap();
    pair.machine.answered(&init, Err(Failure::Lost("time-out".into())), pair.now);
    for id in ["i1", "i2"] {
        pair.machine.instant_actions(instant("beep", id));
    }
    pair.vehicle.unlink();
    pair.machine.vehicle_lost();
    pair.machine.status(pair.vehicle.status.clone());
    assert_eq!(pair.actions(), ["i0 FAILED", "i1 FAILED", "i2 FAILED"]);
    pair.turns(10);
    assert!(pair.vehicle.began.is_empty());
}

/// However many updates a master sends, what is held is bounded.
#[test]
fn updates_do_not_heap_up() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a! b! c! d!"));
    for update in 1..100 {
        let last = pair.machine.record().nodes.last().unwrap();
        let (node, sequence) = (last.node_id.clone(), last.sequence_id);
        pair.machine.order(order("o1", update, sequence, &format!("{node}! a! b! c! d!")));
    }
    assert!(pair.machine.record().nodes.len() <= 20, "{}", pair.machine.record().nodes.len());
    assert_eq!(pair.errors().last(), Some(&"orderError"));
    for id in 0..1_000 {
        pair.machine.instant_actions(instant("beep", &format!("i{id}")));
    }
    assert!(pair.machine.record().actions.len() < 100);
}

#[test]
fn long_texts_are_neither_kept_nor_reported() {
    let long = "x".repeat(2_000);
    for (id, parameter) in [(long.as_str(), ""), ("i1", long.as_str())] {
        let mut pair = Pair::new("a");
        let mut message = instant("stateRequest", id);
        let value = serde_json::Value::from(parameter);
        let parameter = cara_vda5050::message::ActionParameter { key: "k".into(), value };
        message.actions[0].action_parameters = Some(vec![parameter]);
        pair.machine.instant_actions(message.clone());
        assert_eq!((pair.errors(), pair.actions().len()), (vec!["validationError"], 0));
        let text = serde_json::to_vec(&message).unwrap();
        let read = cara_vda5050::message::read::<cara_vda5050::message::InstantActions>(Version::V2, &text);
        assert_eq!(read.is_err(), id == long, "a parameter's value is the application's");
    }
    let mut pair = Pair::new("a");
    pair.machine.order(order(&"o".repeat(65), 0, 0, "a! b!"));
    assert_eq!(pair.errors(), ["orderError"]);
}
