//! Every limit of CARA in one place: those that can be set while running ([`Constraints`]) and those fixed at compile time.

use core::fmt;

use crate::time::Duration;

/// The protocol versions that this unit speaks, announced in every hello and who-has. Two units use the highest common version,
/// and refuse each other if there is none.
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
/// Longest text of a failure, in bytes; a longer one is cut. Each failure that is made or received costs this much.
pub const FAILURE_TEXT_BYTES: usize = 96;
/// Capacity for names and values of one failure, in bytes; beyond it [`ParametersBytes`](crate::error::Limit::ParametersBytes).
pub const FAILURE_VALUES_BYTES: usize = 256;
/// Least interval between progress messages to one peer, so that a handler that reports continuously cannot flood the network.
pub const PROGRESS_INTERVAL: Duration = Duration::from_millis(10);
/// Longest encoded signature (name, arguments and results of one function), in bytes: 384, or 1,024 for units that have
/// lists and records. Stored as long as it is.
pub const SIGNATURE_BYTES: usize = if crate::ability::NESTED { 1024 } else { 384 };
/// Longest line of help on a function, in bytes; a longer one is cut. Stored with the signature, as long as it is.
pub const HELP_BYTES: usize = 160;
/// Longest unit of a variable, in bytes; a longer one is cut. Stored with the signature, as long as it is.
pub const UNIT_BYTES: usize = 16;
/// Deepest nesting of lists and records, the outermost included. Each level costs 32 bytes of stack while a block is checked.
pub const DEPTH: usize = 8;
/// Default capacity for names and values in a `Parameters`, in bytes.
pub const PARAMETERS_BYTES: usize = 512;

/// Longest frame body that the protocol allows, in bytes; a peer may advertise less. Bounds how long an emergency waits
/// behind another message: 4 KiB take 33 ms on a 1 Mbit/s link.
pub const CHUNK_BYTES: usize = 4096;
/// Shortest chunk that a unit may advertise as its limit: an emergency must fit into one.
pub const MINIMUM_CHUNK_BYTES: usize = 320;
/// Longest emergency message, in bytes: fits one chunk and one datagram. Each link reserves capacity for one.
pub const EMERGENCY_BYTES: usize = 256;
/// Calls of emergency or stop functions that may be in flight to a peer when its table of calls is full; beyond it
/// [`Calls`](crate::error::Limit::Calls). Each costs 24 bytes per link.
pub const EMERGENCY_CALLS: usize = 8;
/// Longest message of best-effort delivery, in bytes: one UDP datagram that is not fragmented on Ethernet.
pub const DATAGRAM_BYTES: usize = 1400;
/// Capacity of each link's own buffer: partial frames and handshakes up to this length need no buffer of the pool.
pub const LINK_BUFFER_BYTES: usize = 512;

/// Longest frame on a serial line, delimiters included: the longest wait of an emergency, 67 ms at 19,200 baud.
pub const LINE_FRAME_BYTES: usize = 128;
/// Longest datagram on a serial line, as long as the longest search; a longer one is refused and counted. Costs four times this.
pub const LINE_DATAGRAM_BYTES: usize = 512;
/// Unacknowledged frames of a serial line's stream; a power of two. Each costs 232 bytes per line.
pub const LINE_WINDOW: u8 = 4;
/// How long a serial line's stream may go without an acknowledgement before it ends. If idle, only keep-alives watch it.
pub const LINE_LOST: Duration = Duration::from_secs(4);

/// Managers whose highest claim a unit stores. Each costs 104 bytes on a board; claims of further managers are counted only.
pub const OBEYED_MANAGERS: usize = 4;

/// Leases that one peer may hold here, and this unit at one peer. Each costs 32 bytes per link.
pub const LEASES: usize = 4;

