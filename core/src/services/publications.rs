//! Visibility of a unit's functions: to all nodes, including those that join later, or to one identity, also after it
//! reconnects (paper, listing lines 23 and 24).

use crate::distribution::function_list::Slot;
use crate::distribution::identity::Identity;
use crate::error::{Error, Limit};
use crate::services::run_times::RunTimes;
use crate::storage::Storage;

/// A function that is visible to one identity.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PublishedToOne {
    identity: Identity,
    slot: Slot,
}

/// What a unit keeps about its functions beside their list: who sees them, and their run times.
pub struct Publications<S: Storage> {
    to_all: S::Slice<bool>,
    to_one: S::Slice<Option<PublishedToOne>>,
    version: u32,
    /// The functions' run times, for admission.
    pub(crate) run_times: RunTimes,
}

impl<S: Storage> Publications<S> {
    /// Tables with one flag per function of the unit's list, and one slot in `to_one` for each function shown to a single node.
    pub fn new(to_all: S::Slice<bool>, to_one: S::Slice<Option<PublishedToOne>>) -> Self {
        Self { to_all, to_one, version: 0, run_times: RunTimes::default() }
    }

    /// Shows a function to every node.
    pub fn publish_to_all(&mut self, slot: Slot) -> Result<(), Error> {
        let flag = self.to_all.get_mut(usize::from(slot.0)).ok_or(Error::Full(Limit::Functions))?;
        *flag = true;
        self.version = self.version.wrapping_add(1);
        Ok(())
    }

    /// Shows a function to one node.
    pub fn publish_to(&mut self, identity: &Identity, slot: Slot) -> Result<(), Error> {
        self.version = self.version.wrapping_add(1);
        if self.is_visible(identity, slot) {
            return Ok(());
        }
        let place = self.to_one.iter_mut().find(|place| place.is_none()).ok_or(Error::Full(Limit::Functions))?;
        *place = Some(PublishedToOne { identity: identity.clone(), slot });
        Ok(())
    }

    /// Hides a function from everybody.
    pub fn withdraw(&mut self, slot: Slot) {
        self.version = self.version.wrapping_add(1);
        if let Some(flag) = self.to_all.get_mut(usize::from(slot.0)) {
            *flag = false;
        }
        for place in self.to_one.iter_mut() {
            place.take_if(|published| published.slot == slot);
        }
    }

    /// Differs after each change.
    pub(crate) const fn version(&self) -> u32 {
        self.version
    }

    /// Whether a node may see a function.
    pub fn is_visible(&self, identity: &Identity, slot: Slot) -> bool {
        let to_all = self.to_all.get(usize::from(slot.0)).copied().unwrap_or(false);
        to_all || self.to_one.iter().flatten().any(|shown| shown.slot == slot && shown.identity == *identity)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::storage::Boxed;
    use std::vec;
    use std::vec::Vec;

    #[test]
    fn what_is_published_to_one_is_hidden_from_others() {
        let mut publications: Publications<Boxed> =
            Publications::new(vec![false; 3].into_boxed_slice(), vec![None; 2].into_boxed_slice());
        let (one, other) = (Identity::s_unit("one", 1).unwrap(), Identity::s_unit("other", 2).unwrap());
        publications.publish_to(&one, Slot(1)).unwrap();
        publications.publish_to_all(Slot(2)).unwrap();
        let visible_to = |publications: &Publications<Boxed>, node: &Identity| {
            (0..3).map(Slot).filter(|&slot| publications.is_visible(node, slot)).collect::<Vec<_>>()
        };
        assert_eq!(visible_to(&publications, &one), [Slot(1), Slot(2)]);
        assert_eq!(visible_to(&publications, &other), [Slot(2)]);
        publications.withdraw(Slot(1));
        publications.withdraw(Slot(2));
        assert_eq!(visible_to(&publications, &one), []);
    }

    #[test]
    fn a_full_record_says_so() {
        let mut publications: Publications<Boxed> =
            Publications::new(vec![false; 1].into_boxed_slice(), vec![None; 1].into_boxed_slice());
        let (one, other) = (Identity::s_unit("one", 1).unwrap(), Identity::s_unit("other", 2).unwrap());
        publications.publish_to(&one, Slot(0)).unwrap();
        publications.publish_to(&one, Slot(0)).unwrap();
        assert_eq!(publications.publish_to(&other, Slot(0)), Err(Error::Full(Limit::Functions)));
        assert_eq!(publications.publish_to_all(Slot(1)), Err(Error::Full(Limit::Functions)));
    }
}
