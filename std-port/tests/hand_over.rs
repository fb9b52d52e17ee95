//! The hand-over of a link's token, in every order in which threads can run it.
//!
//! `ReadPolicy` and `Watch` are the port's own: what decides which thread reads, what the epoll set is told, and which
//! links the clock looks at, is what runs here. Around them stand the few steps of `calling.rs`, `workers.rs`,
//! `staying.rs`, `reading.rs` and `threads.rs` that carry the decisions out, with a queue in the place of the socket and no
//! time-outs: a wake-up that is lost blocks for ever, and the model reports that. With `tests/variants/lost-wake-up.patch`
//! it must fail.
//!
//! ```text
//! cargo test -p cara-std --test hand_over
//! ```

#[allow(dead_code, reason = "the file is included for the type it defines; not every function is modelled")]
#[path = "../src/engine/reader.rs"]
mod reader;
#[allow(dead_code, reason = "as above")]
#[path = "../src/engine/watch.rs"]
mod watch;

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};

use cara_core::services::requests::CallId;
use cara_core::time::{Duration, Instant};
use loom::sync::atomic::{self, AtomicUsize};
use loom::sync::{Arc, Condvar, Mutex, MutexGuard};
use loom::thread;
use reader::{Cause, Duties, ReadPolicy, Reader, Registration, Token};
use watch::Watch;

/// What the stream brings: the reply to a call of this unit, or a call of the peer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Item {
    Reply(u32),
    Call,
}

/// The socket and the epoll set.
#[derive(Default)]
struct Wire {
    items: VecDeque<Item>,
    /// The epoll set reports the stream.
    armed: bool,
    /// Requests that the peer has, in the order in which they came.
    asked: VecDeque<u32>,
    /// The replies come in the order of the requests, and not the last one first.
    in_order: bool,
    closed: bool,
}

/// `park` and `unpark` of one thread. Those of loom also wake a thread that waits for a mutex, which then fails.
#[derive(Default)]
struct Parker {
    token: Mutex<bool>,
    given: Condvar,
}

impl Parker {
    fn park(&self) {
        let mut token = self.token.lock().unwrap();
        while !*token {
            token = self.given.wait(token).unwrap();
        }
        *token = false;
    }

    fn unpark(&self) {
        *self.token.lock().unwrap() = true;
        self.given.notify_one();
    }
}

struct Waiter {
    id: u32,
    /// `None` is a future, which does not read.
    thread: Option<Arc<Parker>>,
    done: bool,
}

struct State {
    reading: ReadPolicy,
    registration: Registration,
    waiters: Vec<Waiter>,
    /// Callers that were told to take the token and have not looked yet.
    reported: Vec<u32>,
    stopped: bool,
    /// The clock is to look.
    clock_reported: bool,
    /// Calls of the peer that the pool has read.
    called: u32,
}

struct Link {
    wire: Mutex<Wire>,
    /// Bytes have come, or the epoll set was armed.
    readable: Condvar,
    state: Mutex<State>,
    watch: Watch,
    /// A future has its reply, the clock is told, or is to stop.
    changed: Condvar,
    /// The peer answers when it has this many requests, the last one first; 0: each at once.
    together: usize,
    /// Callers expect to be back at once, and the clock looks after what they keep.
    keeps: bool,
    /// A thread reads; not part of the model, it adds no orders.
    reading: AtomicBool,
}

/// When all happens but the clock's looks.
const NOW: Instant = Instant::START;
/// What is kept, and each handler, has lasted too long by then.
const LATER: Instant = Instant::from_micros(10_000);
/// The only link.
const LINK: u64 = 1;

impl Link {
    fn new(together: usize) -> Arc<Self> {
        Self::build(together, false, ReadPolicy::new(false))
    }

