//! Messages of a session: requests and replies, whose headers precede a block of parameters, and control messages of
//! [items](super::items). Headers contain their length, so that later versions can extend them. This module,
//! [`hello`](super::hello), [`datagram`](super::datagram) and [`block`](super::block) are the only code with knowledge of the
//! encoding, which `docs/wire.md` specifies.

pub use super::control::{ActuatorState, Control, HandOverRefusal, LastOrder, Latch, LeaseEnd, OrderOutcome};
pub use super::control::{SubscriptionRefusal, trace_id};
pub use super::table::NO_SUBSCRIPTION;

use super::block::Put;
use super::control::CONTROL;
use super::function_list::{Generation, Slot};
use crate::ability::{DETAILS, STREAMS};
use crate::config::Priority;
use crate::error::{Error, ServiceError};
use crate::host::connections::Report;
use crate::host::frame::ChunkWriter;
use crate::time::Duration;

const REQUEST: u8 = 1;
const REPLY: u8 = 2;
const FAILURE: u8 = 4;
const PROGRESS: u8 = 5;
const SAMPLE: u8 = 6;

const WANTS_REPLY: u8 = 1;
/// The caller asks for progress; a callee may ignore this.
const WANTS_PROGRESS: u8 = 0x02;
/// An operator made the request, not the unit's program.
const OPERATOR: u8 = 0x04;
/// The call takes over an actuator that another caller holds.
const TAKES_OVER: u8 = 0x10;
/// Flags that this version does not know, and without which a callee must not run the request.
const UNKNOWN: u8 = 0xE0;
/// Length of a request's header.
pub const REQUEST_BYTES: usize = 32;
/// Length of a reply's header.
pub const REPLY_BYTES: usize = 16;
/// Capacity of a receiver for a header before the longest block: those of later versions may be longer.
pub const LONGEST_HEADER_BYTES: usize = 64;
/// Length of a control message's header.
const CONTROL_HEADER_BYTES: usize = 4;
/// The unit of a header's length.
const WORD: usize = 4;
const REQUEST_WORDS: u8 = (REQUEST_BYTES / WORD) as u8;
const REPLY_WORDS: u8 = (REPLY_BYTES / WORD) as u8;
/// Length of the longest control message other than `Publish`.
pub const CONTROL_BYTES: usize = 48;
/// Length of a `Publish` without its signature.
pub const PUBLISH_BYTES: usize = 32;

