//! Failures with text and values, progress, and calls that are given up.

use std::string::String;

use super::super::due::Part;
use super::super::{Event, Incoming, RequestOptions};
use super::net::Datagrams;
use super::pair::Pair;
use super::setup::Setup;
use super::side::{Side, context};
use super::{none, x};
use crate::config::{FAILURE_TEXT_BYTES, LEASES, PROGRESS_INTERVAL, Priority};
use crate::distribution::connection_handler::Directive;
use crate::distribution::failure::Failure;
use crate::distribution::function::Attributes;
use crate::distribution::function_list::Slot;
use crate::distribution::message::{Release, SessionBody, encode_failure, encode_progress};
use crate::error::{Error, Limit, ServiceError};
use crate::host::connections::LinkCounter;
use crate::host::frame::Frame;
use crate::services::Context;
use crate::services::heart::Renew;
use crate::services::lease::{Held, LeaseEnd};
use crate::services::requests::CallId;
use crate::time::{Duration, Instant};

const LEASE: Duration = Duration::from_millis(400);
const GO: &str = "go(x: int) -> (x: int) progress (x: int) fails (at: int[2])";

impl Side {
    fn fail(&mut self, failure: &Failure) -> Result<(), Error> {
        let call = self.held.remove(0);
        self.session.answer_failed(context!(self), call.ticket, failure)
    }

    fn report_progress(&mut self, call: &Incoming, value: i64) -> Result<(), Error> {
        self.session.progress(context!(self), call.ticket, &x(value))
    }

    fn cancel_but_wait(&mut self, id: CallId) {
        self.session.cancel_but_wait(context!(self), id);
    }

    /// How many running calls the port was notified of as given up.
    fn cancelled(&self) -> usize {
        self.count(|event| matches!(event, Event::Cancelled(_)))
    }

    fn stops(&self) -> usize {
        self.count(|event| matches!(event, Event::LeaseExpired(_)))
    }

    /// Does something while the stream is stuck and full. No datagram arrives from here on.
    fn without_room(&mut self, act: impl FnOnce(&mut Self)) {
        (self.net.frozen, self.net.capacity, self.net.datagrams) = (true, 0, Datagrams::Lost);
        (0..1_000).for_each(|_| self.direct(Directive::Challenge));
        act(self);
        assert!(self.session.wire.due.at(Part::Releases) < Instant::FAR_FUTURE, "a release found room");
        (self.net.frozen, self.net.capacity) = (false, 1 << 20);
    }

    fn watched(&mut self, function: &str) -> CallId {
        let options = RequestOptions { progress: true, ..RequestOptions::renewing(Renew::Process) };
        self.request_with(function, &x(1), &options, true).unwrap()
    }
}

fn blocked(text: &str) -> Failure {
    let mut failure = Failure::new(7, text);
    failure.values_mut().add_int("at", 2).unwrap();
    failure.values_mut().set_value("at", [3, 4]).unwrap();
    failure
}

fn with(function: &str) -> Pair {
    let mut pair = Pair::live();
    pair.agv.offer_held(function);
    pair.publish();
    pair
}

fn moving() -> (Pair, Slot) {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_held_lease("go(x: int)", LEASE);
    pair.publish();
    (pair, slot)
}

fn begin(pair: &mut Pair, function: &str) -> (CallId, Incoming) {
    let id = pair.manager.watched(function);
    pair.settle();
    (id, *pair.agv.held.last().unwrap())
}

fn dropped(side: &Side) -> u64 {
    side.counter(LinkCounter::DetailsDropped)
}

// --- failures

#[test]
fn a_failure_brings_its_code_its_text_and_its_values() {
    for (definition, values) in [(GO, true), ("go(x: int)", false)] {
        let mut pair = with(definition);
        let id = pair.manager.call("go", &x(1)).unwrap();
        pair.settle();
        pair.agv.fail(&blocked("the way is blocked")).unwrap();
        pair.settle();
        assert_eq!(pair.manager.outcome(id), Some(Err(Error::Service(ServiceError::Failed(7)))));
        let failure = &pair.manager.failures[0];
        assert_eq!((failure.code(), failure.text()), (7, "the way is blocked"));
        assert_eq!(failure.values().variable("at"), if values { Ok([3, 4]) } else { Err(Error::UnknownVariable) });
        assert_eq!(dropped(&pair.agv), u64::from(!values), "values that are not declared are dropped");
    }
}

