//! What a unit offers: its functions, the application's state that their handlers work on, and the memory for their calls.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{RwLock, RwLockReadGuard, RwLockWriteGuard};

use cara_core::distribution::function_list::FunctionList;

use super::afterwards::Afterwards;
use super::serving::Parked;
use super::state_gate::StateGate;
use crate::handler::Handler;
use crate::locks::{Held, Rank};
use crate::storage::Boxed;

type Functions<T> = FunctionList<Boxed, Handler<T>>;

pub(super) struct Services<T: 'static> {
    functions: RwLock<Functions<T>>,
    pub(super) state: StateGate<T, Parked>,
    pub(super) afterwards: Afterwards<T>,
    #[cfg(feature = "async")]
    pub(super) runner: super::tasks::Runner,
    /// Longest block of parameters that this unit takes.
    longest_message: AtomicUsize,
    /// Bytes that the arguments and results of the largest function need.
    largest_function: AtomicUsize,
}

impl<T> Services<T> {
    pub(super) fn new(functions: Functions<T>, state: T, longest_message: usize) -> Self {
        Self {
            functions: RwLock::new(functions),
            state: StateGate::new(state),
            afterwards: Afterwards::default(),
            #[cfg(feature = "async")]
            runner: super::tasks::Runner::default(),
            longest_message: AtomicUsize::new(longest_message),
            largest_function: AtomicUsize::new(0),
        }
    }

    #[track_caller]
    pub(super) fn functions(&self) -> Held<RwLockReadGuard<'_, Functions<T>>> {
        Rank::Functions.read(&self.functions)
    }

    #[track_caller]
    pub(super) fn functions_mut(&self) -> Held<RwLockWriteGuard<'_, Functions<T>>> {
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
    pub(super) fn make_room_for(&self, bytes: usize) {
        self.largest_function.fetch_max(bytes, Ordering::AcqRel);
    }

    /// Bytes that the parameters of a served call may need: of a message, or of the largest function.
    pub(super) fn call_bytes(&self) -> usize {
        self.longest_message.load(Ordering::Acquire).max(self.largest_function.load(Ordering::Acquire))
    }
}
