//! Clients that are no unit, or a misbehaving one: what they send, byte by byte, on any port.

use cara_core::config::{Mode, PLAIN_MAGIC, Priority, VERSIONS, Versions};
use cara_core::distribution::datagram::{SEARCH_BYTES, WhoHas};
use cara_core::distribution::hello::{Hello, Limits, Manager};
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::error::Refusal;
use cara_core::host::frame::{self, ChunkWriter, Chunking, Frame};
use cara_core::host::secure::Plain;
use cara_core::random::Random;

/// Streams and datagrams of garbage.
const GARBAGE: usize = 24;
/// The message that is broken off.
const MESSAGE: usize = 900;

/// The kind of client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UnknownClient {
    /// A unit of another version of the protocol.
    OtherVersion,
    /// An s_unit of another fleet that dials this manager all the same.
    OtherFleet,
    /// Bytes that mean nothing, some of which look like a datagram or a hello at first.
    Garbage,
    /// An s_unit that joins, begins a message and closes in the middle of a chunk.
    ClosesInMidChunk,
    /// So many silent connections, held as long as the world exists.
    Silent(usize),
}

/// The actions of a client on one connection.
pub(crate) struct Visit {
    /// Said at once.
    pub(crate) says: Vec<u8>,
    /// Whether to close after that, rather than to listen to what comes back.
    pub(crate) closes: bool,
}

impl UnknownClient {
    /// What a unit of another version speaks.
    pub(crate) const OTHER_VERSIONS: Versions = Versions { first: VERSIONS.last + 1, last: VERSIONS.last + 1 };

    /// Datagrams for the discovery port.
    pub(crate) fn datagrams(self, fleet: u32) -> Vec<Vec<u8>> {
        match self {
            Self::OtherVersion => vec![other_version()],
            Self::OtherFleet => vec![who_has(fleet.wrapping_add(1))],
            Self::Garbage => garbage(),
            Self::ClosesInMidChunk | Self::Silent(_) => Vec::new(),
        }
    }

    /// What is done on connections to the manager.
    pub(crate) fn visits(self, manager: &Identity, fleet: u32) -> Vec<Visit> {
        let hear = |says: Vec<u8>| vec![Visit { says, closes: false }];
        match self {
            Self::OtherVersion => hear(framed(&other_version())),
            Self::OtherFleet => hear(hello(manager, fleet.wrapping_add(1))),
            Self::Garbage => garbage().into_iter().map(|says| Visit { says, closes: true }).collect(),
            Self::ClosesInMidChunk => {
                vec![Visit { says: [hello(manager, fleet), half_a_message()].concat(), closes: true }]
            }
            Self::Silent(_) => Vec::new(),
        }
    }

    /// What it says on a network of another mode than plain: the same behind the magic of that mode, in a datagram or in a
    /// hello's frame.
    pub(crate) fn in_mode(mode: Mode, mut said: Vec<u8>) -> Vec<u8> {
        for at in [0, frame::HEADER_BYTES + 1] {
            if let Some(magic) = said.get_mut(at..at + PLAIN_MAGIC.len()).filter(|magic| *magic == PLAIN_MAGIC) {
                magic.copy_from_slice(&mode.magic());
            }
        }
        said
    }

    /// What it must be told before the end.
    pub(crate) fn is_reported(self) -> Option<Vec<u8>> {
        let refusal = match self {
            Self::OtherVersion => Refusal::Version(Self::OTHER_VERSIONS),
            Self::OtherFleet => Refusal::Fleet,
            _ => return None,
        };
        let mut refused = [0; 16];
        let length = frame::encode(&Frame::Refuse(refusal.to_wire()), 0, &mut refused);
        Some(refused[..length].to_vec())
    }
}

fn other_version() -> Vec<u8> {
    let mut said = vec![0; 32];
    said[..4].copy_from_slice(&PLAIN_MAGIC);
    said[4] = UnknownClient::OTHER_VERSIONS.first;
    said[5] = UnknownClient::OTHER_VERSIONS.last;
    said
}

fn framed(hello: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0; hello.len() + 16];
    let length = frame::encode(&Frame::Hello(hello), 0, &mut bytes);
    bytes.truncate(length);
    bytes
}

fn hello(manager: &Identity, fleet: u32) -> Vec<u8> {
    let hello = Hello {
        versions: cara_core::config::VERSIONS,
        capabilities: 0,
        fleet: Fleet(fleet),
        identity: Identity::s_unit("stranger", 66).expect("a short name"),
        wanted: Manager::new(manager.name(), manager.id()).ok(),
        epoch: Epoch(6),
        claim: None,
        obeyed: None,
        nonce: 6,
        limits: Limits { message_size: 1024, chunk_size: 1024, calls: 8, minimum_interval: 0 },
        link: 0,
        udp_port: 0,
        stamp: 0,
        keep_alive: 1_000,
        skipped: 0,
    };
    let mut bytes = [0; 320];
    let length = hello.encode(Mode::Plain, &mut bytes).expect("a hello fits");
    framed(&bytes[..length])
}

fn who_has(fleet: u32) -> Vec<u8> {
    let who_has = WhoHas {
        identity: Identity::m_unit("stranger", 66).expect("a short name"),
        epoch: Epoch(6),
        sequence: 1,
        nonce: 6,
        wanted: None,
        tcp_port: 0,
        expected: 1,
        known: Default::default(),
        standby: false,
        skipped: 0,
    };
    let mut bytes = [0; SEARCH_BYTES];
    who_has.encode(Fleet(fleet), &Plain, &mut bytes).expect("a search fits").to_vec()
}

/// All of the first chunk of a message but its last bytes.
fn half_a_message() -> Vec<u8> {
    let cut = Chunking { chunk: 500, overhead: 0 };
    let mut bytes = vec![0; cut.framed_length(MESSAGE)];
    let writer = ChunkWriter::new(&mut bytes, cut, Priority::Normal, MESSAGE);
    writer.expect("there is room").put(&[1; MESSAGE]);
    bytes.truncate(400);
    bytes
}

/// A third of it is noise, a third begins like a datagram, a third is a hello's frame around noise.
fn garbage() -> Vec<Vec<u8>> {
    let mut random = Random::new(0x6A2B_A6E5);
    let mut one = |number: usize| {
        let length = 8 + random.below(1_200) as usize;
        let mut bytes: Vec<u8> = (0..length).map(|_| random.bits() as u8).collect();
        if !number.is_multiple_of(3) {
            bytes[..4].copy_from_slice(&PLAIN_MAGIC);
            bytes[4] = VERSIONS.last;
        }
        if number % 3 == 2 {
            bytes.truncate(200);
            bytes = framed(&bytes);
        }
        bytes
    };
    (0..GARBAGE).map(&mut one).collect()
}
