//! What a unit offers: its functions, the application's state that their handlers work on, and the memory for their calls.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, RwLock, RwLockReadGuard, RwLockWriteGuard};

use cara_core::distribution::function_list::{FunctionList, Slot};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::lease::{Latch, Lease, Service as _};
use cara_core::services::session::Incoming;
use cara_core::time::Instant;

use super::afterwards::{Afterwards, Pending};
use super::driving::Driver;
use super::link::LinkCell;
#[cfg(feature = "async")]
use super::state_gate::Access;
use super::state_gate::{StateGate, Turn};
#[cfg(feature = "async")]
use super::tasks::Runner;
use crate::handler::{Handler, Hook};
use crate::locks::{Held, Rank};
use crate::storage::Boxed;

type Functions<T> = FunctionList<Boxed, Handler<T>>;

pub(crate) struct Services<T: 'static> {
    driver: Arc<Driver>,
    functions: RwLock<Functions<T>>,
    pub(super) state: StateGate<T, Parked>,
    pub(crate) afterwards: Afterwards<T>,
    #[cfg(feature = "async")]
    pub(crate) runner: Runner,
    /// Longest block of parameters that this unit takes.
    longest_message: AtomicUsize,
    /// Bytes that the arguments and results of the largest function need.
    largest_function: AtomicUsize,
}

/// A call whose turn has not come yet, with its arguments.
pub(crate) struct Parked {
    pub(super) link: Arc<LinkCell>,
    pub(super) call: Incoming,
    pub(super) arguments: Box<ParametersView>,
}

