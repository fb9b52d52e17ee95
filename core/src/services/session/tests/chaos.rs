//! Whatever the network does: every call ends once, runs at most once and in order of its class, and nothing leaks.

use std::collections::BTreeMap;
use std::vec;
use std::vec::Vec;

use proptest::prelude::*;

use super::super::Event;
use super::net::Datagrams;
use super::pair::Pair;
use super::setup::Setup;
use super::side::Side;
use super::x;
use crate::config::{Constraints, GATHER, Priority};
use crate::error::Error;
use crate::services::requests::CallId;
use crate::services::session::{Delivery, RequestOptions};
use crate::time::Duration;

#[derive(Clone, Copy, Debug)]
enum Act {
    Request { function: &'static str, priority: Priority, wants_reply: bool, delivery: Delivery },
    Freeze(bool),
    Narrow(usize),
    Datagrams(Datagrams),
    Starve,
    Feed,
    Answer,
    Republish,
    Pass(u64),
    Suspend,
    Cut,
}

fn act() -> impl Strategy<Value = Act> {
    let function = prop::sample::select(&["now", "held"][..]);
    let priority = prop::sample::select(&Priority::ALL[..]);
    let delivery = prop::sample::select(&[Delivery::Reliable, Delivery::Reliable, Delivery::BestEffort][..]);
    let request = (function, priority, any::<bool>(), delivery);
    let request = request.prop_map(|(function, priority, wants_reply, delivery)| Act::Request {
        function,
        priority,
        wants_reply,
        delivery: if wants_reply { Delivery::Reliable } else { delivery },
    });
    let datagrams = prop::sample::select(&[Datagrams::Pass, Datagrams::Lost, Datagrams::Twice][..]);
    prop_oneof![
        12 => request,
        2 => any::<bool>().prop_map(Act::Freeze),
        1 => prop_oneof![1..60_usize, Just(1 << 20)].prop_map(Act::Narrow),
        1 => datagrams.prop_map(Act::Datagrams),
        1 => Just(Act::Starve),
        2 => Just(Act::Feed),
        4 => Just(Act::Answer),
        1 => Just(Act::Republish),
        4 => (0..300_000_u64).prop_map(Act::Pass),
        1 => (0..3_000_000_u64).prop_map(Act::Pass),
        1 => Just(Act::Suspend),
    ]
}

/// Mostly one-way messages, which are gathered, and calls that are answered after them.
fn gathering_act() -> impl Strategy<Value = Act> {
    let priority = || prop::sample::select(&[Priority::High, Priority::Normal, Priority::Low][..]);
    let request = |function, wants_reply| {
        priority().prop_map(move |priority| Act::Request {
            function,
            priority,
            wants_reply,
            delivery: Delivery::Reliable,
        })
    };
    prop_oneof![
        8 => request("now", false),
        2 => request("now", true),
        4 => request("held", true),
        4 => Just(Act::Answer),
        1 => (0..200_u64).prop_map(Act::Pass),
    ]
}

/// What one end has requested of the other.
#[derive(Default)]
struct Asked {
    calls: BTreeMap<CallId, i64>,
    starved: Vec<std::boxed::Box<[u8]>>,
    next: i64,
}

fn apply(pair: &mut Pair, asked: &mut [Asked; 2], act: Act, manager: bool) {
    let index = usize::from(manager);
    let side = if manager { &mut pair.manager } else { &mut pair.agv };
    let asked = &mut asked[index];
    match act {
        Act::Request { function, priority, wants_reply, delivery } => {
            let options = RequestOptions { priority: Some(priority), delivery, ..RequestOptions::default() };
            asked.next += 1;
            if let Ok(id) = side.request_with(function, &x(asked.next), &options, wants_reply)
                && wants_reply
            {
                asked.calls.insert(id, asked.next);
            }
        }
        Act::Freeze(frozen) => side.net.frozen = frozen,
        Act::Narrow(capacity) => side.net.capacity = capacity,
        Act::Datagrams(datagrams) => side.net.datagrams = datagrams,
        Act::Starve => asked.starved.extend(side.take_buffers()),
        Act::Feed => side.give_buffers(core::mem::take(&mut asked.starved)),
        Act::Answer if side.held.is_empty() => {}
        Act::Answer => side.answer_held(Ok(&*x(0))),
        Act::Republish => {
            side.replace("now(x: int) -> (x: int)");
            side.publish();
        }
        Act::Pass(micros) => pair.run(Duration::from_micros(micros)),
        Act::Suspend => pair.jump(Duration::from_secs(3_600)),
        Act::Cut => pair.cut(),
    }
    pair.settle();
    check_nothing_stays(&pair.manager);
    check_nothing_stays(&pair.agv);
}

/// If bytes are queued and the network has not refused any, a deadline must send them.
fn check_nothing_stays(side: &Side) {
    let Side { session, now, .. } = side;
    let gathers = session.is_live() && session.wire.link.queued() > 0 && !session.wants_to_write();
    assert!(!gathers || session.deadline() <= *now + GATHER, "{} bytes stay", session.wire.link.queued());
}

/// The network recovers, and all running calls are answered.
fn recover(pair: &mut Pair, asked: &mut [Asked; 2]) {
    for (index, asked) in asked.iter_mut().enumerate() {
        let side = if index == 1 { &mut pair.manager } else { &mut pair.agv };
        side.give_buffers(core::mem::take(&mut asked.starved));
        (side.net.frozen, side.net.capacity) = (false, 1 << 20);
    }
    for _ in 0..20 {
        pair.run(Duration::from_millis(1));
        for side in [&mut pair.manager, &mut pair.agv] {
            while !side.held.is_empty() {
                side.answer_held(Ok(&*x(0)));
            }
        }
    }
    pair.run(Duration::from_secs(5));
}

/// Compares the calls of `caller` with what `callee` ran.
fn check(caller: &Side, callee: &Side, calls: &BTreeMap<CallId, i64>) {
    let mut ran: BTreeMap<i64, usize> = BTreeMap::new();
    for x in callee.started().filter_map(|started| started.x) {
        *ran.entry(x).or_default() += 1;
    }
    assert!(ran.values().all(|count| *count == 1), "something ran twice: {ran:?}");
    for (id, x) in calls {
        let ends = caller.count(|event| matches!(event, Event::Reply(known, _) if *known == *id));
        assert_eq!(ends, 1, "call {id:?} ended {ends} times");
        match caller.outcome(*id).unwrap() {
            Ok(_) => assert!(ran.contains_key(x), "{id:?} was answered and never ran"),
            Err(Error::TimedOut | Error::Interrupted) => {}
            Err(Error::ResultLost) => assert!(ran.contains_key(x), "{id:?} has lost a result and never ran"),
            Err(error) => assert!(!ran.contains_key(x), "{id:?} ran and was answered {error}"),
        }
    }
    assert_eq!(caller.session.calls_in_flight(), 0);
    assert_eq!(callee.session.calls_held(), 0);
}

fn check_order(callee: &Side) {
    for class in [Priority::High, Priority::Normal, Priority::Low] {
        let of_class: Vec<i64> =
            callee.started().filter(|started| started.priority == class).filter_map(|started| started.x).collect();
        assert!(of_class.is_sorted(), "{class:?} calls ran as {of_class:?}");
    }
}

fn chaos(acts: &[(Act, bool)], buffers: usize, ordered: bool) {
    let agv = Constraints { message_size: 32 * 1024, calls_per_peer: 4, ..Constraints::S_UNIT };
    let mut pair = Pair::with(&Setup { agv, buffers, ..Setup::default() });
    for side in [&mut pair.manager, &mut pair.agv] {
        side.offer("now(x: int) -> (x: int)", |_| Ok(()));
        side.offer_held("held(x: int) -> (x: int)");
        side.publish();
    }
    pair.settle();
    let mut asked = [Asked::default(), Asked::default()];
    for &(act, manager) in acts {
        apply(&mut pair, &mut asked, act, manager);
    }
    recover(&mut pair, &mut asked);
    check(&pair.manager, &pair.agv, &asked[1].calls);
    check(&pair.agv, &pair.manager, &asked[0].calls);
    if ordered {
        check_order(&pair.manager);
        check_order(&pair.agv);
    }
}

/// The same without anything that may overtake the stream.
fn in_the_stream((act, manager): (Act, bool)) -> (Act, bool) {
    let act = match act {
        Act::Request { function, priority, wants_reply, .. } => {
            Act::Request { function, priority, wants_reply, delivery: Delivery::Reliable }
        }
        act => act,
    };
    (act, manager)
}

proptest! {
    #[test]
    fn calls_survive_anything(acts in prop::collection::vec((act(), any::<bool>()), 1..80)) {
        chaos(&acts, 4, false);
    }

    #[test]
    fn calls_in_the_stream_keep_their_order(
        acts in prop::collection::vec((act(), any::<bool>()).prop_map(in_the_stream), 1..80),
    ) {
        chaos(&acts, 4, true);
    }

    /// As few buffers as on boards: gathered messages of one class take the last one.
    #[test]
    fn calls_survive_gathering_with_few_buffers(
        acts in prop::collection::vec((gathering_act(), any::<bool>()), 1..20), buffers in 2..4_usize,
    ) {
        chaos(&acts, buffers, true);
    }

    #[test]
    fn calls_survive_the_end_of_their_link(
        mut acts in prop::collection::vec((act(), any::<bool>()), 1..40), at in any::<prop::sample::Index>(),
    ) {
        acts.insert(at.index(acts.len()), (Act::Cut, true));
        chaos(&acts, 4, false);
    }
}