#[test]
fn a_request_that_waits_for_nothing_gets_the_text_of_its_failure() {
    let mut pair = with(GO);
    let id = pair.manager.notify("go", &x(1)).unwrap();
    pair.run(Duration::from_millis(5));
    pair.agv.fail(&blocked("the way is blocked")).unwrap();
    pair.settle();
    assert!(pair.manager.has(&Event::Failed(id, Error::Service(ServiceError::Failed(7)))));
    assert_eq!(pair.manager.failures[0].text(), "the way is blocked");
}

#[test]
fn a_text_that_is_too_long_is_cut_between_two_characters_and_counted() {
    let mut pair = with(GO);
    let long: String = core::iter::repeat_n('ö', FAILURE_TEXT_BYTES).collect();
    let failure = blocked(&std::format!("x{long}"));
    assert_eq!(failure.text().len(), FAILURE_TEXT_BYTES - 1);
    pair.manager.call("go", &x(1)).unwrap();
    pair.settle();
    pair.agv.fail(&failure).unwrap();
    pair.settle();
    assert_eq!((pair.manager.failures[0].text(), dropped(&pair.agv)), (failure.text(), 1));
}

#[test]
fn what_does_not_fit_an_emergency_loses_its_values_and_keeps_its_text() {
    let mut pair = with("stop(x: int) fails (note: string[240])");
    let options = RequestOptions { priority: Some(Priority::Emergency), ..RequestOptions::default() };
    let id = pair.manager.request_with("stop", &x(1), &options, true).unwrap();
    pair.settle();
    let mut failure = Failure::new(9, "no brake");
    failure.values_mut().add_string("note", 240).unwrap();
    failure.values_mut().set_value("note", std::str::from_utf8(&[b'n'; 240]).unwrap()).unwrap();
    pair.agv.fail(&failure).unwrap();
    pair.settle();
    assert_eq!(pair.manager.outcome(id), Some(Err(Error::Service(ServiceError::Failed(9)))));
    assert_eq!(pair.manager.failures[0].text(), "no brake");
    assert!(pair.manager.failures[0].values().is_empty() && dropped(&pair.agv) == 1);
}

#[test]
fn a_failure_that_finds_no_buffer_keeps_its_code() {
    let mut pair = with(GO);
    let id = pair.manager.call("go", &x(1)).unwrap();
    pair.settle();
    let taken = pair.agv.take_buffers();
    pair.agv.net.capacity = 0;
    pair.agv.fail(&blocked("the way is blocked")).unwrap();
    pair.agv.give_buffers(taken);
    pair.agv.net.capacity = 1 << 20;
    pair.run(Duration::from_millis(50));
    assert_eq!(pair.manager.outcome(id), Some(Err(Error::Service(ServiceError::Failed(7)))));
    assert!(pair.manager.failures.is_empty() && dropped(&pair.agv) == 1);
}

#[test]
fn details_that_cannot_be_read_leave_the_code() {
    for behind in [&[200_u8, 0, 0, 0, 0, 0, 0, 0, b'x'][..], &[1, 0, 0, 0, 0, 0, 0, 0, 0xFF, 0, 0, 0, 0, 0, 0, 0], &[1]]
    {
        let mut pair = with(GO);
        let error = Error::Service(ServiceError::Failed(7));
        let id = pair.manager.notify("go", &x(1)).unwrap();
        let message = [&encode_failure(id.0, error)[..], behind].concat();
        pair.manager.hear_message(&message, Priority::Normal);
        pair.settle();
        assert!(pair.manager.has(&Event::Failed(id, error)) && pair.manager.failures.is_empty());
    }
}

// --- progress

