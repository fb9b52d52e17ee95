//! The core's port trait over a network.

use core::net::SocketAddrV4;

use cara_core::error::CloseReason;
use cara_core::host::mailman::{LinkId, Mailman};

use crate::net::{Net, Socket};

/// Sends for one unit: its links over their connections, everything else as datagrams.
pub(crate) struct Mail {
    pub(crate) net: Net,
    /// The connection of each link.
    pub(crate) connections: &'static mut [Socket],
}

impl Mailman<SocketAddrV4> for Mail {
    fn write(&mut self, link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        self.connections.get_mut(usize::from(link.0)).ok_or(CloseReason::Reset)?.write(slices)
    }

    fn send_to(&mut self, to: SocketAddrV4, datagram: &[u8]) -> bool {
        self.net.send_to(to, datagram)
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.net.broadcast(datagram)
    }
}
