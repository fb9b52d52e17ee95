//! When a silent peer is given up, and when not.

use super::super::Event;
use super::net::Datagrams;
use super::pair::Pair;
use super::setup::Setup;
use crate::config::Constraints;
use crate::error::CloseReason;
use crate::host::connections::LinkCounter;
use crate::time::Duration;

fn stream_only() -> Pair {
    Pair::with(&Setup { datagrams: false, ..Setup::default() })
}

/// How long after the last sign of life both ends give up, in milliseconds.
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
fn a_silent_peer_is_given_up_after_eight_seconds_where_only_the_stream_passes() {
    let millis = silence(stream_only());
    assert!((7_500..=8_600).contains(&millis), "{millis} ms");
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
    pair.manager.hear_datagram(0xBAD, &[1, 0, 0, 0, 0, 0, 0, 0, 0]);
    pair.manager.hear_datagram(0xBAD, &[]);
    assert_eq!(pair.manager.counter(LinkCounter::DatagramsDropped), 2);
    assert_eq!(pair.manager.counter(LinkCounter::DatagramsReceived), before);
}
