use super::*;
use proptest::prelude::*;

const fn at(micros: u64) -> Instant {
    Instant::from_micros(micros)
}

const START: Instant = Instant::START;

/// A lease of 500 ms from 1 s on, with a ramp of 300 ms.
fn on_a_ramp() -> (Lease, Order) {
    let lease = Lease::new();
    lease.set_ramp(Duration::from_millis(300));
    let order = lease.begin(at(1_000_000), at(1_501_000)).unwrap();
    (lease, order)
}

fn stages(lease: &Lease, millis: &[u64]) -> std::vec::Vec<Stage> {
    millis.iter().map(|millis| lease.stage(at(millis * 1_000))).collect()
}

#[test]
fn an_order_that_has_ended_slows_down_for_the_length_of_its_ramp() {
    let (lease, order) = on_a_ramp();
    let whole = [Stage::Live, Stage::Stopping, Stage::Stopping, Stage::Dead];
    assert_eq!(stages(&lease, &[1_499, 1_501, 1_800, 1_802]), whole, "the unit does not look");
    assert!(lease.end(at(1_600_000), order, LeaseEnd::Expired));
    assert_eq!(
        stages(&lease, &[1_800, 1_802]),
        [Stage::Stopping, Stage::Dead],
        "counted from its end, not from the look"
    );
    assert!(lease.begin(at(1_700_000), at(3_000_000)).is_none(), "the ramp comes first");
    let next = lease.begin(at(1_802_000), at(3_000_000)).unwrap();
    assert_eq!(stages(&lease, &[1_803]), [Stage::Live]);
    // Released before its end.
    assert!(lease.end(at(2_000_000), next, LeaseEnd::Expired));
    assert_eq!(stages(&lease, &[2_000, 2_298, 2_299]), [Stage::Stopping, Stage::Stopping, Stage::Dead]);
}

#[test]
fn a_stop_begins_the_ramp_once() {
    let (lease, order) = on_a_ramp();
    let latch = Latch { by: 0, reason: 1 };
    lease.inhibit(at(1_100_000), latch);
    lease.inhibit(at(1_300_000), latch);
    assert_eq!(stages(&lease, &[1_101, 1_398, 1_399]), [Stage::Stopping, Stage::Stopping, Stage::Dead]);
    assert!(lease.end(at(1_350_000), order, LeaseEnd::Stopped));
    assert_eq!(stages(&lease, &[1_398, 1_399]), [Stage::Stopping, Stage::Dead]);
    // Nothing was moving at the second stop.
    lease.inhibit(at(2_000_000), latch);
    assert_eq!(stages(&lease, &[2_001]), [Stage::Dead]);
}

#[test]
fn what_is_finished_or_has_no_ramp_is_dead_at_once() {
    let (lease, order) = on_a_ramp();
    assert!(lease.end(at(1_100_000), order, LeaseEnd::Finished));
    assert_eq!(stages(&lease, &[1_100, 1_200]), [Stage::Dead; 2]);
    assert!(lease.begin(at(1_100_000), at(1_500_000)).is_some());
    let lease = Lease::new();
    let order = lease.begin(at(1_000_000), at(1_501_000)).unwrap();
    assert_eq!(stages(&lease, &[1_100, 1_501]), [Stage::Live, Stage::Dead]);
    lease.cut(order);
    assert!(lease.end(at(1_600_000), order, LeaseEnd::Expired));
    assert!(lease.stage(at(1_601_000)) == Stage::Dead && lease.begin(at(1_602_000), at(2_000_000)).is_some());
}

#[test]
fn what_goes_with_its_service_slows_down_like_what_has_ended() {
    let (lease, _) = on_a_ramp();
    assert!(lease.clear(at(1_100_000)) && !lease.clear(at(1_200_000)));
    assert_eq!(stages(&lease, &[1_101, 1_398, 1_399]), [Stage::Stopping, Stage::Stopping, Stage::Dead]);
    assert!(lease.begin(at(1_300_000), at(3_000_000)).is_none(), "the ramp comes first");
    let next = lease.begin(at(1_400_000), at(3_000_000)).unwrap();
    assert!(lease.finish(at(1_500_000), next));
    // An order that has ended keeps its end.
    assert!(!lease.clear(at(1_600_000)) && stages(&lease, &[1_601]) == [Stage::Dead]);
    assert_eq!(lease.state().last.unwrap().end, Some(LeaseEnd::Finished));
}

