//! The unit's own sockets, and what is known of the network that they are in.

use std::collections::HashSet;
use std::net::IpAddr;
use std::os::fd::{AsFd, BorrowedFd};
use std::sync::Mutex;

use cara_core::error::CloseReason;

use crate::locks::lock;
use crate::sys::datagram::{Datagrams, Socket};
use crate::sys::stream::Listener;
use crate::threads::Source;

/// Hosts that are remembered for the size of their segments. Beyond them all are forgotten, and found again.
const SHORTENED: usize = 256;

pub(crate) struct Sockets {
    pub(crate) datagrams: Datagrams,
    pub(super) listener: Option<Listener>,
    /// Hosts to which long packets do not come.
    short_segments: Mutex<HashSet<IpAddr>>,
}

impl Sockets {
    pub(super) fn new(datagrams: Datagrams, listener: Option<Listener>) -> Self {
        Self { datagrams, listener, short_segments: Mutex::default() }
    }

    /// All of them, as the clock watches them.
    pub(super) fn sources(&self) -> impl Iterator<Item = (Source, BorrowedFd<'_>)> {
        let datagrams =
            [Socket::Shared, Socket::Own].map(|socket| (Source::Datagrams(socket), self.datagrams.fd(socket)));
        let listener = self.listener.iter().map(|listener| (Source::Listener, listener.as_fd()));
        datagrams.into_iter().chain(listener)
    }

    /// Where the unit takes connections; 0 for nowhere.
    pub(crate) fn tcp_port(&self) -> u16 {
        self.listener.as_ref().map_or(0, Listener::port)
    }

    /// Whether the streams to a host have short segments.
    pub(super) fn shortens(&self, host: IpAddr) -> bool {
        lock(&self.short_segments).contains(&host)
    }

    /// Where long packets do not arrive, as it seems, the next streams have short segments. A board cannot limit those of a stream
    /// that it dials, so the next one that is accepted is limited here.
    pub(super) fn note_segments(&self, host: IpAddr, dialed: bool, reason: CloseReason) {
        let mut hosts = lock(&self.short_segments);
        if reason == (CloseReason::StreamDead { long: true }) {
            if hosts.len() >= SHORTENED {
                hosts.clear();
            }
            if hosts.insert(host) {
                tracing::warn!(%host, "long packets seem not to arrive: the next streams to it have segments of 536 bytes");
            }
        }
        if !dialed && hosts.contains(&host) {
            self.listener.iter().for_each(|listener| listener.limit_segments(true));
        }
    }
}
