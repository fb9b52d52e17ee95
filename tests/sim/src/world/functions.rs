//! A unit's own list of functions.

use std::rc::Rc;

use cara_core::distribution::function::Definition;
use cara_core::error::Error;

use super::handle::UnitHandle;
use super::service::{Handler, Service};

/// The functions that a unit offers. Adding one makes nothing visible: that is what publishing is for.
#[derive(Clone, Copy, Debug)]
pub struct MyFunctionList<'u> {
    pub(super) unit: &'u UnitHandle,
}

impl MyFunctionList<'_> {
    /// Adds a service. The signature is in the text form, as in `pos_info() -> (position: int[2])`.
    ///
    /// # Panics
    /// For a signature that cannot be read.
    pub fn add_service(&self, signature: &str, service: Service) -> Result<(), Error> {
        let definition = definition(signature);
        let attributes = service.attributes;
        self.unit.machine(|machine, _| {
            machine.links.functions.add_function(&definition, attributes, Handler(Rc::new(service))).map(|_| ())
        })?
    }

    /// Replaces the service of the same name; peers that knew the old one get the new one when it is published.
    ///
    /// # Panics
    /// For a signature that cannot be read.
    pub fn replace(&self, signature: &str, service: Service) -> Result<(), Error> {
        let definition = definition(signature);
        let attributes = service.attributes;
        let replaced = self.unit.machine(|machine, _| {
            let functions = &mut machine.links.functions;
            let before = functions.find(definition.name()).and_then(|slot| functions.function(slot));
            let before = before.map(|function| Rc::clone(&function.handler.0));
            functions.replace(&definition, attributes, Handler(Rc::new(service))).map(|_| before)
        })??;
        replaced.into_iter().for_each(|service| service.goes(self.unit));
        Ok(())
    }

    /// Removes a service; peers that saw it are told.
    pub fn remove(&self, name: &str) -> Result<(), Error> {
        let (slot, Handler(service)) = self.unit.machine(|machine, _| machine.links.functions.remove(name))??;
        service.goes(self.unit);
        self.unit.machine(|machine, _| machine.links.hub.publications.withdraw(slot))?;
        self.unit.each_link(|links, network, index| {
            links.with(network, index, |session, cx| session.withdraw(cx, slot));
        });
        Ok(())
    }

    /// All functions in the text form, one in a line.
    pub fn show_functions(&self) -> String {
        let shown = self.unit.machine(|machine, _| machine.links.functions.show_functions().to_string());
        shown.unwrap_or_default()
    }
}

fn definition(signature: &str) -> Definition {
    match Definition::parse(signature) {
        Ok(definition) => definition,
        Err(error) => panic!("`{signature}` is no signature: {error:?}"),
    }
}
