//! Waiting for nodes, functions, events, readers, round trips and the end of what was held.

use std::time::Duration;

use cara_std::{Error, LeaseEnd, Renew, RequestOptions, ServiceOptions, UnitEvent};

use super::{patient, runtime};
use crate::support::{PATIENCE, counter, fleet, meet, number, pair, service, system, unit, until};

#[test]
fn a_node_and_a_function_are_waited_for() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    manager.start().unwrap();
    runtime().block_on(async {
        let soon = tokio::time::timeout(Duration::from_millis(50), manager.wait_for_s_unit_async("agv")).await;
        assert!(soon.is_err(), "it is on the roster, and not here");
        let waiting = tokio::spawn({
            let manager = manager.clone();
            async move { manager.wait_for_s_unit_async("agv").await }
        });
        let agv = unit("agv", 7, fleet).build().unwrap();
        agv.start_async().await.unwrap();
        let peer = waiting.await.unwrap().unwrap();
        assert!(peer.is_connected());
        let to_manager = agv.wait_for_manager_async().await.unwrap();
        let function = tokio::spawn({
            let peer = peer.clone();
            async move { peer.wait_for_function_async("echo").await }
        });
        agv.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
        to_manager.publish_and_wait_async(Duration::from_secs(20)).await.unwrap();
        assert_eq!(function.await.unwrap(), Ok(()));
        assert_eq!(manager.publish_and_wait_async(Duration::from_secs(20)).await, Ok(vec![]));
        let never = tokio::spawn({
            let peer = peer.clone();
            async move { peer.wait_for_function_async("never").await }
        });
        tokio::task::yield_now().await;
        manager.stop_async().await.unwrap();
        assert_eq!(never.await.unwrap(), Err(Error::NotRunning));
    });
}

#[test]
fn the_blocking_form_waits_for_a_node_as_well() {
    let (manager, agv) = pair();
    manager.start().unwrap();
    let none = manager.wait_for_s_unit("agv", Duration::from_millis(20)).err();
    assert_eq!(none, Some(Error::TimedOut));
    std::thread::scope(|scope| {
        let waiting = scope.spawn(|| manager.wait_for_s_unit("agv", Duration::from_secs(20)));
        agv.start().unwrap();
        assert!(waiting.join().unwrap().unwrap().is_connected());
    });
    manager.stop();
    assert_eq!(manager.wait_for_s_unit("agv", Duration::from_secs(20)).err(), Some(Error::NotRunning));
}

#[test]
fn events_are_a_stream_that_ends_with_the_unit() {
    let (manager, agv) = pair();
    let mut events = manager.events_async();
    let (peer, _) = meet(&manager, &agv);
    runtime().block_on(async {
        let first = events.next().await.unwrap().unwrap();
        assert_eq!(first, UnitEvent::Joined { peer: peer.identity().clone() });
        assert!(tokio::time::timeout(Duration::from_millis(1), std::future::pending::<()>()).await.is_err());
        manager.stop_async().await.unwrap();
        let mut left = false;
        while let Some(event) = events.next().await {
            left |= matches!(event.unwrap(), UnitEvent::Left { .. });
        }
        assert!(left, "what happened before the end is told");
        assert_eq!((events.lost(), manager.events_async().next().await), (0, None));
    });
}

#[test]
fn round_trips_are_measured_in_turn_and_one_that_is_dropped_gives_its_turn_up() {
    let (manager, agv) = pair();
    let (peer, _) = meet(&manager, &agv);
    runtime().block_on(async {
        for _ in 0..50 {
            let mut dropped = Box::pin(peer.ping_async(Duration::from_secs(20)));
            let _ = super::once(&mut dropped).await;
        }
        let pings: Vec<_> = (0..8)
            .map(|_| {
                let peer = peer.clone();
                tokio::spawn(async move { peer.ping_async(Duration::from_secs(20)).await })
            })
            .collect();
        for ping in pings {
            ping.await.unwrap().unwrap();
        }
        agv.stop_async().await.unwrap();
    });
    until("it has left", || !peer.is_connected());
    assert_eq!(runtime().block_on(peer.ping_async(Duration::from_secs(20))), Err(Error::NotConnected));
}

#[test]
fn what_is_held_is_released_and_its_end_is_told() {
    let (manager, agv) = pair();
    let definition = "lift(number: int) -> (number: int)".parse().unwrap();
    // So long that nothing ends by time.
    let options = ServiceOptions::new().lease(PATIENCE.saturating_mul(4), || {});
    let lease = agv.my_function_list().add_service(&definition, options, service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let wanted = RequestOptions { renew: Renew::Process, ..patient() };
    runtime().block_on(async {
        let held = peer.call("lift", &mut number(1)).with(wanted).hold().await.unwrap();
        assert!(held.is_held() && lease.is_live());
        let end = held.hold.release_async(Duration::from_secs(20)).await;
        assert_eq!((end, lease.is_live()), (Ok(LeaseEnd::Released), false));
        // Dropped while it waits for the end, it is released all the same.
        let held = peer.call("lift", &mut number(1)).with(wanted).hold().await.unwrap();
        assert!(lease.is_live());
        drop(held.hold.release_async(Duration::from_secs(20)));
    });
    until("it is released", || !lease.is_live());
    assert_eq!(counter(&peer.counters(), "CallsTimedOut"), 0);
}