#[test]
fn progress_comes_to_a_caller_that_wants_it_and_not_behind_the_reply() {
    let mut pair = with(GO);
    let (id, call) = begin(&mut pair, "go");
    assert_eq!(pair.agv.report_progress(&call, 10), Ok(()));
    pair.settle();
    assert_eq!(pair.manager.progress, [(id, 10)]);
    pair.agv.answer_held(Ok(&*x(3)));
    assert_eq!(pair.agv.report_progress(&call, 20), Ok(()), "the call has ended");
    pair.run(PROGRESS_INTERVAL.times(3));
    assert_eq!((pair.manager.progress.len(), pair.agv.counter(LinkCounter::ProgressSent)), (1, 1));

    pair.manager.call("go", &x(1)).unwrap();
    pair.settle();
    let call = pair.agv.held[0];
    assert_eq!(pair.agv.report_progress(&call, 30), Ok(()), "it wants none");
    pair.settle();
    assert_eq!(pair.agv.counter(LinkCounter::ProgressSent), 1);
    pair.agv.answer_held(Ok(&*x(3)));
}

#[test]
fn progress_waits_for_its_interval_and_for_an_empty_stream() {
    let mut pair = with(GO);
    let (id, call) = begin(&mut pair, "go");
    let full = Err(Error::Full(Limit::SendQueue));
    assert_eq!((pair.agv.report_progress(&call, 1), pair.agv.report_progress(&call, 2)), (Ok(()), full));
    pair.run(PROGRESS_INTERVAL);
    assert_eq!(pair.agv.report_progress(&call, 3), Ok(()));
    pair.run(PROGRESS_INTERVAL);
    pair.agv.net.capacity = 0;
    pair.agv.session.wire.send_frame(&Frame::Ping);
    assert_eq!(pair.agv.report_progress(&call, 4), full);
    pair.agv.net.capacity = 1 << 20;
    pair.settle();
    pair.run(PROGRESS_INTERVAL);
    assert_eq!(pair.agv.report_progress(&call, 5), Ok(()));
    pair.settle();
    assert_eq!(pair.manager.progress, [(id, 1), (id, 3), (id, 5)]);
}

#[test]
fn progress_that_does_not_fit_is_refused_by_either_end() {
    let mut pair = with(GO);
    let (id, call) = begin(&mut pair, "go");
    let wrong = pair.agv.session.progress(context!(pair.agv), call.ticket, &none());
    assert_eq!(wrong, Err(Error::MissingArgument { index: 0 }));
    for (call, block) in [(id.0, &[1; 7][..]), (id.0 + 1, &[0; 8])] {
        pair.manager.hear_message(&[&encode_progress(call)[..], block].concat(), Priority::Low);
        pair.settle();
    }
    assert_eq!((pair.manager.progress.len(), pair.manager.counter(LinkCounter::ProgressDropped)), (0, 2));
    assert!(pair.manager.session.is_live());
}

// --- cancellation

#[test]
fn a_call_that_is_cancelled_is_told_to_its_handler_once_and_its_order_ends() {
    let (mut pair, slot) = moving();
    let (id, call) = begin(&mut pair, "go");
    assert!(pair.agv.is_live(slot) && !pair.agv.session.is_cancelled(call.ticket));
    pair.manager.cancel(id);
    pair.settle();
    assert_eq!((pair.agv.cancelled(), pair.agv.stops()), (1, 1));
    assert!(!pair.agv.is_live(slot) && pair.agv.session.is_cancelled(call.ticket));
    pair.agv.answer_held(Ok(&*none()));
    pair.run(LEASE);
    assert_eq!((pair.manager.outcome(id), pair.manager.counter(LinkCounter::RepliesLate)), (None, 1));
    assert_eq!((pair.agv.cancelled(), pair.agv.stops()), (1, 1));
}

#[test]
fn a_release_without_room_is_sent_later_though_the_answer_is_waited_for() {
    for renew in [Renew::Process, Renew::Never] {
        let (mut pair, slot) = moving();
        let options = RequestOptions { timeout: Some(Duration::from_secs(60)), ..RequestOptions::renewing(renew) };
        let id = pair.manager.request_with("go", &x(1), &options, true).unwrap();
        pair.settle();
        assert!(pair.agv.is_live(slot));
        pair.manager.without_room(|manager| manager.cancel_but_wait(id));
        pair.run(Duration::from_millis(20));
        assert_eq!((pair.agv.is_live(slot), pair.agv.stops()), (false, 1), "{renew:?}");
        pair.agv.answer_held(Ok(&*none()));
        pair.settle();
        assert!(pair.manager.outcome(id).unwrap().is_ok());
    }
}

