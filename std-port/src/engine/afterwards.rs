//! Hooks that take the application's state: behind the safe hook of a service, and when a peer is lost. They may have to
//! wait for the state, so they have a thread of their own, in the order in which they became due.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use cara_core::error::Error;

use super::Engine;
use crate::executor::Executor;
use crate::handler::Hook;
use crate::locks::lock;

/// The thread, once there is a hook, and the hook for the loss of a peer.
pub(super) struct Afterwards<T> {
    executor: Mutex<Option<Arc<Executor>>>,
    lost: Mutex<Option<Arc<Pending<T>>>>,
}

impl<T> Default for Afterwards<T> {
    fn default() -> Self {
        Self { executor: Mutex::new(None), lost: Mutex::new(None) }
    }
}

/// A hook that waits once at most, however often it became due meanwhile.
struct Pending<T> {
    hook: Arc<Hook<T>>,
    waits: AtomicBool,
}

impl<T> Pending<T> {
    fn new(hook: Arc<Hook<T>>) -> Arc<Self> {
        Arc::new(Self { hook, waits: AtomicBool::new(false) })
    }
}

impl<T> Afterwards<T> {
    /// The thread is there from here on. [`Error::Network`] when the system refuses it.
    fn start(&self) -> Result<(), Error> {
        let mut executor = lock(&self.executor);
        if executor.is_none() {
            *executor = Some(Arc::new(Executor::start("cara-after")?));
        }
        Ok(())
    }

    /// Waits for the hooks that are due, and ends the thread.
    pub(super) fn end(&self) {
        let executor = lock(&self.executor).take();
        if let Some(executor) = executor {
            executor.end();
        }
    }
}

impl<T: Send + 'static> Engine<T> {
    /// What makes a hook run with the state; it returns at once.
    pub(crate) fn afterwards(&self, hook: Arc<Hook<T>>) -> Result<Box<dyn Fn() + Send + Sync>, Error> {
        self.services.afterwards.start()?;
        let (me, pending) = (self.me.clone(), Pending::new(hook));
        Ok(Box::new(move || {
            if let Some(engine) = me.upgrade() {
                engine.run_afterwards(&pending);
            }
        }))
    }

    /// Runs `hook` whenever a peer is lost.
    pub(crate) fn on_lost(&self, hook: Arc<Hook<T>>) -> Result<(), Error> {
        self.services.afterwards.start()?;
        *lock(&self.services.afterwards.lost) = Some(Pending::new(hook));
        Ok(())
    }

    pub(super) fn run_lost_hook(&self) {
        let pending = lock(&self.services.afterwards.lost).clone();
        if let Some(pending) = pending {
            self.run_afterwards(&pending);
        }
    }

    fn run_afterwards(&self, pending: &Arc<Pending<T>>) {
        let executor = lock(&self.services.afterwards.executor).clone();
        let Some(executor) = executor.filter(|_| !pending.waits.swap(true, Ordering::AcqRel)) else { return };
        let (me, pending) = (self.me.clone(), pending.clone());
        executor.run(move || {
            let Some(engine) = me.upgrade() else { return };
            let ran = engine.with_state(|state| {
                pending.waits.store(false, Ordering::Release);
                catch_unwind(AssertUnwindSafe(|| (pending.hook)(state)))
            });
            if !matches!(ran, Ok(Ok(()))) {
                tracing::error!("a hook panicked");
            }
        });
    }
}
