//! Bytes that mean nothing, on every port of a unit: nothing changes.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpStream, UdpSocket};
use std::time::{Duration, Instant};

use cara_std::{Constraints, Mode};
use socket2::{Domain, Socket, Type};

use crate::support::{PATIENCE, ask, counter, fleet, meet, number, service, system, unit, until};

/// Pseudo-random bytes from a fixed start.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn bytes(&mut self) -> Vec<u8> {
        let length = 1 + self.next() as usize % 700;
        let mut bytes: Vec<u8> = (0..length).map(|_| self.next() as u8).collect();
        // Some of it looks like a datagram or a hello at first.
        if self.next().is_multiple_of(2) {
            let magic = [&Mode::Secured.magic()[..], &[1]].concat();
            let length = magic.len().min(bytes.len());
            bytes[..length].copy_from_slice(&magic[..length]);
        }
        bytes
    }
}

/// The TCP port of a manager is where a vehicle's link leads.
fn stream_port(agv: &cara_std::Unit) -> SocketAddr {
    agv.manager().unwrap().address().unwrap()
}

/// The UDP ports of this process. The system's table has those of all processes of the host, whose tests count what they hear.
fn datagram_ports() -> Vec<u16> {
    let table = std::fs::read_to_string("/proc/self/net/udp").unwrap();
    let own: Vec<String> = std::fs::read_dir("/proc/self/fd")
        .unwrap()
        .filter_map(|file| std::fs::read_link(file.ok()?.path()).ok())
        .filter_map(|target| Some(target.to_str()?.strip_prefix("socket:[")?.strip_suffix(']')?.to_owned()))
        .collect();
    let port = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let (address, inode) = (words.get(1)?, words.get(9)?);
        u16::from_str_radix(address.rsplit(':').next()?, 16).ok().filter(|_| own.iter().any(|known| known == inode))
    };
    table.lines().skip(1).filter_map(port).collect()
}

#[test]
fn junk_on_every_port_changes_nothing() {
    let fleet = fleet();
    let discovery = cara_processes::discovery_port();
    let manager = system(fleet).discovery_port(discovery).build().unwrap();
    let agv = unit("agv", 7, fleet).discovery_port(discovery).build().unwrap();
    agv.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &agv);
    let stream_port = stream_port(&agv);
    let mut noise = Noise(0x9e37_79b9_7f4a_7c15);
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
    let ports = datagram_ports();
    assert!(ports.contains(&discovery) && ports.len() >= 4, "each unit has two: {ports:?}");
    let mut half_open = Vec::new();
    for round in 0..60 {
        for port in &ports {
            // A port that is closed meanwhile refuses; that harms only this socket.
            let _ = socket.send_to(&noise.bytes(), (Ipv4Addr::LOCALHOST, *port));
        }
        let mut stream = TcpStream::connect(stream_port).unwrap();
        if round % 3 != 0 {
            let _ = stream.write_all(&noise.bytes());
        }
        if round % 5 == 0 {
            half_open.push(stream);
        }
        assert_eq!(ask(&peer, "echo", round), Ok(round));
    }
    assert!(counter(&peer.counters(), "CallsTimedOut") == 0 && peer.is_connected());
    assert_eq!(manager.s_units().len(), 1);
    // Silent connections are closed.
    for mut stream in half_open {
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut rest = Vec::new();
        match stream.read_to_end(&mut rest) {
            Ok(_) => {}
            Err(error) => assert_eq!(error.kind(), std::io::ErrorKind::ConnectionReset, "{error}"),
        }
    }
    assert_eq!(ask(&peer, "echo", 5), Ok(5));
}

/// More half-open connections than the capacity: established links stay, and units still join.
#[test]
fn half_open_connections_do_not_keep_units_out_for_ever() {
    let fleet = fleet();
    let manager = system(fleet).build().unwrap();
    let first = unit("first", 1, fleet).build().unwrap();
    first.my_function_list().add_function("echo", &number(0), service(|number| number)).unwrap();
    let (peer, _) = meet(&manager, &first);
    let port = stream_port(&first);
    let silent: Vec<_> =
        (0..200).filter_map(|_| TcpStream::connect_timeout(&port, Duration::from_secs(5)).ok()).collect();
    assert!(silent.len() > 150);
    assert_eq!(ask(&peer, "echo", 5), Ok(5));
    let second = unit("second", 2, fleet).build().unwrap();
    second.start().unwrap();
    until("the second comes", || manager.number_of_s_units() == 2);
    drop(silent);
}

/// A host that opens many connections displaces its own, not that of another, slower host.
#[test]
fn half_open_connections_of_one_host_give_way_to_each_other_first() {
    let fleet = fleet();
    let constraints = Constraints { maximum_nodes: 4, ..Constraints::M_UNIT };
    let manager = system(fleet).constraints(constraints).build().unwrap();
    let first = unit("first", 1, fleet).build().unwrap();
    meet(&manager, &first);
    let port = stream_port(&first);
    // A silent connection is closed after 2 s, so a machine that is slower than that tries again.
    let was_in_time = (0..20).any(|_| {
        let began = Instant::now();
        let slow = connection_from(Ipv4Addr::LOCALHOST, port);
        let gave_way = counter(&manager.counters(), "GaveWay");
        let greedy: Vec<_> = (0..100).map(|_| connection_from(Ipv4Addr::new(127, 0, 0, 2), port)).collect();
        until("some gave way", || counter(&manager.counters(), "GaveWay") > gave_way);
        slow.set_nonblocking(true).unwrap();
        let is_open = (&slow).read(&mut [0; 1]).is_err_and(|error| error.kind() == std::io::ErrorKind::WouldBlock);
        drop(greedy);
        let in_time = began.elapsed() < Duration::from_millis(1_500);
        assert!(is_open || !in_time, "another host's connection was ended");
        in_time
    });
    assert!(was_in_time, "this machine opens no 100 connections in 1.5 s");
    assert!(first.manager().is_some_and(|manager| manager.is_connected()));
}

/// A connection that says nothing.
fn connection_from(host: Ipv4Addr, to: SocketAddr) -> TcpStream {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
    socket.bind(&SocketAddr::from((host, 0)).into()).unwrap();
    socket.connect(&to.into()).unwrap();
    socket.into()
}
