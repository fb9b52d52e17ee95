//! A call as its caller makes it: one object with its options, which a thread waits for, a task awaits, or which is only sent.
//!
//! A port's handle to a peer is a [`Caller`]. What is called is a [`Request`]: [`Dynamic`], or a function of an `#[interface]`.
//! `.wait()`, `.await` or `.send()` sends the call, and its deadline counts from there; a [`Call`] that is dropped before did
//! nothing.
//!
//! Dropping a [`Reply`] gives its call up: the motion of a service with a lease stops, or does not begin. The motion of an
//! answered call lasts as long as its [`renewing`](Call::renewing) says, or until the guard of [`hold`](Call::hold) is dropped.

use core::fmt;
use core::future::{Future, IntoFuture};
use core::marker::PhantomData;
use core::ops::{ControlFlow, Deref, DerefMut};
use core::pin::Pin;
use core::task::{Context, Poll};

use crate::config::Priority;
use crate::distribution::failure::Failure;
use crate::distribution::function::Signature;
use crate::distribution::parameters::{Parameters, ParametersView};
use crate::distribution::typed::{Mismatch, Variables};
use crate::error::{Error, ServiceError};
use crate::services::heart::Renew;
use crate::services::requests::CallId;
use crate::services::session::{Delivery, RequestOptions};
use crate::time::Duration;

/// The function to call.
#[derive(Clone, Copy, Debug)]
pub struct Callee<'a> {
    name: &'a str,
    declared: Option<Declared>,
}

/// A function as an interface declares it, and the comparison with what the peer has published: a pointer, so that a program that
/// only calls by name does not link the comparison.
#[derive(Clone, Copy, Debug)]
struct Declared {
    signature: Signature<'static>,
    check: fn(Signature<'_>, Signature<'_>) -> Result<(), Mismatch>,
}

impl Callee<'static> {
    /// A function of an interface. The call fails if the peer has another version of it.
    pub(crate) fn declared(signature: Signature<'static>) -> Self {
        Self { name: signature.name(), declared: Some(Declared { signature, check: Mismatch::check }) }
    }
}

impl<'a> Callee<'a> {
    /// Its name.
    pub const fn name(&self) -> &'a str {
        self.name
    }

    /// Compares it with the function that the peer has published under this name.
    pub fn check(&self, published: Signature<'_>) -> Result<(), Mismatch> {
        self.declared.map_or(Ok(()), |Declared { signature, check }| check(signature, published))
    }
}

impl<'a> From<&'a str> for Callee<'a> {
    fn from(name: &'a str) -> Self {
        Self { name, declared: None }
    }
}

/// Receives the progress of a call. Returning `Break` gives the call up.
pub type OnProgress<'a> = &'a mut dyn FnMut(&ParametersView) -> ControlFlow<()>;

/// A call as it is passed to a port.
pub struct Outgoing<'a, K> {
    /// The function.
    pub callee: Callee<'a>,
    /// The arguments, and the capacity for results.
    pub parameters: &'a mut ParametersView,
    /// The call's options.
    pub options: &'a RequestOptions,
    /// Receives progress; without it, none is requested from the peer.
    pub progress: Option<OnProgress<'a>>,
    /// Gives the call up from elsewhere.
    pub canceller: Option<&'a K>,
}

impl<K> fmt::Debug for Outgoing<'_, K> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Outgoing").field("callee", &self.callee).field("options", self.options).finish_non_exhaustive()
    }
}

/// The outcome of a call.
pub type Answer<C> = Result<<C as Caller>::Answered, CallError<(), <C as Caller>::Details>>;

/// A port's handle to a peer whose functions are called. No method returns `impl Trait`: a [`Reply`] is `Send` if the port
/// allows.
pub trait Caller {
    /// A call in flight, polled by a task. Dropping it before the call has ended gives the call up.
    type Pending: Unpin;
    /// Names an answered call.
    type Answered;
    /// Keeps the motion of an answered call alive until it is dropped.
    type Hold;
    /// What the port keeps of a failure beside its [`Error`].
    type Details: CallDetails;
    /// Stores variables that are too large for the stack.
    type Room: DerefMut<Target = ParametersView> + Unpin;
    /// Gives calls up from elsewhere.
    type Canceller;

    /// Memory for variables of this many bytes; `None` if the port has only the stack.
    #[doc(hidden)]
    fn room(bytes: usize) -> Option<Self::Room>;

