//! The port trait over the virtual network, and the bounded pool of buffers.

use std::net::SocketAddr;

use cara_core::error::CloseReason;
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::storage::Buffers;

use crate::event::{HostId, StreamId};
use crate::network::Network;
use crate::storage::Boxed;

/// Sends for one unit.
pub(super) struct SimMailman<'n> {
    pub(super) network: &'n mut Network,
    pub(super) host: HostId,
    /// The stream of each link.
    pub(super) streams: &'n [Option<StreamId>],
}

impl Mailman<SocketAddr> for SimMailman<'_> {
    fn write(&mut self, link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let stream = self.streams.get(usize::from(link.0)).copied().flatten().ok_or(CloseReason::Reset)?;
        self.network.write(stream, slices).map_err(|_| CloseReason::Reset)
    }

    fn send_to(&mut self, to: SocketAddr, datagram: &[u8]) -> bool {
        self.network.send_to(self.host, to, datagram)
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.network.broadcast(self.host, datagram)
    }
}

/// Message buffers, made when they are first needed and never more than the limit.
pub(super) struct LazyPool {
    size: usize,
    left: usize,
    free: Vec<Box<[u8]>>,
}

impl LazyPool {
    pub(super) fn new(size: usize, limit: usize) -> Self {
        Self { size, left: limit, free: Vec::new() }
    }

    /// Buffers that could be taken now.
    pub(super) fn free(&self) -> usize {
        self.left + self.free.len()
    }
}

impl Buffers<Boxed> for LazyPool {
    fn take(&mut self) -> Option<Box<[u8]>> {
        if let Some(buffer) = self.free.pop() {
            return Some(buffer);
        }
        self.left = self.left.checked_sub(1)?;
        Some(vec![0; self.size].into_boxed_slice())
    }

    fn give(&mut self, buffer: Box<[u8]>) {
        self.free.push(buffer);
    }
}
