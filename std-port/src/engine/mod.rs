//! What a unit's threads share, and the few ways in which they touch a link.
//!
//! Each part owns its state and its locks, is given the other parts that it needs, and returns what happened. It knows
//! nothing of what is built on it. From below:
//!
//! | modules | what |
//! |---|---|
//! | `reader`, `watch`, `notices`, `details`, `streams`, `worker`, `state`, `state_gate`, `alarms`, `events` | state machines and memory, without any link |
//! | `link`, `peer_cell`, `roster`, `pinging`, `served` | a link and its session, a node, a call as its handler has it |
//! | `sockets`, `driving`, `hub`, `keys`, `peers`, `links` | sockets, threads and clock, the node, its keys, all nodes and all links |
//! | `reading`, `tables`, `interfaces`, `presence`, `claims`, `leadership`, `access`, `noting`, `accounts`, `unjoined` | what is decided and counted with those |
//! | `afterwards`, `tasks`, `services` | functions, and whatever runs with the application's state |
//! | [`Engine`] | joins the parts, lends a session what it needs, and acts on what the parts return |
//! | `settling`, `inbound` | its methods for a link that a thread has locked |
//! | `calling`, `serving`, `workers` | for requests of this unit, those of its peers, and the threads of the pool |
//! | `membership`, `clock_thread` | for links that come and go, and for the thread that keeps time |
//! | `awaiting`, `clocks` | calls that are futures, and those that measure clocks: built on all of it, as the handles are |
//!
//! Locks are taken in the order of [`Rank`](crate::locks::Rank), which a debug build asserts: the accounts, the table of
//! links, a link, the functions, the node, then any other; never two links. Handlers, hooks and subscribers run without
//! any of them. A function that has worked on a link ends with [`Engine::settle`], which gives the lock up and acts on what
//! happened.

mod access;
mod accounts;
mod afterwards;
mod alarms;
mod awaiting;
mod calling;
pub(crate) mod claims;
mod clock_thread;
pub(crate) mod clocks;
pub(crate) mod details;
mod driving;
mod events;
mod hand_over;
mod hub;
mod inbound;
mod interfaces;
mod keys;
mod leadership;
pub(crate) mod link;
mod links;
mod membership;
mod nested;
pub(crate) mod notices;
mod noting;
pub(crate) mod peer_cell;
mod peers;
mod pinging;
mod presence;
pub(crate) mod reader;
mod reading;
pub(crate) mod rerun;
mod roster;
pub(crate) mod served;
mod services;
mod serving;
mod settling;
mod sockets;
pub(crate) mod state;
pub(crate) mod state_gate;
pub(crate) mod streams;
mod tables;
mod tape;
#[cfg(feature = "async")]
mod tasks;
#[cfg(test)]
mod tests;
mod unjoined;
mod watch;
pub(crate) mod worker;
mod workers;

#[cfg(feature = "metrics")]
pub(crate) use accounts::Group;
pub(crate) use accounts::Reading;
pub(crate) use accounts::pairs;
pub(crate) use awaiting::{Answered, CallsToAll, Pending};
#[cfg(feature = "async")]
pub(crate) use driving::Alarm;
#[cfg(feature = "async")]
pub(crate) use events::Delivered;
pub(crate) use hub::HubCell;
pub(crate) use keys::Keys;
#[cfg(feature = "async")]
pub(crate) use pinging::Turn;
pub(crate) use tables::node_storage;
#[cfg(feature = "async")]
pub(crate) use tasks::Spawned;
pub(crate) use worker::{arena, arena_bytes};

use std::path::PathBuf;
use std::sync::atomic;
use std::sync::{Arc, Mutex, Weak};

use cara_core::config::{Constraints, Mode};
use cara_core::distribution::claim::Claim;
use cara_core::distribution::function_list::FunctionList;
use cara_core::distribution::identity::Fleet;
use cara_core::error::{CloseReason, Error};
use cara_core::host::secure::Seal;
use cara_core::services::Context;
use cara_core::services::access::Access;
use cara_core::services::lease::Latch;
use cara_core::services::session::{Event, buffer_bytes};
use cara_core::time::{Duration, Instant};
use cara_secure::link::Cipher;

