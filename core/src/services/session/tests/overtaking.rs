//! Calls for one actuator never overtake each other, whatever their classes and in stream or datagram: the one made last counts.

use super::super::{Delivery, RequestOptions};
use super::none;
use super::pair::Pair;
use crate::config::Priority;
use crate::distribution::claim;
use crate::distribution::function_list::Slot;
use crate::error::Error;
use crate::services::lease::{Claim, Service as _};
use crate::services::requests::CallId;
use crate::time::Duration;

const LEASE: Duration = Duration::from_secs(60);

/// A vehicle whose `go()` and `dock()` move the drive, and `lift()` the fork.
fn vehicle() -> (Pair, [Slot; 3]) {
    let mut pair = Pair::live();
    let go = pair.agv.offer_leased("go()", LEASE);
    let dock = pair.agv.offer_sharing("dock()", LEASE, go);
    let lift = pair.agv.offer_leased("lift()", LEASE);
    pair.publish();
    (pair, [go, dock, lift])
}

fn in_class(pair: &mut Pair, function: &str, class: Priority) -> CallId {
    let options = RequestOptions { priority: Some(class), ..RequestOptions::new() };
    pair.manager.request_with(function, &none(), &options, true).unwrap()
}

fn outcome(pair: &Pair, id: CallId) -> Option<Result<(), Error>> {
    pair.manager.outcome(id).map(|outcome| outcome.map(drop))
}

#[test]
fn a_call_of_a_lower_class_does_not_replace_one_that_was_made_later() {
    let classes = [Priority::Low, Priority::Normal, Priority::High, Priority::Emergency];
    for (at, low) in classes.into_iter().enumerate() {
        for high in classes.into_iter().skip(at + 1) {
            let (mut pair, [go, ..]) = vehicle();
            // In one read, so that the one in the higher class begins first.
            let (first, second) = (in_class(&mut pair, "go", low), in_class(&mut pair, "dock", high));
            let other = in_class(&mut pair, "lift", low);
            pair.settle();
            assert_eq!(outcome(&pair, first), Some(Err(Error::Replaced)), "{low:?} behind {high:?}");
            assert_eq!([second, other].map(|id| outcome(&pair, id)), [Some(Ok(())); 2]);
            let _ = pair.agv.order_of(second);
            assert!(pair.agv.is_live(go));
            let third = in_class(&mut pair, "go", low);
            pair.settle();
            assert_eq!(outcome(&pair, third), Some(Ok(())), "it was made last");
        }
    }
}

#[test]
fn a_call_in_a_stream_that_was_held_up_does_not_replace_a_later_datagram_however_that_ended() {
    for ends in [false, true] {
        let (mut pair, [go, ..]) = vehicle();
        pair.manager.net.frozen = true;
        let first = pair.manager.request_with("go", &none(), &RequestOptions::new(), true).unwrap();
        let best_effort = RequestOptions { delivery: Delivery::BestEffort, ..RequestOptions::new() };
        let second = pair.manager.request_with("dock", &none(), &best_effort, false).unwrap();
        pair.settle();
        assert!(pair.agv.is_live(go));
        if ends {
            // Another unit has had the actuator since.
            let order = pair.agv.order_of(second);
            assert!(pair.agv.end_order(go, order));
            let word = pair.agv.functions.function(go).unwrap().handler.lease.clone().unwrap();
            let (now, made) = (pair.agv.now, pair.agv.now);
            let other = Claim {
                holder: 7,
                replaces: None,
                takes_over: false,
                operator: false,
                link: 1,
                call: 1,
                under: claim::Claim::NONE,
                made,
            };
            let order = word.claim(now, now + LEASE, &other).unwrap();
            assert!(word.finish(now, order));
        }
        pair.manager.net.frozen = false;
        pair.settle();
        assert_eq!(outcome(&pair, first), Some(Err(Error::Replaced)));
        assert_eq!(pair.agv.is_live(go), !ends);
        let lease = pair.agv.functions.function(go).unwrap().handler.lease().unwrap().state();
        assert_eq!(lease.last.map(|last| last.call), Some(if ends { 1 } else { second.0 }));
    }
}

#[test]
fn a_call_that_was_made_before_it_could_be_sent_keeps_its_place() {
    let (mut pair, [go, ..]) = vehicle();
    let made = pair.manager.session.make();
    let second = in_class(&mut pair, "go", Priority::Low);
    pair.settle();
    let options = |made| RequestOptions { made: Some(made), priority: Some(Priority::High), ..RequestOptions::new() };
    let first = pair.manager.request_with("dock", &none(), &options(made), true).unwrap();
    let other = pair.manager.request_with("lift", &none(), &options(made), true).unwrap();
    pair.settle();
    assert_eq!(
        [first, second, other].map(|id| outcome(&pair, id)),
        [Some(Err(Error::Replaced)), Some(Ok(())), Some(Ok(()))]
    );
    let newer = pair.manager.session.make();
    let third = pair.manager.request_with("dock", &none(), &options(newer), true).unwrap();
    pair.settle();
    assert_eq!(outcome(&pair, third), Some(Ok(())));
    assert!(pair.agv.is_live(go));
}

/// A call that never began replaces nothing.
#[test]
fn a_later_call_that_is_refused_does_not_keep_an_earlier_one_out() {
    let (mut pair, [go, ..]) = vehicle();
    pair.manager.net.frozen = true;
    let first = pair.manager.request_with("go", &none(), &RequestOptions::new(), true).unwrap();
    let word = pair.agv.functions.function(go).unwrap().handler.lease.clone().unwrap();
    let (now, made) = (pair.agv.now, pair.agv.now);
    let other = Claim {
        holder: 7,
        replaces: None,
        takes_over: false,
        operator: false,
        link: 1,
        call: 1,
        under: claim::Claim::NONE,
        made,
    };
    let order = word.claim(now, now + LEASE, &other).unwrap();
    let best_effort = RequestOptions { delivery: Delivery::BestEffort, ..RequestOptions::new() };
    pair.manager.request_with("go", &none(), &best_effort, false).unwrap();
    pair.settle();
    assert!(word.finish(now, order));
    pair.manager.net.frozen = false;
    pair.settle();
    assert_eq!(outcome(&pair, first), Some(Ok(())));
}
