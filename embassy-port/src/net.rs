//! IP: a UDP socket for datagrams, and for each connection a TCP socket with what it is doing, since embassy-net's `connect` and
//! `accept` cannot be polled once and begun again. Nothing in here waits.

use core::future::Future;
use core::mem::MaybeUninit;
use core::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use core::pin::pin;
use core::task::{Context, Poll, Waker};

use cara_core::error::{CloseReason, Error};
use cara_core::time::{Duration, Instant};
use embassy_net::driver::Driver;
use embassy_net::tcp::{State, TcpSocket};
use embassy_net::udp::{PacketMetadata, UdpSocket};
use embassy_net::{Config, IpAddress, IpEndpoint, Runner, Stack, StackResources, StaticConfigV4};

use crate::connection::{Progress, copy};
use crate::time::now;

/// A network stack, whose type says how many sockets it has room for. [`new`](crate::new) takes it.
#[derive(Clone, Copy)]
pub struct Network<const SOCKETS: usize>(Stack<'static>);

/// Makes a network stack, as `embassy_net::new` does, whose number of sockets is checked when compiling. Its runner wants a task
/// of its own.
///
/// Two sockets are too few for one link, datagrams and DHCP: "Limits::sockets() = 3, and StackResources has 2".
///
/// ```compile_fail,E0080
/// # use cara_embassy::{Config, Limits, Network, Resources, resources};
/// # let start: fn(Network<2>, &'static mut resources!((), Limits::S_UNIT), Config) =
/// #     |network, resources, config| drop(cara_embassy::new(network, resources, config, ()));
/// # std::hint::black_box(start);
/// ```
pub fn network<D: Driver, const SOCKETS: usize>(
    driver: D,
    config: Config,
    sockets: &'static mut StackResources<SOCKETS>,
    seed: u64,
) -> (Network<SOCKETS>, Runner<'static, D>) {
    let (stack, runner) = embassy_net::new(driver, config, sockets, seed);
    (Network(stack), runner)
}

impl<const SOCKETS: usize> Network<SOCKETS> {
    /// The stack, for the application's own sockets.
    pub fn stack(&self) -> Stack<'static> {
        self.0
    }
}

/// Datagrams that wait to be read or sent.
const DATAGRAMS: usize = 8;

/// The memory of the sockets.
pub(crate) struct Memory<const LINKS: usize, const STREAM: usize, const DATAGRAM: usize> {
    /// For each link, what is received and what is sent.
    streams: [[MaybeUninit<[u8; STREAM]>; 2]; LINKS],
    /// Those that were received, and those to be sent.
    datagrams: MaybeUninit<[[u8; DATAGRAM]; 2]>,
    datagram_heads: MaybeUninit<[[PacketMetadata; DATAGRAMS]; 2]>,
}

impl<const LINKS: usize, const STREAM: usize, const DATAGRAM: usize> Memory<LINKS, STREAM, DATAGRAM> {
    pub(crate) const fn new() -> Self {
        Self {
            streams: [const { [const { MaybeUninit::uninit() }; 2] }; LINKS],
            datagrams: MaybeUninit::uninit(),
            datagram_heads: MaybeUninit::uninit(),
        }
    }

    /// The socket for datagrams at that port of the stack, and those of the links.
    pub(crate) fn open(&'static mut self, stack: Stack<'static>, port: u16) -> Result<(Net, [Socket; LINKS]), Error> {
        let [received, sent] = self.datagram_heads.write([[PacketMetadata::EMPTY; DATAGRAMS]; 2]);
        let [receive, send] = self.datagrams.write([[0; DATAGRAM]; 2]);
        let mut udp = UdpSocket::new(stack, received, receive, sent, send);
        udp.bind(port).map_err(|_| Error::PortInUse)?;
        let streams = self.streams.each_mut();
        let sockets =
            streams.map(|[received, sent]| Socket::new(stack, received.write([0; STREAM]), sent.write([0; STREAM])));
        Ok((Net { stack, udp, port }, sockets))
    }
}

/// The network, and the socket for datagrams.
pub(crate) struct Net {
    stack: Stack<'static>,
    udp: UdpSocket<'static>,
    /// Where units of this mode listen for broadcasts.
    port: u16,
}

impl Net {
    /// The unit's address, if there is one and the cable is plugged in.
    pub(crate) fn address(&self) -> Option<Ipv4Addr> {
        self.config().map(|config| config.address.address())
    }

    pub(crate) fn is_cut(&self) -> bool {
        !self.stack.is_link_up()
    }

