//! Typed services: what `#[interface]` makes of a trait, and what a port gives it.
//!
//! The trait says what a unit offers. From it come a server, which adds all its functions to a unit's list, and clients,
//! which call them at a peer. Signatures and the places of variables are constants; a peer that has another version of the
//! interface is told apart before anything is sent.

#[cfg(feature = "details")]
use core::fmt;
use core::future::Future;
#[cfg(feature = "details")]
use core::ops::ControlFlow;
use core::ops::{Deref, DerefMut};

#[cfg(feature = "details")]
use crate::config::FAILURE_TEXT_BYTES;
use crate::config::Priority;
#[cfg(feature = "details")]
use crate::distribution::failure::Failure;
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
    pub use crate::distribution::parameters::{FromValue, IntoValue, Parameters, ParametersView, Slot, Type};
    pub use crate::distribution::value::Value;
    pub use crate::error::{Error, ServiceError};
    pub use crate::services::heart::Renew;
    pub use crate::services::requests::CallId;
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
    #[cfg(feature = "details")]
    fn fail(&self, failure: Failure) -> ServiceError {
        failure.error()
    }
    /// Tells the caller how far the call is, if it wants to know and the signature says `progress (…)`. Nothing on a port whose
    /// services have run to their end before anything can be sent, as on boards. An error where the values do not fit the signature.
    #[cfg(feature = "details")]
    fn tell(&self, _progress: &ParametersView) -> Result<(), Error> {
        Ok(())
    }
    /// Whether the caller has given the call up, waits no longer, or is gone; never on a port as above.
    #[cfg(feature = "details")]
    fn is_cancelled(&self) -> bool {
        false
    }
}

/// A call that tells `P` while it runs, and `F` when it fails: an argument `call: &impl TypedCall<Left, Blocked>` of a function
/// declares both for its signature, as `progress (…)` and `fails (…)`. `()` stands for nothing. Every [`AnyCall`] is one.
#[cfg(feature = "details")]
pub trait TypedCall<P: Variables, F: Variables = ()>: AnyCall {
    /// Tells the caller how far the call is, as [`tell`](AnyCall::tell) does.
    fn progress(&self, values: &P) -> Result<(), Error> {
        values.with_parameters(|values| self.tell(values))?
    }

    /// What the service returns for a failure with this code, whose text and values go to the caller. Text and bytes that are longer
    /// than they are declared keep the values from it.
    fn fail_with(&self, code: u16, text: &str, values: &F) -> ServiceError {
        self.fail(failure(code, text, values))
    }
}

/// A failure with values, or without them where text and bytes are longer than they are declared.
#[cfg(feature = "details")]
#[doc(hidden)]
pub fn failure(code: u16, text: &str, values: &impl Variables) -> Failure {
    let mut failure = Failure::new(code, text);
    if values.to_parameters(failure.values_mut()).is_err() {
        failure = Failure::new(code, text);
    }
    failure
}

#[cfg(feature = "details")]
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

/// Why a typed call has no results, with what its service has said of it.
#[cfg(feature = "details")]
#[derive(Clone, Debug, PartialEq)]
pub struct Failed<F> {
    /// What every caller learns.
    pub error: CallError,
    /// The reason in words; empty where there is none.
    pub text: heapless::String<FAILURE_TEXT_BYTES>,
    /// The values; `None` where the service sent none.
    pub values: Option<F>,
}

#[cfg(feature = "details")]
impl<F: Variables> Failed<F> {
    /// Of an error, and what the service has said of it.
    #[doc(hidden)]
    pub fn new(error: Error, why: Option<&Failure>) -> Self {
        let text = why.and_then(|why| heapless::String::try_from(why.text()).ok());
        let values = why.filter(|why| !why.values().is_empty()).and_then(|why| F::from_parameters(why.values()).ok());
        Self { error: error.into(), text: text.unwrap_or_default(), values }
    }
}

#[cfg(feature = "details")]
impl<F> From<CallError> for Failed<F> {
    fn from(error: CallError) -> Self {
        Self { error, text: heapless::String::new(), values: None }
    }
}

#[cfg(feature = "details")]
impl<F> From<Error> for Failed<F> {
    fn from(error: Error) -> Self {
        CallError::Call(error).into()
    }
}

#[cfg(feature = "details")]
impl<F> fmt::Display for Failed<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.text.as_str(), &self.error) {
            ("", error) => fmt::Display::fmt(error, f),
            (text, CallError::Call(Error::Service(ServiceError::Failed(code)))) => write!(f, "{text} (code {code})"),
            (text, error) => write!(f, "{error}: {text}"),
        }
    }
}

#[cfg(feature = "details")]
impl<F: fmt::Debug> core::error::Error for Failed<F> {}

/// Hands over what a call tells, as the struct that the interface declares for it.
#[cfg(feature = "details")]
#[doc(hidden)]
pub fn hand<V: Variables>(told: &ParametersView, mut on_progress: impl FnMut(V) -> ControlFlow<()>) -> ControlFlow<()> {
    // What cannot be read is of another version, which is no reason to end a motion.
    V::from_parameters(told).map_or(ControlFlow::Continue(()), &mut on_progress)
}

impl From<CallError> for ServiceError {
    fn from(error: CallError) -> Self {
        match error {
            CallError::Mismatch(_) => Self::NotReady,
            CallError::Call(error) => error.into(),
        }
    }
}

/// What a call that is held has given, and what gives it up when this is dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use = "dropped, it is released at once"]
pub struct Held<H, R> {
    /// The results; `()` of a function without any.
    pub results: R,
    /// What the call has started goes on until this is dropped.
    pub hold: H,
}

impl<H, R> Deref for Held<H, R> {
    type Target = H;

    fn deref(&self) -> &H {
        &self.hold
    }
}

/// A peer whose functions are called.
pub trait Caller {
    /// Shows what the peer has published under a name.
    fn published<R>(&self, function: &str, look: impl Fn(Option<Signature<'_>>) -> R) -> R;

    /// Room for variables of so many bytes, which are too many for the stack; `None` where there is no other memory.
    #[doc(hidden)]
    fn room(_bytes: usize) -> Option<impl DerefMut<Target = ParametersView> + Send> {
        None::<&'static mut ParametersView>
    }

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

/// A peer that a thread can wait for while it hears how far its call is.
#[cfg(feature = "details")]
pub trait WatchingCaller: BlockingCaller {
    /// As [`block`](BlockingCaller::block), with what the call tells while it runs, and what the service has said of a failure in
    /// `why`. `Break` gives the call up, which ends with [`Error::Cancelled`].
    fn block_watched(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
        on_progress: impl FnMut(&ParametersView) -> ControlFlow<()>,
        why: &mut Option<Failure>,
    ) -> Result<(), Error>;
}

/// A peer that a task can await while it hears how far its call is.
#[cfg(feature = "details")]
pub trait AwaitedWatcher: AwaitedCaller {
    /// As [`block_watched`](WatchingCaller::block_watched).
    fn call_watched(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
        on_progress: impl FnMut(&ParametersView) -> ControlFlow<()>,
        why: &mut Option<Failure>,
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
