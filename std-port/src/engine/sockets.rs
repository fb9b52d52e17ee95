//! The unit's own sockets, and what is known of the network that they are in.

use std::sync::Mutex;

use cara_core::time::Instant;

use super::interfaces::InterfaceWatch;
use crate::sys::datagram::Datagrams;
use crate::sys::stream::Listener;

pub(super) struct Sockets {
    pub(super) datagrams: Datagrams,
    pub(super) listener: Option<Listener>,
    /// When connections are taken again, where there were no descriptors for them.
    pub(super) listens_at: Mutex<Option<Instant>>,
    pub(super) interfaces: Mutex<InterfaceWatch>,
}

impl Sockets {
    pub(super) fn new(datagrams: Datagrams, listener: Option<Listener>) -> Self {
        Self { datagrams, listener, listens_at: Mutex::new(None), interfaces: Mutex::default() }
    }

    /// Where the unit takes connections; 0 for nowhere.
    pub(super) fn tcp_port(&self) -> u16 {
        self.listener.as_ref().map_or(0, Listener::port)
    }
}
