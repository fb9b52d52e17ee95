//! The application's state, which calls take in turns, in the order in which they began: one that changes it alone, those that
//! only read it side by side.
//!
//! A call takes its turn when it begins, under the lock of its link, and the state when its turn comes. One that would
//! wait for long gives its thread back and is parked here: it is given to the pool again when its turn has come. So
//! however many calls wait for the state, none of them keeps a thread from the calls that do not need it.
//!
//! A call that reads joins those that read already only if nothing waits before it: however many readers come, one that changes
//! the state waits for those before it alone.
//!
//! The gate also knows when waiting cannot end. A method has the state while it runs. If it then makes a blocking
//! request to a peer, and that peer's call has to wait for its turn, both would wait until the deadline; the second one is
//! told at once instead.

use std::cell::Cell;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::task::Waker;
#[cfg(feature = "async")]
use std::task::{Context, Poll};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

use super::state::State;
use crate::locks::lock;
use cara_core::error::Error;
use cara_core::host::mailman::LinkId;

/// How long a thread of the pool waits for a turn before it parks the call: methods are short as a rule.
const PATIENCE: Duration = Duration::from_millis(1);

thread_local! {
    /// How many methods of any unit this thread is inside of.
    static HOLDING: Cell<usize> = const { Cell::new(0) };
}

/// What a turn is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Access {
    /// Beside others that read.
    Read,
    Change,
}

/// A place in the order of those that take the state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Turn {
    number: u64,
    access: Access,
    /// The peer whose call it is.
    caller: Option<LinkId>,
}

/// The state, and what is parked for it: `W`.
pub(crate) struct StateGate<T, W> {
    gate: Mutex<Gate<W>>,
    changed: Condvar,
    state: State<T>,
    /// Calls that were parked and are to go on; read without a lock.
    ready: AtomicUsize,
}

struct Gate<W> {
    /// Whose turn it is: one that changes the state, or any number that read it.
    holders: Vec<Holder>,
    /// Those that wait, in their order.
    queue: VecDeque<Waiting<W>>,
    /// What was parked and is to go on.
    ready: VecDeque<(W, Result<Turn, Error>)>,
    turns: u64,
    /// Of the tasks that wait for their turn.
    tasks: Vec<Waker>,
    /// Peers' calls are no longer let in.
    stopped: bool,
}

/// One whose turn it is.
struct Holder {
    turn: Turn,
    /// `None` until it has come.
    thread: Option<ThreadId>,
    /// It waits for a reply of each of these peers.
    waits_for: Vec<LinkId>,
}

/// That a holder waits for a peer.
#[derive(Debug)]
pub(crate) struct Mark {
    peer: LinkId,
    /// Which holder.
    turn: Turn,
}

struct Waiting<W> {
    turn: Turn,
    parked: Option<W>,
}

/// What waiting for a turn led to.
pub(crate) enum Entered<'g, T: 'static, W> {
    Held(Held<'g, T, W>),
    /// It takes long: the call is to be parked.
    NotYet,
    Refused(Error),
}

/// The state, until it is dropped.
pub(crate) struct Held<'g, T: 'static, W> {
    gate: &'g StateGate<T, W>,
    turn: Turn,
}

impl<T: 'static, W> StateGate<T, W> {
    pub(crate) fn new(state: T) -> Self {
        let gate = Gate {
            holders: Vec::new(),
            queue: VecDeque::new(),
            ready: VecDeque::new(),
            turns: 0,
            tasks: Vec::new(),
            stopped: false,
        };
        let (gate, changed, state) = (Mutex::new(gate), Condvar::new(), State::new(state));
        Self { gate, changed, state, ready: AtomicUsize::new(0) }
    }

    /// The next turn, for a call of `caller`, or for the application itself.
    pub(crate) fn take_turn(&self, caller: Option<LinkId>, access: Access) -> Turn {
        let mut gate = lock(&self.gate);
        gate.turns += 1;
        let turn = Turn { number: gate.turns, access, caller };
        gate.queue.push_back(Waiting { turn, parked: None });
        gate.admit();
        turn
    }

