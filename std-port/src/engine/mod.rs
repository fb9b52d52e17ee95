//! What a unit's threads share, and the few ways in which they touch a link.
//!
//! Locks, in the order in which they may be taken: the accounts, a link, then the node, then anything else; never two links. Handlers,
//! hooks and subscribers run without any of them. A function that has worked on a link ends with [`Engine::settle`],
//! which gives the lock up and acts on what happened.

mod access;
mod accounts;
mod afterwards;
mod calling;
mod clock_thread;
mod driving;
mod interfaces;
mod keys;
pub(crate) mod link;
mod membership;
pub(crate) mod notices;
pub(crate) mod peers;
mod pinging;
mod presence;
pub(crate) mod reader;
mod reading;
mod roster;
mod serving;
mod state_gate;
mod staying;
mod tables;
mod telling;
#[cfg(test)]
mod tests;
mod watch;
pub(crate) mod workers;

pub(crate) use accounts::pairs;
#[cfg(feature = "metrics")]
pub(crate) use accounts::{Group, Reading};
#[cfg(any(feature = "async", feature = "control"))]
pub(crate) use calling::{CallFuture, worth_waiting};
pub(crate) use clock_thread::system_refused;
pub(crate) use keys::Keys;
pub(crate) use membership::HubCell;
pub(crate) use tables::node_storage;
pub(crate) use workers::arena_bytes;

use std::sync::atomic::{self, AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{SyncSender, TrySendError};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError, RwLock, RwLockReadGuard, RwLockWriteGuard, Weak};

use cara_core::config::{Constraints, Mode};
use cara_core::distribution::function_list::FunctionList;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{CloseReason, Error};
use cara_core::host::mailman::LinkId;
use cara_core::host::secure::Seal;
use cara_core::services::access::Access;
use cara_core::services::unit::{Event, Session, buffer_bytes};
use cara_core::services::{Context, requests::CallId};
use cara_core::time::{Duration, Instant};
use cara_secure::link::Cipher;

use crate::clock::Clock;
use crate::config::Capacities;
use crate::event::UnitEvent;
use crate::handler::Handler;
use crate::pool::MessagePool;
use crate::storage::Boxed;
use crate::sys::datagram::Datagrams;
use crate::sys::interfaces::Interface;
use crate::sys::stream::Listener;
use crate::threads::Threads;
use crate::timers::Timers;
use link::{LinkCell, LinkState, Linux, StdMailman};
use peers::{PeerCell, Peers};
use serving::Begun;
use state_gate::StateGate;

/// Bytes that one read takes from a stream.
pub(crate) const READ_BYTES: usize = 128 * 1024;
/// A link on which reading is paused is looked at again after this.
pub(crate) const RETRY: cara_core::time::Duration = cara_core::time::Duration::from_millis(1);

/// Everything that a unit's threads and handles share.
pub(crate) struct Engine<T: 'static> {
    /// For work that is left to another thread.
    me: Weak<Self>,
    pub(crate) clock: Clock,
    capacities: Capacities,
    pub(crate) hub: Mutex<HubCell>,
    pub(crate) functions: RwLock<FunctionList<Boxed, Handler<T>>>,
    pub(crate) peers: RwLock<Peers>,
    links: RwLock<Vec<Option<Arc<LinkCell>>>>,
    pub(crate) pool: MessagePool,
    pub(crate) state: StateGate<T, serving::Parked>,
    datagrams: Datagrams,
    listener: Option<Listener>,
    /// A manager looks for a live one of its identity before it starts.
    asks_for_itself: bool,
    /// The threads that drive the unit: its own, or those of several units.
    threads: Threads,
    /// No other unit has them.
    own_threads: bool,
    /// The unit's number among those that the threads drive, once it has been started.
    seat: OnceLock<u16>,
    timers: Mutex<Timers>,
    /// Longest block of parameters that this unit takes.
    longest_message: AtomicUsize,
    /// Bytes that the arguments and results of the largest function need.
    largest_function: AtomicUsize,
    /// The links that the clock looks at.
    watch: watch::Watch,
    interfaces: Mutex<interfaces::InterfaceWatch>,
    /// When connections are taken again, where there were no descriptors for them.
    listens_at: Mutex<Option<Instant>>,
    pub(crate) keys: Keys,
    /// When the file with the keys is looked at.
    watched_keys: Mutex<keys::Watched>,
    /// How old the keys of a link become, instead of 12 h.
    pub(crate) renews_every: OnceLock<Duration>,
    stopping: AtomicBool,
    /// When the unit was made.
    born: Instant,
    accounts: accounts::Accounts,
    guard: access::Guard,
    subscribers: Mutex<Vec<Subscriber>>,
    afterwards: afterwards::Afterwards<T>,
}

