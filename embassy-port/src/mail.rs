//! The core's port trait over embassy-net.

use core::net::{IpAddr, Ipv4Addr, SocketAddr};
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

impl Mailman for EmbassyMailman {
    fn write(&mut self, link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        self.lines.get_mut(usize::from(link.0)).ok_or(CloseReason::Reset)?.write(slices)
    }

    fn send_to(&mut self, to: SocketAddr, datagram: &[u8]) -> bool {
        let IpAddr::V4(address) = to.ip() else { return false };
        send(&self.udp, address, to.port(), datagram)
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        let Some(config) = self.stack.config_v4().filter(|_| self.stack.is_link_up()) else { return false };
        let all = config.address.broadcast().unwrap_or(Ipv4Addr::BROADCAST);
        send(&self.udp, all, self.port, datagram)
    }
}

fn send(udp: &UdpSocket<'static>, address: Ipv4Addr, port: u16, datagram: &[u8]) -> bool {
    let to = IpEndpoint::new(IpAddress::Ipv4(address), port);
    // No task waits for send space on this socket, so the no-op waker displaces none.
    let sent = udp.poll_send_to(datagram, to, &mut Context::from_waker(Waker::noop()));
    matches!(sent, Poll::Ready(Ok(())))
}
