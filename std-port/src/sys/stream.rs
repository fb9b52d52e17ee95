//! TCP links: dial, accept, send without blocking, receive with or without.
//!
//! A connected socket is in blocking mode with a receive time-out of [`SLICE`], so that a caller that reads its link
//! waits for the reply with one system call. All other calls are non-blocking, by a flag per call.

use std::io::{self, IoSlice};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};
use std::sync::OnceLock;

use cara_core::config::SHORT_SEGMENT;
use cara_core::error::CloseReason;
use cara_core::time::Duration;
use rustix::io::{Errno, fcntl_dupfd_cloexec, ioctl_fionbio, ioctl_fionread};
use rustix::net::{
    AddressFamily, RecvFlags, SendAncillaryBuffer, SendFlags, Shutdown, SocketFlags, SocketType, accept_with, bind,
    connect, getpeername, getsockname, listen, recv, send, sendmsg, shutdown, socket_with, sockopt,
};

use super::epoll::wait_readable;
use super::spinning::Spinning;

/// The longest that one blocking receive lasts; a waiting caller looks at its deadline and timers this often.
pub(crate) const SLICE: Duration = Duration::from_millis(50);

/// Bytes that may wait unsent in the kernel before it calls the socket full: an emergency has no more in front of it
/// than this and one message.
pub(crate) const UNSENT_BYTES: u32 = 16 * 1024;

/// Connections that the kernel completes ahead of `accept`: a fleet that dials a restarted manager at once.
const BACKLOG: i32 = 1024;

/// What a closed stream has not sent after this is dropped.
const FAREWELL: std::time::Duration = std::time::Duration::from_secs(10);

/// Slices that one send passes on; more are sent by the next call.
const SLICES: usize = 8;

/// How long [`Stream::receive`] may wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Wait {
    /// Not at all.
    Not,
    /// Up to [`SLICE`], in one system call.
    Slice,
    /// Up to [`SLICE`] or this span, whichever is shorter, to some 50 µs; a span below [`SLICE`] costs a second
    /// system call.
    AtMost(Duration),
}

/// What [`Stream::receive`] brought.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Received {
    /// This many bytes, at least one, at the front of the buffer.
    Bytes(usize),
    /// Nothing came in the time given, or a signal ended the wait.
    WouldBlock,
    /// The peer closed the stream, or the network reset it. Nothing will come any more.
    Closed,
}

/// A TCP connection, or one that is being dialled. Any thread may use it at any time.
#[derive(Debug)]
pub(crate) struct Stream {
    socket: OwnedFd,
    /// This end's address, once it was asked for.
    local: OnceLock<Option<Ipv4Addr>>,
    /// Why it could not be opened.
    failed: OnceLock<Errno>,
    spinning: Spinning,
}

impl Stream {
    /// Starts to connect to `to` and returns at once; the stream is writable when the attempt has ended, and
    /// [`finish_connect`](Self::finish_connect) tells how. Sending or receiving before that finds it closed or blocked.
    /// With `short` neither end sends segments above [`SHORT_SEGMENT`].
    pub(crate) fn connect(to: SocketAddr, short: bool) -> Result<Self, Errno> {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let socket = socket_with(AddressFamily::of(to), SocketType::STREAM, flags, None)?;
        set_options(&socket)?;
        if short {
            limit_segments(&socket, true);
        }
        match connect(&socket, &to) {
            Ok(()) | Err(Errno::INPROGRESS | Errno::INTR) => Ok(Self::new(socket)),
            Err(errno) => Err(errno),
        }
    }

    /// How the attempt to connect has ended: `Ok(true)` connected and ready to use, `Ok(false)` not ended yet.
    pub(crate) fn finish_connect(&self) -> Result<bool, CloseReason> {
        sockopt::socket_error(&self.socket).and_then(|outcome| outcome).map_err(|errno| {
            let _ = self.failed.set(errno);
            dial_failed(errno)
        })?;
        let peer = match getpeername(&self.socket) {
            Ok(peer) => peer,
            Err(Errno::NOTCONN) => return Ok(false),
            Err(errno) => return Err(dial_failed(errno)),
        };
        // Dialling an unused port of one's own range can connect a socket to itself.
        if peer == getsockname(&self.socket).ok() {
            return Err(CloseReason::DialFailed);
        }
        ioctl_fionbio(&self.socket, false).map_err(dial_failed)?;
        Ok(true)
    }