    /// A link whose callers call back to back, and have done so.
    fn kept_by_callers() -> Arc<Self> {
        let mut reading = ReadPolicy::new(false);
        let token = reading.on(NOW, Cause::Wants).token.unwrap();
        reading.on(NOW, Cause::Replied { token, asked: NOW, may_keep: true, waiter: None });
        Self::build(0, true, reading)
    }

    /// A link that has been served by a quick handler, and has a call to be read.
    fn served() -> Arc<Self> {
        let mut reading = ReadPolicy::new(false);
        reading.ran(Duration::ZERO);
        reading.on(NOW, Cause::Stays { served: 0, may: true });
        let link = Self::build(0, false, reading);
        link.wire.lock().unwrap().items.push_back(Item::Call);
        link
    }

    fn build(together: usize, keeps: bool, reading: ReadPolicy) -> Arc<Self> {
        let (waiters, reported) = (vec![], vec![]);
        let registration = Registration { readable: true, writable: false, is_out: false };
        let state =
            State { reading, registration, waiters, reported, stopped: false, clock_reported: false, called: 0 };
        let wire = Wire { armed: true, ..Wire::default() };
        Arc::new(Self {
            wire: Mutex::new(wire),
            readable: Condvar::new(),
            state: Mutex::new(state),
            watch: Watch::new(),
            changed: Condvar::new(),
            together,
            keeps,
            reading: AtomicBool::new(false),
        })
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap()
    }

    /// `Engine::read_by`.
    fn read_by(&self, state: &mut State, cause: Cause) -> Option<Token> {
        let duties = state.reading.on(NOW, cause);
        wake(state, duties);
        if duties.enlist {
            self.watch.enlist(LINK);
            if self.watch.begins() {
                state.clock_reported = true;
                self.changed.notify_all();
            }
        }
        duties.token
    }

    /// `Engine::settle`: the epoll set follows which thread reads. There is always one, or it was told to.
    fn settle(&self, mut state: MutexGuard<'_, State>) {
        self.set_interest(&mut state);
    }

    fn set_interest(&self, state: &mut State) {
        state.registration = state.reading.registration(state.registration, false, false);
        let armed = state.registration.readable;
        let is_read = match state.reading.reader() {
            Reader::Led { .. } | Reader::Serving { .. } => true,
            Reader::Kept { .. } => self.keeps,
            Reader::Offered => !state.reported.is_empty(),
            Reader::Opening | Reader::Pool => armed,
        };
        assert!(is_read, "no thread reads");
        let mut wire = self.wire.lock().unwrap();
        if wire.armed != armed {
            wire.armed = armed;
            self.readable.notify_all();
        }
    }

    fn begin(&self) {
        assert!(!self.reading.swap(true, Ordering::Relaxed), "two threads read one stream");
    }

    fn end(&self) {
        self.reading.store(false, Ordering::Relaxed);
    }

    /// A blocking read: one item a time. Ends the reading under the link's lock, as bytes are looked at there.
    fn receive(&self) -> (Option<Item>, MutexGuard<'_, State>) {
        self.begin();
        let mut wire = self.wire.lock().unwrap();
        while wire.items.is_empty() && !wire.closed {
            wire = self.readable.wait(wire).unwrap();
        }
        let item = wire.items.pop_front();
        drop(wire);
        let state = self.lock();
        self.end();
        (item, state)
    }

    /// The request goes out, and the peer answers.
    fn send(&self, id: u32) {
        let mut wire = self.wire.lock().unwrap();
        wire.asked.push_back(id);
        if wire.asked.len() >= self.together {
            while let Some(id) = if wire.in_order { wire.asked.pop_front() } else { wire.asked.pop_back() } {
                wire.items.push_back(Item::Reply(id));
            }
            self.readable.notify_all();
        }
    }

    /// `Engine::feed`: notes a reply and wakes what waits for it.
    fn feed(&self, state: &mut State, item: Item) {
        let Item::Reply(id) = item else {
            state.called += 1;
            self.changed.notify_all();
            return;
        };
        if let Some(waiter) = state.waiters.iter_mut().find(|waiter| waiter.id == id) {
            waiter.done = true;
            match &waiter.thread {
                Some(thread) => thread.unpark(),
                None => self.changed.notify_all(),
            }
        }
    }

