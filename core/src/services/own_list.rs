//! Changes of a unit's own function list while something is stopped: one rule for all ports.
//!
//! A latch (docs/concepts.md, "Stop and reset") belongs to an actuator, or to the unit after a stop of all. It survives every
//! change of the list: a new service starts latched if the unit is, a replacement inherits the latch, and a removed service
//! leaves it to the others of its actuator, those that stop or reset it included, or else to the unit. Only a reset ends it.

use super::lease::{Lease, Service};
use crate::distribution::function::{Attributes, Definition, Signature};
use crate::distribution::function_list::{FunctionList, Slot};
use crate::error::Error;
use crate::storage::Storage;

impl<S: Storage, H: Service + 'static> FunctionList<S, H> {
    /// Adds a function; [`Error::NameTaken`] or [`Error::Full`] leave the list unchanged. Its actuator is latched if the unit is.
    pub fn add_function(&mut self, definition: &Definition, attributes: Attributes, handler: H) -> Result<Slot, Error> {
        self.add_signature(definition.signature(), attributes, handler)
    }

    /// As [`add_function`](Self::add_function), with a signature.
    pub fn add_signature(
        &mut self,
        signature: Signature<'_>,
        attributes: Attributes,
        handler: H,
    ) -> Result<Slot, Error> {
        let is_known = handler.lease().is_some_and(|lease| self.lists(lease));
        let slot = self.insert(signature, attributes, handler)?;
        let lease = self.function(slot).and_then(|function| function.handler.lease());
        if let Some(lease) = lease.filter(|_| !is_known) {
            lease.inherit(self.stopped());
        }
        Ok(slot)
    }

    /// Replaces the function of this name; [`Error::UnknownFunction`] or [`Error::Full`] leave the list unchanged. If it moves an
    /// actuator, that is latched if the previous function's was. If it moves none, and the previous one's actuator was latched and
    /// has no other function in the list, the unit is latched: functions of actuators that come into the list later are latched,
    /// until a reset of all.
    pub fn replace(&mut self, definition: &Definition, attributes: Attributes, handler: H) -> Result<Slot, Error> {
        self.replace_signature(definition.signature(), attributes, handler)
    }

    /// As [`replace`](Self::replace), with a signature.
    pub fn replace_signature(
        &mut self,
        signature: Signature<'_>,
        attributes: Attributes,
        handler: H,
    ) -> Result<Slot, Error> {
        let previous = self.find(signature.name()).and_then(|slot| self.function(slot));
        let moved = previous.is_some_and(|previous| previous.attributes.lease.and(previous.handler.lease()).is_some());
        // What moves in place of what moved is latched as that was. The unit's latch, of before its reset, is no news to it.
        let takes_over = moved && attributes.lease.is_some();
        let is_known = handler.lease().is_some_and(|lease| self.lists(lease));
        let (slot, replaced) = self.swap(signature, attributes, handler)?;
        let lease = self.function(slot).and_then(|function| function.handler.lease());
        match (lease.filter(|_| attributes.lease.is_some()), replaced.lease()) {
            (Some(lease), Some(replaced)) => lease.inherit(replaced.latch_word()),
            (None, Some(replaced)) if !self.lists(replaced) => self.stopped().inherit_removed(replaced.latch_word()),
            _ => {}
        }
        // Behind that: the unit may just have been latched.
        if let Some(lease) = lease.filter(|_| !is_known && !takes_over) {
            lease.inherit(self.stopped());
        }
        Ok(slot)
    }

    /// Removes a function and returns its slot and handler; [`Error::UnknownFunction`]. If its actuator is latched and no other
    /// function in the list is of it, functions of actuators that come into the list later are latched, until a reset of all.
    pub fn remove(&mut self, name: &str) -> Result<(Slot, H), Error> {
        let (slot, handler) = self.take(name)?;
        if let Some(lease) = handler.lease().filter(|lease| !self.lists(lease)) {
            self.stopped().inherit_removed(lease.latch_word());
        }
        Ok((slot, handler))
    }

    /// Whether any function in the list has this lease: moves, stops or resets what it is of.
    fn lists(&self, lease: &Lease) -> bool {
        self.iter().filter_map(|function| function.handler.lease()).any(|known| core::ptr::eq(known, lease))
    }
}

#[cfg(test)]
impl Service for u32 {}
