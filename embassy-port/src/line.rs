//! One TCP socket, and what it is doing: embassy-net's `connect` and `accept` cannot be polled once and begun again, so
//! that state is kept here. Nothing in here waits.

use core::future::Future;
use core::net::{SocketAddr, SocketAddrV4};
use core::pin::pin;
use core::task::{Context, Poll, Waker};

use cara_core::error::CloseReason;
use cara_core::time::{Duration, Instant};
use embassy_net::tcp::{State, TcpSocket};
use embassy_net::{IpAddress, IpEndpoint, Stack};

use crate::time::now;

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

/// Progress of a socket's operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Progress {
    /// Nothing new.
    None,
    /// The connection that was dialled is there.
    Connected,
    /// A connection was accepted.
    Accepted(SocketAddrV4),
    /// The connection that was dialled could not be opened.
    Broken,
}

/// One TCP socket.
pub(crate) struct Line {
    socket: TcpSocket<'static>,
    doing: Doing,
}

impl Line {
    pub(crate) fn new(stack: Stack<'static>, receive: &'static mut [u8], send: &'static mut [u8]) -> Self {
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
pub(crate) fn address_of(end: IpEndpoint) -> Option<SocketAddrV4> {
    match SocketAddr::new(end.addr.into(), end.port) {
        SocketAddr::V4(address) => Some(address),
        SocketAddr::V6(_) => None,
    }
}

/// Polls a future once, and gives it up if it would wait.
pub(crate) fn poll_once<F: Future>(future: F) -> Option<F::Output> {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(output) => Some(output),
        Poll::Pending => None,
    }
}

/// Copies as much as both hold.
pub(crate) fn copy(from: &[u8], to: &mut [u8]) -> usize {
    let count = from.len().min(to.len());
    if let (Some(from), Some(to)) = (from.get(..count), to.get_mut(..count)) {
        to.copy_from_slice(from);
    }
    count
}