    /// Sends a call without waiting for it.
    fn send(
        &self,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<CallId, CallError<(), Self::Details>>;

    /// Polls a call. The first poll sends it and fills `pending`. Do not call it again after it was ready.
    fn poll(
        &self,
        pending: &mut Option<Self::Pending>,
        outgoing: Outgoing<'_, Self::Canceller>,
        cx: &mut Context<'_>,
    ) -> Poll<Answer<Self>>;

    /// A guard for the motion of an answered call, which ends when the guard is dropped.
    fn hold(&self, answered: Self::Answered) -> Self::Hold;
}

/// A peer that a thread can wait for.
pub trait BlockingCaller: Caller {
    /// Calls and waits for the results.
    fn wait(&self, outgoing: Outgoing<'_, Self::Canceller>) -> Answer<Self>;
}

/// A function to call, with its arguments.
pub trait Request: Sized {
    /// The results.
    type Results;
    /// The values of progress reports.
    type Progress<'v>;
    /// The values of failures.
    type Failure;
    /// The request with its variables while the call runs. `R` stores variables that are too large for the stack.
    #[doc(hidden)]
    type Frame<R: DerefMut<Target = ParametersView> + Unpin>;

    /// Adds variables, not set yet. The frame is not moved from here on.
    #[doc(hidden)]
    fn frame<R: DerefMut<Target = ParametersView> + Unpin>(self) -> Self::Frame<R>;
    /// Encodes the arguments into the variables, once.
    #[doc(hidden)]
    fn open<C: Caller>(frame: &mut Self::Frame<C::Room>) -> Result<(), Error>;
    /// The function and its variables.
    #[doc(hidden)]
    fn parts<R: DerefMut<Target = ParametersView> + Unpin>(
        frame: &mut Self::Frame<R>,
    ) -> (Callee<'_>, &mut ParametersView);
    /// Reads the results.
    #[doc(hidden)]
    fn results<R: DerefMut<Target = ParametersView> + Unpin>(frame: &Self::Frame<R>) -> Result<Self::Results, Error>;
    /// Reads progress; `None` if the peer's version of it differs.
    #[doc(hidden)]
    fn progress(values: &ParametersView) -> Option<Self::Progress<'_>>;
}

/// A call by name, whose results update its parameters.
pub struct Dynamic<'p> {
    name: &'p str,
    parameters: &'p mut ParametersView,
}

impl fmt::Debug for Dynamic<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Dynamic").field(&self.name).finish()
    }
}

impl<'p> Dynamic<'p> {
    /// A call of the function of this name. On an error the parameters are unchanged.
    pub const fn new(name: &'p str, parameters: &'p mut ParametersView) -> Self {
        Self { name, parameters }
    }
}

impl Request for Dynamic<'_> {
    type Results = ();
    type Progress<'v> = &'v ParametersView;
    type Failure = ();
    type Frame<R: DerefMut<Target = ParametersView> + Unpin> = Self;

    fn frame<R: DerefMut<Target = ParametersView> + Unpin>(self) -> Self {
        self
    }

    fn open<C: Caller>(_: &mut Self) -> Result<(), Error> {
        Ok(())
    }

    fn parts<R: DerefMut<Target = ParametersView> + Unpin>(frame: &mut Self) -> (Callee<'_>, &mut ParametersView) {
        (frame.name.into(), frame.parameters)
    }

    fn results<R: DerefMut<Target = ParametersView> + Unpin>(_: &Self) -> Result<(), Error> {
        Ok(())
    }

    fn progress(values: &ParametersView) -> Option<&ParametersView> {
        Some(values)
    }
}

/// A typed call with its variables: on the stack, or in the port's memory if they are too large.
#[doc(hidden)]
#[derive(Debug)]
pub struct Frame<const BYTES: usize, R, A> {
    function: Signature<'static>,
    /// The arguments, until they are encoded into the variables.
    request: Option<A>,
    on_stack: Parameters<BYTES>,
    room: Option<R>,
}

impl<const BYTES: usize, R: DerefMut<Target = ParametersView>, A> Frame<BYTES, R, A> {
    /// A frame without variables.
    #[inline]
    pub const fn new(function: Signature<'static>, request: A) -> Self {
        Self { function, request: Some(request), on_stack: Parameters::sized(), room: None }
    }

    /// Lays the variables out, in `bytes` bytes. Returns the arguments the first time.
    pub fn lay_out<C: Caller<Room = R>>(&mut self, bytes: usize) -> Result<Option<(A, &mut ParametersView)>, Error> {
        let Some(request) = self.request.take() else { return Ok(None) };
        if bytes > BYTES {
            self.room = C::room(bytes);
        }
        let function = self.function;
        let (_, variables) = self.parts();
        variables.lay_out(function)?;
        Ok(Some((request, variables)))
    }

