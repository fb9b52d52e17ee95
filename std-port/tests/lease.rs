//! A service's lease, the heart that renews it, and the latch of a stop, in every order in which threads can write and read them.
//!
//! `Lease` is the core's own. Two links write it, under a lock as in `safe_hook.rs`, and the application reads it without.
//! Where the links take no lock, the model must fail.

#![allow(unexpected_cfgs, reason = "the features are those of the core")]

// The file's `core` is this crate: all is the standard library's but for `sync::atomic` below.
extern crate self as core;
use std::*;

#[allow(dead_code, unused_imports, unreachable_pub, reason = "the file is included for the type it defines")]
#[path = "../../core/src/services/heart.rs"]
mod heart;
#[allow(dead_code, unreachable_pub, reason = "the file is included for the type it defines")]
#[path = "../../core/src/distribution/latch.rs"]
mod latch;
#[allow(dead_code, unused_imports, unreachable_pub, reason = "the file is included for the type it defines")]
#[path = "../../core/src/services/lease.rs"]
mod lease;

use cara_core::{config, error, time};
mod distribution {
    pub(crate) use crate::latch;
    pub(crate) use cara_core::distribution::*;
}
mod services {
    pub(crate) use cara_core::services::{heart, requests, stream};
}
mod sync {
    /// Loom's atomics in a model, and those of the standard library in the tests of the file itself.
    pub(crate) mod atomic {
        pub(crate) use std::sync::atomic::Ordering;

        macro_rules! atomic {
            ($name:ident, $value:ty) => {
                #[derive(Debug, Default)]
                pub(crate) struct $name {
                    plain: std::sync::atomic::$name,
                    /// Made when it is first used, since loom's are not made in a `const`.
                    modelled: std::sync::OnceLock<loom::sync::atomic::$name>,
                }

                impl $name {
                    pub(crate) const fn new(value: $value) -> Self {
                        Self { plain: std::sync::atomic::$name::new(value), modelled: std::sync::OnceLock::new() }
                    }

                    fn modelled(&self) -> Option<&loom::sync::atomic::$name> {
                        let make = || loom::sync::atomic::$name::new(self.plain.load(Ordering::Relaxed));
                        crate::IN_MODEL.get().then(|| self.modelled.get_or_init(make))
                    }

                    pub(crate) fn load(&self, order: Ordering) -> $value {
                        self.modelled().map_or_else(|| self.plain.load(order), |atomic| atomic.load(order))
                    }

                    pub(crate) fn store(&self, value: $value, order: Ordering) {
                        match self.modelled() {
                            Some(atomic) => atomic.store(value, order),
                            None => self.plain.store(value, order),
                        }
                    }
                }
            };
        }

        atomic!(AtomicBool, bool);
        atomic!(AtomicU8, u8);
        atomic!(AtomicU16, u16);
        atomic!(AtomicU32, u32);
    }
}

use std::cell::Cell;

use cara_core::distribution::message::Latch;
use heart::Heart;
use latch::LatchWord;
use lease::{Lease, LeaseEnd, Order};
use loom::sync::{Arc, Mutex};
use loom::thread;
use time::Instant;

thread_local! {
    /// All threads of a model run on one thread of the system.
    static IN_MODEL: Cell<bool> = const { Cell::new(false) };
}

fn model(run: impl Fn() + Sync + Send + 'static) {
    IN_MODEL.set(true);
    loom::model(run);
    IN_MODEL.set(false);
}

const NOW: Instant = Instant::from_micros(1_000_000);
const END: Instant = Instant::from_micros(2_001_000);
const LATER: Instant = Instant::from_micros(3_001_000);

/// The lease as two links share it.
struct Shared {
    lease: Lease,
    /// Held while a link writes.
    lock: Option<Mutex<()>>,
}

impl Shared {
    fn write<R>(&self, write: impl FnOnce(&Lease) -> R) -> R {
        let _writing = self.lock.as_ref().map(|lock| lock.lock().unwrap());
        write(&self.lease)
    }
}

/// A lease and its first order.
fn started(lock: Option<Mutex<()>>) -> (Arc<Shared>, Order) {
    let shared = Arc::new(Shared { lease: Lease::new(), lock });
    let order = shared.lease.begin(NOW, END).unwrap();
    // Every atomic is made before the threads begin.
    let _ = shared.lease.state();
    (shared, order)
}

fn locked() -> (Arc<Shared>, Order) {
    started(Some(Mutex::new(())))
}

