//! Calls, what they hold, and round trips.

use cara_core::error::Error;
use cara_core::services::lease::LeaseEnd;
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use std::future::poll_fn;

use super::reply::PendingReply;
use crate::communication_system::{CommunicationSystem, outcomes, rooms};
use crate::engine::CallsToAll;
use crate::growing::CallParameters;
use crate::heart::Hold;
use crate::peer::Peer;

impl<T: Send + 'static> Peer<T> {
    /// Calls a function; the future ends with its results, which update `parameters`, or with why there are none. The
    /// request is sent at once where interval and room allow, and otherwise by the future, within the deadline.
    ///
    /// Dropped before it has ended, the call is given up: its slot is free, and what it started, or would start, stops if its
    /// service has a lease. Without one the service may still run, once.
    ///
    /// ```no_run
    /// # async fn ask(depot: cara_std::CommunicationSystem) -> Result<(), cara_std::Error> {
    /// use cara_std::{Parameters, RequestOptions};
    ///
    /// let mut pos = Parameters::new();
    /// pos.add_int("position", 2)?;
    /// depot.s_unit("agv-07")?.request_async("pos_info", &mut pos, &RequestOptions::default())?.await?;
    /// let [x, y]: [i64; 2] = pos.variable("position")?;
    /// # Ok(())
    /// # }
    /// ```
    pub fn request_async<'p>(
        &self,
        function: &str,
        parameters: &'p mut (impl CallParameters + ?Sized),
        options: &RequestOptions,
    ) -> Result<PendingReply<'p, T>, Error> {
        let parameters = self.with_room(function, parameters);
        let call = self.engine.pending_call(self.link()?, function, parameters, options)?;
        Ok(PendingReply::new(&self.engine, call, parameters))
    }

    /// As [`request_async`](Self::request_async); what the call has started goes on until the returned guard is dropped, and
    /// at most for as long as the options' `renew` says. Dropped before it has ended, the call is given up.
    ///
    /// ```no_run
    /// # async fn lift(depot: cara_std::CommunicationSystem, heart: cara_std::Heart) -> Result<(), cara_std::Error> {
    /// use cara_std::{Duration, Parameters, RequestOptions};
    ///
    /// let wanted = RequestOptions::renewing(heart.renew());
    /// let lifting = depot.s_unit("fork")?.hold_async("lift", &mut Parameters::new(), &wanted).await?;
    /// // …
    /// lifting.release_async(Duration::from_secs(2)).await?;
    /// # Ok(())
    /// # }
    /// ```
    pub async fn hold_async(
        &self,
        function: &str,
        parameters: &mut (impl CallParameters + ?Sized),
        options: &RequestOptions,
    ) -> Result<Hold<T>, Error> {
        let mut reply = self.request_async(function, parameters, options)?;
        (&mut reply).await?;
        reply.into_call().into_held().map(Hold::new).ok_or(Error::NotConnected)
    }

    /// Measures a round trip of the protocol itself, with no function involved. [`Error::TimedOut`] when no answer comes in
    /// time. Dropped before it has ended, it gives its turn to the next caller.
    pub async fn ping_async(&self, timeout: impl Into<Duration>) -> Result<Duration, Error> {
        self.engine.await_ping(&self.link()?, timeout.into()).await
    }

    /// As [`publish_my_function_list`](Self::publish_my_function_list), and ends when the node has read the list;
    /// [`Error::TimedOut`] otherwise. Dropped before it has ended, the list is published all the same.
    pub async fn publish_and_wait_async(&self, timeout: impl Into<Duration>) -> Result<(), Error> {
        let told = self.engine.publish(Some(&self.cell.identity))?;
        match self.engine.acknowledgements(told, timeout.into()).await.is_empty() {
            true => Ok(()),
            false => Err(Error::TimedOut),
        }
    }
}

impl<T: Send + 'static> Hold<T> {
    /// Releases it, as dropping does, and ends when the node has told that it is over there, and how: within a keep-alive
    /// interval as a rule. [`Error::TimedOut`] when it has not told so in time, [`Error::Interrupted`] when the link ended
    /// before. Dropped before it has ended, it is released all the same.
    pub async fn release_async(self, timeout: impl Into<Duration>) -> Result<LeaseEnd, Error> {
        self.call.ended(timeout.into()).await
    }
}

impl<T: Send + 'static> CommunicationSystem<T> {
    /// As [`block_request_all`](Self::block_request_all): calls `function` of every node, all at the same time, and ends
    /// when all have ended, with an outcome for each. Dropped before it has ended, those calls that have not are given up.
    ///
    /// ```no_run
    /// # async fn stop(depot: cara_std::CommunicationSystem) {
    /// use cara_std::{Parameters, RequestOptions};
    ///
    /// for (agv, outcome) in depot.request_all_async("stop", &Parameters::new(), &RequestOptions::default()).await {
    ///     if let Err(error) = outcome {
    ///         eprintln!("{agv:?} did not stop: {error}");
    ///     }
    /// }
    /// # }
    /// ```
    pub async fn request_all_async<P: CallParameters + Clone>(
        &self,
        function: &str,
        parameters: &P,
        options: &RequestOptions,
    ) -> Vec<(Peer<T>, Result<P, Error>)> {
        let peers = self.asked_with_all(function);
        let mut results = rooms(&peers, function, parameters);
        let mut calls = CallsToAll::new(self.engine(), peers.iter().map(Peer::link), function, options);
        poll_fn(|cx| calls.poll(cx, &mut results)).await;
        outcomes(peers, calls, results)
    }
}