#[test]
fn what_is_dead_or_was_replaced_is_not_finished() {
    let (lease, first) = on_a_ramp();
    let second = lease.begin(at(1_100_000), at(1_501_000)).unwrap();
    assert!(!lease.finish(at(1_200_000), first) && lease.is_live_for(second, at(1_200_000)));
    assert!(!lease.finish(at(1_501_000), second) && lease.awaits_hook(), "its time is over");
    assert!(lease.end(at(1_502_000), second, LeaseEnd::Expired));
    assert!(!lease.finish(at(1_502_000), second));
    let third = lease.begin(at(2_000_000), at(3_000_000)).unwrap();
    assert!(lease.finish(at(2_100_000), third) && !lease.finish(at(2_100_000), third));
    assert_eq!(stages(&lease, &[2_100]), [Stage::Dead], "nothing moves");
}

#[test]
fn a_ramp_of_long_ago_keeps_nothing_from_beginning() {
    for days in [1, 24, 25, 26, 40, 49] {
        let (lease, order) = on_a_ramp();
        assert!(lease.end(at(1_200_000), order, LeaseEnd::Expired));
        let later = at(1_200_000 + days * 86_400_000_000);
        assert_eq!(lease.stage(later), Stage::Dead, "{days}");
        assert!(lease.begin(later, later + Duration::from_secs(1)).is_some(), "{days}");
    }
}

#[test]
fn a_lease_lives_until_its_end_and_not_longer() {
    let lease = Lease::new();
    assert!(!lease.is_live(START));
    let order = lease.begin(START, at(500_000)).unwrap();
    assert!(lease.is_live(at(498_000)));
    assert!(lease.renew(order, at(501_000)));
    assert!(lease.is_live(at(500_000)));
    assert!(!lease.is_live(at(501_000)));
    assert!(lease.end(START, order, LeaseEnd::Expired));
    let order = lease.begin(START, at(500_000)).unwrap();
    assert!(!lease.is_live(at(500_000)));
    assert!(lease.end(START, order, LeaseEnd::Expired) && lease.begin(START, at(500_000)).is_some());
    assert!(lease.clear(START) && !lease.clear(START));
    assert!(!lease.is_live(START));
}

/// Each millisecond around the points where 32 bits of milliseconds change their sign or wrap, and microseconds of all kinds.
#[test]
#[cfg_attr(miri, ignore = "so many cases take the interpreter hours")]
fn a_lease_lasts_equally_long_at_every_point_of_its_clock() {
    let starts = [1 << 31, 1 << 32, 3 << 31, 1 << 40].into_iter().flat_map(|base| base - 10..=base + 10);
    for (start, length) in starts.flat_map(|start: u64| (2..=12).map(move |length| (start, length))) {
        for rest in [0, 1, 999] {
            let (from, end) = (at(start * 1_000), at((start + length) * 1_000 + rest));
            let seen_end = Lease::seen_end(end);
            assert!(seen_end <= end && seen_end + Duration::from_millis(2) > end, "{end:?} is seen as {seen_end:?}");
            let lease = Lease::new();
            let order = lease.begin(from, end).unwrap();
            for now in (start * 1_000..=(start + length) * 1_000 + rest).step_by(333).map(at) {
                assert_eq!(lease.lasts_beyond(now), now < seen_end, "{start} + {length}, at {now:?}");
                assert_eq!(lease.left(now), Some(seen_end.since(now)), "{start} + {length}, at {now:?}");
                assert_eq!(lease.is_live_for(order, now), now < seen_end, "{start} + {length}, at {now:?}");
            }
        }
    }
}

#[test]
fn a_lease_survives_the_wrap_of_its_clock() {
    let wrap = u64::from(u32::MAX) * 1_000;
    let lease = Lease::new();
    assert!(lease.begin(at(wrap - 200_000), at(wrap + 300_000)).is_some());
    assert!(lease.is_live(at(wrap - 100_000)));
    assert!(lease.is_live(at(wrap + 200_000)));
    assert!(!lease.is_live(at(wrap + 300_000)));
}

#[test]
fn an_interrupt_that_inhibits_between_two_stores_of_a_new_order_leaves_it_dead() {
    let lease = Lease::new();
    lease.inhibit(START, Latch { by: 0, reason: 1 });
    // What `begin` stores after it.
    lease.seen_dead.store(false, Ordering::Release);
    lease.end.store(odd_millis(at(500_000)) as u32, Ordering::Release);
    assert!(!lease.is_live(at(1_000)) && !lease.lasts_beyond(at(1_000)));
    lease.reset(at(100_000), at(100_000));
    assert!(!lease.is_live(at(100_000)), "a reader has seen it dead");
}

#[test]
fn looking_ahead_ends_nothing() {
    let lease = Lease::new();
    let order = lease.begin(START, at(500_000)).unwrap();
    assert!(lease.lasts_beyond(at(498_000)) && !lease.lasts_beyond(at(500_000)));
    assert!(lease.is_live(at(498_000)) && lease.renew(order, at(600_000)));
    assert!(!lease.is_live(at(600_000)) && !lease.lasts_beyond(at(0)));
}

