//! The node and what it publishes, under their lock.

use std::collections::HashMap;
use std::sync::Mutex;

use cara_core::distribution::connection_handler::Command;
use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::host::mailman::LinkId;
use cara_core::services::hub::{Door, Hub};
use core::net::SocketAddr;

use super::driving::Driver;
use super::link::Linux;
use crate::locks::{Locked, Rank};

/// What the hub's lock protects. Nothing is locked under it but the ring of keys, for a moment.
pub(crate) struct HubCell {
    pub(crate) hub: Hub<Linux>,
    serial: u32,
    /// The serial of the link that last had an index: what the hub says of an index is meant for that one.
    pub(super) serials: HashMap<LinkId, u32>,
}

/// The hub as the threads share it.
pub(crate) struct SharedHub(pub(super) Mutex<HubCell>);

impl SharedHub {
    #[track_caller]
    pub(crate) fn lock(&self) -> Locked<'_, HubCell> {
        Rank::Hub.lock(&self.0)
    }

    /// Holds the clock up, from a test that goes on with a call, as no thread of the unit does.
    #[cfg(test)]
    pub(super) fn freeze(&self) -> std::sync::MutexGuard<'_, HubCell> {
        crate::locks::lock(&self.0)
    }
}

impl HubCell {
    pub(crate) fn new(hub: Hub<Linux>) -> Self {
        Self { hub, serial: 0, serials: HashMap::new() }
    }

    /// The serial of the link that a command is for. Another link may have its index by the time that it is passed on.
    pub(super) fn serial_of(&self, command: &Command<SocketAddr>) -> Option<u32> {
        match command {
            Command::Dial { .. } => None,
            Command::Notify(link, _) => self.serials.get(link).copied(),
        }
    }

    /// Longest block of parameters that this unit takes.
    pub(crate) fn longest_message(&self) -> usize {
        self.hub.node.constraints().message_size as usize
    }

    pub(crate) fn identity(&self) -> (Identity, Fleet) {
        (self.hub.node.identity().clone(), self.hub.node.fleet())
    }

    /// A link gets an index: its serial.
    pub(super) fn open(&mut self, link: LinkId) -> u32 {
        self.serial = self.serial.wrapping_add(1);
        self.serials.insert(link, self.serial);
        self.serial
    }
}

/// The hub, for sessions: under the lock of one link.
pub(super) struct HubDoor<'e> {
    pub(super) hub: &'e SharedHub,
    pub(super) driver: &'e Driver,
}

impl Door<Linux> for HubDoor<'_> {
    fn enter(&mut self, act: &mut dyn FnMut(&mut Hub<Linux>)) {
        let due = {
            let mut cell = self.hub.lock();
            act(&mut cell.hub);
            cell.hub.node.next_deadline()
        };
        // What concerns other links is passed on by the clock.
        self.driver.wake_at(due);
    }
}