/// A vehicle that runs one call of each function, none of which is renewed.
fn unrenewed(functions: [&str; LEASES]) -> (Pair, [(CallId, Slot); LEASES]) {
    let (mut pair, _) = moving();
    let slots = functions.map(|function| pair.agv.offer_held_lease(&std::format!("{function}(x: int)"), LEASE));
    pair.publish();
    let options = RequestOptions::renewing(Renew::Never);
    let calls = functions.map(|function| pair.manager.request_with(function, &x(1), &options, true).unwrap());
    pair.settle();
    assert!(slots.iter().all(|slot| pair.agv.is_live(*slot)));
    (pair, core::array::from_fn(|at| (calls[at], slots[at])))
}

#[test]
fn a_release_without_room_is_sent_later_though_the_table_of_leases_is_full() {
    let (mut pair, calls) = unrenewed(["lift", "tilt", "turn", "dock"]);
    let others = ["back", "left", "right"];
    others.iter().for_each(|other| _ = pair.agv.offer_held_lease(&std::format!("{other}(x: int)"), LEASE));
    pair.publish();
    pair.manager.net.frozen = true;
    for function in others.iter().chain(&["go"]) {
        pair.manager.watched(function);
    }
    assert!(pair.manager.session.calling.held.is_full());
    pair.manager.without_room(|manager| calls.iter().for_each(|(call, _)| manager.cancel_but_wait(*call)));
    pair.run(Duration::from_millis(20));
    assert!(calls.iter().all(|(_, slot)| !pair.agv.is_live(*slot)));
}

#[test]
fn a_release_without_room_waits_once_though_the_call_is_cancelled_again() {
    let (mut pair, calls) = unrenewed(["lift", "tilt", "turn", "dock"]);
    let (call, slot) = calls[0];
    pair.manager.without_room(|manager| {
        manager.cancel_but_wait(call);
        assert!(!manager.session.calling.held.iter().all(Held::is_renewed));
        manager.cancel(call);
        assert!(manager.session.calling.held.iter().all(Held::is_renewed));
    });
    pair.run(Duration::from_millis(20));
    assert!(!pair.agv.is_live(slot));
}

/// It is not refused, and no release is lost.
#[test]
fn a_renewed_call_finds_a_place_among_releases_without_room() {
    let (mut pair, calls) = unrenewed(["lift", "tilt", "turn", "dock"]);
    pair.manager.without_room(|manager| {
        calls.iter().for_each(|(call, _)| manager.cancel_but_wait(*call));
        assert!(manager.session.calling.held.is_full());
        let id = manager.watched("go");
        assert!(manager.session.holds(id));
    });
    pair.run(Duration::from_millis(20));
    assert!(calls.iter().all(|(_, slot)| !pair.agv.is_live(*slot)));
}

/// A release that can be kept nowhere else keeps its place.
#[test]
fn a_renewed_call_is_refused_where_it_would_cost_a_release() {
    let (mut pair, calls) = unrenewed(["lift", "tilt", "turn", "dock"]);
    let others =
        ["back", "left", "right"].map(|other| pair.agv.offer_held_lease(&std::format!("{other}(x: int)"), LEASE));
    pair.publish();
    let go = pair.agv.functions.find("go").unwrap();
    pair.manager.without_room(|manager| {
        for slot in others.iter().chain(&[go]) {
            manager.release(*slot).unwrap();
        }
        calls.iter().for_each(|(call, _)| manager.cancel_but_wait(*call));
        let refused = manager.request_with("go", &x(1), &RequestOptions::renewing(Renew::Process), true);
        assert_eq!(refused, Err(Error::Full(Limit::Leases)));
    });
    pair.run(Duration::from_millis(20));
    assert!(calls.iter().all(|(_, slot)| !pair.agv.is_live(*slot)));
}