    fn take_outcome(&self, state: &mut State, id: u32) -> bool {
        let before = state.waiters.len();
        state.waiters.retain(|waiter| waiter.id != id || !waiter.done);
        state.waiters.len() < before
    }

    /// `Engine::leave`.
    fn leave(&self, mut state: MutexGuard<'_, State>, token: Option<Token>) {
        let waiter = next_reader(&state);
        self.read_by(&mut state, Cause::Leaves { token, waiter });
        self.settle(state);
    }

    /// `Engine::leave_with_reply`.
    fn leave_with_reply(&self, mut state: MutexGuard<'_, State>, token: Token) {
        let may_keep = self.keeps && !state.waiters.iter().any(|waiter| waiter.thread.is_none());
        let waiter = next_reader(&state);
        self.read_by(&mut state, Cause::Replied { token, asked: NOW, may_keep, waiter });
        self.settle(state);
    }

    /// `Engine::block_request`. A caller without `patience` gives up when it has looked twice.
    fn call(&self, id: u32, patience: bool) -> bool {
        let parker = Arc::new(Parker::default());
        let mut state = self.lock();
        let mut token = if patience { self.read_by(&mut state, Cause::Wants) } else { None };
        self.set_interest(&mut state);
        state.waiters.push(Waiter { id, thread: Some(parker.clone()), done: false });
        self.send(id);
        let mut looks = 0;
        loop {
            state.reported.retain(|reported| *reported != id);
            if self.take_outcome(&mut state, id) {
                match token {
                    Some(token) => self.leave_with_reply(state, token),
                    None => self.leave(state, None),
                }
                return true;
            }
            if !patience && looks == 1 {
                state.waiters.retain(|waiter| waiter.id != id);
                self.leave(state, token);
                return false;
            }
            looks += 1;
            token = token.or_else(|| self.read_by(&mut state, Cause::Wants));
            if token.is_some() && patience {
                state = self.read_for_reply(state, id);
            } else {
                self.settle(state);
                if patience {
                    parker.park();
                } else {
                    thread::yield_now();
                }
                state = self.lock();
            }
        }
    }

    /// `Engine::read_for_reply`.
    fn read_for_reply<'l>(&'l self, mut state: MutexGuard<'l, State>, id: u32) -> MutexGuard<'l, State> {
        loop {
            self.settle(state);
            let (item, locked) = self.receive();
            state = locked;
            item.into_iter().for_each(|item| self.feed(&mut state, item));
            if state.waiters.iter().any(|waiter| waiter.id == id && waiter.done) {
                return state;
            }
        }
    }

    /// `Engine::call_future`, awaited.
    fn call_future(&self, id: u32) {
        let mut state = self.lock();
        self.read_by(&mut state, Cause::NeedsPool);
        state.waiters.push(Waiter { id, thread: None, done: false });
        self.send(id);
        self.settle(state);
        let mut state = self.lock();
        while !self.take_outcome(&mut state, id) {
            state = self.changed.wait(state).unwrap();
        }
        self.settle(state);
    }

    /// `Engine::work`: waits in the epoll set and drains what is ready, unless another thread has the token.
    fn pool(&self) {
        loop {
            let mut wire = self.wire.lock().unwrap();
            while !wire.closed && !(wire.armed && !wire.items.is_empty()) {
                wire = self.readable.wait(wire).unwrap();
            }
            if wire.closed {
                return;
            }
            drop(wire);
            let mut state = self.lock();
            if state.reading.is_free() {
                self.begin();
                let items: Vec<Item> = self.wire.lock().unwrap().items.drain(..).collect();
                self.end();
                items.into_iter().for_each(|item| self.feed(&mut state, item));
            }
            self.settle(state);
        }
    }

