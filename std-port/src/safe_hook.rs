//! The safe hook of a leased service, on a thread of its own that watches the lease itself.
//!
//! At the end of the lease the hook runs whatever else the process is about: the thread waits for no lock of a link, no
//! other thread, no other hook, and not for the application's state. The unit reports each end as well, and also ends
//! that come before their time; whichever of the two is first makes the hook run, once for each order.
//!
//! Links of several peers write one lease, each from a thread of its own. They write it here, under the lock of the hook:
//! so one write never comes between the look and the store of another, and no order begins between the end of the one
//! before it and its hook.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

use cara_core::error::{Error, ServiceError};
use cara_core::services::lease::{ActuatorState, Claim, Ended, Latch, Lease, LeaseEnd, Order};
use cara_core::time::{Duration, Instant};

use crate::clock::Clock;
use crate::executor::OwnThread;
use crate::lease::ServiceLease;
use crate::locks::lock;

/// A thread that waits for the end of a lease looks at the clock this often: its wait stands still while the system is
/// suspended, and the clock goes on.
const LOOK: Duration = Duration::from_millis(20);
/// A hook that runs for longer is counted, and its service refused until it returns.
const LATE: Duration = Duration::from_millis(100);

/// How long the end of a service waits for its hook.
const PATIENCE: std::time::Duration = std::time::Duration::from_secs(10);

/// The hook and its thread, and all writes to the lease.
pub(crate) struct SafeHook {
    shared: Arc<Shared>,
    thread: OwnThread,
}

/// What a hook is made of.
pub(crate) struct Parts {
    pub(crate) lease: Arc<ServiceLease>,
    pub(crate) clock: Clock,
    pub(crate) hook: Arc<dyn Fn() + Send + Sync>,
    /// Runs after it, and waits for nothing either.
    pub(crate) then: Option<Box<dyn Fn() + Send + Sync>>,
    /// Counts hooks that took long.
    pub(crate) late: Arc<AtomicU64>,
}

struct Shared {
    parts: Parts,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// The hook is to run.
    due: bool,
    /// The thread has seen the end of the lease and started the hook; the unit has yet to report that end.
    started_early: bool,
    /// The number of the service whose order was the last to begin.
    service: u64,
    running_since: Option<Instant>,
    /// This run has been counted as a long one.
    counted: bool,
    /// The service is gone.
    is_over: bool,
}

impl SafeHook {
    /// Starts the thread. [`Error::Network`] when the system refuses it.
    pub(crate) fn start(parts: Parts) -> Result<Self, Error> {
        let shared = Arc::new(Shared { parts, state: Mutex::default(), changed: Condvar::new() });
        let own = shared.clone();
        let thread = OwnThread::start("cara-safe", move || own.work())?;
        Ok(Self { shared, thread })
    }

    /// Begins an order: the thread looks when its lease ends.
    pub(crate) fn begin(&self, end: Instant, claim: &Claim, service: u64) -> Result<Order, Error> {
        // The order before this one is safe first: until then what reads the lease would act for this one by the wish of that.
        let (mut state, is_safe) = self.shared.await_hook(lock(&self.shared.state));
        if !is_safe {
            return Err(ServiceError::NotReady.into());
        }
        // It may have waited for that longer than the lease lasts.
        let now = self.shared.parts.clock.now();
        if Lease::seen_end(end) <= now {
            return Err(Error::Expired);
        }
        let order = self.shared.lease().claim(now, end, claim)?;
        state.service = service;
        self.shared.changed.notify_all();
        Ok(order)
    }

    /// Does what an order wants, unless it has ended: neither its end nor its hook comes in between.
    pub(crate) fn commit<R>(&self, order: Order, change: impl FnOnce() -> R) -> Result<R, Ended> {
        let _writing = lock(&self.shared.state);
        let is_live = self.shared.lease().is_live_for(order, self.shared.parts.clock.now());
        if is_live { Ok(change()) } else { Err(Ended) }
    }

