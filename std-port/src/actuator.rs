//! What a vehicle moves: a drive, a fork. One order at a time has it, whichever service that one is of.

use std::fmt;
use std::sync::Arc;

use cara_core::services::lease::{Latch, Lease};

use cara_core::time::Instant;

use crate::clock::Clock;
use crate::lease::{LeaseWatch, ServiceLease};
use crate::safe_hook::SafeHook;

/// What several services move: an order of one of them takes the place of any other's, and a stop ends it. Made by
/// [`MyFunctionList::actuator`](crate::MyFunctionList::actuator) with the hook that makes it safe.
///
/// ```no_run
/// # use std::{sync::{Arc, atomic::{AtomicBool, Ordering}}, time::Duration};
/// # use cara_std::{Served, Definition, ParametersView, ServiceError, ServiceOptions, Unit};
/// # fn drive_to(_: &Served, _: &mut ParametersView) -> Result<(), ServiceError> { Ok(()) }
/// # fn halt(_: &Served, _: &mut ParametersView) -> Result<(), ServiceError> { Ok(()) }
/// let agv = Unit::new("agv", 7, "depot", 1)?;
/// let functions = agv.my_function_list();
/// let power = Arc::new(AtomicBool::new(false));
/// let off = power.clone();
/// let drive = functions.actuator(move || off.store(false, Ordering::SeqCst))?;
///
/// let moves = || ServiceOptions::new().moves(&drive, Duration::from_millis(400));
/// functions.add_service(&Definition::parse("go_to(position: int[2])").unwrap(), moves(), drive_to)?;
/// functions.add_service(&Definition::parse("dock(station: int)").unwrap(), moves(), drive_to)?;
/// functions.add_service(&Definition::parse("halt()").unwrap(), ServiceOptions::new().stops(&drive), halt)?;
/// functions.add_service(&Definition::parse("go_on()").unwrap(), ServiceOptions::new().resets(&drive), halt)?;
///
/// # fn bumper_is_pressed() -> bool { false }
/// if bumper_is_pressed() {
///     drive.inhibit(1);
/// }
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone)]
pub struct Actuator {
    pub(crate) lease: Arc<ServiceLease>,
    pub(crate) safe: Arc<SafeHook>,
    pub(crate) clock: Clock,
    /// Lets the unit look at what a stop, or a reset, has changed.
    pub(crate) look: Arc<dyn Fn(Change) + Send + Sync>,
}

/// What happened to an actuator's latch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Change {
    Stopped,
    /// By a call, which does the same for the unit.
    Reset,
    /// By the unit's own program.
    ResetHere,
}

impl Actuator {
    /// Whether it may move, on behalf of whichever order has it: for the loop that moves it.
    pub fn watch(&self) -> LeaseWatch {
        LeaseWatch::new(self.lease.clone(), self.clock)
    }

    /// How long what it moves takes to stand still: an order that ends unfinished is [stopping](LeaseWatch::stage) for this
    /// time, and no other one begins meanwhile (`Busy`). At most a minute.
    #[must_use]
    pub fn ramp(self, span: impl Into<cara_core::time::Duration>) -> Self {
        self.word().set_ramp(span.into());
        self
    }

    /// The vehicle's own stop, as of a bumper or a switch for manual mode: the order ends, its hook starts, and none begins
    /// until a service [resets](crate::ServiceOptions::resets) it, or [`reset`](Self::reset) does. Callers are told `reason`,
    /// as [`Error::Inhibited`](crate::Error::Inhibited).
    pub fn inhibit(&self, reason: u16) {
        self.inhibit_at(self.clock.now(), Latch { by: 0, reason });
    }

    pub(crate) fn inhibit_at(&self, now: Instant, latch: Latch) {
        self.safe.inhibit(now, latch);
        self.lease.wake();
        (self.look)(Change::Stopped);
    }

    /// Lets it move again.
    pub fn reset(&self) {
        let now = self.clock.now();
        self.safe.reset(now, now);
        (self.look)(Change::ResetHere);
    }

    pub(crate) fn reset_at(&self, now: Instant, made: Instant) {
        self.safe.reset(now, made);
        (self.look)(Change::Reset);
    }

    /// What inhibits it.
    pub fn latch(&self) -> Option<Latch> {
        self.word().latch()
    }

    pub(crate) fn word(&self) -> &Lease {
        &self.lease.lease
    }
}

impl fmt::Debug for Actuator {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Actuator").field("watch", &self.watch()).field("latch", &self.latch()).finish()
    }
}
