//! Requests that are awaited.

use core::fmt;
use core::future::poll_fn;
use core::task::Poll;

use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, Limit};
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};

use crate::handle::Handle;
use crate::machine::Machine;
use crate::peer::Peer;
use crate::replies::InFlight;
use crate::time::{now, timer};

/// How long a request waits for room at a time.
const PAUSE: Duration = Duration::from_millis(5);

impl<T> Peer<T> {
    /// Calls a function and waits for its results, which update `parameters` (paper, listing line 13). On an error they
    /// are unchanged.
    ///
    /// Cancelled before the request was sent, nothing has happened. Cancelled later, the reply is lost; what the call
    /// started, or would start, stops if its service has a lease, as it does on an error. Without one the service may
    /// still run, once.
    #[doc(alias = "block_request_their_function")]
    pub async fn block_request(&self, function: &str, parameters: &mut ParametersView) -> Result<(), Error> {
        self.block_request_with(function, parameters, const { &RequestOptions::new() }).await
    }

    /// As [`block_request`](Self::block_request), with a time-out, class or lease of its own.
    pub async fn block_request_with(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<(), Error> {
        let mut call = self.hold(function, parameters, options).await?;
        call.is_wanted = true;
        Ok(())
    }

    /// As [`block_request_with`](Self::block_request_with); what the call has started goes on until the returned guard is
    /// dropped, and at most for as long as the options' `renew` says.
    pub async fn hold(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<Hold<T>, Error> {
        let timeout = options.timeout.unwrap_or(self.unit.constraints().request_timeout);
        let deadline = now() + timeout;
        let call = self.begin(function, parameters, options, deadline).await?;
        poll_fn(|cx| {
            let mut machine = self.unit.shared.machine.borrow_mut();
            machine.outcome(&call.call, parameters, cx.waker()).map_or(Poll::Pending, Poll::Ready)
        })
        .await?;
        Ok(call)
    }

    /// Sends the request as soon as the interval and the room allow, within the deadline.
    pub(crate) async fn begin(
        &self,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
        deadline: Instant,
    ) -> Result<Hold<T>, Error> {
        // It keeps its place among the calls that move the same thing, however long it waits for room.
        let link = self.link()?;
        let made = self.unit.act(|machine| machine.with(link, |session, _| session.make()));
        let options = &RequestOptions { made, ..*options };
        loop {
            let again = match self.try_begin(function, parameters, options, deadline) {
                Ok(call) => return Ok(Hold { unit: self.unit, call, is_wanted: false }),
                Err((error, None)) => return Err(error),
                Err((_, Some(again))) => again,
            };
            timer(again).await;
        }
    }

    /// Sends the request, if it can be sent now; with the error, when it may be tried again. What this needs is no part of a
    /// future.
    fn try_begin(
        &self,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
        deadline: Instant,
    ) -> Result<InFlight, (Error, Option<Instant>)> {
        let now = now();
        let options = RequestOptions { timeout: Some(deadline.since(now)), ..*options };
        let link = self.link().map_err(|error| (error, None))?;
        let sent = self.unit.act(|machine| machine.call(link, function, parameters, &options, deadline));
        sent.map_err(|error| {
            let wait = match error {
                Error::TooSoon { wait } => wait,
                Error::Full(Limit::SendQueue | Limit::Buffers | Limit::Calls) => PAUSE,
                _ => return (error, None),
            };
            let again = now + wait;
            (error, (again < deadline).then_some(again))
        })
    }
}

/// A call that is given up when this is dropped: what it started, or would start, stops if its service has a lease.
#[must_use = "dropped, it is released at once"]
pub struct Hold<T: 'static> {
    unit: Handle<T>,
    pub(crate) call: InFlight,
    /// Also behind the end of this.
    pub(crate) is_wanted: bool,
}

impl<T> fmt::Debug for Hold<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Hold").finish_non_exhaustive()
    }
}

impl<T> Drop for Hold<T> {
    fn drop(&mut self) {
        if self.is_wanted {
            return;
        }
        if let Ok(mut machine) = self.unit.shared.machine.try_borrow_mut() {
            machine.give_up(&self.call);
        }
    }
}

impl<T> Machine<T> {
    fn call(
        &mut self,
        link: u16,
        function: &str,
        parameters: &ParametersView,
        options: &RequestOptions,
        deadline: Instant,
    ) -> Result<InFlight, Error> {
        if !self.can_wait(link, function, options.priority) {
            return Err(Error::Full(Limit::Calls));
        }
        let serial = self.link(link).map_or(0, |link| link.serial);
        let called = self.with(link, |session, cx| {
            let theirs = session.their_function_list().named(function).ok_or(Error::UnknownFunction)?;
            let (slot, generation) = (theirs.slot, theirs.generation);
            let id = session.request(cx, function, parameters, options, true)?;
            Ok(InFlight { link, serial, id, slot, generation, deadline })
        });
        let call = called.unwrap_or(Err(Error::NotConnected))?;
        self.wait(call);
        Ok(call)
    }
}
