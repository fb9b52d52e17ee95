//! A call as its caller makes it: one object, with its options, that a thread waits for, a task awaits, or that is only sent.
//!
//! A port's handle to a peer is a [`Caller`]. What is called is a [`Request`]: [`Dynamic`], or what `#[interface]` writes for a
//! function. Nothing is sent before `.wait()`, `.await` or `.send()`, and a [`Call`] that is dropped before did nothing.
//!
//! A deadline counts from there. A [`Reply`] that is dropped gives its call up: what the call started, or would start, stops if its
//! service has a lease. Once it is answered, what it started goes on for as long as its [`renewing`](Call::renewing) says, or
//! until what [`hold`](Call::hold) returns is dropped.

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

/// The function that a call is of.
#[derive(Clone, Copy, Debug)]
pub struct Callee<'a> {
    name: &'a str,
    declared: Option<Declared>,
}

/// A function as an interface declares it, and what compares that with what the peer has published. It is a pointer so that
/// a program that calls by name alone has nothing of the comparison.
#[derive(Clone, Copy, Debug)]
struct Declared {
    signature: Signature<'static>,
    check: fn(Signature<'_>, Signature<'_>) -> Result<(), Mismatch>,
}

impl Callee<'static> {
    /// A function of an interface: a peer that has another version of it is not called.
    pub(crate) fn declared(signature: Signature<'static>) -> Self {
        Self { name: signature.name(), declared: Some(Declared { signature, check: Mismatch::check }) }
    }
}

impl<'a> Callee<'a> {
    /// Its name.
    pub const fn name(&self) -> &'a str {
        self.name
    }

    /// Compares it with what the peer has published under its name.
    pub fn check(&self, published: Signature<'_>) -> Result<(), Mismatch> {
        self.declared.map_or(Ok(()), |Declared { signature, check }| check(signature, published))
    }
}

impl<'a> From<&'a str> for Callee<'a> {
    fn from(name: &'a str) -> Self {
        Self { name, declared: None }
    }
}

/// Hears what a call tells while it runs. `Break` gives the call up.
pub type OnProgress<'a> = &'a mut dyn FnMut(&ParametersView) -> ControlFlow<()>;

/// A call as a port gets it.
pub struct Outgoing<'a, K> {
    /// The function.
    pub callee: Callee<'a>,
    /// The arguments, and the place for the results.
    pub parameters: &'a mut ParametersView,
    /// How it is called.
    pub options: &'a RequestOptions,
    /// Hears the progress; what the service tells is wanted only then.
    pub progress: Option<OnProgress<'a>>,
    /// Gives it up.
    pub canceller: Option<&'a K>,
}

impl<K> fmt::Debug for Outgoing<'_, K> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Outgoing").field("callee", &self.callee).field("options", self.options).finish_non_exhaustive()
    }
}

/// How a call has ended.
pub type Answer<C> = Result<<C as Caller>::Answered, CallError<(), <C as Caller>::Details>>;

/// A port's handle to a peer whose functions are called. It has no `impl Trait` in return position, so that a [`Reply`] is `Send`
/// where the port's types are.
pub trait Caller {
    /// A call on its way, which a task polls. Dropped before it has ended, it gives the call up.
    type Pending: Unpin;
    /// Names a call that was answered.
    type Answered;
    /// What a call has started goes on until this is dropped.
    type Hold;
    /// What is known of a failure beside its [`Error`].
    type Details: CallDetails;
    /// Holds variables that are too many for the stack.
    type Room: DerefMut<Target = ParametersView> + Unpin;
    /// Gives calls up from elsewhere.
    type Canceller;

    /// Room for variables of so many bytes; `None` where there is no other memory than the stack.
    #[doc(hidden)]
    fn room(bytes: usize) -> Option<Self::Room>;

    /// Calls without waiting.
    fn send(
        &self,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<CallId, CallError<(), Self::Details>>;

    /// Goes on with a call, which the first poll puts into `pending`. Not to be called again once it was ready.
    fn poll(
        &self,
        pending: &mut Option<Self::Pending>,
        outgoing: Outgoing<'_, Self::Canceller>,
        cx: &mut Context<'_>,
    ) -> Poll<Answer<Self>>;

    /// What an answered call has started is given up with what is returned.
    fn hold(&self, answered: Self::Answered) -> Self::Hold;
}

/// A peer that a thread can wait for.
pub trait BlockingCaller: Caller {
    /// Calls and waits for the results.
    fn wait(&self, outgoing: Outgoing<'_, Self::Canceller>) -> Answer<Self>;
}

/// What is called, and with what.
pub trait Request: Sized {
    /// What the call gives back.
    type Results;
    /// What it tells while it runs.
    type Progress<'v>;
    /// The values of its failures.
    type Failure;
    /// It with its variables while it runs. `R` is where a port keeps those that are too many for the stack.
    #[doc(hidden)]
    type Frame<R: DerefMut<Target = ParametersView> + Unpin>;

