//! The handle to a unit: what m_units and s_units have in common.

use std::fmt;
use std::marker::PhantomData;
#[cfg(feature = "control")]
use std::sync::Mutex;
#[cfg(feature = "control")]
use std::sync::atomic::AtomicU64;
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Weak};

use cara_core::config::{Constraints, Mode};
use cara_core::distribution::claim::Claim;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::time::Duration;

use crate::access::AccessTable;
use crate::config;
#[cfg(feature = "control")]
use crate::control::{self, Audit, Control, Server};
use crate::engine::{Engine, pairs};
use crate::error::StartError;
use crate::event::{Finding, UnitEvent};
use crate::heart::Heart;
use crate::lease::LeaseWatch;
#[cfg(feature = "control")]
use crate::locks::lock;
use crate::my_function_list::MyFunctionList;
use crate::sys::interfaces::Interface;

/// The role of a [`CommunicationSystem`](crate::CommunicationSystem), as a type.
#[derive(Debug)]
pub enum MUnit {}

/// The role of a [`Unit`](crate::Unit), as a type.
#[derive(Debug)]
pub enum SUnit {}

/// A handle to a unit of this process, for any thread. Clones are handles to the same unit, which stops when the last one is
/// dropped.
///
/// Its role is a type, so that what only one role can do is a method of that role alone: a [`Handle<T, MUnit>`] is called
/// [`CommunicationSystem`](crate::CommunicationSystem), as in the paper, and a [`Handle<T, SUnit>`] is called
/// [`Unit`](crate::Unit). `T` is the application's state.
///
/// ```
/// use cara_std::Handle;
///
/// /// Of any role.
/// fn introduce<R>(unit: &Handle<(), R>) -> String {
///     format!("{} with {} functions", unit.identity(), unit.my_function_list().len())
/// }
/// ```
///
/// An s_unit has no nodes:
///
/// ```compile_fail
/// fn count(unit: &cara_std::Unit) -> usize {
///     unit.number_of_s_units()
/// }
/// ```
///
/// And an m_unit no manager:
///
/// ```compile_fail
/// fn manager(system: &cara_std::CommunicationSystem) -> Option<cara_std::Peer> {
///     system.manager()
/// }
/// ```
pub struct Handle<T: Send + 'static, R> {
    pub(crate) owner: Arc<Owner<T>>,
    role: PhantomData<fn() -> R>,
}

impl<T: Send + 'static, R> Clone for Handle<T, R> {
    fn clone(&self) -> Self {
        Self::owned_by(self.owner.clone())
    }
}

impl<T: Send + 'static, R> fmt::Debug for Handle<T, R> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.identity())
    }
}

/// Stops the unit's threads when the last handle goes.
pub(crate) struct Owner<T: Send + 'static> {
    pub(crate) engine: Arc<Engine<T>>,
    /// It does not keep the unit running.
    guest: bool,
    #[cfg(feature = "control")]
    control: Control,
    #[cfg(feature = "control")]
    audit: Option<Arc<Audit>>,
    #[cfg(feature = "control")]
    pub(crate) server: Mutex<Option<Server>>,
}

/// A unit that stops waits so long for the last lines of its audit log.
#[cfg(feature = "control")]
const LAST_LINES: std::time::Duration = std::time::Duration::from_secs(1);
/// A standby looks so often whether it commands, which opens its control socket.
#[cfg(feature = "control")]
const BETWEEN_LOOKS: std::time::Duration = std::time::Duration::from_millis(200);
/// One that could not open it tries again after so long.
#[cfg(feature = "control")]
const BETWEEN_TRIES: std::time::Duration = std::time::Duration::from_secs(30);
/// One that takes over waits so long for the control socket of one on this host that steps down.
#[cfg(feature = "control")]
const STEPPING_DOWN: std::time::Duration = std::time::Duration::from_secs(3);

#[cfg(feature = "control")]
fn wait_until(limit: std::time::Duration, condition: impl Fn() -> bool) {
    let end = std::time::Instant::now() + limit;
    while !condition() && std::time::Instant::now() < end {
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
}

impl<T: Send + 'static> Owner<T> {
    pub(crate) fn new(
        engine: Arc<Engine<T>>,
        #[cfg(feature = "control")] control: Control,
        #[cfg(feature = "control")] audit: Option<Arc<Audit>>,
    ) -> Self {
        Self {
            engine,
            guest: false,
            #[cfg(feature = "control")]
            control,
            #[cfg(feature = "control")]
            audit,
            #[cfg(feature = "control")]
            server: Mutex::new(None),
        }
    }

    fn stop(&self) {
        self.engine.stop();
        #[cfg(feature = "control")]
        {
            let server = lock(&self.server).take();
            if let Some(server) = server {
                server.stop();
            }
            if let Some(audit) = &self.audit {
                audit.flush(LAST_LINES);
            }
        }
    }
}

