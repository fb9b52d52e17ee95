//! Every limit of CARA in one place: what can be set while running ([`Constraints`]) and what is fixed when compiling.

use core::fmt;

use crate::time::Duration;

/// The versions of the protocol that this unit speaks, told in every hello and who-has. Two units use the highest one
/// that both speak, and refuse each other where there is none.
pub const VERSIONS: Versions = Versions { first: 2, last: 2 };
/// First four bytes of every datagram and hello in plain mode. Secured mode has its own, so the two never meet.
pub const PLAIN_MAGIC: [u8; 4] = *b"CARp";
/// First four bytes of every datagram and hello in secured mode.
pub const SECURED_MAGIC: [u8; 4] = *b"CARs";
/// UDP port on which units of plain mode listen for broadcasts. Secured mode uses the next one.
pub const PLAIN_PORT: u16 = 21_970;
/// UDP port on which units of secured mode listen for broadcasts.
pub const SECURED_PORT: u16 = 21_971;

/// Longest name of a node, in bytes of UTF-8. Costs this much per known node.
pub const NODE_NAME_BYTES: usize = 32;
/// Longest name of a function or variable, in bytes of UTF-8. Stored as long as it is.
pub const NAME_BYTES: usize = 32;
/// Most variables in one `Parameters`, and in the arguments or results of one function. Costs 16 bytes each per `Parameters`.
pub const VARIABLES: usize = 16;
/// Longest text of a failure, in bytes; a longer one is cut. Costs so many bytes for each failure that is made or taken.
pub const FAILURE_TEXT_BYTES: usize = 96;
/// Names and values of one failure, in bytes; what does not fit is refused as [`ParametersBytes`](crate::error::Limit::ParametersBytes).
pub const FAILURE_VALUES_BYTES: usize = 256;
/// Progress of the calls of one peer is sent at most this often, so that a handler that publishes all the time fills no network.
pub const PROGRESS_INTERVAL: Duration = Duration::from_millis(10);
/// Longest encoded signature (name, arguments and results of one function), in bytes: 384, or 1,024 for units that have
/// lists and records. Stored as long as it is.
pub const SIGNATURE_BYTES: usize = if crate::ability::NESTED { 1024 } else { 384 };
/// Longest line of help on a function, in bytes; a longer one is cut. Stored as long as it is, with the signature.
pub const HELP_BYTES: usize = 160;
/// Longest unit of a variable, in bytes; a longer one is cut. Stored as long as it is, with the signature.
pub const UNIT_BYTES: usize = 16;
/// Most lists and records inside each other, the outermost included. Costs 32 bytes of stack each while a block is checked.
pub const DEPTH: usize = 4;
/// Bytes of the values and names in a `Parameters` whose size is not given.
pub const PARAMETERS_BYTES: usize = 512;

/// Longest frame body that the protocol allows, in bytes; a peer may advertise less. Bounds how long an emergency waits
/// behind another message: 4 KiB take 33 ms on a 1 Mbit/s link.
pub const CHUNK_BYTES: usize = 4096;
/// Shortest chunk that a unit may advertise as its limit: an emergency must fit into one.
pub const MINIMUM_CHUNK_BYTES: usize = 320;
/// Longest emergency message, in bytes: fits one chunk and one datagram. Each link reserves room for one.
pub const EMERGENCY_BYTES: usize = 256;
/// Calls of emergency services, or of those that stop, that may be in flight to a peer when its table of calls is full; one
/// more is refused as [`Calls`](crate::error::Limit::Calls). Costs 24 bytes each per link.
pub const EMERGENCY_CALLS: usize = 8;
/// Longest message of best-effort delivery, in bytes: one UDP datagram that is not fragmented on Ethernet.
pub const DATAGRAM_BYTES: usize = 1400;
/// The buffer that each link owns: partial frames and handshakes up to this length need no buffer of the pool.
pub const LINK_BUFFER_BYTES: usize = 512;