/// A message, borrowed from the received bytes.
#[derive(Debug)]
pub enum Message<'b> {
    /// Run a function.
    Request(RequestHeader, &'b [u8]),
    /// The outcome of a request: results or an error.
    Reply(u32, Result<&'b [u8], Error>),
    /// A request without a reply was not run, or its service failed.
    Failure(u32, Error),
    /// Progress of a running call.
    Progress(u32, &'b [u8]),
    /// [Items](super::items), each a [`Control`]: lists, limits, leases.
    Control(&'b [u8]),
    /// The newest value of a stream.
    Sample(SampleHeader, &'b [u8]),
}

impl<'b> Message<'b> {
    /// Decodes a message; `None` if it is not of this format.
    #[inline]
    pub fn decode(bytes: &'b [u8]) -> Option<Self> {
        match *bytes.first()? {
            REQUEST => {
                let header = RequestHeader::decode(bytes.first_chunk()?);
                Some(Self::Request(header, behind_header(bytes, bytes.get(6)?, REQUEST_BYTES)?))
            }
            REPLY => {
                let (id, status) = decode_reply(bytes.first_chunk()?);
                let block = behind_header(bytes, bytes.get(3)?, REPLY_BYTES)?;
                Some(Self::Reply(id, status.map(|()| block)))
            }
            FAILURE => {
                let (id, status) = decode_reply(bytes.first_chunk()?);
                Some(Self::Failure(id, status.err()?))
            }
            PROGRESS if DETAILS => {
                let &[_, _, _, words, a, b, c, d] = bytes.first_chunk::<PROGRESS_BYTES>()?;
                let block = behind_header(bytes, &words, PROGRESS_BYTES)?;
                Some(Self::Progress(u32::from_le_bytes([a, b, c, d]), block))
            }
            CONTROL => Some(Self::Control(bytes.get(CONTROL_HEADER_BYTES..)?)),
            SAMPLE if STREAMS => {
                let header = SampleHeader::decode(bytes.first_chunk()?);
                Some(Self::Sample(header, behind_header(bytes, bytes.get(6)?, SAMPLE_BYTES)?))
            }
            _ => None,
        }
    }
}

/// The bytes after a header that gives its own length in words: at least `least` bytes, more in later versions.
#[inline]
fn behind_header<'b>(bytes: &'b [u8], words: &u8, least: usize) -> Option<&'b [u8]> {
    let length = usize::from(*words).saturating_mul(WORD);
    if length < least { None } else { bytes.get(length..) }
}

impl Put for ChunkWriter<'_> {
    #[inline]
    fn put(&mut self, bytes: &[u8]) {
        ChunkWriter::put(self, bytes);
    }
}

/// The header of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RequestHeader {
    /// Increases within a session; the reply repeats it.
    pub id: u32,
    /// The callee's function.
    pub slot: Slot,
    /// The generation of the slot that the caller knows.
    pub generation: Generation,
    /// The caller waits for a reply.
    pub wants_reply: bool,
    /// The caller asks for progress.
    pub wants_progress: bool,
    /// The call takes over an actuator that another caller holds.
    pub takes_over: bool,
    /// An operator made the request, not the unit's program.
    pub operator: bool,
    /// Unknown flags, without which the request must not be run.
    pub unknown: u8,
    /// Time from the request to the caller's deadline, saturating.
    pub remaining: Duration,
    /// The callee's clock in microseconds, as the caller last received it.
    pub stamp: u64,
    /// Time since it was received, saturating.
    pub since: Duration,
    /// The call's number among those that its caller has made on this link: later calls have higher ones.
    pub number: u32,
}

impl RequestHeader {
    /// The encoded header.
    #[inline]
    pub fn encode(&self) -> [u8; REQUEST_BYTES] {
        let flags = if self.wants_reply { WANTS_REPLY } else { 0 }
            | if self.wants_progress { WANTS_PROGRESS } else { 0 }
            | if self.takes_over { TAKES_OVER } else { 0 }
            | if self.operator { OPERATOR } else { 0 }
            | self.unknown;
        let [s0, s1] = self.slot.0.to_le_bytes();
        let [g0, g1] = self.generation.0.to_le_bytes();
        let [i0, i1, i2, i3] = self.id.to_le_bytes();
        let [r0, r1, r2, r3] = self.remaining.as_wire().to_le_bytes();
        let [t0, t1, t2, t3, t4, t5, t6, t7] = self.stamp.to_le_bytes();
        let [e0, e1, e2, e3] = self.since.as_wire().to_le_bytes();
        let [n0, n1, n2, n3] = self.number.to_le_bytes();
        [
            REQUEST,
            flags,
            s0,
            s1,
            g0,
            g1,
            REQUEST_WORDS,
            0,
            i0,
            i1,
            i2,
            i3,
            r0,
            r1,
            r2,
            r3,
            t0,
            t1,
            t2,
            t3,
            t4,
            t5,
            t6,
            t7,
            e0,
            e1,
            e2,
            e3,
            n0,
            n1,
            n2,
            n3,
        ]
    }

    #[inline]
    fn decode(bytes: &[u8; REQUEST_BYTES]) -> Self {
        let [_, flags, s0, s1, g0, g1, _, _, i0, i1, i2, i3, r0, r1, r2, r3, rest @ ..] = bytes;
        let [t0, t1, t2, t3, t4, t5, t6, t7, e0, e1, e2, e3, n0, n1, n2, n3] = rest;
        Self {
            id: u32::from_le_bytes([*i0, *i1, *i2, *i3]),
            slot: Slot(u16::from_le_bytes([*s0, *s1])),
            generation: Generation(u16::from_le_bytes([*g0, *g1])),
            wants_reply: flags & WANTS_REPLY != 0,
            wants_progress: flags & WANTS_PROGRESS != 0,
            takes_over: flags & TAKES_OVER != 0,
            operator: flags & OPERATOR != 0,
            unknown: flags & UNKNOWN,
            remaining: micros([*r0, *r1, *r2, *r3]),
            stamp: u64::from_le_bytes([*t0, *t1, *t2, *t3, *t4, *t5, *t6, *t7]),
            since: micros([*e0, *e1, *e2, *e3]),
            number: u32::from_le_bytes([*n0, *n1, *n2, *n3]),
        }
    }
}

