//! Calls that tasks await.

use core::convert::Infallible;
use core::fmt;
use core::future::Future;
use core::pin::Pin;
use core::task::{Context, Poll};

use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, Limit};
use cara_core::services::Port;
use cara_core::services::call::{self, Call, Callee, Caller, Dynamic, Outgoing};
use cara_core::services::requests::{CallId, Made};
use cara_core::services::session::RequestOptions;
use cara_core::time::{Duration, Instant};
use embassy_time::Timer;

use crate::details;
use crate::handle::Handle;
use crate::link::InFlight;
use crate::machine::Machine;
use crate::owned::Owned;
use crate::peer::Peer;
use crate::port::Board;
use crate::time::{now, timer};

/// How long a request waits for room at a time.
const PAUSE: Duration = Duration::from_millis(5);

/// Why a call has no results. With the feature `details` it has what the service has said; it turns into an [`Error`] by `?`.
pub type CallError<F = ()> = call::CallError<F, details::Kept>;

impl<T> Peer<T> {
    /// Makes a unit that calls others without the feature `call` fail to compile.
    pub(crate) const MAY_CALL: () = assert!(
        Board::CALLS,
        "a unit that calls others or reads their streams needs the feature `call` of cara-embassy"
    );

    /// A call of a function by name, whose results update `parameters`: to be awaited, or [sent](Call::send) without waiting.
    /// Nothing happens before. On an error the parameters are unchanged.
    ///
    /// Dropped before it has ended, the call is given up: what it started, or would start, stops if its service has a lease, as it
    /// does on an error. Without one the service may still run, once. A reply that is here and is not fetched holds up
    /// reading from its link until the call's deadline.
    pub fn call<'c>(&'c self, function: &'c str, parameters: &'c mut ParametersView) -> Call<'c, Self, Dynamic<'c>> {
        Call::new(self, Dynamic::new(function, parameters))
    }

    /// Calls a function and waits for its results, which update `parameters` (paper, listing line 13): [`call`](Self::call) with
    /// the default options.
    #[doc(alias = "block_request_their_function")]
    pub async fn block_request(&self, function: &str, parameters: &mut ParametersView) -> Result<(), Error> {
        Ok(self.call(function, parameters).await?)
    }

    /// Calls a function without waiting (paper, listing line 19): accepted, not sent, not executed. A failure comes as
    /// [`UnitEvent::RequestFailed`](crate::UnitEvent::RequestFailed) under the returned id.
    #[doc(alias = "request_their_function")]
    pub fn request(&self, function: &str, parameters: &ParametersView) -> Result<CallId, Error> {
        Ok(self.send(function.into(), parameters, const { &RequestOptions::new() })?)
    }
}

/// A call that a task awaits. Dropped before it has ended, it is given up.
pub struct Pending<T: 'static> {
    unit: Handle<T>,
    stage: Stage,
    deadline: Instant,
    /// Its place among the calls that move the same thing, however long it waits for room.
    made: Option<Made>,
}

enum Stage {
    /// It is sent at once, or after a pause.
    Unsent(Option<Timer>),
    Sent(InFlight),
    Over,
}

impl<T> fmt::Debug for Pending<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Pending").finish_non_exhaustive()
    }
}

impl<T> Drop for Pending<T> {
    fn drop(&mut self) {
        self.give_up();
    }
}

impl<T> Pending<T> {
    fn new(peer: &Peer<T>, options: &RequestOptions) -> Result<Self, Error> {
        let () = Peer::<T>::MAY_CALL;
        let link = peer.link()?;
        let made = peer.unit.act(|machine| machine.with(link, |session, _| session.make()));
        let timeout = options.timeout.unwrap_or(peer.unit.constraints().request_timeout);
        Ok(Self { unit: peer.unit, stage: Stage::Unsent(None), deadline: now() + timeout, made })
    }

    fn give_up(&mut self) {
        if let Stage::Sent(call) = core::mem::replace(&mut self.stage, Stage::Over) {
            self.unit.give_up(call);
        }
    }