    /// Why it could not be opened, if it could not.
    pub(crate) fn dial_error(&self) -> Option<std::io::Error> {
        self.failed.get().map(|errno| (*errno).into())
    }

    /// The same stream behind the lowest descriptor that is free, if that is lower than its own.
    pub(crate) fn with_lowest_number(self) -> Self {
        match fcntl_dupfd_cloexec(&self.socket, 0) {
            Ok(socket) if socket.as_raw_fd() < self.socket.as_raw_fd() => Self::new(socket),
            _ => self,
        }
    }

    /// The peer's address; `None` when the stream is not connected.
    pub(crate) fn peer_address(&self) -> Option<SocketAddr> {
        getpeername(&self.socket).ok().flatten()?.try_into().ok()
    }

    /// The address of this end; `None` when the stream is not connected.
    pub(crate) fn local_address(&self) -> Option<SocketAddr> {
        getsockname(&self.socket).ok()?.try_into().ok()
    }

    /// The host's address at this end of a connected stream, from which the link's datagrams leave as well.
    pub(crate) fn local_host(&self) -> Option<Ipv4Addr> {
        *self.local.get_or_init(|| match self.local_address()?.ip() {
            IpAddr::V4(host) => Some(host),
            IpAddr::V6(_) => None,
        })
    }

    /// Longest segment that this end sends.
    #[cfg(feature = "control")]
    pub(crate) fn segment(&self) -> Option<u32> {
        socket2::SockRef::from(&self.socket).tcp_mss().ok()
    }

    fn new(socket: OwnedFd) -> Self {
        Self { socket, local: OnceLock::new(), failed: OnceLock::new(), spinning: Spinning::default() }
    }

    /// Threads that wait for it poll it for so long before they sleep, as far as that helps.
    pub(crate) fn spin(&mut self, span: Duration) {
        self.spinning = Spinning::lasting(span);
    }

    /// Waits in a row, or nearly, that have spun in vain.
    #[cfg(test)]
    pub(crate) fn spun_in_vain(&self) -> u32 {
        self.spinning.misses()
    }

    /// Sends what the kernel takes of `slices`, in order, without waiting; 0 when it has no room.
    ///
    /// One system call; from the ninth slice on, the next call sends the rest. No bytes to send are 0 as well.
    pub(crate) fn send(&self, slices: &[&[u8]]) -> Result<usize, CloseReason> {
        let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
        loop {
            let sent = match slices {
                [] => return Ok(0),
                [only] => send(&self.socket, only, flags),
                _ => self.send_several(slices, flags),
            };
            return match sent {
                Ok(sent) => Ok(sent),
                Err(Errno::INTR) => continue,
                // Lack of memory passes, too; the link's timers end one on which it does not.
                Err(Errno::AGAIN | Errno::NOBUFS | Errno::NOMEM) => Ok(0),
                Err(_) => Err(CloseReason::Reset),
            };
        }
    }

    fn send_several(&self, slices: &[&[u8]], flags: SendFlags) -> rustix::io::Result<usize> {
        let mut vectors = [IoSlice::new(&[]); SLICES];
        let mut used = 0;
        for (vector, slice) in vectors.iter_mut().zip(slices) {
            *vector = IoSlice::new(slice);
            used += 1;
        }
        let vectors = vectors.get(..used).unwrap_or_default();
        sendmsg(&self.socket, vectors, &mut SendAncillaryBuffer::default(), flags)
    }

    /// Receives into `buffer`, which must not be empty.
    pub(crate) fn receive(&self, buffer: &mut [u8], wait: Wait) -> Received {
        let (received, wait) = self.spinning.spin(wait, || self.receive_once(buffer, Wait::Not));
        if received == Received::WouldBlock { self.receive_once(buffer, wait) } else { received }
    }

    fn receive_once(&self, buffer: &mut [u8], wait: Wait) -> Received {
        let flags = match wait {
            Wait::Not => RecvFlags::DONTWAIT,
            Wait::Slice => RecvFlags::empty(),
            Wait::AtMost(span) if span >= SLICE => RecvFlags::empty(),
            // A failed wait is told by the receive that follows.
            Wait::AtMost(span) => match wait_readable(self.socket.as_fd(), span) {
                Ok(false) => return Received::WouldBlock,
                Ok(true) | Err(_) => RecvFlags::DONTWAIT,
            },
        };
        match recv(&self.socket, buffer, flags) {
            Ok((0, _)) => Received::Closed,
            Ok((count, _)) => Received::Bytes(count),
            Err(Errno::AGAIN | Errno::INTR | Errno::NOBUFS | Errno::NOMEM) => Received::WouldBlock,
            Err(_) => Received::Closed,
        }
    }