    /// Lets no order begin, and starts the hook for the one that there is: its unit reports that end later.
    pub(crate) fn inhibit(&self, now: Instant, latch: Latch) {
        // Before the lock, which a handler may hold in `commit`: it may come between any two other writes.
        self.shared.lease().inhibit(now, latch);
        let mut state = lock(&self.shared.state);
        if self.shared.lease().left(now).is_some() && !state.started_early && !state.due {
            (state.due, state.started_early) = (true, true);
        }
        self.shared.changed.notify_all();
    }

    pub(crate) fn reset(&self, now: Instant, made: Instant) {
        let _writing = lock(&self.shared.state);
        self.shared.lease().reset(now, made);
    }

    pub(crate) fn renew(&self, order: Order, end: Instant) -> bool {
        let _writing = lock(&self.shared.state);
        self.shared.lease().renew(order, end)
    }

    pub(crate) fn cut(&self, order: Order) {
        let _writing = lock(&self.shared.state);
        self.shared.lease().cut(order);
    }

    /// Ends an order whose work is done: the hook does not run. `false` for one that has ended before, whose hook does.
    pub(crate) fn finish(&self, now: Instant, order: Order) -> bool {
        let _writing = lock(&self.shared.state);
        self.shared.lease().finish(now, order)
    }

    /// Ends an order and starts the hook, unless it was started early. Returns at once.
    pub(crate) fn expire(&self, now: Instant, order: Order, how: LeaseEnd) -> bool {
        let mut state = lock(&self.shared.state);
        let is_over = self.shared.lease().end(now, order, how);
        if is_over {
            self.shared.start(&mut state);
        }
        is_over
    }

    pub(crate) fn state(&self) -> ActuatorState {
        let _writing = lock(&self.shared.state);
        self.shared.lease().state()
    }

    /// A service is removed: an order of it that has not ended does so, and the hook starts. One of another service that moves the
    /// same goes on.
    pub(crate) fn clear(&self, service: u64) {
        let mut state = lock(&self.shared.state);
        if state.service == service && self.shared.lease().clear(self.shared.parts.clock.now()) {
            self.shared.start(&mut state);
        }
    }

    /// Waits until the hook has run as often as it was to: the next order of the service comes after it. `false` when
    /// that takes long.
    pub(crate) fn has_run(&self) -> bool {
        self.shared.await_hook(lock(&self.shared.state)).1
    }

    /// Counts a hook that is stuck.
    pub(crate) fn look(&self) {
        let now = self.shared.parts.clock.now();
        self.shared.count_if_late(&mut lock(&self.shared.state), now);
    }

    /// Ends the thread, and waits for it, when the hook has run as often as it was to.
    pub(crate) fn end(&self) {
        self.shared.end();
        self.thread.join(PATIENCE);
    }
}

impl Drop for SafeHook {
    /// Without waiting: a service is replaced under a lock that everything needs.
    fn drop(&mut self) {
        self.shared.end();
    }
}

impl Shared {
    fn lease(&self) -> &Lease {
        &self.parts.lease.lease
    }

    /// An order has ended, and the hook is to run, once.
    fn start(&self, state: &mut State) {
        state.due |= !std::mem::take(&mut state.started_early);
        self.changed.notify_all();
    }

    fn end(&self) {
        lock(&self.state).is_over = true;
        self.changed.notify_all();
    }

    fn work(&self) {
        while self.await_end() {
            if catch_unwind(AssertUnwindSafe(|| (self.parts.hook)())).is_err() {
                tracing::error!("a safe hook panicked");
            }
            let mut state = lock(&self.state);
            self.count_if_late(&mut state, self.parts.clock.now());
            state.running_since = None;
            drop(state);
            self.changed.notify_all();
            if let Some(then) = &self.parts.then {
                then();
            }
        }
    }

    /// Waits until the hook is to run; `false` when it never is any more.
    fn await_end(&self) -> bool {
        let mut state = lock(&self.state);
        loop {
            let now = self.parts.clock.now();
            let left = self.lease().left(now);
            if left == Some(Duration::ZERO) && !state.started_early && !state.due && !self.lease().is_live(now) {
                (state.due, state.started_early) = (true, true);
            }
            if std::mem::take(&mut state.due) {
                (state.running_since, state.counted) = (Some(now), false);
                return true;
            }
            if state.is_over {
                return false;
            }
            state = self.wait(state, left.map(until_next_look));
        }
    }

