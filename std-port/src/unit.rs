//! The paper's `Unit`: an s_unit, which connects to one m_unit, its manager.

use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Weak};

use cara_core::config::{Constraints, Mode};
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::requests::CallId;
use cara_core::time::Duration;

use crate::access::AccessTable;
use crate::builder::{self, BuildError, Builder, manager};
use crate::communication_system::Owner;
use crate::engine::{Engine, pairs};
use crate::error::StartError;
use crate::event::UnitEvent;
use crate::my_function_list::MyFunctionList;
use crate::peer::Peer;
use crate::sys::interfaces::Interface;

/// Events that wait for a subscriber before it loses some.
const EVENTS: usize = 256;

/// An s_unit. Clones are handles to the same unit, which stops when the last one is dropped.
pub struct Unit<T: Send + 'static = ()> {
    owner: Arc<Owner<T>>,
}

impl<T: Send + 'static> Clone for Unit<T> {
    fn clone(&self) -> Self {
        Self { owner: self.owner.clone() }
    }
}

/// A handle that does not keep the unit running: what a handler of the unit itself holds to call its manager.
pub struct WeakUnit<T: Send + 'static = ()> {
    owner: Weak<Owner<T>>,
}

impl<T: Send + 'static> Clone for WeakUnit<T> {
    fn clone(&self) -> Self {
        Self { owner: self.owner.clone() }
    }
}

impl<T: Send + 'static> WeakUnit<T> {
    /// The unit, unless its last handle has been dropped.
    pub fn upgrade(&self) -> Option<Unit<T>> {
        self.owner.upgrade().map(|owner| Unit { owner })
    }
}

impl Unit {
    /// An s_unit with defaults, which joins the manager of the given name and id and no other.
    pub fn new(name: &str, id: u32, manager_name: &str, manager_id: u32) -> Result<Self, BuildError> {
        Self::builder(name, id, manager_name, manager_id)?.build_unit()
    }

    /// An s_unit with other than defaults.
    pub fn builder(name: &str, id: u32, manager_name: &str, manager_id: u32) -> Result<Builder<()>, Error> {
        Ok(Builder::new(Identity::s_unit(name, id)?, manager(manager_name, manager_id)?))
    }
}

impl<T: Send + 'static> Unit<T> {
    pub(crate) fn of(owner: Owner<T>) -> Self {
        Self { owner: Arc::new(owner) }
    }

    pub(crate) fn engine(&self) -> &Arc<Engine<T>> {
        &self.owner.engine
    }

    /// Looks for the manager and keeps the connection, in threads of its own.
    #[doc(alias = "start_thread")]
    pub fn start(&self) -> Result<(), StartError> {
        self.engine().start()
    }

    /// Ends the link in an orderly way and all threads.
    pub fn stop(&self) {
        self.engine().stop();
    }

    /// A handle for the unit's own handlers. One that owned a [`Unit`] would keep it running for ever.
    pub fn downgrade(&self) -> WeakUnit<T> {
        WeakUnit { owner: Arc::downgrade(&self.owner) }
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

    /// The manager, once it has been met.
    pub fn manager(&self) -> Option<Peer<T>> {
        let peers = self.engine().peers();
        let cell = peers.of_role(Role::MUnit).next().cloned();
        cell.map(|cell| Peer { engine: self.engine().clone(), cell })
    }

    /// Whether the manager is connected.
    pub fn is_connected(&self) -> bool {
        self.manager().is_some_and(|manager| manager.is_connected())
    }

    /// Calls a function of the manager and waits for its results.
    #[doc(alias = "block_request_their_function")]
    pub fn block_request(&self, function: &str, parameters: &mut ParametersView) -> Result<(), Error> {
        self.manager().ok_or(Error::NotConnected)?.block_request(function, parameters)
    }

    /// Calls a function of the manager without waiting.
    #[doc(alias = "request_their_function")]
    pub fn request(&self, function: &str, parameters: &ParametersView) -> Result<CallId, Error> {
        self.manager().ok_or(Error::NotConnected)?.request(function, parameters)
    }

    /// The unit's own functions.
    pub fn my_function_list(&self) -> MyFunctionList<'_, T> {
        MyFunctionList { engine: self.engine() }
    }

    /// Makes the unit's functions visible to its manager, now or when it comes.
    pub fn publish_my_function_list(&self) -> Result<(), Error> {
        self.engine().publish(None).map(|_| ())
    }

    /// Looks for the manager now.
    pub fn broadcast(&self) {
        self.engine().broadcast();
    }

    /// Runs `hook` each time the manager is lost, once, with the application's state, for which it may have to wait: what
    /// makes safe belongs into the hook of a [lease](crate::ServiceOptions::lease). [`Error::Network`] when the system
    /// refuses the thread that it runs on.
    pub fn on_manager_lost(&self, hook: impl Fn(&mut T) + Send + Sync + 'static) -> Result<(), Error> {
        self.engine().on_lost(Arc::new(hook))
    }

    /// Runs `act` with the application's state.
    pub fn with_state<R>(&self, act: impl FnOnce(&mut T) -> R) -> Result<R, Error> {
        self.engine().with_state(act)
    }

    /// The constraints in force.
    pub fn constraints(&self) -> Constraints {
        *self.engine().hub().hub.node.constraints()
    }

    /// Changes the constraints; the manager is told.
    pub fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        builder::check(&constraints)?;
        self.engine().set_constraints(constraints)
    }

    /// Another access table, or none: in force when this returns. A file that the unit follows is taken over again when it
    /// changes.
    pub fn set_access(&self, table: Option<AccessTable>) {
        self.engine().set_access(table);
    }

    /// The access table in force; without one each node that has joined may do everything.
    pub fn access(&self) -> Option<Arc<AccessTable>> {
        self.engine().access()
    }

    /// What no call returns: joined, left, failed. A subscriber that does not keep up loses events.
    pub fn events(&self) -> Receiver<UnitEvent> {
        let (sender, receiver) = sync_channel(EVENTS);
        self.engine().subscribe(sender);
        receiver
    }

    /// The keys of links that this unit opens from here on are renewed this often, instead of every 12 h; once. So a test
    /// need not wait for so long.
    #[doc(hidden)]
    pub fn renew_keys_every(&self, span: cara_core::time::Duration) {
        self.engine().key_watch.renew_every(span);
    }

    /// Everything that is counted for the unit as a whole: (name, number), zeros included. What happened in discovery and
    /// membership; on all links together, those that have ended included; in the port. The last six (`BuffersInUse`,
    /// `BuffersPeak`, `LinksOpen`, `NodesConnected`, `CallsHeld`, `CallsInFlight`) tell how it is now; no other ever goes
    /// back.
    pub fn counters(&self) -> Vec<(&'static str, u64)> {
        pairs(self.engine().readings())
    }

    /// Everything that is counted, for the unit and for each node that it knows, in the text form that Prometheus reads:
    /// see [`metrics`](crate::metrics).
    #[cfg(feature = "metrics")]
    pub fn metrics(&self) -> String {
        crate::metrics::text(self.engine(), &self.identity())
    }
}
