//! What a motor's loop looks at: may this motion go on?

use std::fmt;
use std::future::Future;
use std::pin::Pin;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use cara_core::services::lease::{Ended, Lease, Order, Stage};

use crate::actuator::Actuator;
use crate::clock::Clock;
use crate::safe_hook::SafeHook;

/// A service's lease, and the threads and tasks that await its end.
#[derive(Debug, Default)]
pub(crate) struct ServiceLease {
    pub(crate) lease: Lease,
    tasks: Mutex<Vec<Waker>>,
    threads: Condvar,
}

impl ServiceLease {
    fn tasks(&self) -> MutexGuard<'_, Vec<Waker>> {
        self.tasks.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An order has ended, or a newer one has begun: the threads and tasks that wait look again.
    pub(crate) fn wake(&self) {
        // Under the lock, which a thread holds from its look to its rest.
        let tasks = std::mem::take(&mut *self.tasks());
        self.threads.notify_all();
        tasks.into_iter().for_each(Waker::wake);
    }
}

/// A lease, to be read from any thread at any time: a few atomic loads and the clock.
///
/// [`Served::lease`](crate::Served::lease) is that of one call: once dead it is dead for ever, whatever call comes next. What
/// [`add_function`](crate::MyFunctionList::add_function) returns is the service's, for whichever call holds it now: for a
/// motor's loop, which has to stand still whenever no call moves it.
#[derive(Clone)]
pub struct LeaseWatch {
    service: Arc<ServiceLease>,
    /// The order that it is of, and the hook under whose lock that one ends.
    order: Option<(Order, Arc<SafeHook>)>,
    clock: Clock,
}

impl LeaseWatch {
    /// Of whichever order there is.
    pub(crate) const fn new(service: Arc<ServiceLease>, clock: Clock) -> Self {
        Self { service, order: None, clock }
    }

    /// Of one order.
    pub(crate) fn of(order: Order, actuator: Actuator) -> Self {
        let Actuator { lease, safe, clock, .. } = actuator;
        Self { service: lease, order: Some((order, safe)), clock }
    }

    /// The order that it is of, and its actuator's word.
    pub(crate) fn order(&self) -> Option<(&ServiceLease, Order)> {
        self.order.as_ref().map(|(order, _)| (&*self.service, *order))
    }

    /// Whether the caller still wants what it started.
    ///
    /// ```no_run
    /// # fn set_power(on: bool) {}
    /// fn motor_loop(lease: cara_std::LeaseWatch) {
    ///     loop {
    ///         set_power(lease.is_live());
    ///         std::thread::sleep(std::time::Duration::from_millis(1));
    ///     }
    /// }
    /// ```
    pub fn is_live(&self) -> bool {
        let now = self.clock.now();
        match &self.order {
            Some((order, _)) => self.service.lease.is_live_for(*order, now),
            None => self.service.lease.is_live(now),
        }
    }

    /// What the loop of a vehicle that cannot stand still at once may do now. The [ramp](crate::Actuator::ramp) is part of the
    /// bound: a vehicle stands at the latest a lease, a ramp and a turn of this loop after its manager's last sign.
    ///
    /// ```no_run
    /// # use cara_std::Stage;
    /// # fn drive() {}
    /// # fn brake() {}
    /// # fn set_power(on: bool) {}
    /// fn motor_loop(lease: cara_std::LeaseWatch) {
    ///     loop {
    ///         match lease.stage() {
    ///             Stage::Live => drive(),
    ///             Stage::Stopping => brake(),
    ///             Stage::Dead => set_power(false),
    ///         }
    ///         std::thread::sleep(std::time::Duration::from_millis(1));
    ///     }
    /// }
    /// ```
    pub fn stage(&self) -> Stage {
        let now = self.clock.now();
        match &self.order {
            Some((order, _)) => self.service.lease.stage_for(*order, now),
            None => self.service.lease.stage(now),
        }
    }

    /// How long it lasts as things are, for measurements and displays; `None` once it is dead. A motor asks
    /// [`stage`](Self::stage): what is left may be taken back at any time.
    pub fn left(&self) -> Option<cara_core::time::Duration> {
        if self.is_live() { self.service.lease.left(self.clock.now()) } else { None }
    }

    /// Runs `change` while the order lives, and nothing once it has ended. The order's end and its safe hook wait for
    /// `change`, so it must be short, and ask nothing of the unit.
    pub fn commit<R>(&self, change: impl FnOnce() -> R) -> Result<R, Ended> {
        match &self.order {
            Some((order, safe)) => safe.commit(*order, change),
            None if self.is_live() => Ok(change()),
            None => Err(Ended),
        }
    }

    /// Waits until it is dead, in this thread. It returns at once when it is dead already.
    pub fn wait_until_ended(&self) {
        let mut tasks = self.service.tasks();
        while self.is_live() {
            // It may end by time alone, where the unit's own threads are held up.
            let left = self
                .service
                .lease
                .left(self.clock.now())
                .map_or(Duration::ZERO, Duration::from)
                .max(Duration::from_millis(1));
            tasks = self.service.threads.wait_timeout(tasks, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Ends when it is dead. Dropping the future loses nothing.
    pub fn ended(&self) -> LeaseEnded {
        LeaseEnded { watch: Some(self.clone()) }
    }
}

impl fmt::Debug for LeaseWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "LeaseWatch(live: {})", self.is_live())
    }
}

/// The end of a lease; see [`LeaseWatch::ended`] and [`Served::lease_ended`](crate::Served::lease_ended).
#[derive(Clone, Debug)]
#[must_use = "it is awaited"]
pub struct LeaseEnded {
    /// `None` where there is no lease: nothing ends.
    pub(crate) watch: Option<LeaseWatch>,
}

impl Future for LeaseEnded {
    type Output = ();

    fn poll(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        let Some(watch) = &self.watch else { return Poll::Pending };
        let mut tasks = watch.service.tasks();
        if !watch.is_live() {
            return Poll::Ready(());
        }
        if !tasks.iter().any(|task| task.will_wake(cx.waker())) {
            tasks.push(cx.waker().clone());
        }
        Poll::Pending
    }
}
