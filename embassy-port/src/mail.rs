//! The core's port trait over what a unit reaches others over: IP or a serial line.

use core::mem::MaybeUninit;
use core::net::{Ipv4Addr, SocketAddrV4};
use core::task::Context;

use cara_core::error::{CloseReason, Error};
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::time::Instant;

use crate::connection::Progress;
#[cfg(feature = "line")]
use crate::line;
#[cfg(feature = "net")]
use crate::net;

#[cfg(not(any(feature = "line", feature = "net")))]
compile_error!("cara-embassy needs its feature `net`, for embassy-net, or `line`, for a serial line without IP");

/// What a unit reaches others over: a `Network`, or a `line::Line`.
pub trait Transport {
    /// How many sockets it has.
    #[doc(hidden)]
    const SOCKETS: usize;

    #[doc(hidden)]
    fn carrier(self) -> Carrier;
}

/// A transport of either kind.
#[doc(hidden)]
pub enum Carrier {
    #[cfg(feature = "net")]
    Net(embassy_net::Stack<'static>),
    #[cfg(feature = "line")]
    Line(line::Line),
}

#[cfg(feature = "net")]
impl<const SOCKETS: usize> Transport for net::Network<SOCKETS> {
    const SOCKETS: usize = SOCKETS;

    fn carrier(self) -> Carrier {
        Carrier::Net(self.stack())
    }
}

#[cfg(feature = "line")]
impl Transport for line::Line {
    /// A line needs none.
    const SOCKETS: usize = usize::MAX;

    fn carrier(self) -> Carrier {
        Carrier::Line(self)
    }
}

/// The memory of what a unit sends with.
pub(crate) struct Memory<const LINKS: usize, const STREAM: usize, const DATAGRAM: usize> {
    connections: MaybeUninit<[Connection; LINKS]>,
    #[cfg(feature = "net")]
    net: net::Memory<LINKS, STREAM, DATAGRAM>,
}

impl<const LINKS: usize, const STREAM: usize, const DATAGRAM: usize> Memory<LINKS, STREAM, DATAGRAM> {
    pub(crate) const fn new() -> Self {
        Self {
            connections: MaybeUninit::uninit(),
            #[cfg(feature = "net")]
            net: net::Memory::new(),
        }
    }

    /// Takes datagrams at that port.
    pub(crate) fn open(&'static mut self, carrier: Carrier, port: u16) -> Result<Mail, Error> {
        match carrier {
            #[cfg(feature = "net")]
            Carrier::Net(stack) => {
                let (net, sockets) = self.net.open(stack, port)?;
                let connections = self.connections.write(sockets.map(Connection::Net));
                Ok(Mail { network: Network::Net(net), connections })
            }
            #[cfg(feature = "line")]
            Carrier::Line(line) => {
                if LINKS > 1 {
                    return Err(Error::BadConstraint);
                }
                let connections =
                    self.connections.write([(); LINKS].map(|()| Connection::Line(line::Stream::new(line))));
                Ok(Mail { network: Network::Line(line::Port { line, port }), connections })
            }
        }
    }
}

/// Sends for one unit: its links over their connections, everything else as datagrams.
pub(crate) struct Mail {
    network: Network,
    /// The connection of each link.
    pub(crate) connections: &'static mut [Connection],
}

enum Network {
    #[cfg(feature = "net")]
    Net(net::Net),
    #[cfg(feature = "line")]
    Line(line::Port),
}

/// The connection of a link.
pub(crate) enum Connection {
    #[cfg(feature = "net")]
    Net(net::Socket),
    #[cfg(feature = "line")]
    Line(line::Stream),
}

/// The same of whichever it is.
macro_rules! of {
    ($kind:ident: $of:expr, $one:ident => $act:expr) => {
        match $of {
            #[cfg(feature = "net")]
            $kind::Net($one) => $act,
            #[cfg(feature = "line")]
            $kind::Line($one) => $act,
        }
    };
}

impl Mailman<SocketAddrV4> for Mail {
    fn write(&mut self, link: LinkId, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let connection = self.connections.get_mut(usize::from(link.0)).ok_or(CloseReason::Reset)?;
        of!(Connection: connection, one => one.write(slices))
    }

