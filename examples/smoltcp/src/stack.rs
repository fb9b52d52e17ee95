//! The network below: smoltcp's interface with one TCP and one UDP socket, and the core's [`Mailman`] over them.

use core::net::{SocketAddr, SocketAddrV4};

use cara_core::config::PLAIN_PORT;
use cara_core::error::CloseReason;
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::time::Instant;
use smoltcp::iface::{Config, Interface, PollIngressSingleResult, PollResult, SocketHandle, SocketSet};
use smoltcp::phy::Device;
use smoltcp::socket::{tcp, udp};
use smoltcp::wire::{EthernetAddress, HardwareAddress, IpCidr, Ipv4Cidr};

use crate::resources::{DATAGRAM_PORT, StackMemory};

/// First of the ports that links are opened from.
const FIRST_PORT: u16 = 49_152;

/// A stream that is closed is forgotten after this, if the other end does not answer.
const FAREWELL: smoltcp::time::Duration = smoltcp::time::Duration::from_secs(3);

/// Interface and sockets.
pub(crate) struct Stack {
    interface: Interface,
    sockets: SocketSet<'static>,
    stream: SocketHandle,
    datagrams: SocketHandle,
    address: Option<Ipv4Cidr>,
    /// The next link is opened from this port.
    port: u16,
}

/// What the stream can do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stream {
    Opening,
    Open,
    /// All that came has been read, and no more will come.
    Ended,
}

impl Stack {
    pub(crate) fn new<D: Device>(
        now: Instant,
        mac: [u8; 6],
        seed: u64,
        device: &mut D,
        memory: &'static mut StackMemory,
    ) -> Self {
        let mut config = Config::new(HardwareAddress::Ethernet(EthernetAddress(mac)));
        config.random_seed = seed;
        let [received, sent] = &mut memory.stream;
        let mut stream =
            tcp::Socket::new(tcp::SocketBuffer::new(&mut received[..]), tcp::SocketBuffer::new(&mut sent[..]));
        // The core writes whole frames, and the first message after a silence is to leave at once.
        stream.set_nagle_enabled(false);
        let ([received, sent], [received_heads, sent_heads]) = (&mut memory.datagrams, &mut memory.datagram_heads);
        let mut datagrams = udp::Socket::new(
            udp::PacketBuffer::new(&mut received_heads[..], &mut received[..]),
            udp::PacketBuffer::new(&mut sent_heads[..], &mut sent[..]),
        );
        let bound = datagrams.bind(DATAGRAM_PORT);
        debug_assert_eq!(bound, Ok(()));
        let mut sockets = SocketSet::new(&mut memory.sockets[..]);
        let (stream, datagrams) = (sockets.add(stream), sockets.add(datagrams));
        // Two boots in a row do not open their first link from the same port.
        let port = FIRST_PORT | seed as u16;
        Self {
            interface: Interface::new(config, device, instant(now)),
            sockets,
            stream,
            datagrams,
            address: None,
            port,
        }
    }

    pub(crate) fn set_address(&mut self, address: Option<Ipv4Cidr>) {
        self.address = address;
        self.interface.update_ip_addrs(|addresses| {
            addresses.clear();
            addresses.extend(address.map(IpCidr::Ipv4));
        });
    }

    /// Takes one frame of the device; `false` when there is none.
    pub(crate) fn take_frame<D: Device>(&mut self, now: Instant, device: &mut D) -> bool {
        let taken = self.interface.poll_ingress_single(instant(now), device, &mut self.sockets);
        taken != PollIngressSingleResult::None
    }

    /// Gives the device what it takes now.
    pub(crate) fn send_frames<D: Device>(&mut self, now: Instant, device: &mut D) {
        while self.interface.poll_egress(instant(now), device, &mut self.sockets) != PollResult::None {}
    }

    /// When smoltcp has something to do by itself: resend, acknowledge, ask for an address.
    pub(crate) fn deadline(&mut self, now: Instant) -> Instant {
        let due = self.interface.poll_at(instant(now), &self.sockets);
        due.map_or(Instant::FAR_FUTURE, |due| Instant::from_micros(due.total_micros().max(0) as u64))
    }

    /// Opens the stream; `false` when it cannot be: no address, or one that this network cannot reach.
    pub(crate) fn connect(&mut self, to: SocketAddrV4) -> bool {
        let stream = self.sockets.get_mut::<tcp::Socket>(self.stream);
        stream.abort();
        // A live link's end is the core's to find out.
        stream.set_timeout(None);
        self.port = self.port.wrapping_add(1) | FIRST_PORT;
        stream.connect(self.interface.context(), to, self.port).is_ok()
    }

    pub(crate) fn stream(&self) -> Stream {
        let stream = self.sockets.get::<tcp::Socket>(self.stream);
        match stream.state() {
            tcp::State::SynSent => Stream::Opening,
            _ if stream.may_recv() => Stream::Open,
            _ => Stream::Ended,
        }
    }

    pub(crate) fn stream_takes_bytes(&self) -> bool {
        self.sockets.get::<tcp::Socket>(self.stream).can_send()
    }

    /// Closes the stream once its queue is sent, or without that when the peer accepts nothing for [`FAREWELL`].
    pub(crate) fn close(&mut self) {
        let stream = self.sockets.get_mut::<tcp::Socket>(self.stream);
        stream.set_timeout(Some(FAREWELL));
        stream.close();
    }

    /// Bytes that have come, which stay in the stream until they are [consumed](Self::consume).
    pub(crate) fn peek(&mut self, bytes: &mut [u8]) -> usize {
        let come = self.sockets.get_mut::<tcp::Socket>(self.stream).peek(bytes.len()).unwrap_or(&[]);
        bytes.iter_mut().zip(come).for_each(|(place, byte)| *place = *byte);
        come.len()
    }

    pub(crate) fn consume(&mut self, count: usize) {
        // It fails only for a stream that has nothing.
        let _ = self.sockets.get_mut::<tcp::Socket>(self.stream).recv(|bytes| (count.min(bytes.len()), ()));
    }

    /// The next datagram and where it came from.
    pub(crate) fn datagram(&mut self, bytes: &mut [u8]) -> Option<(SocketAddrV4, usize)> {
        let socket = self.sockets.get_mut::<udp::Socket>(self.datagrams);
        while socket.can_recv() {
            // A datagram longer than any of CARA does not fit the buffer: it is dropped, not truncated.
            if let Ok((length, from)) = socket.recv_slice(bytes)
                && let SocketAddr::V4(from) = from.endpoint.into()
            {
                return Some((from, length));
            }
        }
        None
    }
}

impl Mailman<SocketAddrV4> for Stack {
    fn write(&mut self, _: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let stream = self.sockets.get_mut::<tcp::Socket>(self.stream);
        let mut written = 0;
        for slice in slices {
            let taken = stream.send_slice(slice).map_err(|_| CloseReason::Reset)?;
            written += taken;
            if taken < slice.len() {
                break;
            }
        }
        Ok(written)
    }

    fn send_to(&mut self, to: SocketAddrV4, datagram: &[u8]) -> bool {
        let socket = self.sockets.get_mut::<udp::Socket>(self.datagrams);
        socket.send_slice(datagram, to).is_ok()
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        let everybody = self.address.and_then(|address| address.broadcast());
        everybody.is_some_and(|everybody| self.send_to(SocketAddrV4::new(everybody, PLAIN_PORT), datagram))
    }
}

fn instant(now: Instant) -> smoltcp::time::Instant {
    smoltcp::time::Instant::from_micros(i64::try_from(now.as_micros()).unwrap_or(i64::MAX))
}
