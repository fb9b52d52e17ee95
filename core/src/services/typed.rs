//! Typed services: what `#[interface]` generates from a trait, and what a port provides for it.
//!
//! From the trait come a server, which adds its functions to a unit's list, and clients, which call them at a peer. Signatures
//! and positions of variables are constants; a peer with another version of the interface is detected before anything is sent.

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

/// Text and bytes of a fixed capacity, usable as variables; of the `heapless` version that the core uses.
#[doc(no_inline)]
pub use heapless;

/// Names that generated code uses.
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

/// Bytes that a client reserves beside its own variables, for results that only the peer's version of a function has.
pub const ROOM: usize = 64;

/// Larger sets of variables are not put on a client's stack.
pub const STACK_BYTES: usize = 32 * 1024;

/// How many bytes of variables a client puts on its stack.
pub const fn on_stack(bytes: usize) -> usize {
    if bytes > STACK_BYTES { 0 } else { bytes }
}

/// What a service learns about its call, on any port. An argument `call: &impl AnyCall` is not a variable of the signature.
pub trait AnyCall {
    /// The port's type for an order. A function for one port writes `call: &impl AnyCall<Order = LeaseWatch>`; a trait for any
    /// port declares `type Order;` and writes `Order = Self::Order`.
    type Order;

    /// The order, if the service has a lease: a motor's loop checks it, and `unit.end_order(&order)` ends it as finished.
    fn order(&self) -> Option<Self::Order>;
    /// The caller.
    fn caller(&self) -> &Identity;
    /// The call's class.
    fn priority(&self) -> Priority;
    /// When the caller stops waiting, on the unit's clock.
    fn deadline(&self) -> Instant;
    /// Whether the caller waits for an answer.
    fn wants_reply(&self) -> bool;
    /// Runs `change` unless the call's order has ended; always for a service without a lease.
    fn commit<R>(&self, change: impl FnOnce() -> R) -> Result<R, Ended>;
    /// The error to return for this failure. Its text is sent to the caller, except on ports that send only its code.
    fn fail(&self, failure: Failure) -> ServiceError {
        failure.error()
    }
    /// Sends the caller progress, if it asked for it and the signature has `progress (…)`. Does nothing on ports that send only
    /// after a service has returned, as on boards. An error if the values do not match the signature.
    fn notify(&self, _progress: &ParametersView) -> Result<(), Error> {
        Ok(())
    }
    /// Whether the caller has given the call up, has timed out, or is gone; always `false` on a port as above.
    fn is_cancelled(&self) -> bool {
        false
    }
}

/// A call with progress of type `P` and failure values of type `F`: the argument `call: &impl TypedCall<Left, Blocked>` declares
/// both in the signature, as `progress (…)` and `fails (…)`. `()` declares nothing. Every [`AnyCall`] implements this.
pub trait TypedCall<P: Variables, F: Variables = ()>: AnyCall {
    /// Sends the caller progress, as [`notify`](AnyCall::notify) does.
    fn progress(&self, values: &P) -> Result<(), Error> {
        values.with_parameters(|values| self.notify(values))?
    }

    /// The error to return for a failure with this code; text and values are sent to the caller. If text or bytes in `values`
    /// exceed their declared lengths, the values are left out.
    fn fail_with(&self, code: u16, text: &str, values: &F) -> ServiceError {
        self.fail(failure(code, text, values))
    }
}

/// A failure with values, or without them if text or bytes exceed their declared lengths.
#[doc(hidden)]
pub fn failure(code: u16, text: &str, values: &impl Variables) -> Failure {
    let mut failure = Failure::new(code, text);
    if values.to_parameters(failure.values_mut()).is_err() {
        failure = Failure::new(code, text);
    }
    failure
}

impl<C: AnyCall, P: Variables, F: Variables> TypedCall<P, F> for C {}

/// The unit's state, for an `async fn` of an interface: the argument `state: &impl AsyncState<Self>` is not a variable. Between
/// two uses other services have the state. Fails once the unit has stopped.
pub trait AsyncState<T: ?Sized>: Send + Sync {
    /// Runs `act` with the state when its turn comes among the other methods. It must not block. Dropping the future gives up the
    /// turn.
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

/// A service that reads the application's state, side by side with other readers.
pub type Reader<T, C> = dyn Fn(&T, &C, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
/// A service with exclusive use of the application's state.
pub type Method<T, C> = dyn Fn(&mut T, &C, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;
/// A service without the state, such as one of the emergency class.
pub type Free<C> = dyn Fn(&C, &mut ParametersView) -> Result<(), ServiceError> + Send + Sync;

/// A port's list of the unit's own functions, for an application with state `T`.
pub trait Functions<T: 'static> {
    /// What services learn about their call.
    type Call: AnyCall + 'static;
    /// What stops the motion that services start.
    type Actuator;

    /// Adds a service that gets the state. If the attributes say so, it moves, stops or resets `actuator`, or all without one.
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

/// A port's list whose services may read the state side by side.
#[diagnostic::on_unimplemented(
    message = "`{Self}` takes no service with `&self`",
    label = "this interface has a function with `&self`",
    note = "on Linux functions with `&self` run side by side, and so the state must be `Sync`: put what is not into a `Mutex`, or take `&mut self`"
)]
pub trait ReaderFunctions<T: 'static>: Functions<T> {
    /// Adds a service that reads the state: as `read` if readers run side by side, as `method` on ports where one call at a time
    /// has the state, and always if it moves, stops or resets something.
    fn add_reader(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Self::Actuator>,
        read: &'static Reader<T, Self::Call>,
        method: &'static Method<T, Self::Call>,
    ) -> Result<(), Error>;
}

/// A port's list whose services may be futures. Such a service owns its call, state and variables, and returns the results in the
/// place of the arguments.
#[diagnostic::on_unimplemented(
    message = "`{Self}` takes no service that is an `async fn`",
    label = "this interface has an `async fn`",
    note = "an `async fn` is served on Linux, with the feature `async` of `cara-std`; its clients work on any port"
)]
pub trait AsyncFunctions<T: 'static>: Functions<T, Call: Send + Sync> {
    /// Lends services the state.
    type State: AsyncState<T> + 'static;
    /// Stores the variables of a call.
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

/// The server that `#[interface]` generates: all functions of the trait, for a unit whose state implements it.
pub trait Interface<T: 'static, F: Functions<T> + ?Sized> {
    /// Adds them to the unit's list.
    fn add_to(self, functions: &F) -> Result<(), Error>;
}

/// The common part of all clients: a peer, and the options of calls.
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
    /// A client of this peer, with the default options.
    pub const fn at(peer: &'p P) -> Self {
        Self { peer, options: RequestOptions::new() }
    }

    /// Uses these options for all later calls.
    pub const fn with(self, options: RequestOptions) -> Self {
        Self { options, ..self }
    }

    /// Sets how long calls renew their leases.
    pub const fn renewing(self, renew: Renew) -> Self {
        let options = RequestOptions { renew, ..self.options };
        Self { options, ..self }
    }

    /// A call of the peer with these options.
    pub const fn call<Q>(&self, request: Q) -> Call<'p, P, Q> {
        Call::new(self.peer, request).with(self.options)
    }
}
