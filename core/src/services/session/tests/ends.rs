//! How a link ends, leaving nothing behind.

use std::vec::Vec;

use super::super::Event;
use super::super::Publication;
use super::pair::Pair;
use super::setup::Setup;
use super::side::{Side, context};
use super::{none, text, x};
use crate::distribution::connection_handler::Directive;
use crate::distribution::function_list::TheirFunctionList;
use crate::error::{CloseReason, Error};
use crate::services::Context;
use crate::services::lease::Lease;
use crate::storage::Boxed;
use crate::time::{Duration, Instant};

#[test]
fn leases_end_first_then_calls_then_the_link_each_once() {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_leased("go()", Duration::from_secs(5));
    pair.agv.publish();
    pair.manager.offer_held("ask(x: int)");
    pair.manager.publish();
    pair.settle();
    pair.manager.call("go", &none()).unwrap();
    let calls: Vec<_> = (0..3).map(|at| pair.agv.call("ask", &x(at)).unwrap()).collect();
    pair.settle();
    pair.agv.happened.clear();
    pair.cut();
    let interrupted = calls.iter().map(|&id| Event::Reply(id, Err(Error::Interrupted)));
    let mut expected: Vec<Event> = [Event::LeaseExpired(slot)].into_iter().chain(interrupted).collect();
    expected.push(Event::Closed(CloseReason::Reset));
    assert_eq!(pair.agv.happened, expected);
    assert!(!pair.agv.is_live(slot));
    pair.run(Duration::from_secs(20));
    assert_eq!(pair.agv.happened, expected);
    assert_eq!(pair.agv.session.deadline(), Instant::FAR_FUTURE);
}

#[test]
fn the_slices_of_a_link_come_back_empty_for_the_next_one() {
    let mut pair = Pair::with_position();
    pair.manager.offer_held("ask(x: int)");
    pair.manager.publish();
    pair.settle();
    pair.agv.call("ask", &x(1)).unwrap();
    pair.settle();
    assert_eq!(pair.manager.session.calls_held(), 1);
    for (side, agv) in [(&mut pair.manager, false), (&mut pair.agv, true)] {
        let next = Side::new(&Setup::default(), agv, 1).session;
        let storage = std::mem::replace(&mut side.session, next).into_storage(&mut side.pool);
        assert!(storage.pending.iter().all(Option::is_none) && storage.running.iter().all(Option::is_none));
        assert!(storage.publications.iter().all(|publication| *publication == Publication::default()));
        assert_eq!(storage.small.len(), crate::config::LINK_BUFFER_BYTES);
        let theirs: TheirFunctionList<Boxed> =
            TheirFunctionList::new(storage.their_functions, storage.their_signatures);
        assert!(theirs.is_empty());
        assert_eq!(side.pool.free(), side.buffers);
    }
}

#[test]
fn an_orderly_end_is_told_to_the_peer() {
    let mut pair = Pair::with_position();
    pair.manager.close(CloseReason::StoppedHere);
    pair.settle();
    assert!(pair.manager.has(&Event::Closed(CloseReason::StoppedHere)));
    assert!(pair.agv.has(&Event::Closed(CloseReason::Stopped)));
}

#[test]
fn a_peer_that_breaks_the_protocol_is_told_so() {
    let second_hello: Vec<u8> = [&[2, 0, 1, 0][..]].concat();
    let no_message = [&[8, 0, 0x13, 2, 2, 0, 0, 0, 99, 99][..]].concat();
    let no_frame = [&[3, 0, 0x3F, 1, 2][..]].concat();
    for bytes in [second_hello, no_message, no_frame] {
        let mut pair = Pair::live();
        pair.manager.hear(&bytes);
        pair.settle();
        assert!(pair.manager.has(&Event::Closed(CloseReason::Protocol)), "{bytes:?}");
        assert!(pair.agv.has(&Event::Closed(CloseReason::Protocol)), "{bytes:?}");
    }
}

#[test]
fn a_frame_above_the_told_limit_ends_the_link_with_that_reason() {
    let mut pair = Pair::live();
    pair.agv.hear(&[0xFF, 0xFF]);
    pair.settle();
    assert!(pair.agv.has(&Event::Closed(CloseReason::Oversize)));
    assert!(pair.manager.has(&Event::Closed(CloseReason::Oversize)));
}

#[test]
fn a_link_that_ends_in_the_middle_of_messages_gives_every_buffer_back() {
    let mut pair = Pair::live();
    for side in [&mut pair.agv, &mut pair.manager] {
        side.offer_held("read(text: string[20000])");
        side.publish();
    }
    pair.settle();
    (pair.manager.net.capacity, pair.agv.net.capacity) = (100, 100);
    for _ in 0..2 {
        pair.manager.call("read", &text(9_000)).unwrap();
        pair.agv.call("read", &text(9_000)).unwrap();
    }
    for _ in 0..130 {
        pair.step();
    }
    assert!(pair.agv.pool.free() < 6 && pair.manager.pool.free() < 6);
    pair.cut();
    assert_eq!((pair.agv.pool.free(), pair.manager.pool.free()), (6, 6));
}

#[test]
fn a_link_that_has_ended_does_and_keeps_nothing() {
    let mut pair = Pair::with_position();
    let slot = pair.agv.functions.find("pos_info").unwrap();
    pair.manager.call("pos_info", &super::parameters(|p| p.add_int("position", 2).unwrap())).unwrap();
    pair.cut();
    assert_eq!(pair.manager.call("pos_info", &none()), Err(Error::NotConnected));
    let lease = Lease::new();
    let order = lease.begin(Instant::START, Instant::FAR_FUTURE).unwrap();
    for side in [&mut pair.manager, &mut pair.agv] {
        assert_eq!(side.release(slot), Err(Error::NotConnected));
        assert!(!side.session.end_order(context!(side), &lease, order));
        side.direct(Directive::Challenge);
        side.publish();
        side.withdraw(slot);
        side.flush_gathered();
        side.close(CloseReason::Stopped);
        side.hear(&[2, 0, 4]);
    }
    pair.settle();
    assert!(pair.manager.net.writes.is_empty() && pair.agv.net.writes.is_empty());
    assert_eq!(pair.manager.count(|event| matches!(event, Event::Closed(_))), 1);
}

#[test]
fn a_call_that_runs_when_the_link_ends_may_still_be_answered() {
    let mut pair = Pair::live();
    pair.agv.offer_held("work()");
    pair.publish();
    let id = pair.manager.call("work", &none()).unwrap();
    pair.settle();
    pair.cut();
    pair.agv.answer_held(Ok(&*none()));
    assert_eq!(pair.agv.session.calls_held(), 0);
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::Interrupted);
}

#[test]
fn a_link_that_was_never_live_ends_as_well() {
    let mut pair = Pair::connected(&Setup::default());
    pair.agv.hub.waits = true;
    pair.settle();
    pair.cut();
    assert!(pair.agv.has(&Event::Closed(CloseReason::Reset)));
    assert!(pair.manager.has(&Event::Closed(CloseReason::Reset)));
}