    /// With variables that are not set: they are in one place from here on, and are not moved.
    #[doc(hidden)]
    fn frame<R: DerefMut<Target = ParametersView> + Unpin>(self) -> Self::Frame<R>;
    /// Puts the arguments into the variables, once.
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
    /// Reads the progress; `None` where it is of another version.
    #[doc(hidden)]
    fn progress(values: &ParametersView) -> Option<Self::Progress<'_>>;
}

/// A call by name, whose results update the parameters that it was made with.
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
    /// Of the function of this name. On an error the parameters stay as they are.
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

/// A typed call and its variables: on the stack, or where the port has room for more.
#[doc(hidden)]
#[derive(Debug)]
pub struct Frame<const BYTES: usize, R, A> {
    function: Signature<'static>,
    /// The arguments, until they are among the variables.
    request: Option<A>,
    on_stack: Parameters<BYTES>,
    room: Option<R>,
}

impl<const BYTES: usize, R: DerefMut<Target = ParametersView>, A> Frame<BYTES, R, A> {
    /// Without variables yet.
    #[inline]
    pub const fn new(function: Signature<'static>, request: A) -> Self {
        Self { function, request: Some(request), on_stack: Parameters::sized(), room: None }
    }

    /// Lays the variables out, which take `bytes`; the arguments, once.
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

/// A call that has not been sent.
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
/// `W` hears its progress, and `K` says what it leads to.
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
    /// With the default options.
    pub const fn new(caller: &'c C, request: Q) -> Self {
        let options = RequestOptions::new();
        Self { caller, request, options, canceller: None, watch: Unwatched, kind: PhantomData }
    }

    /// Hears what the call tells while it runs: the newest progress that has not been heard, and none after the reply. Where
    /// `hear` returns `Break`, the call is given up and ends with [`Error::Cancelled`]: what it moves stops, and its handler is told.
    pub fn watch<F>(self, hear: F) -> Call<'c, C, Q, Watched<F>>
    where
        Q: Request,
        F: FnMut(Q::Progress<'_>) -> ControlFlow<()>,
    {
        let Self { caller, request, options, canceller, .. } = self;
        Call { caller, request, options, canceller, watch: Watched(hear), kind: PhantomData }
    }

    /// Sends it without waiting: accepted, not executed. A failure comes as an event under the returned id.
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
    /// What the call has started goes on until the [hold](Held) that it ends with is dropped, and at most for as long as
    /// [`renewing`](Self::renewing) says.
    pub fn hold(self) -> Call<'c, C, Q, W, Holding> {
        let Self { caller, request, options, canceller, watch, .. } = self;
        Call { caller, request, options, canceller, watch, kind: PhantomData }
    }
}

impl<'c, C: Caller, Q, W, K> Call<'c, C, Q, W, K> {
    /// The caller waits no longer, and the callee begins no later, than this; otherwise the constraint `request_timeout`.
    pub fn timeout(mut self, timeout: impl Into<Duration>) -> Self {
        self.options.timeout = Some(timeout.into());
        self
    }

    /// In this class, and not in the function's own.
    pub const fn priority(mut self, priority: Priority) -> Self {
        self.options.priority = Some(priority);
        self
    }

    /// What it starts is wanted so long, if its function has a lease.
    pub const fn renewing(mut self, renew: Renew) -> Self {
        self.options.renew = renew;
        self
    }

    /// Takes over what another caller moves, in place of [`Error::Held`].
    pub const fn take_over(mut self) -> Self {
        self.options.take_over = true;
        self
    }

    /// In one datagram, now or never: only for a call that is [sent](Call::send).
    pub const fn best_effort(mut self) -> Self {
        self.options.delivery = Delivery::BestEffort;
        self
    }

    /// With these options in place of those so far.
    pub const fn with(mut self, options: RequestOptions) -> Self {
        self.options = options;
        self
    }

    /// Ends with [`Error::Cancelled`] within 20 ms once `canceller` says so; an answer that is here already wins.
    pub const fn cancelled_by(mut self, canceller: &'c C::Canceller) -> Self {
        self.canceller = Some(canceller);
        self
    }

    /// Once it is given up, by a [canceller](Self::cancelled_by) or by what [watches](Call::watch) it, it waits so long for the
    /// service's answer, at most until its deadline, and ends with that: results, or its error with text and values. With
    /// [`Error::Cancelled`] where none comes in time. What it moves stops at once all the same. A [`Reply`] that is dropped waits for
    /// nothing. Where a call had not begun, the answer is [`Error::Expired`].
    pub fn answer_within(mut self, wait: impl Into<Duration>) -> Self
    where
        C: BlockingCaller,
    {
        self.options.answer_within = wait.into();
        self
    }

