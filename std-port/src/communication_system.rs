//! The paper's `Communication_System`: an m_unit, which connects to many nodes.

use std::collections::HashSet;
#[cfg(feature = "control")]
use std::path::PathBuf;
#[cfg(feature = "control")]
use std::sync::Mutex;
#[cfg(feature = "control")]
use std::sync::atomic::AtomicU64;
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Weak};
use std::task::{Poll, Wake, Waker};

use cara_core::config::{Constraints, Mode};
use cara_core::distribution::connection_handler::{Finding, Target};
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::Error;
#[cfg(feature = "control")]
use cara_core::services::access::Verb;
use cara_core::services::requests::CallId;
use cara_core::services::unit::RequestOptions;
use cara_core::time::Duration;
use core::net::IpAddr;

use crate::access::AccessTable;
use crate::builder::{self, BuildError, Builder};
#[cfg(feature = "control")]
use crate::control::{self, Control, Server};
use crate::engine::{Engine, pairs};
use crate::error::StartError;
use crate::event::UnitEvent;
use crate::locks::lock;
use crate::my_function_list::MyFunctionList;
use crate::peer::Peer;
use crate::sys::interfaces::Interface;

/// Events that wait for a subscriber before it loses some.
const EVENTS: usize = 4096;

/// An m_unit. Clones are handles to the same unit, which stops when the last one is dropped.
#[doc(alias = "Communication_System")]
pub struct CommunicationSystem<T: Send + 'static = ()> {
    pub(crate) owner: Arc<Owner<T>>,
}

/// Stops the unit's threads when the last handle goes.
pub(crate) struct Owner<T: Send + 'static> {
    pub(crate) engine: Arc<Engine<T>>,
    /// It does not keep the unit running.
    guest: bool,
    #[cfg(feature = "control")]
    control: Control,
    #[cfg(feature = "control")]
    server: Mutex<Option<Server>>,
}

impl<T: Send + 'static> Owner<T> {
    pub(crate) fn new(engine: Arc<Engine<T>>) -> Self {
        Self {
            engine,
            guest: false,
            #[cfg(feature = "control")]
            control: Control::Off,
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
        }
    }
}

#[cfg(feature = "control")]
impl<T: Send + 'static> Owner<T> {
    pub(crate) fn with_control(mut self, control: Control) -> Self {
        self.control = control;
        self
    }

    fn guest(engine: Arc<Engine<T>>) -> Self {
        let mut guest = Self::new(engine);
        guest.guest = true;
        guest
    }

    /// Opens the socket for the unit's operator, unless it is open or the unit is being stopped.
    fn open_control(&self) {
        let mut server = lock(&self.server);
        // Dropping a server without stopping it would leak its threads.
        if server.is_none() && !self.engine.is_stopping() {
            let guest = Self::guest(self.engine.clone());
            *server = control::open(&self.control, CommunicationSystem::of(guest));
        }
    }
}

impl<T: Send + 'static> Drop for Owner<T> {
    fn drop(&mut self) {
        if !self.guest {
            self.stop();
        }
    }
}

impl<T: Send + 'static> Clone for CommunicationSystem<T> {
    fn clone(&self) -> Self {
        Self { owner: self.owner.clone() }
    }
}

/// A non-owning handle, for the unit's own handlers to call other nodes.
pub struct WeakSystem<T: Send + 'static = ()> {
    owner: Weak<Owner<T>>,
}

impl<T: Send + 'static> Clone for WeakSystem<T> {
    fn clone(&self) -> Self {
        Self { owner: self.owner.clone() }
    }
}

impl<T: Send + 'static> WeakSystem<T> {
    /// The unit, unless its last handle has been dropped.
    pub fn upgrade(&self) -> Option<CommunicationSystem<T>> {
        self.owner.upgrade().map(|owner| CommunicationSystem { owner })
    }
}

impl CommunicationSystem {
    /// An m_unit with defaults (paper, listing line 1).
    pub fn new(name: &str, id: u32) -> Result<Self, BuildError> {
        Self::builder(name, id)?.build_system()
    }

    /// An m_unit with other than defaults.
    pub fn builder(name: &str, id: u32) -> Result<Builder<()>, Error> {
        Ok(Builder::new(Identity::m_unit(name, id)?, Target::Everybody))
    }
}

