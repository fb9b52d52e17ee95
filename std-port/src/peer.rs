//! A node as this unit sees it.

use std::fmt;
use std::sync::Arc;

use cara_core::config::Constraints;
use cara_core::distribution::claim::Claim;
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::Function;
use cara_core::distribution::hello::{Limits, Manager};
use cara_core::distribution::identity::{Epoch, Identity};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{CloseReason, Error};
use cara_core::services::call::{Call, Caller, Dynamic};
use cara_core::services::lease::{ActuatorState, OrderOutcome, trace_id};
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use core::net::SocketAddr;

use crate::config;
#[cfg(feature = "control")]
use crate::control::protocol::{CipherInfo, DatagramsInfo, LinkInfo};
use crate::engine::clocks::ClockOffset;
use crate::engine::link::LinkCell;
use crate::engine::peer_cell::PeerCell;
use crate::engine::{Engine, pairs};
use crate::error::HandOverError;
use crate::growing::{CallParameters, bytes_of_results};

/// A node, connected or not. Stays valid when the node leaves, and works again when it comes back.
pub struct Peer<T: Send + 'static = ()> {
    pub(crate) engine: Arc<Engine<T>>,
    pub(crate) cell: Arc<PeerCell>,
}

impl<T: Send + 'static> Clone for Peer<T> {
    fn clone(&self) -> Self {
        Self { engine: self.engine.clone(), cell: self.cell.clone() }
    }
}

impl<T: Send + 'static> fmt::Debug for Peer<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.cell.identity)
    }
}

/// A copy of the functions that a node has published to this unit.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TheirFunctionList {
    functions: Vec<TheirFunction>,
}

impl TheirFunctionList {
    /// One line per function (paper, listing line 10).
    pub fn show_functions(&self) -> impl fmt::Display + '_ {
        self
    }

    /// The functions.
    pub fn iter(&self) -> std::slice::Iter<'_, TheirFunction> {
        self.functions.iter()
    }

    /// The names.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.iter().map(|function| function.definition.name())
    }

    /// Whether a function is among them.
    pub fn contains(&self, name: &str) -> bool {
        self.names().any(|known| known == name)
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.functions.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.functions.is_empty()
    }
}

impl fmt::Display for TheirFunctionList {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.iter().try_for_each(|function| writeln!(f, "{}", function.definition.signature()))
    }
}

impl<'l> IntoIterator for &'l TheirFunctionList {
    type Item = &'l TheirFunction;
    type IntoIter = std::slice::Iter<'l, TheirFunction>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

/// A function that a node has published to this unit.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct TheirFunction {
    /// Its name, arguments and results.
    pub definition: Definition,
    /// How it wants to be called.
    pub attributes: Attributes,
}

impl TheirFunction {
    fn of(function: Function<'_>) -> Self {
        Self { definition: function.signature.to_definition(), attributes: *function.attributes }
    }
}

