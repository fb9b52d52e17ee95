//! The paper's `Communication_System`: an m_unit, which connects to many nodes.

use std::collections::HashSet;
use std::fmt;
#[cfg(feature = "control")]
use std::path::PathBuf;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, Wake, Waker};

use cara_core::distribution::connection_handler::Target;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::error::Error;
#[cfg(feature = "control")]
use cara_core::services::access::Verb;
use cara_core::services::call::Caller;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use core::net::IpAddr;

use crate::builder::{BuildError, Builder};
use crate::engine::CallsToAll;
use crate::error::CallError;
use crate::growing::CallParameters;
use crate::handle::{Handle, MUnit, WeakHandle};
#[cfg(feature = "control")]
use crate::locks::lock;
use crate::peer::Peer;

/// An m_unit, which connects to many nodes.
#[doc(alias = "Communication_System")]
pub type CommunicationSystem<T = ()> = Handle<T, MUnit>;

/// A handle to an m_unit that does not keep it running.
pub type WeakSystem<T = ()> = WeakHandle<T, MUnit>;

impl CommunicationSystem {
    /// An m_unit with defaults (paper, listing line 1).
    pub fn new(name: &str, id: u32) -> Result<Self, BuildError> {
        Self::builder(name, id)?.build()
    }

    /// An m_unit with other than defaults.
    ///
    /// ```no_run
    /// use cara_std::{CommunicationSystem, Interfaces};
    ///
    /// let depot = CommunicationSystem::builder("depot", 1)?.fleet(7).interfaces(Interfaces::Loopback).build()?;
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn builder(name: &str, id: u32) -> Result<Builder<(), MUnit>, BuildError> {
        Ok(Builder::new(Identity::m_unit(name, id)?, Target::Everybody))
    }
}

