//! The application's state under its own lock, which knows when waiting for it cannot end.
//!
//! A method holds the state while it runs. If it then makes a blocking request to a peer, and that peer needs the state
//! for its answer, both would wait until the deadline; the second one is told at once instead. A hook waits for nobody:
//! what it would wait for may be the very thread that is to run it. The holder runs it before it gives the state up.

use std::cell::Cell;
use std::sync::{Condvar, Mutex, MutexGuard};
use std::thread::ThreadId;

use cara_core::error::Error;
use cara_core::host::mailman::LinkId;

use super::lock;

thread_local! {
    /// How many methods of any unit this thread is inside of.
    static HOLDING: Cell<usize> = const { Cell::new(0) };
}

pub(crate) struct StateGate<T> {
    gate: Mutex<Gate<T>>,
    changed: Condvar,
    state: Mutex<T>,
}

struct Gate<T> {
    holder: Option<ThreadId>,
    /// The holder waits for a reply of this peer.
    waits_for: Option<LinkId>,
    /// What the holder runs before it goes.
    left: Vec<Work<T>>,
    /// Peers' calls are no longer let in.
    stopped: bool,
}

/// Something short that needs the state.
type Work<T> = Box<dyn FnOnce(&mut T) + Send>;

/// The state, until it is dropped.
pub(crate) struct Held<'g, T> {
    gate: &'g StateGate<T>,
    state: MutexGuard<'g, T>,
}

impl<T> StateGate<T> {
    pub(crate) fn new(state: T) -> Self {
        let gate = Gate { holder: None, waits_for: None, left: Vec::new(), stopped: false };
        Self { gate: Mutex::new(gate), changed: Condvar::new(), state: Mutex::new(state) }
    }