    /// Waits until the hook has run, if it is to: `false` when that takes long.
    fn await_hook<'s>(&self, mut state: MutexGuard<'s, State>) -> (MutexGuard<'s, State>, bool) {
        let until = self.parts.clock.now() + LATE;
        while state.due || state.running_since.is_some() {
            let now = self.parts.clock.now();
            if self.count_if_late(&mut state, now) || now >= until {
                return (state, false);
            }
            state = self.wait(state, Some(LATE));
        }
        (state, true)
    }

    fn wait<'s>(&self, state: MutexGuard<'s, State>, at_most: Option<Duration>) -> MutexGuard<'s, State> {
        match at_most {
            None => self.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
            Some(span) => self.changed.wait_timeout(state, span.into()).unwrap_or_else(PoisonError::into_inner).0,
        }
    }

    /// Whether the hook runs for longer than it may; counted once.
    fn count_if_late(&self, state: &mut State, now: Instant) -> bool {
        let is_late = state.running_since.is_some_and(|since| now >= since + LATE);
        if is_late && !std::mem::replace(&mut state.counted, true) {
            self.parts.late.fetch_add(1, Ordering::Relaxed);
            tracing::error!("a safe hook takes longer than {} ms: it must be short", LATE.as_millis());
        }
        is_late
    }
}

