//! The other end's unit as the units of this host see it: sockets at a loopback address of its own.
//!
//! Its ports are the unit's own ones. Those for links are learnt from its searches and answers, since a port cannot be
//! changed there: in secured mode they are signed.

use std::io;
use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4, TcpListener, TcpStream, UdpSocket};
use std::os::fd::OwnedFd;

use cara_core::distribution::datagram::{Datagram, Header};
use cara_core::host::line;
use cara_std::Fleet;
use rustix::io::Errno;
use rustix::net::{AddressFamily, SocketFlags, SocketType, bind, connect, socket_with, sockopt};

/// Ports of a unit that are open at a time: its own, and those from before it restarted.
const PORTS: usize = 4;
/// Units of this host that the line reaches; the one that was silent for longest gives way.
const UNITS: usize = 64;
/// What is read ahead of the line. A link's queue should stand in the unit, where an emergency passes it.
const READ_AHEAD: usize = 2_048;
/// Where broadcasts on loopback go.
const ALL: Ipv4Addr = Ipv4Addr::new(127, 255, 255, 255);
/// More than any datagram that the line takes.
const DATAGRAM_BYTES: usize = 2_048;

pub(crate) struct Host {
    address: Ipv4Addr,
    discovery_port: u16,
    fleet: Fleet,
    /// Hears broadcasts.
    shared: UdpSocket,
    /// The other unit's ports for datagrams, the newest last.
    pub(crate) datagrams: Vec<(u16, UdpSocket)>,
    /// Its ports for links, the newest last.
    pub(crate) links: Vec<(u16, TcpListener)>,
    /// Ports of this host's units, for datagrams and for links. The line reaches these and no other service of the host.
    units: Vec<(u16, ())>,
    units_for_links: Vec<(u16, ())>,
}

impl Host {
    pub(crate) fn open(address: Ipv4Addr, discovery_port: u16, fleet: Fleet) -> io::Result<Self> {
        let shared = socket(SocketType::DGRAM)?;
        sockopt::set_socket_reuseaddr(&shared, true)?;
        bind(&shared, &SocketAddrV4::new(Ipv4Addr::UNSPECIFIED, discovery_port))?;
        let (datagrams, links, units, units_for_links) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        Ok(Self { address, discovery_port, fleet, shared: shared.into(), datagrams, links, units, units_for_links })
    }

    /// The sockets on which datagrams come.
    pub(crate) fn hears(&self) -> impl Iterator<Item = &UdpSocket> {
        self.datagrams.iter().map(|(_, socket)| socket).chain([&self.shared])
    }

    /// Hands the datagrams that units of this host have sent to `send`, with their ports.
    pub(crate) fn receive(&mut self, mut send: impl FnMut(u16, u16, &[u8])) -> io::Result<()> {
        let mut buffer = [0; DATAGRAM_BYTES];
        let own = self.datagrams.iter().map(|(port, socket)| (*port, socket));
        for (to, socket) in own.chain([(0, &self.shared)]) {
            loop {
                let (count, from) = match socket.recv_from(&mut buffer) {
                    Ok((count, SocketAddr::V4(from))) => (count, from),
                    // An earlier datagram has met no reader.
                    Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => continue,
                    _ => break,
                };
                let datagram = buffer.get(..count).unwrap_or_default();
                // Not from the network, and not what this line or another one has brought.
                if *from.ip() != Ipv4Addr::LOCALHOST || !is_of(self.fleet, datagram) {
                    continue;
                }
                keep(&mut self.units, UNITS, from.port(), || Ok(()))?;
                if let Some(port) = port_for_links(datagram) {
                    keep(&mut self.units_for_links, UNITS, port, || Ok(()))?;
                }
                send(to, from.port(), datagram);
            }
        }
        Ok(())
    }

    /// Passes on a datagram of the other unit. What the network does not take is lost, as datagrams are.
    pub(crate) fn deliver(&mut self, datagram: &line::Datagram<'_>) -> io::Result<()> {
        let line::Datagram { to, from, bytes } = *datagram;
        let is_known = to == 0 || self.units.iter().any(|(port, ())| *port == to);
        if !is_known || !is_of(self.fleet, bytes) {
            return Ok(());
        }
        let address = self.address;
        if let Some(port) = port_for_links(bytes) {
            keep(&mut self.links, PORTS, port, || {
                let listener = TcpListener::bind((address, port))?;
                listener.set_nonblocking(true)?;
                Ok(listener)
            })?;
        }
        let socket = keep(&mut self.datagrams, PORTS, from, || for_datagrams(address, from))?;
        let to = if to == 0 { (ALL, self.discovery_port) } else { (Ipv4Addr::LOCALHOST, to) };
        // The first attempt may report that an earlier datagram met no reader.
        let _ = socket.send_to(bytes, to).or_else(|_| socket.send_to(bytes, to));
        Ok(())
    }