use crate::access::AccessTable;
#[cfg(feature = "access")]
use crate::access::watch::FileWatch;
use crate::actuator::Change;
use crate::authority::Authority;
use crate::config::Capacities;
#[cfg(feature = "control")]
use crate::control::Audit;
use crate::error::{StartError, system_refused};
use crate::event::UnitEvent;
use crate::handler::Handler;
use crate::latch::Keeper;
use crate::news::News;
use crate::pool::MessagePool;
use crate::storage::Boxed;
use crate::sys::datagram::Datagrams;
use crate::sys::stream::Listener;
use crate::threads::Threads;
use driving::Driver;
use events::Events;
use hub::{HubDoor, SharedHub};
use keys::{KeyDoor, KeyWatch};
use link::{LinkCell, LinkState, Linux, StdMailman};
use links::Links;
use noting::Notes;
use peer_cell::PeerCell;
use peers::Nodes;
use presence::SelfSearch;
use services::Services;
use sockets::Sockets;
use tape::{LIMITS, TapedSession};

/// Everything that a unit's threads and handles share.
pub(crate) struct Engine<T: 'static> {
    /// For work that is left to another thread.
    me: Weak<Self>,
    pub(crate) driver: Arc<Driver>,
    /// Beside the hub, whose lock a session's datagram does not take.
    pub(crate) fleet: Fleet,
    pub(crate) sockets: Sockets,
    interfaces: interfaces::InterfaceWatch,
    pub(crate) links: Links,
    /// Where the core's sessions are recorded, if they are.
    core_recordings: Option<PathBuf>,
    pub(crate) hub: SharedHub,
    pub(crate) nodes: Nodes,
    pub(crate) services: Arc<Services<T>>,
    pub(crate) pool: MessagePool,
    /// How long a thread that waits for a link polls it before it sleeps.
    spin: Duration,
    pub(crate) key_watch: KeyWatch,
    pub(crate) guard: access::Guard,
    pub(crate) claims: claims::Claims,
    pub(crate) leadership: Arc<leadership::Leadership>,
    pub(crate) latch: Keeper,
    pub(crate) accounts: accounts::Accounts,
    notes: Notes,
    pub(crate) events: Events,
    unjoined: unjoined::Unjoined,
    clocks: Arc<clocks::Clocks>,
    /// For threads that look for themselves at what has happened.
    pub(crate) news: News,
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
    pub(crate) spin: Duration,
    pub(crate) state: T,
    pub(crate) datagrams: Datagrams,
    pub(crate) listener: Option<Listener>,
    pub(crate) maximum_links: usize,
    pub(crate) asks_for_itself: bool,
    pub(crate) state_folder: Option<PathBuf>,
    pub(crate) take_over: claims::TakeOver,
    pub(crate) stands_by: bool,
    pub(crate) authority: Option<Box<dyn Authority>>,
    pub(crate) starts_stopped: Option<u16>,
    pub(crate) core_recordings: Option<PathBuf>,
    #[cfg(feature = "control")]
    pub(crate) audit: Option<Arc<Audit>>,
}

