//! Typed services on Linux: how a unit's list takes the functions of an interface, and how its clients call a peer.

use std::task::{Context, Poll};

use cara_core::config::Priority;
use cara_core::distribution::failure::Failure;
use cara_core::distribution::function::{Attributes, Signature};
use cara_core::distribution::function_list::FunctionList;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::services::call::{BlockingCaller, Callee, Caller, Outgoing};
use cara_core::services::lease::Ended;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::time::Instant;
use cara_core::typed::{AnyCall, Free, Functions, Interface, Method, Reader, ReaderFunctions};

use crate::actuator::Actuator;
use crate::engine::details::Canceller;
use crate::engine::worker::room;
use crate::engine::{Answered, Pending};
use crate::error::{BoxedDetail, CallError};
use crate::handler::{IntoHandler, Reads, Served, ServiceOptions};
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

    fn notify(&self, progress: &ParametersView) -> Result<(), Error> {
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
    /// LiftClient::at(&fork).lift_to(1.5).wait()?;
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

impl<T: Send + Sync + 'static> ReaderFunctions<T> for MyFunctionList<'_, T> {
    fn add_reader(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Actuator>,
        read: &'static Reader<T, Served>,
        method: &'static Method<T, Served>,
    ) -> Result<(), Error> {
        // Calls that move one thing never overtake each other, as readers might.
        if actuator.is_some() || attributes.stop || attributes.reset {
            return self.add_method(signature, attributes, actuator, method);
        }
        self.add(signature, attributes, None, Reads(read))
    }
}

impl<T: Send + 'static> Caller for Peer<T> {
    type Pending = Pending<T>;
    type Answered = Answered;
    type Hold = Hold<T>;
    type Details = BoxedDetail;
    type Room = Box<ParametersView>;
    type Canceller = Canceller;

    fn room(bytes: usize) -> Option<Box<ParametersView>> {
        Some(room(bytes))
    }

    fn send(
        &self,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
    ) -> Result<CallId, CallError> {
        self.engine.request(&self.link()?, callee, parameters, options)
    }

    fn poll(
        &self,
        pending: &mut Option<Pending<T>>,
        mut outgoing: Outgoing<'_, Canceller>,
        cx: &mut Context<'_>,
    ) -> Poll<Result<Answered, CallError>> {
        let pending = match pending {
            Some(pending) => pending,
            None => pending.insert(Pending::new(&self.engine, self.link()?, outgoing.callee, outgoing.options)),
        };
        pending.poll(&mut outgoing, cx)
    }

    fn hold(&self, call: Answered) -> Hold<T> {
        Hold { engine: self.engine.clone(), call }
    }
}

impl<T: Send + 'static> BlockingCaller for Peer<T> {
    fn wait(&self, outgoing: Outgoing<'_, Canceller>) -> Result<Answered, CallError> {
        let link = self.link()?;
        let id = self.engine.block_request(&link, outgoing)?;
        Ok(Answered { link, id })
    }
}
