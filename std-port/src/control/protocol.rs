//! Messages of the control socket: one JSON object a line. Each [`Question`] is answered by any number of [`Answer`]s,
//! of which the last one is [`Answer::Done`] or [`Answer::Failed`]. A line that is no question is answered with
//! `Failed`, and the next line is read. An empty line is a [`BEAT`] and not answered.

use cara_core::config::SHORT_SEGMENT;
use cara_core::distribution::function::Attributes;
use cara_secure::suite::Suite;
use std::collections::BTreeMap;
use std::time::{SystemTime, UNIX_EPOCH};

use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize};

pub use super::clock::ClockInfo;
use super::role::Role;

/// In the manager's first line, so that an older command recognises a newer manager.
pub const CONTROL_VERSION: u32 = 2;

/// How often a client sends an empty line, its heartbeat, while a [`Question::Hold`] is answered. A stopped process sends none, so that its lease ends.
pub const BEAT: std::time::Duration = std::time::Duration::from_millis(50);

/// Longest line in bytes, in either direction: a call with 256 KiB of parameters, written as text.
pub const LONGEST_LINE: usize = 4 * 1024 * 1024;

/// What an operator asks of a running unit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "ask", rename_all = "snake_case", deny_unknown_fields)]
pub enum Question {
    /// Act for somebody from here on: as if this connection had the role, which must not exceed its own, and under this name in
    /// the audit log. For the unit's own user and root, such as the server of a page whose users have roles of their own.
    As {
        /// Who that is, in 1 to 64 bytes.
        name: String,
        /// What they may do.
        role: Role,
    },
    /// Asks for the unit's identity and state. Answered by [`Answer::Unit`].
    Unit,
    /// Asks for the known nodes and the refused ones. An [`Answer::Node`] for each, an [`Answer::Refused`] for each
    /// refusal.
    Nodes {
        /// Only nodes that offer this function.
        offering: Option<String>,
    },
    /// Search now.
    Search,
    /// Take a node that is not connected off the roster, until it joins again or the unit is started again.
    Retire {
        /// `NAME`, `NAME/ID` or `#ID`.
        node: String,
    },
    /// Hand a vehicle over to another manager, while nothing of it moves. An [`Answer::Called`] when it has agreed and leaves, or
    /// why not. Unless it joins the other manager within [`HAND_OVER_TIMEOUT`](cara_core::config::HAND_OVER_TIMEOUT) it comes back.
    HandOver {
        /// `NAME`, `NAME/ID` or `#ID`.
        node: String,
        /// The other manager's `NAME/ID`.
        to: String,
        /// How long to wait for the vehicle's answer.
        timeout_ms: u64,
    },
    /// An [`Answer::Function`] for each function that a node has published to this unit.
    Functions {
        /// `NAME`, `NAME/ID` or `#ID`.
        node: String,
    },
    /// An [`Answer::Order`] for each leased function of a node, of all connected ones if absent.
    Orders {
        /// `NAME`, `NAME/ID` or `#ID`.
        node: Option<String>,
    },
    /// Call a function. An [`Answer::Called`] for each node; of all, also for each s_unit of the roster that was not called. No lease is renewed: what the call starts goes on for the
    /// length of its lease.
    Call(CallQuestion),
    /// Call a function of one node and keep its lease, until what it started has ended there, or the connection is closed:
    /// then it stops; likewise after the length of the lease without a [`BEAT`] of the client. An [`Answer::Called`], then
    /// an [`Answer::Ended`].
    Hold(CallQuestion),
    /// Call each function with the attribute `stop`, all of them at the same time and in the class emergency. An
    /// [`Answer::Called`] for each node, when its last one has answered: `NoStop` is the error of a node without one,
    /// `NotConnected` that of one that is absent.
    Stop {
        /// `NAME`, `NAME/ID` or `#ID`; each s_unit of the roster, and each m_unit that has such a function, if absent.
        node: Option<String>,
    },
    /// As [`Stop`](Self::Stop), for the attribute `reset`; the error of a node without one is `NoReset`.
    Reset {
        /// As there.
        node: Option<String>,
    },
    /// Publish this unit's functions. An [`Answer::Unread`] for each node that has not read the list in time.
    Publish {
        /// To this node alone; to all, also later ones, if absent.
        node: Option<String>,
        /// How long to wait for acknowledgements.
        timeout_ms: u64,
    },
    /// Change a constraint of the unit, or of its traffic with one node. Answered by [`Answer::Constraints`].
    Set {
        /// Towards this node alone: the unit's side of that link.
        node: Option<String>,
        /// Its name in [`Constraints`](crate::Constraints); with `_us` behind it as well.
        constraint: String,
        /// In the constraint's unit: a number, nodes, bytes or microseconds.
        value: u64,
    },
    /// An [`Answer::Event`] for each event, until the connection is closed. The first is `watching`, behind which nothing
    /// is missed; `lost` tells how many came faster than they were read.
    Watch,
    /// As [`Watch`](Self::Watch), and an [`Answer::Command`] for each outcome of what operators ask that changes something, and of
    /// what the unit's program calls.
    Commands,
    /// Values of a stream of a node as they come, until the connection is closed: an [`Answer::Value`] for each. Without a name
    /// the last value of each of its streams, or that there is none.
    Stream {
        /// `NAME`, `NAME/ID` or `#ID`; `.` for the unit's own log, the stream `log`.
        node: String,
        /// The stream.
        name: Option<String>,
        /// Least time between two values; 0 for each that the node grants, also where they are read late.
        interval_ms: u64,
    },
    /// Values of all streams of all nodes as they come, also of nodes that join later, and of the unit's own log, until the
    /// connection is closed: an [`Answer::Value`] for each. Streams that the operator may not call are left out.
    Streams {
        /// Least time between two values of a stream; 0 for each that the node grants, also where they are read late. Of the stream
        /// `log` each comes in any case.
        interval_ms: u64,
        /// Streams of these names alone; of all names if empty.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        names: Vec<String>,
    },
    /// Counters of the unit, or of the link to one node. Answered by an [`Answer::Counters`] for each.
    Counters {
        /// The unit and all connected nodes if absent.
        node: Option<String>,
    },
    /// All counters in Prometheus' text form, of units that are built with it. In pieces, each an [`Answer::Metrics`].
    Metrics,
    /// Measures round trips of the protocol's own ping, with no function involved. An [`Answer::Sample`] for each.
    Ping {
        /// `NAME`, `NAME/ID` or `#ID`.
        node: String,
        /// How many.
        count: u32,
        /// Between two of them.
        pause_us: u64,
        /// How long to wait for each.
        timeout_ms: u64,
    },
}

