//! How much of its way a vehicle is told at a time, and what is reported as it drives.

mod fake;

use cara_vda5050::machine::Machine;
use cara_vda5050::message::Order;
use cara_vda5050::state::Command;
use fake::{Pair, instant, order, policy};

/// What the vehicle is told at a time: never more than is released, never past a node where it has to stand.
#[test]
fn the_vehicle_passes_nodes_at_which_nothing_is_to_be_done() {
    let roof = |order: &mut Order| order.nodes[2].node_position.as_mut().unwrap().map_id = "roof".into();
    let as_it_is: fn(&mut Order) = |_| {};
    let long_names = |order: &mut Order| order.edges.iter_mut().for_each(|edge| edge.edge_id = "e".repeat(64));
    type Row = (&'static str, fn(&mut Order), &'static [&'static str]);
    let rows: [Row; 10] = [
        ("a! b! c! d! e!", long_names, &["bc", "cd", "de"]),
        ("a! b! c! d!", as_it_is, &["bcd"]),
        ("a! b! c d", as_it_is, &["b"]),
        ("a! b!:pick=HARD c!", as_it_is, &["b", "c"]),
        ("a! b!:pick=SOFT c!", as_it_is, &["b", "c"]),
        ("a! b!:pick c!", as_it_is, &["bc"]),
        ("a!:pick=HARD b! c!", as_it_is, &["bc"]),
        ("a! b! c!/beep d! e!", as_it_is, &["b", "c", "de"]),
        ("a! b! c! d!", roof, &["b", "c", "d"]),
        // The second half is told when the first one is driven.
        ("a! b! c! d! e! f! g! h! i! j! k!", as_it_is, &["bcdefghi", "fghijk"]),
    ];
    for (way, change, expected) in rows {
        let mut pair = Pair::new("a");
        let mut sent = order("o1", 0, 0, way);
        change(&mut sent);
        pair.machine.order(sent);
        let mut told = Vec::new();
        for _ in 0..60 {
            while let Some(command) = pair.machine.next(pair.now) {
                if let Command::Drive { legs, .. } = &command {
                    told.push(legs.iter().map(|(_, node)| node.node_id.as_str()).collect::<String>());
                }
                let answer = pair.vehicle.command(&command);
                pair.machine.answered(&command, answer, pair.now);
            }
            pair.turn();
        }
        assert_eq!(told, expected, "{way}");
        let is_left = pair.left().contains('!');
        assert!(!is_left && pair.errors().is_empty(), "{way}: {} {:?}", pair.left(), pair.errors());
    }
}

#[test]
fn nodes_are_reported_as_they_are_passed_and_an_update_does_not_stop_the_vehicle() {
    let mut pair = Pair::new("a");
    pair.vehicle.steps = 3;
    pair.machine.order(order("o1", 0, 0, "a! b!:beep c! d"));
    let mut seen = Vec::new();
    for turn in 0..15 {
        if turn == 4 {
            pair.machine.order(order("o1", 1, 4, "c! d! e!"));
        }
        pair.turn();
        let report = pair.machine.report().unwrap();
        let is_end = report.last_node_id == "e";
        assert!(report.driving || is_end, "it stands at {}", report.last_node_id);
        assert!(report.distance_since_last_node.unwrap() <= 3.0);
        seen.push(report.last_node_id);
        if is_end {
            break;
        }
    }
    seen.dedup();
    assert_eq!(seen, ["a", "b", "c", "d", "e"]);
    assert_eq!((pair.vehicle.began.len(), pair.left().as_str()), (1, ""), "what blocks nothing began as it passed");
}

/// A vehicle that was told less, as an answer was lost, stands at the end of that, and is told again.
#[test]
fn a_vehicle_that_stands_early_is_told_again() {
    let mut pair = Pair::new("a");
    pair.machine.order(order("o1", 0, 0, "a! b! c! d!"));
    let Some(Command::Drive { number, mut legs, goes_on }) = pair.machine.next(pair.now) else { panic!() };
    legs.truncate(2);
    let told = Command::Drive { number, legs, goes_on };
    let answer = pair.vehicle.command(&told);
    pair.machine.answered(&told, answer, pair.now);
    pair.turns(20);
    assert_eq!((pair.left().as_str(), pair.vehicle.reached.len()), ("", 3));
}

/// The vehicle has been told to drive to b and c, and refuses d, which an update has added.
#[test]
fn a_vehicle_that_refuses_to_drive_further_drives_to_the_end_of_what_it_has() {
    for is_consulted in [true, false] {
        let mut pair = Pair::new("a");
        (pair.vehicle.steps, pair.vehicle.refuses, pair.vehicle.is_consulted) = (10, "d", is_consulted);
        pair.machine.order(order("o1", 0, 0, "a! b! c!"));
        pair.turns(3);
        pair.machine.order(order("o1", 1, 4, "c! d!"));
        pair.turn();
        assert!(!is_consulted || pair.vehicle.status.is_driving, "it stops in mid-edge");
        let error = pair.machine.report().unwrap().errors.remove(0);
        let references = error.error_references.unwrap();
        let named = references.iter().map(|of| format!("{}={}", of.reference_key, of.reference_value));
        assert_eq!(
            (error.error_type.as_str(), named.collect::<Vec<_>>().join(" ")),
            ("orderError", "topic=order orderId=o1 orderUpdateId=1 edgeId=cd nodeId=d".into())
        );
        let mut stops = 0;
        for _ in 0..60 {
            let drove = pair.vehicle.status.is_driving;
            pair.turn();
            stops += u32::from(drove && !pair.vehicle.status.is_driving && pair.machine.record().last_node_id != "c");
        }
        assert_eq!((pair.left().as_str(), pair.vehicle.status.is_driving), ("cd! d!", false), "{is_consulted}");
        assert_eq!(stops, 0, "it stops again and again");
        let shown = pair.machine.report().unwrap().errors;
        assert_eq!((shown.len(), shown[0].error_type.as_str()), (1, "driveRefused"));
        // Once it takes that, it goes on, and has driven each edge once.
        pair.vehicle.refuses = "";
        pair.turns(20);
        let reached: Vec<_> = pair.vehicle.reached.iter().map(|(node, _)| node.as_str()).collect();
        assert_eq!((pair.left().as_str(), reached), ("", vec!["b", "c", "d"]));
        assert!(pair.machine.report().unwrap().errors.is_empty());
    }
}

/// Neither a pause, a lost link nor a restart of the gateway makes it forget how far the vehicle agreed to drive.
#[test]
fn what_the_vehicle_has_agreed_to_is_driven_behind_a_stop() {
    type Stop = fn(&mut Pair);
    let stops: [(&str, Stop); 3] = [
        ("pause", |pair| {
            pair.machine.instant_actions(instant("startPause", "p1"));
            pair.turns(3);
            pair.machine.instant_actions(instant("stopPause", "p2"));
        }),
        ("link", |pair| {
            pair.machine.vehicle_lost();
            pair.vehicle.unlink();
        }),
        ("restart", |pair| {
            pair.machine = Machine::new(pair.machine.record().clone(), policy(), pair.now);
            pair.machine.broker(true, pair.now);
            pair.vehicle.unlink();
        }),
    ];
    for (what, stop) in stops {
        let mut pair = Pair::new("a");
        (pair.vehicle.steps, pair.vehicle.refuses) = (10, "d");
        pair.machine.order(order("o1", 0, 0, "a! b! c!"));
        pair.turns(3);
        pair.machine.order(order("o1", 1, 4, "c! d!"));
        pair.turns(2);
        stop(&mut pair);
        assert!(!pair.vehicle.status.is_driving, "{what}");
        pair.turns(40);
        assert_eq!((pair.left().as_str(), pair.vehicle.status.is_driving), ("cd! d!", false), "{what}");
    }
}