impl<T: Send + 'static> Services<T> {
    pub(super) fn new(driver: Arc<Driver>, functions: Functions<T>, state: T, longest_message: usize) -> Self {
        Self {
            driver,
            functions: RwLock::new(functions),
            state: StateGate::new(state),
            afterwards: Afterwards::default(),
            #[cfg(feature = "async")]
            runner: Runner::default(),
            longest_message: AtomicUsize::new(longest_message),
            largest_function: AtomicUsize::new(0),
        }
    }

    #[track_caller]
    pub(crate) fn functions(&self) -> Held<RwLockReadGuard<'_, Functions<T>>> {
        Rank::Functions.read(&self.functions)
    }

    #[track_caller]
    pub(crate) fn functions_mut(&self) -> Held<RwLockWriteGuard<'_, Functions<T>>> {
        Rank::Functions.write(&self.functions)
    }

    /// Slots of the unit's own list that are in use: those up to its last function.
    pub(super) fn own_functions(&self) -> usize {
        self.functions().iter().map(|function| usize::from(function.slot.0) + 1).max().unwrap_or(0)
    }

    pub(super) fn set_longest_message(&self, bytes: usize) {
        self.longest_message.store(bytes, Ordering::Release);
    }

    /// A function of the unit needs so many bytes for its arguments and results.
    pub(crate) fn make_room_for(&self, bytes: usize) {
        self.largest_function.fetch_max(bytes, Ordering::AcqRel);
    }

    /// Bytes that the parameters of a served call may need: of a message, or of the largest function.
    pub(super) fn call_bytes(&self) -> usize {
        self.longest_message.load(Ordering::Acquire).max(self.largest_function.load(Ordering::Acquire))
    }

    /// Runs `act` with the application's state, when its turn comes.
    pub(crate) fn with_state<R>(&self, act: impl FnOnce(&mut T) -> R) -> Result<R, Error> {
        let result = self.state.enter().map(|held| held.change(act));
        self.go_on_with_parked();
        result?.ok_or(Error::NotRunning)
    }

    /// The same for a task, which no thread waits for.
    #[cfg(feature = "async")]
    pub(crate) async fn with_state_awaited<R>(&self, act: impl FnOnce(&mut T) -> R) -> Result<R, Error> {
        struct Place<'s, T: Send + 'static>(&'s Services<T>, Turn);
        impl<T: Send + 'static> Drop for Place<'_, T> {
            fn drop(&mut self) {
                self.0.state.give_up(self.1);
                self.0.go_on_with_parked();
            }
        }
        let place = Place(self, self.state.take_turn(None, Access::Change));
        let mut act = Some(act);
        std::future::poll_fn(|cx| {
            let entered = self.state.poll_enter(place.1, cx);
            entered.map_ok(|held| act.take().and_then(|act| held.change(act)))
        })
        .await?
        .ok_or(Error::NotRunning)
    }

    /// Calls that were parked and have their turn now are left to the pool.
    pub(super) fn go_on_with_parked(&self) {
        if self.state.has_ready()
            && let Some(unit_number) = self.driver.unit_number()
        {
            self.driver.pool().hand_over(crate::threads::token(unit_number, u64::MAX));
        }
    }

    pub(super) fn park(&self, turn: Turn, parked: Parked) {
        self.state.park(turn, parked);
        self.go_on_with_parked();
    }

    pub(super) fn give_up(&self, turn: Option<Turn>) {
        if let Some(turn) = turn {
            self.state.give_up(turn);
            self.go_on_with_parked();
        }
    }

    /// What makes a hook run with the state; it returns at once.
    pub(crate) fn afterwards(self: &Arc<Self>, hook: Arc<Hook<T>>) -> Result<Box<dyn Fn() + Send + Sync>, Error> {
        self.afterwards.start()?;
        let (me, pending) = (Arc::downgrade(self), Pending::new(hook));
        Ok(Box::new(move || {
            if let Some(services) = me.upgrade() {
                services.run_afterwards(&pending);
            }
        }))
    }

    pub(super) fn run_lost_hook(self: &Arc<Self>) {
        if let Some(pending) = self.afterwards.lost() {
            self.run_afterwards(&pending);
        }
    }

    fn run_afterwards(self: &Arc<Self>, pending: &Arc<Pending<T>>) {
        let Some(executor) = self.afterwards.due(pending) else { return };
        let (me, pending) = (Arc::downgrade(self), pending.clone());
        executor.run(move || {
            let Some(services) = me.upgrade() else { return };
            let ran = services.with_state(|state| catch_unwind(AssertUnwindSafe(|| pending.run(state))));
            if !matches!(ran, Ok(Ok(()))) {
                tracing::error!("a hook panicked");
            }
        });
    }

    /// What is latched, if anything is.
    pub(crate) fn latched(&self) -> Option<Latch> {
        let functions = self.functions();
        let latched = functions.iter().filter_map(|function| function.handler.lease()).find_map(Lease::latch);
        latched.or_else(|| functions.stopped().latch())
    }

    /// A stop of all has ended once its program has reset the last actuator in the list.
    pub(super) fn end_stop_of_all(&self, now: Instant) {
        let functions = self.functions();
        let mut leases = functions.iter().filter_map(|function| function.handler.lease()).peekable();
        if leases.peek().is_some() && leases.all(|lease| !lease.is_inhibited()) {
            functions.stopped().reset_by_parts(now, now);
        }
    }

    /// Has each safe hook that is stuck count itself.
    pub(super) fn look_at_hooks(&self) {
        let functions = self.functions();
        let actuators = functions.iter().filter_map(|function| function.handler.actuator.as_ref());
        actuators.for_each(|actuator| actuator.safe.look());
    }

    /// Ends what runs beside the pool. A handler may own a handle to a peer of this unit, and so the unit itself: without
    /// handlers nothing is left.
    pub(super) fn end(&self) -> Vec<Handler<T>> {
        let handlers = self.take_handlers();
        // What moved stops, and is heard of, before the unit is gone.
        handlers.iter().filter_map(|handler| handler.actuator.as_ref()).for_each(|actuator| actuator.safe.end());
        self.afterwards.end();
        handlers.iter().filter_map(|handler| handler.executor.as_ref()).for_each(|executor| executor.end());
        #[cfg(feature = "async")]
        self.runner.end();
        handlers
    }

    fn take_handlers(&self) -> Vec<Handler<T>> {
        let mut functions = self.functions_mut();
        let names: Vec<String> = functions.iter().map(|function| function.name().to_owned()).collect();
        names.iter().filter_map(|name| functions.remove(name).ok()).map(|(_, handler)| handler).collect()
    }
}

/// The lease of a service has ended, and its safe hook is running: whatever waits for the end of the lease looks again.
pub(super) fn wake_leased<T>(functions: &Functions<T>, slot: Slot) {
    if let Some(actuator) = functions.function(slot).and_then(|function| function.handler.actuator.as_ref()) {
        actuator.lease.wake();
    }
}