/// Longest frame on a serial line, delimiters included: what an emergency waits for at most, 67 ms at 19,200 baud.
pub const LINE_FRAME_BYTES: usize = 128;
/// Longest datagram on a serial line, as long as the longest search. A longer one is refused, and counted. Costs a line four times as much.
pub const LINE_DATAGRAM_BYTES: usize = 512;
/// Frames of a serial line's stream that may be unacknowledged; a power of two. Costs a line 232 bytes each.
pub const LINE_WINDOW: u8 = 4;
/// How long a serial line's stream may go unanswered before it ends. An idle one is watched by keep-alives alone.
pub const LINE_LOST: Duration = Duration::from_secs(4);

/// Managers whose highest claim a unit keeps. Costs 104 bytes each on a board; that of a further one is not kept, which is counted.
pub const OBEYED_MANAGERS: usize = 4;

/// Leases that one peer may hold here, and this unit at one peer. Costs 32 bytes each per link.
pub const LEASES: usize = 4;

/// Ids behind the newest one that the at-most-once window of a priority remembers.
pub const WINDOW: u32 = 64;
/// How long a unit waits on a new link for the peer's hello, and in secured mode for the whole proof, before it closes it.
pub const HELLO_TIMEOUT: Duration = Duration::from_secs(2);
/// A secured link is rekeyed, in a new handshake, before its keys reach this age. Up to an eighth less, by chance, so
/// that a fleet that joined at once does not do it at once.
pub const HANDSHAKE_LIFE: Duration = Duration::from_secs(12 * 3_600);
/// The least time from one handshake of a link to the next.
pub const SHORTEST_HANDSHAKE_LIFE: Duration = Duration::from_secs(1);
/// How long a peer that is heard may take for its part of a new handshake on a live link before the link is given up.
pub const RENEWAL_TIMEOUT: Duration = Duration::from_secs(60);
/// Datagrams under the previous key are accepted for this long after the first one under the new key.
pub const PREVIOUS_KEY_LIFE: Duration = Duration::from_secs(5);
/// How long an old link may take to answer the challenge that tells a restarted peer from a duplicate one.
pub const CHALLENGE_TIMEOUT: Duration = Duration::from_millis(300);
/// Shortest pause between two keep-alives.
pub const SHORTEST_KEEP_ALIVE: Duration = Duration::from_millis(1);
/// Longest pause between two keep-alives. A unit refuses a longer one of its own. A longer one that a peer advertises
/// is taken as this, so that a vanished peer is lost after 210 s at most.
pub const LONGEST_KEEP_ALIVE: Duration = Duration::from_secs(60);
/// Keep-alives that may be missed in a row.
pub const MISSED_KEEP_ALIVES: u8 = 3;
/// Where only the stream passes, no peer is lost earlier than this, however short its keep-alives: retransmissions after one lost
/// segment take as long.
pub const STREAM_ONLY_LOSS: Duration = Duration::from_secs(3);
/// A stream into which nothing was written for this long is probed.
pub const PROBE: Duration = Duration::from_secs(4);
/// A stream is dead when what was written does not reach the peer, and nothing else does, for this long.
pub const STREAM_DEAD: Duration = Duration::from_secs(8);
/// And in this direction alone, while the other one gets on.
pub const ONE_WAY_DEAD: Duration = Duration::from_secs(16);
/// Both where a keep-alive was missed within the last minute: on a path that loses a tenth of all frames, a stack that resends after
/// 1, 3, 7 and 15 s is stuck for more than 8 s every few hours.
pub const LOSSY_DEAD: Duration = Duration::from_secs(60);
/// The maximum segment size with which a stream is dialled again that died with more than this outstanding: the least that every
/// IPv4 host takes (RFC 9293, section 3.7.1).
pub const SHORT_SEGMENT: u16 = 536;
/// One-way messages written this soon after the last write are gathered.
pub const GATHER: Duration = Duration::from_micros(50);
/// First back-off between two searches; doubles up to [`LONGEST_SEARCH`], each with full jitter on top.
pub const FIRST_SEARCH: Duration = Duration::from_millis(250);
/// Longest back-off between two searches.
pub const LONGEST_SEARCH: Duration = Duration::from_secs(8);
/// Searches per [`SEARCH_WINDOW`] on a network, own and heard, above which a unit defers its own.
pub const SEARCH_BUDGET: u8 = 4;
/// The window of [`SEARCH_BUDGET`].
pub const SEARCH_WINDOW: Duration = Duration::from_secs(1);
/// An answer to a broadcast is delayed at random by up to this much per node that is expected to answer as well.
pub const ANSWER_SPREAD: Duration = Duration::from_millis(1);

