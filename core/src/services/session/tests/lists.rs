//! What a peer sees of a unit's functions.

use super::super::Event;
use super::pair::Pair;
use super::setup::Setup;
use super::{none, x};
use crate::config::Priority;
use crate::distribution::function::Attributes;
use crate::distribution::message::Control;
use crate::error::Error;
use crate::host::connections::LinkCounter;

#[test]
fn what_is_published_is_visible_and_acknowledged() {
    let mut pair = Pair::live();
    pair.agv.offer("pos_info() -> (position: int[2])", |_| Ok(()));
    pair.agv.offer("go_to(position: int[2])", |_| Ok(()));
    pair.settle();
    assert!(pair.manager.session.their_function_list().is_empty(), "adding shows nothing");
    let serial = pair.agv.publish();
    pair.settle();
    assert!(pair.manager.has(&Event::ListChanged));
    assert!(pair.agv.has(&Event::Acknowledged { serial, skipped: 0 }));
    let shown = pair.manager.session.their_function_list().show_functions();
    assert_eq!(std::format!("{shown}"), "pos_info() -> (position: int[2])\ngo_to(position: int[2])\n");
}

#[test]
fn what_is_not_published_cannot_be_called() {
    let mut pair = Pair::with_position();
    pair.agv.offer("secret()", |_| Ok(()));
    pair.settle();
    assert_eq!(pair.manager.call("secret", &none()), Err(Error::UnknownFunction));
    // Nor can a peer that guesses its slot call it.
    pair.manager.hear_of("secret()", 1, 0);
    let id = pair.manager.call("secret", &none()).unwrap();
    pair.settle();
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::UnknownFunction);
    assert!(pair.agv.ran().is_empty());
}

#[test]
fn what_is_withdrawn_is_gone_and_can_come_back() {
    let mut pair = Pair::with_position();
    let slot = pair.agv.functions.find("pos_info").unwrap();
    let serial = pair.agv.withdraw(slot);
    pair.settle();
    assert!(pair.agv.has(&Event::Acknowledged { serial, skipped: 0 }));
    assert_eq!(pair.manager.call("pos_info", &none()), Err(Error::UnknownFunction));
    pair.publish();
    assert!(pair.manager.call("pos_info", &none()).is_ok());
}

#[test]
fn a_call_that_crosses_a_withdrawal_is_stale() {
    let mut pair = Pair::live();
    let slot = pair.agv.offer("go()", |_| Ok(()));
    pair.publish();
    let id = pair.manager.call("go", &none()).unwrap();
    pair.agv.withdraw(slot);
    pair.settle();
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::StaleFunction);
    assert!(pair.agv.ran().is_empty());
}

/// It has run, so the error is not that it is stale: a retry would run it twice.
#[test]
fn a_function_that_is_replaced_while_it_runs_has_lost_its_results() {
    let mut pair = Pair::live();
    pair.agv.offer_held("turn(x: int) -> (x: int)");
    pair.publish();
    let id = pair.manager.call("turn", &x(1)).unwrap();
    pair.settle();
    assert_eq!(pair.agv.ran(), ["turn"]);
    pair.agv.replace("turn(angle: float)");
    pair.publish();
    pair.agv.answer_held(Ok(&*x(2)));
    pair.settle();
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::ResultLost);
}

#[test]
fn a_function_that_was_replaced_is_stale_and_the_news_follows() {
    let mut pair = Pair::live();
    pair.agv.offer("turn(x: int)", |_| Ok(()));
    pair.publish();
    pair.agv.replace("turn(angle: float)");
    let id = pair.manager.call("turn", &x(1)).unwrap();
    pair.settle();
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::StaleFunction);
    assert!(pair.agv.ran().is_empty());
    assert_eq!(pair.manager.call("turn", &x(1)), Err(Error::UnknownFunction), "it is not published anew");
    pair.publish();
    assert_eq!(pair.manager.call("turn", &x(1)), Err(Error::MissingArgument { index: 0 }));
}

#[test]
fn functions_beyond_the_readers_room_are_skipped_and_told() {
    let mut pair = Pair::with(&Setup { their_functions: 1, ..Setup::default() });
    pair.agv.offer("one()", |_| Ok(()));
    pair.agv.offer("two()", |_| Ok(()));
    pair.agv.offer("three()", |_| Ok(()));
    let serial = pair.agv.publish();
    pair.settle();
    assert!(pair.agv.has(&Event::Acknowledged { serial, skipped: 2 }));
    assert_eq!(pair.manager.counter(LinkCounter::FunctionsSkipped), 2);
}