/// How many ids behind the newest the at-most-once window of a priority remembers.
pub const WINDOW: u32 = 64;
/// How long a new link may take until the peer's hello, and in secured mode its proof; then it is closed.
pub const HELLO_TIMEOUT: Duration = Duration::from_secs(2);
/// Age by which a secured link is rekeyed in a new handshake: at random up to an eighth earlier, so that a fleet that joined
/// together does not rekey together.
pub const HANDSHAKE_LIFE: Duration = Duration::from_secs(12 * 3_600);
/// Least time between two handshakes of a link.
pub const SHORTEST_HANDSHAKE_LIFE: Duration = Duration::from_secs(1);
/// How long a peer that is alive may take for its part of a new handshake on a live link; then the link ends.
pub const RENEWAL_TIMEOUT: Duration = Duration::from_secs(60);
/// Datagrams under the previous key are accepted for this long after the first one under the new key.
pub const PREVIOUS_KEY_LIFE: Duration = Duration::from_secs(5);
/// How long an old link has to answer the challenge that distinguishes a restarted peer from a duplicate.
pub const CHALLENGE_TIMEOUT: Duration = Duration::from_millis(300);
/// A vehicle that is handed over to another manager goes back unless it has joined there within this time.
pub const HAND_OVER_TIMEOUT: Duration = Duration::from_secs(10);
/// Shortest keep-alive interval.
pub const SHORTEST_KEEP_ALIVE: Duration = Duration::from_millis(1);
/// Longest keep-alive interval. A unit refuses a longer one of its own, and limits a peer's to this, so that a vanished peer is
/// lost after 210 s at most.
pub const LONGEST_KEEP_ALIVE: Duration = Duration::from_secs(60);
/// How many keep-alives in a row may be missed.
pub const MISSED_KEEP_ALIVES: u8 = 3;
/// If only the stream passes, no peer is lost earlier than this, however short its keep-alives: retransmission after one lost
/// segment takes that long.
pub const STREAM_ONLY_LOSS: Duration = Duration::from_secs(3);
/// A stream without writes for this long is probed.
pub const PROBE: Duration = Duration::from_secs(4);
/// A stream is dead if bytes written do not reach the peer, and nothing arrives from it, for this long.
pub const STREAM_DEAD: Duration = Duration::from_secs(8);
/// A stream is dead if only this direction makes no progress for this long.
pub const ONE_WAY_DEAD: Duration = Duration::from_secs(16);
/// Replaces both limits if a keep-alive was missed within the last minute: on a path that loses a tenth of all frames, a TCP that
/// retransmits after 1, 3, 7 and 15 s is stuck for more than 8 s every few hours.
pub const LOSSY_DEAD: Duration = Duration::from_secs(60);
/// The maximum segment size for dialling again after a stream died with more than this outstanding: the least that every IPv4
/// host accepts (RFC 9293, section 3.7.1).
pub const SHORT_SEGMENT: u16 = 536;
/// One-way messages written this soon after the last write are gathered.
pub const GATHER: Duration = Duration::from_micros(50);
/// First back-off between searches; doubles up to [`LONGEST_SEARCH`], each with full jitter on top.
pub const FIRST_SEARCH: Duration = Duration::from_millis(250);
/// Longest back-off between searches.
pub const LONGEST_SEARCH: Duration = Duration::from_secs(8);
/// Searches per [`SEARCH_WINDOW`] on a network, own and others', above which a unit defers its own.
pub const SEARCH_BUDGET: u8 = 4;
/// The window of [`SEARCH_BUDGET`].
pub const SEARCH_WINDOW: Duration = Duration::from_secs(1);
/// An answer to a broadcast is delayed at random by up to this much for each node that is expected to answer.
pub const ANSWER_SPREAD: Duration = Duration::from_millis(1);

/// A range of protocol versions.
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Versions {
    /// The lowest.
    pub first: u8,
    /// The highest.
    pub last: u8,
}

impl Versions {
    /// The highest version in both ranges.
    pub const fn common(self, other: Self) -> Option<u8> {
        let first = if self.first > other.first { self.first } else { other.first };
        let last = if self.last < other.last { self.last } else { other.last };
        if first <= last { Some(last) } else { None }
    }