/// Versions of the protocol, from the first to the last.
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Versions {
    /// The lowest one.
    pub first: u8,
    /// The highest one.
    pub last: u8,
}

impl Versions {
    /// The highest version that is among both.
    pub const fn common(self, other: Self) -> Option<u8> {
        let first = if self.first > other.first { self.first } else { other.first };
        let last = if self.last < other.last { self.last } else { other.last };
        if first <= last { Some(last) } else { None }
    }

    /// Of the two bytes on the wire. Version 1 has something else where the last version is now.
    pub(crate) const fn from_wire(first: u8, last: u8) -> Self {
        Self { first, last: if first <= 1 || last < first { first } else { last } }
    }
}

/// `2`, or `2 to 4`.
impl fmt::Display for Versions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.first)?;
        if self.last == self.first { Ok(()) } else { write!(f, " to {}", self.last) }
    }
}

/// What can be set by hand (paper, section 2), before the start and while running. Peers are told what concerns them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Constraints {
    /// Default time-out of blocking and asynchronous requests.
    pub request_timeout: Duration,
    /// Least time between two requests to one node; zero switches the limit off. The callee enforces its own as well.
    pub minimum_interval: Duration,
    /// Most nodes connected at a time; the next one is refused with `Full`.
    pub maximum_nodes: u16,
    /// Longest message received, in bytes of its block of parameters; told to peers, which refuse to send a longer one.
    pub message_size: u32,
    /// Longest chunk received, in bytes; told to peers.
    pub chunk_size: u16,
    /// Pause between two keep-alives: [`SHORTEST_KEEP_ALIVE`] to [`LONGEST_KEEP_ALIVE`].
    pub keep_alive: Duration,
    /// Calls that one peer may have waiting or running here; the next one is answered with `Busy`.
    pub calls_per_peer: u16,
    /// Which of a peer's calls that wait here and move nothing begins next, within a class.
    pub scheduling: Scheduling,
    /// How long orders of a manager go on once another one of its identity, with a higher claim, wants to command.
    pub handover: Duration,
    /// Streams of this unit that one peer may be subscribed to; the next subscription is refused.
    pub subscriptions_per_peer: u16,
    /// Bytes of values of streams that one peer is sent in a second; what is above comes later, and is newer then.
    pub stream_bytes: u32,
}

impl Constraints {
    /// Defaults of an m_unit.
    pub const M_UNIT: Self = Self {
        request_timeout: Duration::from_secs(2),
        minimum_interval: Duration::ZERO,
        maximum_nodes: 1_000,
        message_size: 32 * 1024,
        chunk_size: CHUNK_BYTES as u16,
        keep_alive: Duration::from_secs(1),
        calls_per_peer: 64,
        scheduling: Scheduling::EarliestDeadline,
        handover: Duration::from_secs(10),
        subscriptions_per_peer: 1_024,
        stream_bytes: 1_000_000,
    };
    /// Defaults of an s_unit, sized for a microcontroller.
    pub const S_UNIT: Self = Self {
        request_timeout: Duration::from_secs(2),
        minimum_interval: Duration::ZERO,
        maximum_nodes: 1,
        message_size: 1024,
        chunk_size: 1024,
        keep_alive: Duration::from_secs(1),
        calls_per_peer: 8,
        scheduling: Scheduling::EarliestDeadline,
        handover: Duration::from_secs(10),
        subscriptions_per_peer: 8,
        stream_bytes: 100_000,
    };
}

