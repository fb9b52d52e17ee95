//! Units whose port leaves out calling and everything else that is optional.

use super::super::Event;
use super::pair::PairOf;
use super::setup::Setup;
use super::side::Table;
use crate::config::Priority;
use crate::distribution::function_list::{Generation, Slot};
use crate::distribution::message::{RequestHeader, SessionBody, encode_reply};
use crate::error::CloseReason;
use crate::host::connections::LinkCounter;
use crate::time::Duration;

/// Two units that only serve.
fn pair() -> PairOf<false> {
    PairOf::with(&Setup::default())
}

/// A request of a function without arguments, as the other end would make it.
fn request(id: u32, slot: Slot) -> RequestHeader {
    RequestHeader {
        id,
        slot,
        generation: Generation(0),
        wants_reply: false,
        wants_progress: false,
        takes_over: false,
        operator: false,
        unknown: 0,
        remaining: Duration::from_secs(1),
        stamp: 0,
        since: Duration::ZERO,
        number: 0,
    }
}

#[test]
fn functions_of_others_are_skipped_and_the_peer_is_told() {
    let mut pair = pair();
    pair.agv.offer("pos_info() -> (position: int[2])", |_| Ok(()));
    pair.agv.offer("go_to(position: int[2])", |_| Ok(()));
    let serial = pair.agv.publish();
    pair.settle();
    assert!(pair.agv.has(&Event::Acknowledged { serial, skipped: 2 }));
    assert!(pair.manager.session.their_function_list().is_empty());
    assert_eq!(pair.manager.counter(LinkCounter::FunctionsSkipped), 2);
}

#[test]
fn an_answer_to_nothing_ends_the_link() {
    let mut pair = pair();
    pair.manager.hear_message(&encode_reply(1, Ok(())), Priority::Normal);
    pair.settle();
    assert!(pair.manager.has(&Event::Closed(CloseReason::Protocol)));
}

#[test]
fn no_table_is_asked() {
    let mut pair = pair();
    let slot = pair.agv.offer("go()", |_| Ok(()));
    pair.publish();
    pair.agv.set_table(Some(Table::default()));
    let generation = pair.agv.functions.generation(slot).unwrap();
    let stamp = pair.agv.now.as_micros();
    pair.agv.hear_request(&RequestHeader { generation, stamp, ..request(1, slot) }, Priority::Normal, &[]);
    pair.settle();
    assert_eq!(pair.agv.ran(), ["go"]);
}

#[test]
fn a_request_in_a_datagram_is_dropped_and_one_in_the_stream_runs() {
    let mut pair = pair();
    let slot = pair.agv.offer("go()", |_| Ok(()));
    pair.publish();
    let generation = pair.agv.functions.generation(slot).unwrap();
    let header = RequestHeader { generation, stamp: pair.agv.now.as_micros(), ..request(1, slot) };
    let dropped = pair.agv.counter(LinkCounter::DatagramsDropped);
    let body = [&SessionBody::message_prefix(Priority::Normal.to_wire())[..], &header.encode()].concat();
    pair.agv.hear_datagram(pair.agv.session.nonce(), &body);
    assert_eq!((pair.agv.ran().len(), pair.agv.counter(LinkCounter::DatagramsDropped)), (0, dropped + 1));
    pair.agv.hear_request(&header, Priority::Normal, &[]);
    pair.settle();
    assert_eq!(pair.agv.ran(), ["go"]);
}