impl<T: Send + 'static> Peer<T> {
    /// Its name, id and role.
    pub fn identity(&self) -> &Identity {
        &self.cell.identity
    }

    /// Its name.
    pub fn name(&self) -> &str {
        self.cell.identity.name()
    }

    /// Its ID number.
    pub fn id(&self) -> u32 {
        self.cell.identity.id()
    }

    /// Whether it is connected now.
    pub fn is_connected(&self) -> bool {
        self.cell.is_connected()
    }

    /// Takes it off the [roster](crate::CommunicationSystem::roster) until it joins again, or this unit is started again; `false`
    /// while it is connected.
    pub fn retire(&self) -> bool {
        self.cell.retire()
    }

    /// Whether it has been taken off the roster, and has not joined since.
    pub fn is_retired(&self) -> bool {
        self.cell.is_retired()
    }

    /// The other end of its link, while it is connected.
    pub fn address(&self) -> Option<SocketAddr> {
        self.cell.link().map(|link| link.lock().session.address())
    }

    /// How long it has been connected without a break; `None` while it is not.
    pub fn connected_for(&self) -> Option<Duration> {
        self.cell.connected_for().map(Into::into)
    }

    /// How long ago it left, and why; `None` while it is connected.
    pub fn left(&self) -> Option<(Duration, CloseReason)> {
        self.cell.left().map(|(ago, reason)| (ago.into(), reason))
    }

    /// How long ago the node was heard searching for this unit, and from where, while it is not connected and if that was after it
    /// left. `None` also where it was told this unit's address: it dials, and does not search.
    pub fn searched(&self) -> Option<(Duration, SocketAddr)> {
        self.cell.searched().map(|(ago, from)| (ago.into(), from))
    }

    /// The claim of the manager of this unit's name that it obeys instead, and where the node is: it refuses this unit until this one's
    /// claim is the higher one. `None` otherwise.
    pub fn under(&self) -> Option<(Claim, SocketAddr)> {
        let cell = self.engine.hub.lock();
        let known = cell.hub.node.node(self.identity())?;
        known.under().map(|claim| (claim, *known.address()))
    }

    /// Which of its runs is connected: it differs after each start of the node.
    pub fn epoch(&self) -> Option<Epoch> {
        self.cell.link().and_then(|link| link.lock().session.epoch())
    }

    /// The version of the protocol that is spoken with the node; `None` while it is not connected.
    pub fn version(&self) -> Option<u8> {
        self.cell.link().and_then(|link| link.lock().session.version())
    }

    /// What the node takes, as it last told; `None` while it is not connected.
    pub fn limits(&self) -> Option<Limits> {
        self.cell.link().and_then(|link| link.lock().session.hello().map(|hello| hello.limits))
    }

    /// The constraints in force towards this node: the unit's own, unless they were changed for it.
    pub fn constraints(&self) -> Constraints {
        let unit = *self.engine.hub.lock().hub.node.constraints();
        self.cell.constraints(unit)
    }

    /// Changes the time-out, the minimum interval and the calls that it may have here for this node alone. They stay when
    /// it leaves and comes back, also when the unit's own are changed later. [`Error::BadConstraint`] where any other
    /// constraint differs from the unit's: nodes share the unit's tables and buffers.
    pub fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        config::check(&constraints)?;
        self.engine.set_peer_constraints(&self.cell, constraints)
    }

    /// Measures a round trip of the protocol itself, with no function involved: what the network and the two ports take.
    /// [`Error::TimedOut`] when no answer comes in time.
    pub fn ping(&self, timeout: impl Into<Duration>) -> Result<Duration, Error> {
        self.engine.ping(&self.link()?, timeout.into())
    }

    /// How far the node's clock is from this manager's, while it is connected and where it [tells](crate::MyFunctionList::add_clock)
    /// that; `None` also at an s_unit, which does not ask. It is measured when the node has joined, and each minute;
    /// what is older than 4 minutes is not told.
    pub fn clock_offset(&self) -> Option<ClockOffset> {
        self.cell.clock_offset(self.engine.now())
    }

    /// Hands this vehicle over to another manager while nothing of it moves: it leaves this one, and is back within about ten seconds
    /// unless it has joined the other one there. Its latches and last orders stay with it. `Ok`: it has left; where it is now, the other
    /// manager knows. It stays there until that manager hands it over again, or [`forget_claims`](crate::control::forget_claims).
    ///
    /// [`HandOverError::Link`] with [`Error::TimedOut`]: it has not answered in time, or knows no hand-over, as boards
    /// without that feature. With
    /// [`Error::NotConnected`]: it was not there, or left before its answer came, and may be on its way.
    pub fn hand_over(&self, to: &Manager, timeout: impl Into<Duration>) -> Result<(), HandOverError> {
        self.engine.hand_over_to(&self.link()?, to, timeout.into())
    }

    pub(crate) fn link(&self) -> Result<Arc<LinkCell>, Error> {
        self.cell.link().ok_or(Error::NotConnected)
    }

    /// How its link is now, while it is connected.
    #[cfg(feature = "control")]
    pub(crate) fn link_info(&self) -> Option<LinkInfo> {
        let connected = self.cell.connected_for()?;
        let link = self.link().ok()?;
        let mut state = link.lock();
        Some(LinkInfo {
            silent_ms: state.session.silent_for(self.engine.now()).as_millis(),
            calls: state.session.calls_in_flight(),
            calls_here: state.session.calls_held(),
            queued_bytes: state.session.bytes_queued(),
            stream_ms: state.session.stream_silent_for(self.engine.now()).as_millis(),
            datagrams: datagrams(state.session.hears_datagrams(), state.session.is_heard(), connected),
            segment: link.stream.segment(),
            cipher: state.session.cipher().suite().map(CipherInfo::of),
        })
    }

    /// What the node has published to this unit; empty while it is not connected.
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// for function in &depot.s_unit("agv")?.their_function_list() {
    ///     println!("{}: lease {:?}", function.definition.signature(), function.attributes.lease);
    /// }
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn their_function_list(&self) -> TheirFunctionList {
        let Ok(link) = self.link() else { return TheirFunctionList::default() };
        let state = link.lock();
        TheirFunctionList { functions: state.session.their_function_list().iter().map(TheirFunction::of).collect() }
    }

    /// One of the functions that it has published to this unit.
    pub fn function(&self, name: &str) -> Option<TheirFunction> {
        let link = self.link().ok()?;
        let state = link.lock();
        state.session.their_function_list().named(name).map(TheirFunction::of)
    }

    /// Whether it has published a function to this unit.
    pub(crate) fn offers(&self, function: &str) -> bool {
        self.link().is_ok_and(|link| link.lock().session.their_function_list().named(function).is_some())
    }

    /// Waits until the node has published `function`; `false` after `timeout`, or when this unit is stopped.
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// let agv = depot.s_unit("agv")?;
    /// assert!(agv.wait_for_function("go_to", std::time::Duration::from_secs(5)), "{agv:?} cannot drive");
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn wait_for_function(&self, function: &str, timeout: impl Into<Duration>) -> bool {
        let deadline = self.engine.now() + timeout.into();
        // Counted before the look: what comes after it ends the wait.
        let mut seen = self.engine.news.count();
        while !self.offers(function) {
            let left = deadline.since(self.engine.now());
            if left == Duration::ZERO || self.engine.is_stopping() {
                return false;
            }
            seen = self.engine.news.wait(seen, left);
        }
        true
    }

    /// A call of a function by name, whose results update `parameters`: `.wait()` for threads, `.await` for tasks, or `.send()`
    /// without waiting for results. Nothing happens before.
    ///
    /// On an error the parameters are unchanged, and what the call started, or would start, stops if its service has a lease.
    ///
    /// ```no_run
    /// use cara_std::{Duration, Parameters};
    /// use std::ops::ControlFlow;
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// let agv = depot.s_unit("agv")?;
    /// let heart = depot.heart(Duration::from_millis(100));
    ///
    /// let mut position = Parameters::new();
    /// position.add_int("position", 2)?;
    /// agv.call("pos_info", &mut position).timeout(Duration::from_millis(200)).wait()?;
    ///
    /// let going = agv.call("go_to", &mut position).renewing(heart.renew()).watch(|progress| {
    ///     match progress.variable::<f64>("left") {
    ///         Ok(left) if left > 100.0 => ControlFlow::Break(()),
    ///         _ => ControlFlow::Continue(()),
    ///     }
    /// });
    /// let order = going.hold().wait()?;
    /// // …
    /// drop(order); // The vehicle stops.
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    pub fn call<'c>(
        &'c self,
        function: &'c str,
        parameters: &'c mut (impl CallParameters + ?Sized),
    ) -> Call<'c, Self, Dynamic<'c>> {
        Call::new(self, Dynamic::new(function, self.with_room(function, parameters)))
    }

    /// Calls a function and waits for its results, which update `parameters` (paper, listing line 13): [`call`](Self::call) with
    /// the default options.
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// let mut pos = cara_std::Parameters::new();
    /// pos.add_int("position", 2)?;
    /// depot.s_unit("agv")?.block_request("pos_info", &mut pos)?;
    /// let [x, y]: [i64; 2] = pos.variable("position")?;
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    #[doc(alias = "block_request_their_function")]
    pub fn block_request(&self, function: &str, parameters: &mut (impl CallParameters + ?Sized)) -> Result<(), Error> {
        Ok(self.call(function, parameters).wait()?)
    }

    /// The parameters of a call, with room for its results where they grow.
    pub(crate) fn with_room<'p>(
        &self,
        function: &str,
        parameters: &'p mut (impl CallParameters + ?Sized),
    ) -> &'p mut ParametersView {
        parameters.make_room(|| {
            let link = self.link().ok()?;
            let state = link.lock();
            let signature = state.session.their_function_list().named(function)?.signature;
            Some(bytes_of_results(signature.results(), state.session.constraints().message_size))
        });
        parameters.view_mut()
    }

    /// What has become of the newest call of a leased function by this unit, as the node tells after it has joined again: for
    /// one whose reply was lost, as with [`Error::Interrupted`]. Calls of [operators](RequestOptions::operator) do not count.
    /// [`OrderOutcome::Unknown`] while it is not connected.
    ///
    /// ```no_run
    /// use cara_std::{Error, OrderOutcome, Parameters};
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// let agv = depot.s_unit("agv")?;
    ///
    /// if agv.block_request("go_to", &mut Parameters::new()) == Err(Error::Interrupted) {
    ///     agv.wait_for_function("go_to", std::time::Duration::from_secs(10));
    ///     match agv.outcome_of("go_to") {
    ///         OrderOutcome::Ended(how) => println!("it began, and is over: {}", how.word()),
    ///         OrderOutcome::NotStarted => println!("it did not move"),
    ///         outcome => println!("look where it is: {outcome:?}"),
    ///     }
    /// }
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn outcome_of(&self, function: &str) -> OrderOutcome {
        let order = self.cell.last_order(function);
        let outcome =
            order.zip(self.actuator_state(function)).map(|((link, call), state)| state.outcome_of(link, call.0));
        outcome.unwrap_or(OrderOutcome::Unknown)
    }

    /// The trace id of this unit's newest call of a leased function, as [`LastOrder::trace`](crate::LastOrder::trace) has it in the
    /// node's [state](Self::actuator_state): for the program's own record, by which it knows its orders again after a start.
    /// `None` before the first. Calls of [operators](RequestOptions::operator) do not count.
    pub fn trace_of(&self, function: &str) -> Option<u64> {
        self.cell.last_order(function).map(|(link, call)| trace_id(link, call.0))
    }

    /// The state of what a function of the node moves: what inhibits it, and the order that it has or had last, as the node
    /// tells when it joins, and within a keep-alive interval after a change. `None` while it is not
    /// connected, and as long as it has nothing to tell.
    pub fn actuator_state(&self, function: &str) -> Option<ActuatorState> {
        let link = self.link().ok()?;
        let state = link.lock();
        let slot = state.session.their_function_list().named(function)?.slot;
        state.actuators.get(&slot).copied()
    }

    /// How long what calls of this unit have started at the node goes on if no more renewal gets there; `None` where nothing is
    /// renewed.
    ///
    /// It is the length of the lease, counted from when the node's last answer to a renewal came, or else from the request. The
    /// node counts from when the renewal was made, and an answer does not say which one it is for: while the way back holds
    /// answers up, this is too long by as much as they are late, and too short by what renewals that got there have added since.
    /// What bounds a motion is the lease itself, which the node keeps.
    pub fn lease_left(&self, function: &str) -> Option<Duration> {
        let link = self.link().ok()?;
        let state = link.lock();
        let slot = state.session.their_function_list().named(function)?.slot;
        state.session.lease_left(self.engine.now(), slot)
    }

    /// Calls a function without waiting (paper, listing line 19): accepted, not sent, not executed. A failure comes as
    /// [`UnitEvent::RequestFailed`](crate::UnitEvent::RequestFailed) under the returned id.
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// let call = depot.s_unit("agv")?.request("blink", &cara_std::Parameters::new())?;
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    #[doc(alias = "request_their_function")]
    pub fn request(&self, function: &str, parameters: &ParametersView) -> Result<CallId, Error> {
        Ok(self.send(function.into(), parameters, &RequestOptions::new())?)
    }

    /// Gives up the leases that calls of `function` have begun or will begin: what they started stops, and what has not
    /// begun does not begin.
    pub fn release(&self, function: &str) -> Result<(), Error> {
        let link = self.link()?;
        let mut state = link.lock();
        let slot = state.session.their_function_list().find(function).ok_or(Error::UnknownFunction)?;
        let released = self.engine.with(&link, &mut state, |session, cx| session.release(cx, slot));
        self.engine.settle(&link, state);
        released
    }

    /// Sends one-way messages that gather now.
    pub fn flush(&self) -> Result<(), Error> {
        self.engine.on_link(&self.link()?, |session, cx| session.flush_gathered(cx));
        Ok(())
    }

    /// Makes the unit's functions visible to this node only (paper, listing line 23); survives its reconnection.
    pub fn publish_my_function_list(&self) -> Result<(), Error> {
        self.engine.publish(Some(&self.cell.identity)).map(|_| ())
    }

    /// As [`publish_my_function_list`](Self::publish_my_function_list), and returns when the node has read the list;
    /// [`Error::TimedOut`] otherwise.
    pub fn publish_and_wait(&self, timeout: impl Into<Duration>) -> Result<(), Error> {
        let reported = self.engine.publish(Some(&self.cell.identity))?;
        match self.engine.await_acknowledgements(&reported, timeout.into()).is_empty() {
            true => Ok(()),
            false => Err(Error::TimedOut),
        }
    }

    /// What happened on its links, the earlier ones included: (name, count), zeros included.
    pub fn counters(&self) -> Vec<(&'static str, u64)> {
        pairs(self.engine.accounts.of_peer(&self.cell))
    }
}