    /// The function and its variables.
    pub fn parts(&mut self) -> (Callee<'static>, &mut ParametersView) {
        (Callee::declared(self.function), self.room.as_deref_mut().unwrap_or(&mut self.on_stack))
    }
}

impl<const BYTES: usize, R: Deref<Target = ParametersView>, A> Deref for Frame<BYTES, R, A> {
    type Target = ParametersView;

    fn deref(&self) -> &ParametersView {
        self.room.as_deref().unwrap_or(&self.on_stack)
    }
}

/// A call that has not been sent yet.
///
/// ```
/// use cara_core::Parameters;
/// use cara_core::config::Priority;
/// use cara_core::error::Error;
/// use cara_core::services::call::{BlockingCaller, Call, Dynamic};
/// use cara_core::time::Duration;
///
/// /// `peer` is a port's handle to a node; its `call` makes the same object.
/// fn position<P: BlockingCaller>(peer: &P) -> Result<[i64; 2], Error> {
///     let mut position = Parameters::new();
///     position.add_int("position", 2)?;
///     let call = Call::new(peer, Dynamic::new("pos_info", &mut position));
///     call.timeout(Duration::from_millis(200)).priority(Priority::High).wait().map_err(|failed| failed.error)?;
///     position.variable("position")
/// }
/// ```
///
/// `W` receives its progress, and `K` determines its output.
#[must_use = "nothing is sent before `.wait()`, `.await` or `.send()`"]
pub struct Call<'c, C: Caller, Q, W = Unwatched, K = Once> {
    caller: &'c C,
    request: Q,
    options: RequestOptions,
    canceller: Option<&'c C::Canceller>,
    watch: W,
    kind: PhantomData<K>,
}

impl<C: Caller, Q: fmt::Debug, W, K> fmt::Debug for Call<'_, C, Q, W, K> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Call").field("request", &self.request).field("options", &self.options).finish_non_exhaustive()
    }
}

impl<'c, C: Caller, Q> Call<'c, C, Q> {
    /// A call with the default options.
    pub const fn new(caller: &'c C, request: Q) -> Self {
        let options = RequestOptions::new();
        Self { caller, request, options, canceller: None, watch: Unwatched, kind: PhantomData }
    }

    /// Receives progress: the newest report that was not passed on yet, and none after the reply. If `hear` returns `Break`, the
    /// call ends with [`Error::Cancelled`]: its motion stops, and its handler is notified.
    pub fn watch<F>(self, hear: F) -> Call<'c, C, Q, Watched<F>>
    where
        Q: Request,
        F: FnMut(Q::Progress<'_>) -> ControlFlow<()>,
    {
        let Self { caller, request, options, canceller, .. } = self;
        Call { caller, request, options, canceller, watch: Watched(hear), kind: PhantomData }
    }

    /// Sends the call without waiting: `Ok` means accepted, not executed. A failure is reported as an event with the returned id.
    pub fn send(self) -> Result<CallId, CallError<Q::Failure, C::Details>>
    where
        Q: Request,
    {
        let mut frame = self.request.frame::<C::Room>();
        Q::open::<C>(&mut frame)?;
        let (callee, parameters) = Q::parts(&mut frame);
        self.caller.send(callee, parameters, &self.options).map_err(CallError::typed)
    }
}

impl<'c, C: Caller, Q, W> Call<'c, C, Q, W> {
    /// The motion that the call starts continues until the returned [hold](Held) is dropped, but no longer than
    /// [`renewing`](Self::renewing) says.
    pub fn hold(self) -> Call<'c, C, Q, W, Holding> {
        let Self { caller, request, options, canceller, watch, .. } = self;
        Call { caller, request, options, canceller, watch, kind: PhantomData }
    }
}

impl<'c, C: Caller, Q, W, K> Call<'c, C, Q, W, K> {
    /// How long the caller waits, and until when the callee may begin. The default is the constraint `request_timeout`.
    pub fn timeout(mut self, timeout: impl Into<Duration>) -> Self {
        self.options.timeout = Some(timeout.into());
        self
    }

    /// Overrides the function's own priority class.
    pub const fn priority(mut self, priority: Priority) -> Self {
        self.options.priority = Some(priority);
        self
    }

    /// How long the call renews its lease, if the function has one.
    pub const fn renewing(mut self, renew: Renew) -> Self {
        self.options.renew = renew;
        self
    }