impl<T: Send + 'static> CommunicationSystem<T> {
    pub(crate) fn of(owner: Owner<T>) -> Self {
        Self { owner: Arc::new(owner) }
    }

    pub(crate) fn engine(&self) -> &Arc<Engine<T>> {
        &self.owner.engine
    }

    #[cfg(feature = "control")]
    pub(crate) fn keys(&self) -> &crate::engine::Keys {
        self.engine().keys()
    }

    /// Searches for nodes and keeps connections, in threads of its own (paper, listing line 2).
    ///
    /// First it asks for its own identity and waits 300 ms: [`StartError::AlreadyRunning`] where a live m_unit answers.
    /// One that is stopped (`SIGSTOP`) or hangs does not answer; on this host it holds its control socket, which is
    /// [`StartError::SocketHeld`]. From one on another host, or without a socket, the links go to this one. See
    /// [`Builder::beside_another`].
    #[doc(alias = "start_thread")]
    pub fn start(&self) -> Result<(), StartError> {
        #[cfg(not(feature = "control"))]
        self.engine().start()?;
        #[cfg(feature = "control")]
        {
            self.engine().start_unless(|| control::held(&self.owner.control, &self.identity(), self.fleet()))?;
            self.owner.open_control();
        }
        Ok(())
    }

    /// Ends every link in an orderly way and all threads.
    pub fn stop(&self) {
        self.owner.stop();
    }

    /// Where it answers its operator; `None` if nowhere.
    #[cfg(feature = "control")]
    pub fn control_path(&self) -> Option<PathBuf> {
        lock(&self.owner.server).as_ref().map(|server| server.path().to_owned())
    }

    #[cfg(feature = "control")]
    pub(crate) fn operator_may(&self, function: &str, verb: Verb) -> Result<(), Error> {
        self.engine().operator_may(function, verb)
    }

    /// Whether what the operator has begun may go on.
    #[cfg(feature = "control")]
    pub(crate) fn operator_may_go_on(&self, function: &str) -> bool {
        self.engine().operator_may_go_on(function)
    }

    #[cfg(feature = "control")]
    pub(crate) fn operator_sees(&self, function: &str) -> bool {
        self.engine().operator_sees(function)
    }

    #[cfg(feature = "control")]
    pub(crate) fn is_stopped(&self) -> bool {
        self.engine().is_stopping()
    }

    /// A handle for the unit's own handlers. One that owned a [`CommunicationSystem`] would keep it running for ever.
    pub fn downgrade(&self) -> WeakSystem<T> {
        WeakSystem { owner: Arc::downgrade(&self.owner) }
    }

    /// This unit's identity.
    pub fn identity(&self) -> Identity {
        self.engine().hub().hub.node.identity().clone()
    }

    /// The fleet that it belongs to.
    pub fn fleet(&self) -> Fleet {
        self.engine().hub().hub.node.fleet()
    }

    /// Which of its runs this is: peers tell a restart by it.
    pub fn epoch(&self) -> Epoch {
        self.engine().hub().hub.node.epoch()
    }

    /// Time since it was made.
    pub fn uptime(&self) -> Duration {
        self.engine().uptime()
    }

    /// Whether its links are secured, with keys, or plain.
    pub fn mode(&self) -> Mode {
        self.engine().mode()
    }

    /// The UDP port of broadcasts.
    pub fn discovery_port(&self) -> u16 {
        self.engine().discovery_port()
    }

    /// The interfaces that it uses, with those that are down, as they were at most a few seconds ago.
    pub fn interfaces(&self) -> Vec<Interface> {
        self.engine().interfaces().to_vec()
    }

    /// The TCP port on which the unit takes connections, for s_units that are told a fixed address.
    pub fn tcp_port(&self) -> u16 {
        self.engine().tcp_port()
    }

    /// Searches for nodes now (paper, listing line 6).
    pub fn broadcast(&self) {
        self.engine().broadcast();
    }

    /// How many s_units are connected and have published their list (paper, listing line 3).
    #[doc(alias = "get_number_s_units")]
    pub fn number_of_s_units(&self) -> usize {
        self.number_of(Role::SUnit)
    }

    /// How many m_units are connected and have told what they offer.
    pub fn number_of_m_units(&self) -> usize {
        self.number_of(Role::MUnit)
    }

    fn number_of(&self, role: Role) -> usize {
        self.engine().peers().of_role(role).filter(|peer| peer.is_introduced()).count()
    }

    /// The s_units in the order in which they first published their list, then those that have not published it yet.
    /// One that has left keeps its place, so an index stays that of the same node once it has published.
    pub fn s_units(&self) -> Vec<Peer<T>> {
        self.of_role(Role::SUnit)
    }

    /// The m_units, likewise.
    pub fn m_units(&self) -> Vec<Peer<T>> {
        self.of_role(Role::MUnit)
    }

    fn of_role(&self, role: Role) -> Vec<Peer<T>> {
        self.engine().peers().of_role(role).map(|cell| self.peer(cell)).collect()
    }

    fn peer(&self, cell: &Arc<crate::engine::peers::PeerCell>) -> Peer<T> {
        Peer { engine: self.engine().clone(), cell: cell.clone() }
    }

    /// The s_unit of a name, connected or not. [`Error::NotConnected`] before it has joined; [`Error::Ambiguous`] where
    /// several s_units have that name, those included that the [roster](Self::roster) misses: the one that is here may not
    /// be the one that is meant. Ask by [identity](Self::node) then.
    pub fn s_unit(&self, name: &str) -> Result<Peer<T>, Error> {
        self.only(|identity| identity.role() == Role::SUnit && identity.name() == name)
    }

    /// The m_unit of a name, likewise.
    pub fn m_unit(&self, name: &str) -> Result<Peer<T>, Error> {
        self.only(|identity| identity.role() == Role::MUnit && identity.name() == name)
    }

    /// The node of an ID number, likewise.
    pub fn node_with_id(&self, id: u32) -> Result<Peer<T>, Error> {
        self.only(|identity| identity.id() == id)
    }

    /// The node of a name, an ID number and a role: `None` if it has neither joined nor stands on the [roster](Self::roster).
    pub fn node(&self, identity: &Identity) -> Option<Peer<T>> {
        self.engine().node_of(identity).map(|cell| self.peer(&cell))
    }

    /// The s_units that this manager is expected to have, connected or not: with keys those that its key file lists, in
    /// plain mode those that have joined since its start. [`Peer::retire`] takes one off.
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// for missing in depot.roster().iter().filter(|agv| !agv.is_connected()) {
    ///     eprintln!("{missing:?} is missing");
    /// }
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn roster(&self) -> Vec<Peer<T>> {
        self.engine().roster().iter().map(|cell| self.peer(cell)).collect()
    }

    /// The connected nodes at an IP address.
    pub fn nodes_at(&self, address: IpAddr) -> Vec<Peer<T>> {
        self.connected().filter(|peer| peer.address().is_some_and(|at| at.ip() == address)).collect()
    }

    /// The connected nodes that offer a function to this unit.
    pub fn nodes_offering(&self, function: &str) -> Vec<Peer<T>> {
        self.connected().filter(|peer| peer.their_function_list().contains(function)).collect()
    }

    fn only(&self, wanted: impl Fn(&Identity) -> bool) -> Result<Peer<T>, Error> {
        self.engine().only_node(wanted).map(|cell| self.peer(&cell))
    }

    /// Those of which a call to all has an outcome: the whole roster, and any other node that offers the function.
    pub(crate) fn asked_with_all(&self, function: &str) -> Vec<Peer<T>> {
        let mut asked = self.roster();
        let known: HashSet<_> = asked.iter().map(|peer| Arc::as_ptr(&peer.cell)).collect();
        let others = self.nodes_offering(function).into_iter();
        asked.extend(others.filter(|other| !known.contains(&Arc::as_ptr(&other.cell))));
        asked
    }

    fn connected(&self) -> impl Iterator<Item = Peer<T>> {
        let peers: Vec<_> = self.engine().peers().connected().map(|cell| self.peer(cell)).collect();
        peers.into_iter()
    }

    /// The unit's own functions.
    pub fn my_function_list(&self) -> MyFunctionList<'_, T> {
        MyFunctionList { engine: self.engine() }
    }

    /// Makes the unit's functions visible to all nodes, also to those that come later (paper, listing line 24).
    pub fn publish_my_function_list(&self) -> Result<(), Error> {
        self.engine().publish(None).map(|_| ())
    }

    /// As [`publish_my_function_list`](Self::publish_my_function_list), and returns when every connected node has read
    /// the list, or after `timeout` the nodes that have not.
    pub fn publish_and_wait(&self, timeout: impl Into<Duration>) -> Result<Vec<Identity>, Error> {
        let told = self.engine().publish(None)?;
        let missing = self.engine().await_acknowledgements(&told, timeout.into());
        Ok(missing.iter().filter_map(|link| link.peer.get()).map(|peer| peer.identity.clone()).collect())
    }

    /// Requests without waiting from every node, with an outcome for each: for each s_unit of the [roster](Self::roster),
    /// [`Error::NotConnected`] of one that is absent and [`Error::UnknownFunction`] of one that does not offer `function`;
    /// and for each m_unit that offers it.
    pub fn request_all(&self, function: &str, parameters: &ParametersView) -> Vec<(Peer<T>, Result<CallId, Error>)> {
        let peers = self.asked_with_all(function).into_iter();
        peers.map(|peer| (peer.clone(), peer.request(function, parameters))).collect()
    }

    /// Calls `function` of every node, all at the same time, and waits for all of them. There is an outcome for each, as of
    /// [`request_all`](Self::request_all).
    pub fn block_request_all<const BYTES: usize>(
        &self,
        function: &str,
        parameters: &Parameters<BYTES>,
        options: &RequestOptions,
    ) -> Vec<(Peer<T>, Result<Parameters<BYTES>, Error>)> {
        let peers = self.asked_with_all(function);
        let links = peers.iter().map(Peer::link).collect();
        let calls = self.engine().call_each(links, function, parameters, options);
        let each = peers.into_iter().zip(calls);
        each.map(|(peer, call)| {
            let mut results = parameters.clone();
            let outcome = call.and_then(|mut call| wait(|cx| call.poll(cx, &mut results)));
            (peer, outcome.map(|()| results))
        })
        .collect()
    }

    /// The constraints in force.
    pub fn constraints(&self) -> Constraints {
        *self.engine().hub().hub.node.constraints()
    }

    /// Changes the constraints; peers are told. [`Error::BadConstraint`] for values that this unit cannot hold.
    pub fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        builder::check(&constraints)?;
        self.engine().set_constraints(constraints)
    }

    /// Sets another access table, or none; in force when this returns. A file that the unit follows replaces it when it
    /// changes.
    pub fn set_access(&self, table: Option<AccessTable>) {
        self.engine().set_access(table);
    }

    /// The access table in force; without one, a joined node may do everything.
    pub fn access(&self) -> Option<Arc<AccessTable>> {
        self.engine().access()
    }

    /// Subscribes to events: joined, left, failed. A subscriber that does not keep up loses events.
    pub fn events(&self) -> Receiver<UnitEvent> {
        let (sender, receiver) = sync_channel(EVENTS);
        self.engine().subscribe(sender);
        receiver
    }

    /// Events with room for so many, and how many have found none since it was last set to 0.
    #[cfg(feature = "control")]
    pub(crate) fn events_with_losses(&self, room: usize) -> (Receiver<UnitEvent>, Arc<AtomicU64>) {
        let (sender, receiver) = sync_channel(room);
        (receiver, self.engine().subscribe(sender))
    }

    /// Runs `act` with the application's state.
    pub fn with_state<R>(&self, act: impl FnOnce(&mut T) -> R) -> Result<R, Error> {
        self.engine().with_state(act)
    }

    /// Frees unused message buffers, of which a few are otherwise kept for the next long messages.
    pub fn trim_buffers(&self) {
        self.engine().pool.shrink();
    }

    /// Everything that is counted for the unit as a whole: (name, number), zeros included. What happened in discovery and
    /// membership; on all links together, those that have ended included; in the port. The last seven
    /// (`AccessFileWrong`, `BuffersInUse`, `BuffersPeak`, `LinksOpen`, `NodesConnected`, `CallsHeld`, `CallsInFlight`) tell
    /// how it is now; no other ever goes back.
    pub fn counters(&self) -> Vec<(&'static str, u64)> {
        pairs(self.engine().readings())
    }

    /// Everything that is counted, for the unit and for each node that it knows, in the text form that Prometheus reads:
    /// see [`metrics`](crate::metrics).
    #[cfg(feature = "metrics")]
    pub fn metrics(&self) -> String {
        crate::metrics::text(self.engine(), &self.identity())
    }

    /// The last refusals, here or there.
    pub fn findings(&self) -> Vec<Finding> {
        self.engine().hub().hub.node.findings().cloned().collect()
    }

    /// Time since a refusal.
    pub fn age(&self, finding: &Finding) -> Duration {
        self.engine().now().since(finding.at)
    }
}

/// Unparks the thread that makes it.
pub(crate) fn thread_waker() -> Waker {
    struct Unpark(std::thread::Thread);
    impl Wake for Unpark {
        fn wake(self: Arc<Self>) {
            self.0.unpark();
        }
    }
    Waker::from(Arc::new(Unpark(std::thread::current())))
}

/// Blocks this thread until `poll` is ready.
pub(crate) fn wait<R>(mut poll: impl FnMut(&mut std::task::Context<'_>) -> Poll<R>) -> R {
    let waker = thread_waker();
    let mut cx = std::task::Context::from_waker(&waker);
    loop {
        if let Poll::Ready(result) = poll(&mut cx) {
            return result;
        }
        std::thread::park();
    }
}
