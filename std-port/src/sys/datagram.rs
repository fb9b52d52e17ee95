//! UDP: the discovery socket that all units of a host share, the unit's own socket, and broadcasts on every interface.
//!
//! Everything is sent from the own socket and answered to it. The shared socket only hears broadcasts; of unicast
//! datagrams to its port the kernel gives each to one unit alone.

use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use cara_core::error::Error;
use nix::libc::{in_addr, in_pktinfo};
use nix::sys::socket::{ControlMessage, MsgFlags, SockaddrIn, sendmsg};
use rustix::io::Errno;
use rustix::net::{
    AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, bind, recvfrom, sendto, socket_with, sockopt,
};

use super::interfaces::{Interface, Interfaces, interfaces};
use super::stream::local_port;

/// How long a list of interfaces is used before the system is asked again: a cable that is plugged in is found by the
/// next search after that.
const REFRESH: Duration = Duration::from_secs(3);

/// Bytes of datagrams that may wait to be read, where the system allows it: a thousand nodes that answer at once.
const RECEIVE_BUFFER: usize = 1024 * 1024;

/// A unit's two sockets for datagrams.
#[derive(Debug)]
pub struct Datagrams {
    shared: OwnedFd,
    own: OwnedFd,
    own_port: u16,
    discovery_port: u16,
    interfaces: Interfaces,
    targets: Mutex<Targets>,
}

/// The interfaces as they were a short while ago.
#[derive(Debug)]
struct Targets {
    list: Arc<[Interface]>,
    asked: Instant,
}

/// Which of the two sockets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Socket {
    /// The one that hears broadcasts to the discovery port.
    Shared,
    /// The one that sends, and hears what is sent to this unit alone.
    Own,
}

impl Datagrams {
    /// Opens both sockets on `interfaces`; other units of the host may share `discovery_port`.
    ///
    /// [`Error::PortInUse`] when a program that does not share it has that port, [`Error::PortNotPermitted`] when this user
    /// may not have it, [`Error::Network`] otherwise.
    pub fn open(interfaces: Interfaces, discovery_port: u16) -> Result<Self, Error> {
        // Bound to all addresses even for loopback alone, where `receive` drops what comes from elsewhere: a socket
        // bound to one address hears no broadcasts.
        let shared = open_socket(Ipv4Addr::UNSPECIFIED, discovery_port, true).map_err(refused)?;
        let own = open_socket(interfaces.bind_address(), 0, false).map_err(network)?;
        sockopt::set_socket_broadcast(&own, true).map_err(network)?;
        let own_port = local_port(&own).map_err(|_| Error::Network)?;
        let discovery_port = local_port(&shared).map_err(|_| Error::Network)?;
        let targets = Targets { list: look(interfaces).into(), asked: Instant::now() };
        Ok(Self { shared, own, own_port, discovery_port, interfaces, targets: Mutex::new(targets) })
    }

    /// The port of the own socket, from which everything is sent.
    pub(crate) const fn own_port(&self) -> u16 {
        self.own_port
    }

    /// The port that broadcasts go to.
    pub const fn discovery_port(&self) -> u16 {
        self.discovery_port
    }