    /// Sends the request as soon as the interval and the room allow, within the deadline.
    fn send(
        &mut self,
        peer: &Peer<T>,
        outgoing: &Outgoing<'_, Infallible>,
        cx: &mut Context<'_>,
    ) -> Poll<Result<InFlight, Error>> {
        loop {
            match &mut self.stage {
                Stage::Sent(call) => return Poll::Ready(Ok(*call)),
                Stage::Over => return Poll::Ready(Err(Error::Interrupted)),
                Stage::Unsent(pause) => {
                    if pause.as_mut().is_some_and(|pause| Pin::new(pause).poll(cx).is_pending()) {
                        return Poll::Pending;
                    }
                }
            }
            let now = now();
            let options =
                RequestOptions { timeout: Some(self.deadline.since(now)), made: self.made, ..*outgoing.options };
            let (callee, parameters, deadline) = (outgoing.callee, &*outgoing.parameters, self.deadline);
            let link = peer.link()?;
            let sent = self.unit.act(|machine| machine.call(link, callee, parameters, &options, deadline));
            self.stage = match sent {
                Ok(call) => Stage::Sent(call),
                Err(error) => {
                    let wait = match error {
                        Error::TooSoon { wait } => wait,
                        Error::Full(Limit::SendQueue | Limit::Buffers | Limit::Calls) => PAUSE,
                        _ => return Poll::Ready(Err(error)),
                    };
                    let again = now + wait;
                    if again >= self.deadline {
                        return Poll::Ready(Err(error));
                    }
                    Stage::Unsent(Some(timer(again)))
                }
            };
        }
    }
}

impl<T> Caller for Peer<T> {
    type Pending = Pending<T>;
    type Answered = InFlight;
    type Hold = Hold<T>;
    type Details = details::Kept;
    type Room = &'static mut ParametersView;
    type Canceller = Infallible;

    fn room(_: usize) -> Option<Self::Room> {
        None
    }

    fn send(
        &self,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<CallId, CallError> {
        let () = Self::MAY_CALL;
        let link = self.link()?;
        let sent = self
            .unit
            .act(|machine| machine.with(link, |session, cx| session.request(cx, callee, parameters, options, false)));
        sent.unwrap_or(Err(Error::NotConnected)).map_err(|error| self.explained(callee, error))
    }

    fn poll(
        &self,
        pending: &mut Option<Pending<T>>,
        mut outgoing: Outgoing<'_, Infallible>,
        cx: &mut Context<'_>,
    ) -> Poll<Result<InFlight, CallError>> {
        let pending = match pending {
            Some(pending) => pending,
            None => pending.insert(Pending::new(self, outgoing.options)?),
        };
        let call = match pending.send(self, &outgoing, cx) {
            Poll::Ready(Ok(call)) => call,
            Poll::Ready(Err(error)) => return Poll::Ready(Err(self.explained(outgoing.callee, error))),
            Poll::Pending => return Poll::Pending,
        };
        if self.unit.hear(&call, &mut outgoing).is_break() {
            pending.give_up();
            return Poll::Ready(Err(Error::Cancelled.into()));
        }
        let outcome = self.unit.lend(|machine| {
            let outcome = machine.outcome(&call, outgoing.parameters, cx.waker())?;
            Some(outcome.map_err(|error| machine.failed(&call, error)))
        });
        let Some(outcome) = outcome else { return Poll::Pending };
        Poll::Ready(match outcome {
            Ok(()) => {
                pending.stage = Stage::Over;
                Ok(call)
            }
            Err(failed) => {
                pending.give_up();
                Err(failed)
            }
        })
    }

    fn hold(&self, call: InFlight) -> Hold<T> {
        Hold { unit: self.unit, call }
    }
}

/// What an answered call has started goes on until this is dropped: [`Call::hold`].
#[must_use = "dropped, it is released at once"]
pub struct Hold<T: 'static> {
    unit: Handle<T>,
    call: InFlight,
}

impl<T> fmt::Debug for Hold<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Hold").finish_non_exhaustive()
    }
}

impl<T> Drop for Hold<T> {
    fn drop(&mut self) {
        self.unit.give_up(self.call);
    }
}

impl<T> Handle<T> {
    /// Nothing waits for a call any more, and what it started is not wanted. While the machine is in use, it is given up right
    /// behind that.
    fn give_up(&self, call: InFlight) {
        let (link, call) = (call.link, Owned::made(&call));
        match self.shared.machine.try_borrow_mut() {
            Ok(mut machine) => machine.give_up(link, call),
            Err(_) => {
                self.shared.unwanted.mark(link, call);
                self.shared.unwanted.made.set(Some(Machine::give_up_marked));
            }
        }
    }
}

impl<T> Machine<T> {
    fn call(
        &mut self,
        link: u16,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
        deadline: Instant,
    ) -> Result<InFlight, Error> {
        if !self.can_wait(link, callee.name(), options.priority) {
            return Err(Error::Full(Limit::Calls));
        }
        let serial = self.link(link).map_or(0, |link| link.serial);
        let called = self.with(link, |session, cx| {
            let theirs = session.their_function_list().named(callee.name()).ok_or(Error::UnknownFunction)?;
            let (slot, generation) = (theirs.slot, theirs.generation);
            let id = session.request(cx, callee, parameters, options, true)?;
            Ok(InFlight { link, serial, id, slot, generation, deadline })
        });
        let call = called.unwrap_or(Err(Error::NotConnected))?;
        self.wait(call);
        self.own(link, Owned::made(&call));
        Ok(call)
    }
}
