//! The network by itself: what arrives, when, and what faults do to it.

mod datagrams;
mod faults;
mod runs;
mod streams;

use cara_core::time::{Duration, Instant};
use cara_sim::{HostId, NetEvent, Network, Path, StreamId};
use std::net::SocketAddr;

const PORT: u16 = 7000;

fn at_port(network: &Network, host: HostId, port: u16) -> SocketAddr {
    SocketAddr::new(network.address(host).ip(), port)
}

fn millis(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

/// Two hosts, and a stream between them that is open.
struct Pair {
    network: Network,
    left: HostId,
    right: HostId,
    /// The left host's end, which dialled.
    dialled: StreamId,
    accepted: StreamId,
}

impl Pair {
    fn open(seed: u64) -> Self {
        Self::open_over(seed, Path::LAN)
    }

    fn open_over(seed: u64, path: Path) -> Self {
        let mut network = Network::new(seed);
        network.set_calm(path);
        let (left, right) = (network.add_host(), network.add_host());
        network.listen(right, PORT);
        let to = at_port(&network, right, PORT);
        let dialled = network.connect(left, to);
        let mut accepted = None;
        loop {
            match network.next_event().expect("the dial comes to an end") {
                NetEvent::Accepted { stream, .. } => accepted = Some(stream),
                NetEvent::Connected { .. } => break,
                other => panic!("{other:?}"),
            }
        }
        Self { network, left, right, dialled, accepted: accepted.expect("accepted before connected") }
    }

    /// Runs for `span` and returns all bytes that the accepting end reads in it.
    fn read_for(&mut self, span: Duration) -> Vec<u8> {
        let limit = self.network.now() + span;
        let mut bytes = Vec::new();
        while let Some(event) = self.network.next_event_until(limit) {
            if event == (NetEvent::Readable { host: self.right, stream: self.accepted }) {
                bytes.extend(read_all(&mut self.network, self.accepted));
            }
        }
        bytes
    }

    /// The first event that is none of `Readable`, with its time.
    fn next_other(&mut self) -> (Instant, NetEvent) {
        loop {
            match self.network.next_event().expect("something happens") {
                NetEvent::Readable { stream, .. } => drop(read_all(&mut self.network, stream)),
                event => return (self.network.now(), event),
            }
        }
    }
}

fn read_all(network: &mut Network, stream: StreamId) -> Vec<u8> {
    let mut all = Vec::new();
    network.read(stream, |bytes| {
        all.extend_from_slice(bytes);
        bytes.len()
    });
    all
}

/// Sends `message` from `writer` to the other end and returns what was read there and when the last byte was.
fn transfer(network: &mut Network, writer: StreamId, message: &[u8]) -> (Vec<u8>, Instant) {
    let mut written = network.write(writer, &[message]).expect("the stream is open");
    let (mut got, mut last) = (Vec::new(), network.now());
    while let Some(event) = network.next_event() {
        match event {
            NetEvent::Readable { stream, .. } if stream != writer => {
                got.extend(read_all(network, stream));
                last = network.now();
            }
            NetEvent::Writable { stream, .. } if stream == writer => {
                written += network.write(writer, &[&message[written..]]).expect("the stream is open");
            }
            _ => (),
        }
        if got.len() == message.len() {
            break;
        }
    }
    (got, last)
}

fn message(length: usize) -> Vec<u8> {
    (0..length).map(|index| (index % 251) as u8).collect()
}