    /// The descriptor to watch for one of the sockets.
    pub(crate) fn fd(&self, socket: Socket) -> BorrowedFd<'_> {
        match socket {
            Socket::Shared => self.shared.as_fd(),
            Socket::Own => self.own.as_fd(),
        }
    }

    /// The next datagram of `socket` and its source, without waiting; `None` when there is none.
    ///
    /// A datagram longer than `buffer` is cut to its length: lend one byte more than the longest that counts. Own
    /// broadcasts, and what comes from an interface that is not used, are dropped here.
    pub fn receive(&self, socket: Socket, buffer: &mut [u8]) -> Option<(usize, SocketAddr)> {
        loop {
            let (count, source) = match recvfrom(self.fd(socket), &mut *buffer, RecvFlags::DONTWAIT) {
                Ok((count, _, source)) => (count, source),
                Err(Errno::AGAIN) => return None,
                // An earlier datagram found no reader at its target, or a signal came; the next one is unharmed.
                Err(Errno::INTR | Errno::CONNREFUSED | Errno::HOSTUNREACH | Errno::NETUNREACH) => continue,
                Err(errno) => {
                    tracing::debug!(%errno, "a datagram could not be read");
                    return None;
                }
            };
            let Some(Ok(SocketAddr::V4(source))) = source.map(SocketAddr::try_from) else { continue };
            if self.interfaces.accept(*source.ip()) && !self.is_own(source) {
                return Some((count, source.into()));
            }
        }
    }

    /// Sends one datagram to one address. `false` when the network refused it or has no room.
    pub fn send_to(&self, to: SocketAddr, datagram: &[u8]) -> bool {
        self.try_send_to(to, datagram).is_ok()
    }

    /// The same from an address of this host.
    pub(crate) fn send_from(&self, from: Ipv4Addr, to: SocketAddr, datagram: &[u8]) -> bool {
        let SocketAddr::V4(to) = to else { return self.send_to(to, datagram) };
        let source = in_pktinfo {
            ipi_ifindex: 0,
            ipi_spec_dst: in_addr { s_addr: u32::from(from).to_be() },
            ipi_addr: in_addr { s_addr: 0 },
        };
        let (vectors, source) = ([io::IoSlice::new(datagram)], [ControlMessage::Ipv4PacketInfo(&source)]);
        let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_NOSIGNAL;
        let to = SockaddrIn::from(to);
        let sent = unless_earlier(|| {
            sendmsg(self.own.as_raw_fd(), &vectors, &source, flags, Some(&to))
                .map_err(|errno| Errno::from_raw_os_error(errno as i32))
        });
        if let Err(errno) = sent {
            tracing::debug!(%errno, %from, %to, "a datagram could not be sent");
        }
        sent.is_ok()
    }

    fn try_send_to(&self, to: SocketAddr, datagram: &[u8]) -> rustix::io::Result<()> {
        let sent = send_datagram(&self.own, to, datagram);
        if let Err(errno) = sent {
            tracing::debug!(%errno, %to, "a datagram could not be sent");
        }
        sent
    }

    /// Sends one datagram to the discovery port of all nodes on each interface. `false` when no interface took it.
    pub fn broadcast(&self, datagram: &[u8]) -> bool {
        let mut sent = false;
        for interface in self.targets().iter().filter(|interface| interface.is_usable()) {
            let Some(target) = interface.broadcast else { continue };
            let outcome = self.try_send_to(SocketAddrV4::new(target, self.discovery_port).into(), datagram);
            let refused = outcome.err().map(|errno| io::Error::from(errno).kind());
            if refused != interface.refused {
                self.note_refused(interface.address, refused);
            }
            sent |= refused.is_none();
        }
        sent
    }

    fn note_refused(&self, address: Ipv4Addr, refused: Option<io::ErrorKind>) {
        let mut targets = self.targets.lock().unwrap_or_else(PoisonError::into_inner);
        let mut list = targets.list.to_vec();
        list.iter_mut().filter(|known| known.address == address).for_each(|known| known.refused = refused);
        targets.list = list.into();
    }

    /// The interfaces that are used, with those that are down.
    pub(crate) fn targets(&self) -> Arc<[Interface]> {
        let mut targets = self.targets.lock().unwrap_or_else(PoisonError::into_inner);
        if targets.asked.elapsed() >= REFRESH {
            targets.look(self.interfaces);
        }
        targets.list.clone()
    }

    /// Names of the interfaces on which broadcasts can go out, as any unit of the process has seen them half a second ago at
    /// most.
    pub(crate) fn usable(&self) -> Vec<String> {
        let mut targets = self.targets.lock().unwrap_or_else(PoisonError::into_inner);
        targets.look(self.interfaces);
        targets.list.iter().filter(|interface| interface.is_usable()).map(|interface| interface.name.clone()).collect()
    }

    /// Whether nodes that this unit may look for can be reached on the interfaces of these names.
    pub(crate) fn reaches_others(&self, usable: &[String]) -> bool {
        let targets = self.targets();
        let elsewhere = |interface: &Interface| !interface.address.is_loopback() && usable.contains(&interface.name);
        match self.interfaces {
            Interfaces::Loopback => !usable.is_empty(),
            Interfaces::All => targets.iter().any(elsewhere),
        }
    }

    fn is_own(&self, source: SocketAddrV4) -> bool {
        if source.port() != self.own_port {
            return false;
        }
        source.ip().is_loopback() || self.targets().iter().any(|interface| interface.address == *source.ip())
    }
}

