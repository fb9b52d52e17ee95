//! Requests of a unit: the paper's two forms, to one node and to all, and the leases that they hold.

use std::task::Poll;

use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;

use super::handle::{Peer, UnitHandle};
use super::replies::{CallError, Newest, Promise, Waiting};
use super::service::{BoxedParameters, LeaseWatch, boxed_parameters};
use crate::event::StreamId;

impl UnitHandle {
    /// The paper's asynchronous request: returns at once, and leaves the parameters as they are.
    pub fn request(&self, peer: impl Into<Peer>, function: &str, parameters: &ParametersView) -> Result<CallId, Error> {
        self.request_with(peer, function, parameters, RequestOptions::default())
    }

    /// As [`Self::request`], with options.
    pub fn request_with(
        &self,
        peer: impl Into<Peer>,
        function: &str,
        parameters: &ParametersView,
        options: RequestOptions,
    ) -> Result<CallId, Error> {
        let index = self.link_to(&peer.into())?;
        let requested = self
            .machine(|machine, network| machine.links.request(network, index, function, parameters, &options, None))?;
        self.work(index);
        requested
    }

    /// The asynchronous request to all, with an outcome for each: each s_unit that has joined, connected or not, and each
    /// m_unit that offers the function.
    pub fn request_all(&self, function: &str, parameters: &ParametersView) -> Vec<(Identity, Result<CallId, Error>)> {
        self.asked_with_all(function)
            .into_iter()
            .map(|peer| (peer.clone(), self.request(&peer, function, parameters)))
            .collect()
    }

    /// The paper's synchronous request: waits for the reply, which updates the parameters; on an error they are
    /// unchanged. Waits inside the deadline for the minimum interval to pass.
    pub async fn block_request(
        &self,
        peer: impl Into<Peer>,
        function: &str,
        parameters: &mut ParametersView,
    ) -> Result<(), Error> {
        self.block_request_with(peer, function, parameters, RequestOptions::default()).await
    }

    /// As [`Self::block_request`], with options.
    pub async fn block_request_with(
        &self,
        peer: impl Into<Peer>,
        function: &str,
        parameters: &mut ParametersView,
        options: RequestOptions,
    ) -> Result<(), Error> {
        let peer = peer.into();
        let timeout = options.timeout.unwrap_or(self.constraints()?.request_timeout);
        let deadline = self.now() + timeout;
        let index = self.link_to(&peer)?;
        let made = self.machine(|machine, network| machine.links.with(network, index, |session, _| session.make()))?;
        loop {
            let options = RequestOptions { timeout: Some(deadline.since(self.now())), made, ..options };
            match self.call(&peer, function, parameters, &options) {
                Ok(call) => {
                    let results = call.results().await.map_err(|failed| failed.error)?;
                    return parameters.copy_from(&results);
                }
                Err(Error::TooSoon { wait }) if self.now() + wait < deadline => self.sleep(wait).await,
                Err(error) => return Err(error),
            }
        }
    }

    /// A call that is watched: what it tells while it runs, and why it fails. Given up with what this returns.
    ///
    /// ```no_run
    /// # async fn run(unit: cara_sim::UnitHandle) -> Result<(), Box<dyn std::error::Error>> {
    /// let options = cara_core::services::session::RequestOptions::default();
    /// let mut call = unit.watch("agv", "go_to", &cara_core::distribution::parameters::Parameters::new(), options)?;
    /// while let Some(progress) = call.progress().await {
    ///     let left: f64 = progress.variable("left")?;
    /// }
    /// let results = call.results().await?;
    /// # Ok(()) }
    /// ```
    pub fn watch(
        &self,
        peer: impl Into<Peer>,
        function: &str,
        parameters: &ParametersView,
        options: RequestOptions,
    ) -> Result<Watched, Error> {
        let options = RequestOptions { progress: true, ..options };
        Ok(Watched(self.call(&peer.into(), function, parameters, &options)?))
    }

    /// A call whose lease ends when what this returns is dropped.
    pub async fn hold(
        &self,
        peer: impl Into<Peer>,
        function: &str,
        parameters: &mut ParametersView,
        options: RequestOptions,
    ) -> Result<Hold, Error> {
        let call = self.call(&peer.into(), function, parameters, &options)?;
        parameters.copy_from(&call.promise.clone().await.map_err(|failed| failed.error)?)?;
        Ok(Hold { _call: call })
    }

    fn asked_with_all(&self, function: &str) -> Vec<Identity> {
        let mut asked = self.roster();
        asked.extend(self.nodes_offering(function).into_iter().filter(|node| node.role() == Role::MUnit));
        asked
    }

    /// The synchronous request to all at the same time, with an outcome for each, as of [`request_all`](Self::request_all).
    pub async fn block_request_all(
        &self,
        function: &str,
        parameters: &ParametersView,
    ) -> Vec<(Identity, Result<BoxedParameters, Error>)> {
        let options = RequestOptions::default();
        let calls: Vec<_> = self
            .asked_with_all(function)
            .into_iter()
            .map(|peer| (peer.clone(), self.call(&Peer::Is(peer), function, parameters, &options)))
            .collect();
        let mut outcomes = Vec::new();
        for (peer, call) in calls {
            outcomes.push((
                peer,
                match call {
                    Ok(call) => call.results().await.map_err(|failed| failed.error),
                    Err(error) => Err(error),
                },
            ));
        }
        outcomes
    }

