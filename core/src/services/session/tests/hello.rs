//! How a link begins.

use super::super::Event;
use super::pair::Pair;
use super::setup::{self, Setup};
use crate::config::{HELLO_TIMEOUT, VERSIONS, Versions};
use crate::distribution::claim::{Claim, TaggedClaim};
use crate::distribution::connection_handler::Directive;
use crate::distribution::identity::Identity;
use crate::error::{CloseReason, Refusal};
use crate::time::{Duration, Instant};

#[test]
fn both_ends_learn_who_the_other_is() {
    let pair = Pair::live();
    assert_eq!(pair.manager.session.identity(), Some(&Identity::s_unit("agv-01", 1).unwrap()));
    assert_eq!(pair.agv.session.identity(), Some(&Identity::m_unit("manager", 1).unwrap()));
    for side in [&pair.manager, &pair.agv] {
        assert_eq!(side.happened.first(), Some(&Event::Joined));
        assert_eq!(side.count(|event| *event == Event::Joined), 1);
    }
}

#[test]
fn a_refusal_tells_the_reason_to_both() {
    for side_refuses in [true, false] {
        let mut pair = Pair::connected(&Setup::default());
        let refuses = if side_refuses { &mut pair.manager } else { &mut pair.agv };
        refuses.hub.hub = setup::hub(!side_refuses, "another", *refuses.session.constraints(), false);
        pair.settle();
        let closed = Event::Closed(CloseReason::Refused(Refusal::WrongManager));
        assert!(pair.manager.has(&closed), "{:?}", pair.manager.happened);
        assert!(pair.agv.has(&closed), "{:?}", pair.agv.happened);
    }
}

#[test]
fn a_claim_that_is_fenced_is_told_to_both() {
    let tagged = |term| TaggedClaim { claim: Claim { term, claimant: 1 }, ..TaggedClaim::NONE };
    let (over, newer) = (tagged(5), tagged(6));
    for manager_refuses in [true, false] {
        let obeys = |pair: &mut Pair| {
            let manager = pair.manager.hub.hub.node.identity().clone();
            pair.agv.hub.hub.node.keep_obeyed(Instant::START, &manager, newer);
        };
        let mut pair = Pair::prepared(&Setup::default(), |pair| {
            pair.manager.hub.hub.node.set_claim(over);
            if manager_refuses {
                obeys(pair);
            }
        });
        // The vehicle's hello was sent before it obeyed this claim, so the vehicle refuses.
        if !manager_refuses {
            obeys(&mut pair);
        }
        pair.settle();
        let closed = Event::Closed(CloseReason::Refused(Refusal::Fenced));
        assert!(pair.agv.has(&closed), "{:?}", pair.agv.happened);
        assert!(pair.manager.has(&closed), "{:?}", pair.manager.happened);
    }
}

#[test]
fn no_hello_in_time_ends_the_link() {
    let mut pair = Pair::connected(&Setup::default());
    pair.agv.net.frozen = true;
    pair.run(HELLO_TIMEOUT - Duration::from_micros(1));
    assert!(pair.manager.happened.is_empty());
    pair.run(Duration::from_micros(1));
    assert_eq!(pair.manager.happened, [Event::Closed(CloseReason::HelloTimeout)]);
}

#[test]
fn another_version_is_told_to_both() {
    let mut pair = Pair::connected(&Setup::default());
    let mut bytes = pair.agv.net.deliver().0;
    // After length, kind and magic: the first version that the end speaks.
    const FIRST: usize = 2 + 1 + 4;
    bytes[FIRST] += 1;
    pair.manager.hear(&bytes);
    pair.step();
    // The answer is its own hello, from which the other end learns its versions.
    let mut answer = pair.manager.net.deliver().0;
    assert_eq!(answer[2], 1, "a hello, and a refusal behind it");
    answer[FIRST] += 1;
    pair.agv.hear(&answer);
    pair.settle();
    let versions = Versions { first: VERSIONS.last + 1, last: VERSIONS.last + 1 };
    let closed = Event::Closed(CloseReason::Refused(Refusal::Version(versions)));
    for side in [&pair.manager, &pair.agv] {
        assert_eq!(side.happened, std::slice::from_ref(&closed));
    }
}

#[test]
fn what_is_no_hello_ends_the_link() {
    for bytes in [&b"GET / HTTP/1.1\r\n\r\n"[..], &[1, 0, 4], &[3, 0, 0x13, 2, 0]] {
        let mut pair = Pair::connected(&Setup::default());
        pair.manager.hear(bytes);
        pair.settle();
        assert!(pair.manager.session.is_ended(), "{bytes:?}");
    }
}

#[test]
fn what_follows_the_hello_waits_for_the_decision() {
    let mut pair = Pair::connected(&Setup::default());
    pair.agv.hub.waits = true;
    pair.settle();
    pair.manager.offer("stop()", |_| Ok(()));
    pair.manager.publish();
    pair.settle();
    assert!(pair.agv.session.their_function_list().is_empty());
    pair.agv.hub.waits = false;
    pair.agv.direct(Directive::Admit);
    pair.settle();
    assert_eq!(pair.agv.session.their_function_list().len(), 1);
}

/// The link that it has waited for has raised its claim, then ended.
#[test]
fn a_newcomer_whose_claim_is_the_lower_one_by_now_is_not_admitted() {
    let tagged = |term| TaggedClaim { claim: Claim { term, claimant: 1 }, ..TaggedClaim::NONE };
    let mut pair = Pair::prepared(&Setup::default(), |pair| pair.manager.hub.hub.node.set_claim(tagged(6)));
    pair.agv.hub.waits = true;
    pair.settle();
    pair.agv.hub.waits = false;
    let manager = pair.manager.hub.hub.node.identity().clone();
    pair.agv.hub.hub.node.keep_obeyed(Instant::START, &manager, tagged(7));
    pair.agv.direct(Directive::Admit);
    pair.settle();
    let closed = Event::Closed(CloseReason::Refused(Refusal::Fenced));
    assert!(pair.manager.has(&closed), "{:?}", pair.manager.happened);
    assert_eq!(pair.agv.happened, [closed]);
}

#[test]
fn a_newcomer_whose_link_has_ended_by_now_is_not_admitted() {
    let mut pair = Pair::connected(&Setup::default());
    pair.agv.hub.waits = true;
    pair.settle();
    pair.agv.direct(Directive::Close(CloseReason::Reset));
    pair.agv.hub.waits = false;
    pair.agv.direct(Directive::Admit);
    assert_eq!((pair.agv.hub.hub.node.connected(), pair.agv.has(&Event::Joined)), (0, false));
}

#[test]
fn a_challenge_is_answered_once_and_only_on_a_live_link() {
    let mut pair = Pair::connected(&Setup::default());
    pair.manager.direct(Directive::Challenge);
    pair.settle();
    assert!(pair.manager.session.is_live(), "{:?}", pair.agv.happened);
    let entered = |pair: &Pair| (pair.manager.hub.entered, pair.agv.hub.entered);
    let before = entered(&pair);
    pair.manager.direct(Directive::Challenge);
    pair.settle();
    assert_eq!(entered(&pair), (before.0 + 1, before.1), "it is in the stream and in several datagrams");
    assert!(!pair.manager.has(&Event::Answered), "only a ping is told of");
}