    /// `Engine::stay`: a thread of the pool reads one call; its handler calls the peer back, or is quick.
    fn stay(&self, calls_back: Option<u32>) {
        let mut state = self.lock();
        let may = state.waiters.is_empty();
        let Some(token) = self.read_by(&mut state, Cause::Stays { served: 1, may }) else { return };
        self.settle(state);
        loop {
            let (item, mut state) = self.receive();
            item.into_iter().for_each(|item| self.feed(&mut state, item));
            let alone = state.waiters.is_empty();
            if item != Some(Item::Call) {
                self.settle(state);
                match item {
                    Some(_) if alone => continue,
                    _ => break,
                }
            }
            self.read_by(&mut state, Cause::Begins(token));
            self.settle(state);
            if let Some(id) = calls_back {
                assert!(self.call(id, true));
            }
            let mut state = self.lock();
            self.read_by(&mut state, Cause::Ends(token));
            let continues = state.reading.is_held(token);
            self.settle(state);
            if !continues || calls_back.is_some() {
                break;
            }
        }
        self.leave(self.lock(), Some(token));
    }

    /// `Links::look`: the clock looks when it is told to, and until it finds nothing on its list.
    fn clock(&self) {
        let mut state = self.lock();
        loop {
            while !state.clock_reported && !state.stopped {
                state = self.changed.wait(state).unwrap();
            }
            if state.stopped {
                return;
            }
            state.clock_reported = false;
            drop(state);
            while self.watch.look(|_| self.look_at_link()) {}
            state = self.lock();
        }
    }

    /// `Engine::look_at_link`.
    fn look_at_link(&self) -> bool {
        let mut state = self.lock();
        let waiter = next_reader(&state);
        let duties = state.reading.on(LATER, Cause::Looks { waiter });
        wake(&mut state, duties);
        self.settle(state);
        duties.look_at.is_some()
    }

    /// Waits until the pool, or a holder of the token, has read a call of the peer.
    fn await_call(&self) {
        let mut state = self.lock();
        while state.called == 0 {
            state = self.changed.wait(state).unwrap();
        }
    }

    fn close(&self) {
        self.wire.lock().unwrap().closed = true;
        self.readable.notify_all();
        self.lock().stopped = true;
        self.changed.notify_all();
    }
}

/// `LinkState::next_reader`.
fn next_reader(state: &State) -> Option<CallId> {
    state.waiters.iter().find(|waiter| waiter.thread.is_some() && !waiter.done).map(|waiter| CallId(waiter.id))
}

fn wake(state: &mut State, duties: Duties) {
    let Some(CallId(id)) = duties.wake else { return };
    state.reported.push(id);
    state
        .waiters
        .iter()
        .filter(|waiter| waiter.id == id)
        .filter_map(|waiter| waiter.thread.as_ref())
        .for_each(|thread| thread.unpark());
}

fn check(preemptions: usize, model: impl Fn() + Sync + Send + 'static) {
    let mut builder = loom::model::Builder::new();
    builder.preemption_bound = Some(preemptions);
    builder.check(model);
}

fn spawn(link: &Arc<Link>, act: impl FnOnce(&Link) + 'static) -> thread::JoinHandle<()> {
    let link = link.clone();
    thread::spawn(move || act(&link))
}

/// Two callers, whose replies come the other way round, and a thread of the pool.
#[test]
fn two_callers_get_their_replies_whichever_thread_reads_them() {
    check(3, || {
        let link = Link::new(2);
        let pool = spawn(&link, Link::pool);
        let other = spawn(&link, |link| assert!(link.call(2, true)));
        assert!(link.call(1, true));
        other.join().unwrap();
        link.close();
        pool.join().unwrap();
    });
}

#[test]
fn the_token_goes_on_from_caller_to_caller() {
    check(2, || {
        let link = Link::new(3);
        let others = [2, 3].map(|id| spawn(&link, move |link| assert!(link.call(id, true))));
        assert!(link.call(1, true));
        others.into_iter().for_each(|other| other.join().unwrap());
    });
}