impl Targets {
    /// Asks the system; what became of the last broadcast stays with its address.
    fn look(&mut self, interfaces: Interfaces) {
        let mut list = look(interfaces);
        for interface in &mut list {
            let known = self.list.iter().find(|known| known.address == interface.address);
            interface.refused = known.and_then(|known| known.refused);
        }
        *self = Self { list: list.into(), asked: Instant::now() };
    }
}

/// A list of interfaces serves all units of the process for so long: a thousand that start together ask the system once.
const SHARED: Duration = Duration::from_millis(500);

/// When the system was asked for its interfaces, and what it said.
static SEEN: Mutex<Option<(Instant, Arc<[Interface]>)>> = Mutex::new(None);

fn look(wanted: Interfaces) -> Vec<Interface> {
    match all_interfaces() {
        Ok(all) => all.iter().filter(|interface| wanted.accept(interface.address)).cloned().collect(),
        Err(error) => {
            tracing::warn!(%error, "the interfaces could not be listed");
            Vec::new()
        }
    }
}

fn all_interfaces() -> io::Result<Arc<[Interface]>> {
    let mut seen = SEEN.lock().unwrap_or_else(PoisonError::into_inner);
    match &*seen {
        Some((at, all)) if at.elapsed() < SHARED => Ok(all.clone()),
        _ => {
            let all: Arc<[Interface]> = interfaces()?.into();
            *seen = Some((Instant::now(), all.clone()));
            Ok(all)
        }
    }
}

fn open_socket(address: Ipv4Addr, port: u16, shared: bool) -> rustix::io::Result<OwnedFd> {
    let socket = socket_with(AddressFamily::INET, SocketType::DGRAM, SocketFlags::CLOEXEC, None)?;
    sockopt::set_socket_reuseaddr(&socket, shared)?;
    sockopt::set_socket_recv_buffer_size(&socket, RECEIVE_BUFFER)?;
    bind(&socket, &SocketAddrV4::new(address, port))?;
    Ok(socket)
}

fn send_datagram(socket: &OwnedFd, to: SocketAddr, datagram: &[u8]) -> rustix::io::Result<()> {
    let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
    unless_earlier(|| sendto(socket, datagram, flags, &to))
}

/// A refusal that an earlier datagram met is reported by the next send, which itself was not tried.
fn unless_earlier(mut send: impl FnMut() -> rustix::io::Result<usize>) -> rustix::io::Result<()> {
    for _ in 0..3 {
        match send() {
            Ok(_) => return Ok(()),
            Err(Errno::INTR | Errno::CONNREFUSED) => {}
            Err(errno) => return Err(errno),
        }
    }
    Err(Errno::CONNREFUSED)
}

/// Why the port of broadcasts is not to be had.
fn refused(errno: Errno) -> Error {
    match errno {
        Errno::ADDRINUSE => Error::PortInUse,
        Errno::ACCESS | Errno::PERM => Error::PortNotPermitted,
        errno => network(errno),
    }
}