    /// Whether bytes, or the stream's end, wait to be received.
    pub(crate) fn has_unread(&self) -> bool {
        ioctl_fionread(&self.socket).is_ok_and(|count| count > 0)
    }

    /// Ends both directions: what was sent still goes out, a thread that waits in a receive returns, and both ends
    /// find the stream closed.
    pub(crate) fn shutdown(&self) {
        // What a dead path does not take need not stay in the kernel for minutes. While the link lives its end is the core's to find
        // out: the kernel would count a peer that holds reading back as dead.
        let _ = socket2::SockRef::from(&self.socket).set_tcp_user_timeout(Some(FAREWELL));
        // A stream that is not connected (any more) is closed already.
        let _ = shutdown(&self.socket, Shutdown::Both);
    }

    /// A connected socket with the port's options, in blocking mode.
    fn accepted(socket: OwnedFd) -> rustix::io::Result<Self> {
        set_options(&socket)?;
        Ok(Self::new(socket))
    }
}

impl AsFd for Stream {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// Neither end of a connection sends segments above [`SHORT_SEGMENT`], or as long as the network takes. Before it is opened.
fn limit_segments(socket: &OwnedFd, limited: bool) {
    let most = if limited { SHORT_SEGMENT.into() } else { 0 };
    if let Err(error) = socket2::SockRef::from(socket).set_tcp_mss(most) {
        tracing::warn!(%error, "the segments of connections could not be limited");
    }
}

fn set_options(socket: &OwnedFd) -> rustix::io::Result<()> {
    sockopt::set_tcp_nodelay(socket, true)?;
    sockopt::set_socket_timeout(socket, sockopt::Timeout::Recv, Some(SLICE.into()))?;
    let unsent = socket2::SockRef::from(socket).set_tcp_notsent_lowat(UNSENT_BYTES);
    unsent.map_err(|error| Errno::from_io_error(&error).unwrap_or(Errno::INVAL))
}

fn dial_failed(errno: Errno) -> CloseReason {
    tracing::debug!(%errno, "a connection could not be opened");
    CloseReason::DialFailed
}

/// What [`Listener::accept`] brought.
#[derive(Debug)]
pub(crate) enum Accepted {
    /// A new connection and the address of its other end.
    Stream(Stream, SocketAddr),
    /// No connection is waiting.
    WouldBlock,
    /// The process or the system is out of descriptors or memory. The connection still waits: watch the listener
    /// again after a pause, since it stays readable.
    Exhausted,
}

/// Takes connections from other units.
#[derive(Debug)]
pub(crate) struct Listener {
    socket: OwnedFd,
    port: u16,
}

impl Listener {
    /// Listens on `port` of `address`; port 0 lets the kernel choose.
    pub(crate) fn open(address: Ipv4Addr, port: u16) -> io::Result<Self> {
        let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
        let socket = socket_with(AddressFamily::INET, SocketType::STREAM, flags, None)?;
        // Connections of an earlier process that linger must not keep a restarted one from its port. Where the kernel
        // chooses, it would give one port to several that allow it, of which the second cannot listen.
        sockopt::set_socket_reuseaddr(&socket, port != 0)?;
        bind(&socket, &SocketAddrV4::new(address, port))?;
        listen(&socket, BACKLOG)?;
        let port = local_port(&socket)?;
        Ok(Self { socket, port })
    }

    /// The port that it listens on.
    pub(crate) const fn port(&self) -> u16 {
        self.port
    }

    /// Connections that come from now on have [short segments](SHORT_SEGMENT), or not.
    pub(crate) fn limit_segments(&self, limited: bool) {
        limit_segments(&self.socket, limited);
    }

    /// Takes the next waiting connection, never waits for one.
    pub(crate) fn accept(&self) -> Accepted {
        loop {
            match accept_with(&self.socket, SocketFlags::CLOEXEC) {
                Ok(socket) => {
                    // A connection that is closed by now is skipped.
                    let Ok(stream) = Stream::accepted(socket) else { continue };
                    let Some(peer) = stream.peer_address() else { continue };
                    return Accepted::Stream(stream, peer);
                }
                Err(Errno::AGAIN) => return Accepted::WouldBlock,
                Err(Errno::MFILE | Errno::NFILE | Errno::NOBUFS | Errno::NOMEM) => return Accepted::Exhausted,
                // The socket itself is of no use any more; nothing will come from it.
                Err(Errno::BADF | Errno::INVAL | Errno::NOTSOCK | Errno::OPNOTSUPP) => return Accepted::WouldBlock,
                // The rest are errors of the connection that was being taken.
                Err(_) => {}
            }
        }
    }
}

impl AsFd for Listener {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }
}