    /// Takes over an actuator that another caller holds, instead of failing with [`Error::Held`].
    pub const fn take_over(mut self) -> Self {
        self.options.take_over = true;
        self
    }

    /// Sends one datagram, without retransmission: only for a call that is [sent](Call::send).
    pub const fn best_effort(mut self) -> Self {
        self.options.delivery = Delivery::BestEffort;
        self
    }

    /// Only while this unit leads ([`UnitEvent::Leading`](crate::services::event::UnitEvent::Leading)), [`Error::NoAuthority`]
    /// otherwise. This unit looks when it sends: what the call is for has to refuse lower claims itself, as a vehicle does.
    pub const fn only_while_leading(mut self) -> Self {
        self.options.only_while_leading = true;
        self
    }

    /// With these options in place of those so far.
    pub const fn with(mut self, options: RequestOptions) -> Self {
        self.options = options;
        self
    }

    /// Ends with [`Error::Cancelled`] within 20 ms of `canceller`'s request, unless the answer is already here.
    pub const fn cancelled_by(mut self, canceller: &'c C::Canceller) -> Self {
        self.canceller = Some(canceller);
        self
    }

    /// If the call is given up, by a [canceller](Self::cancelled_by) or what [watches](Call::watch) it, waits up to this long,
    /// and at most until its deadline, for the service's answer, and returns that: results, or its error with text and values. If
    /// none comes, [`Error::Cancelled`]. Motion stops at once all the same. [`Error::Expired`] if the call had not begun. A
    /// dropped [`Reply`] waits for nothing.
    pub fn answer_within(mut self, wait: impl Into<Duration>) -> Self
    where
        C: BlockingCaller,
    {
        self.options.answer_within = wait.into();
        self
    }

    /// Sends the call and waits for its results. On an error motion of a service with a lease stops, or does not begin.
    pub fn wait(mut self) -> Result<K::Output, CallError<Q::Failure, C::Details>>
    where
        C: BlockingCaller,
        Q: Request,
        W: Watch<Q>,
        K: Kind<C, Q::Results>,
    {
        let mut frame = self.request.frame::<C::Room>();
        Q::open::<C>(&mut frame)?;
        let (callee, parameters) = Q::parts(&mut frame);
        let mut hear = |values: &ParametersView| self.watch.hear(values);
        let outgoing = Outgoing {
            callee,
            parameters,
            options: &options::<Q, W>(self.options),
            progress: if W::WATCHES { Some(&mut hear) } else { None },
            canceller: self.canceller,
        };
        let answered = self.caller.wait(outgoing).map_err(CallError::typed)?;
        finish::<C, Q, K>(self.caller, &frame, answered)
    }
}

/// Requests progress only if something receives it.
const fn options<Q: Request, W: Watch<Q>>(options: RequestOptions) -> RequestOptions {
    RequestOptions { progress: W::WATCHES, ..options }
}

/// The results of an answered call. If they cannot be read, the caller fails, so its motion ends.
fn finish<C: Caller, Q: Request, K: Kind<C, Q::Results>>(
    caller: &C,
    frame: &Q::Frame<C::Room>,
    answered: C::Answered,
) -> Result<K::Output, CallError<Q::Failure, C::Details>> {
    match Q::results(frame) {
        Ok(results) => Ok(K::output(caller, answered, results)),
        Err(error) => {
            drop(caller.hold(answered));
            Err(error.into())
        }
    }
}

impl<'c, C: Caller, Q: Request, W: Watch<Q>, K: Kind<C, Q::Results>> IntoFuture for Call<'c, C, Q, W, K> {
    type Output = Result<K::Output, CallError<Q::Failure, C::Details>>;
    type IntoFuture = Reply<'c, C, Q, W, K>;

    fn into_future(self) -> Self::IntoFuture {
        let Self { caller, request, options, canceller, watch, kind } = self;
        let options = self::options::<Q, W>(options);
        Reply { caller, frame: request.frame(), options, canceller, watch, pending: None, is_over: false, kind }
    }
}

/// A [`Call`] while a task awaits it. Dropping it before the call has ended gives the call up.
#[must_use = "nothing is sent before it is polled; dropped, the call is given up"]
pub struct Reply<'c, C: Caller, Q: Request, W = Unwatched, K = Once> {
    caller: &'c C,
    frame: Q::Frame<C::Room>,
    options: RequestOptions,
    canceller: Option<&'c C::Canceller>,
    watch: W,
    pending: Option<C::Pending>,
    /// It was ready: a further poll must not send the call again.
    is_over: bool,
    kind: PhantomData<K>,
}