/// As it would be if none of them waited.
#[test]
fn a_newer_call_replaces_its_functions_earlier_one_beside_releases_without_room() {
    let (mut pair, calls) = unrenewed(["lift", "tilt", "turn", "dock"]);
    let first = pair.manager.watched("go");
    pair.manager.without_room(|manager| {
        calls[1..].iter().for_each(|(call, _)| manager.cancel_but_wait(*call));
        assert!(manager.session.calling.held.is_full());
        let second = manager.watched("go");
        assert!(!manager.session.holds(first) && manager.session.holds(second));
    });
    pair.run(Duration::from_millis(20));
    let live = calls.map(|(_, slot)| pair.agv.is_live(slot));
    assert_eq!(live, [true, false, false, false]);
}

/// It waits behind the first one, so it has not taken its place.
#[test]
fn a_release_without_room_is_of_its_call_alone() {
    for renew in [Renew::Process, Renew::Never] {
        let mut pair = Pair::with(&Setup { running: 1, ..Setup::default() });
        let slot = pair.agv.offer_held_lease("go(x: int)", LEASE);
        pair.publish();
        begin(&mut pair, "go");
        let second = pair.manager.request_with("go", &x(1), &RequestOptions::renewing(renew), true).unwrap();
        pair.settle();
        pair.manager.without_room(|manager| manager.cancel_but_wait(second));
        pair.run(Duration::from_millis(20));
        assert!(pair.agv.is_live(slot), "{renew:?}");
        pair.agv.answer_held(Ok(&*none()));
        pair.settle();
        assert_eq!((pair.agv.held.len(), pair.agv.is_live(slot)), (0, true), "{renew:?}");
        assert_eq!(pair.manager.outcome(second).map(|outcome| outcome.is_ok()), Some(false), "{renew:?}");
    }
}

#[test]
fn a_call_that_is_cancelled_stops_at_once_though_its_answer_is_waited_for() {
    let (mut pair, slot) = moving();
    let (id, call) = begin(&mut pair, "go");
    pair.manager.cancel_but_wait(id);
    pair.settle();
    assert_eq!((pair.agv.cancelled(), pair.agv.stops()), (1, 1));
    assert!(!pair.agv.is_live(slot) && pair.agv.session.is_cancelled(call.ticket));
    pair.run(LEASE);
    assert_eq!(pair.agv.counter(LinkCounter::RenewalsIgnored), 0, "nothing is renewed any more");
    assert!(!pair.agv.session.is_answered(call.ticket));
    pair.agv.fail(&blocked("given up")).unwrap();
    pair.settle();
    assert!(pair.agv.session.is_answered(call.ticket));
    assert_eq!(pair.manager.outcome(id).unwrap().unwrap_err(), Error::Service(ServiceError::Failed(7)));
    assert_eq!(pair.manager.counter(LinkCounter::RepliesLate), 0);
    assert_eq!((pair.agv.cancelled(), pair.agv.stops()), (1, 1));
}

#[test]
fn a_call_that_times_out_is_cancelled_as_well() {
    let mut pair = with(GO);
    begin(&mut pair, "go");
    pair.run(pair.manager.session.constraints().request_timeout);
    assert_eq!(pair.agv.cancelled(), 1);
}

#[test]
fn a_cancellation_does_not_end_the_order_that_has_taken_the_calls_place() {
    let (mut pair, slot) = moving();
    let (first, one) = begin(&mut pair, "go");
    let (_, two) = begin(&mut pair, "go");
    assert!(!pair.agv.continues(&one) && pair.agv.continues(&two));
    pair.manager.cancel(first);
    pair.run(LEASE);
    assert_eq!((pair.agv.cancelled(), pair.agv.stops()), (1, 0));
    assert!(pair.agv.continues(&two) && pair.agv.is_live(slot));
    assert!(!pair.agv.session.is_cancelled(two.ticket));
}

#[test]
fn a_call_that_has_not_begun_does_not_begin_once_it_is_cancelled() {
    let mut pair = Pair::with(&Setup { running: 1, ..Setup::default() });
    pair.agv.offer_held(GO);
    pair.publish();
    begin(&mut pair, "go");
    let second = pair.manager.watched("go");
    pair.settle();
    assert_eq!(pair.agv.held.len(), 1, "the second one waits");
    pair.manager.cancel(second);
    pair.settle();
    pair.agv.answer_held(Ok(&*x(1)));
    pair.settle();
    assert_eq!((pair.agv.held.len(), pair.agv.cancelled()), (0, 0));
    assert_eq!(pair.agv.counter(LinkCounter::RequestsExpired), 1);
}