/// Which of the calls that wait begins next. Calls that move, stop or reset something keep their order in each and are never refused
/// for their deadlines, and of equal time-outs the call that came first is first in each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Scheduling {
    /// The one with the earliest deadline, but one that has waited half its time-out before all others. Where no more calls may
    /// wait, the one with the latest deadline is refused.
    #[default]
    EarliestDeadline,
    /// The one that came first. Where no more calls may wait, the one that comes is refused.
    Fifo,
    /// As [`EarliestDeadline`](Self::EarliestDeadline), and a call is refused as [`Busy`](crate::error::Error::Busy), when it comes
    /// or when its turn comes, if its function has lately taken longer on average than it has left. The averages of the eight functions that ran last are kept. On a
    /// board with the feature `admission`. One a second begins all the
    /// same, so that a function that was slow once is tried again. So more deadlines are met where more is asked than can be done.
    Admission,
}

impl Scheduling {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::EarliestDeadline, Self::Fifo, Self::Admission];

    /// As people and files write it: `deadline`, `fifo` or `admission`.
    pub const fn word(self) -> &'static str {
        match self {
            Self::EarliestDeadline => "deadline",
            Self::Fifo => "fifo",
            Self::Admission => "admission",
        }
    }
}

/// Whether units prove their identity and seal their frames. Units of different modes never connect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Mode {
    /// Frames are in clear, and every claimed identity is accepted.
    Plain,
    /// A peer is accepted only with a proof of the pair's key; frames are sealed.
    Secured,
}

impl Mode {
    /// As people and files write it: `plain` or `secured`.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::Secured => "secured",
        }
    }

    /// First four bytes of every datagram and hello.
    pub const fn magic(self) -> [u8; 4] {
        match self {
            Self::Plain => PLAIN_MAGIC,
            Self::Secured => SECURED_MAGIC,
        }
    }

    /// The mode of these first four bytes.
    pub const fn of_magic(magic: [u8; 4]) -> Option<Self> {
        match magic {
            PLAIN_MAGIC => Some(Self::Plain),
            SECURED_MAGIC => Some(Self::Secured),
            _ => None,
        }
    }

    /// Cipher suites that a unit of this mode has, a bit each: bit 0 is `Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s`.
    pub const fn suites(self) -> u16 {
        match self {
            Self::Plain => 0,
            Self::Secured => 1,
        }
    }

    /// UDP port on which units listen for broadcasts.
    pub const fn port(self) -> u16 {
        match self {
            Self::Plain => PLAIN_PORT,
            Self::Secured => SECURED_PORT,
        }
    }
}

/// Class of a request. An emergency goes between the chunks of other messages, ignores the minimum interval and has
/// reserved capacity everywhere; the other classes take turns between messages, highest first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum Priority {
    /// "Stop now": at most [`EMERGENCY_BYTES`], also sent as a datagram.
    Emergency = 0,
    /// Before normal messages.
    High = 1,
    /// The default.
    #[default]
    Normal = 2,
    /// After all others.
    Low = 3,
}

impl Priority {
    /// All classes, highest first.
    pub const ALL: [Self; 4] = [Self::Emergency, Self::High, Self::Normal, Self::Low];

    /// The byte on the wire.
    pub const fn to_wire(self) -> u8 {
        self as u8
    }

    /// The class of a byte on the wire.
    pub const fn from_wire(byte: u8) -> Option<Self> {
        match byte {
            0 => Some(Self::Emergency),
            1 => Some(Self::High),
            2 => Some(Self::Normal),
            3 => Some(Self::Low),
            _ => None,
        }
    }

    /// `emergency`, `high`, `normal`, `low`.
    pub const fn word(self) -> &'static str {
        match self {
            Self::Emergency => "emergency",
            Self::High => "high",
            Self::Normal => "normal",
            Self::Low => "low",
        }
    }
}
