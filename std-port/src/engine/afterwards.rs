//! Hooks that take the application's state: behind the safe hook of a service, and when a peer is lost. They may have to
//! wait for the state, so they have a thread of their own, in the order in which they became due.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use cara_core::error::Error;

use crate::executor::Executor;
use crate::handler::Hook;
use crate::locks::lock;

/// The thread, once there is a hook, and the hook for the loss of a peer.
pub(crate) struct Afterwards<T> {
    executor: Mutex<Option<Arc<Executor>>>,
    lost: Mutex<Option<Arc<Pending<T>>>>,
}

impl<T> Default for Afterwards<T> {
    fn default() -> Self {
        Self { executor: Mutex::new(None), lost: Mutex::new(None) }
    }
}

/// A hook that waits once at most, however often it became due meanwhile.
pub(super) struct Pending<T> {
    hook: Arc<Hook<T>>,
    waits: AtomicBool,
}

impl<T> Pending<T> {
    pub(super) fn new(hook: Arc<Hook<T>>) -> Arc<Self> {
        Arc::new(Self { hook, waits: AtomicBool::new(false) })
    }

    /// Its turn has come.
    pub(super) fn run(&self, state: &mut T) {
        self.waits.store(false, Ordering::Release);
        (self.hook)(state);
    }
}

impl<T> Afterwards<T> {
    /// The thread is there from here on. [`Error::Network`] when the system refuses it.
    pub(super) fn start(&self) -> Result<(), Error> {
        let mut executor = lock(&self.executor);
        if executor.is_none() {
            *executor = Some(Arc::new(Executor::start("cara-after")?));
        }
        Ok(())
    }

    /// Runs `hook` whenever a peer is lost.
    pub(crate) fn on_lost(&self, hook: Arc<Hook<T>>) -> Result<(), Error> {
        self.start()?;
        *lock(&self.lost) = Some(Pending::new(hook));
        Ok(())
    }

    pub(super) fn lost(&self) -> Option<Arc<Pending<T>>> {
        lock(&self.lost).clone()
    }

    /// A hook is due: what it is run by, unless it waits already.
    pub(super) fn due(&self, pending: &Pending<T>) -> Option<Arc<Executor>> {
        let executor = lock(&self.executor).clone();
        executor.filter(|_| !pending.waits.swap(true, Ordering::AcqRel))
    }

    /// Waits for the hooks that are due, and ends the thread.
    pub(super) fn end(&self) {
        let executor = lock(&self.executor).take();
        if let Some(executor) = executor {
            executor.end();
        }
    }
}
