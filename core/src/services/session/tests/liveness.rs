//! When a silent peer is lost, and when not.

use std::vec::Vec;

use super::super::Event;
use super::super::outbound::{Delivery, RequestOptions};
use super::net::Datagrams;
use super::pair::Pair;
use super::setup::Setup;
use super::side::{Side, context};
use super::{none, text};
use crate::config::Constraints;
use crate::distribution::claim::{Claim, TaggedClaim};
use crate::error::CloseReason;
use crate::host::connections::LinkCounter;
use crate::host::mailman::LinkId;
use crate::services::Context;
use crate::time::Duration;

fn stream_only() -> Pair {
    Pair::with(&Setup { datagrams: false, ..Setup::default() })
}

/// The time from the last sign of life until both ends end the link, in milliseconds.
fn silence(mut pair: Pair) -> u64 {
    pair.run(Duration::from_secs(10));
    for side in [&mut pair.manager, &mut pair.agv] {
        side.net.frozen = true;
        side.net.datagrams = Datagrams::Lost;
    }
    let silent = Event::Closed(CloseReason::Silent);
    for millis in (0..20_000).step_by(100) {
        if pair.manager.has(&silent) && pair.agv.has(&silent) {
            return millis;
        }
        pair.run(Duration::from_millis(100));
    }
    panic!("nobody gave up");
}

#[test]
fn a_silent_peer_is_given_up_within_three_keep_alives() {
    let millis = silence(Pair::live());
    assert!((2_500..=3_600).contains(&millis), "{millis} ms");
}

#[test]
fn a_silent_peer_is_given_up_as_soon_where_only_the_stream_passes() {
    let millis = silence(stream_only());
    assert!((2_500..=3_600).contains(&millis), "{millis} ms");
    // The same if datagrams no longer pass.
    let mut pair = Pair::live();
    pair.run(Duration::from_secs(10));
    lose_datagrams(&mut pair);
    let millis = silence(pair);
    assert!((2_500..=3_600).contains(&millis), "{millis} ms");
}

/// A standby asks the vehicle how long ago that was: it need not wait for three keep-alives more when the link has ended.
#[test]
fn a_vehicle_knows_when_it_last_heard_its_manager() {
    let tagged = TaggedClaim { claim: Claim { term: 5, claimant: 1 }, ..TaggedClaim::NONE };
    let mut pair = Pair::prepared(&Setup::default(), |pair| pair.manager.hub.hub.node.set_claim(tagged));
    let manager = pair.manager.hub.hub.node.identity().clone();
    let since = |pair: &Pair| pair.agv.hub.hub.node.obeyed_report(pair.agv.now, &manager).map(|report| report.since);
    for (pause, runs) in [(2_000, 10_000), (8_000, 1_050)] {
        // Once it is heard again, with a keep-alive, nothing of an earlier silence remains.
        pair.run(Duration::from_millis(runs));
        assert_eq!(since(&pair), Some(0));
        pair.manager.net.datagrams = Datagrams::Lost;
        pair.manager.net.frozen = true;
        pair.run(Duration::from_millis(1_400));
        assert_eq!(since(&pair), Some(0), "it may come yet");
        pair.run(Duration::from_millis(pause - 1_400));
        assert!(
            since(&pair).is_some_and(|since| (pause - 1_100..=pause).contains(&u64::from(since))),
            "{:?}",
            since(&pair)
        );
        pair.manager.net.datagrams = Datagrams::Pass;
        pair.manager.net.frozen = false;
    }
    assert!(pair.agv.has(&Event::Closed(CloseReason::Silent)));
    let (now, before) = (pair.agv.now, since(&pair));
    pair.agv.hub.hub.node.left(now, LinkId(0), CloseReason::Silent);
    assert_eq!(since(&pair), before);
}

