//! Typed services: what `#[interface]` makes of a trait, and what a port gives it.
//!
//! The trait says what a unit offers. From it come a server, which adds all its functions to a unit's list, and clients,
//! which call them at a peer. Signatures and the places of variables are constants; a peer that has another version of the
//! interface is told apart before anything is sent.

use core::future::Future;

use crate::config::Priority;
use crate::distribution::function::{Attributes, Signature};
use crate::distribution::identity::Identity;
use crate::distribution::parameters::ParametersView;
pub use crate::distribution::typed::*;
use crate::error::{Error, ServiceError};
use crate::services::heart::Renew;
use crate::services::lease::Ended;
use crate::services::requests::CallId;
use crate::services::session::RequestOptions;
use crate::time::Instant;

/// Text and bytes of a fixed room, as variables can be: of the version that the core is built with.
#[doc(no_inline)]
pub use heapless;

/// What generated code names.
#[doc(hidden)]
pub mod parts {
    pub use crate::config::Priority;
    pub use crate::distribution::function::{Attributes, Signature, VariableSpec};
    pub use crate::distribution::parameters::{FromValue, IntoValue, Parameters, ParametersView, Type};
    pub use crate::distribution::value::{Target, Value};
    pub use crate::error::{Error, ServiceError};
    pub use crate::services::heart::Renew;
    pub use crate::services::requests::CallId;
    pub use crate::services::session::RequestOptions;
    pub use crate::time::Duration;
}

/// Bytes beside those of its own variables that a client has for results which only the peer's version of a function knows.
pub const ROOM: usize = 64;

/// What a service is told about its call, on any port: an argument `call: &impl AnyCall` of a function is no variable, but
/// this.
pub trait AnyCall {
    /// The caller.
    fn caller(&self) -> &Identity;
    /// The call's class.
    fn priority(&self) -> Priority;
    /// After this the caller no longer waits; on the unit's clock.
    fn deadline(&self) -> Instant;
    /// Whether the caller waits.
    fn wants_reply(&self) -> bool;
    /// Does what the call wants to change, unless its order has ended; always for a service without a lease.
    fn commit<R>(&self, change: impl FnOnce() -> R) -> Result<R, Ended>;
}

/// A service with the application's state.
pub type Method<T, C> = dyn Fn(&mut T, &C, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
/// A service without it, as one of the emergency class is.
pub type Free<C> = dyn Fn(&C, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;

/// A port's list of the unit's own functions, whose application has the state `T`.
pub trait Functions<T: 'static> {
    /// What it tells its services about a call.
    type Call: AnyCall + 'static;
    /// What makes safe what services move.
    type Actuator;

    /// Adds a service that gets the state. Where the attributes say so, it moves, stops or resets `actuator`, or stops or
    /// resets all without one.
    fn add_method(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Self::Actuator>,
        run: &'static Method<T, Self::Call>,
    ) -> Result<(), Error>;

    /// As [`add_method`](Self::add_method), for a service without the state.
    fn add_free(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Self::Actuator>,
        run: &'static Free<Self::Call>,
    ) -> Result<(), Error>;
}

/// The server that `#[interface]` makes: all functions of the trait, for a unit whose state implements it.
pub trait Interface<T: 'static, F: Functions<T> + ?Sized> {
    /// Adds them to the unit's list.
    fn add_to(self, functions: &F) -> Result<(), Error>;
}

/// A line of help on a function, and the units of its variables, as the trait tells them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Help {
    /// The function.
    pub function: &'static str,
    /// What it does.
    pub text: &'static str,
    /// The units of variables, by name.
    pub units: &'static [(&'static str, &'static str)],
}

/// Why a typed call has no results.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CallError {
    /// The peer has another version of the function; nothing was sent.
    #[error("{0}")]
    Mismatch(#[from] Mismatch),
    /// What the dynamic form of the call says as well.
    #[error("{0}")]
    Call(#[from] Error),
}

impl From<CallError> for ServiceError {
    fn from(error: CallError) -> Self {
        match error {
            CallError::Mismatch(_) => Self::NotReady,
            CallError::Call(error) => error.into(),
        }
    }
}

/// A peer whose functions are called.
pub trait Caller {
    /// Shows what the peer has published under a name.
    fn published<R>(&self, function: &str, look: impl Fn(Option<Signature<'_>>) -> R) -> R;

    /// Calls without waiting.
    fn send(&self, function: &str, parameters: &ParametersView, options: &RequestOptions) -> Result<CallId, Error>;
}

/// A peer that a thread can wait for.
pub trait BlockingCaller: Caller {
    /// A call that is given up when this is dropped.
    type Hold;

    /// Calls and waits for the results.
    fn block(&self, function: &str, parameters: &mut ParametersView, options: &RequestOptions) -> Result<(), Error>;

    /// The same; what the call has started goes on until what is returned is dropped.
    fn block_and_hold(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<Self::Hold, Error>;
}

/// A peer that a task can await.
pub trait AwaitedCaller: Caller {
    /// Calls and waits for the results.
    fn call(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> impl Future<Output = Result<(), Error>>;
}

/// What all clients are made of: a peer, and how its functions are called.
#[derive(Debug)]
pub struct Client<'p, P> {
    peer: &'p P,
    options: RequestOptions,
}

impl<P> Clone for Client<'_, P> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<P> Copy for Client<'_, P> {}

impl<'p, P: Caller> Client<'p, P> {
    /// Calls at this peer, with the default options.
    pub const fn at(peer: &'p P) -> Self {
        Self { peer, options: RequestOptions::new() }
    }

    /// Calls with these options from here on.
    pub const fn with(self, options: RequestOptions) -> Self {
        Self { options, ..self }
    }

    /// Calls whose motion is wanted so long.
    pub const fn renewing(self, renew: Renew) -> Self {
        let options = RequestOptions { renew, ..self.options };
        Self { options, ..self }
    }

    /// The peer.
    pub const fn peer(&self) -> &'p P {
        self.peer
    }

    /// How its functions are called.
    pub const fn options(&self) -> &RequestOptions {
        &self.options
    }

    /// Makes the variables of a function, and looks whether the peer has the same one.
    pub fn prepare(&self, function: Signature<'static>, parameters: &mut ParametersView) -> Result<(), CallError> {
        parameters.lay_out(function)?;
        let differs =
            |published: Option<Signature<'_>>| published.map_or(Ok(()), |theirs| Mismatch::check(function, theirs));
        Ok(self.peer.published(function.name(), differs)?)
    }
}
