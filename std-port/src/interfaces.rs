//! Typed services on Linux: how a unit's list takes the functions of an interface, and how its clients call a peer.

use std::ops::{ControlFlow, DerefMut};

use cara_core::config::Priority;
use cara_core::distribution::failure::{CallFailure, Failure};
use cara_core::distribution::function::{Attributes, Signature};
use cara_core::distribution::function_list::FunctionList;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::services::lease::Ended;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::Instant;
use cara_core::typed::{AnyCall, BlockingCaller, Caller, Free, Functions, Interface, Method, WatchingCaller};

use crate::actuator::Actuator;
use crate::engine::room;
use crate::handler::{IntoHandler, Served, ServiceOptions};
use crate::heart::Hold;
use crate::lease::LeaseWatch;
use crate::my_function_list::MyFunctionList;
use crate::peer::Peer;

impl AnyCall for Served {
    type Order = LeaseWatch;

    fn order(&self) -> Option<LeaseWatch> {
        self.lease.clone()
    }

    fn fail(&self, failure: Failure) -> ServiceError {
        Self::fail(self, failure)
    }

    fn tell(&self, progress: &ParametersView) -> Result<(), Error> {
        Self::progress(self, progress)
    }

    fn is_cancelled(&self) -> bool {
        Self::is_cancelled(self)
    }

    fn caller(&self) -> &Identity {
        &self.caller
    }

    fn priority(&self) -> Priority {
        self.priority
    }

    fn deadline(&self) -> Instant {
        self.deadline
    }

    fn wants_reply(&self) -> bool {
        self.wants_reply
    }

    fn commit<R>(&self, change: impl FnOnce() -> R) -> Result<R, Ended> {
        Self::commit(self, change)
    }
}

impl<T: Send + 'static> MyFunctionList<'_, T> {
    /// Adds all functions of an interface, which the unit's state implements. Adding them makes nothing visible.
    ///
    /// ```no_run
    /// use cara_std::{ServiceError, Unit, interface};
    ///
    /// #[interface]
    /// trait Lift {
    ///     /// Tells how high it is.
    ///     #[returns(height)]
    ///     #[idempotent]
    ///     fn height(&mut self) -> f64;
    ///
    ///     #[actuator(motor)]
    ///     #[lease(ms = 400)]
    ///     fn lift_to(&mut self, #[unit = "m"] height: f64) -> Result<(), ServiceError>;
    /// }
    ///
    /// struct Fork { height: f64, target: f64 }
    ///
    /// impl Lift for Fork {
    ///     fn height(&mut self) -> f64 {
    ///         self.height
    ///     }
    ///
    ///     fn lift_to(&mut self, height: f64) -> Result<(), ServiceError> {
    ///         self.target = height;
    ///         Ok(())
    ///     }
    /// }
    ///
    /// let fork = Unit::builder("fork", 7, "depot", 1)?.state(Fork { height: 0.0, target: 0.0 }).build()?;
    /// let motor = fork.my_function_list().actuator(|| { /* cut the motor's power */ })?;
    /// fork.my_function_list().serve(LiftServer { motor })?;
    /// fork.publish_my_function_list()?;
    ///
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// let fork = depot.s_unit("fork")?;
    /// LiftClient::at(&fork).lift_to(1.5)?;
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// The errors of [`add_service`](Self::add_service); functions before the one that was refused stay.
    pub fn serve(&self, interface: impl Interface<T, Self>) -> Result<(), Error> {
        interface.add_to(self)
    }

    pub(crate) fn add<Form>(
        &self,
        signature: Signature<'_>,
        attributes: Attributes,
        actuator: Option<&Actuator>,
        run: impl IntoHandler<T, Form>,
    ) -> Result<(), Error> {
        let options = ServiceOptions { attributes, actuator: actuator.cloned(), ..ServiceOptions::default() };
        self.put(&signature.to_definition(), options, run, FunctionList::add_function).map(|_| ())
    }
}

impl<T: Send + 'static> Functions<T> for MyFunctionList<'_, T> {
    type Call = Served;
    type Actuator = Actuator;

    fn add_method(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Actuator>,
        run: &'static Method<T, Served>,
    ) -> Result<(), Error> {
        let run = move |state: &mut T, call: &Served, parameters: &mut ParametersView| -> Result<(), ServiceError> {
            run(state, call, parameters)
        };
        self.add(signature, attributes, actuator, run)
    }

    fn add_free(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Actuator>,
        run: &'static Free<Served>,
    ) -> Result<(), Error> {
        let run =
            move |call: &Served, parameters: &mut ParametersView| -> Result<(), ServiceError> { run(call, parameters) };
        self.add(signature, attributes, actuator, run)
    }
}

impl<T: Send + 'static> Caller for Peer<T> {
    fn published<R>(&self, function: &str, look: impl Fn(Option<Signature<'_>>) -> R) -> R {
        let Ok(link) = self.link() else { return look(None) };
        let state = link.lock();
        look(state.session.their_function_list().named(function).map(|function| function.signature))
    }

    fn room(bytes: usize) -> Option<impl DerefMut<Target = ParametersView> + Send> {
        Some(room(bytes))
    }

    fn send(&self, function: &str, parameters: &ParametersView, options: &RequestOptions) -> Result<CallId, Error> {
        self.request_with(function, parameters, options)
    }
}

impl<T: Send + 'static> BlockingCaller for Peer<T> {
    type Hold = Hold<T>;

    fn block(&self, function: &str, parameters: &mut ParametersView, options: &RequestOptions) -> Result<(), Error> {
        self.block_request_with(function, parameters, options)
    }

    fn block_and_hold(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<Hold<T>, Error> {
        self.hold(function, parameters, options)
    }
}

/// The error of a call, and in `why` what its service has said of it.
pub(crate) fn parted(failed: Box<CallFailure>, why: &mut Option<Failure>) -> Error {
    let CallFailure { error, failure } = *failed;
    *why = failure;
    error
}

impl<T: Send + 'static> WatchingCaller for Peer<T> {
    fn block_watched(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
        on_progress: impl FnMut(&ParametersView) -> ControlFlow<()>,
        why: &mut Option<Failure>,
    ) -> Result<(), Error> {
        let outcome = self.block_request_with_progress(function, parameters, options, on_progress);
        outcome.map_err(|failed| parted(failed, why))
    }
}

#[cfg(feature = "async")]
impl<T: Send + 'static> cara_core::typed::AwaitedCaller for Peer<T> {
    async fn call(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<(), Error> {
        self.request_async(function, parameters, options)?.await
    }
}

#[cfg(feature = "async")]
impl<T: Send + 'static> cara_core::typed::AwaitedWatcher for Peer<T> {
    async fn call_watched(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
        mut on_progress: impl FnMut(&ParametersView) -> ControlFlow<()>,
        why: &mut Option<Failure>,
    ) -> Result<(), Error> {
        let options = RequestOptions { progress: true, ..*options };
        let mut call = self.request_async(function, parameters, &options)?;
        while let Some(told) = call.progress().await {
            if on_progress(&told).is_break() {
                // Dropped here, the call is given up.
                return Err(Error::Cancelled);
            }
        }
        let outcome = (&mut call).await;
        *why = call.failure().map(|failure| *failure);
        outcome
    }
}