    pub(crate) fn wake_on_change(&self, context: &mut Context<'_>) {
        // Polled once, either leaves the task's waker with the stack, which it wakes for any change.
        let _ = match self.is_cut() {
            true => pin!(self.stack.wait_link_up()).poll(context),
            false => pin!(self.stack.wait_link_down()).poll(context),
        };
    }

    fn config(&self) -> Option<StaticConfigV4> {
        if self.stack.is_link_up() { self.stack.config_v4() } else { None }
    }

    pub(crate) fn send_to(&mut self, to: SocketAddrV4, datagram: &[u8]) -> bool {
        let to = IpEndpoint::new(IpAddress::Ipv4(*to.ip()), to.port());
        // No task waits for send space on this socket, so the no-op waker displaces none.
        let sent = self.udp.poll_send_to(datagram, to, &mut Context::from_waker(Waker::noop()));
        matches!(sent, Poll::Ready(Ok(())))
    }

    pub(crate) fn broadcast(&mut self, datagram: &[u8]) -> bool {
        let Some(config) = self.config() else { return false };
        let all = config.address.broadcast().unwrap_or(Ipv4Addr::BROADCAST);
        self.send_to(SocketAddrV4::new(all, self.port), datagram)
    }

    /// Takes a datagram: its length and where it comes from, or that it is dropped. `None` when there is none; the task is then
    /// woken by the next.
    pub(crate) fn receive(
        &mut self,
        into: &mut [u8],
        context: &mut Context<'_>,
    ) -> Option<Option<(usize, SocketAddrV4)>> {
        match self.udp.poll_recv_from(into, context) {
            Poll::Pending => None,
            Poll::Ready(Err(_)) => Some(None),
            Poll::Ready(Ok((length, from))) => Some(address_of(from.endpoint).map(|from| (length, from))),
        }
    }

    /// Whether a datagram waits.
    pub(crate) fn has_datagram(&mut self, context: &mut Context<'_>) -> bool {
        self.udp.poll_recv_ready(context).is_ready()
    }
}

/// How long a socket may take to say farewell before it is reset.
const FAREWELL: Duration = Duration::from_millis(500);

/// What the socket is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Doing {
    Nothing,
    Listening,
    Dialing,
    /// A link owns it.
    Open,
    Closing {
        until: Instant,
    },
}

/// One TCP socket.
pub(crate) struct Socket {
    socket: TcpSocket<'static>,
    doing: Doing,
}

impl Socket {
    fn new(stack: Stack<'static>, receive: &'static mut [u8], send: &'static mut [u8]) -> Self {
        let mut socket = TcpSocket::new(stack, receive, send);
        // A small request must not wait for the acknowledgement of the one before.
        socket.set_nagle_enabled(false);
        Self { socket, doing: Doing::Nothing }
    }

    /// It is better not disturbed as long as another one is free.
    pub(crate) fn is_closing(&self) -> bool {
        matches!(self.doing, Doing::Closing { .. })
    }

    /// A link has it, from its dialling on.
    pub(crate) fn is_in_use(&self) -> bool {
        matches!(self.doing, Doing::Open | Doing::Dialing)
    }

    /// It is listening, or free to listen.
    pub(crate) fn takes_connections(&self) -> bool {
        matches!(self.doing, Doing::Listening | Doing::Nothing)
    }

    /// Listens, unless the socket is in use.
    pub(crate) fn listen(&mut self, port: u16) {
        if self.doing == Doing::Nothing && poll_once(self.socket.accept(port)).is_none() {
            self.doing = Doing::Listening;
        }
    }

    /// Begins to open a connection; `false` when that cannot be.
    pub(crate) fn dial(&mut self, to: SocketAddrV4) -> bool {
        if self.doing != Doing::Nothing {
            self.socket.abort();
        }
        let to = IpEndpoint::new(IpAddress::Ipv4(*to.ip()), to.port());
        let started = !matches!(poll_once(self.socket.connect(to)), Some(Err(_)));
        self.doing = if started { Doing::Dialing } else { Doing::Nothing };
        started
    }

    /// Ends the connection behind what was written.
    pub(crate) fn close(&mut self) {
        self.socket.close();
        self.doing = Doing::Closing { until: now() + FAREWELL };
    }

    /// Ends the connection now, as when the network below is gone.
    pub(crate) fn abort(&mut self) {
        self.socket.abort();
        self.doing = Doing::Nothing;
    }