/// The header of a stream's value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleHeader {
    /// The sender's stream.
    pub slot: Slot,
    /// The generation of the slot.
    pub generation: Generation,
    /// The earliest time at which the value can have been made, in microseconds of the subscriber's clock; may be negative.
    pub made: i64,
}

/// Length of a sample's header.
pub const SAMPLE_BYTES: usize = 16;

impl SampleHeader {
    /// The encoded header.
    pub fn encode(&self) -> [u8; SAMPLE_BYTES] {
        let ([s0, s1], [g0, g1]) = (self.slot.0.to_le_bytes(), self.generation.0.to_le_bytes());
        let [a, b, c, d, e, f, g, h] = self.made.to_le_bytes();
        [SAMPLE, 0, s0, s1, g0, g1, (SAMPLE_BYTES / WORD) as u8, 0, a, b, c, d, e, f, g, h]
    }

    fn decode(bytes: &[u8; SAMPLE_BYTES]) -> Self {
        let &[_, _, s0, s1, g0, g1, _, _, a, b, c, d, e, f, g, h] = bytes;
        Self {
            slot: Slot(u16::from_le_bytes([s0, s1])),
            generation: Generation(u16::from_le_bytes([g0, g1])),
            made: i64::from_le_bytes([a, b, c, d, e, f, g, h]),
        }
    }
}

/// Length of a progress header.
pub const PROGRESS_BYTES: usize = 8;

/// The header of progress of call `id`.
pub fn encode_progress(id: u32) -> [u8; PROGRESS_BYTES] {
    let [a, b, c, d] = id.to_le_bytes();
    [PROGRESS, 0, 0, (PROGRESS_BYTES / WORD) as u8, a, b, c, d]
}

/// What follows the header of a reply or failure message after a service failed: a text, and a block of values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FailureDetails<'b> {
    /// The reason in words.
    pub text: &'b str,
    /// The block of values, if the signature declares them.
    pub values: &'b [u8],
}

impl<'b> FailureDetails<'b> {
    /// Decodes the details; `None` if the message has none.
    pub fn of(message: &'b [u8]) -> Option<Self> {
        let &[REPLY | FAILURE, SERVICE_FAILED, _, words, ..] = message.first_chunk::<REPLY_BYTES>()? else {
            return None;
        };
        let (&head, rest) = behind_header(message, &words, REPLY_BYTES)?.split_first_chunk()?;
        let length = usize::try_from(u64::from_le_bytes(head)).ok()?;
        let (text, rest) = rest.split_at_checked(length)?;
        let values = rest.get(length.wrapping_neg() & 7..)?;
        Some(Self { text: core::str::from_utf8(text).ok()?, values })
    }

    /// Length of a text with its length field and padding.
    pub(crate) const fn text_bytes(text: &str) -> usize {
        text.len().next_multiple_of(8).saturating_add(8)
    }

    /// Encodes a text, in [`text_bytes`](Self::text_bytes).
    pub(crate) fn put_text(text: &str, to: &mut impl Put) {
        to.put(&(text.len() as u64).to_le_bytes());
        to.put(text.as_bytes());
        to.put([0; 8].get(..text.len().wrapping_neg() & 7).unwrap_or_default());
    }
}

fn micros(bytes: [u8; 4]) -> Duration {
    Duration::from_micros(u64::from(u32::from_le_bytes(bytes)))
}

/// The header of a reply to request `id`.
pub fn encode_reply(id: u32, status: Result<(), Error>) -> [u8; REPLY_BYTES] {
    answer(REPLY, id, status)
}

/// The message with the error of request `id`, which expects no reply.
pub fn encode_failure(id: u32, error: Error) -> [u8; REPLY_BYTES] {
    answer(FAILURE, id, Err(error))
}