    /// Sends it and waits for the results. What it started, or would start, stops on an error if its service has a lease.
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

/// Progress is asked for where something hears it, and not otherwise.
const fn options<Q: Request, W: Watch<Q>>(options: RequestOptions) -> RequestOptions {
    RequestOptions { progress: W::WATCHES, ..options }
}

/// The results of an answered call. Where they cannot be read, what the call started is not wanted.
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

/// What a [`Call`] is while a task awaits it. Dropped before it has ended, it gives the call up.
#[must_use = "nothing is sent before it is polled; dropped, the call is given up"]
pub struct Reply<'c, C: Caller, Q: Request, W = Unwatched, K = Once> {
    caller: &'c C,
    frame: Q::Frame<C::Room>,
    options: RequestOptions,
    canceller: Option<&'c C::Canceller>,
    watch: W,
    pending: Option<C::Pending>,
    /// It was ready. Polled once more, it must not call again.
    is_over: bool,
    kind: PhantomData<K>,
}

impl<C: Caller, Q: Request, W, K> fmt::Debug for Reply<'_, C, Q, W, K> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Reply").field("options", &self.options).finish_non_exhaustive()
    }
}

/// Nothing in it is ever pinned.
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

/// Nothing hears the progress of a call.
#[derive(Clone, Copy, Debug)]
pub struct Unwatched;

/// Hears the progress of a call: see [`Call::watch`].
#[derive(Clone, Copy, Debug)]
pub struct Watched<F>(F);

/// A call that ends with its results.
#[derive(Debug)]
pub enum Once {}

/// A call that ends with its results and a hold: see [`Call::hold`].
#[derive(Debug)]
pub enum Holding {}

use sealed::{Kind, Watch};

mod sealed {
    use core::ops::ControlFlow;

    use super::{Caller, Held, Holding, Once, Request, Unwatched, Watched};
    use crate::distribution::parameters::ParametersView;

    /// What hears the progress of a call.
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
            // Progress of another version is no reason to end a motion.
            Q::progress(values).map_or(ControlFlow::Continue(()), &mut self.0)
        }
    }

    /// What a call leads to.
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

/// What a call that is held has given, and what gives it up when this is dropped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use = "dropped, it is released at once"]
pub struct Held<H, R = ()> {
    /// The results; `()` of a call by name.
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

/// What is known of a failed call beside its [`Error`].
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "the core has no memory to box it in; a port may")]
pub enum Detail {
    /// What the service has said.
    Service(Failure),
    /// Where the peer's version of the function differs.
    Version(Mismatch),
}

/// How a port keeps what is known of a failed call; `()` keeps nothing.
pub trait CallDetails: Default {
    /// Of this.
    fn of(detail: Detail) -> Self;
    /// What is known, if it was kept.
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

/// Why a call has no results. `F` are the values of its service's failures, and `D` is how the port keeps them.
///
/// It turns into an [`Error`] by `?`.
pub struct CallError<F = (), D = ()> {
    /// What every caller learns.
    pub error: Error,
    details: D,
    values: PhantomData<fn() -> F>,
}

impl<F, D: CallDetails> CallError<F, D> {
    /// An error, and what else is known of it.
    pub fn new(error: Error, detail: Option<Detail>) -> Self {
        Self { error, details: detail.map(D::of).unwrap_or_default(), values: PhantomData }
    }

    /// What the service has said of its failure, with the values of a call by name. `None` where it has said nothing, or the
    /// port keeps nothing of it.
    pub fn failure(&self) -> Option<&Failure> {
        match self.details.get() {
            Some(Detail::Service(failure)) => Some(failure),
            _ => None,
        }
    }

    /// Where the peer's version of the function differs, of [`Error::Mismatch`].
    pub fn mismatch(&self) -> Option<&Mismatch> {
        match self.details.get() {
            Some(Detail::Version(mismatch)) => Some(mismatch),
            _ => None,
        }
    }

    /// The reason in words; empty where there is none.
    pub fn text(&self) -> &str {
        self.failure().map_or("", Failure::text)
    }

    /// The values that the interface declares for failures; `None` where the service sent none.
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
    /// The same, of a call whose interface declares values for failures.
    fn typed<F>(self) -> CallError<F, D> {
        CallError { error: self.error, details: self.details, values: PhantomData }
    }
}

impl<F, D: Clone> Clone for CallError<F, D> {
    fn clone(&self) -> Self {
        Self { error: self.error, details: self.details.clone(), values: PhantomData }
    }
}

/// By what happened; what the service has said of it is not compared.
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