/// The manager's keep-alives say so: a standby need not wait until it has given the vehicle up.
#[test]
fn a_vehicle_that_its_manager_does_not_hear_counts_from_then() {
    let tagged = TaggedClaim { claim: Claim { term: 5, claimant: 1 }, ..TaggedClaim::NONE };
    let mut pair = Pair::prepared(&Setup::default(), |pair| pair.manager.hub.hub.node.set_claim(tagged));
    let manager = pair.manager.hub.hub.node.identity().clone();
    let since = |pair: &Pair| pair.agv.hub.hub.node.obeyed_report(pair.agv.now, &manager).map(|report| report.since);
    pair.run(Duration::from_millis(10_000));
    pair.agv.net.datagrams = Datagrams::Lost;
    pair.agv.net.frozen = true;
    pair.run(Duration::from_millis(1_400));
    assert_eq!(since(&pair), Some(0), "it may be heard yet");
    pair.run(Duration::from_millis(200));
    assert!(since(&pair).is_some_and(|since| (1_500..=1_600).contains(&since)), "{:?}", since(&pair));
    assert_eq!(pair.agv.counter(LinkCounter::KeepAlivesMissed), 0, "it hears the manager");
    // Heard again, it learns that before the next keep-alive.
    pair.agv.net.datagrams = Datagrams::Pass;
    pair.agv.net.frozen = false;
    pair.run(Duration::from_millis(500));
    assert_eq!(since(&pair), Some(0));
    assert!(pair.manager.session.is_live() && pair.agv.session.is_live());
}

/// The frame may be the last thing that the link brings: nothing is polled between the two.
#[test]
fn a_manager_that_is_heard_again_was_heard_then_even_if_the_link_ends_at_once() {
    let tagged = TaggedClaim { claim: Claim { term: 5, claimant: 1 }, ..TaggedClaim::NONE };
    for datagrams in [false, true] {
        let mut pair = Pair::prepared(&Setup::default(), |pair| pair.manager.hub.hub.node.set_claim(tagged));
        pair.run(Duration::from_secs(10));
        let manager = pair.manager.hub.hub.node.identity().clone();
        pair.manager.net.datagrams = Datagrams::Lost;
        pair.manager.net.frozen = true;
        pair.run(Duration::from_millis(2_500));
        let (now, node) = (pair.agv.now, &pair.agv.hub.hub.node);
        assert!(node.obeyed_report(now, &manager).is_some_and(|report| report.since >= 1_500));
        pair.manager.net.datagrams = Datagrams::Pass;
        pair.manager.net.frozen = false;
        pair.manager.now = pair.manager.session.deadline();
        pair.manager.work(Vec::new());
        let (mut stream, queue) = pair.manager.net.deliver();
        if datagrams {
            let (nonce, mut body) = queue.into_iter().next().unwrap();
            let from = pair.agv.session.address();
            pair.agv.session.datagram(context!(pair.agv), from, nonce, &mut body);
        } else {
            pair.agv.session.receive(context!(pair.agv), &mut stream, None);
        }
        pair.agv.hub.hub.node.left(now, LinkId(2), CloseReason::Reset);
        let since = pair.agv.hub.hub.node.obeyed_report(now, &manager).map(|report| report.since);
        assert_eq!(since, Some(0), "{datagrams}");
    }
}

fn lose_datagrams(pair: &mut Pair) {
    pair.manager.net.datagrams = Datagrams::Lost;
    pair.agv.net.datagrams = Datagrams::Lost;
}

/// For each end: whether it receives the peer's datagrams, and whether its own arrive there.
fn datagrams(pair: &Pair) -> [(Option<bool>, bool); 2] {
    [&pair.manager, &pair.agv].map(|side| (side.session.hears_datagrams(), side.session.is_heard()))
}

#[test]
fn a_link_does_without_datagrams_that_cease_to_pass() {
    let mut pair = Pair::live();
    assert_eq!(datagrams(&pair), [(Some(true), true); 2], "known at once");
    lose_datagrams(&mut pair);
    pair.run(Duration::from_secs(5));
    assert_eq!(datagrams(&pair), [(Some(false), false); 2]);
    pair.run(Duration::from_secs(120));
    for side in [&mut pair.manager, &mut pair.agv] {
        assert!(side.session.is_live());
        assert_eq!(side.counter(LinkCounter::DatagramsMissing), 1);
        // The three that were missed when datagrams stopped. Later ones come in the stream.
        assert!(side.counter(LinkCounter::KeepAlivesMissed) <= 4);
        side.net.datagrams = Datagrams::Pass;
    }
    pair.run(Duration::from_secs(3));
    assert_eq!(datagrams(&pair), [(Some(true), true); 2]);
}