fn answer(kind: u8, id: u32, status: Result<(), Error>) -> [u8; REPLY_BYTES] {
    let (code, index, first, second) = match status {
        Ok(()) => (0, 0, 0, 0),
        Err(error) => error_code(error),
    };
    let [i0, i1, i2, i3] = id.to_le_bytes();
    let [a0, a1, a2, a3] = first.to_le_bytes();
    let [b0, b1, b2, b3] = second.to_le_bytes();
    [kind, code, index, REPLY_WORDS, i0, i1, i2, i3, a0, a1, a2, a3, b0, b1, b2, b3]
}

#[inline]
fn decode_reply(bytes: &[u8; REPLY_BYTES]) -> (u32, Result<(), Error>) {
    let &[_, code, index, _, i0, i1, i2, i3, a0, a1, a2, a3, b0, b1, b2, b3] = bytes;
    let id = u32::from_le_bytes([i0, i1, i2, i3]);
    if code == 0 {
        return (id, Ok(()));
    }
    let (first, second) = (u32::from_le_bytes([a0, a1, a2, a3]), u32::from_le_bytes([b0, b1, b2, b3]));
    (id, Err(error_of(code, index, first, second)))
}

/// The wire code of [`ServiceError::Failed`](crate::error::ServiceError::Failed).
const SERVICE_FAILED: u8 = 20;

/// The wire form of a callee's error: code, index, first number, second number.
fn error_code(error: Error) -> (u8, u8, u32, u32) {
    match error {
        Error::UnknownFunction => (1, 0, 0, 0),
        Error::StaleFunction => (2, 0, 0, 0),
        Error::MissingArgument { index } => (3, index, 0, 0),
        Error::WrongType { index } => (4, index, 0, 0),
        Error::WrongSize { index, expected, found } => (5, index, expected, found),
        Error::Expired => (6, 0, 0, 0),
        Error::Stale => (7, 0, 0, 0),
        Error::Busy => (8, 0, 0, 0),
        Error::NotAllowed => (10, 0, 0, 0),
        Error::WouldDeadlock => (11, 0, 0, 0),
        Error::TooLarge { limit } => (12, 0, limit, 0),
        Error::TooSoon { wait } => (13, 0, wait.as_wire(), 0),
        Error::ResultWouldNotFit { need, have } => (14, 0, need, have),
        Error::ResultLost => (15, 0, 0, 0),
        Error::Unsupported => (16, 0, 0, 0),
        Error::Held { by, operator } => (17, 0, by, operator.into()),
        Error::Inhibited { by, reason } => (18, 0, by, reason.into()),
        Error::Replaced => (19, 0, 0, 0),
        Error::Service(ServiceError::Failed(code)) => (SERVICE_FAILED, 0, u32::from(code), 0),
        Error::Service(ServiceError::Panicked) => (21, 0, 0, 0),
        Error::Service(ServiceError::NotReady) => (22, 0, 0, 0),
        Error::Service(ServiceError::BadResults) => (23, 0, 0, 0),
        _ => (9, 0, 0, 0),
    }
}

/// The inverse of [`error_code`]. Codes of later versions become `Malformed`.
fn error_of(code: u8, index: u8, first: u32, second: u32) -> Error {
    match code {
        1 => Error::UnknownFunction,
        2 => Error::StaleFunction,
        3 => Error::MissingArgument { index },
        4 => Error::WrongType { index },
        5 => Error::WrongSize { index, expected: first, found: second },
        6 => Error::Expired,
        7 => Error::Stale,
        8 => Error::Busy,
        10 => Error::NotAllowed,
        11 => Error::WouldDeadlock,
        12 => Error::TooLarge { limit: first },
        13 => Error::TooSoon { wait: Duration::from_micros(u64::from(first)) },
        14 => Error::ResultWouldNotFit { need: first, have: second },
        15 => Error::ResultLost,
        16 => Error::Unsupported,
        17 => Error::Held { by: first, operator: second & 1 != 0 },
        18 => Error::Inhibited { by: first, reason: second as u16 },
        19 => Error::Replaced,
        SERVICE_FAILED => Error::Service(ServiceError::Failed(first as u16)),
        21 => Error::Service(ServiceError::Panicked),
        22 => Error::Service(ServiceError::NotReady),
        23 => Error::Service(ServiceError::BadResults),
        _ => Error::Malformed,
    }
}