#[test]
fn a_cancellation_that_comes_before_its_request_keeps_it_from_running() {
    let mut pair = with(GO);
    let next = pair.manager.session.calling.requests.newest().0 + 1;
    let cancel = SessionBody::cancel(&Release { call: next, class: Priority::Normal });
    pair.agv.hear_datagram(pair.agv.session.nonce(), &cancel);
    let id = pair.manager.watched("go");
    pair.settle();
    assert_eq!((id.0, pair.agv.held.len()), (next, 0));
    pair.manager.watched("go");
    pair.settle();
    assert_eq!(pair.agv.held.len(), 1, "another one does");
}

#[test]
fn a_cancellation_behind_the_answer_is_counted_and_changes_nothing() {
    let (mut pair, slot) = moving();
    let (id, _) = begin(&mut pair, "go");
    let cancel = SessionBody::cancel(&Release { call: id.0, class: Priority::Normal });
    pair.agv.answer_held(Ok(&*none()));
    pair.manager.cancel(CallId(900));
    pair.settle();
    assert_eq!(pair.agv.counter(LinkCounter::CancelsIgnored), 0, "the caller knows that it has no such call");
    let (_, two) = begin(&mut pair, "go");
    pair.agv.hear_datagram(pair.agv.session.nonce(), &cancel);
    pair.settle();
    assert_eq!((pair.agv.counter(LinkCounter::CancelsIgnored), pair.agv.cancelled()), (1, 0));
    assert!(pair.agv.continues(&two) && pair.agv.is_live(slot));
}

#[test]
fn a_cancellation_that_is_lost_with_the_link_leaves_the_end_to_the_link() {
    let (mut pair, slot) = moving();
    let (id, _) = begin(&mut pair, "go");
    (pair.manager.net.frozen, pair.manager.net.datagrams) = (true, Datagrams::Lost);
    pair.manager.cancel(id);
    pair.settle();
    assert_eq!((pair.agv.cancelled(), pair.agv.stops()), (0, 0));
    pair.cut();
    assert_eq!((pair.agv.cancelled(), pair.agv.stops()), (0, 1));
    assert!(!pair.agv.is_live(slot));
}

#[test]
fn a_reset_that_is_given_up_lets_nothing_move() {
    let mut pair = Pair::live();
    let slot = pair.agv.offer_leased("go(x: int)", LEASE);
    let stop = Attributes { stop: true, ..Attributes::default() };
    let reset = Attributes { reset: true, ..Attributes::default() };
    pair.agv.offer_control("stop(x: int)", stop, None);
    pair.agv.offer_control("reset(x: int)", reset, None);
    pair.publish();
    pair.manager.call("stop", &x(1)).unwrap();
    pair.settle();
    pair.agv.answer_held(Ok(&*none()));
    // Longer than the rounding of a latch's time.
    pair.run(Duration::from_millis(5));
    let id = pair.manager.call("reset", &x(1)).unwrap();
    pair.settle();
    pair.manager.cancel(id);
    pair.settle();
    pair.agv.answer_held(Ok(&*none()));
    let moved = pair.manager.call("go", &x(1)).unwrap();
    pair.run(Duration::from_millis(50));
    assert!(matches!(pair.manager.outcome(moved), Some(Err(Error::Inhibited { .. }))) && !pair.agv.is_live(slot));
}

#[test]
fn a_cancellation_ends_the_order_of_its_call_alone() {
    let mut pair = Pair::live();
    let one = pair.agv.offer_held_lease("go(x: int)", LEASE);
    let other = pair.agv.offer_held_lease("lift(x: int)", LEASE);
    pair.publish();
    let calls = [begin(&mut pair, "go").0, begin(&mut pair, "lift").0];
    pair.manager.cancel(calls[1]);
    pair.settle();
    assert!(pair.agv.is_live(one) && !pair.agv.is_live(other));
    assert!(!pair.manager.is_reported(calls[1], LeaseEnd::Expired), "the caller knows");
}