#[test]
fn an_order_does_not_take_the_place_of_a_dead_one_before_that_has_been_ended() {
    let lease = Lease::new();
    let first = lease.begin(START, at(500_000)).unwrap();
    assert!(lease.begin(at(500_000), at(900_000)).is_none(), "its time is over");
    assert!(lease.end(START, first, LeaseEnd::Expired) && lease.begin(at(500_000), at(900_000)).is_some());
    let lease = Lease::new();
    let first = lease.begin(START, at(500_000)).unwrap();
    lease.cut(first);
    assert!(!lease.is_live(START) && !lease.renew(first, at(600_000)));
    assert!(lease.begin(START, at(900_000)).is_none(), "it was cut");
    assert!(lease.end(START, first, LeaseEnd::Expired) && lease.begin(START, at(900_000)).is_some());
}

#[test]
fn what_belongs_to_an_earlier_order_does_nothing_to_a_newer_one() {
    let lease = Lease::new();
    let first = lease.begin(START, at(500_000)).unwrap();
    let second = lease.begin(at(100_000), at(600_000)).unwrap();
    assert!(!lease.is_live_for(first, at(100_000)) && lease.is_live_for(second, at(100_000)));
    lease.cut(first);
    assert!(!lease.end(START, first, LeaseEnd::Expired) && !lease.renew(first, at(900_000)));
    assert!(lease.is_live_for(second, at(598_000)));
    assert!(!lease.is_live_for(second, at(600_000)) && !lease.is_live_for(second, START));
}

#[test]
fn what_is_left_of_a_lease_is_told_until_its_end() {
    let lease = Lease::new();
    assert_eq!(lease.left(at(7)), None);
    let order = lease.begin(START, at(501_000)).unwrap();
    let left = [0, 500_999, 501_000, 900_000].map(|now| lease.left(at(now)).map(Duration::as_micros));
    assert_eq!(left, [Some(501_000), Some(1), Some(0), Some(0)]);
    let wrap = (1_u64 << 32) * 1_000;
    assert!(lease.end(START, order, LeaseEnd::Expired));
    let order = lease.begin(at(wrap - 1_000), at(wrap + 301_000)).unwrap();
    assert_eq!(lease.left(at(wrap - 1_000)), Some(Duration::from_millis(302)));
    assert!(lease.end(START, order, LeaseEnd::Expired));
    assert_eq!(lease.left(at(0)), None);
}

#[test]
fn a_live_order_gives_way_to_its_own_caller_or_to_a_take_over() {
    let claim = |replaces, operator, takes_over| {
        let (under, made) = (claim::Claim::NONE, at(1_000_000));
        Claim { holder: 7, replaces, takes_over, operator, link: 1, call: 2, under, made }
    };
    for operator in [false, true] {
        let lease = Lease::new();
        let claims = |now: u64, made: &Claim| lease.claim(at(now), at(now + 500_000), made);
        let first = claims(1_000_000, &claim(None, operator, false)).unwrap();
        let held = Err(Error::Held { by: 7, operator });
        assert_eq!(claims(1_100_000, &claim(None, operator, false)), held, "of another link");
        assert_eq!(claims(1_100_000, &claim(Some(first), !operator, false)), held, "operator and program are two");
        let second = claims(1_100_000, &claim(Some(first), operator, false)).unwrap();
        assert_eq!(claims(1_200_000, &claim(Some(first), operator, false)), held, "the first was replaced");
        let third = claims(1_200_000, &claim(None, !operator, true)).unwrap();
        assert!(lease.is_live_for(third, at(1_300_000)) && !lease.is_live_for(second, at(1_300_000)));
        assert_eq!(claims(1_800_000, &claim(Some(third), !operator, false)), Err(Error::Busy), "its hook comes first");
        assert_eq!(claims(1_800_000, &claim(None, operator, true)), Err(Error::Busy), "its hook comes first");
    }
}

#[test]
fn the_claim_of_an_order_is_reported_whole() {
    for (term, claimant) in [(1 << 32 | 5, 0xfedc_ba98_7654_3210), (7, 1), (u64::MAX, 1 << 32)] {
        let (under, made) = (claim::Claim { term, claimant }, at(1_000_000));
        let claim =
            Claim { holder: 7, replaces: None, takes_over: false, operator: true, link: 3, call: 9, under, made };
        let lease = Lease::new();
        lease.claim(made, at(1_500_000), &claim).unwrap();
        let last = LastOrder { holder: 7, link: 3, call: 9, claim: under, end: None };
        assert_eq!(lease.state(), ActuatorState { latch: None, last: Some(last) });
    }
}