/// A channel that is told what happens.
struct Subscriber {
    sender: SyncSender<UnitEvent>,
    /// Events that found no room.
    lost: Arc<AtomicU64>,
}

/// The call of its own that a thread reads for.
struct OwnCall<'p> {
    id: CallId,
    parameters: &'p mut ParametersView,
    result: Option<Result<(), Error>>,
}

pub(crate) fn lock<V>(mutex: &Mutex<V>) -> MutexGuard<'_, V> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

pub(crate) fn read<V>(lock: &RwLock<V>) -> RwLockReadGuard<'_, V> {
    lock.read().unwrap_or_else(PoisonError::into_inner)
}

pub(crate) fn write<V>(lock: &RwLock<V>) -> RwLockWriteGuard<'_, V> {
    lock.write().unwrap_or_else(PoisonError::into_inner)
}

/// The parts that [`Engine::new`] puts together.
pub(crate) struct EngineParts<T: 'static> {
    /// The threads that the unit shares with others, if any.
    pub(crate) threads: Threads,
    pub(crate) own_threads: bool,
    pub(crate) capacities: Capacities,
    pub(crate) keys: Keys,
    pub(crate) hub: HubCell,
    pub(crate) functions: FunctionList<Boxed, Handler<T>>,
    pub(crate) pool: MessagePool,
    pub(crate) state: T,
    pub(crate) datagrams: Datagrams,
    pub(crate) listener: Option<Listener>,
    pub(crate) maximum_links: usize,
    pub(crate) asks_for_itself: bool,
}