    /// The state for the application itself, however long that takes; [`Error::WouldDeadlock`] when this thread has it.
    pub(crate) fn enter(&self) -> Result<Held<'_, T, W>, Error> {
        let turn = self.take_turn(None, Access::Change);
        match self.await_turn(turn, None) {
            Entered::Held(held) => Ok(held),
            Entered::NotYet => Err(Error::WouldDeadlock),
            Entered::Refused(error) => Err(error),
        }
    }

    /// The state for a call that has its turn. [`Error::WouldDeadlock`] when a holder waits for that call's peer, or is
    /// this thread. [`Error::NotRunning`] when the unit has stopped. Refused, the turn is given up.
    pub(crate) fn enter_by(&self, turn: Turn) -> Entered<'_, T, W> {
        self.await_turn(turn, Some(PATIENCE))
    }

    fn await_turn(&self, turn: Turn, patience: Option<Duration>) -> Entered<'_, T, W> {
        let this = std::thread::current().id();
        let mut end = None;
        let mut gate = lock(&self.gate);
        loop {
            if gate.has_turn(turn) {
                if gate.stopped && turn.caller.is_some() {
                    gate.leave(turn);
                    self.notify(gate);
                    return Entered::Refused(Error::NotRunning);
                }
                return Entered::Held(self.hold(gate, turn, this));
            }
            let refusal = match gate.held_by(this).is_some() {
                true => Some(Error::WouldDeadlock),
                false => gate.refusal(turn),
            };
            if let Some(error) = refusal {
                gate.leave(turn);
                self.notify(gate);
                return Entered::Refused(error);
            }
            let Some(patience) = patience else {
                gate = self.changed.wait(gate).unwrap_or_else(PoisonError::into_inner);
                continue;
            };
            let now = Instant::now();
            let left = end.get_or_insert(now + patience).saturating_duration_since(now);
            if left.is_zero() {
                return Entered::NotYet;
            }
            gate = self.changed.wait_timeout(gate, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// The state for a task that has this turn, of the application itself, once it is its turn. [`Error::WouldDeadlock`] when
    /// this thread has it.
    #[cfg(feature = "async")]
    pub(crate) fn poll_enter(&self, turn: Turn, cx: &Context<'_>) -> Poll<Result<Held<'_, T, W>, Error>> {
        let this = std::thread::current().id();
        let mut gate = lock(&self.gate);
        if gate.has_turn(turn) {
            return Poll::Ready(Ok(self.hold(gate, turn, this)));
        }
        if gate.held_by(this).is_some() {
            return Poll::Ready(Err(Error::WouldDeadlock));
        }
        if !gate.tasks.iter().any(|task| task.will_wake(cx.waker())) {
            gate.tasks.push(cx.waker().clone());
        }
        Poll::Pending
    }

    fn hold(&self, mut gate: MutexGuard<'_, Gate<W>>, turn: Turn, thread: ThreadId) -> Held<'_, T, W> {
        gate.holders.iter_mut().filter(|holder| holder.turn == turn).for_each(|holder| holder.thread = Some(thread));
        drop(gate);
        HOLDING.with(|holding| holding.set(holding.get() + 1));
        Held { gate: self, turn }
    }

    /// Something has changed: threads and tasks that wait look again.
    fn notify(&self, mut gate: MutexGuard<'_, Gate<W>>) {
        self.count_ready(&gate);
        let tasks = std::mem::take(&mut gate.tasks);
        drop(gate);
        self.changed.notify_all();
        tasks.into_iter().for_each(Waker::wake);
    }

    /// Leaves a call here until its turn comes; whether that is now, so that it is to be asked for at once.
    pub(crate) fn park(&self, turn: Turn, work: W) -> bool {
        let mut gate = lock(&self.gate);
        if gate.has_turn(turn) {
            gate.ready.push_back((work, Ok(turn)));
        } else if let Some(error) = gate.refusal(turn) {
            gate.leave(turn);
            gate.ready.push_back((work, Err(error)));
        } else {
            if let Some(waiting) = gate.queue.iter_mut().find(|waiting| waiting.turn == turn) {
                waiting.parked = Some(work);
            }
            return false;
        }
        self.notify(gate);
        true
    }

    /// A call that was parked, with its turn, or with why it gets none.
    pub(crate) fn take_ready(&self) -> Option<(W, Result<Turn, Error>)> {
        let mut gate = lock(&self.gate);
        let ready = gate.ready.pop_front();
        self.count_ready(&gate);
        ready
    }

    /// Whether a call that was parked is to go on. Asked by a thread that gives up the state, or a turn, or begins to wait.
    pub(crate) fn has_ready(&self) -> bool {
        self.ready.load(Ordering::Acquire) > 0
    }

    fn count_ready(&self, gate: &Gate<W>) {
        self.ready.store(gate.ready.len(), Ordering::Release);
    }

    /// A call that has begun is not run after all.
    pub(crate) fn give_up(&self, turn: Turn) {
        let mut gate = lock(&self.gate);
        gate.leave(turn);
        self.notify(gate);
    }

    /// Lets no more calls of peers in; those that wait return.
    pub(crate) fn stop(&self) {
        let mut gate = lock(&self.gate);
        gate.stopped = true;
        gate.refuse_parked();
        self.notify(gate);
    }

    /// Notes, around a blocking request of a method, whom it waits for.
    pub(crate) fn waiting_for<R>(&self, peer: LinkId, wait: impl FnOnce() -> R) -> R {
        if HOLDING.with(Cell::get) == 0 {
            return wait();
        }
        // However the wait ends: a mark that stays would refuse that peer's later calls.
        struct Marked<'g, T: 'static, W>(&'g StateGate<T, W>, Option<Mark>);
        impl<T: 'static, W> Drop for Marked<'_, T, W> {
            fn drop(&mut self) {
                self.1.take().into_iter().for_each(|mark| self.0.unmark(mark));
            }
        }
        let _marked = Marked(self, self.mark(peer));
        wait()
    }

    /// Notes that this thread waits for a peer, if it holds the state: for a call that is polled, which may end elsewhere.
    pub(crate) fn mark(&self, peer: LinkId) -> Option<Mark> {
        if HOLDING.with(Cell::get) == 0 {
            return None;
        }
        let mut gate = lock(&self.gate);
        let holder = gate.held_by(std::thread::current().id())?;
        holder.waits_for.push(peer);
        let turn = holder.turn;
        gate.refuse_parked();
        self.notify(gate);
        Some(Mark { peer, turn })
    }

    /// That wait is over.
    pub(crate) fn unmark(&self, Mark { peer, turn }: Mark) {
        let mut gate = lock(&self.gate);
        let Some(holder) = gate.holders.iter_mut().find(|holder| holder.turn == turn) else { return };
        if let Some(index) = holder.waits_for.iter().position(|waited_for| *waited_for == peer) {
            holder.waits_for.swap_remove(index);
        }
    }
}

impl<W> Gate<W> {
    /// It is its turn, and it has yet to come.
    fn has_turn(&self, turn: Turn) -> bool {
        self.holders.iter().any(|holder| holder.turn == turn && holder.thread.is_none())
    }

    fn held_by(&mut self, thread: ThreadId) -> Option<&mut Holder> {
        self.holders.iter_mut().find(|holder| holder.thread == Some(thread))
    }

    /// Why a turn that waits never comes, or comes too late for its caller.
    fn refusal(&self, turn: Turn) -> Option<Error> {
        match turn.caller {
            None => None,
            Some(_) if self.stopped => Some(Error::NotRunning),
            Some(caller) => {
                let is_waited_for = self.holders.iter().any(|holder| holder.waits_for.contains(&caller));
                is_waited_for.then_some(Error::WouldDeadlock)
            }
        }
    }

    /// Gives those the state that are next.
    fn admit(&mut self) {
        while let Some(next) = self.queue.front() {
            // Nothing overtakes what waits: a reader behind one that changes the state is not next.
            let joins = next.turn.access == Access::Read
                && self.holders.iter().all(|holder| holder.turn.access == Access::Read);
            if !self.holders.is_empty() && !joins {
                return;
            }
            let Some(Waiting { turn, parked }) = self.queue.pop_front() else { return };
            self.holders.push(Holder { turn, thread: None, waits_for: Vec::new() });
            self.ready.extend(parked.map(|work| (work, Ok(turn))));
        }
    }

    /// A turn is over, or will not be used.
    fn leave(&mut self, turn: Turn) {
        self.holders.retain(|holder| holder.turn != turn);
        self.queue.retain(|waiting| waiting.turn != turn);
        self.admit();
    }

    fn refuse_parked(&mut self) {
        let mut index = 0;
        while let Some(waiting) = self.queue.get(index) {
            let error = waiting.parked.as_ref().and_then(|_| self.refusal(waiting.turn));
            let Some(error) = error else {
                index += 1;
                continue;
            };
            let refused = self.queue.remove(index).and_then(|waiting| waiting.parked);
            self.ready.extend(refused.map(|work| (work, Err(error))));
        }
        self.admit();
    }
}

impl<T: 'static, W> Held<'_, T, W> {
    /// For a turn to change it; `None` never.
    pub(crate) fn change<R>(&self, act: impl FnOnce(&mut T) -> R) -> Option<R> {
        self.gate.state.change(act)
    }

    /// For a turn to read it.
    pub(crate) const fn state(&self) -> &State<T> {
        &self.gate.state
    }
}

impl<T: 'static, W> Drop for Held<'_, T, W> {
    fn drop(&mut self) {
        let mut gate = lock(&self.gate.gate);
        gate.leave(self.turn);
        HOLDING.with(|holding| holding.set(holding.get().saturating_sub(1)));
        self.gate.notify(gate);
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

    fn entered<'g>(entered: Entered<'g, u32, &'static str>) -> Result<Held<'g, u32, &'static str>, Error> {
        match entered {
            Entered::Held(held) => Ok(held),
            Entered::NotYet => panic!("it is not its turn"),
            Entered::Refused(error) => Err(error),
        }
    }

    /// A call of `caller`, which waits for its turn as long as that takes.
    fn call<'g>(
        gate: &'g StateGate<u32, &'static str>,
        caller: Option<LinkId>,
    ) -> Result<Held<'g, u32, &'static str>, Error> {
        wait_for(gate, gate.take_turn(caller, Access::Change))
    }

    fn call_to_read<'g>(
        gate: &'g StateGate<u32, &'static str>,
        caller: Option<LinkId>,
    ) -> Result<Held<'g, u32, &'static str>, Error> {
        wait_for(gate, gate.take_turn(caller, Access::Read))
    }

    fn wait_for<'g>(gate: &'g StateGate<u32, &'static str>, turn: Turn) -> Result<Held<'g, u32, &'static str>, Error> {
        loop {
            match gate.enter_by(turn) {
                Entered::NotYet => {}
                other => return entered(other),
            }
        }
    }

    fn assert_refused(gate: &StateGate<u32, &'static str>, caller: Option<LinkId>, error: Error) {
        assert_eq!(call(gate, caller).map(drop).unwrap_err(), error);
    }

    /// Runs `act` on another thread while this one holds the state and waits for the peer of `HERE`.
    fn while_waiting(gate: &StateGate<u32, &'static str>, act: impl FnOnce() + Send) {
        let held = gate.enter().unwrap();
        gate.waiting_for(LinkId(1), || std::thread::scope(|scope| scope.spawn(act).join().unwrap()));
        drop(held);
    }

    #[test]
    fn one_at_a_time_holds_the_state() {
        let gate = Arc::new(StateGate::new(0_u32));
        let threads: Vec<_> = (0..4)
            .map(|_| {
                let gate = gate.clone();
                std::thread::spawn(move || {
                    (0..500).for_each(|_| call(&gate, HERE).unwrap().change(|state| *state += 1).unwrap())
                })
            })
            .collect();
        threads.into_iter().for_each(|thread| thread.join().unwrap());
        assert_eq!(gate.enter().unwrap().change(|state| *state), Some(2_000));
    }

    #[test]
    fn readers_are_let_in_together_and_overtake_nobody() {
        let gate = StateGate::new(0);
        let [first, second] = [HERE, ELSEWHERE].map(|caller| gate.take_turn(caller, Access::Read));
        let [changes, third] = [Access::Change, Access::Read].map(|access| gate.take_turn(HERE, access));
        let reading = [first, second].map(|turn| entered(gate.enter_by(turn)).unwrap());
        assert!(!gate.park(changes, "changes"));
        assert!(!gate.park(third, "third"), "one that changes the state waits before it");
        let [first, second] = reading;
        drop(second);
        assert!(!gate.has_ready(), "one still reads");
        drop(first);
        assert_eq!(gate.take_ready(), Some(("changes", Ok(changes))));
        assert!(!gate.has_ready(), "no reader beside it");
        drop(entered(gate.enter_by(changes)).unwrap());
        assert_eq!(gate.take_ready(), Some(("third", Ok(third))));
        drop(entered(gate.enter_by(third)).unwrap());
        assert!(gate.enter().is_ok());
    }

    /// Each reader comes before the last one goes, so that the state is never free.
    #[test]
    fn readers_without_end_keep_no_change_from_its_turn() {
        let gate = StateGate::new(0);
        let mut reading = call_to_read(&gate, HERE).unwrap();
        let changes = gate.take_turn(ELSEWHERE, Access::Change);
        let mut later = Vec::new();
        for _ in 0..100 {
            let turn = gate.take_turn(HERE, Access::Read);
            let is_next = lock(&gate.gate).has_turn(turn);
            match is_next {
                true => reading = entered(gate.enter_by(turn)).unwrap(),
                false => later.push(turn),
            }
        }
        assert_eq!(later.len(), 100, "all of them came later");
        drop(reading);
        drop(entered(gate.enter_by(changes)).unwrap());
        let _all: Vec<_> = later.into_iter().map(|turn| entered(gate.enter_by(turn)).unwrap()).collect();
    }

    #[test]
    fn who_gives_up_a_change_lets_those_behind_it_read() {
        let gate = StateGate::new(0);
        let reading = call_to_read(&gate, HERE).unwrap();
        let changes = gate.take_turn(HERE, Access::Change);
        let behind = gate.take_turn(HERE, Access::Read);
        assert!(!gate.park(behind, "behind"));
        gate.give_up(changes);
        assert_eq!(gate.take_ready(), Some(("behind", Ok(behind))));
        drop(entered(gate.enter_by(behind)).unwrap());
        drop(reading);
        assert!(gate.enter().is_ok());
    }

    /// Two read, and both wait for the same peer, which calls back.
    #[test]
    fn a_peer_that_a_reader_waits_for_may_read_and_not_change() {
        let gate = StateGate::new(0);
        let one = call_to_read(&gate, ELSEWHERE).unwrap();
        std::thread::scope(|scope| {
            let other = scope.spawn(|| {
                let _held = call_to_read(&gate, ELSEWHERE).unwrap();
                gate.waiting_for(LinkId(1), || {});
            });
            gate.waiting_for(LinkId(1), || {
                other.join().unwrap();
                std::thread::scope(|scope| {
                    scope.spawn(|| {
                        assert!(call_to_read(&gate, HERE).is_ok());
                        assert_refused(&gate, HERE, Error::WouldDeadlock);
                        assert!(call_to_read(&gate, HERE).is_ok(), "what was refused keeps nobody waiting");
                    });
                });
            });
        });
        assert_refused(&gate, None, Error::WouldDeadlock);
        drop(one);
        assert!(call(&gate, HERE).is_ok());
    }

    #[test]
    fn who_is_waited_for_is_told_at_once() {
        let gate = StateGate::new(0);
        while_waiting(&gate, || assert_refused(&gate, HERE, Error::WouldDeadlock));
        assert!(call(&gate, HERE).is_ok(), "nobody holds it any more");
    }

    /// The peer's call came first and waits; then the holder begins to wait for that peer.
    #[test]
    fn who_waits_already_is_told_when_the_holder_begins_to_wait() {
        let gate = StateGate::new(0);
        let held = gate.enter().unwrap();
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
        let held = gate.enter().unwrap();
        let other = {
            let gate = gate.clone();
            std::thread::spawn(move || sender.send(call(&gate, ELSEWHERE).unwrap().change(|state| *state)).unwrap())
        };
        gate.waiting_for(LinkId(1), || assert!(receiver.recv_timeout(Duration::from_millis(20)).is_err()));
        drop(held);
        assert_eq!(receiver.recv_timeout(Duration::from_secs(30)), Ok(Some(1)));
        other.join().unwrap();
    }

    #[test]
    fn a_thread_does_not_wait_for_itself() {
        let gate = StateGate::new(0);
        let _held = call(&gate, HERE).unwrap();
        assert_refused(&gate, None, Error::WouldDeadlock);
    }

    /// A thread that holds one unit's state and asks on behalf of another unit changes nothing there.
    #[test]
    fn only_the_holder_can_wait_for_a_peer() {
        let (mine, other): (StateGate<u32, &'static str>, Arc<StateGate<u32, &'static str>>) =
            (StateGate::new(0), Arc::new(StateGate::new(0)));
        let barrier = Arc::new(Barrier::new(2));
        let holder = {
            let (other, barrier) = (other.clone(), barrier.clone());
            std::thread::spawn(move || {
                let _held = other.enter().unwrap();
                barrier.wait();
                barrier.wait();
            })
        };
        barrier.wait();
        let _held = mine.enter().unwrap();
        other.waiting_for(LinkId(1), || assert_eq!(lock(&other.gate).holders[0].waits_for, []));
        barrier.wait();
        holder.join().unwrap();
    }

    /// Calls of three peers begin while the application has the state: two are parked, one thread waits.
    #[test]
    fn the_state_is_taken_in_the_order_in_which_calls_began() {
        let gate = StateGate::new(0);
        let held = gate.take_turn(None, Access::Change);
        let [first, second, third] = [HERE, ELSEWHERE, HERE].map(|caller| gate.take_turn(caller, Access::Change));
        assert!(matches!(gate.enter_by(third), Entered::NotYet) && !gate.park(third, "third"));
        assert!(matches!(gate.enter_by(first), Entered::NotYet) && !gate.park(first, "first"));
        assert!(!gate.has_ready());
        gate.give_up(held);
        assert_eq!(gate.take_ready(), Some(("first", Ok(first))), "it came first, and was parked later");
        assert!(matches!(gate.enter_by(second), Entered::NotYet), "the first one has its turn");
        drop(entered(gate.enter_by(first)).unwrap());
        assert!(!gate.has_ready(), "the second is not parked, and has its turn");
        drop(entered(gate.enter_by(second)).unwrap());
        assert_eq!(gate.take_ready(), Some(("third", Ok(third))));
        drop(entered(gate.enter_by(third)).unwrap());
        assert!(gate.enter().is_ok());
    }

    #[test]
    fn a_turn_that_comes_while_its_call_is_being_parked_is_not_lost() {
        let gate = StateGate::new(0);
        let held = gate.take_turn(None, Access::Change);
        let turn = gate.take_turn(HERE, Access::Change);
        assert!(matches!(gate.enter_by(turn), Entered::NotYet));
        gate.give_up(held);
        assert!(gate.park(turn, "late"));
        assert_eq!(gate.take_ready(), Some(("late", Ok(turn))));
    }

    #[test]
    fn a_turn_that_is_given_up_passes_to_the_next_one() {
        let gate = StateGate::new(0);
        let [first, second, third] = [HERE; 3].map(|caller| gate.take_turn(caller, Access::Change));
        gate.give_up(second);
        gate.give_up(first);
        drop(entered(gate.enter_by(third)).unwrap());
        assert!(gate.enter().is_ok());
    }

    /// Two are parked when the holder begins to wait for the peer of one of them.
    #[test]
    fn what_is_parked_is_refused_when_the_holder_begins_to_wait_for_its_caller() {
        let gate = StateGate::new(0);
        let held = gate.enter().unwrap();
        let [here, there] = [(HERE, "here"), (ELSEWHERE, "there")].map(|(caller, name)| {
            let turn = gate.take_turn(caller, Access::Change);
            assert!(!gate.park(turn, name));
            turn
        });
        gate.waiting_for(LinkId(1), || {
            assert_eq!(gate.take_ready(), Some(("here", Err(Error::WouldDeadlock))));
            assert!(!gate.has_ready());
        });
        gate.stop();
        assert_eq!(gate.take_ready(), Some(("there", Err(Error::NotRunning))));
        drop(held);
        assert!(gate.enter().is_ok(), "{here:?} and {there:?} have no turns any more");
    }

    /// A mark that stayed would refuse the calls of a peer that no caller waits for any more.
    #[test]
    fn the_mark_of_whom_the_holder_waits_for_goes_with_the_wait() {
        let gate = StateGate::new(0);
        let held = gate.enter().unwrap();
        gate.waiting_for(LinkId(1), || {});
        let turn = gate.take_turn(HERE, Access::Change);
        assert!(!gate.park(turn, "here") && !gate.has_ready(), "it waits for its turn, and is not refused");
        let panicked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            gate.waiting_for(LinkId(1), || panic!("a request"));
        }));
        assert!(panicked.is_err());
        assert_eq!(gate.take_ready(), Some(("here", Err(Error::WouldDeadlock))), "while that one waited");
        let turn = gate.take_turn(HERE, Access::Change);
        assert!(!gate.park(turn, "here") && !gate.has_ready(), "and none after it");
        drop(held);
        assert_eq!(gate.take_ready(), Some(("here", Ok(turn))));
    }

    #[test]
    fn a_stopped_unit_lets_no_peer_in() {
        let gate = StateGate::new(0);
        let began = Instant::now();
        let held = gate.enter().unwrap();
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| assert_refused(&gate, HERE, Error::NotRunning));
            gate.stop();
            waiting.join().unwrap();
        });
        drop(held);
        assert_refused(&gate, HERE, Error::NotRunning);
        assert!(gate.enter().is_ok(), "the application still reads its state");
        assert!(began.elapsed() < Duration::from_secs(60));
    }

    #[test]
    fn a_panic_opens_the_gate() {
        let gate = StateGate::new(0);
        let panicked = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            let _held = call(&gate, HERE).unwrap();
            panic!("a handler");
        }));
        assert!(panicked.is_err() && call(&gate, HERE).is_ok());
    }
}