    fn send_to(&mut self, to: SocketAddrV4, datagram: &[u8]) -> bool {
        of!(Network: &mut self.network, one => one.send_to(to, datagram))
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        of!(Network: &mut self.network, one => one.broadcast(datagram))
    }
}

impl Mail {
    /// The unit's address; none while the cable is out or no address is known.
    pub(crate) fn address(&self) -> Option<Ipv4Addr> {
        of!(Network: &self.network, one => one.address())
    }

    /// Whether the cable is out.
    pub(crate) fn is_cut(&self) -> bool {
        of!(Network: &self.network, one => one.is_cut())
    }

    /// The task is woken when the cable or the address changes, unless another task waits for that as well.
    pub(crate) fn wake_on_change(&self, context: &mut Context<'_>) {
        of!(Network: &self.network, one => one.wake_on_change(context));
    }

    /// Takes a datagram: its length and where it comes from, or that it is dropped. `None` when there is none; the task is then
    /// woken by the next.
    pub(crate) fn receive(
        &mut self,
        into: &mut [u8],
        context: &mut Context<'_>,
    ) -> Option<Option<(usize, SocketAddrV4)>> {
        of!(Network: &mut self.network, one => one.receive(into, context))
    }

    /// Whether a datagram waits.
    pub(crate) fn has_datagram(&mut self, context: &mut Context<'_>) -> bool {
        of!(Network: &mut self.network, one => one.has_datagram(context))
    }
}

impl Connection {
    /// It is better not disturbed as long as another one is free.
    pub(crate) fn is_closing(&self) -> bool {
        of!(Connection: self, one => one.is_closing())
    }

    /// A link has it, from its dialling on.
    pub(crate) fn is_in_use(&self) -> bool {
        of!(Connection: self, one => one.is_in_use())
    }

    /// It is listening, or free to listen.
    pub(crate) fn takes_connections(&self) -> bool {
        of!(Connection: self, one => one.takes_connections())
    }

    /// Listens, unless it is in use.
    pub(crate) fn listen(&mut self, port: u16) {
        of!(Connection: self, one => one.listen(port));
    }

    /// Begins to open a connection; `false` when that cannot be.
    pub(crate) fn dial(&mut self, to: SocketAddrV4) -> bool {
        of!(Connection: self, one => one.dial(to))
    }

    /// Ends the connection behind what was written.
    pub(crate) fn close(&mut self) {
        of!(Connection: self, one => one.close());
    }

    /// Ends the connection now, as when the network below is gone.
    pub(crate) fn abort(&mut self) {
        of!(Connection: self, one => one.abort());
    }

    /// Looks what became of it.
    pub(crate) fn progress(&mut self, now: Instant) -> Progress {
        of!(Connection: self, one => one.progress(now))
    }

    /// When [`progress`](Self::progress) has something to do without an event of the network.
    pub(crate) fn deadline(&self) -> Instant {
        of!(Connection: self, one => one.deadline())
    }

    /// Copies what has arrived, without taking it.
    pub(crate) fn peek(&mut self, into: &mut [u8]) -> usize {
        of!(Connection: self, one => one.peek(into))
    }

    /// Takes bytes that were looked at.
    pub(crate) fn take(&mut self, count: usize) {
        of!(Connection: self, one => one.take(count));
    }

    /// The peer has closed, or the connection was reset, and all that it sent has been read.
    pub(crate) fn has_ended(&self) -> bool {
        of!(Connection: self, one => one.has_ended())
    }

    /// Whether everything that has arrived has been read, the end of the stream included.
    pub(crate) fn has_been_read(&self) -> bool {
        of!(Connection: self, one => one.has_been_read())
    }

    /// Whether it would take bytes.
    pub(crate) fn can_write(&self) -> bool {
        of!(Connection: self, one => one.can_write())
    }

    /// The task is woken by whatever happens to it, and by room for more bytes if it wants to write.
    pub(crate) fn wake_on_news(&self, context: &mut Context<'_>, wants_to_write: bool) {
        of!(Connection: self, one => one.wake_on_news(context, wants_to_write));
    }
}