impl Question {
    /// Whether what it keeps moving needs a [`BEAT`] of the client.
    pub(super) fn needs_beats(&self) -> bool {
        matches!(self, Self::Hold(_))
    }

    /// Whether the thread that answers it watches or stops something, so that it waits for no client that reads slowly.
    pub(super) fn waits_for_no_reader(&self) -> bool {
        matches!(self, Self::Hold(_) | Self::Stop { .. } | Self::Reset { .. })
    }

    /// Whether it is carried out only while its client is there: what moves something, or may let it move again, is not wanted
    /// any more by a client that has gone before its turn came, as where the unit's process was stopped meanwhile.
    pub(super) fn needs_its_client(&self) -> bool {
        matches!(self, Self::Call(_) | Self::Hold(_) | Self::Reset { .. } | Self::HandOver { .. })
    }

    /// Whether it is answered also where all connections are in use.
    pub(super) fn is_of_a_stop(&self) -> bool {
        matches!(self, Self::As { .. } | Self::Stop { .. } | Self::Unit | Self::Nodes { .. })
    }
}

/// A call as an operator makes it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CallQuestion {
    /// `NAME`, `NAME/ID` or `#ID`; every node that offers the function if absent.
    pub node: Option<String>,
    /// The function's name.
    pub function: String,
    /// Its arguments, by name.
    pub arguments: Vec<Argument>,
    /// Return when the request is accepted.
    pub asynchronous: bool,
    /// The unit's constraint if absent.
    pub timeout_ms: Option<u64>,
    /// The function's own if absent: `emergency`, `high`, `normal` or `low`.
    pub priority: Option<String>,
    /// In one datagram, now or never; asynchronous calls only.
    pub best_effort: bool,
    /// Take over what another unit, or the program of this one, moves.
    #[serde(default)]
    pub take_over: bool,
    /// Tell what it tells while it runs, as [`Answer::Progress`]; calls of one node only.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub progress: bool,
}

