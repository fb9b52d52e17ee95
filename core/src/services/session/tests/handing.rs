//! Hand-over on a link: what a vehicle refuses, and what stays with it.

use super::super::Event;
use super::none;
use super::pair::Pair;
use super::side::context;
use super::yielding::newcomer;
use crate::config::Priority;
use crate::distribution::connection_handler::Directive;
use crate::distribution::function::Attributes;
use crate::distribution::hello::Manager;
use crate::distribution::message::HandOverRefusal;
use crate::error::{CloseReason, Error};
use crate::host::mailman::LinkId;
use crate::services::Context;
use crate::services::lease::{Latch, LeaseEnd, Service as _};
use crate::time::Duration;

const LEASE: Duration = Duration::from_millis(500);
const STOP: Attributes =
    Attributes { priority: Priority::Emergency, idempotent: true, stop: true, ..Attributes::NORMAL };

/// Makes something stand against it.
type Arrange = fn(&mut Pair);

fn other() -> Manager {
    Manager::new("other", 2).unwrap()
}

/// A vehicle that can be handed over: it has keys, and stores claims.
fn vehicle() -> Pair {
    let mut pair = Pair::live();
    pair.agv.offer_leased("go()", LEASE);
    pair.agv.offer_control("halt()", STOP, None);
    pair.publish();
    pair.agv.paired = true;
    pair.agv.hub.hub.node.store_claims();
    pair
}

fn hand_over(pair: &mut Pair, to: &Manager) -> Option<Result<(), HandOverRefusal>> {
    pair.manager.session.hand_over(context!(pair.manager), to).unwrap();
    pair.settle();
    pair.manager.session.hand_over_answer()
}

#[test]
fn a_vehicle_leaves_at_once_and_keeps_latch_and_last_order() {
    let mut pair = vehicle();
    let go = pair.agv.functions.find("go").unwrap();
    for function in ["go", "halt"] {
        pair.manager.call(function, &none()).unwrap();
        pair.settle();
    }
    pair.run(Duration::from_millis(50));
    // Both are the vehicle's: no link holds them.
    let kept = |pair: &Pair| pair.agv.functions.function(go).unwrap().handler.lease().unwrap().state();
    let before = kept(&pair);
    assert_eq!(before.latch, Some(Latch { by: 1, reason: 0 }));
    assert_eq!(before.last.and_then(|last| last.end), Some(LeaseEnd::Stopped));
    assert_eq!(hand_over(&mut pair, &other()), Some(Ok(())));
    assert!(pair.manager.has(&Event::Answered) && pair.manager.has(&Event::Closed(CloseReason::Stopped)));
    assert!(pair.agv.has(&Event::Closed(CloseReason::StoppedHere)));
    let hello = pair.agv.hub.hub.node.hello(pair.agv.now, LinkId(3), 9);
    assert_eq!(hello.wanted, Some(other()));
    assert_eq!(kept(&pair), before);
}

#[test]
fn a_vehicle_that_cannot_go_says_why_and_stays() {
    let own = Manager::new("manager", 1).unwrap();
    let cases: [(HandOverRefusal, &Manager, Arrange); 4] = [
        (HandOverRefusal::NoKey, &other(), |pair| pair.agv.paired = false),
        (HandOverRefusal::Other, &own, |_| ()),
        (HandOverRefusal::Moves, &other(), |pair| {
            pair.manager.call("go", &none()).unwrap();
        }),
        (HandOverRefusal::NotStored, &other(), |pair| {
            let fresh = super::setup::hub(true, "manager", *pair.agv.session.constraints(), true);
            pair.agv.hub.hub = fresh;
            let (now, hello) = (pair.agv.now, pair.agv.session.hello().unwrap().clone());
            let (link, from) = (LinkId(2), pair.agv.session.address());
            pair.agv.hub.hub.node.admit(now, link, from, &hello);
        }),
    ];
    for (refusal, to, arrange) in cases {
        let mut pair = vehicle();
        arrange(&mut pair);
        pair.settle();
        assert_eq!(hand_over(&mut pair, to), Some(Err(refusal)));
        assert!(pair.agv.session.is_live() && pair.manager.session.is_live(), "{refusal:?}");
        let hello = pair.agv.hub.hub.node.hello(pair.agv.now, LinkId(3), 9);
        assert_eq!(hello.wanted.as_ref(), Some(&own), "{refusal:?}");
    }
}

#[test]
fn only_a_vehicle_is_handed_over_and_only_by_its_manager() {
    let mut pair = vehicle();
    let asked = pair.agv.session.hand_over(context!(pair.agv), &other());
    assert_eq!(asked, Err(Error::Unsupported), "a manager is not asked");
    pair.cut();
    pair.settle();
    let asked = pair.manager.session.hand_over(context!(pair.manager), &other());
    assert_eq!(asked, Err(Error::NotConnected));
}

/// A vehicle that does not know hand-over answers nothing, and one that is slow answers late.
#[test]
fn only_the_answer_to_the_last_question_counts() {
    let own = Manager::new("manager", 1).unwrap();
    let mut pair = vehicle();
    pair.manager.session.hand_over(context!(pair.manager), &own).unwrap();
    pair.manager.session.hand_over(context!(pair.manager), &other()).unwrap();
    assert_eq!(pair.manager.session.hand_over_answer(), None);
    let answered = |pair: &mut Pair, refusal| pair.manager.session.handing.answered(refusal);
    assert!(!answered(&mut pair, Some(HandOverRefusal::Other)));
    assert_eq!(pair.manager.session.hand_over_answer(), None, "that of the first");
    assert!(answered(&mut pair, None));
    assert_eq!(pair.manager.session.hand_over_answer(), Some(Ok(())));
    assert!(!answered(&mut pair, Some(HandOverRefusal::Moves)), "nobody asked");
    assert_eq!(pair.manager.session.hand_over_answer(), Some(Ok(())));
}

#[test]
fn a_manager_that_was_left_moves_nothing_and_what_is_behind_its_call_goes_on() {
    let mut pair = vehicle();
    let own = pair.agv.session.hello().unwrap().identity.clone();
    pair.agv.hub.hub.node.belong_to(&own, &other().identity().unwrap());
    let go = pair.manager.call("go", &none()).unwrap();
    pair.manager.call("halt", &none()).unwrap();
    pair.settle();
    assert_eq!(pair.manager.outcome(go).unwrap().unwrap_err(), Error::Busy);
    assert_eq!(pair.agv.held.len(), 1);
    assert!(!pair.agv.session.awaits_claim());
}

#[test]
fn a_manager_that_is_to_give_way_hands_nothing_over() {
    let mut pair = vehicle();
    newcomer(&mut pair);
    pair.agv.direct(Directive::Yield);
    assert_eq!(hand_over(&mut pair, &other()), Some(Err(HandOverRefusal::Moves)));
    let hello = pair.agv.hub.hub.node.hello(pair.agv.now, LinkId(3), 9);
    assert_eq!(hello.wanted, Some(Manager::new("manager", 1).unwrap()));
}
