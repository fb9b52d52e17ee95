//! What a manager's claim means for its calls, and how it gives way to another one of its identity with a higher claim.

use super::super::Event;
use super::net::Datagrams;
use super::none;
use super::pair::Pair;
use super::setup::Setup;
use super::side::context;
use crate::config::Constraints;
use crate::distribution::claim::{Claim, TaggedClaim};
use crate::distribution::connection_handler::{Admission, ClaimEvent, Command, Directive};
use crate::distribution::function_list::Slot;
use crate::distribution::hello::{ClaimReport, Hello};
use crate::distribution::identity::Epoch;
use crate::error::{CloseReason, Refusal};
use crate::host::mailman::LinkId;
use crate::host::secure::Plain;
use crate::services::Context;
use crate::time::Duration;

const LEASE: Duration = Duration::from_millis(500);

fn tagged(term: u64) -> TaggedClaim {
    TaggedClaim { claim: Claim { term, claimant: 1 }, ..TaggedClaim::NONE }
}

/// A pair whose manager has a claim of the fifth term.
fn claiming() -> Pair {
    Pair::prepared(&Setup::default(), |pair| pair.manager.hub.hub.node.set_claim(tagged(5)))
}

/// The same, and its vehicle moves.
fn moving() -> (Pair, Slot) {
    let mut pair = claiming();
    pair.settle();
    let go = pair.agv.offer_leased("go()", LEASE);
    pair.publish();
    pair.manager.call("go", &none()).unwrap();
    pair.settle();
    assert!(pair.agv.is_live(go));
    (pair, go)
}

fn due(pair: &mut Pair) -> Option<Command<core::net::SocketAddr>> {
    pair.agv.hub.hub.node.poll(pair.agv.now, &mut pair.agv.net, &Plain)
}

/// What tells the newcomer so.
fn refused(why: Refusal) -> Option<Command<core::net::SocketAddr>> {
    Some(Command::Notify(LinkId(9), Directive::Refuse(why)))
}

/// Another manager of the same identity, with a claim of the seventh term, asks the vehicle to take it.
pub(super) fn newcomer(pair: &mut Pair) {
    let now = pair.agv.now;
    let claim = Some(ClaimReport { tagged: tagged(7), since: 0 });
    let hello = Hello { epoch: Epoch(9), claim, ..pair.manager.hub.hub.node.hello(now, LinkId(9), 1) };
    let from = ([10, 0, 0, 9], 7_000).into();
    assert_eq!(pair.agv.hub.hub.node.admit(now, LinkId(9), from, &hello), Admission::Wait);
    let link = pair.agv.session.wire.link.id();
    assert_eq!(due(pair), Some(Command::Notify(link, Directive::Yield)));
}

/// It is to give way to another manager of its identity, which waits.
#[test]
fn a_manager_that_raises_its_claim_above_that_of_a_newcomer_stays() {
    for (raised, stays) in [(5, false), (6, false), (8, true)] {
        let mut pair = claiming();
        pair.run(Duration::from_secs(10));
        newcomer(&mut pair);
        pair.manager.hub.hub.node.set_claim(tagged(raised));
        pair.manager.session.announce_claim(context!(pair.manager));
        pair.agv.direct(Directive::Yield);
        assert!(pair.agv.session.granting.obedience.gives_way());
        pair.settle();
        assert_eq!((pair.agv.session.is_live(), pair.agv.session.granting.obedience.gives_way()), (stays, !stays));
        if stays {
            assert_eq!(due(&mut pair), refused(Refusal::Fenced));
        }
    }
}

/// Linux tells a link so on its own thread.
#[test]
fn a_raise_that_comes_before_the_link_is_told_to_give_way_counts() {
    for (raised, stays) in [(6, false), (8, true)] {
        let mut pair = claiming();
        pair.run(Duration::from_secs(10));
        newcomer(&mut pair);
        pair.manager.hub.hub.node.set_claim(tagged(raised));
        pair.manager.session.announce_claim(context!(pair.manager));
        pair.settle();
        pair.agv.direct(Directive::Yield);
        pair.settle();
        assert_eq!((pair.agv.session.is_live(), pair.agv.session.granting.obedience.gives_way()), (stays, !stays));
        assert_eq!(due(&mut pair), refused(Refusal::Fenced).filter(|_| stays));
    }
}

/// A manager with the same claim dials later, which decides nothing.
#[test]
fn a_manager_that_gives_way_has_time_for_each_answer() {
    let (mut pair, go) = moving();
    newcomer(&mut pair);
    for directive in [Directive::Yield, Directive::Challenge] {
        pair.agv.direct(directive);
        (pair.manager.net.frozen, pair.manager.net.datagrams) = (true, Datagrams::Lost);
        pair.run(Duration::from_millis(200));
        (pair.manager.net.frozen, pair.manager.net.datagrams) = (false, Datagrams::Pass);
        pair.settle();
        assert!(pair.agv.session.is_live() && pair.agv.is_live(go), "{directive:?}");
        pair.run(Duration::from_secs(1));
    }
    (pair.manager.net.frozen, pair.manager.net.datagrams) = (true, Datagrams::Lost);
    pair.agv.direct(Directive::Challenge);
    pair.run(Duration::from_millis(330));
    assert!(pair.agv.has(&Event::Closed(CloseReason::PeerRestarted)) && !pair.agv.is_live(go));
}

/// It asks again behind each refusal.
#[test]
fn a_newcomer_is_told_each_time_that_the_vehicle_drives() {
    let (mut pair, go) = moving();
    for _ in 0..3 {
        pair.run(Duration::from_secs(1));
        newcomer(&mut pair);
        pair.agv.direct(Directive::Yield);
        pair.settle();
        assert_eq!(due(&mut pair), refused(Refusal::Driving));
        assert!(pair.agv.is_live(go));
    }
}