fn network(errno: Errno) -> Error {
    tracing::warn!(%errno, "a socket for datagrams could not be opened");
    Error::Network
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;

    use super::super::epoll::wait_readable;
    use super::*;

    /// Waits for one datagram that is `expected`; other units of the host may broadcast to the same port.
    fn receive(unit: &Datagrams, socket: Socket, expected: &[u8]) -> SocketAddr {
        let start = Instant::now();
        let mut buffer = [0; 64];
        while start.elapsed() < Duration::from_secs(30) {
            match unit.receive(socket, &mut buffer) {
                Some((count, source)) if &buffer[..count] == expected => return source,
                Some(_) => {}
                None => drop(wait_readable(unit.fd(socket), Duration::from_millis(20).into())),
            }
        }
        panic!("{expected:?} did not arrive in time")
    }

    fn units<const N: usize>() -> [Datagrams; N] {
        let mut port = 0;
        std::array::from_fn(|_| {
            let unit = Datagrams::open(Interfaces::Loopback, port).unwrap();
            port = unit.discovery_port();
            unit
        })
    }

    #[test]
    fn a_port_that_is_not_permitted_is_told_apart_from_a_network_that_is_down() {
        assert_eq!(refused(Errno::ACCESS), Error::PortNotPermitted);
        assert_eq!((refused(Errno::ADDRINUSE), refused(Errno::MFILE)), (Error::PortInUse, Error::Network));
    }

    #[test]
    fn a_broadcast_reaches_every_other_unit_that_shares_the_port() {
        let [sender, first, second] = units();
        assert!(sender.broadcast(b"who has?"));
        let from = SocketAddr::from((Ipv4Addr::LOCALHOST, sender.own_port()));
        assert_eq!(receive(&first, Socket::Shared, b"who has?"), from);
        assert_eq!(receive(&second, Socket::Shared, b"who has?"), from);
    }

    #[test]
    fn own_broadcasts_are_not_heard() {
        let [sender, other] = units();
        sender.broadcast(b"mine");
        other.broadcast(b"theirs");
        // Whatever precedes the other's datagram would be the own one.
        let start = Instant::now();
        let mut buffer = [0; 64];
        let count = loop {
            match sender.receive(Socket::Shared, &mut buffer) {
                Some((count, _)) if matches!(&buffer[..count], b"mine" | b"theirs") => break count,
                _ => assert!(start.elapsed() < Duration::from_secs(30)),
            }
        };
        assert_eq!(&buffer[..count], b"theirs");
    }

    #[test]
    fn an_answer_goes_to_the_own_socket_of_one_unit_alone() {
        let [asker, answerer, third] = units();
        asker.broadcast(b"who has?");
        let from = receive(&answerer, Socket::Shared, b"who has?");
        assert!(answerer.send_to(from, b"here"));
        assert_eq!(receive(&asker, Socket::Own, b"here").port(), answerer.own_port());
        assert_eq!(third.receive(Socket::Own, &mut [0; 64]), None);
    }

    #[test]
    fn a_datagram_leaves_from_the_address_that_is_asked_for() {
        let [unit, other] = units();
        let (from, to) = (Ipv4Addr::new(127, 0, 0, 9), SocketAddr::from((Ipv4Addr::LOCALHOST, other.own_port())));
        // A socket that is bound to one address sends from no other.
        let wide = Datagrams::open(Interfaces::All, unit.discovery_port()).unwrap();
        assert!(wide.send_from(from, to, b"alias"));
        assert_eq!(receive(&other, Socket::Own, b"alias"), SocketAddr::from((from, wide.own_port())));
        assert!(!wide.send_from(Ipv4Addr::new(192, 0, 2, 1), to, b"none"), "the host has no such address");
        let gone = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap().local_addr().unwrap();
        for _ in 0..10 {
            assert!(wide.send_from(from, gone, b"lost"));
        }
    }

    #[test]
    fn a_port_that_a_foreign_program_has_is_an_error_of_its_own() {
        let foreign = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap();
        let port = foreign.local_addr().unwrap().port();
        assert_eq!(Datagrams::open(Interfaces::Loopback, port).unwrap_err(), Error::PortInUse);
    }

    #[test]
    fn a_datagram_that_nobody_reads_harms_no_other() {
        let [unit, other] = units();
        let gone = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap().local_addr().unwrap();
        for _ in 0..10 {
            assert!(unit.send_to(gone, b"lost"));
        }
        let to = SocketAddr::from((Ipv4Addr::LOCALHOST, other.own_port()));
        assert!(unit.send_to(to, b"kept"));
        receive(&other, Socket::Own, b"kept");
    }

    #[test]
    fn a_long_datagram_is_cut_to_the_buffer_and_an_oversize_one_refused() {
        let [unit, other] = units();
        let to = SocketAddr::from((Ipv4Addr::LOCALHOST, other.own_port()));
        assert!(unit.send_to(to, &[1; 100]));
        assert!(!unit.send_to(to, &[1; 70_000]));
        assert_eq!(receive(&other, Socket::Own, &[1; 64]).port(), unit.own_port());
    }

    #[test]
    fn units_that_look_at_once_ask_the_system_once() {
        let ask = || -> Vec<_> { (0..100).map(|_| all_interfaces().unwrap()).collect() };
        // The machine may be so slow that the first list is too old before the last look.
        let once = |lists: Vec<Arc<[Interface]>>| lists.iter().all(|list| Arc::ptr_eq(list, &lists[0]));
        assert!((0..20).any(|_| once(ask())));
    }

    #[test]
    fn loopback_alone_has_no_other_target() {
        let [unit] = units();
        let targets = unit.targets();
        assert!(!targets.is_empty() && targets.iter().all(|interface| interface.address.is_loopback()), "{targets:?}");
    }
}