/// When the last caller has left, the pool reads what no thread has the token for.
#[test]
fn a_future_gets_its_reply_from_a_caller_or_from_the_pool() {
    check(3, || {
        let link = Link::new(0);
        let pool = spawn(&link, Link::pool);
        let caller = spawn(&link, |link| assert!(link.call(2, true)));
        link.call_future(1);
        caller.join().unwrap();
        link.close();
        pool.join().unwrap();
    });
}

/// The token may be offered to a caller just when it gives up: it must not be lost with it.
#[test]
fn a_caller_that_gives_up_passes_the_token_on() {
    check(2, || {
        let link = Link::new(3);
        link.wire.lock().unwrap().in_order = true;
        let hasty = spawn(&link, |link| {
            link.call(2, false);
        });
        let other = spawn(&link, |link| assert!(link.call(3, true)));
        assert!(link.call(1, true));
        hasty.join().unwrap();
        other.join().unwrap();
    });
}

#[test]
fn what_is_left_when_a_caller_gives_up_is_read_by_the_pool() {
    check(3, || {
        let link = Link::new(2);
        let pool = spawn(&link, Link::pool);
        let hasty = spawn(&link, |link| {
            link.call(2, false);
        });
        link.call_future(1);
        hasty.join().unwrap();
        link.close();
        pool.join().unwrap();
    });
}

/// A thread of the pool that was told of the link comes to read it when a caller does so already.
#[test]
fn the_pool_keeps_off_a_link_that_a_caller_reads() {
    check(2, || {
        let link = Link::new(0);
        let pool = spawn(&link, Link::pool);
        let peer = spawn(&link, |link| {
            link.wire.lock().unwrap().items.push_back(Item::Call);
            link.readable.notify_all();
        });
        assert!(link.call(1, true));
        peer.join().unwrap();
        link.close();
        pool.join().unwrap();
    });
}

/// A caller keeps the link from call to call; what the peer sends when no further call comes is read by the pool.
#[test]
fn a_link_that_is_kept_comes_back_to_the_pool() {
    check(3, || {
        let link = Link::kept_by_callers();
        let pool = spawn(&link, Link::pool);
        let clock = spawn(&link, Link::clock);
        assert!(link.call(1, true));
        assert!(link.call(2, true));
        link.wire.lock().unwrap().items.push_back(Item::Call);
        link.readable.notify_all();
        link.await_call();
        link.close();
        pool.join().unwrap();
        clock.join().unwrap();
    });
}

/// Two callers that each would keep the link: the other one is offered the token, or takes it.
#[test]
fn a_link_that_is_kept_is_led_by_the_caller_that_comes() {
    check(2, || {
        let link = Link::kept_by_callers();
        let clock = spawn(&link, Link::clock);
        let other = spawn(&link, |link| assert!(link.call(2, true)));
        assert!(link.call(1, true));
        other.join().unwrap();
        link.close();
        clock.join().unwrap();
    });
}

/// A future needs a thread that reads: the link is not kept while one waits, or goes to the pool when it comes.
#[test]
fn a_future_on_a_link_that_was_kept_gets_its_reply() {
    check(3, || {
        let link = Link::kept_by_callers();
        let pool = spawn(&link, Link::pool);
        assert!(link.call(1, true));
        link.call_future(2);
        link.close();
        pool.join().unwrap();
    });
}

/// A thread that stays runs a handler, which calls back over the same link: the clock takes the token from it.
#[test]
fn a_handler_of_a_thread_that_stays_can_call_back() {
    check(3, || {
        let link = Link::served();
        let clock = spawn(&link, Link::clock);
        let staying = spawn(&link, |link| link.stay(Some(7)));
        staying.join().unwrap();
        link.close();
        clock.join().unwrap();
    });
}