#[test]
fn each_end_knows_which_direction_of_datagrams_is_blocked() {
    let mut pair = Pair::live();
    pair.agv.net.datagrams = Datagrams::Lost;
    pair.run(Duration::from_secs(6));
    assert_eq!(datagrams(&pair), [(Some(false), true), (Some(true), false)]);
    // From the start, and if none are sent at all.
    let mut pair = Pair::connected(&Setup::default());
    pair.agv.net.datagrams = Datagrams::Lost;
    pair.run(Duration::from_secs(6));
    assert_eq!(datagrams(&pair), [(Some(false), true), (Some(true), false)]);
    let mut pair = stream_only();
    assert_eq!(datagrams(&pair), [(None, false); 2], "not known yet");
    pair.run(Duration::from_secs(6));
    assert_eq!(datagrams(&pair), [(Some(false), false); 2]);
}

#[test]
fn a_best_effort_call_arrives_where_datagrams_do_not_pass() {
    let mut pair = Pair::with_position();
    let options = RequestOptions { delivery: Delivery::BestEffort, ..RequestOptions::default() };
    let mut ran = 0;
    for lost in [false, true] {
        if lost {
            lose_datagrams(&mut pair);
            pair.run(Duration::from_secs(5));
        }
        pair.manager.request_with("pos_info", &none(), &options, false).unwrap();
        pair.run(Duration::from_millis(100));
        ran += 1;
        assert_eq!(pair.agv.ran.len(), ran);
    }
}

/// From now on the stream of one or both ends delivers nothing; everything else passes. Returns after how many milliseconds both
/// ends have ended the link, and why.
fn stream_dead(pair: &mut Pair, manager: bool, agv: bool) -> (u64, CloseReason) {
    (pair.manager.net.frozen, pair.agv.net.frozen) = (manager, agv);
    let dead = |side: &Side| {
        side.happened.iter().find_map(|event| match event {
            Event::Closed(reason) => Some(*reason),
            _ => None,
        })
    };
    for millis in (0..30_000).step_by(100) {
        if let (Some(one), Some(other)) = (dead(&pair.manager), dead(&pair.agv)) {
            assert_eq!(one, other, "both know why");
            assert_eq!(pair.manager.counter(LinkCounter::StreamsDied), 1);
            assert_eq!(pair.agv.counter(LinkCounter::StreamsDied), 1);
            return (millis, one);
        }
        pair.run(Duration::from_millis(100));
    }
    panic!("nobody gave up");
}

#[test]
fn a_dead_stream_ends_the_link_though_datagrams_pass() {
    for (manager, agv) in [(true, true), (true, false), (false, true)] {
        let mut pair = Pair::live();
        pair.run(Duration::from_secs(60));
        let (millis, reason) = stream_dead(&mut pair, manager, agv);
        let most = if manager && agv { 14_000 } else { 24_000 };
        assert!((8_000..=most).contains(&millis), "{manager} {agv}: {millis} ms");
        assert_eq!(reason, CloseReason::StreamDead { long: false });
    }
}

#[test]
fn a_call_in_flight_shortens_the_time_to_find_a_dead_stream() {
    let mut pair = Pair::with_position();
    pair.run(Duration::from_secs(10));
    pair.manager.net.frozen = true;
    let id = pair.manager.call("pos_info", &none()).unwrap();
    let (millis, _) = stream_dead(&mut pair, true, true);
    assert!((8_000..=10_000).contains(&millis), "{millis} ms");
    assert!(pair.manager.outcome(id).unwrap().is_err());
}

#[test]
fn a_stream_that_dies_with_several_segments_outstanding_says_so() {
    let mut pair = Pair::live();
    pair.agv.offer("note(text: string[20000])", |_| Ok(()));
    pair.publish();
    pair.manager.net.frozen = true;
    pair.manager.call("note", &text(1_500)).unwrap();
    assert_eq!(stream_dead(&mut pair, true, false).1, CloseReason::StreamDead { long: true });
}

#[test]
fn dead_streams_are_found_with_any_keep_alive() {
    for (seconds, most) in [(5, 16_000), (60, 20_000)] {
        let mut pair = Pair::live();
        for side in [&mut pair.manager, &mut pair.agv] {
            let constraints = Constraints { keep_alive: Duration::from_secs(seconds), ..*side.session.constraints() };
            side.set_constraints(constraints);
        }
        pair.run(Duration::from_secs(200));
        let (millis, _) = stream_dead(&mut pair, true, true);
        assert!((8_000..=most).contains(&millis), "{seconds} s: {millis} ms");
    }
}