/// A variable with its value.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Argument {
    /// The variable's name.
    pub name: String,
    /// The variable's size: elements, or the most bytes of a string or of bytes.
    pub size: u32,
    /// Its value.
    #[serde(flatten)]
    pub value: ArgumentValue,
}

/// The value of a variable.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type", content = "value", rename_all = "snake_case")]
pub enum ArgumentValue {
    /// Whole numbers.
    Int(Vec<i64>),
    /// Numbers with a fraction, as text where JSON has no number for them (`NaN`, `inf`, `-inf`).
    Float(Vec<Number>),
    /// Text.
    String(String),
    /// Truth values.
    Bool(Vec<bool>),
    /// Bytes in hexadecimal, two digits each.
    Bytes(String),
    /// A list, as [`json`](super::json) has it.
    List(serde_json::Value),
    /// A record, likewise.
    Record(serde_json::Value),
}

/// A number with a fraction.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Number {
    /// A finite one.
    Finite(f64),
    /// `NaN`, `inf` or `-inf`.
    Other(String),
}

/// Through serde_json's own types: where any crate of a program asks serde_json for numbers of arbitrary precision, a
/// number inside a tagged structure reads as no `f64`.
impl<'de> Deserialize<'de> for Number {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        match serde_json::Value::deserialize(from)? {
            serde_json::Value::Number(number) => number.as_f64().map(Self::Finite),
            serde_json::Value::String(text) => Some(Self::Other(text)),
            _ => None,
        }
        .ok_or_else(|| D::Error::custom("a number is a JSON number, or `NaN`, `inf` or `-inf` as text"))
    }
}

fn real<'de, D: Deserializer<'de>>(from: D) -> Result<Option<f64>, D::Error> {
    Ok(Option::<serde_json::Number>::deserialize(from)?.and_then(|number| number.as_f64()))
}

/// What the unit answers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "answer", rename_all = "snake_case")]
pub enum Answer {
    /// Sent once, before any question.
    Hello {
        /// [`CONTROL_VERSION`] of the unit.
        control_version: u32,
        /// The unit's `name/id`.
        unit: String,
        /// Its fleet.
        fleet: u32,
        /// All connections are in use: on this one nothing but [`Question::Stop`] is answered, and
        /// what helps to ask it: [`Question::Unit`] and [`Question::Nodes`].
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        full: bool,
    },
    /// This unit.
    Unit(UnitInfo),
    /// A node that has joined, connected or not, or that is on the roster.
    Node(NodeInfo),
    /// A node that was refused, here or there.
    Refused(RefusedInfo),
    /// A function of a node.
    Function(FunctionInfo),
    /// The state of what a function of a node moves.
    Order(OrderInfo),
    /// How a call ended.
    Called {
        /// The node's name.
        node: String,
        /// The node's id.
        id: u32,
        /// The results of a blocking call.
        results: Vec<Argument>,
        /// The id under which a failure of an asynchronous call would be told.
        call: Option<u32>,
        /// Why it failed.
        error: Option<Failure>,
        /// From asking to the end, in microseconds.
        took_us: u64,
        /// Of a stop or a reset: the functions that this is the end of.
        #[serde(default, skip_serializing_if = "Vec::is_empty")]
        functions: Vec<String>,
    },
    /// What a call tells while it runs.
    Progress {
        /// The node's name.
        node: String,
        /// The node's id.
        id: u32,
        /// The values.
        values: Vec<Argument>,
    },
    /// What a call started has ended.
    Ended {
        /// Its lease ended there without being renewed, it was stopped, or the node was lost, as opposed to: it has finished.
        expired: bool,
    },
    /// A node that has not read the published list in time.
    Unread {
        /// The node's name.
        node: String,
        /// The node's id.
        id: u32,
    },
    /// Constraints in force.
    Constraints(ConstraintsInfo),
    /// Something happened.
    Event {
        /// Milliseconds since the unit's start.
        at_ms: u64,
        /// Milliseconds since 1970, when this was reported. A unit that does not report it runs on the reader's host.
        #[serde(default = "unix_ms")]
        unix_ms: u64,
        /// Its name, as `joined` or `request_failed`.
        event: String,
        /// The node that it is about.
        node: Option<String>,
        /// The rest, in words.
        text: String,
    },
    /// An outcome of a command.
    Command {
        /// Milliseconds since 1970, at the outcome.
        unix_ms: u64,
        /// Who asked.
        by: By,
        /// What was asked. A call of the unit's program has the form of an operator's.
        question: Box<Question>,
        /// An answer to it; none if the client had gone, or the program had given the call up.
        outcome: Option<Box<Answer>>,
    },
    /// A value of a stream.
    Value {
        /// The node's `name/id`.
        node: String,
        /// The stream's signature.
        stream: String,
        /// Milliseconds since 1970, when this was told.
        unix_ms: u64,
        /// How old it was then, never too low; absent where there is no value.
        age_us: Option<u64>,
        /// The values.
        values: Vec<Argument>,
        /// Why there is none.
        error: Option<Failure>,
    },
    /// Counters by name, zeros included.
    Counters {
        /// The node at the other end of the link; the unit's own if absent.
        node: Option<String>,
        /// Name and count.
        counters: Vec<(String, u64)>,
    },
    /// The next lines of the counters in Prometheus' text form.
    Metrics {
        /// Whole lines.
        text: String,
    },
    /// A round trip.
    Sample {
        /// Microseconds; absent if it failed.
        #[serde(default, deserialize_with = "real")]
        us: Option<f64>,
        /// Why it failed.
        error: Option<Failure>,
    },
    /// The question has been answered.
    Done,
    /// The question could not be answered.
    Failed(Failure),
}