/// One link renews its call and ends it; the call of another one takes the lease over and ends.
fn both_end((shared, first): (Arc<Shared>, Order)) {
    let other = shared.clone();
    let other = thread::spawn(move || {
        if let Some(second) = other.write(|lease| lease.begin(NOW, END)) {
            other.write(|lease| lease.end(NOW, second, LeaseEnd::Expired));
        }
    });
    let _renewed = shared.write(|lease| lease.renew(first, LATER));
    shared.write(|lease| lease.end(NOW, first, LeaseEnd::Expired));
    other.join().unwrap();
    assert!(shared.lease.left(NOW).is_none(), "the lease lives, and no order has it");
}

#[test]
fn nothing_lives_when_both_orders_have_ended() {
    model(|| both_end(locked()));
}

#[test]
#[should_panic(expected = "the lease lives, and no order has it")]
fn without_the_lock_a_renewal_revives_what_another_link_has_ended() {
    model(|| both_end(started(None)));
}

/// Two calls begin side by side.
fn both_begin((shared, _): (Arc<Shared>, Order)) {
    let other = shared.clone();
    let begin = |shared: &Shared| shared.write(|lease| lease.begin(NOW, END)).unwrap();
    let other = thread::spawn(move || begin(&other));
    let (mine, theirs) = (begin(&shared), other.join().unwrap());
    assert_ne!(mine, theirs, "two calls have one order");
    let live = [mine, theirs].map(|order| shared.lease.is_live_for(order, NOW));
    assert_eq!(live.into_iter().filter(|live| *live).count(), 1);
}

#[test]
fn two_that_begin_at_once_are_two_orders() {
    model(|| both_begin(locked()));
}

#[test]
#[should_panic(expected = "two calls have one order")]
fn without_the_lock_they_are_one() {
    model(|| both_begin(started(None)));
}

/// The application looks at an order while its link renews it and another one takes the lease over.
#[test]
fn an_order_that_was_seen_dead_stays_dead() {
    for looks_at in [NOW, END] {
        model(move || {
            let (shared, first) = locked();
            let writer = shared.clone();
            let writer = thread::spawn(move || {
                if writer.write(|lease| lease.renew(first, LATER)) {
                    let _second = writer.write(|lease| lease.begin(NOW, LATER));
                }
            });
            let looks = [(); 3].map(|()| shared.lease.is_live_for(first, looks_at));
            assert!(looks.windows(2).all(|pair| pair[0] || !pair[1]), "it was dead, and lives: {looks:?}");
            writer.join().unwrap();
        });
    }
}

/// A loop's heart is dropped, and the next loop gets it and beats, while a link renews the order of the first one.
#[test]
fn the_beat_of_a_later_loop_renews_no_earlier_order() {
    model(|| {
        let heart: &'static Heart = Box::leak(Box::new(Heart::new(time::Duration::from_millis(100))));
        heart.beat(NOW);
        let beats = heart.beats();
        assert!(beats.age(NOW).is_some() && beats.period().as_millis() == 100);
        let next = thread::spawn(move || {
            heart.stop();
            // Both owners take it from one list, under a lock: no two are in this at once.
            heart.set_period(time::Duration::from_millis(200));
            heart.beat(LATER);
        });
        let ages = [(); 2].map(|()| beats.age(LATER));
        let is_of_first = |age: Option<time::Duration>| age.is_none_or(|age| age >= LATER.since(NOW));
        assert!(ages.iter().all(|age| is_of_first(*age)), "another loop's beat renews it: {ages:?}");
        assert!(ages[0].is_some() || ages[1].is_none(), "it was stopped, and beats: {ages:?}");
        next.join().unwrap();
        assert!(beats.age(LATER).is_none() && heart.beats().age(LATER).is_some());
    });
}

/// The vehicle is stopped once more while the reset of the first stop is done.
#[test]
fn a_stop_beside_a_reset_stays_in_effect() {
    model(|| {
        let cause = |reason| Latch { by: 7, reason };
        let latch = Arc::new(LatchWord::new());
        latch.inhibit(NOW, cause(1));
        let resets = latch.clone();
        let resets = thread::spawn(move || resets.reset(LATER, END));
        // Here and not in the other thread: loom tries no switch before a store whose thread has read the same atomic last.
        latch.inhibit(LATER, cause(2));
        resets.join().unwrap();
        assert!(latch.is_inhibited(), "the second stop is lost");
        assert!(!latch.is_behind_stop(LATER, END), "what was wanted before it is");
    });
}