/// `follow(x: int[..8])`, as published by a unit that has lists.
const FOLLOW: &[u8] = b"\x06follow\x01\x05\x01\x08\0\0\0x\0\x01\0\0\0\0";

#[test]
fn a_function_with_lists_is_skipped_by_a_unit_without_them() {
    let mut pair = Pair::with_position();
    let attributes = Attributes::default().encode();
    let publish = Control::Publish { slot: 1, generation: 0, attributes: &attributes, signature: FOLLOW };
    for control in [publish, Control::ListEnd { serial: 7 }] {
        pair.manager.hear_message(control.encode(&mut [0; 128]).unwrap(), Priority::High);
    }
    pair.settle();
    let (skipped, refused) = match cfg!(feature = "nested") {
        true => (0, Error::WrongType { index: 0 }),
        false => (1, Error::UnknownFunction),
    };
    assert!(pair.agv.has(&Event::Acknowledged { serial: 7, skipped }));
    assert_eq!(pair.manager.counter(LinkCounter::FunctionsSkipped), skipped.into());
    assert_eq!(pair.manager.call("follow", &x(1)), Err(refused));
    assert!(pair.block_request("pos_info", &mut *none()).is_ok(), "the others can be called");
}

/// A message with one that is too long would end the link.
#[cfg(feature = "nested")]
#[test]
fn a_signature_that_the_reader_has_no_buffer_for_is_skipped() {
    let long = |count| {
        let fields: std::vec::Vec<_> = (0..count).map(|index| std::format!("{index:0>32}: int")).collect();
        std::format!("long(x: {{{}}}[..2])", fields.join(", "))
    };
    let manager = crate::config::Constraints { message_size: 256, ..crate::config::Constraints::M_UNIT };
    let mut pair = Pair::with(&Setup { manager, ..Setup::default() });
    pair.agv.offer(&long(10), |_| Ok(()));
    pair.agv.offer(&long(11).replace("long", "longer"), |_| Ok(()));
    pair.agv.offer("short(x: int)", |_| Ok(()));
    let serial = pair.agv.publish();
    pair.settle();
    assert!(pair.agv.has(&Event::Acknowledged { serial, skipped: 1 }));
    assert_eq!(pair.manager.counter(LinkCounter::FunctionsSkipped), 1);
    assert_eq!(pair.manager.call("longer", &x(1)), Err(Error::UnknownFunction));
    assert_eq!(pair.manager.call("long", &x(1)), Err(Error::WrongType { index: 0 }));
    assert_eq!(pair.block_request("short", &mut *x(1)), Ok(()));
}

#[test]
fn a_list_that_finds_no_room_goes_out_when_there_is_some() {
    let mut pair = Pair::with(&Setup { buffers: 2, buffer_size: 600, ..Setup::default() });
    for index in 0..16 {
        pair.agv.offer(&std::format!("function_with_a_long_name_{index}(position: int[2])"), |_| Ok(()));
    }
    pair.agv.net.capacity = 50;
    let serial = pair.agv.publish();
    assert!(!pair.agv.session.their_function_list().is_empty() || pair.agv.counter(LinkCounter::SendRefused) > 0);
    pair.settle();
    assert!(pair.agv.has(&Event::Acknowledged { serial, skipped: 8 }));
}

#[test]
fn what_was_published_stays_so_in_a_longer_table() {
    let mut pair = Pair::with_position();
    let longer = |slots: usize| std::vec![Default::default(); slots].into_boxed_slice();
    let before = pair.agv.session.publication_slots();
    assert_eq!(pair.agv.session.lend_publications(longer(before - 1)).len(), before - 1, "fewer are given back");
    assert_eq!(pair.agv.session.lend_publications(longer(before + 8)).len(), before);
    let id = pair.manager.call("pos_info", &none()).unwrap();
    pair.settle();
    assert!(pair.manager.outcome(id).unwrap().is_ok());
    let serial = pair.agv.publish();
    pair.settle();
    assert!(pair.agv.has(&Event::Acknowledged { serial, skipped: 0 }));
}