/// A caller comes while a thread stays; it gets its reply from that thread, or takes the token when it leaves.
#[test]
fn a_caller_and_a_thread_that_stays_share_a_link() {
    check(2, || {
        let link = Link::served();
        let clock = spawn(&link, Link::clock);
        let staying = spawn(&link, |link| link.stay(None));
        let caller = spawn(&link, |link| assert!(link.call(1, true)));
        caller.join().unwrap();
        link.close();
        staying.join().unwrap();
        clock.join().unwrap();
    });
}

/// What happens while the clock looks is seen by it, or tells it to look again.
#[test]
fn nothing_happens_behind_the_back_of_the_clock() {
    loom::model(|| {
        let watch = Arc::new(Watch::new());
        assert!(watch.begins(), "no thread has told the clock yet");
        let other = watch.clone();
        let happens = thread::spawn(move || other.begins());
        while watch.look(|_| false) {}
        let is_reported = happens.join().unwrap();
        assert!(is_reported || !watch.look(|_| false), "the clock sleeps, and has not seen it");
    });
}

/// The pool, without links: threads that run handlers though no other thread waits, and the clock that stands in for them.
struct Pool {
    calls: Mutex<VecDeque<Handler>>,
    idle: AtomicUsize,
    watch: Watch,
    flags: Mutex<Flags>,
    changed: Condvar,
}

#[derive(Default)]
struct Flags {
    /// The clock is to look.
    reported: bool,
    /// Handlers need not wait any more.
    released: bool,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Handler {
    /// Has been quick, and waits for the other one now.
    Waits,
    Releases,
}

impl Pool {
    fn new() -> Self {
        Self {
            calls: Mutex::default(),
            idle: AtomicUsize::default(),
            watch: Watch::new(),
            flags: Mutex::default(),
            changed: Condvar::default(),
        }
    }

    /// `ThreadPool::work`, for the calls that there are.
    fn work(&self) {
        loop {
            self.idle.fetch_add(1, Ordering::SeqCst);
            let call = self.calls.lock().unwrap().pop_front();
            self.idle.fetch_sub(1, Ordering::SeqCst);
            let Some(call) = call else { return };
            // `Engine::may_run_at_once`.
            if self.idle.load(Ordering::SeqCst) == 0 && self.watch.begins() {
                self.flags.lock().unwrap().reported = true;
                self.changed.notify_all();
            }
            self.run(call);
        }
    }

    fn run(&self, call: Handler) {
        let mut flags = self.flags.lock().unwrap();
        flags.released |= call == Handler::Releases;
        self.changed.notify_all();
        while !flags.released {
            flags = self.changed.wait(flags).unwrap();
        }
    }

    /// `Links::look`: looks when it is told to, and until it finds that nothing has happened.
    fn clock(&self) {
        let mut flags = self.flags.lock().unwrap();
        while !flags.released {
            if !std::mem::take(&mut flags.reported) {
                flags = self.changed.wait(flags).unwrap();
                continue;
            }
            drop(flags);
            let mut used = true;
            while used {
                used = self.watch.look(|_| false);
                let waiting = !self.calls.lock().unwrap().is_empty();
                if waiting && self.idle.load(Ordering::SeqCst) == 0 {
                    // `ThreadPool::relieve`: what it starts is this thread here.
                    self.work();
                }
            }
            flags = self.flags.lock().unwrap();
        }
    }
}

/// All threads are inside handlers that wait for a call which no thread has read: the clock starts one that reads it.
#[test]
fn the_clock_helps_when_all_threads_are_inside_handlers() {
    check(3, || {
        let pool = Arc::new(Pool::new());
        pool.calls.lock().unwrap().extend([Handler::Waits, Handler::Waits, Handler::Releases]);
        let workers = [(); 2].map(|()| {
            let pool = pool.clone();
            thread::spawn(move || pool.work())
        });
        pool.clock();
        workers.into_iter().for_each(|worker| worker.join().unwrap());
    });
}
