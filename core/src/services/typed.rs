//! Typed services: what `#[interface]` makes of a trait, and what a port gives it.
//!
//! The trait says what a unit offers. From it come a server, which adds all its functions to a unit's list, and clients,
//! which call them at a peer. Signatures and the places of variables are constants; a peer that has another version of the
//! interface is told apart before anything is sent.

use core::future::Future;
use core::ops::DerefMut;

use crate::config::Priority;
use crate::distribution::failure::Failure;
use crate::distribution::function::{Attributes, Signature};
use crate::distribution::identity::Identity;
use crate::distribution::parameters::ParametersView;
pub use crate::distribution::typed::*;
use crate::error::{Error, ServiceError};
use crate::services::call::{Call, Caller};
pub use crate::services::call::{Frame, Request};
use crate::services::heart::Renew;
use crate::services::lease::Ended;
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
    pub use crate::distribution::parameters::{FromValue, IntoValue, Parameters, ParametersView, Slot, Type};
    pub use crate::distribution::value::Value;
    pub use crate::error::{Error, ServiceError};
    pub use crate::services::call::{Call, Callee, Caller};
    pub use crate::services::heart::Renew;
    pub use crate::services::session::RequestOptions;
    pub use crate::time::Duration;
}

/// Bytes beside those of its own variables that a client has for results which only the peer's version of a function knows.
pub const ROOM: usize = 64;

/// Variables that take more bytes than these are not put on a client's stack.
pub const STACK_BYTES: usize = 32 * 1024;

/// Bytes of the variables that a client puts on its stack.
pub const fn on_stack(bytes: usize) -> usize {
    if bytes > STACK_BYTES { 0 } else { bytes }
}

/// What a service is told about its call, on any port: an argument `call: &impl AnyCall` of a function is no variable, but
/// this.
pub trait AnyCall {
    /// What the port knows an order by. `call: &impl AnyCall<Order = LeaseWatch>` tells it to a function that is written for one port;
    /// a trait for any port says `type Order;` and `Order = Self::Order`.
    type Order;

    /// The order of a service with a lease: its unit ends it with `unit.end_order(&order)`, and a motor's loop looks at it.
    fn order(&self) -> Option<Self::Order>;
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
    /// What the service returns for this failure, whose text goes to the caller; on a port that cannot tell it, its code alone.
    fn fail(&self, failure: Failure) -> ServiceError {
        failure.error()
    }
    /// Tells the caller how far the call is, if it wants to know and the signature says `progress (…)`. Nothing on a port whose
    /// services have run to their end before anything can be sent, as on boards. An error where the values do not fit the signature.
    fn notify(&self, _progress: &ParametersView) -> Result<(), Error> {
        Ok(())
    }
    /// Whether the caller has given the call up, waits no longer, or is gone; never on a port as above.
    fn is_cancelled(&self) -> bool {
        false
    }
}

/// A call that tells `P` while it runs, and `F` when it fails: an argument `call: &impl TypedCall<Left, Blocked>` of a function
/// declares both for its signature, as `progress (…)` and `fails (…)`. `()` stands for nothing. Every [`AnyCall`] is one.
pub trait TypedCall<P: Variables, F: Variables = ()>: AnyCall {
    /// Tells the caller how far the call is, as [`notify`](AnyCall::notify) does.
    fn progress(&self, values: &P) -> Result<(), Error> {
        values.with_parameters(|values| self.notify(values))?
    }

    /// What the service returns for a failure with this code, whose text and values go to the caller. Text and bytes that are longer
    /// than they are declared keep the values from it.
    fn fail_with(&self, code: u16, text: &str, values: &F) -> ServiceError {
        self.fail(failure(code, text, values))
    }
}

/// A failure with values, or without them where text and bytes are longer than they are declared.
#[doc(hidden)]
pub fn failure(code: u16, text: &str, values: &impl Variables) -> Failure {
    let mut failure = Failure::new(code, text);
    if values.to_parameters(failure.values_mut()).is_err() {
        failure = Failure::new(code, text);
    }
    failure
}

impl<C: AnyCall, P: Variables, F: Variables> TypedCall<P, F> for C {}

/// The state of a unit, for an `async fn` of an interface: an argument `state: &impl AsyncState<Self>` is no variable, but this.
/// Between two uses of it others have the state. An error, once the unit has stopped.
pub trait AsyncState<T: ?Sized>: Send + Sync {
    /// Runs `act` with the state when its turn comes, as a method has it. `act` itself must not wait. Dropped before its turn, it
    /// gives the turn up.
    fn with<R: Send>(
        &self,
        act: impl FnOnce(&mut T) -> R + Send,
    ) -> impl Future<Output = Result<R, ServiceError>> + Send;

    /// As [`with`](Self::with), unless the call's order has ended: see [`AnyCall::commit`].
    fn commit<R: Send>(
        &self,
        change: impl FnOnce(&mut T) -> R + Send,
    ) -> impl Future<Output = Result<R, ServiceError>> + Send;
}

/// A service that reads the application's state.
pub type Reader<T, C> = dyn Fn(&T, &C, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
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

/// A port's list whose services may read the state beside each other.
#[diagnostic::on_unimplemented(
    message = "`{Self}` takes no service with `&self`",
    label = "this interface has a function with `&self`",
    note = "on Linux functions with `&self` run side by side, and so the state must be `Sync`: put what is not into a `Mutex`, or take `&mut self`"
)]
pub trait ReaderFunctions<T: 'static>: Functions<T> {
    /// Adds a service that reads the state: as `read` where readers run side by side, as `method` where one call at a time has the
    /// state. One that moves, stops or resets something is always the latter.
    fn add_reader(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Self::Actuator>,
        read: &'static Reader<T, Self::Call>,
        method: &'static Method<T, Self::Call>,
    ) -> Result<(), Error>;
}

/// A port's list whose services may be futures. Such a service gets its call, the state and its variables to keep, and what it
/// returns are its results where its arguments were.
#[diagnostic::on_unimplemented(
    message = "`{Self}` takes no service that is an `async fn`",
    label = "this interface has an `async fn`",
    note = "an `async fn` is served on Linux, with the feature `async` of `cara-std`; its clients work on any port"
)]
pub trait AsyncFunctions<T: 'static>: Functions<T, Call: Send + Sync> {
    /// What lends its services the state.
    type State: AsyncState<T> + 'static;
    /// What holds the variables of a call.
    type Room: DerefMut<Target = ParametersView> + Send + 'static;

    /// As [`add_free`](Functions::add_free), for a service that is a future.
    fn add_task<W>(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Self::Actuator>,
        run: fn(Self::Call, Self::State, Self::Room) -> W,
    ) -> Result<(), Error>
    where
        W: Future<Output = Result<Self::Room, ServiceError>> + Send + 'static;
}

/// The server that `#[interface]` makes: all functions of the trait, for a unit whose state implements it.
pub trait Interface<T: 'static, F: Functions<T> + ?Sized> {
    /// Adds them to the unit's list.
    fn add_to(self, functions: &F) -> Result<(), Error>;
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

    /// A call at the peer, with these options.
    pub const fn call<Q>(&self, request: Q) -> Call<'p, P, Q> {
        Call::new(self.peer, request).with(self.options)
    }
}