#[cfg(feature = "control")]
impl<T: Send + 'static> Owner<T> {
    fn guest(engine: Arc<Engine<T>>) -> Self {
        let mut guest = Self::new(engine, Control::Off, None);
        guest.guest = true;
        guest
    }

    /// Opens the socket for the unit's operator, unless it is open or the unit is being stopped.
    fn open_control(&self) {
        let mut server = lock(&self.server);
        // Dropping a server without stopping it would leak its threads.
        if server.is_none() && !self.engine.is_stopping() {
            let guest = Self::guest(self.engine.clone());
            *server = control::open(&self.control, self.audit.clone(), Handle::of(guest));
        }
    }

    /// Gives a standby the control socket of its host while it commands, and only then: whoever waits knows no vehicle, and would
    /// answer an operator that all are absent.
    fn keep_control_while_commanding(owner: Weak<Self>) -> Result<(), StartError> {
        let thread = std::thread::Builder::new().name("cara-socket".into());
        let keep = move || {
            let mut due = std::time::Instant::now();
            while let Some(owner) = owner.upgrade().filter(|owner| !owner.engine.is_stopping()) {
                if owner.engine.hub.lock().hub.node.is_standby() {
                    due = std::time::Instant::now();
                    let server = lock(&owner.server).take();
                    server.inspect(Server::stop);
                } else if lock(&owner.server).is_none() && due <= std::time::Instant::now() && owner.take_control() {
                    due = std::time::Instant::now() + BETWEEN_TRIES;
                }
                drop(owner);
                std::thread::sleep(BETWEEN_LOOKS);
            }
        };
        thread.spawn(keep).map(drop).map_err(|error| crate::error::system_refused(error).into())
    }

    /// Opens the socket if that is possible; `false` where another process has it. A process that does not answer is the manager which
    /// this unit has replaced, and hangs: its socket is removed.
    fn take_control(&self) -> bool {
        let (identity, fleet) = self.engine.hub.lock().identity();
        if let Some(path) = control::held(&self.control, &identity, fleet)
            && !control::free_silent(&self.control, &path)
        {
            return false;
        }
        self.open_control();
        true
    }
}

impl<T: Send + 'static> Drop for Owner<T> {
    fn drop(&mut self) {
        if !self.guest {
            self.stop();
        }
    }
}

/// A handle that does not keep the unit running: what a handler of the unit itself holds to call others.
pub struct WeakHandle<T: Send + 'static, R> {
    owner: Weak<Owner<T>>,
    role: PhantomData<fn() -> R>,
}

impl<T: Send + 'static, R> Clone for WeakHandle<T, R> {
    fn clone(&self) -> Self {
        Self { owner: self.owner.clone(), role: PhantomData }
    }
}

impl<T: Send + 'static, R> fmt::Debug for WeakHandle<T, R> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("WeakHandle")
    }
}

impl<T: Send + 'static, R> WeakHandle<T, R> {
    /// The unit, unless its last handle has been dropped.
    pub fn upgrade(&self) -> Option<Handle<T, R>> {
        self.owner.upgrade().map(Handle::owned_by)
    }
}

