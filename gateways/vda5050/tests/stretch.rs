//! How much of its way a vehicle is told at a time, and what is reported as it drives.

mod fake;

use cara_vda5050::message::Order;
use cara_vda5050::state::Command;
use fake::{Pair, order};

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
    let Some(Command::Drive { number, mut legs }) = pair.machine.next(pair.now) else { panic!() };
    legs.truncate(2);
    let told = Command::Drive { number, legs };
    let answer = pair.vehicle.command(&told);
    pair.machine.answered(&told, answer, pair.now);
    pair.turns(20);
    assert_eq!((pair.left().as_str(), pair.vehicle.reached.len()), ("", 3));
}