/// The port that a bound socket has.
pub(super) fn local_port(socket: &OwnedFd) -> io::Result<u16> {
    let address = SocketAddr::try_from(getsockname(socket)?)?;
    Ok(address.port())
}

/// The address family of a socket address.
trait Of {
    fn of(address: SocketAddr) -> Self;
}

impl Of for AddressFamily {
    fn of(address: SocketAddr) -> Self {
        match address {
            SocketAddr::V4(_) => Self::INET,
            SocketAddr::V6(_) => Self::INET6,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::super::epoll::{Epoll, Events, Interest};
    use super::*;

    const LIMIT: Duration = Duration::from_secs(30);

    /// Waits until `fd` is ready for `interest`; fails after [`LIMIT`].
    fn await_ready(fd: impl AsFd, interest: Interest) {
        let set = Epoll::new().unwrap();
        set.add(fd, 0, interest).unwrap();
        let mut events = Events::new(1);
        set.wait(&mut events, Some(LIMIT)).unwrap();
        assert!(!events.is_empty(), "nothing became ready in time");
    }

    fn pair() -> (Stream, Stream) {
        let listener = Listener::open(Ipv4Addr::LOCALHOST, 0).unwrap();
        let near = Stream::connect(SocketAddrV4::new(Ipv4Addr::LOCALHOST, listener.port()).into(), false).unwrap();
        await_ready(&near, Interest::WRITE_ONCE);
        assert_eq!(near.finish_connect(), Ok(true));
        await_ready(&listener, Interest::READ_LEVEL);
        let Accepted::Stream(far, address) = listener.accept() else { panic!("nobody was accepted") };
        assert_eq!(Some(address), near.local_address());
        assert!(matches!(listener.accept(), Accepted::WouldBlock));
        (near, far)
    }

    #[test]
    fn segments_are_limited_by_the_end_that_dials_or_by_the_one_that_listens() {
        let listener = Listener::open(Ipv4Addr::LOCALHOST, 0).unwrap();
        let to = SocketAddrV4::new(Ipv4Addr::LOCALHOST, listener.port()).into();
        for (dials_short, accepts_short) in [(false, false), (true, false), (false, true), (false, false)] {
            listener.limit_segments(accepts_short);
            let near = Stream::connect(to, dials_short).unwrap();
            await_ready(&near, Interest::WRITE_ONCE);
            await_ready(&listener, Interest::READ_LEVEL);
            let Accepted::Stream(far, _) = listener.accept() else { panic!("nobody was accepted") };
            for end in [near, far] {
                let mss = socket2::SockRef::from(&end.socket).tcp_mss().unwrap();
                assert_eq!(mss <= SHORT_SEGMENT.into(), dials_short || accepts_short, "{mss}");
            }
        }
    }

    /// Receives exactly `count` bytes.
    fn receive_all(stream: &Stream, count: usize) -> Vec<u8> {
        let start = Instant::now();
        let (mut all, mut buffer) = (Vec::new(), [0; 4096]);
        while all.len() < count && start.elapsed() < LIMIT.into() {
            match stream.receive(&mut buffer, Wait::Slice) {
                Received::Bytes(count) => all.extend_from_slice(&buffer[..count]),
                Received::WouldBlock => {}
                Received::Closed => break,
            }
        }
        all
    }

    #[test]
    fn slices_arrive_in_order_in_both_directions() {
        let (near, far) = pair();
        assert_eq!(near.send(&[]), Ok(0));
        assert_eq!(near.send(&[b"one "]), Ok(4));
        assert_eq!(near.send(&[b"two ", b"", b"three "]), Ok(10));
        assert_eq!(receive_all(&far, 14), b"one two three ");
        let many = [b"x".as_slice(); SLICES + 3];
        assert_eq!(far.send(&many), Ok(SLICES), "the rest is left to the next call");
        assert_eq!(receive_all(&near, SLICES), [b'x'; SLICES]);
    }

    #[test]
    fn a_receive_waits_as_long_as_it_is_told() {
        let (near, _far) = pair();
        let mut buffer = [0; 8];
        let mut waited = |wait| {
            let start = Instant::now();
            assert_eq!(near.receive(&mut buffer, wait), Received::WouldBlock);
            Duration::from(start.elapsed())
        };
        let short = Duration::from_millis(3);
        assert!(waited(Wait::AtMost(short)) >= short);
        assert!(waited(Wait::Slice) >= SLICE);
        assert!(waited(Wait::AtMost(LIMIT)) >= SLICE);
        let fastest = (0..10).map(|_| waited(Wait::Not)).min();
        assert!(fastest < Some(Duration::from_millis(1)), "{fastest:?}");
        let fastest = (0..10).map(|_| waited(Wait::AtMost(short))).min();
        assert!(fastest < Some(SLICE), "{fastest:?}");
    }

    #[test]
    fn a_full_socket_takes_a_part_then_nothing_and_has_room_after_a_read() {
        let (near, far) = pair();
        let bytes = vec![7u8; 1 << 20];
        let mut sent = 0;
        loop {
            match near.send(&[&bytes]).unwrap() {
                0 => break,
                count => sent += count,
            }
            assert!(sent < 1 << 28, "the kernel bounds nothing");
        }
        assert!(sent > 0);
        assert_eq!(receive_all(&far, sent).len(), sent);
        await_ready(&near, Interest::WRITE_ONCE);
        assert!(near.send(&[&bytes]).unwrap() > 0);
    }

    #[test]
    fn the_end_of_a_stream_is_told_to_reader_and_sender() {
        let (near, far) = pair();
        far.send(&[b"bye"]).unwrap();
        drop(far);
        assert_eq!(receive_all(&near, 4), b"bye");
        assert_eq!(near.receive(&mut [0; 8], Wait::Not), Received::Closed);
        let start = Instant::now();
        let ended = loop {
            if let Err(reason) = near.send(&[b"x"]) {
                break reason;
            }
            assert!(start.elapsed() < LIMIT.into());
        };
        assert_eq!(ended, CloseReason::Reset);
    }

    #[test]
    fn shutdown_ends_a_receive_of_another_thread() {
        let (near, far) = pair();
        std::thread::scope(|scope| {
            let waiting = scope.spawn(|| {
                let start = Instant::now();
                loop {
                    match near.receive(&mut [0; 8], Wait::Slice) {
                        Received::WouldBlock if start.elapsed() < LIMIT.into() => {}
                        other => break other,
                    }
                }
            });
            near.shutdown();
            assert_eq!(waiting.join().unwrap(), Received::Closed);
        });
        await_ready(&far, Interest::READ_LEVEL);
        assert_eq!(far.receive(&mut [0; 8], Wait::Not), Received::Closed);
    }

    #[test]
    fn a_port_where_nobody_listens_is_a_failed_dial() {
        let unused = Listener::open(Ipv4Addr::LOCALHOST, 0).unwrap().port();
        let stream = Stream::connect(SocketAddrV4::new(Ipv4Addr::LOCALHOST, unused).into(), false).unwrap();
        await_ready(&stream, Interest::WRITE_ONCE);
        assert_eq!(stream.finish_connect(), Err(CloseReason::DialFailed));
        assert_eq!(stream.dial_error().map(|error| error.kind()), Some(std::io::ErrorKind::ConnectionRefused));
    }

    #[test]
    fn a_connect_that_goes_on_is_neither_done_nor_failed() {
        // A full backlog keeps the next connection waiting.
        let flags = SocketFlags::CLOEXEC;
        let full = socket_with(AddressFamily::INET, SocketType::STREAM, flags, None).unwrap();
        bind(&full, &SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0)).unwrap();
        listen(&full, 0).unwrap();
        let to = SocketAddrV4::new(Ipv4Addr::LOCALHOST, local_port(&full).unwrap()).into();
        let dials: Vec<_> = (0..4).map(|_| Stream::connect(to, false).unwrap()).collect();
        assert_eq!(dials.last().unwrap().finish_connect(), Ok(false));
    }

    #[test]
    fn links_do_not_gather_small_writes_and_bound_what_is_unsent() {
        for stream in <[Stream; 2]>::from(pair()) {
            assert_eq!(sockopt::tcp_nodelay(&stream.socket), Ok(true));
            assert_eq!(socket2::SockRef::from(&stream.socket).tcp_notsent_lowat().unwrap(), UNSENT_BYTES);
            assert!(!socket2::SockRef::from(&stream.socket).nonblocking().unwrap());
        }
    }
}