    /// A link that a unit of this host dials, and the port that it is for.
    pub(crate) fn accept(&self) -> Option<(u16, TcpStream)> {
        self.links.iter().find_map(|(port, listener)| {
            let (stream, _) = listener.accept().ok()?;
            prepare(&stream).ok()?;
            Some((*port, stream))
        })
    }

    /// Begins to dial a unit of this host.
    pub(crate) fn dial(&self, port: u16) -> io::Result<TcpStream> {
        if !self.units_for_links.iter().any(|(known, ())| *known == port) {
            return Err(io::ErrorKind::PermissionDenied.into());
        }
        let socket = socket(SocketType::STREAM)?;
        bind(&socket, &SocketAddrV4::new(self.address, 0))?;
        match connect(&socket, &SocketAddrV4::new(Ipv4Addr::LOCALHOST, port)) {
            Ok(()) | Err(Errno::INPROGRESS) => {}
            Err(errno) => return Err(errno.into()),
        }
        let stream = TcpStream::from(socket);
        prepare(&stream)?;
        Ok(stream)
    }
}

/// A socket for the other unit's datagrams. A board's come from the discovery port itself, which all units of the host share.
fn for_datagrams(address: Ipv4Addr, port: u16) -> io::Result<UdpSocket> {
    let socket = socket(SocketType::DGRAM)?;
    sockopt::set_socket_reuseaddr(&socket, true)?;
    sockopt::set_socket_broadcast(&socket, true)?;
    bind(&socket, &SocketAddrV4::new(address, port))?;
    Ok(socket.into())
}

fn socket(kind: SocketType) -> io::Result<OwnedFd> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    Ok(socket_with(AddressFamily::INET, kind, flags, None)?)
}

fn prepare(stream: &TcpStream) -> io::Result<()> {
    stream.set_nonblocking(true)?;
    stream.set_nodelay(true)?;
    Ok(sockopt::set_socket_recv_buffer_size(stream, READ_AHEAD)?)
}

fn is_of(fleet: Fleet, datagram: &[u8]) -> bool {
    Header::decode(datagram).is_ok_and(|(header, _)| header.fleet == fleet)
}

/// What there is of `port`, made if it is new; that which was used least lately goes if there are more than `most`.
fn keep<T>(
    open: &mut Vec<(u16, T)>,
    most: usize,
    port: u16,
    new: impl FnOnce() -> io::Result<T>,
) -> io::Result<&mut T> {
    if let Some(at) = open.iter().position(|(known, _)| *known == port) {
        let found = open.remove(at);
        open.push(found);
    } else {
        open.push((port, new()?));
        if open.len() > most {
            open.remove(0);
        }
    }
    open.last_mut().map(|(_, socket)| socket).ok_or_else(|| io::ErrorKind::NotFound.into())
}

/// Where a search or an answer says that its sender takes links.
fn port_for_links(datagram: &[u8]) -> Option<u16> {
    let (header, body) = Header::decode(datagram).ok()?;
    let port = match header.read(body).ok()? {
        Datagram::WhoHas(search) => search.tcp_port,
        Datagram::Announce(answer) => answer.tcp_port,
        Datagram::Session { .. } => 0,
    };
    (port != 0).then_some(port)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_too_many_ports_that_used_least_lately_goes() {
        let mut open = Vec::new();
        for port in [1, 2, 1, 3] {
            keep(&mut open, 2, port, || Ok(port)).unwrap();
        }
        assert_eq!(open, [(1, 1), (3, 3)]);
    }

    #[test]
    fn datagrams_may_come_from_the_discovery_port() {
        let address = Ipv4Addr::new(127, 67, 255, 2);
        let host = Host::open(address, 0, Fleet(1)).unwrap();
        let port = host.shared.local_addr().unwrap().port();
        for_datagrams(address, port).unwrap();
    }

    /// A device on the line must not reach what else the host runs.
    #[test]
    fn only_ports_of_units_are_dialled() {
        let service = TcpListener::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        let port = service.local_addr().unwrap().port();
        let address = Ipv4Addr::new(127, 67, 255, 1);
        let mut host = Host::open(address, 0, Fleet(1)).unwrap();
        assert_eq!(host.dial(port).unwrap_err().kind(), io::ErrorKind::PermissionDenied);
        keep(&mut host.units_for_links, UNITS, port, || Ok(())).unwrap();
        host.dial(port).unwrap();
        assert_eq!(service.accept().unwrap().1.ip(), address);
    }
}