/// A few bytes a second arrive, of a message that takes minutes.
#[test]
fn a_stream_that_creeps_is_alive() {
    let mut pair = Pair::live();
    pair.agv.offer("note(text: string[20000])", |_| Ok(()));
    pair.publish();
    pair.manager.net.capacity = 10;
    let options = RequestOptions { timeout: Some(Duration::from_secs(3_600)), ..RequestOptions::default() };
    pair.manager.request_with("note", &text(2_000), &options, true).unwrap();
    for _ in 0..150 {
        pair.manager.net.frozen = false;
        let _ = pair.step();
        pair.manager.net.frozen = true;
        pair.run(Duration::from_secs(3));
        assert!(pair.manager.session.is_live() && pair.agv.session.is_live());
    }
}

/// It leaves bytes in its stream unread, and reports that.
#[test]
fn a_peer_that_holds_reading_back_is_slow_and_not_dead() {
    for datagrams in [true, false] {
        let mut pair = Pair::with(&Setup { datagrams, ..Setup::default() });
        pair.run(Duration::from_secs(10));
        pair.agv.holds_back = true;
        pair.run(Duration::from_secs(120));
        assert!(
            pair.manager.session.is_live() && pair.agv.session.is_live(),
            "{datagrams}: {:?}",
            pair.manager.happened
        );
        pair.agv.holds_back = false;
        pair.run(Duration::from_secs(20));
        assert!(pair.manager.session.is_live() && pair.agv.session.is_live());
    }
}

#[test]
fn lost_datagrams_do_not_make_a_stream_look_dead() {
    let mut pair = Pair::live();
    for _ in 0..60 {
        pair.run(Duration::from_millis(900));
        lose_datagrams(&mut pair);
        pair.run(Duration::from_millis(1_800));
        pair.manager.net.datagrams = Datagrams::Pass;
        pair.agv.net.datagrams = Datagrams::Pass;
    }
    assert!(pair.manager.session.is_live() && pair.agv.session.is_live(), "{:?}", pair.manager.happened);
}

#[test]
fn an_idle_link_lives() {
    for mut pair in [Pair::live(), stream_only()] {
        pair.run(Duration::from_secs(600));
        assert!(pair.manager.session.is_live() && pair.agv.session.is_live());
        assert_eq!(pair.manager.counter(LinkCounter::KeepAlivesMissed), 0);
    }
}

#[test]
fn datagrams_that_pass_in_one_direction_only_end_nothing() {
    let mut pair = Pair::connected(&Setup::default());
    pair.agv.net.datagrams = Datagrams::Lost;
    pair.settle();
    pair.run(Duration::from_secs(60));
    assert!(pair.manager.session.is_live() && pair.agv.session.is_live(), "{:?}", pair.manager.happened);
    assert!(!pair.manager.has(&Event::Answered));
}

#[test]
fn two_lost_datagrams_end_nothing() {
    let mut pair = Pair::live();
    for _ in 0..10 {
        pair.run(Duration::from_millis(1_100));
        pair.agv.net.datagrams = Datagrams::Lost;
        pair.run(Duration::from_millis(2_000));
        pair.agv.net.datagrams = Datagrams::Pass;
    }
    assert!(pair.manager.session.is_live());
    assert!(pair.manager.counter(LinkCounter::KeepAlivesMissed) > 0);
}

#[test]
fn a_host_that_was_suspended_keeps_its_links() {
    for mut pair in [Pair::live(), stream_only()] {
        pair.run(Duration::from_millis(1_700));
        pair.jump(Duration::from_secs(49 * 24 * 3_600));
        pair.run(Duration::from_secs(10));
        assert!(pair.manager.session.is_live() && pair.agv.session.is_live());
    }
}

#[test]
fn a_longer_pause_between_keep_alives_ends_nothing() {
    let mut pair = Pair::live();
    let constraints = Constraints { keep_alive: Duration::from_secs(30), ..*pair.agv.session.constraints() };
    pair.agv.set_constraints(constraints);
    pair.run(Duration::from_secs(120));
    assert!(pair.manager.session.is_live() && pair.agv.session.is_live());
}

#[test]
fn datagrams_of_another_session_are_counted_and_renew_nothing() {
    let mut pair = Pair::live();
    let before = pair.manager.counter(LinkCounter::DatagramsReceived);
    pair.manager.hear_datagram(0xBAD, &[1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    pair.manager.hear_datagram(0xBAD, &[]);
    assert_eq!(pair.manager.counter(LinkCounter::DatagramsDropped), 2);
    assert_eq!(pair.manager.counter(LinkCounter::DatagramsReceived), before);
}
