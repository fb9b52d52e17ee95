//! Units that call nothing: their port says so, and what only a caller needs is not in the program.

use super::super::Event;
use super::pair::PairOf;
use super::setup::Setup;
use crate::config::Priority;
use crate::distribution::message::{REPLY_BYTES, encode_reply};
use crate::error::CloseReason;
use crate::host::connections::LinkCounter;
use crate::host::frame::ChunkWriter;

/// Two units that only serve.
fn pair() -> PairOf<false> {
    PairOf::with(&Setup::default())
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
    assert_eq!(pair.manager.session.counters().value(LinkCounter::FunctionsSkipped), 2);
}

#[test]
fn an_answer_to_nothing_ends_the_link() {
    let mut pair = pair();
    let reply = encode_reply(1, Ok(()));
    let sent = pair.agv.session.link.send_message(
        &mut pair.agv.net,
        &mut pair.agv.pool,
        Priority::Normal,
        REPLY_BYTES,
        false,
        |writer: &mut ChunkWriter<'_>| writer.put(&reply),
    );
    assert_eq!(sent, Ok(()));
    pair.settle();
    assert!(pair.manager.has(&Event::Closed(CloseReason::Protocol)));
}
