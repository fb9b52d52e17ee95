//! Calls and their answers.

use super::super::Event;
use super::pair::Pair;
use super::setup::Setup;
use super::side::context;
use super::{none, parameters, text, x};
use crate::config::{Constraints, EMERGENCY_BYTES, Priority};
use crate::distribution::message::{RequestHeader, encode_failure};
use crate::distribution::parameters::Parameters;
use crate::error::{Error, Limit, ServiceError};
use crate::host::connections::LinkCounter;
use crate::services::Context;
use crate::services::requests::CallId;
use crate::services::session::{Delivery, RequestOptions};
use crate::time::Duration;
use std::vec::Vec;

#[test]
fn a_request_updates_the_callers_parameters() {
    let mut pair = Pair::with_position();
    let mut pos = Parameters::new();
    pos.add_int("position", 2).unwrap();
    pair.block_request("pos_info", &mut pos).unwrap();
    assert_eq!(pos.variable("position"), Ok([3, 4]));
    assert_eq!((pair.manager.session.calls_in_flight(), pair.agv.session.calls_held()), (0, 0));
}

/// Those sent, received, refused and dropped.
#[test]
fn a_link_counts_what_becomes_of_its_messages() {
    let mut pair = Pair::with_position();
    pair.agv.offer_held("wait()");
    pair.publish();
    let count = |pair: &Pair, counter| [pair.manager.counter(counter), pair.agv.counter(counter)];
    let messages = |pair: &Pair| {
        let [sent, received] = [LinkCounter::MessagesSent, LinkCounter::MessagesReceived].map(|of| count(pair, of));
        [sent[0], received[1], sent[1], received[0]]
    };
    let before = messages(&pair);
    pair.block_request("pos_info", &mut *parameters(|pos| pos.add_int("position", 2).unwrap())).unwrap();
    assert_eq!(messages(&pair), before.map(|count| count + 1));
    assert_eq!(pair.manager.call("come", &none()), Err(Error::UnknownFunction));
    let late = pair.manager.call("wait", &none()).unwrap();
    pair.run(Duration::from_secs(2));
    assert_eq!(pair.manager.outcome(late).unwrap().unwrap_err(), Error::TimedOut);
    pair.agv.answer_held(Ok(&*none()));
    pair.settle();
    let counted = [LinkCounter::RequestsWithheld, LinkCounter::CallsTimedOut, LinkCounter::RepliesLate];
    assert_eq!(counted.map(|counter| count(&pair, counter)), [[1, 0]; 3]);
}

/// The bytes may be overwritten then.
#[test]
fn results_are_shown_until_the_session_receives_again_or_ends() {
    for ends in [false, true] {
        let mut pair = Pair::live();
        pair.agv.offer("echo(text: string[20000]) -> (text: string[20000])", |_| Ok(()));
        pair.publish();
        pair.manager.call("echo", &text(20_000)).unwrap();
        let (manager, mut lent) = (&mut pair.manager, Vec::new());
        let results = loop {
            pair.agv.inbox.extend(manager.net.deliver().0);
            pair.agv.work(Vec::new());
            lent.extend(pair.agv.net.deliver().0);
            let receipt = manager.session.receive(context!(manager), &mut lent, None);
            if let Some(Event::Reply(_, outcome)) = receipt.event {
                break outcome.unwrap();
            }
            lent.drain(..receipt.consumed);
            manager.session.writable(context!(manager));
        };
        let block = manager.session.results(&results, &lent).unwrap();
        assert!(block.bytes().len() > 20_000);
        if ends {
            manager.end();
        } else {
            manager.session.receive(context!(manager), &mut [], None);
        }
        assert_eq!(manager.session.results(&results, &lent).err(), Some(Error::ResultLost));
    }
}

#[test]
fn twenty_thousand_characters_travel_in_chunks() {
    let mut pair = Pair::live();
    pair.agv.offer("echo(text: string[20000]) -> (text: string[20000])", |_| Ok(()));
    pair.publish();
    let (sent, mut back) = (text(20_000), text(20_000));
    pair.block_request("echo", &mut *back).unwrap();
    assert!(back.variable::<&str>("text") == sent.variable("text"));
    assert!(pair.agv.counter(LinkCounter::BytesReceived) > 20_000);
}

#[test]
fn two_messages_cross_on_a_slow_link() {
    let mut pair = Pair::live();
    for side in [&mut pair.agv, &mut pair.manager] {
        side.offer("echo(text: string[20000]) -> (text: string[20000])", |_| Ok(()));
        side.publish();
    }
    pair.settle();
    (pair.agv.net.capacity, pair.manager.net.capacity) = (77, 100);
    let down = pair.manager.call("echo", &text(20_000)).unwrap();
    let up = pair.agv.call("echo", &text(19_000)).unwrap();
    pair.settle();
    assert_eq!(pair.manager.outcome(down).unwrap().unwrap().variable::<&str>("text").unwrap().len(), 20_000);
    assert_eq!(pair.agv.outcome(up).unwrap().unwrap().variable::<&str>("text").unwrap().len(), 19_000);
}

