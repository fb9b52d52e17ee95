//! A unit's own list of functions (paper: `my_function_list`).

use std::sync::Arc;

use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::{FunctionList, Slot};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::lease::Lease;

use crate::engine::{Engine, arena_bytes, read, write};
use crate::handler::{Handler, IntoHandler, ServiceOptions};
use crate::lease::LeaseWatch;
use crate::storage::Boxed;

/// The functions that a unit offers. Adding one makes nothing visible: that is what publishing is for.
pub struct MyFunctionList<'u, T: Send + 'static> {
    pub(crate) engine: &'u Arc<Engine<T>>,
}

impl<T: Send + 'static> MyFunctionList<'_, T> {
    /// Adds a function whose arguments are also its results (paper, listing line 22).
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
    /// [`Error::TooLarge`] when arguments and results are declared larger than any call can be served with.
    pub fn add_service<Form>(
        &self,
        definition: &Definition,
        options: ServiceOptions<T>,
        handler: impl IntoHandler<T, Form>,
    ) -> Result<LeaseWatch, Error> {
        self.put(definition, options, handler, FunctionList::add_function)
    }

    /// Changes a function. Whoever knows the old one gets [`Error::StaleFunction`] until it is published again.
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
        self.engine.make_room_for(bytes);
        Ok(())
    }

    fn put<Form>(
        &self,
        definition: &Definition,
        options: ServiceOptions<T>,
        handler: impl IntoHandler<T, Form>,
        put: impl FnOnce(&mut FunctionList<Boxed, Handler<T>>, &Definition, Attributes, Handler<T>) -> Result<Slot, Error>,
    ) -> Result<LeaseWatch, Error> {
        self.check_size(definition)?;
        let lease = Arc::new(Lease::new());
        let attributes =
            Attributes { priority: options.priority, lease: options.lease, idempotent: options.idempotent };
        let kept = options.lease.map(|_| lease.clone());
        let handler =
            Handler { run: handler.into_run().0, lease: kept, safe: options.safe, detached: options.detached };
        put(&mut write(&self.engine.functions), definition, attributes, handler)?;
        Ok(LeaseWatch::new(lease, self.engine.clock))
    }

    /// Removes a function; peers are told.
    pub fn remove(&self, name: &str) -> Result<(), Error> {
        self.engine.remove_function(name)
    }

    /// The service has finished what its caller started: the lease ends, and no hook runs.
    pub fn end_lease(&self, name: &str) {
        let Some(slot) = read(&self.engine.functions).find(name) else { return };
        for link in self.engine.each_link() {
            let mut state = link.lock();
            self.engine.with(&link, &mut state, |session, cx| session.end_lease(cx, slot));
            self.engine.settle(&link, state);
        }
    }

    /// How many functions there are.
    pub fn len(&self) -> usize {
        read(&self.engine.functions).len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    #[cfg(feature = "control")]
    pub(crate) fn names(&self) -> Vec<String> {
        read(&self.engine.functions).iter().map(|function| function.name().to_owned()).collect()
    }

    /// One line per function.
    pub fn show_functions(&self) -> String {
        read(&self.engine.functions).show_functions().to_string()
    }
}