impl<T: Send + 'static> Engine<T> {
    pub(crate) fn new(parts: EngineParts<T>) -> Arc<Self> {
        let longest_message = AtomicUsize::new(parts.hub.longest_message());
        let born = parts.threads.crew().clock.now();
        Arc::new_cyclic(|me| Self {
            me: me.clone(),
            clock: parts.threads.crew().clock,
            capacities: parts.capacities,
            hub: Mutex::new(parts.hub),
            functions: RwLock::new(parts.functions),
            peers: RwLock::new(Peers::default()),
            links: RwLock::new((0..parts.maximum_links).map(|_| None).collect()),
            pool: parts.pool,
            state: StateGate::new(parts.state),
            datagrams: parts.datagrams,
            listener: parts.listener,
            asks_for_itself: parts.asks_for_itself,
            threads: parts.threads,
            own_threads: parts.own_threads,
            seat: OnceLock::new(),
            timers: Mutex::new(Timers::new()),
            longest_message,
            largest_function: AtomicUsize::new(0),
            watch: watch::Watch::new(),
            interfaces: Mutex::default(),
            listens_at: Mutex::new(None),
            keys: parts.keys,
            watched_keys: Mutex::new(keys::Watched::new(born)),
            renews_every: OnceLock::new(),
            stopping: AtomicBool::new(false),
            born,
            accounts: accounts::Accounts::default(),
            guard: access::Guard::default(),
            subscribers: Mutex::new(Vec::new()),
            afterwards: afterwards::Afterwards::default(),
        })
    }

    pub(crate) fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Acquire)
    }

    /// Lends the session of a link what it needs.
    pub(crate) fn with<R>(
        &self,
        link: &LinkCell,
        state: &mut LinkState,
        act: impl FnOnce(&mut Session<Linux>, &mut Context<'_, Linux>) -> R,
    ) -> R {
        self.with_at(self.now(), link, state, act)
    }

    /// The same at a time that was read a moment ago: each look at the clock is some percent of a small request.
    fn with_at<R>(
        &self,
        now: Instant,
        link: &LinkCell,
        state: &mut LinkState,
        act: impl FnOnce(&mut Session<Linux>, &mut Context<'_, Linux>) -> R,
    ) -> R {
        let functions = read(&self.functions);
        let mut mailman = StdMailman { stream: Some(&link.stream), datagrams: &self.datagrams };
        let mut buffers = &self.pool;
        let asked = self.guard.ask();
        let access = asked.as_ref().map(|asked| asked as &dyn Access);
        let (mut hub, mut keys) = (self, self);
        let mut cx = Context {
            now,
            mailman: &mut mailman,
            buffers: &mut buffers,
            functions: &*functions,
            access,
            hub: &mut hub,
            keys: &mut keys,
        };
        act(&mut state.session, &mut cx)
    }

    /// Gives the session what was read. Returns the call that is to be run, its arguments in `arguments`.
    fn feed(
        &self,
        now: Instant,
        link: &Arc<LinkCell>,
        state: &mut LinkState,
        bytes: &mut [u8],
        mut arguments: Option<&mut ParametersView>,
        mut own: Option<&mut OwnCall<'_>>,
    ) -> Option<Begun> {
        let (was_paused, stalled) = (state.is_paused(), state.backlog.is_stalled(now));
        let (mut earlier, mut position) = state.backlog.take();
        let bytes = if was_paused {
            earlier.extend_from_slice(bytes);
            &mut earlier[..]
        } else {
            bytes
        };
        let mut call = None;
        loop {
            let rest = bytes.get_mut(position..).unwrap_or_default();
            let step = if !rest.is_empty() && !stalled && state.holds_back() {
                Step::PAUSED
            } else {
                let arguments = arguments.as_deref_mut().filter(|_| call.is_none());
                self.step(now, link, state, rest, arguments, own.as_deref_mut())
            };
            position += step.consumed;
            call = call.or(step.call);
            // One emergency alone has a place to wait, and the next one may be among these bytes.
            self.dispatch_emergencies(link, state);
            if step.joined {
                self.joined(link, state);
            }
            if step.paused && was_paused {
                state.backlog.put(earlier, position);
                return call;
            }
            if step.paused {
                state.backlog.put(bytes.get(position..).unwrap_or_default().to_vec(), 0);
                state.backlog.moved(now);
                return call;
            }
            let through = position == bytes.len() && !state.session.holds_received();
            if through || !step.progress {
                return call;
            }
        }
    }

    /// One call of `Session::receive`, with its event taken apart; an emergency goes to the thread of its service.
    fn step(
        &self,
        now: Instant,
        link: &Arc<LinkCell>,
        state: &mut LinkState,
        bytes: &mut [u8],
        mut arguments: Option<&mut ParametersView>,
        own: Option<&mut OwnCall<'_>>,
    ) -> Step {
        self.make_list_room(state);
        let functions = read(&self.functions);
        let mut mailman = StdMailman { stream: Some(&link.stream), datagrams: &self.datagrams };
        let mut buffers = &self.pool;
        let asked = self.guard.ask();
        let access = asked.as_ref().map(|asked| asked as &dyn Access);
        let (mut hub, mut keys) = (self, self);
        let mut cx = Context {
            now,
            mailman: &mut mailman,
            buffers: &mut buffers,
            functions: &*functions,
            access,
            hub: &mut hub,
            keys: &mut keys,
        };
        let LinkState { session, waiters, notices, .. } = state;
        let receipt = session.receive(&mut cx, bytes, arguments.as_deref_mut());
        let mut step = Step {
            consumed: receipt.consumed,
            paused: receipt.paused,
            progress: receipt.consumed > 0 || receipt.event.is_some(),
            joined: false,
            call: None,
        };
        match receipt.event {
            None => {}
            Some(Event::Joined) => step.joined = true,
            Some(Event::Call(call)) => {
                let begun = self.begun(&functions, link, call);
                match arguments.filter(|_| serving::is_emergency(&call)) {
                    None => step.call = Some(begun),
                    Some(arguments) => self.copy_emergency(&functions, link, begun, arguments),
                }
            }
            Some(Event::Reply(id, outcome)) => match own.filter(|own| own.id == id) {
                Some(own) => own.result = Some(outcome.and_then(|block| block.read_into(own.parameters))),
                None => {
                    let outcome =
                        outcome.map(|block| (block.signature().as_bytes().into(), Box::<[u8]>::from(block.bytes())));
                    if let Some(waiter) = waiters.iter_mut().find(|waiter| waiter.id == id) {
                        waiter.finish(outcome);
                    }
                }
            },
            Some(event) => {
                if matches!(event, Event::ListChanged) && !link.is_introduced() {
                    // A node that counts has its place.
                    link.peer.get().into_iter().for_each(|peer| write(&self.peers).introduce(peer));
                    link.introduce();
                }
                if let Event::LeaseExpired(slot) = event {
                    self.wake_leased(&functions, slot);
                }
                notices.note(&event);
            }
        }
        step
    }

    /// Polls the session as far as something is due, sets its timer and epoll interest, gives the lock up, and acts on
    /// what happened.
    pub(crate) fn settle<'l>(&self, link: &'l Arc<LinkCell>, guard: MutexGuard<'l, LinkState>) {
        self.settle_at(self.now(), link, guard);
    }

    fn settle_at<'l>(&self, now: Instant, link: &'l Arc<LinkCell>, mut guard: MutexGuard<'l, LinkState>) {
        let state = &mut *guard;
        self.dispatch_emergencies(link, state);
        let mut deadline = state.session.deadline();
        if deadline <= now {
            self.poll_session(link, state);
            deadline = state.session.deadline();
        }
        self.set_timer(now, deadline, link, state);
        self.set_interest(link, state);
        if state.notices.begin() {
            self.act(link, guard);
        }
    }

    fn poll_session(&self, link: &Arc<LinkCell>, state: &mut LinkState) {
        loop {
            let event = self.with(link, state, |session, cx| session.poll(cx));
            match event {
                None => return,
                Some(Event::Reply(id, outcome)) => {
                    state.finish(id, outcome.map(|_| Default::default()));
                }
                Some(event) => {
                    if let Event::Closed(_) = event {
                        link.stream.shutdown();
                        link.room.notify_all();
                    }
                    self.note(state, &event);
                }
            }
        }
    }

    /// An event that is acted upon when the lock is given up; only what waits for the end of a lease is woken before.
    fn note(&self, state: &mut LinkState, event: &Event<'_>) {
        if let Event::LeaseExpired(slot) = *event {
            self.wake_leased(&read(&self.functions), slot);
        }
        state.notices.note(event);
    }

    /// The thread that has read an emergency goes on reading.
    fn copy_emergency(
        &self,
        functions: &FunctionList<Boxed, Handler<T>>,
        link: &Arc<LinkCell>,
        begun: Begun,
        arguments: &ParametersView,
    ) {
        let mut copy = workers::arena(self.call_bytes());
        if copy.copy_from(arguments).is_ok() {
            self.run_emergency(functions, link, begun, copy);
        }
    }

    fn set_timer(&self, now: Instant, mut deadline: Instant, link: &LinkCell, state: &mut LinkState) {
        if state.is_paused() {
            deadline = deadline.min(now + RETRY);
        }
        // A timer that is early does no harm: it is set again when it comes.
        if deadline < state.timer {
            state.timer = deadline;
            if lock(&self.timers).set(u32::from(link.id.0), deadline) {
                self.wake_clock_at(deadline);
            }
        }
    }

    /// Where the unit takes connections; 0 for nowhere.
    pub(crate) fn tcp_port(&self) -> u16 {
        self.listener.as_ref().map_or(0, Listener::port)
    }

    /// The link of an id.
    pub(crate) fn link(&self, id: LinkId) -> Option<Arc<LinkCell>> {
        read(&self.links).get(usize::from(id.0)).cloned().flatten()
    }

    /// The link that an epoll token means, unless it is gone.
    fn link_of_token(&self, token: u64) -> Option<Arc<LinkCell>> {
        let id = LinkId((token & 0xffff) as u16);
        self.link(id).filter(|link| link.token() == token)
    }

    pub(crate) fn each_link(&self) -> Vec<Arc<LinkCell>> {
        read(&self.links).iter().flatten().cloned().collect()
    }

    /// Tells subscribers; one that does not keep up loses the event, and one that is gone is forgotten.
    pub(crate) fn tell(&self, event: UnitEvent) {
        tracing::debug!(?event);
        lock(&self.subscribers).retain(|subscriber| match subscriber.sender.try_send(event.clone()) {
            Ok(()) => true,
            Err(TrySendError::Full(_)) => {
                subscriber.lost.fetch_add(1, Ordering::Relaxed);
                self.accounts.event_lost();
                true
            }
            Err(TrySendError::Disconnected(_)) => false,
        });
    }

    /// Tells `sender` what happens from here on; what is returned counts the events that found no room.
    pub(crate) fn subscribe(&self, sender: SyncSender<UnitEvent>) -> Arc<AtomicU64> {
        let lost = Arc::new(AtomicU64::new(0));
        lock(&self.subscribers).push(Subscriber { sender, lost: lost.clone() });
        lost
    }

    /// Changes the constraints of the unit and tells every peer. [`Error::BadConstraint`] for more nodes than the process may
    /// have files open for.
    pub(crate) fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        self.make_node_room(constraints.maximum_nodes)?;
        let longest = {
            let mut cell = lock(&self.hub);
            cell.hub.node.set_constraints(constraints);
            cell.longest_message()
        };
        // Buffers first: peers send longer messages as soon as they are told.
        self.pool.resize(message_buffer_bytes(&constraints, self.keys.mode()));
        self.longest_message.store(longest, Ordering::Release);
        for link in self.each_link() {
            let mut state = link.lock();
            let own = link.peer.get().map_or(constraints, |peer| peer.constraints(constraints));
            self.with(&link, &mut state, |session, cx| session.set_constraints(cx, own));
            self.settle(&link, state);
        }
        Ok(())
    }

    /// Changes what differs for one node from the unit's constraints.
    pub(crate) fn set_peer_constraints(&self, peer: &PeerCell, constraints: Constraints) -> Result<(), Error> {
        let unit = *lock(&self.hub).hub.node.constraints();
        peer.set_constraints(unit, constraints)?;
        if let Some(link) = peer.link() {
            let mut state = link.lock();
            self.with(&link, &mut state, |session, cx| session.set_constraints(cx, constraints));
            self.settle(&link, state);
        }
        Ok(())
    }

    /// Time since the unit was made.
    pub(crate) fn uptime(&self) -> Duration {
        self.clock.now().since(self.born)
    }

    /// Whether it has keys.
    pub(crate) fn mode(&self) -> Mode {
        self.keys.mode()
    }

    /// The port of broadcasts.
    pub(crate) fn discovery_port(&self) -> u16 {
        self.datagrams.discovery_port()
    }

    /// The interfaces that are used, with those that are down.
    pub(crate) fn interfaces(&self) -> Arc<[Interface]> {
        self.datagrams.targets()
    }

    /// Ends every link in an orderly way and all threads. Within a handler it returns before the threads have ended.
    pub(crate) fn stop(&self) {
        if self.stopping.swap(true, Ordering::AcqRel) {
            return;
        }
        for link in self.each_link() {
            let mut state = link.lock();
            self.with(&link, &mut state, |session, cx| session.close(cx, CloseReason::Stopped));
            self.settle(&link, state);
        }
        self.state.stop();
        self.go_on_with_parked();
        // A handler may own a handle to a peer of this unit, and so the unit itself: without handlers nothing is left.
        let handlers = self.take_handlers();
        // What moved stops, and is heard of, before the unit is gone.
        handlers.iter().filter_map(|handler| handler.safe.as_ref()).for_each(|safe| safe.end());
        self.afterwards.end();
        handlers.iter().filter_map(|handler| handler.lane.as_ref()).for_each(|lane| lane.end());
        self.release_threads();
    }

    /// Runs `act` with the application's state, when its turn comes.
    pub(crate) fn with_state<R>(&self, act: impl FnOnce(&mut T) -> R) -> Result<R, Error> {
        let result = self.state.enter().map(|mut state| act(&mut state));
        self.go_on_with_parked();
        result
    }

    fn take_handlers(&self) -> Vec<Handler<T>> {
        let mut functions = write(&self.functions);
        let names: Vec<String> = functions.iter().map(|function| function.name().to_owned()).collect();
        names.iter().filter_map(|name| functions.remove(name).ok()).map(|(_, handler)| handler).collect()
    }

    fn now(&self) -> Instant {
        self.clock.now()
    }
}

/// Bytes of a buffer of the pool.
pub(crate) fn message_buffer_bytes(constraints: &Constraints, mode: Mode) -> usize {
    2 * buffer_bytes(constraints.message_size, Cipher::new(mode).overhead())
}

/// What one step of feeding led to.
struct Step {
    consumed: usize,
    paused: bool,
    /// Something was consumed or came out: there may be more.
    progress: bool,
    joined: bool,
    call: Option<Begun>,
}

impl Step {
    /// Nothing was looked at.
    const PAUSED: Self = Self { consumed: 0, paused: true, progress: false, joined: false, call: None };
}