#[test]
fn a_request_that_does_not_fit_the_signature_is_not_sent() {
    let mut pair = Pair::live();
    pair.agv.offer("go(x: int, name: string[3])", |_| Ok(()));
    pair.publish();
    let sent = pair.manager.net.writes.len();
    let wrong_type = parameters(|p| p.add_float("x", 1).unwrap());
    let wrong_size = parameters(|p| p.add_int("x", 2).unwrap());
    let expected = Error::WrongSize { index: 0, expected: 1, found: 2 };
    assert_eq!(pair.manager.call("come", &x(1)), Err(Error::UnknownFunction));
    assert_eq!(pair.manager.call("go", &none()), Err(Error::MissingArgument { index: 0 }));
    assert_eq!(pair.manager.call("go", &x(1)), Err(Error::MissingArgument { index: 1 }));
    assert_eq!(pair.manager.call("go", &wrong_type), Err(Error::WrongType { index: 0 }));
    assert_eq!(pair.manager.call("go", &wrong_size), Err(expected));
    assert_eq!((pair.manager.net.writes.len(), pair.manager.counter(LinkCounter::RequestsWithheld)), (sent, 5));
}

#[test]
fn the_callee_checks_what_the_caller_should_have_checked() {
    let mut pair = Pair::live();
    pair.agv.offer("go(x: int, name: string[3])", |_| Ok(()));
    pair.publish();
    let reported = pair.agv.functions.function(pair.agv.functions.find("go").unwrap()).unwrap();
    let header = RequestHeader {
        id: 7,
        slot: reported.slot,
        generation: reported.generation,
        wants_reply: false,
        wants_progress: false,
        takes_over: false,
        operator: false,
        unknown: 0,
        remaining: Duration::from_secs(1),
        stamp: pair.agv.now.as_micros(),
        since: Duration::ZERO,
        number: 1,
    };
    // Too short, too long, and a text that is not UTF-8.
    let no_text = [&[0; 8][..], &[3, 0, 0, 0, 0, 0, 0, 0], &[0xFF, 0xFE, 0xFD, 0, 0, 0, 0, 0]].concat();
    for (id, block) in [(7, &[0; 8][..]), (8, &[0; 64][..]), (9, &no_text)] {
        pair.agv.hear_request(&RequestHeader { id, ..header }, Priority::Normal, block);
    }
    pair.settle();
    assert!(pair.agv.ran().is_empty());
    assert_eq!(pair.agv.counter(LinkCounter::RequestsRejected), 3);
    assert_eq!(pair.manager.counter(LinkCounter::RepliesLate), 3, "its caller never made them");
}

#[test]
fn results_that_would_not_fit_are_known_before_the_call_is_sent() {
    let mut pair = Pair::with_position();
    let mut small: Parameters<8> = Parameters::sized();
    let refused = pair.block_request("pos_info", &mut small);
    assert!(matches!(refused, Err(Error::ResultWouldNotFit { need: _, have: 8 })), "{refused:?}");
    assert!(pair.agv.ran().is_empty());
}

#[test]
fn a_call_without_answer_times_out_and_its_late_answer_is_counted() {
    let mut pair = Pair::live();
    pair.agv.offer_held("wait()");
    pair.publish();
    let id = pair.manager.call("wait", &none()).unwrap();
    pair.run(Duration::from_micros(1_999_999));
    assert_eq!(pair.manager.outcome(id), None);
    pair.run(Duration::from_micros(1));
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::TimedOut);
    assert_eq!((pair.manager.session.calls_in_flight(), pair.manager.counter(LinkCounter::CallsTimedOut)), (0, 1));
    pair.agv.answer_held(Ok(&*none()));
    pair.settle();
    assert_eq!(pair.manager.counter(LinkCounter::RepliesLate), 1);
    assert_eq!(pair.manager.count(|event| matches!(event, Event::Reply(..))), 1);
}

#[test]
fn a_time_out_frees_a_slot_of_a_full_table() {
    let mut pair = Pair::with(&Setup { agv: Constraints::M_UNIT, ..Setup::default() });
    pair.agv.offer_held("wait()");
    pair.publish();
    pair.manager.net.frozen = true;
    for _ in 0..128 {
        pair.manager.call("wait", &none()).unwrap();
    }
    assert_eq!(pair.manager.call("wait", &none()), Err(Error::Full(Limit::Calls)));
    pair.run(Duration::from_secs(2));
    assert_eq!(pair.manager.session.calls_in_flight(), 0);
    assert!(pair.manager.call("wait", &none()).is_ok());
}