impl<T: Send + 'static, R> Handle<T, R> {
    fn owned_by(owner: Arc<Owner<T>>) -> Self {
        Self { owner, role: PhantomData }
    }

    pub(crate) fn of(owner: Owner<T>) -> Self {
        Self::owned_by(Arc::new(owner))
    }

    pub(crate) fn engine(&self) -> &Arc<Engine<T>> {
        &self.owner.engine
    }

    /// Searches for nodes, or for the manager, and keeps connections, in threads of its own (paper, listing line 2).
    ///
    /// An m_unit first asks for its own identity and waits 300 ms: [`StartError::AlreadyRunning`] where a live m_unit answers.
    /// One that is stopped (`SIGSTOP`) or hangs does not answer; on this host it holds its control socket, which is
    /// [`StartError::SocketHeld`]. If it is on another host, or has no socket, this one starts and gets its links. An m_unit
    /// that is to [take over](crate::Builder::take_over) starts in any case.
    #[doc(alias = "start_thread")]
    pub fn start(&self) -> Result<(), StartError> {
        #[cfg(not(feature = "control"))]
        self.engine().start()?;
        #[cfg(feature = "control")]
        {
            let held = || control::held(&self.owner.control, &self.identity(), self.fleet());
            let ran = self.engine().driver.unit_number().is_some();
            self.engine().start_unless(held)?;
            if self.engine().claims.takes_over() {
                // The one that steps down has the socket until it ends.
                wait_until(STEPPING_DOWN, || held().is_none());
            }
            if self.engine().claims.stands_by() {
                let owner = Arc::downgrade(&self.owner);
                return if ran { Ok(()) } else { Owner::keep_control_while_commanding(owner) };
            }
            self.owner.open_control();
        }
        Ok(())
    }

    /// Ends every link in an orderly way and all of its threads.
    pub fn stop(&self) {
        self.owner.stop();
    }

    /// For watchdogs: wakes the thread that ends leases and misses keep-alives, and waits until it has done what is due. `false` if
    /// that takes longer than this, or the unit does not run.
    pub fn keeps_time(&self, within: impl Into<Duration>) -> bool {
        self.engine().driver.goes_round(within.into())
    }

    /// A handle for the unit's own handlers. One that owned a [`Handle`] would keep it running for ever.
    pub fn downgrade(&self) -> WeakHandle<T, R> {
        WeakHandle { owner: Arc::downgrade(&self.owner), role: PhantomData }
    }

    /// Whether this m_unit stands by and commands nobody: see [`Builder::standby`](crate::Builder::standby).
    pub fn is_standby(&self) -> bool {
        self.engine().hub.lock().hub.node.is_standby()
    }

    /// Whether this manager leads: see [`Builder::authority`](crate::Builder::authority).
    pub fn is_leading(&self) -> bool {
        self.engine().leads()
    }

    #[cfg(feature = "control")]
    pub(crate) fn has_authority(&self) -> bool {
        self.engine().leadership.has_authority()
    }

    /// The claim of an m_unit, or the highest that an s_unit has obeyed.
    pub fn claim(&self) -> Claim {
        self.engine().hub.lock().hub.node.claim()
    }

    /// This unit's identity.
    pub fn identity(&self) -> Identity {
        self.engine().hub.lock().hub.node.identity().clone()
    }

    /// The fleet that it belongs to.
    pub fn fleet(&self) -> Fleet {
        self.engine().fleet
    }

    /// Which of its runs this is: peers tell a restart by it.
    pub fn epoch(&self) -> Epoch {
        self.engine().hub.lock().hub.node.epoch()
    }

    /// Time since it was made.
    pub fn uptime(&self) -> Duration {
        self.engine().uptime()
    }

    /// Whether its links are secured, with keys, or plain.
    pub fn mode(&self) -> Mode {
        self.engine().keys().mode()
    }

    /// The UDP port of broadcasts.
    pub fn discovery_port(&self) -> u16 {
        self.engine().sockets.datagrams.discovery_port()
    }

    /// The interfaces that it uses, with those that are down, as they were at most a few seconds ago.
    pub fn interfaces(&self) -> Vec<Interface> {
        self.engine().sockets.datagrams.targets().to_vec()
    }

    /// Searches for nodes, or for the manager, now (paper, listing line 6).
    pub fn broadcast(&self) {
        self.engine().broadcast();
    }

    /// The unit's own functions.
    pub fn my_function_list(&self) -> MyFunctionList<'_, T> {
        MyFunctionList { engine: self.engine() }
    }

    /// What an order ([`Served::lease`](crate::Served::lease)) has started is finished: it ends, no hook runs, and its caller is told
    /// so. `false` for one that has ended before, as when a newer call has replaced it, and for a lease that is of no call.
    pub fn end_order(&self, order: &LeaseWatch) -> bool {
        let Some((word, order)) = order.order() else { return false };
        let engine = self.engine();
        let mut links = engine.links.all().into_iter();
        let is_finished = links.any(|link| {
            engine.on_link(&link, |session, cx| {
                session.unrecorded("an order of the peer has ended").end_order(cx, &word.lease, order)
            })
        });
        word.wake();
        is_finished
    }

    /// A stream of this unit, as [added](MyFunctionList::add_stream) before.
    pub fn stream(&self, name: &str) -> Option<crate::stream::Stream<T>> {
        self.my_function_list().stream(name)
    }

    /// The constraints in force.
    pub fn constraints(&self) -> Constraints {
        *self.engine().hub.lock().hub.node.constraints()
    }

    /// Changes the constraints; peers are told. [`Error::BadConstraint`] for values that this unit cannot hold.
    pub fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        config::check(&constraints)?;
        self.engine().set_constraints(constraints)
    }

    /// Sets another access table, or none; in force when this returns. A file that the unit follows replaces it when it
    /// changes.
    pub fn set_access(&self, table: Option<AccessTable>) {
        self.engine().set_access(table);
    }

    /// The access table in force; without one, a joined node may do everything.
    pub fn access(&self) -> Option<Arc<AccessTable>> {
        self.engine().guard.table()
    }

    /// Subscribes to events: joined, left, failed. A subscriber that does not keep up loses events.
    ///
    /// ```no_run
    /// use cara_std::{CommunicationSystem, UnitEvent};
    ///
    /// let depot = CommunicationSystem::new("depot", 1)?;
    /// let events = depot.events();
    /// depot.start()?;
    /// for event in events {
    ///     if let UnitEvent::Left { peer, reason } = event {
    ///         eprintln!("{peer}: {reason}");
    ///     }
    /// }
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn events(&self) -> Receiver<UnitEvent> {
        let (sender, receiver) = sync_channel(self.events_waiting());
        self.engine().events.subscribe(sender);
        receiver
    }

    /// Events that wait for a subscriber before it loses some: an m_unit has many nodes.
    pub(crate) fn events_waiting(&self) -> usize {
        match self.identity().role() {
            Role::MUnit => 4096,
            Role::SUnit => 256,
        }
    }

    /// Events with room for so many, and how many have found none since it was last set to 0.
    #[cfg(feature = "control")]
    pub(crate) fn events_with_losses(&self, room: usize) -> (Receiver<UnitEvent>, Arc<AtomicU64>) {
        let (sender, receiver) = sync_channel(room);
        (receiver, self.engine().events.subscribe(sender))
    }

    /// A heart for one loop of the program, which is to beat it at least once in `period`: half of the shortest lease that
    /// is named with it, or less.
    pub fn heart(&self, period: impl Into<Duration>) -> Heart {
        Heart::new(self.engine(), period.into())
    }

    /// Runs `act` with the application's state.
    ///
    /// ```no_run
    /// let agv = cara_std::Unit::builder("agv", 7, "depot", 1)?.state([0_i64; 2]).build()?;
    /// agv.with_state(|position| *position = [3, 4])?;
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn with_state<A>(&self, act: impl FnOnce(&mut T) -> A) -> Result<A, Error> {
        self.engine().services.with_state(act)
    }

    /// Frees unused message buffers, of which a few are otherwise kept for the next long messages.
    pub fn trim_buffers(&self) {
        self.engine().pool.shrink();
    }

    /// Everything that is counted for the unit as a whole: (name, number), zeros included. What happened in discovery and
    /// membership; on all links together, those that have ended included; in the port. The last eight
    /// (`AccessFileWrong`, `BuffersInUse`, `BuffersPeak`, `LinksOpen`, `Leading`, `NodesConnected`, `CallsHeld`, `CallsInFlight`) tell
    /// how it is now; no other ever goes back.
    pub fn counters(&self) -> Vec<(&'static str, u64)> {
        pairs(self.engine().readings())
    }

    /// What happened on all links, also on those that have ended.
    pub fn counted(&self, counter: LinkCounter) -> u64 {
        self.engine().accounts.counted(&self.engine().links, counter)
    }

    /// What happened in discovery and membership.
    pub fn node_counted(&self, counter: NodeCounter) -> u64 {
        self.engine().hub.lock().hub.node.counters.value(counter)
    }

    /// Everything that is counted, for the unit and for each node that it knows, in the text form that Prometheus reads:
    /// see [`metrics`](crate::metrics).
    #[cfg(feature = "metrics")]
    pub fn metrics(&self) -> String {
        crate::metrics::text(self.engine(), &self.identity())
    }

    /// The last refusals, here or there.
    pub fn findings(&self) -> Vec<Finding> {
        self.engine().hub.lock().hub.node.findings().cloned().collect()
    }

    /// Time since a refusal.
    pub fn age(&self, finding: &Finding) -> Duration {
        self.engine().now().since(finding.at)
    }

    /// The keys of links that this unit opens from here on are renewed this often, instead of every 12 h; once. So a test
    /// need not wait for so long.
    #[doc(hidden)]
    pub fn renew_keys_every(&self, span: cara_core::time::Duration) {
        self.engine().key_watch.renew_every(span);
    }
}