    /// Looks what became of it.
    pub(crate) fn progress(&mut self, now: Instant) -> Progress {
        let state = self.socket.state();
        match self.doing {
            Doing::Nothing | Doing::Open => Progress::None,
            Doing::Listening => match state {
                State::Listen | State::SynReceived | State::SynSent => Progress::None,
                State::Closed | State::TimeWait => {
                    self.doing = Doing::Nothing;
                    Progress::None
                }
                _ => self.accepted(),
            },
            Doing::Dialing => match state {
                State::SynSent | State::SynReceived | State::Listen => Progress::None,
                State::Closed | State::TimeWait => {
                    self.doing = Doing::Nothing;
                    Progress::Broken
                }
                _ => {
                    self.doing = Doing::Open;
                    Progress::Connected
                }
            },
            Doing::Closing { until } => {
                if matches!(state, State::Closed | State::TimeWait) {
                    self.doing = Doing::Nothing;
                } else if now >= until {
                    self.abort();
                }
                Progress::None
            }
        }
    }

    fn accepted(&mut self) -> Progress {
        let Some(from) = self.socket.remote_endpoint().and_then(address_of) else {
            self.abort();
            return Progress::None;
        };
        self.doing = Doing::Open;
        Progress::Accepted(from)
    }

    /// When [`progress`](Self::progress) has something to do without an event of the network.
    pub(crate) fn deadline(&self) -> Instant {
        match self.doing {
            Doing::Closing { until } => until,
            _ => Instant::FAR_FUTURE,
        }
    }

    /// Writes what there is room for; returns how many bytes that were.
    pub(crate) fn write(&mut self, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        if !self.socket.may_send() {
            return Err(CloseReason::Reset);
        }
        let mut written = 0_usize;
        for slice in slices {
            let mut rest = *slice;
            while !rest.is_empty() {
                // Checked first, because a write that would block replaces the registered waker.
                if !self.socket.can_send() {
                    return Ok(written);
                }
                let count = self.write_some(rest)?;
                written = written.saturating_add(count);
                rest = rest.get(count..).unwrap_or_default();
            }
        }
        Ok(written)
    }

    fn write_some(&mut self, bytes: &[u8]) -> Result<usize, CloseReason> {
        let copied = poll_once(self.socket.write_with(|room| {
            let count = copy(bytes, room);
            (count, count)
        }));
        copied.unwrap_or(Ok(0)).map_err(|_| CloseReason::Reset)
    }

    /// Copies what has arrived, without taking it.
    pub(crate) fn peek(&mut self, into: &mut [u8]) -> usize {
        if !self.socket.can_recv() {
            return 0;
        }
        let peeked = poll_once(self.socket.read_with(|bytes| (0, copy(bytes, into))));
        peeked.and_then(Result::ok).unwrap_or(0)
    }

    /// Takes bytes that were looked at.
    pub(crate) fn take(&mut self, count: usize) {
        if count > 0 && self.socket.can_recv() {
            let _ = poll_once(self.socket.read_with(|bytes| (count.min(bytes.len()), ())));
        }
    }

    /// The peer has closed, or the connection was reset, and all that it sent has been read.
    pub(crate) fn has_ended(&self) -> bool {
        self.doing == Doing::Open && !self.socket.may_recv()
    }

    /// Whether everything that has arrived has been read, the end of the stream included.
    pub(crate) fn has_been_read(&self) -> bool {
        !self.socket.can_recv() && !self.has_ended()
    }

    /// Whether it would take bytes.
    pub(crate) fn can_write(&self) -> bool {
        self.socket.can_send()
    }

    /// The task is woken by whatever happens to it, and by room for more bytes if it wants to write.
    pub(crate) fn wake_on_news(&self, context: &mut Context<'_>, wants_to_write: bool) {
        let open = self.doing == Doing::Open;
        if !open || wants_to_write {
            let _ = pin!(self.socket.wait_write_ready()).poll(context);
        }
        if open {
            let _ = pin!(self.socket.wait_read_ready()).poll(context);
        }
    }
}

/// Units of boards have IPv4 addresses only.
fn address_of(end: IpEndpoint) -> Option<SocketAddrV4> {
    match SocketAddr::new(end.addr.into(), end.port) {
        SocketAddr::V4(address) => Some(address),
        SocketAddr::V6(_) => None,
    }
}

/// Polls a future once, and gives it up if it would wait.
fn poll_once<F: Future>(future: F) -> Option<F::Output> {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(output) => Some(output),
        Poll::Pending => None,
    }
}
