//! Orders, renewals, releases, stops and resets: forged, once more, and held back, at every state of a vehicle that moves.
//!
//! A success is a vehicle that moves, moves for longer, stops, is reset or runs a service because of the attacker. What is put
//! into a stream may end its link, and with it the motion.

use cara_core::config::Priority;
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::message::{Release, Renewal, SessionBody};
use cara_core::host::connections::LinkCounter;
use cara_core::time::Duration;

use super::Tally;
use super::ends::{Carried, Drive, Ends};

const RUN: u8 = 5;
/// Renewals are so far apart.
const MOMENT: Duration = Duration::from_millis(100);
/// In front of a datagram's body.
const HEADER: usize = 24;

/// What the manager does, one after the other.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Step {
    Meet,
    Order(&'static str),
    GiveUp,
    /// Time passes for both.
    Wait,
    /// Nothing of the manager arrives from here on, and the vehicle waits for longer than its lease.
    Silence,
}

use Step::{GiveUp, Meet, Order, Silence, Wait};

const STORY: [Step; 22] = [
    Meet,
    Order("go"),
    Wait,
    Wait,
    Wait,
    GiveUp,
    Wait,
    Order("go"),
    Wait,
    Order("go"),
    Wait,
    Order("halt"),
    Wait,
    Order("free"),
    Wait,
    Order("go"),
    Wait,
    Wait,
    GiveUp,
    Order("go"),
    Wait,
    Silence,
];

/// Plays the first steps of the story; `carry` sees each thing on its way, with its number, and delivers it if it likes; `behind`
/// comes behind each step.
fn play(steps: usize, mut carry: impl FnMut(&mut Ends, usize, Carried), mut behind: impl FnMut(&mut Ends)) -> Ends {
    let (mut ends, mut number) = (Ends::moving(RUN), 0);
    for step in STORY.into_iter().take(steps) {
        match step {
            Meet => {}
            Order(function) => ends.manager.order(function),
            GiveUp => ends.manager.give_up(),
            Wait => [true, false].into_iter().for_each(|end| ends.end(end).wait(MOMENT)),
            Silence => ends.agv.wait(Duration::from_millis(500)),
        }
        while let Some(carried) = ends.next() {
            carry(&mut ends, number, carried);
            number += 1;
        }
        behind(&mut ends);
    }
    ends
}

/// All that is carried in the first steps.
fn said(steps: usize) -> Vec<Carried> {
    let mut record = Vec::new();
    let deliver = |ends: &mut Ends, _, carried: Carried| {
        ends.deliver(&carried);
        record.push(carried);
    };
    play(steps, deliver, |_| ());
    record
}

/// Plays the first steps and delivers something: how the drive stood before and after.
fn attacked(steps: usize, with: &Carried) -> (Drive, Drive, Ends) {
    let mut ends = play(steps, |ends, _, carried| ends.deliver(&carried), |_| ());
    let before = ends.agv.drive();
    ends.deliver(with);
    (before, ends.agv.drive(), ends)
}

/// How many steps there may have been.
fn states() -> impl Iterator<Item = usize> {
    1..=STORY.len()
}

/// Whether a drive stands otherwise than it did, but for having lost its link.
fn has_changed(ends: &Ends, before: &Drive, after: &Drive) -> bool {
    if ends.agv.closed.is_some() {
        return after.left.is_some() || after.ran != before.ran || after.state.latch != before.state.latch;
    }
    before != after
}

/// So that the attacks have something to attack.
#[test]
fn the_story_is_as_it_should_be() {
    let mut moved = String::new();
    let look = |ends: &mut Ends| {
        let drive = ends.agv.drive();
        moved.push(if drive.state.latch.is_some() {
            's'
        } else if drive.left.is_some() {
            'm'
        } else {
            '-'
        });
    };
    let ends = play(STORY.len(), |ends, _, carried| ends.deliver(&carried), look);
    assert_eq!(moved, "-mmmm--mmmmss--mmm-mm-");
    assert_eq!(ends.agv.ran, 7, "five orders, a stop, a reset");
    assert_eq!(ends.agv.counted(LinkCounter::DatagramsForged), 0);
    assert!(said(STORY.len()).iter().filter(|carried| to_vehicle(carried)).count() > 12, "renewals among them");
}

/// A datagram of the manager's.
const fn to_vehicle(carried: &Carried) -> bool {
    carried.datagram && !carried.to_manager
}

#[test]
fn nothing_that_was_said_moves_or_stops_a_second_time() {
    let mut tally = Tally::new("orders, renewals, releases, stops and resets once more, at every later state");
    for steps in states() {
        for again in said(steps) {
            for reflected in [false, true] {
                let carried = Carried { to_manager: again.to_manager != reflected, ..again.clone() };
                let (before, after, ends) = attacked(steps, &carried);
                let lost = carried.datagram && ends.agv.closed.is_some();
                tally.note(has_changed(&ends, &before, &after) || lost);
            }
        }
    }
    tally.close();
}

/// One on the wire who delivers a datagram of the manager when it is of use, and not when it was sent: what came by the stream
/// meanwhile is not undone.
#[test]
fn what_is_held_back_revives_nothing() {
    let mut tally = Tally::new("datagrams of orders, renewals, releases, stops and resets held back");
    for steps in states() {
        for (number, held) in said(steps).iter().enumerate().filter(|(_, carried)| to_vehicle(carried)) {
            let hold = |ends: &mut Ends, at, carried: Carried| {
                if at != number {
                    ends.deliver(&carried);
                }
            };
            let mut ends = play(steps, hold, |_| ());
            let before = ends.agv.drive();
            ends.deliver(held);
            tally.note(before != ends.agv.drive());
        }
    }
    tally.close();
}

/// As the manager would have written it, of one who knows nonces and ids, but not the keys.
#[test]
fn nothing_that_is_made_up_moves_or_stops() {
    let mut tally = Tally::new("forged orders, renewals, releases, stops and resets, at every state");
    let whole = said(STORY.len());
    for steps in states() {
        let genuine = said(steps);
        let header = &whole.iter().find(|carried| to_vehicle(carried)).expect("a datagram").bytes[..HEADER];
        let mut bodies: Vec<Vec<u8>> = Vec::new();
        for call in 1..10 {
            let (class, since) = (Priority::Normal, Duration::ZERO);
            bodies.push(SessionBody::renewal(&Renewal { call, class, stamp: 5_000_000, since, age: since }).to_vec());
            bodies.push(SessionBody::release(&Release { call, class }).to_vec());
            bodies.push(SessionBody::release_all(Slot(1), call).to_vec());
        }
        // What is still to come, with another seal.
        bodies.extend(whole[genuine.len()..].iter().filter(|carried| to_vehicle(carried)).map(|carried| {
            let mut body = carried.bytes[HEADER..].to_vec();
            body.iter_mut().rev().take(16).for_each(|byte| *byte ^= 0x5A);
            body
        }));
        for body in bodies {
            for (before, after) in [(0, 0), (0, 16), (8, 16), (9, 16), (24, 16)] {
                let bytes = [header, &vec![0; before], &body, &vec![0; after]].concat();
                let (before, after, ends) = attacked(steps, &Carried { to_manager: false, datagram: true, bytes });
                tally.note(has_changed(&ends, &before, &after) || ends.agv.closed.is_some());
            }
            let bytes = [&(body.len() as u16 + 1).to_le_bytes()[..], &[6], &body].concat();
            let (before, after, ends) = attacked(steps, &Carried { to_manager: false, datagram: false, bytes });
            tally.note(has_changed(&ends, &before, &after));
        }
    }
    tally.close();
}