#[test]
fn a_live_order_has_ten_seconds_however_often_it_is_to_give_way() {
    let (mut pair, go) = moving();
    for _ in 0..9 {
        newcomer(&mut pair);
        pair.agv.direct(Directive::Yield);
        pair.run(Duration::from_millis(1_100));
        assert_eq!(due(&mut pair), refused(Refusal::Driving));
        assert!(pair.agv.is_live(go) && pair.agv.session.is_live());
    }
    pair.run(Duration::from_millis(300));
    assert!(pair.agv.has(&Event::LeaseExpired(go)));
    assert!(pair.agv.has(&Event::Closed(CloseReason::PeerRestarted)));
}

/// A vehicle may be told to let orders go on for ever. What stands gives way all the same.
#[test]
fn however_long_orders_may_go_on_a_vehicle_that_stands_gives_way() {
    let constraints = Constraints { handover: Duration::MAX, ..Constraints::S_UNIT };
    let setup = Setup { agv: constraints, ..Setup::default() };
    let mut pair = Pair::prepared(&setup, |pair| pair.manager.hub.hub.node.set_claim(tagged(5)));
    pair.run(Duration::from_secs(1));
    newcomer(&mut pair);
    pair.agv.direct(Directive::Yield);
    pair.settle();
    assert!(pair.agv.has(&Event::Closed(CloseReason::PeerRestarted)));
}

#[test]
fn an_open_question_does_not_prolong_an_order() {
    let (mut pair, go) = moving();
    newcomer(&mut pair);
    pair.agv.direct(Directive::Yield);
    pair.run(Duration::from_millis(9_900));
    (pair.manager.net.frozen, pair.manager.net.datagrams) = (true, Datagrams::Lost);
    pair.agv.direct(Directive::Challenge);
    pair.run(Duration::from_millis(130));
    assert!(pair.agv.has(&Event::LeaseExpired(go)) && pair.agv.session.is_live());
}

/// However often it is asked, and though it owed an answer before.
#[test]
fn a_manager_that_is_silent_gives_way_after_its_first_question() {
    for first in [Directive::Yield, Directive::Challenge] {
        let (mut pair, go) = moving();
        newcomer(&mut pair);
        (pair.manager.net.frozen, pair.manager.net.datagrams) = (true, Datagrams::Lost);
        pair.agv.direct(first);
        for _ in 0..5 {
            pair.agv.direct(Directive::Yield);
            pair.run(Duration::from_millis(80));
        }
        assert!(pair.agv.has(&Event::Closed(CloseReason::PeerRestarted)) && !pair.agv.is_live(go));
    }
}

/// It cannot answer, so a manager with a higher claim does not wait for that.
#[test]
fn a_manager_that_does_not_hear_its_vehicle_is_not_asked_to_show_life() {
    for (silence, waits) in [(2_000, 100), (0, 400)] {
        let mut pair = Pair::live();
        pair.run(Duration::from_secs(10));
        pair.agv.net.datagrams = Datagrams::Lost;
        pair.agv.net.frozen = true;
        pair.run(Duration::from_millis(silence));
        newcomer(&mut pair);
        pair.agv.direct(Directive::Yield);
        let restarted = Event::Closed(CloseReason::PeerRestarted);
        if silence == 0 {
            pair.run(Duration::from_millis(200));
            assert!(!pair.agv.has(&restarted), "it may answer yet");
        }
        pair.run(Duration::from_millis(waits));
        assert!(pair.agv.has(&restarted), "{silence}");
    }
}

#[test]
fn a_raised_claim_is_stored_before_the_next_moving_call() {
    let mut pair = claiming();
    pair.settle();
    pair.agv.offer_leased("go()", LEASE);
    pair.publish();
    pair.agv.hub.hub.node.store_claims();
    let manager = pair.manager.hub.hub.node.identity().clone();
    for term in [5, 8] {
        pair.manager.hub.hub.node.set_claim(tagged(term));
        pair.manager.session.announce_claim(context!(pair.manager));
        pair.settle();
        let ran = pair.agv.ran.len();
        let call = pair.manager.call("go", &none()).unwrap();
        pair.settle();
        assert!(pair.agv.session.awaits_claim() && pair.agv.ran.len() == ran, "{term}");
        let keep = ClaimEvent::Keep(manager.clone(), tagged(term));
        assert_eq!(pair.agv.hub.hub.node.take_claim_event(), Some(keep));
        pair.agv.hub.hub.node.claim_kept(&manager, tagged(term).claim, true);
        pair.run(Duration::from_millis(50));
        assert!(pair.manager.outcome(call).unwrap().is_ok());
    }
}

/// A standby asks the vehicle how long ago its manager heard it.
#[test]
fn a_raised_claim_is_no_sign_that_the_manager_hears_the_vehicle() {
    let mut pair = claiming();
    let manager = pair.manager.hub.hub.node.identity().clone();
    let since = |pair: &Pair| pair.agv.hub.hub.node.obeyed_report(pair.agv.now, &manager).map(|report| report.since);
    pair.run(Duration::from_secs(10));
    (pair.agv.net.frozen, pair.agv.net.datagrams) = (true, Datagrams::Lost);
    pair.run(Duration::from_millis(1_600));
    assert!(since(&pair).is_some_and(|since| since >= 1_500), "{:?}", since(&pair));
    let (session, report) = (&mut pair.agv.session, ClaimReport { tagged: tagged(6), since: 0 });
    session.granting.obedience.claim_arrived(&mut session.wire, context!(pair.agv), &report);
    assert!(since(&pair).is_some_and(|since| since >= 1_500), "{:?}", since(&pair));
}
