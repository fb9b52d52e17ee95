//! The five further nodes of the paper's distribution 2: each calls at random, while it is told to.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use anyhow::{Result, ensure};

use crate::block::text;
use crate::peer::{Caller, Peer, Place};

/// How many there are.
const NODES: u32 = 5;
/// Characters of each call.
const CHARS: u32 = 1_000;
/// Milliseconds between two calls of one node, drawn at random.
const INTERVAL_MS: std::ops::RangeInclusive<u64> = 1..=20;

/// The nodes, each with a thread of its own.
pub(crate) struct Further {
    state: Arc<State>,
}

#[derive(Default)]
struct State {
    is_calling: Mutex<bool>,
    changed: Condvar,
    has_failed: AtomicBool,
    calls: AtomicU64,
}

impl Further {
    /// Connects all of them, and starts none.
    pub(crate) fn connect(peer: &dyn Peer, place: &Place, address: &str) -> Result<Self> {
        let state = Arc::new(State::default());
        // All at the same time: each listens for a while before it looks for its manager.
        let connected: Vec<Result<_>> = thread::scope(|scope| {
            let connect = |number| scope.spawn(move || peer.connect_further(place, address, number));
            let threads: Vec<_> = (0..NODES).map(connect).collect();
            threads.into_iter().map(|thread| thread.join().expect("connecting does not panic")).collect()
        });
        for caller in connected {
            let (mut caller, state) = (caller?, state.clone());
            thread::spawn(move || state.call(&mut *caller));
        }
        Ok(Self { state })
    }

    /// They call from now on.
    pub(crate) fn begin(&self) {
        self.state.set(true);
    }

    /// They stop; how many calls were answered since the process began, or an error where one was not.
    pub(crate) fn end(&self) -> Result<u64> {
        self.state.set(false);
        ensure!(!self.state.has_failed.load(Ordering::Relaxed), "a call of a further node failed");
        Ok(self.state.calls.load(Ordering::Relaxed))
    }
}

impl State {
    fn set(&self, is_calling: bool) {
        *self.is_calling.lock().unwrap_or_else(PoisonError::into_inner) = is_calling;
        self.changed.notify_all();
    }

    /// Until they are told to call.
    fn wait(&self) {
        let is_calling = self.is_calling.lock().unwrap_or_else(PoisonError::into_inner);
        drop(self.changed.wait_while(is_calling, |is_calling| !*is_calling));
    }

    fn call(&self, caller: &mut dyn Caller) {
        let text = text(CHARS);
        loop {
            self.wait();
            thread::sleep(Duration::from_millis(fastrand::u64(INTERVAL_MS)));
            if !*self.is_calling.lock().unwrap_or_else(PoisonError::into_inner) {
                continue;
            }
            match caller.echo(&text) {
                Ok(_) => self.calls.fetch_add(1, Ordering::Relaxed),
                Err(_) => return self.has_failed.store(true, Ordering::Relaxed),
            };
        }
    }
}