impl<T: Send + 'static> CommunicationSystem<T> {
    #[cfg(feature = "control")]
    pub(crate) fn keys(&self) -> &crate::engine::Keys {
        self.engine().keys()
    }

    /// Where it answers its operator; `None` if nowhere.
    #[cfg(feature = "control")]
    pub fn control_path(&self) -> Option<PathBuf> {
        lock(&self.owner.server).as_ref()?.path()
    }

    /// Shows operators a log at the [control socket](crate::control): `cara logs`, the page and recordings have it. The first one
    /// counts. Each reader has what is kept of it, the newest 16 KiB; one that is slow loses lines, and sees how many bytes.
    #[cfg(feature = "control")]
    pub fn show_log(&self, log: &crate::Log) {
        let _ = self.engine().log().set(log.clone());
    }

    #[cfg(feature = "control")]
    pub(crate) fn operator_may(&self, function: &str, verb: Verb) -> Result<(), Error> {
        let engine = self.engine();
        engine.guard.operator_may(&engine.links, engine.now(), function, verb)
    }

    /// Whether what the operator has begun may go on.
    #[cfg(feature = "control")]
    pub(crate) fn operator_may_go_on(&self, function: &str) -> bool {
        self.engine().guard.operator_may_go_on(function)
    }

    #[cfg(feature = "control")]
    pub(crate) fn operator_sees(&self, function: &str) -> bool {
        self.engine().guard.operator_sees(function)
    }

    #[cfg(feature = "control")]
    pub(crate) fn is_stopped(&self) -> bool {
        self.engine().is_stopping()
    }

    /// The TCP port on which the unit takes connections, for s_units that are told a fixed address.
    pub fn tcp_port(&self) -> u16 {
        self.engine().sockets.tcp_port()
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
        self.engine().nodes.read().of_role(role).filter(|peer| peer.is_introduced()).count()
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
        self.engine().nodes.read().of_role(role).map(|cell| self.peer_of(cell)).collect()
    }

    fn peer_of(&self, cell: &Arc<crate::engine::peer_cell::PeerCell>) -> Peer<T> {
        Peer { engine: self.engine().clone(), cell: cell.clone() }
    }

    /// The node of a name, whatever its role, likewise.
    pub fn peer(&self, name: &str) -> Result<Peer<T>, Error> {
        self.only(|identity| identity.name() == name)
    }

    /// The s_unit of a name, connected or not. [`Error::NotConnected`] before it has joined; [`Error::Ambiguous`] where
    /// several s_units have that name, those included that the [roster](Self::roster) misses: the one that is here may not
    /// be the one that is meant. Ask by [identity](Self::node) then.
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// let agv = depot.s_unit("agv-07")?;
    /// println!("{agv:?} is at {:?}", agv.address());
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn s_unit(&self, name: &str) -> Result<Peer<T>, Error> {
        self.only(|identity| identity.role() == Role::SUnit && identity.name() == name)
    }

    /// The s_unit of a name, once it is connected and has told what it offers; [`Error::TimedOut`] after `timeout`,
    /// [`Error::Ambiguous`] where several have that name.
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// depot.start()?;
    /// let agv = depot.wait_for_s_unit("agv-07", std::time::Duration::from_secs(30))?;
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn wait_for_s_unit(&self, name: &str, timeout: impl Into<Duration>) -> Result<Peer<T>, Error> {
        let engine = self.engine();
        let deadline = engine.now() + timeout.into();
        // Counted before the look: what comes after it ends the wait.
        let mut seen = engine.news.count();
        loop {
            if let Some(found) = self.s_unit_here(name) {
                return found;
            }
            let left = deadline.since(engine.now());
            if engine.is_stopping() {
                return Err(Error::NotRunning);
            }
            if left == Duration::ZERO {
                return Err(Error::TimedOut);
            }
            seen = engine.news.wait(seen, left);
        }
    }

    /// The s_unit of a name if it is connected and has told what it offers, or why none can be meant.
    pub(crate) fn s_unit_here(&self, name: &str) -> Option<Result<Peer<T>, Error>> {
        match self.s_unit(name) {
            Ok(peer) => peer.cell.is_introduced().then_some(Ok(peer)),
            Err(Error::NotConnected) => None,
            Err(error) => Some(Err(error)),
        }
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
        self.engine().nodes.of(self.engine().keys(), identity).map(|cell| self.peer_of(&cell))
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
        self.engine().nodes.roster(self.engine().keys()).iter().map(|cell| self.peer_of(cell)).collect()
    }

    /// The connected nodes at an IP address.
    pub fn nodes_at(&self, address: IpAddr) -> Vec<Peer<T>> {
        self.connected().filter(|peer| peer.address().is_some_and(|at| at.ip() == address)).collect()
    }

    /// The connected nodes that offer a function to this unit.
    pub fn nodes_offering(&self, function: &str) -> Vec<Peer<T>> {
        self.connected().filter(|peer| peer.offers(function)).collect()
    }

    fn only(&self, wanted: impl Fn(&Identity) -> bool) -> Result<Peer<T>, Error> {
        self.engine().nodes.only(self.engine().keys(), wanted).map(|cell| self.peer_of(&cell))
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
        let peers: Vec<_> = self.engine().nodes.read().connected().map(|cell| self.peer_of(cell)).collect();
        peers.into_iter()
    }

    /// Passes on a stream of a node to this unit's other nodes, as a stream of its own called `node/stream`, until the returned
    /// guard is dropped: however many read it, the node's link has one subscription, at least `interval` apart. Ages
    /// count from when the value was made, passing on included. It is seen once this unit's list is
    /// [published](Self::publish_my_function_list). The errors are those of [`Peer::stream`] and
    /// [`MyFunctionList::add_stream`](crate::MyFunctionList::add_stream), and [`Error::BadName`] where the name is too long.
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// use cara_std::Duration;
    ///
    /// let relay = depot.relay_stream("agv-07", "pose", Duration::from_millis(200))?;
    /// depot.publish_my_function_list()?;
    /// # drop(relay);
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn relay_stream(
        &self,
        node: &str,
        stream: &str,
        interval: impl Into<Duration>,
    ) -> Result<crate::stream::Relay<T>, Error> {
        let peer = self.s_unit(node).or_else(|_| self.m_unit(node))?;
        crate::stream::Relay::new(&peer, stream, interval.into())
    }

    /// Makes the unit's functions visible to all nodes, also to those that come later (paper, listing line 24).
    pub fn publish_my_function_list(&self) -> Result<(), Error> {
        self.engine().publish(None).map(|_| ())
    }

    /// As [`publish_my_function_list`](Self::publish_my_function_list), and returns when every connected node has read
    /// the list, or after `timeout` the nodes that have not.
    pub fn publish_and_wait(&self, timeout: impl Into<Duration>) -> Result<Vec<Identity>, Error> {
        let reported = self.engine().publish(None)?;
        let missing = self.engine().await_acknowledgements(&reported, timeout.into());
        Ok(missing.iter().filter_map(|link| link.peer.get()).map(|peer| peer.identity.clone()).collect())
    }

    /// A call of `function` of every node, all at the same time: `.wait()`, `.await` or `.send()`. There is an outcome for each
    /// s_unit of the [roster](Self::roster), [`Error::NotConnected`] of one that is absent and [`Error::UnknownFunction`] of one that
    /// does not offer `function`; and for each m_unit that offers it.
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// for (agv, outcome) in depot.call_all("stop", &cara_std::Parameters::new()).wait() {
    ///     if let Err(error) = outcome {
    ///         eprintln!("{agv:?} did not stop: {error}");
    ///     }
    /// }
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub const fn call_all<'c, P: CallParameters + ?Sized>(
        &'c self,
        function: &'c str,
        parameters: &'c P,
    ) -> CallToAll<'c, T, P> {
        CallToAll { system: self, function, parameters, options: RequestOptions::new() }
    }
}