/// The content of a session's datagram, or of a session frame in the stream.
#[derive(Debug, PartialEq, Eq)]
pub enum SessionBody<'b> {
    /// The sender is alive.
    KeepAlive {
        /// The sender's clock in microseconds.
        stamp: u64,
        /// What has arrived from the peer.
        report: Report,
    },
    /// Renews the lease of a call. Answered at once, by the same of stream and datagram.
    Renew(Renewal),
    /// Answers `Renew`, with the caller's id of the call.
    Renewed(u32),
    /// The caller releases a call of a function with a lease, whether in flight, queued or running.
    Release(Release),
    /// The caller has given a call up and no longer waits for it.
    Cancel(Release),
    /// The caller releases all its calls of a function with ids up to this one, whether in flight, queued or running.
    ReleaseAll(Slot, u32),
    /// The priority and a whole message: a best-effort request, or the second copy of an emergency.
    Message(u8, &'b [u8]),
    /// Answered at once, by datagram.
    Ping,
    /// Answers `Ping`, and reports what has arrived from the peer.
    Pong(Report),
    /// The sender ends the link because its stream is dead, with a close code. Only by datagram.
    Close(u8),
}

/// A renewal of a call's lease. Its age is bounded like a request's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Renewal {
    /// The caller's id of the call.
    pub call: u32,
    /// The class of the call.
    pub class: Priority,
    /// The callee's clock, as the caller last received it.
    pub stamp: u64,
    /// Time since it was received.
    pub since: Duration,
    /// Age of the evidence that the caller wants the call: the time since its heart's last beat.
    pub age: Duration,
}

/// The caller gives up a call: it ends, leaves the queue, or does not begin if it arrives later.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Release {
    /// The caller's id of the call.
    pub call: u32,
    /// The class of the call.
    pub class: Priority,
}

impl Release {
    fn decode(bytes: &[u8]) -> Option<Self> {
        let (&class, call) = bytes.split_first()?;
        Some(Self { call: u32::from_le_bytes(*call.first_chunk()?), class: Priority::from_wire(class)? })
    }
}

/// Length of the longest session body that is not a message.
pub const SESSION_BODY_BYTES: usize = 22;

const KEEP_ALIVE: u8 = 1;
const RENEW: u8 = 2;
const MESSAGE: u8 = 3;
const PING: u8 = 4;
const PONG: u8 = 5;
const RELEASE: u8 = 6;
const RELEASE_ALL: u8 = 7;
const RENEWED: u8 = 8;
const CANCEL: u8 = 9;
const CLOSE: u8 = 10;

/// Flags of a report.
const HEARS: u8 = 1;
const HOLDS: u8 = 2;
const MISSES: u8 = 4;

impl<'b> SessionBody<'b> {
    /// Decodes a session body; `None` if unknown. All but a message may be longer than this version's.
    pub fn decode(bytes: &'b [u8]) -> Option<Self> {
        let (&kind, rest) = bytes.split_first()?;
        match kind {
            KEEP_ALIVE => {
                let (stamp, rest) = rest.split_first_chunk()?;
                Some(Self::KeepAlive { stamp: u64::from_le_bytes(*stamp), report: report_of(rest)? })
            }
            RENEW => {
                let (&class, rest) = rest.split_first()?;
                let (call, rest) = rest.split_first_chunk()?;
                let (stamp, rest) = rest.split_first_chunk()?;
                let (since, rest) = rest.split_first_chunk()?;
                Some(Self::Renew(Renewal {
                    call: u32::from_le_bytes(*call),
                    class: Priority::from_wire(class)?,
                    stamp: u64::from_le_bytes(*stamp),
                    since: micros(*since),
                    age: micros(*rest.first_chunk()?),
                }))
            }
            RENEWED => Some(Self::Renewed(u32::from_le_bytes(*rest.first_chunk()?))),
            RELEASE => Some(Self::Release(Release::decode(rest)?)),
            CANCEL if DETAILS => Some(Self::Cancel(Release::decode(rest)?)),
            RELEASE_ALL => {
                let (slot, id) = rest.split_first_chunk()?;
                Some(Self::ReleaseAll(Slot(u16::from_le_bytes(*slot)), u32::from_le_bytes(*id.first_chunk()?)))
            }
            MESSAGE => {
                let (&priority, message) = rest.split_first()?;
                Some(Self::Message(priority, message))
            }
            PING => Some(Self::Ping),
            PONG => Some(Self::Pong(report_of(rest)?)),
            CLOSE => rest.first().map(|code| Self::Close(*code)),
            _ => None,
        }
    }