#[test]
fn a_call_that_is_given_up_ends_without_an_event() {
    let mut pair = Pair::live();
    pair.agv.offer_held("wait()");
    pair.publish();
    let id = pair.manager.call("wait", &none()).unwrap();
    pair.settle();
    pair.manager.cancel(id);
    pair.settle();
    pair.agv.answer_held(Ok(&*none()));
    pair.run(Duration::from_secs(3));
    assert_eq!((pair.manager.outcome(id), pair.manager.counter(LinkCounter::RepliesLate)), (None, 1));
    let counted = [LinkCounter::CallsCancelled, LinkCounter::CallsTimedOut].map(|which| pair.manager.counter(which));
    assert_eq!(counted, [1, 0]);
}

#[test]
fn a_time_out_that_the_caller_notices_first_is_one() {
    let mut pair = Pair::live();
    pair.agv.offer_held("wait()");
    pair.publish();
    let id = pair.manager.call("wait", &none()).unwrap();
    pair.manager.now = pair.manager.now + Duration::from_secs(2);
    pair.manager.cancel(id);
    let counted = [LinkCounter::CallsCancelled, LinkCounter::CallsTimedOut].map(|which| pair.manager.counter(which));
    assert_eq!(counted, [0, 1]);
}

#[test]
fn a_failing_service_says_why() {
    let mut pair = Pair::live();
    pair.agv.offer("fail()", |_| Err(ServiceError::Failed(7).into()));
    pair.agv.offer("lie() -> (x: int)", |results| {
        results.clear();
        results.add_float("x", 1)
    });
    pair.publish();
    let failed = pair.block_request("fail", &mut *none());
    assert_eq!(failed, Err(Error::Service(ServiceError::Failed(7))));
    assert_eq!(pair.block_request("lie", &mut *x(5)), Err(Error::Service(ServiceError::BadResults)));
    let id = pair.manager.notify("fail", &none()).unwrap();
    pair.settle();
    assert!(pair.manager.has(&Event::Failed(id, Error::Service(ServiceError::Failed(7)))));
}

#[test]
fn a_failure_ends_the_call_that_it_names_and_no_other() {
    let mut pair = Pair::live();
    pair.agv.offer_held("wait()");
    pair.publish();
    let failed = Error::Service(ServiceError::Failed(3));
    let fail = |pair: &mut Pair, id: u32| {
        pair.manager.hear_message(&encode_failure(id, failed), Priority::Normal);
        pair.settle();
    };
    let [first, second] = [(); 2].map(|()| pair.manager.call("wait", &none()).unwrap());
    let never_made = second.0 + 1;
    fail(&mut pair, never_made);
    assert_eq!(pair.manager.session.calls_in_flight(), 2);
    assert!(!pair.manager.has(&Event::Failed(CallId(never_made), failed)));
    assert_eq!(pair.manager.counter(LinkCounter::RepliesLate), 1);
    fail(&mut pair, second.0);
    assert_eq!(pair.manager.outcome(second), Some(Err(failed)));
    assert_eq!((pair.manager.outcome(first), pair.manager.session.calls_in_flight()), (None, 1));
    let event = |event: &Event| matches!(event, Event::Failed(..));
    assert_eq!(pair.manager.count(event), 0, "a call that waited has one outcome");
}

#[test]
fn an_answer_that_finds_no_room_goes_out_when_there_is_some() {
    let mut pair = Pair::with(&Setup { buffers: 2, ..Setup::default() });
    pair.agv.offer("echo(text: string[20000]) -> (text: string[20000])", |_| Ok(()));
    pair.publish();
    pair.agv.net.capacity = 0;
    let others = pair.agv.take_buffers();
    let id = pair.manager.call("echo", &text(100)).unwrap();
    pair.settle();
    assert_eq!((pair.manager.outcome(id), pair.agv.counter(LinkCounter::SendRefused) > 0), (None, true));
    pair.agv.give_buffers(others);
    pair.agv.net.capacity = 10;
    pair.settle();
    assert!(pair.manager.outcome(id).unwrap().is_ok());
}

#[test]
fn nothing_can_be_requested_before_the_link_is_live() {
    let mut pair = Pair::connected(&Setup::default());
    assert_eq!(pair.manager.call("go", &none()), Err(Error::NotConnected));
    pair.settle();
    assert_eq!(pair.manager.call("go", &none()), Err(Error::UnknownFunction));
}

#[test]
fn what_an_emergency_or_a_datagram_cannot_carry_is_too_large() {
    let mut pair = Pair::live();
    pair.agv.offer("log(text: string[20000])", |_| Ok(()));
    pair.publish();
    let emergency = RequestOptions { priority: Some(Priority::Emergency), ..RequestOptions::default() };
    let limit = EMERGENCY_BYTES as u32 - 32;
    let refused = pair.manager.request_with("log", &text(250), &emergency, false);
    assert_eq!(refused, Err(Error::TooLarge { limit }));
    let datagram = RequestOptions { delivery: Delivery::BestEffort, ..RequestOptions::default() };
    let refused = pair.manager.request_with("log", &text(1_400), &datagram, false);
    assert_eq!(refused, Err(Error::TooLarge { limit: 1_400 - 32 }));
    assert_eq!(pair.manager.request_with("log", &text(9), &datagram, true), Err(Error::BadConstraint));
}