    /// The state, for a call of `caller`; [`Error::WouldDeadlock`] when its holder waits for that caller, or is this
    /// thread. [`Error::NotRunning`] for a call of a peer when the unit has stopped.
    pub(crate) fn enter(&self, caller: Option<LinkId>) -> Result<Held<'_, T>, Error> {
        let this = std::thread::current().id();
        let mut gate = lock(&self.gate);
        loop {
            if caller.is_some() && gate.stopped {
                return Err(Error::NotRunning);
            }
            let Some(holder) = gate.holder else { break };
            if holder == this || (caller.is_some() && gate.waits_for == caller) {
                return Err(Error::WouldDeadlock);
            }
            gate = self.changed.wait(gate).unwrap_or_else(std::sync::PoisonError::into_inner);
        }
        gate.holder = Some(this);
        drop(gate);
        HOLDING.with(|holding| holding.set(holding.get() + 1));
        Ok(Held { gate: self, state: lock(&self.state) })
    }

    /// Runs `work` now, or leaves it to whoever holds the state. `work` must not panic.
    pub(crate) fn run_or_leave(&self, work: Work<T>) {
        let mut gate = lock(&self.gate);
        if gate.holder.is_some() {
            gate.left.push(work);
            return;
        }
        gate.holder = Some(std::thread::current().id());
        drop(gate);
        HOLDING.with(|holding| holding.set(holding.get() + 1));
        let mut held = Held { gate: self, state: lock(&self.state) };
        work(&mut held);
    }

    /// Lets no more calls of peers in; those that wait return.
    pub(crate) fn stop(&self) {
        lock(&self.gate).stopped = true;
        self.changed.notify_all();
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
        if gate.holder == Some(std::thread::current().id()) {
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
    /// Runs what was left to the holder, then opens the gate; the lock itself is given up right after.
    fn drop(&mut self) {
        loop {
            let mut gate = lock(&self.gate.gate);
            if gate.left.is_empty() {
                gate.holder = None;
                gate.waits_for = None;
                break;
            }
            let left = std::mem::take(&mut gate.left);
            drop(gate);
            left.into_iter().for_each(|work| work(&mut self.state));
        }
        HOLDING.with(|holding| holding.set(holding.get().saturating_sub(1)));
        self.gate.changed.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;
    use std::sync::{Arc, Barrier};
    use std::time::{Duration, Instant};

    use super::*;

    const HERE: Option<LinkId> = Some(LinkId(1));
    const ELSEWHERE: Option<LinkId> = Some(LinkId(2));

    fn assert_refused(gate: &StateGate<u32>, caller: Option<LinkId>, error: Error) {
        assert_eq!(gate.enter(caller).map(|held| *held).unwrap_err(), error);
    }

    /// Runs `act` on another thread while this one holds the state and waits for the peer of `HERE`.
    fn while_waiting(gate: &StateGate<u32>, act: impl FnOnce() + Send) {
        let held = gate.enter(None).unwrap();
        gate.waiting_for(LinkId(1), || std::thread::scope(|scope| scope.spawn(act).join().unwrap()));
        drop(held);
    }

    #[test]
    fn one_at_a_time_holds_the_state() {
        let gate = Arc::new(StateGate::new(0_u32));
        let threads: Vec<_> = (0..4)
            .map(|_| {
                let gate = gate.clone();
                std::thread::spawn(move || (0..500).for_each(|_| *gate.enter(HERE).unwrap() += 1))
            })
            .collect();
        threads.into_iter().for_each(|thread| thread.join().unwrap());
        assert_eq!(*gate.enter(None).unwrap(), 2_000);
    }

    #[test]
    fn who_is_waited_for_is_told_at_once() {
        let gate = StateGate::new(0);
        while_waiting(&gate, || assert_refused(&gate, HERE, Error::WouldDeadlock));
        assert!(gate.enter(HERE).is_ok(), "nobody holds it any more");
    }

    /// The peer's call came first and waits; then the holder begins to wait for that peer.
    #[test]
    fn who_waits_already_is_told_when_the_holder_begins_to_wait() {
        let gate = StateGate::new(0);
        let held = gate.enter(None).unwrap();
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| assert_refused(&gate, HERE, Error::WouldDeadlock));
            gate.waiting_for(LinkId(1), || waiting.join().unwrap());
        });
        drop(held);
    }

    #[test]
    fn others_wait_until_the_holder_goes() {
        let gate = Arc::new(StateGate::new(1));
        let (sender, receiver) = channel();
        let held = gate.enter(None).unwrap();
        let other = {
            let gate = gate.clone();
            std::thread::spawn(move || sender.send(*gate.enter(ELSEWHERE).unwrap()).unwrap())
        };
        gate.waiting_for(LinkId(1), || assert!(receiver.recv_timeout(Duration::from_millis(20)).is_err()));
        drop(held);
        assert_eq!(receiver.recv_timeout(Duration::from_secs(5)), Ok(1));
        other.join().unwrap();
    }

    #[test]
    fn a_thread_does_not_wait_for_itself() {
        let gate = StateGate::new(0);
        let _held = gate.enter(HERE).unwrap();
        assert_refused(&gate, None, Error::WouldDeadlock);
    }

    /// A thread that holds one unit's state and asks on behalf of another unit changes nothing there.
    #[test]
    fn only_the_holder_can_wait_for_a_peer() {
        let (mine, other) = (StateGate::new(0), Arc::new(StateGate::new(0)));
        let barrier = Arc::new(Barrier::new(2));
        let holder = {
            let (other, barrier) = (other.clone(), barrier.clone());
            std::thread::spawn(move || {
                let _held = other.enter(None).unwrap();
                barrier.wait();
                barrier.wait();
            })
        };
        barrier.wait();
        let _held = mine.enter(None).unwrap();
        other.waiting_for(LinkId(1), || assert_eq!(lock(&other.gate).waits_for, None));
        barrier.wait();
        holder.join().unwrap();
    }

    #[test]
    fn work_is_run_at_once_or_by_the_holder_in_order() {
        let gate = StateGate::new(0);
        gate.run_or_leave(Box::new(|state| *state = 1));
        let mut held = gate.enter(None).unwrap();
        assert_eq!(*held, 1);
        gate.run_or_leave(Box::new(|state| *state *= 10));
        gate.run_or_leave(Box::new(|state| *state += 2));
        *held = 4;
        drop(held);
        assert_eq!(*gate.enter(None).unwrap(), 42);
    }

    #[test]
    fn a_stopped_unit_lets_no_peer_in() {
        let gate = StateGate::new(0);
        let began = Instant::now();
        let held = gate.enter(None).unwrap();
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| assert_refused(&gate, HERE, Error::NotRunning));
            gate.stop();
            waiting.join().unwrap();
        });
        drop(held);
        assert_refused(&gate, HERE, Error::NotRunning);
        assert!(gate.enter(None).is_ok(), "the application still reads its state");
        assert!(began.elapsed() < Duration::from_secs(5));
    }

    #[test]
    fn a_panic_opens_the_gate() {
        let gate = StateGate::new(0);
        let panicked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            let _held = gate.enter(HERE).unwrap();
            panic!("a handler");
        }));
        assert!(panicked.is_err() && gate.enter(HERE).is_ok());
    }
}