    /// The encoded keep-alive.
    pub fn keep_alive(stamp: u64, report: Report) -> [u8; 14] {
        let [a, b, c, d, e, f, g, h] = stamp.to_le_bytes();
        let [_, r0, r1, r2, r3, flags] = Self::pong(report);
        [KEEP_ALIVE, a, b, c, d, e, f, g, h, r0, r1, r2, r3, flags]
    }

    /// The encoded renewal.
    pub fn renewal(renewal: &Renewal) -> [u8; 22] {
        let [c0, c1, c2, c3] = renewal.call.to_le_bytes();
        let [a, b, c, d, e, f, g, h] = renewal.stamp.to_le_bytes();
        let [w, x, y, z] = renewal.since.as_wire().to_le_bytes();
        let [a0, a1, a2, a3] = renewal.age.as_wire().to_le_bytes();
        [RENEW, renewal.class.to_wire(), c0, c1, c2, c3, a, b, c, d, e, f, g, h, w, x, y, z, a0, a1, a2, a3]
    }

    /// The encoded answer to a renewal.
    pub fn renewed(call: u32) -> [u8; 5] {
        let [c0, c1, c2, c3] = call.to_le_bytes();
        [RENEWED, c0, c1, c2, c3]
    }

    /// Encodes the release of one call.
    pub fn release(release: &Release) -> [u8; 6] {
        let [c0, c1, c2, c3] = release.call.to_le_bytes();
        [RELEASE, release.class.to_wire(), c0, c1, c2, c3]
    }

    /// Encodes the cancellation of one call.
    pub fn cancel(release: &Release) -> [u8; 6] {
        let [_, rest @ ..] = Self::release(release);
        let [a, b, c, d, e] = rest;
        [CANCEL, a, b, c, d, e]
    }

    /// Encodes the release of all calls of a function up to `id`.
    pub fn release_all(slot: Slot, id: u32) -> [u8; 7] {
        let ([s0, s1], [i0, i1, i2, i3]) = (slot.0.to_le_bytes(), id.to_le_bytes());
        [RELEASE_ALL, s0, s1, i0, i1, i2, i3]
    }

    /// The encoded ping.
    pub const PING: [u8; 1] = [PING];

    /// The encoded pong.
    pub fn pong(report: Report) -> [u8; 6] {
        let [r0, r1, r2, r3] = report.received.to_le_bytes();
        let flag = |is_set, flag| if is_set { flag } else { 0 };
        let flags = flag(report.hears, HEARS) | flag(report.holds, HOLDS) | flag(report.misses, MISSES);
        [PONG, r0, r1, r2, r3, flags]
    }

    /// Encodes the end of a link with this close code.
    pub const fn close(code: u8) -> [u8; 2] {
        [CLOSE, code]
    }

    /// The two bytes before a message.
    pub const fn message_prefix(priority: u8) -> [u8; 2] {
        [MESSAGE, priority]
    }
}

fn report_of(bytes: &[u8]) -> Option<Report> {
    let (received, rest) = bytes.split_first_chunk()?;
    let flags = rest.first()?;
    let is_set = |flag: u8| flags & flag != 0;
    let received = u32::from_le_bytes(*received);
    Some(Report { received, hears: is_set(HEARS), holds: is_set(HOLDS), misses: is_set(MISSES) })
}

#[cfg(test)]
mod tests;