/// Who asks for a command.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct By {
    /// `operator`, through the control socket, or `program`, which has nothing of the rest.
    pub origin: String,
    /// The user.
    pub uid: Option<u32>,
    /// The process, and its program.
    pub pid: Option<i32>,
    /// Another program may take its name.
    pub program: Option<String>,
    /// The user's name, or for whom that process acts.
    pub name: Option<String>,
    /// What they may do.
    pub role: Option<Role>,
}

/// The unit's own program.
impl Default for By {
    fn default() -> Self {
        Self { origin: "program".to_owned(), uid: None, pid: None, program: None, name: None, role: None }
    }
}

/// An error as text, and where its remedy lies.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// `configuration`, `peer`, `resource` or `transport`.
    pub cause: String,
    /// The error's name, as `TimedOut`.
    pub error: String,
    /// What kind of it, as `Failed` or `Panicked` of `Service`, `NoKey` of `Refused`.
    #[serde(default)]
    pub kind: Option<String>,
    /// The code with which a service failed.
    #[serde(default)]
    pub code: Option<u16>,
    /// What the service has said of it, beside its code.
    #[serde(flatten)]
    pub said: Option<Box<Said>>,
    /// What happened and what to do.
    pub text: String,
}

/// What a service has said of its failure.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Said {
    /// Why, in words; empty where it gave values alone.
    pub reason: String,
    /// The values that its signature declares.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub values: Vec<Argument>,
}

/// A unit that is asked.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct UnitInfo {
    /// Its name.
    pub name: String,
    /// Its ID number.
    pub id: u32,
    /// `m_unit` or `s_unit`.
    pub role: String,
    /// Its fleet.
    pub fleet: u32,
    /// `plain` or `secured`; absent where the unit is older than this.
    #[serde(default)]
    pub mode: Option<String>,
    /// The keys of a secured unit.
    #[serde(default)]
    pub keys: Option<KeysInfo>,
    /// Protocol version.
    pub version: u8,
    /// The release of `cara-std` that it is built with; absent where it is older than this.
    #[serde(default)]
    pub release: Option<String>,
    /// The UDP port of broadcasts.
    pub discovery_port: u16,
    /// Where it takes connections; 0 for nowhere.
    pub tcp_port: u16,
    /// Which of its runs this is, in hexadecimal.
    pub epoch: String,
    /// Since its start.
    pub uptime_ms: u64,
    /// The interfaces that it uses, with those that are down.
    pub interfaces: Vec<InterfaceInfo>,
    /// Constraints in force.
    pub constraints: ConstraintsInfo,
    /// Connected nodes.
    pub connected: usize,
    /// Whether it leads; none without an authority.
    #[serde(default)]
    pub leading: Option<bool>,
}

/// What may be told of a unit's keys.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeysInfo {
    /// Their file, which the unit follows; none where they were made in its process.
    pub file: Option<String>,
    /// The generations that it takes, the one that it speaks with first.
    pub generations: Vec<u32>,
}

