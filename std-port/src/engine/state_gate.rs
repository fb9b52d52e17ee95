//! The application's state under its own lock, which knows when waiting for it cannot end.
//!
//! A method holds the state while it runs. If it then makes a blocking request to a peer, and that peer needs the state
//! for its answer, both would wait until the deadline; the second one is told at once instead.

use std::cell::Cell;
use std::sync::{Condvar, Mutex, MutexGuard};

use cara_core::error::Error;
use cara_core::host::mailman::LinkId;

use super::lock;

thread_local! {
    /// How many methods of any unit this thread is inside of.
    static HOLDING: Cell<usize> = const { Cell::new(0) };
}

pub(crate) struct StateGate<T> {
    gate: Mutex<Gate>,
    changed: Condvar,
    state: Mutex<T>,
}

#[derive(Default)]
struct Gate {
    held: bool,
    /// The holder waits for a reply of this peer.
    waits_for: Option<LinkId>,
}

/// The state, until it is dropped.
pub(crate) struct Held<'g, T> {
    gate: &'g StateGate<T>,
    state: MutexGuard<'g, T>,
}

impl<T> StateGate<T> {
    pub(crate) fn new(state: T) -> Self {
        Self { gate: Mutex::new(Gate::default()), changed: Condvar::new(), state: Mutex::new(state) }
    }

    /// The state, for a call of `caller`; [`Error::WouldDeadlock`] when its holder waits for that caller.
    pub(crate) fn enter(&self, caller: Option<LinkId>) -> Result<Held<'_, T>, Error> {
        let mut gate = lock(&self.gate);
        while gate.held {
            if caller.is_some() && gate.waits_for == caller {
                return Err(Error::WouldDeadlock);
            }
            gate = self.changed.wait(gate).unwrap_or_else(std::sync::PoisonError::into_inner);
        }
        gate.held = true;
        drop(gate);
        HOLDING.with(|holding| holding.set(holding.get() + 1));
        Ok(Held { gate: self, state: lock(&self.state) })
    }

    /// Notes, around a blocking request of a method, whom it waits for.
    pub(crate) fn waiting_for<R>(&self, peer: LinkId, wait: impl FnOnce() -> R) -> R {
        if HOLDING.with(Cell::get) == 0 {
            return wait();
        }
        self.set_waits_for(Some(peer));
        let result = wait();
        self.set_waits_for(None);
        result
    }

    fn set_waits_for(&self, peer: Option<LinkId>) {
        let mut gate = lock(&self.gate);
        if gate.held {
            gate.waits_for = peer;
        }
        drop(gate);
        self.changed.notify_all();
    }
}

impl<T> std::ops::Deref for Held<'_, T> {
    type Target = T;
    fn deref(&self) -> &T {
        &self.state
    }
}

impl<T> std::ops::DerefMut for Held<'_, T> {
    fn deref_mut(&mut self) -> &mut T {
        &mut self.state
    }
}

impl<T> Drop for Held<'_, T> {
    /// Opens the gate; the lock itself is given up right after.
    fn drop(&mut self) {
        HOLDING.with(|holding| holding.set(holding.get().saturating_sub(1)));
        *lock(&self.gate.gate) = Gate::default();
        self.gate.changed.notify_all();
    }
}