impl<C: Caller, Q: Request, W, K> fmt::Debug for Reply<'_, C, Q, W, K> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Reply").field("options", &self.options).finish_non_exhaustive()
    }
}

/// No field is structurally pinned.
impl<C: Caller, Q: Request, W, K> Unpin for Reply<'_, C, Q, W, K> {}

impl<C: Caller, Q: Request, W: Watch<Q>, K: Kind<C, Q::Results>> Future for Reply<'_, C, Q, W, K> {
    type Output = Result<K::Output, CallError<Q::Failure, C::Details>>;

    fn poll(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Self::Output> {
        let Self { caller, frame, options, canceller, watch, pending, is_over, .. } = self.get_mut();
        if core::mem::replace(is_over, true) {
            return Poll::Ready(Err(Error::Interrupted.into()));
        }
        Q::open::<C>(frame)?;
        let (callee, parameters) = Q::parts(frame);
        let mut hear = |values: &ParametersView| watch.hear(values);
        let progress: Option<OnProgress<'_>> = if W::WATCHES { Some(&mut hear) } else { None };
        let outgoing = Outgoing { callee, parameters, options, progress, canceller: *canceller };
        match caller.poll(pending, outgoing, cx) {
            Poll::Pending => {
                *is_over = false;
                Poll::Pending
            }
            Poll::Ready(Err(error)) => Poll::Ready(Err(error.typed())),
            Poll::Ready(Ok(answered)) => Poll::Ready(finish::<C, Q, K>(caller, frame, answered)),
        }
    }
}

/// Progress is ignored.
#[derive(Clone, Copy, Debug)]
pub struct Unwatched;

/// Progress is received: see [`Call::watch`].
#[derive(Clone, Copy, Debug)]
pub struct Watched<F>(F);

/// The call returns its results.
#[derive(Debug)]
pub enum Once {}

/// The call returns its results and a hold: see [`Call::hold`].
#[derive(Debug)]
pub enum Holding {}

use sealed::{Kind, Watch};

mod sealed {
    use core::ops::ControlFlow;

    use super::{Caller, Held, Holding, Once, Request, Unwatched, Watched};
    use crate::distribution::parameters::ParametersView;

    /// Receives the progress of a call.
    pub trait Watch<Q: Request> {
        const WATCHES: bool;
        fn hear(&mut self, values: &ParametersView) -> ControlFlow<()>;
    }

    impl<Q: Request> Watch<Q> for Unwatched {
        const WATCHES: bool = false;

        fn hear(&mut self, _: &ParametersView) -> ControlFlow<()> {
            ControlFlow::Continue(())
        }
    }

    impl<Q: Request, F: FnMut(Q::Progress<'_>) -> ControlFlow<()>> Watch<Q> for Watched<F> {
        const WATCHES: bool = true;

        fn hear(&mut self, values: &ParametersView) -> ControlFlow<()> {
            // Unreadable progress of another version is no reason to end a motion.
            Q::progress(values).map_or(ControlFlow::Continue(()), &mut self.0)
        }
    }

    /// Determines the output of a call.
    pub trait Kind<C: Caller, R> {
        type Output;
        fn output(caller: &C, answered: C::Answered, results: R) -> Self::Output;
    }

    impl<C: Caller, R> Kind<C, R> for Once {
        type Output = R;

        fn output(_: &C, _: C::Answered, results: R) -> R {
            results
        }
    }

    impl<C: Caller, R> Kind<C, R> for Holding {
        type Output = Held<C::Hold, R>;

        fn output(caller: &C, answered: C::Answered, results: R) -> Held<C::Hold, R> {
            Held { results, hold: caller.hold(answered) }
        }
    }
}

/// The results of a held call, and the guard that keeps its motion alive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use = "dropped, it is released at once"]
pub struct Held<H, R = ()> {
    /// The results; `()` of a call by name.
    pub results: R,
    /// Dropping this ends the motion that the call has started.
    pub hold: H,
}

impl<H, R> Deref for Held<H, R> {
    type Target = H;

    fn deref(&self) -> &H {
        &self.hold
    }
}

/// What is known of a failed call beside its [`Error`].
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "the core has no memory to box it in; a port may")]
pub enum Detail {
    /// The failure that the service returned.
    Service(Failure),
    /// Where the peer's version of the function differs.
    Version(Mismatch),
}