#[test]
fn what_is_cut_without_a_ramp_is_dead_before_the_unit_looks() {
    let lease = Lease::new();
    lease.cut(lease.begin(at(1_000_000), at(1_501_000)).unwrap());
    assert_eq!(stages(&lease, &[1_000, 1_100, 1_501, 1_502]), [Stage::Dead; 4]);
    let (lease, order) = on_a_ramp();
    lease.cut(order);
    assert_eq!(stages(&lease, &[1_100, 1_800, 1_802]), [Stage::Stopping, Stage::Stopping, Stage::Dead]);
}

#[test]
fn a_renewal_that_comes_too_late_prolongs_no_ramp() {
    let (lease, order) = on_a_ramp();
    lease.cut(order);
    assert!(!lease.renew(order, at(3_000_000)));
    assert_eq!(stages(&lease, &[1_802, 2_900]), [Stage::Dead; 2]);
    let (lease, order) = on_a_ramp();
    lease.inhibit(at(1_100_000), Latch { by: 0, reason: 1 });
    assert!(!lease.renew(order, at(3_000_000)) && lease.left(at(1_100_000)) == Some(Duration::from_millis(401)));
}

#[test]
fn an_unused_lease_is_on_no_ramp_when_its_clock_starts() {
    let lease = Lease::new();
    lease.set_ramp(Duration::from_millis(300));
    assert_eq!(stages(&lease, &[0, 1, 299]), [Stage::Dead; 3]);
    assert!(lease.begin(at(1_000), at(501_000)).is_some());
}

#[test]
fn no_order_begins_on_a_lease_that_is_stopped() {
    let lease = Lease::new();
    lease.inhibit(at(1_000_000), Latch { by: 0, reason: 1 });
    assert!(lease.begin(at(1_100_000), at(1_500_000)).is_none());
    lease.reset(at(1_200_000), at(1_200_000));
    assert!(lease.begin(at(1_200_000), at(1_500_000)).is_some());
}

#[test]
fn a_hook_is_awaited_from_an_orders_death_to_its_end() {
    let (lease, order) = on_a_ramp();
    assert!(!lease.awaits_hook(), "it lives");
    lease.cut(order);
    assert!(lease.awaits_hook());
    assert!(lease.end(at(1_100_000), order, LeaseEnd::Expired) && !lease.awaits_hook(), "its hook runs");
}

#[test]
fn a_stop_is_seen_behind_however_many_orders() {
    for before in [0, 1, 1 << 30, 1 << 31] {
        let lease = Lease::new();
        lease.order.store(before, Ordering::Release);
        let changes = lease.changes();
        lease.inhibit(at(1_000), Latch { by: 0, reason: 1 });
        assert_ne!(lease.changes(), changes, "{before}");
    }
}

/// Steps with a lease. The number is how far the reader's clock advances in between.
#[derive(Clone, Copy, Debug)]
enum Step {
    Look(u64),
    /// A renewal whose end counts from a time that was read this much earlier.
    Renew(u64),
    Begin(u64),
    End,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        4 => (0..150_000_u64).prop_map(Step::Look),
        4 => (0..400_000_u64).prop_map(Step::Renew),
        1 => (0..400_000_u64).prop_map(Step::Begin),
        1 => Just(Step::End),
    ]
}

proptest! {
    #[test]
    fn what_was_seen_dead_lives_only_by_a_new_order(steps in prop::collection::vec(step(), 0..60)) {
        let lease = Lease::new();
        let (mut now, mut dead) = (0, true);
        let mut orders: std::vec::Vec<(Order, bool)> = std::vec::Vec::new();
        for step in steps {
            match step {
                Step::Look(later) => {
                    now += later;
                    let live = lease.is_live(at(now));
                    prop_assert!(!(live && dead), "it was seen dead, and lives at {now}");
                    dead = !live;
                }
                Step::Renew(length) => {
                    let renewed = orders.last().is_some_and(|(order, _)| lease.renew(*order, at(now + length)));
                    prop_assert_eq!(renewed, !dead);
                }
                Step::Begin(length) => {
                    if let Some(order) = lease.begin(at(now), at(now + length)) {
                        orders.push((order, false));
                        dead = false;
                    }
                }
                Step::End => {
                    if let Some((order, _)) = orders.last() {
                        prop_assert!(lease.end(START, *order, LeaseEnd::Expired));
                    }
                    dead = true;
                }
            }
            for index in 0..orders.len() {
                let live = lease.is_live_for(orders[index].0, at(now));
                prop_assert!(!(live && orders[index].1), "an order was dead, and lives");
                prop_assert!(!live || index + 1 == orders.len(), "an earlier order lives");
                orders[index].1 = !live;
                dead |= index + 1 == orders.len() && !live;
            }
        }
    }
}
