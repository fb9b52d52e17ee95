//! Typed services on boards: how a unit's list takes the functions of an interface.

use core::fmt;

use cara_core::config::Priority;
#[cfg(feature = "details")]
use cara_core::distribution::failure::Failure;
use cara_core::distribution::function::{Attributes, Signature};
use cara_core::distribution::function_list::FunctionList;
use cara_core::distribution::identity::Identity;
use cara_core::error::Error;
use cara_core::services::lease::{Ended, Lease};
use cara_core::time::Instant;
use cara_core::typed::{AnyCall, Free, Functions, Interface, Method, Reader, ReaderFunctions};

use crate::functions::MyFunctionList;
use crate::handler::{Handler, Hook, Safe, Served, ServiceOptions};
use crate::lease::LeaseWatch;

/// What functions of an interface move, stop or reset: see [`ServiceOptions::lease`].
///
#[cfg_attr(feature = "derive", doc = "```")]
#[cfg_attr(not(feature = "derive"), doc = "```ignore")]
/// use cara_core::ServiceError;
/// use cara_core::error::Error;
/// use cara_core::services::heart::{Heart, Renew};
/// use cara_core::services::lease::Lease;
/// use cara_core::time::Duration;
/// use cara_embassy::{Actuator, Handle, Peer, interface, now};
/// use embassy_time::Timer;
///
/// #[interface]
/// trait Agv {
///     #[actuator(drive)]
///     #[lease(ms = 400)]
///     fn go_to(&mut self, x: i64) -> Result<(), ServiceError>;
/// }
///
/// struct Vehicle { target: i64 }
///
/// impl Agv for Vehicle {
///     fn go_to(&mut self, x: i64) -> Result<(), ServiceError> {
///         self.target = x;
///         Ok(())
///     }
/// }
///
/// /// The motors' interrupt reads it too: `DRIVE.is_live(now())`.
/// static DRIVE: Lease = Lease::new();
///
/// fn cut_power() { /* a pin */ }
///
/// fn offer(vehicle: Handle<Vehicle>) -> Result<(), Error> {
///     vehicle.my_function_list().serve(AgvServer { drive: Actuator::new(&DRIVE, &cut_power) })?;
///     vehicle.publish_my_function_list()
/// }
///
/// /// In a manager: the vehicle drives while this loop beats its heart, for three seconds here.
/// async fn drive<T>(vehicle: &Peer<T>) {
///     static HEART: Heart = Heart::new(Duration::from_millis(200));
///     HEART.beat(now());
///     let call = AgvClient::at(vehicle).go_to(5).renewing(Renew::Heart(HEART.beats())).hold();
///     // Dropped at the end, the hold stops the vehicle.
///     let Ok(_order) = call.await else { return };
///     for _ in 0..30 {
///         HEART.beat(now());
///         Timer::after_millis(100).await;
///     }
/// }
/// ```
pub struct Actuator<T: 'static> {
    lease: &'static Lease,
    safe: &'static Safe,
    then: Option<&'static Hook<T>>,
}

impl<T> fmt::Debug for Actuator<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Actuator").finish_non_exhaustive()
    }
}

impl<T> Clone for Actuator<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Actuator<T> {}

impl<T> Actuator<T> {
    /// What a lease is of, and what makes it safe.
    pub const fn new(lease: &'static Lease, safe: &'static Safe) -> Self {
        Self { lease, safe, then: None }
    }

    /// Runs each time after `safe`, with the application's state.
    pub const fn then(self, hook: &'static Hook<T>) -> Self {
        Self { then: Some(hook), ..self }
    }
}

impl<T> AnyCall for Served<T> {
    type Order = LeaseWatch;

    fn order(&self) -> Option<LeaseWatch> {
        self.lease
    }

    #[cfg(feature = "details")]
    fn fail(&self, failure: Failure) -> cara_core::error::ServiceError {
        Self::fail(self, failure)
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

impl<T: 'static> MyFunctionList<T> {
    /// Adds all functions of an interface, which the unit's state implements. Adding them makes nothing visible. The errors of
    /// [`add_service`](Self::add_service); functions before the one that was refused stay.
    pub fn serve(&self, interface: impl Interface<T, Self>) -> Result<(), Error> {
        interface.add_to(self)
    }

    fn add(
        &self,
        signature: Signature<'_>,
        attributes: Attributes,
        actuator: Option<&Actuator<T>>,
        handler: Handler<T>,
    ) -> Result<(), Error> {
        let mut options = ServiceOptions { attributes, ..ServiceOptions::new() };
        if let Some(actuator) = actuator {
            options.lease = Some(actuator.lease);
            // What stops or resets has no hook of its own.
            if attributes.lease.is_some() {
                (options.safe, options.then) = (Some(actuator.safe), actuator.then);
            }
        }
        self.put(signature, options, handler, FunctionList::add_signature)
    }
}

impl<T: 'static> Functions<T> for MyFunctionList<T> {
    type Call = Served<T>;
    type Actuator = Actuator<T>;

    fn add_method(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Actuator<T>>,
        run: &'static Method<T, Served<T>>,
    ) -> Result<(), Error> {
        self.add(signature, attributes, actuator, Handler::method(run))
    }

    fn add_free(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Actuator<T>>,
        run: &'static Free<Served<T>>,
    ) -> Result<(), Error> {
        self.add(signature, attributes, actuator, Handler::free(run))
    }
}

impl<T: 'static> ReaderFunctions<T> for MyFunctionList<T> {
    fn add_reader(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Actuator<T>>,
        _: &'static Reader<T, Served<T>>,
        method: &'static Method<T, Served<T>>,
    ) -> Result<(), Error> {
        self.add_method(signature, attributes, actuator, method)
    }
}