impl<T: Send + 'static> Engine<T> {
    pub(crate) fn new(parts: EngineParts<T>) -> Arc<Self> {
        let driver = Arc::new(Driver::new(parts.threads, parts.own_threads, parts.asks_for_itself));
        let node = &parts.hub.hub.node;
        let latch = Keeper::new(parts.state_folder.as_deref(), node.identity(), node.fleet());
        let stopped = latch.kept().or(parts.starts_stopped.map(|reason| Latch { by: 0, reason }));
        if let Some(stopped) = stopped {
            parts.functions.stopped().inhibit(driver.born(), stopped);
        }
        Arc::new_cyclic(|me| Self {
            me: me.clone(),
            fleet: parts.hub.hub.node.fleet(),
            sockets: Sockets::new(parts.datagrams, parts.listener),
            interfaces: interfaces::InterfaceWatch::default(),
            links: Links::new(driver.clone(), parts.maximum_links, parts.capacities),
            core_recordings: parts.core_recordings,
            services: Arc::new(Services::new(
                driver.clone(),
                parts.functions,
                parts.state,
                parts.hub.longest_message(),
            )),
            hub: SharedHub(Mutex::new(parts.hub)),
            nodes: Nodes::default(),
            pool: parts.pool,
            spin: parts.spin,
            key_watch: KeyWatch::new(parts.keys, driver.born()),
            driver,
            guard: access::Guard::default(),
            claims: claims::Claims::new(parts.state_folder, parts.take_over, parts.stands_by),
            leadership: Arc::new(leadership::Leadership::new(parts.authority)),
            latch,
            accounts: accounts::Accounts::default(),
            notes: Notes {
                #[cfg(feature = "control")]
                audit: parts.audit,
                #[cfg(feature = "control")]
                commands: Arc::default(),
                #[cfg(feature = "control")]
                log: std::sync::OnceLock::new(),
            },
            events: Events::default(),
            unjoined: unjoined::Unjoined::default(),
            clocks: Arc::default(),
            news: News::default(),
        })
    }

    /// Those that follow what operators and the program do.
    #[cfg(feature = "control")]
    pub(crate) fn commands(&self) -> &Arc<crate::control::Commands> {
        self.notes.commands()
    }

    /// Where the program's log is, for operators.
    #[cfg(feature = "control")]
    pub(crate) const fn log(&self) -> &std::sync::OnceLock<crate::Log> {
        &self.notes.log
    }

    pub(crate) fn is_stopping(&self) -> bool {
        self.driver.is_stopping()
    }

    /// Lends the session of a link what it needs.
    pub(crate) fn with<R>(
        &self,
        link: &LinkCell,
        state: &mut LinkState,
        act: impl FnOnce(&mut TapedSession, &mut Context<'_, Linux>) -> R,
    ) -> R {
        self.with_at(self.now(), link, state, act)
    }

    /// The same at a time that was read a moment ago: each look at the clock is some percent of a small request.
    fn with_at<R>(
        &self,
        now: Instant,
        link: &LinkCell,
        state: &mut LinkState,
        act: impl FnOnce(&mut TapedSession, &mut Context<'_, Linux>) -> R,
    ) -> R {
        self.with_functions(now, &self.services.functions(), link, &mut state.session, act)
    }

    /// The same with the functions that the caller reads, and goes on to read.
    fn with_functions<R>(
        &self,
        now: Instant,
        functions: &FunctionList<Boxed, Handler<T>>,
        link: &LinkCell,
        session: &mut TapedSession,
        act: impl FnOnce(&mut TapedSession, &mut Context<'_, Linux>) -> R,
    ) -> R {
        let mut mailman = StdMailman { stream: Some(&link.stream), datagrams: &self.sockets.datagrams };
        let mut buffers = &self.pool;
        let asked = self.guard.ask();
        let access = asked.as_ref().map(|asked| asked as &dyn Access);
        let mut hub = HubDoor { hub: &self.hub, driver: &self.driver };
        let mut keys = KeyDoor { watch: &self.key_watch, driver: &self.driver };
        let mut cx = Context {
            now,
            mailman: &mut mailman,
            buffers: &mut buffers,
            functions,
            access,
            hub: &mut hub,
            keys: &mut keys,
        };
        act(session, &mut cx)
    }

    /// Has the session of a link do something, and acts on what happens.
    pub(crate) fn on_link<R>(
        &self,
        link: &Arc<LinkCell>,
        act: impl FnOnce(&mut TapedSession, &mut Context<'_, Linux>) -> R,
    ) -> R {
        let mut state = link.lock();
        let result = self.with(link, &mut state, act);
        self.settle(link, state);
        result
    }

    /// The same on every link, one after the other.
    pub(crate) fn on_each_link(&self, mut act: impl FnMut(&mut TapedSession, &mut Context<'_, Linux>)) {
        self.links.all().iter().for_each(|link| self.on_link(link, &mut act));
    }

    /// Tells subscribers.
    pub(crate) fn notify(&self, event: UnitEvent) {
        if self.unjoined.note(self.now(), &event) {
            self.driver.wake_looker();
        }
        self.events.notify(&event);
        self.news.add();
    }

    /// Changes the constraints of the unit and tells every peer. [`Error::BadConstraint`] for more nodes than the process may
    /// have files open for.
    pub(crate) fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        self.links.make_node_room(&self.hub, constraints.maximum_nodes)?;
        let longest = {
            let mut cell = self.hub.lock();
            cell.hub.node.set_constraints(constraints);
            cell.longest_message()
        };
        // Buffers first: peers send longer messages as soon as they are told.
        self.pool.resize(message_buffer_bytes(&constraints, self.keys().mode()));
        self.services.set_longest_message(longest);
        for link in self.links.all() {
            let mut state = link.lock();
            let own = link.peer.get().map_or(constraints, |peer| peer.constraints(constraints));
            self.with(&link, &mut state, |session, cx| session.unrecorded(LIMITS).set_constraints(cx, own));
            self.settle(&link, state);
        }
        Ok(())
    }

    /// Another access table, or none: in force when this returns, and every peer is told what it may see.
    pub(crate) fn set_access(&self, table: Option<AccessTable>) {
        self.guard.set(table);
        for link in self.links.all() {
            let mut state = link.lock();
            // One that is not live yet may have told its list.
            self.with(&link, &mut state, |session, cx| {
                session.unrecorded("the access table has changed").access_changed(cx)
            });
            if state.session.is_live() {
                state.notices.push(Event::ListChanged);
            }
            self.settle(&link, state);
        }
    }

    /// Takes over what is written to an access table's file.
    #[cfg(feature = "access")]
    pub(crate) fn follow(self: &Arc<Self>, mut watch: FileWatch) -> Result<(), Error> {
        let engine = Arc::downgrade(self);
        access::following::follow(move || {
            let Some(engine) = engine.upgrade().filter(|engine| !engine.is_stopping()) else { return false };
            if let Some(table) = watch.look().and_then(|read| engine.guard.read(read)) {
                engine.set_access(Some(table));
                engine.guard.file.reloads.fetch_add(1, atomic::Ordering::Relaxed);
            }
            true
        })
    }

    /// Changes what differs for one node from the unit's constraints.
    pub(crate) fn set_peer_constraints(&self, peer: &PeerCell, constraints: Constraints) -> Result<(), Error> {
        let unit = *self.hub.lock().hub.node.constraints();
        peer.set_constraints(unit, constraints)?;
        if let Some(link) = peer.link() {
            self.on_link(&link, |session, cx| session.unrecorded(LIMITS).set_constraints(cx, constraints));
        }
        Ok(())
    }

    /// Everything that is counted for the unit as a whole.
    pub(crate) fn readings(&self) -> Vec<Reading> {
        self.services.look_at_hooks();
        self.accounts.readings(&accounts::Parts {
            links: &self.links,
            hub: &self.hub,
            nodes: &self.nodes,
            pool: &self.pool,
            events: &self.events,
            guard: &self.guard,
            leads: self.leads(),
            latch: &self.latch,
            notes: &self.notes,
        })
    }

    /// Time since the unit was made.
    pub(crate) fn uptime(&self) -> Duration {
        self.now().since(self.driver.born())
    }

    /// Begins to search and to serve, driven by the unit's threads. One that runs already goes on; one that was stopped
    /// does not start again.
    #[cfg(not(feature = "control"))]
    pub(crate) fn start(self: &Arc<Self>) -> Result<(), StartError> {
        self.start_unless(|| None)
    }

    /// Begins, as `start` does, unless a process of this host `holds` what is this unit's, as one does that hangs and
    /// does not say that it runs.
    pub(crate) fn start_unless(self: &Arc<Self>, holds: impl FnOnce() -> Option<PathBuf>) -> Result<(), StartError> {
        if self.is_stopping() {
            return Err(Error::NotRunning.into());
        }
        if self.driver.unit_number().is_some() {
            return Ok(());
        }
        let running = if self.driver.asks_for_itself {
            let search =
                SelfSearch { datagrams: &self.sockets.datagrams, keys: self.keys(), clock: self.driver.clock() };
            search.running_elsewhere(&self.hub).map_err(system_refused)?
        } else {
            None
        };
        if let Some((at, report)) = &running {
            self.claims.may_start_beside(&self.hub, *at, report.as_ref())?;
        }
        if let Some(path) = (self.driver.asks_for_itself && !self.claims.takes_over()).then(holds).flatten() {
            let (identity, fleet) = self.hub.lock().identity();
            return Err(StartError::SocketHeld { identity, fleet, path });
        }
        let heard = running.and_then(|(_, report)| report).map_or(Claim::NONE, |report| report.claim());
        self.claim(heard)
            .and_then(|()| self.driver.start(self.clone(), &self.sockets))
            .inspect_err(|_| self.give_up_key())?;
        if self.keys().mode() == Mode::Plain {
            tracing::warn!(
                unit = %self.hub.lock().hub.node.identity(), discovery_port = self.sockets.datagrams.discovery_port(),
                "plain mode, without keys: whoever is on the network can read what this unit says, and speak as any unit"
            );
        }
        self.driver.wake_looker();
        self.driver.wake();
        if self.claims.stands_by() {
            self.notify(UnitEvent::StandsBy { by: None });
        }
        Ok(())
    }

    /// With an authority only once that has given the key, which a standby asks for later.
    fn claim(&self, heard: Claim) -> Result<(), StartError> {
        if self.claims.stands_by() {
            self.claims.claim(&self.hub, self.keys(), self.driver.clock(), heard)?;
            return self.want_key();
        }
        let revision = self.seek_key()?;
        let above = heard.max(claims::above_revision(revision));
        self.claims.claim(&self.hub, self.keys(), self.driver.clock(), above)?;
        self.started_under(revision)
    }

    /// What the unit moves has been stopped, or reset.
    pub(crate) fn latch_changed(&self, change: Change) {
        match change {
            Change::Stopped => self.links.look_at_orders(),
            Change::ResetHere => self.services.end_stop_of_all(self.now()),
            Change::Reset => {}
        }
        self.latch.notify();
    }

    /// Ends every link in an orderly way and all threads. Within a handler it returns before the threads have ended.
    pub(crate) fn stop(&self) {
        if self.driver.stop() {
            return;
        }
        // Those that wait for a node wait in vain.
        self.news.add();
        self.on_each_link(|session, cx| session.close(cx, CloseReason::StoppedHere));
        self.leadership.wake();
        self.services.state.stop();
        self.services.go_on_with_parked();
        // Dropped at the end, when no thread of the unit is left.
        let _handlers = self.services.end();
        self.driver.release_threads(&self.sockets, || self.links.watch.clear());
        // No clock sounds them any more, and the task of one may hold the unit.
        self.driver.alarms.clear();
        #[cfg(feature = "async")]
        {
            self.events.end_queues();
            let peers: Vec<_> = self.nodes.read().all().cloned().collect();
            peers.iter().for_each(|peer| peer.streams.wake_tasks());
        }
        self.leadership.await_release();
    }

    pub(crate) fn now(&self) -> Instant {
        self.driver.clock().now()
    }

    pub(crate) fn keys(&self) -> &Keys {
        self.key_watch.keys()
    }
}

/// Bytes of a buffer of the pool.
pub(crate) fn message_buffer_bytes(constraints: &Constraints, mode: Mode) -> usize {
    2 * buffer_bytes(constraints.message_size, Cipher::new(mode).overhead())
}