/// An address of an interface.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InterfaceInfo {
    /// The system's name of it.
    pub name: String,
    /// The unit's address there.
    pub address: String,
    /// Where broadcasts go; none on a point-to-point link.
    pub broadcast: Option<String>,
    /// Whether it is up and has a carrier.
    pub up: bool,
    /// Why the system did not take the last broadcast of the unit there.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refused: Option<String>,
}

/// Constraints (paper, section 2). Times in microseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ConstraintsInfo {
    /// Time-out of a request.
    pub request_timeout_us: u64,
    /// Least time between two requests to one node.
    pub minimum_interval_us: u64,
    /// Most connected nodes.
    pub maximum_nodes: u16,
    /// Longest message in bytes.
    pub message_size: u32,
    /// Longest frame in bytes.
    pub chunk_size: u16,
    /// Between two signs of life.
    pub keep_alive_us: u64,
    /// Calls that one peer may have waiting or running here.
    pub calls_per_peer: u16,
    /// Which of them begins next.
    #[serde(default)]
    pub scheduling: SchedulingInfo,
}

/// Which of the calls that wait begins next; set by its number, in this order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SchedulingInfo {
    /// The one with the earliest deadline.
    #[default]
    Deadline,
    /// The one that came first.
    Fifo,
    /// The one with the earliest deadline, and those that cannot make theirs are refused.
    Admission,
}

/// A node as the unit sees it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodeInfo {
    /// Its name.
    pub name: String,
    /// Its ID number.
    pub id: u32,
    /// `m_unit` or `s_unit`.
    pub role: String,
    /// Whether it is connected now.
    pub connected: bool,
    /// Whether it is on the roster: an s_unit that this unit is to have, and that was not retired.
    #[serde(default)]
    pub expected: bool,
    /// The other end of its link while it is connected.
    pub address: Option<String>,
    /// Protocol version that it speaks, while it is connected.
    pub version: Option<u8>,
    /// Which of its runs is connected, in hexadecimal.
    pub epoch: Option<String>,
    /// For how long it has been connected without a break.
    pub connected_ms: Option<u64>,
    /// How long ago it left, while it is not connected.
    #[serde(default)]
    pub left_ms: Option<u64>,
    /// Why it left, as `Silent`.
    #[serde(default)]
    pub left_reason: Option<String>,
    /// Likewise in words.
    #[serde(default)]
    pub left_text: Option<String>,
    /// How long ago it was heard searching for this unit, while it is not connected and if that was after it left. Why it was not
    /// taken stands in [`Answer::Refused`], where it is known.
    #[serde(default)]
    pub searched_ms: Option<u64>,
    /// From where.
    #[serde(default)]
    pub searched_from: Option<String>,
    /// What it takes, while it is connected.
    pub limits: Option<LimitsInfo>,
    /// Its link, while it is connected; absent where the unit is older than this.
    #[serde(default)]
    pub link: Option<LinkInfo>,
    /// How far its clock is from the unit's, while it is connected and if it tells that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clock: Option<ClockInfo>,
    /// Functions that it has published to this unit.
    pub functions: usize,
}

/// What a node takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LimitsInfo {
    /// Longest message in bytes.
    pub message_size: u32,
    /// Longest frame in bytes.
    pub chunk_size: u16,
    /// Calls that this unit may have waiting or running there.
    pub calls: u16,
    /// Least time between two requests to it.
    pub minimum_interval_us: u64,
}

/// How the link to a node is at this moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LinkInfo {
    /// How long ago the node was last heard.
    pub silent_ms: u64,
    /// Calls of the unit that wait for its reply.
    pub calls: usize,
    /// Calls of the node that run or wait at the unit.
    pub calls_here: u16,
    /// Bytes for it that the network has not taken yet.
    pub queued_bytes: usize,
    /// How long ago something of it came in the stream.
    #[serde(default)]
    pub stream_ms: u64,
    /// Where datagrams pass; absent while that is not known.
    #[serde(default)]
    pub datagrams: Option<DatagramsInfo>,
    /// Longest segment that the unit sends in the stream, in bytes.
    #[serde(default)]
    pub segment: Option<u32>,
    /// What seals it; absent in plain mode.
    #[serde(default)]
    pub cipher: Option<CipherInfo>,
}