/// A node that has been connected for less may not have reported yet that datagrams arrive there.
#[cfg(feature = "control")]
const REPORTED: std::time::Duration = std::time::Duration::from_secs(3);

/// Where datagrams pass, as far as that is known `connected` after the node has joined.
#[cfg(feature = "control")]
fn datagrams(hears: Option<bool>, is_heard: bool, connected: std::time::Duration) -> Option<DatagramsInfo> {
    let is_reported = is_heard || connected >= REPORTED;
    Some(match (hears?, is_heard) {
        (true, true) => DatagramsInfo::Pass,
        (true, false) => DatagramsInfo::ToUnit,
        (false, true) => DatagramsInfo::ToNode,
        (false, false) => DatagramsInfo::None,
    })
    .filter(|_| is_reported)
}

#[cfg(all(test, feature = "control"))]
mod tests {
    use super::*;

    #[test]
    fn what_a_fresh_node_has_not_reported_is_not_known() {
        let fresh = REPORTED - std::time::Duration::from_millis(1);
        assert_eq!(datagrams(Some(true), false, fresh), None);
        assert_eq!(datagrams(Some(false), false, fresh), None);
        assert_eq!(datagrams(Some(true), true, fresh), Some(DatagramsInfo::Pass));
        assert_eq!(datagrams(Some(false), true, fresh), Some(DatagramsInfo::ToNode));
        assert_eq!(datagrams(Some(true), false, REPORTED), Some(DatagramsInfo::ToUnit));
        assert_eq!(datagrams(None, true, REPORTED), None);
    }
}
