//! Visibility of the unit's functions.

use cara_core::distribution::identity::Identity;
use cara_core::error::Error;

use crate::machine::Machine;
use crate::port::{LinkContext, LinkSession};

impl<T> Machine<T> {
    /// Does something on each link; one that is not live yet may have told its list.
    pub(crate) fn each_link(&mut self, mut act: impl FnMut(&mut LinkSession, &mut LinkContext<'_>)) {
        for index in self.indices() {
            self.with(index, &mut act);
        }
    }

    /// Shows all functions to all nodes.
    pub(crate) fn publish(&mut self) -> Result<(), Error> {
        let Self { functions, hub, .. } = self;
        functions.iter().try_for_each(|function| hub.publications.publish_to_all(function.slot))?;
        for index in self.indices() {
            self.notify_list(index);
        }
        Ok(())
    }

    /// Shows all functions to one node.
    pub(crate) fn publish_to(&mut self, identity: &Identity) -> Result<(), Error> {
        let Self { functions, hub, .. } = self;
        functions.iter().try_for_each(|function| hub.publications.publish_to(identity, function.slot))?;
        if let Some(index) = self.link_to(identity) {
            self.notify_list(index);
        }
        Ok(())
    }

    fn notify_list(&mut self, index: u16) {
        if self.link(index).is_none_or(|link| !link.is_live()) {
            return;
        }
        let serial = self.with(index, |session, cx| session.publish(cx));
        if let Some(link) = self.link_mut(index) {
            link.reported = serial;
        }
    }

    /// The life of a link, and the serial of the list that its peer was last told.
    pub(crate) fn reported(&self, index: u16) -> Option<(u32, u32)> {
        let link = self.link(index).filter(|link| link.is_live())?;
        Some((link.serial, link.reported?))
    }

    /// Whether the peer of that life of the link has read the list, or has left.
    pub(crate) fn has_read(&self, index: u16, serial: u32, reported: u32) -> bool {
        let link = self.link(index).filter(|link| link.serial == serial && link.is_live());
        link.and_then(|link| link.session.as_ref()).is_none_or(|session| session.is_acknowledged(reported))
    }
}
