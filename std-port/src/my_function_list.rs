//! A unit's own list of functions (paper: `my_function_list`).

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use cara_core::config::Priority;
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::{FunctionList, Slot};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;

use crate::actuator::Actuator;
use crate::engine::{Engine, arena_bytes, clocks};
use crate::executor::Executor;
use crate::handler::{Handler, Hook, IntoHandler, Safe, Served, ServiceOptions};
use crate::lease::{LeaseWatch, ServiceLease};
use crate::safe_hook::{Parts, SafeHook};
use crate::storage::Boxed;

/// The functions that a unit offers. Adding one makes nothing visible: that is what publishing is for.
pub struct MyFunctionList<'u, T: Send + 'static> {
    pub(crate) engine: &'u Arc<Engine<T>>,
}

impl<T: Send + 'static> fmt::Debug for MyFunctionList<'_, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("MyFunctionList").finish_non_exhaustive()
    }
}

impl<T: Send + 'static> MyFunctionList<'_, T> {
    /// Adds a function whose arguments are also its results (paper, listing line 22).
    ///
    /// ```no_run
    /// use cara_std::{Parameters, Unit};
    ///
    /// let agv = Unit::new("agv", 7, "depot", 1)?;
    /// let mut pos = Parameters::new();
    /// pos.add_int("position", 2)?;
    /// agv.my_function_list().add_function("pos_info", &pos, |mut pos: Parameters| {
    ///     pos.set_value("position", [3, 4]).expect("it is declared so");
    ///     pos
    /// })?;
    /// agv.publish_my_function_list()?;
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn add_function<Form>(
        &self,
        name: &str,
        arguments: &ParametersView,
        handler: impl IntoHandler<T, Form>,
    ) -> Result<(), Error> {
        let definition = Definition::new(name)?.arguments(arguments)?.results(arguments)?;
        self.add_service(&definition, ServiceOptions::new(), handler).map(|_| ())
    }

    /// Adds a function by its definition, as made by `"go_to(position: int[2])".parse()`, with attributes. Returns its
    /// lease, which is dead unless the options ask for one.
    ///
    /// ```no_run
    /// use cara_std::{Served, Definition, ParametersView, ServiceError, ServiceOptions, Unit};
    ///
    /// fn double(_: &Served, parameters: &mut ParametersView) -> Result<(), ServiceError> {
    ///     let number: i64 = parameters.variable("number")?;
    ///     Ok(parameters.set_value("number", 2 * number)?)
    /// }
    ///
    /// let agv = Unit::new("agv", 7, "depot", 1)?;
    /// let signature = Definition::parse("double(number: int) -> (number: int)").expect("it is a signature");
    /// agv.my_function_list().add_service(&signature, ServiceOptions::new().idempotent(), double)?;
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    ///
    /// [`Error::TooLarge`] when arguments and results are declared larger than any call can be served with,
    /// [`Error::EmergencyWaits`] for a handler of an emergency service that takes the application's state or is a future,
    /// [`Error::Network`] when the system refuses the threads of a safe hook, of an emergency service, or of futures.
    pub fn add_service<Form>(
        &self,
        definition: &Definition,
        options: ServiceOptions<T>,
        handler: impl IntoHandler<T, Form>,
    ) -> Result<LeaseWatch, Error> {
        self.put(definition, options, handler, FunctionList::add_function)
    }

    /// Changes a function. A caller that knows the old one gets [`Error::StaleFunction`] until it is published again.
    pub fn replace<Form>(
        &self,
        definition: &Definition,
        options: ServiceOptions<T>,
        handler: impl IntoHandler<T, Form>,
    ) -> Result<LeaseWatch, Error> {
        self.put(definition, options, handler, FunctionList::replace)
    }

    /// Arguments and results get their declared sizes when a call is served, however short the message.
    fn check_size(&self, definition: &Definition) -> Result<(), Error> {
        let bytes = definition.signature().parameters_bytes() as usize;
        let limit = arena_bytes(usize::MAX);
        if bytes > limit {
            return Err(Error::TooLarge { limit: limit as u32 });
        }
        self.engine.services.make_room_for(bytes);
        Ok(())
    }