    /// Gives up the lease that it holds on a function of a peer, which stops what that started.
    pub fn release(&self, peer: impl Into<Peer>, function: &str) -> Result<(), Error> {
        let index = self.link_to(&peer.into())?;
        self.machine(|machine, network| {
            let released = machine.links.with(network, index, |session, cx| {
                let slot = session.their_function_list().find(function).ok_or(Error::UnknownFunction)?;
                session.release(cx, slot)
            });
            released.unwrap_or(Err(Error::NotConnected))
        })??;
        self.work(index);
        Ok(())
    }

    /// Asks a vehicle to go over to another manager. Whether it agrees is seen at the vehicle.
    pub fn hand_over(&self, peer: impl Into<Peer>, to: &Manager) -> Result<(), Error> {
        let index = self.link_to(&peer.into())?;
        let asked = self
            .machine(|machine, network| machine.links.with(network, index, |session, cx| session.hand_over(cx, to)))?;
        self.work(index);
        asked.unwrap_or(Err(Error::NotConnected))
    }

    /// What an order of this unit (`call.lease`) has started is finished: it ends, no safe hook runs, and its caller is told so.
    /// `false` for one that has ended before.
    pub fn end_order(&self, order: &LeaseWatch) -> bool {
        let mut is_finished = false;
        self.each_link(|links, network, index| {
            let ended = links.with(network, index, |session, cx| session.end_order(cx, order.word(), order.order()));
            is_finished |= ended == Some(true);
        });
        is_finished
    }

    /// Whether the lease of one of its own services is live now; false for one without a lease.
    pub fn lease_is_live(&self, function: &str) -> bool {
        let live = self.machine(|machine, network| {
            let functions = &machine.links.functions;
            let function = functions.find(function).and_then(|slot| functions.function(slot))?;
            function.handler.0.lease_is_live(network.clock(self.host()))
        });
        matches!(live, Ok(Some(true)))
    }

    /// Sends a call whose end the promise tells; giving up the returned value gives up the call.
    fn call(
        &self,
        peer: &Peer,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<InFlight, Error> {
        let index = self.link_to(peer)?;
        let mut copy = boxed_parameters(size_of_val(parameters));
        copy.copy_from(parameters)?;
        let promise = Promise::new();
        let progress = Newest::default();
        let waiting = Waiting { parameters: copy, promise: promise.clone(), progress: progress.clone() };
        let requested = self.machine(|machine, network| {
            let stream = machine.links.link(index).map(|link| link.stream).ok_or(Error::NotConnected)?;
            let id = machine.links.request(network, index, function, parameters, options, Some(waiting))?;
            Ok((stream, id))
        })?;
        self.work(index);
        let unit = self.clone();
        requested.map(|(stream, id)| InFlight { unit, stream, id, promise, progress, has_succeeded: false })
    }
}

/// What a call has started goes on as long as this is kept, if its caller renews it.
#[must_use = "dropped, it is released at once"]
pub struct Hold {
    /// Not marked as successful, so that dropping it gives up the call.
    _call: InFlight,
}

impl std::fmt::Debug for Hold {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Hold").finish_non_exhaustive()
    }
}

/// A call in flight, which is given up when this is dropped before it has ended well.
struct InFlight {
    unit: UnitHandle,
    stream: StreamId,
    id: CallId,
    promise: Promise<Result<BoxedParameters, Box<CallError>>>,
    progress: Newest,
    has_succeeded: bool,
}

/// A call in flight; dropped before it has ended, it is given up, and its callee is told so.
#[must_use = "dropped, it is given up at once"]
pub struct Watched(InFlight);

impl std::fmt::Debug for Watched {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Watched").field("id", &self.0.id).finish_non_exhaustive()
    }
}

impl Watched {
    /// The newest that the call has told and this has not returned; `None` once it has ended.
    pub async fn progress(&mut self) -> Option<BoxedParameters> {
        std::future::poll_fn(|context| {
            if self.0.promise.is_kept(context) {
                return Poll::Ready(None);
            }
            self.0.progress.take(context).map_or(Poll::Pending, |values| Poll::Ready(Some(values)))
        })
        .await
    }

    /// Its results, or all that is known of why there are none.
    pub async fn results(self) -> Result<BoxedParameters, Box<CallError>> {
        self.0.results().await
    }
}

impl InFlight {
    async fn results(mut self) -> Result<BoxedParameters, Box<CallError>> {
        let results = self.promise.clone().await;
        self.has_succeeded = results.is_ok();
        results
    }
}

impl Drop for InFlight {
    fn drop(&mut self) {
        if self.has_succeeded || !self.unit.exists() {
            return;
        }
        let _ = self.unit.machine(|machine, network| {
            if let Some(index) = machine.links.of_stream(self.stream) {
                machine.links.cancel(network, index, self.id);
            }
        });
    }
}