impl LinkInfo {
    /// What is wrong with the ways between the two, as far as it is known.
    pub fn trouble(&self) -> Option<String> {
        let datagrams = match self.datagrams {
            None | Some(DatagramsInfo::Pass) => None,
            Some(DatagramsInfo::ToUnit) => Some("datagrams to it do not pass".to_owned()),
            Some(DatagramsInfo::ToNode) => Some("datagrams from it do not pass".to_owned()),
            Some(DatagramsInfo::None) => Some("no datagrams pass".to_owned()),
        };
        let stream =
            (self.stream_ms > QUIET_STREAM_MS).then(|| format!("stream silent for {} s", self.stream_ms / 1000));
        let segments = self.segment.filter(|segment| *segment <= u32::from(SHORT_SEGMENT));
        let segments = segments.map(|segment| format!("segments of {segment} bytes"));
        let all: Vec<String> = [datagrams, stream, segments].into_iter().flatten().collect();
        (!all.is_empty()).then(|| all.join(", "))
    }
}

/// A stream in order brings something more often: a unit looks every 4 s whether it has written, and probes if not, so that up to
/// 8 s are without a byte.
pub const QUIET_STREAM_MS: u64 = 9_000;

/// In which directions a link's datagrams pass, as either end has told.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DatagramsInfo {
    /// In both.
    Pass,
    /// To the unit; the node tells that none come there.
    ToUnit,
    /// To the node, as it tells; none come here.
    ToNode,
    /// In neither.
    None,
}

/// What seals a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum CipherInfo {
    /// ChaCha20-Poly1305.
    #[serde(rename = "ChaCha20-Poly1305")]
    ChaChaPoly,
    /// AES-256-GCM.
    #[serde(rename = "AES-256-GCM")]
    AesGcm,
}

impl CipherInfo {
    pub(crate) const fn of(suite: Suite) -> Self {
        match suite {
            Suite::ChaChaPoly => Self::ChaChaPoly,
            #[cfg(feature = "ring")]
            Suite::AesGcm => Self::AesGcm,
        }
    }

    /// Its name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::ChaChaPoly => "ChaCha20-Poly1305",
            Self::AesGcm => "AES-256-GCM",
        }
    }
}

/// Milliseconds since 1970 now.
pub(super) fn unix_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis() as u64
}

/// A refusal.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusedInfo {
    /// The other end.
    pub address: String,
    /// `NAME/ID`, if it said so.
    pub node: Option<String>,
    /// The reason's name, as `WrongManager`.
    pub reason: String,
    /// What to do.
    pub text: String,
    /// Since then.
    pub ago_ms: u64,
}

/// A function that a node offers.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FunctionInfo {
    /// Its name.
    pub name: String,
    /// Its text form, as `go_to(position: int[2]) -> (position: int[2])`.
    pub signature: String,
    /// How it wants to be called: `priority`, `lease_us` (or null), `actuator`, a key for each of [`Attributes::FLAGS`], and
    /// `stream_ms` of a stream.
    #[serde(flatten, with = "super::attributes")]
    pub attributes: Attributes,
    /// What it does, in a line; absent where the node says nothing.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub help: String,
    /// Units of variables, by their names; absent where there are none.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub units: BTreeMap<String, String>,
}

/// The state of what a function of a node moves, as the node told.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct OrderInfo {
    /// The node's name.
    pub node: String,
    /// The node's id.
    pub id: u32,
    /// The function's name.
    pub function: String,
    /// Of the order that has it, or had it last: `none` since the node's start, `runs`, or how it ended: `finished`,
    /// `expired`, `replaced`, `stopped`, `released`.
    pub order: String,
    /// The ID number of its caller.
    pub holder: Option<u32>,
    /// The trace id of its call in 16 hexadecimal digits, where its caller has the id number of the unit that is asked.
    #[serde(default)]
    pub trace: Option<String>,
    /// Under which claim, likewise: term and claimant.
    #[serde(default)]
    pub claim: Option<(u64, u64)>,
    /// How long it goes on if no more renewal of the unit that is asked gets there, counted from the node's last answer: too long by
    /// as much as that was held up.
    pub left_ms: Option<u64>,
    /// What keeps every order from beginning.
    pub inhibited: Option<InhibitedInfo>,
    /// How long ago the node's stream brought something: what is told here is as old, or a little older.
    #[serde(default)]
    pub age_ms: Option<u64>,
}

/// What inhibits a function.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct InhibitedInfo {
    /// The ID number of the unit that stopped it; 0 for the node itself.
    pub by: u32,
    /// Why, as the node numbers its reasons; 0 for a function that stops.
    pub reason: u16,
}