    /// Decodes the two bytes on the wire. In version 1 the second byte has another meaning.
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

/// What can be set (paper, section 2), before the start and while running. Peers are notified of what concerns them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Constraints {
    /// Default time-out of requests.
    pub request_timeout: Duration,
    /// Least time between two requests to one node; zero switches the limit off. The callee enforces its own, too.
    pub minimum_interval: Duration,
    /// Most nodes connected at a time; the next is refused with `Full`.
    pub maximum_nodes: u16,
    /// Longest message received, in bytes of its block of parameters; peers know it and send no longer one.
    pub message_size: u32,
    /// Longest chunk received, in bytes; peers know it.
    pub chunk_size: u16,
    /// Keep-alive interval: [`SHORTEST_KEEP_ALIVE`] to [`LONGEST_KEEP_ALIVE`].
    pub keep_alive: Duration,
    /// Calls of one peer that may wait or run here; the next is refused with `Busy`.
    pub calls_per_peer: u16,
    /// Which of a peer's waiting calls of one class begins next, if they move nothing.
    pub scheduling: Scheduling,
    /// How long orders of a manager may continue once another of its identity, with a higher claim, wants to command.
    pub handover: Duration,
    /// Streams of this unit that one peer may subscribe to; the next is refused.
    pub subscriptions_per_peer: u16,
    /// Bytes of stream values that one peer is sent in a second; beyond it values are sent later, and newer.
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
    /// Defaults of an m_unit that stands by. Three of these keep-alives leave a standby time to listen for answers, and to be obeyed
    /// within 3 s of its manager's failure.
    pub const STANDBY: Self = Self { keep_alive: Duration::from_millis(700), ..Self::M_UNIT };
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

/// Which waiting call begins next. In all variants, calls that move, stop or reset something keep their order and are never
/// refused for their deadlines, and calls with equal time-outs keep their order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Scheduling {
    /// The call with the earliest deadline, but one that has waited half of its time-out first of all. If no more may wait, the
    /// call with the latest deadline is refused.
    #[default]
    EarliestDeadline,
    /// The call that arrived first. If no more may wait, the new one is refused.
    Fifo,
    /// As [`EarliestDeadline`](Self::EarliestDeadline), but a call is also refused as [`Busy`](crate::error::Error::Busy), on
    /// arrival or in its turn, if its function has lately taken longer on average than the call has left. Under overload more
    /// deadlines are met. One call a second begins all the same, so that a function that was slow is tried again. Averages are
    /// kept for the eight functions that ran last. On boards with the feature `admission`.
    Admission,
}

impl Scheduling {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::EarliestDeadline, Self::Fifo, Self::Admission];

    /// The word in texts and files: `deadline`, `fifo` or `admission`.
    pub const fn word(self) -> &'static str {
        match self {
            Self::EarliestDeadline => "deadline",
            Self::Fifo => "fifo",
            Self::Admission => "admission",
        }
    }
}

/// Whether units authenticate each other and encrypt frames. Units of different modes never connect.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Mode {
    /// Nothing is encrypted, and every claimed identity is accepted.
    Plain,
    /// A peer is accepted only if it proves the pair's key; frames are encrypted and authenticated.
    Secured,
}

impl Mode {
    /// The word in texts and files: `plain` or `secured`.
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

    /// The mode with this magic.
    pub const fn of_magic(magic: [u8; 4]) -> Option<Self> {
        match magic {
            PLAIN_MAGIC => Some(Self::Plain),
            SECURED_MAGIC => Some(Self::Secured),
            _ => None,
        }
    }

    /// The cipher suites that every unit in this mode has, a bit each: bit 0 is `Noise_NNpsk0_25519_ChaChaPoly_BLAKE2s`.
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

/// Priority class of a request. An emergency is sent between the chunks of other messages, ignores the minimum interval and has
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