/// A call of every node, which has not been sent: [`CommunicationSystem::call_all`].
#[must_use = "nothing is sent before `.wait()`, `.await` or `.send()`"]
pub struct CallToAll<'c, T: Send + 'static, P: ?Sized> {
    system: &'c CommunicationSystem<T>,
    function: &'c str,
    parameters: &'c P,
    options: RequestOptions,
}

impl<T: Send + 'static, P: ?Sized> fmt::Debug for CallToAll<'_, T, P> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("CallToAll").field("function", &self.function).finish_non_exhaustive()
    }
}

impl<T: Send + 'static, P: CallParameters + ?Sized> CallToAll<'_, T, P> {
    /// With these options.
    pub const fn with(self, options: RequestOptions) -> Self {
        Self { options, ..self }
    }

    /// Requests without waiting.
    pub fn send(self) -> Vec<(Peer<T>, Result<CallId, CallError>)> {
        let (callee, parameters) = (self.function.into(), self.parameters.view());
        let peers = self.system.asked_with_all(self.function).into_iter();
        peers.map(|peer| (peer.clone(), peer.send(callee, parameters, &self.options))).collect()
    }

    /// Calls and waits for all of them.
    pub fn wait(self) -> Vec<(Peer<T>, Result<P, CallError>)>
    where
        P: Clone,
    {
        let mut replies = self.into_future();
        wait(|cx| Pin::new(&mut replies).poll(cx))
    }
}

impl<'c, T: Send + 'static, P: CallParameters + Clone> IntoFuture for CallToAll<'c, T, P> {
    type Output = Vec<(Peer<T>, Result<P, CallError>)>;
    type IntoFuture = RepliesOfAll<'c, T, P>;

    fn into_future(self) -> Self::IntoFuture {
        let Self { system, function, parameters, options } = self;
        let peers = system.asked_with_all(function);
        let mut results = vec![parameters.clone(); peers.len()];
        for (peer, results) in peers.iter().zip(&mut results) {
            peer.with_room(function, results);
        }
        let calls = CallsToAll::new(system.engine(), peers.iter().map(Peer::link), function, options);
        RepliesOfAll { function, peers, calls: Some(calls), results }
    }
}

/// What a [`CallToAll`] is while it is awaited. Dropped before it has ended, those calls that have not are given up.
pub struct RepliesOfAll<'c, T: Send + 'static, P> {
    function: &'c str,
    peers: Vec<Peer<T>>,
    calls: Option<CallsToAll<T>>,
    results: Vec<P>,
}

impl<T: Send + 'static, P> fmt::Debug for RepliesOfAll<'_, T, P> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("RepliesOfAll").field("function", &self.function).finish_non_exhaustive()
    }
}

/// Nothing in it is ever pinned.
impl<T: Send + 'static, P> Unpin for RepliesOfAll<'_, T, P> {}

impl<T: Send + 'static, P: CallParameters> Future for RepliesOfAll<'_, T, P> {
    type Output = Vec<(Peer<T>, Result<P, CallError>)>;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let Self { function, peers, calls, results } = &mut *self;
        if calls.as_mut().is_some_and(|calls| calls.poll(cx, function, results).is_pending()) {
            return Poll::Pending;
        }
        let ended = calls.take().into_iter().flat_map(CallsToAll::into_outcomes);
        let outcomes = std::mem::take(peers).into_iter().zip(ended).zip(std::mem::take(results));
        Poll::Ready(outcomes.map(|((peer, ended), results)| (peer, ended.map(|()| results))).collect())
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
