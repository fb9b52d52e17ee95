//! The five further nodes of the paper's distribution 2: each calls at random, while it is told to.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, OnceLock, PoisonError};
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
/// One call of so many may fail: on a machine with other load an answer may come too late, and the others go on.
const TOLERATED: u64 = 100;

/// The nodes, each with a thread of its own.
pub(crate) struct Further {
    state: Arc<State>,
}

#[derive(Default)]
struct State {
    is_calling: Mutex<bool>,
    changed: Condvar,
    calls: AtomicU64,
    failures: AtomicU64,
    /// Of the first failure.
    reason: OnceLock<String>,
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

    /// They stop; how many calls were answered since the process began, or an error where more than a few were not.
    pub(crate) fn end(&self) -> Result<u64> {
        self.state.set(false);
        let [calls, failures] = [&self.state.calls, &self.state.failures].map(|count| count.load(Ordering::Relaxed));
        let reason = self.state.reason.get().map_or("", String::as_str);
        ensure!(failures <= calls / TOLERATED, "{failures} calls of further nodes failed, {calls} did not: {reason}");
        Ok(calls)
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
                Err(error) => {
                    self.reason.get_or_init(|| format!("{error:#}"));
                    self.failures.fetch_add(1, Ordering::Relaxed)
                }
            };
        }
    }
}