    pub(crate) fn put<Form>(
        &self,
        definition: &Definition,
        options: ServiceOptions<T>,
        handler: impl IntoHandler<T, Form>,
        put: impl FnOnce(&mut FunctionList<Boxed, Handler<T>>, &Definition, Attributes, Handler<T>) -> Result<Slot, Error>,
    ) -> Result<LeaseWatch, Error> {
        self.check_size(definition)?;
        let attributes = options.attributes;
        let run = handler.into_run().0;
        let is_emergency = attributes.priority == Priority::Emergency;
        if is_emergency && run.waits() {
            return Err(Error::EmergencyWaits);
        }
        #[cfg(feature = "async")]
        if matches!(run, crate::handler::Run::Task(_)) {
            self.engine.services.runner.make()?;
        }
        let executor = if is_emergency { Some(Arc::new(Executor::start("cara-emergency")?)) } else { None };
        let actuator = match (options.actuator, options.safe) {
            (Some(_), _) if options.then.is_some() => return Err(Error::BadConstraint),
            (None, Some(hook)) => Some(self.make_actuator(hook, options.then)?),
            (actuator, _) => actuator,
        };
        let watch = actuator.as_ref().map_or_else(|| self.never(), Actuator::watch);
        let handler = Handler {
            number: Handler::<T>::next_number(),
            run,
            actuator,
            moves: attributes.lease.is_some(),
            held_long: AtomicBool::new(false),
            executor,
            #[cfg(feature = "async")]
            to_its_end: options.to_its_end,
            stream: None,
        };
        put(&mut self.engine.services.functions_mut(), definition, attributes, handler)?;
        Ok(watch)
    }

    /// The lease of a service that has none.
    fn never(&self) -> LeaseWatch {
        LeaseWatch::new(Arc::default(), self.engine.driver.clock())
    }

    /// What several services [move](ServiceOptions::moves), with the hook that makes it safe: see
    /// [`ServiceOptions::lease`]. [`Error::Network`] when the system refuses the hook's thread.
    pub fn actuator(&self, safe: impl Fn() + Send + Sync + 'static) -> Result<Actuator, Error> {
        self.make_actuator(Arc::new(safe), None)
    }

    fn make_actuator(&self, hook: Arc<Safe>, then: Option<Arc<Hook<T>>>) -> Result<Actuator, Error> {
        let (lease, clock) = (Arc::<ServiceLease>::default(), self.engine.driver.clock());
        let then = then.map(|then| self.engine.services.afterwards(then)).transpose()?;
        let late = self.engine.accounts.hooks_late();
        let safe = Arc::new(SafeHook::start(Parts { lease: lease.clone(), clock, hook, then, late })?);
        let engine = Arc::downgrade(self.engine);
        let services = Arc::downgrade(&self.engine.services);
        self.engine.latch.start(move || services.upgrade().map(|services| services.latched()))?;
        let look = Arc::new(move |change| engine.upgrade().into_iter().for_each(|engine| engine.latch_changed(change)));
        Ok(Actuator { lease, safe, clock, look })
    }

    /// Adds the function `clock() -> (unix_us: int)`, which tells this host's time in microseconds since 1970. Managers to which the
    /// list is published call it now and then, and show how far this clock is from theirs.
    ///
    /// What [`add_service`](Self::add_service) refuses.
    pub fn add_clock(&self) -> Result<(), Error> {
        let definition = Definition::parse(clocks::SIGNATURE).map_err(|_| Error::BadName)?;
        let tell =
            |_: &Served, parameters: &mut ParametersView| Ok(parameters.set_value(clocks::UNIX_US, clocks::unix_us())?);
        self.add_service(&definition, ServiceOptions::new().idempotent(), tell).map(|_| ())
    }

    /// Removes a function; peers are told.
    pub fn remove(&self, name: &str) -> Result<(), Error> {
        self.engine.remove_function(name)
    }

    /// How many functions there are.
    pub fn len(&self) -> usize {
        self.engine.services.functions().len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    #[cfg(feature = "control")]
    pub(crate) fn names(&self) -> Vec<String> {
        self.engine.services.functions().iter().map(|function| function.name().to_owned()).collect()
    }

    /// One line per function.
    pub fn show_functions(&self) -> String {
        self.engine.services.functions().show_functions().to_string()
    }
}
