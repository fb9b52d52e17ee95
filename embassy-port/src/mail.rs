//! The core's port trait over embassy-net.

use core::net::{Ipv4Addr, SocketAddrV4};
use core::task::{Context, Poll, Waker};

use cara_core::error::CloseReason;
use cara_core::host::mailman::{LinkId, Mailman};
use embassy_net::udp::UdpSocket;
use embassy_net::{IpAddress, IpEndpoint, Stack};

use crate::line::Line;

/// Sends for one unit: its links over their sockets, everything else over one UDP socket.
pub(crate) struct EmbassyMailman {
    /// The socket of each link.
    pub(crate) lines: &'static mut [Line],
    pub(crate) udp: UdpSocket<'static>,
    /// Where units of this mode listen for broadcasts.
    pub(crate) port: u16,
    pub(crate) stack: Stack<'static>,
}

impl Mailman<SocketAddrV4> for EmbassyMailman {
    fn write(&mut self, link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        self.lines.get_mut(usize::from(link.0)).ok_or(CloseReason::Reset)?.write(slices)
    }

    fn send_to(&mut self, to: SocketAddrV4, datagram: &[u8]) -> bool {
        send(&self.udp, to, datagram)
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        let Some(config) = self.stack.config_v4().filter(|_| self.stack.is_link_up()) else { return false };
        let all = config.address.broadcast().unwrap_or(Ipv4Addr::BROADCAST);
        send(&self.udp, SocketAddrV4::new(all, self.port), datagram)
    }
}

fn send(udp: &UdpSocket<'static>, to: SocketAddrV4, datagram: &[u8]) -> bool {
    let to = IpEndpoint::new(IpAddress::Ipv4(*to.ip()), to.port());
    // No task waits for send space on this socket, so the no-op waker displaces none.
    let sent = udp.poll_send_to(datagram, to, &mut Context::from_waker(Waker::noop()));
    matches!(sent, Poll::Ready(Ok(())))
}
