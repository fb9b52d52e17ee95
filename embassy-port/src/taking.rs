//! Functions of an interface that take their calls: the method returns at once, and a task tells how far the call is, sees that
//! it is given up, and answers.

use core::fmt;
use core::marker::PhantomData;
use core::ops::Deref;

use cara_core::config::FAILURE_VALUES_BYTES;
use cara_core::distribution::parameters::Parameters;
use cara_core::error::{Error, ServiceError};
use cara_core::typed::{TypedCall, Variables, failure};

use crate::handler::Served;
use crate::owned::Owned;
use crate::taken::TakenCall;

/// As [`TypedCall`], for a function whose method takes the call and returns: `call: &impl LongCall<Left, Blocked, State = Agv>`.
/// What the method returns is passed over then.
///
#[cfg_attr(feature = "derive", doc = "```")]
#[cfg_attr(not(feature = "derive"), doc = "```ignore")]
/// use cara_core::ServiceError;
/// use cara_embassy::{LongCall, TypedTaken, Variables, interface};
///
/// #[derive(Variables)]
/// struct Left { left: f32 }
///
/// #[interface]
/// trait Dock {
///     fn dock(&mut self, call: &impl LongCall<Left, (), State = Agv>, gate: u8) -> Result<(), ServiceError>;
/// }
///
/// /// A task looks at it each time that the wheels have turned.
/// #[derive(Default)]
/// struct Agv { docking: Option<TypedTaken<Agv, Left, ()>> }
///
/// impl Dock for Agv {
///     fn dock(&mut self, call: &impl LongCall<Left, (), State = Agv>, gate: u8) -> Result<(), ServiceError> {
///         self.docking = Some(call.take());
///         Ok(())
///     }
/// }
///
/// /// What the task does with the call that it has found in `docking`.
/// async fn follow(call: TypedTaken<Agv, Left, ()>) {
///     while !call.is_cancelled() {
///         let left = metres_left().await;
///         if left == 0.0 {
///             return call.finish(&()).await;
///         }
///         // An error if values come faster than every 10 ms: this one is skipped.
///         let _ = call.progress(&Left { left });
///     }
/// }
/// # async fn metres_left() -> f32 { 0.0 }
/// ```
pub trait LongCall<P: Variables, F: Variables = ()>: TypedCall<P, F> {
    /// The state of the unit.
    type State: 'static;

    /// Takes the call, which is answered by what this returns. Once: of a call that is taken twice, the second has no caller.
    fn take(&self) -> TypedTaken<Self::State, P, F>;
}

impl<T: 'static, P: Variables, F: Variables> LongCall<P, F> for Served<T> {
    type State = T;

    fn take(&self) -> TypedTaken<T, P, F> {
        let running = self.running.take();
        if let Some(running) = &running {
            self.unit.look(|machine| machine.own(running.link, Owned::taken(running)));
        }
        let call = TakenCall {
            unit: self.unit,
            running,
            caller: self.caller.clone(),
            priority: self.priority,
            deadline: self.deadline,
            wants_reply: self.wants_reply,
            lease: self.lease,
        };
        TypedTaken { call, types: PhantomData }
    }
}

/// A [`TakenCall`] of an interface, with what it tells and its failures as the interface declares them.
#[must_use = "the caller waits for the reply"]
pub struct TypedTaken<T: 'static, P, F = ()> {
    call: TakenCall<T>,
    types: PhantomData<fn(P, F)>,
}

impl<T, P, F> fmt::Debug for TypedTaken<T, P, F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.call.fmt(f)
    }
}

impl<T, P, F> Deref for TypedTaken<T, P, F> {
    type Target = TakenCall<T>;

    fn deref(&self) -> &TakenCall<T> {
        &self.call
    }
}

impl<T, P: Variables, F: Variables> TypedTaken<T, P, F> {
    /// As [`TakenCall::progress`].
    pub fn progress(&self, values: &P) -> Result<(), Error> {
        values.with_parameters(|values| self.call.progress(values))?
    }

    /// Answers with results, as [`TakenCall::reply`] does: `()`, or a struct of no more than [`FAILURE_VALUES_BYTES`].
    pub async fn finish(self, results: &impl Variables) {
        let mut parameters = Parameters::<FAILURE_VALUES_BYTES>::sized();
        let written = results.to_parameters(&mut parameters).map_err(|_| ServiceError::BadResults);
        self.call.reply(written.map(|()| &*parameters)).await;
    }

    /// Answers with a failure, as [`TypedCall::fail_with`] makes it.
    pub async fn fail_with(self, code: u16, text: &str, values: &F) {
        self.call.fail(&failure(code, text, values)).await;
    }
}