/// How a port stores details of a failed call; `()` stores nothing.
pub trait CallDetails: Default {
    /// Stores this detail.
    fn of(detail: Detail) -> Self;
    /// The detail, if it was stored.
    fn get(&self) -> Option<&Detail>;
}

impl CallDetails for () {
    fn of(_: Detail) {}

    fn get(&self) -> Option<&Detail> {
        None
    }
}

impl CallDetails for Option<Detail> {
    fn of(detail: Detail) -> Self {
        Some(detail)
    }

    fn get(&self) -> Option<&Detail> {
        self.as_ref()
    }
}

/// Why a call has no results. `F` is the type of failure values, and `D` is how the port stores details.
///
/// It turns into an [`Error`] by `?`.
pub struct CallError<F = (), D = ()> {
    /// The error, as every caller gets it.
    pub error: Error,
    details: D,
    values: PhantomData<fn() -> F>,
}

impl<F, D: CallDetails> CallError<F, D> {
    /// An error and its details.
    pub fn new(error: Error, detail: Option<Detail>) -> Self {
        Self { error, details: detail.map(D::of).unwrap_or_default(), values: PhantomData }
    }

    /// The failure that the service returned, with its values if the call was by name. `None` if it returned only a code, or the
    /// port stores no details.
    pub fn failure(&self) -> Option<&Failure> {
        match self.details.get() {
            Some(Detail::Service(failure)) => Some(failure),
            _ => None,
        }
    }

    /// How the peer's version of the function differs, for [`Error::Mismatch`].
    pub fn mismatch(&self) -> Option<&Mismatch> {
        match self.details.get() {
            Some(Detail::Version(mismatch)) => Some(mismatch),
            _ => None,
        }
    }

    /// The reason in words; empty if there is none.
    pub fn text(&self) -> &str {
        self.failure().map_or("", Failure::text)
    }

    /// The failure values that the interface declares; `None` if the service sent none.
    pub fn values(&self) -> Option<F>
    where
        F: Variables,
    {
        let values = self.failure()?.values();
        (!values.is_empty()).then(|| F::from_parameters(values).ok()).flatten()
    }
}

impl<F, D> CallError<F, D> {
    /// The service's own code.
    pub const fn code(&self) -> Option<u16> {
        match self.error {
            Error::Service(ServiceError::Failed(code)) => Some(code),
            _ => None,
        }
    }

    /// Whether the service may have run. `false` is certain.
    pub const fn may_have_run(&self) -> bool {
        self.error.may_have_run()
    }
}

impl<D> CallError<(), D> {
    /// Converts to the failure type that the interface declares.
    fn typed<F>(self) -> CallError<F, D> {
        CallError { error: self.error, details: self.details, values: PhantomData }
    }
}

impl<F, D: Clone> Clone for CallError<F, D> {
    fn clone(&self) -> Self {
        Self { error: self.error, details: self.details.clone(), values: PhantomData }
    }
}

/// Compares the errors only, not what the service said.
impl<F, D> PartialEq for CallError<F, D> {
    fn eq(&self, other: &Self) -> bool {
        self.error == other.error
    }
}

impl<F, D> PartialEq<Error> for CallError<F, D> {
    fn eq(&self, other: &Error) -> bool {
        self.error == *other
    }
}

impl<F, D: CallDetails> From<Error> for CallError<F, D> {
    fn from(error: Error) -> Self {
        Self::new(error, None)
    }
}

impl<F, D> From<CallError<F, D>> for Error {
    fn from(error: CallError<F, D>) -> Self {
        error.error
    }
}

impl<F, D> From<CallError<F, D>> for ServiceError {
    fn from(error: CallError<F, D>) -> Self {
        match error.error {
            Error::Mismatch(_) => Self::NotReady,
            error => error.into(),
        }
    }
}

impl<F, D: CallDetails> fmt::Display for CallError<F, D> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.details.get(), self.error) {
            (Some(Detail::Version(mismatch)), _) => fmt::Display::fmt(mismatch, f),
            (Some(Detail::Service(failure)), Error::Service(_)) => fmt::Display::fmt(failure, f),
            (_, error) => fmt::Display::fmt(&error, f),
        }
    }
}

impl<F, D: CallDetails> fmt::Debug for CallError<F, D> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut shown = f.debug_tuple("CallError");
        shown.field(&self.error);
        self.details.get().map(|detail| shown.field(detail));
        shown.finish()
    }
}

impl<F, D: CallDetails> core::error::Error for CallError<F, D> {}