/// How long the thread waits where so much of the lease is left. Nothing is left of a lease whose hook was started early:
/// until the unit reports its end there is nothing to hurry for.
fn until_next_look(left: Duration) -> Duration {
    if left == Duration::ZERO { LOOK } else { left.min(LOOK) }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicUsize;
    use std::sync::mpsc::channel;

    use cara_processes::ticker::unless_held_up;

    use super::*;
    use crate::testing::until;

    static AHEAD: AtomicU64 = AtomicU64::new(0);
    const CLAIM: Claim = Claim {
        holder: 1,
        replaces: None,
        takes_over: true,
        operator: false,
        link: 0,
        call: 0,
        under: cara_core::distribution::claim::Claim::NONE,
        made: Instant::START,
    };

    fn begin(safe: &SafeHook, clock: Clock, length: Duration) -> Order {
        safe.begin(clock.now() + length, &CLAIM, 0).expect("the order before has ended")
    }

    /// As a caller does: again while the hook of the order before has not run, as on a slow machine.
    fn begin_by(safe: &SafeHook, end: Instant) -> Result<Order, Error> {
        let give_up = std::time::Instant::now() + std::time::Duration::from_secs(20);
        loop {
            let begun = safe.begin(end, &CLAIM, 0);
            if begun != Err(ServiceError::NotReady.into()) || std::time::Instant::now() >= give_up {
                return begun;
            }
        }
    }

    /// The unit does nothing here: the thread sees the end of a lease that a suspension has outlasted, and what the unit
    /// reports of it later makes the hook run no second time.
    #[test]
    fn a_lease_that_a_suspension_has_outlasted_is_made_safe_at_once_and_once() {
        let (lease, runs) = (Arc::new(ServiceLease::default()), Arc::new(AtomicUsize::new(0)));
        let (clock, counted) = (Clock::moved_by(&AHEAD), runs.clone());
        let hook = Arc::new(move || {
            counted.fetch_add(1, Ordering::SeqCst);
        });
        let parts = Parts { lease: lease.clone(), clock, hook, then: None, late: Arc::default() };
        let safe = SafeHook::start(parts).unwrap();
        for round in 1..4 {
            let order = begin(&safe, clock, Duration::from_secs(3_600));
            std::thread::sleep(std::time::Duration::from_millis(30));
            assert_eq!(runs.load(Ordering::SeqCst), round - 1, "it is live");
            AHEAD.fetch_add(7_200_000_000, Ordering::SeqCst);
            assert!(!lease.lease.is_live(clock.now()));
            until(|| runs.load(Ordering::SeqCst) == round);
            assert!(safe.expire(clock.now(), order, LeaseEnd::Expired));
            until(|| safe.has_run());
        }
        safe.end();
        assert_eq!(runs.load(Ordering::SeqCst), 3);
    }

    #[test]
    fn what_ends_before_its_time_is_made_safe_and_what_is_finished_is_not() {
        static AHEAD: AtomicU64 = AtomicU64::new(0);
        let (lease, runs) = (Arc::new(ServiceLease::default()), Arc::new(AtomicUsize::new(0)));
        let (clock, counted) = (Clock::moved_by(&AHEAD), runs.clone());
        let hook = Arc::new(move || {
            counted.fetch_add(1, Ordering::SeqCst);
        });
        let parts = Parts { lease: lease.clone(), clock, hook, then: None, late: Arc::default() };
        let safe = SafeHook::start(parts).unwrap();
        let order = begin(&safe, clock, Duration::from_secs(3_600));
        assert!(safe.expire(clock.now(), order, LeaseEnd::Expired));
        until(|| runs.load(Ordering::SeqCst) == 1 && safe.has_run());
        let order = begin(&safe, clock, Duration::from_secs(3_600));
        assert!(safe.finish(clock.now(), order));
        AHEAD.fetch_add(7_200_000_000, Ordering::SeqCst);
        // Three looks of the thread.
        std::thread::sleep(std::time::Duration::from_millis(60));
        safe.end();
        assert_eq!(runs.load(Ordering::SeqCst), 1);
    }

    /// A call waits for the hook of the order before it. What was to begin is over by then, and is told to have begun by
    /// nothing.
    #[test]
    fn an_order_whose_time_passes_while_it_waits_for_the_hook_does_not_begin() {
        static AHEAD: AtomicU64 = AtomicU64::new(0);
        let clock = Clock::moved_by(&AHEAD);
        // The call waits for so long at most.
        unless_held_up(LATE.into(), || {
            let (runs, (continues, may_go_on)) = (Arc::new(AtomicUsize::new(0)), channel::<()>());
            let (counted, may_go_on) = (runs.clone(), Mutex::new(may_go_on));
            let hook = Arc::new(move || {
                counted.fetch_add(1, Ordering::SeqCst);
                let _ = lock(&may_go_on).recv();
            });
            let parts = Parts { lease: Arc::default(), clock, hook, then: None, late: Arc::default() };
            let safe = SafeHook::start(parts).unwrap();
            for (millis, begins) in [(40, false), (3_600_000, true)] {
                let order = begin(&safe, clock, Duration::from_secs(3_600));
                let before = runs.load(Ordering::SeqCst);
                assert!(safe.expire(clock.now(), order, LeaseEnd::Expired));
                until(|| runs.load(Ordering::SeqCst) == before + 1);
                let end = clock.now() + Duration::from_millis(millis);
                std::thread::scope(|scope| {
                    let (asks, asked) = channel();
                    let safe = &safe;
                    let waits = scope.spawn(move || {
                        asks.send(()).unwrap();
                        safe.begin(end, &CLAIM, 0)
                    });
                    asked.recv().unwrap();
                    std::thread::sleep(std::time::Duration::from_millis(20));
                    assert!(!waits.is_finished(), "it waits for the hook");
                    // Less than a hook may take.
                    AHEAD.fetch_add(50_000, Ordering::SeqCst);
                    continues.send(()).unwrap();
                    let order = waits.join().unwrap();
                    assert_eq!(order.err(), (!begins).then_some(Error::Expired));
                    assert_eq!(safe.shared.lease().is_live(clock.now()), begins);
                });
            }
            safe.end();
        });
    }

    #[test]
    fn the_thread_rests_between_two_looks() {
        let waits = [0, 1, 5_000, 3_600_000_000].map(|left| until_next_look(Duration::from_micros(left)).as_micros());
        assert_eq!(waits, [20_000, 1, 5_000, 20_000]);
    }

    /// What one link writes waits for what another one is writing.
    #[test]
    fn no_write_begins_during_another() {
        const LONG: Duration = Duration::from_secs(3_600);
        type Write = fn(&SafeHook, Order, Instant) -> bool;
        let writes: [Write; 6] = [
            |safe, _, now| safe.begin(now + LONG, &CLAIM, 0).is_ok(),
            |safe, order, now| safe.renew(order, now + LONG + LONG),
            |safe, order, now| {
                safe.cut(order);
                !safe.shared.lease().is_live(now)
            },
            |safe, order, now| safe.finish(now, order),
            |safe, order, now| safe.expire(now, order, LeaseEnd::Expired),
            |safe, order, now| {
                safe.clear(0);
                !safe.shared.lease().is_live_for(order, now)
            },
        ];
        let clock = Clock::new();
        for write in writes {
            let parts = Parts { lease: Arc::default(), clock, hook: Arc::new(|| {}), then: None, late: Arc::default() };
            let safe = SafeHook::start(parts).unwrap();
            let order = begin(&safe, clock, LONG);
            let (now, lease) = (clock.now(), safe.shared.lease());
            let seen = || (lease.is_live_for(order, now), lease.left(now));
            let before = seen();
            std::thread::scope(|scope| {
                let writing = lock(&safe.shared.state);
                let (begins, started) = channel();
                let safe = &safe;
                let other = scope.spawn(move || {
                    begins.send(()).unwrap();
                    write(safe, order, now)
                });
                started.recv().unwrap();
                std::thread::sleep(std::time::Duration::from_millis(20));
                assert!(!other.is_finished() && seen() == before, "it has been written during another write");
                drop(writing);
                assert!(other.join().unwrap());
                assert_ne!(seen(), before);
            });
            safe.end();
        }
    }

    /// What began earlier would be stopped by the hook of the order before it.
    #[test]
    fn an_order_does_not_begin_while_the_hook_of_the_one_before_runs() {
        const LONG: Duration = Duration::from_secs(3_600);
        let clock = Clock::new();
        let ((came, comes), (continues, may_go_on)) = (channel(), channel::<()>());
        let may_go_on = Mutex::new(may_go_on);
        let hook = Arc::new(move || {
            came.send(()).unwrap();
            let _ = lock(&may_go_on).recv();
        });
        let parts = Parts { lease: Arc::default(), clock, hook, then: None, late: Arc::default() };
        let safe = SafeHook::start(parts).unwrap();
        let order = begin(&safe, clock, LONG);
        assert!(safe.expire(clock.now(), order, LeaseEnd::Expired));
        comes.recv().unwrap();
        assert_eq!(safe.begin(clock.now() + LONG, &CLAIM, 0), Err(ServiceError::NotReady.into()));
        assert!(!safe.shared.lease().is_live(clock.now()));
        continues.send(()).unwrap();
        until(|| safe.begin(clock.now() + LONG, &CLAIM, 0).is_ok());
        safe.end();
    }

    /// Two links serve calls of one service at once. What each of them does to the lease is done as a whole: no lease
    /// outlives its orders, and no hook of an earlier order runs while a later one is live.
    #[test]
    fn calls_of_two_peers_change_one_lease_one_after_the_other() {
        const CALLS: usize = 20_000;
        const LONG: Duration = Duration::from_secs(3_600);
        let (lease, runs) = (Arc::new(ServiceLease::default()), Arc::new(AtomicUsize::new(0)));
        let (clock, counted) = (Clock::new(), runs.clone());
        let hook = Arc::new(move || {
            counted.fetch_add(1, Ordering::SeqCst);
        });
        let parts = Parts { lease: lease.clone(), clock, hook, then: None, late: Arc::default() };
        let safe = SafeHook::start(parts).unwrap();
        let serve = || {
            for call in 0..CALLS {
                let now = clock.now();
                let Ok(order) = begin_by(&safe, now + LONG) else { panic!("call {call}: busy for ever") };
                if safe.has_run() {
                    let before = runs.load(Ordering::SeqCst);
                    let renewed = safe.renew(order, now + LONG);
                    std::thread::yield_now();
                    let after = runs.load(Ordering::SeqCst);
                    let live = lease.lease.is_live_for(order, now);
                    assert!(!live || after == before, "call {call}: the hook of an earlier order ran");
                    assert!(!live || renewed, "call {call}: a live order was not renewed");
                }
                safe.expire(clock.now(), order, LeaseEnd::Expired);
            }
        };
        std::thread::scope(|scope| (0..2).for_each(|_| drop(scope.spawn(serve))));
        assert_eq!(lease.lease.left(clock.now()), None, "every order has ended, and the lease lives");
        safe.end();
    }
}
