//! Messages of a session: requests and replies with headers in front of a block of parameters, control messages of
//! [items](super::items). Headers tell their length, so that a later version can put more into them. With
//! [`hello`](super::hello), [`datagram`](super::datagram) and [`block`](super::block) the only code
//! that knows the encoding; `docs/wire.md` says it in words.

pub use super::control::SubscriptionRefusal;
pub use super::control::{ActuatorState, Control, LastOrder, Latch, LeaseEnd, OrderOutcome, trace_id};
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
/// The caller wants to be told progress; a callee may pass it over.
const WANTS_PROGRESS: u8 = 0x02;
/// An operator made it, and not the unit's program.
const OPERATOR: u8 = 0x04;
/// What another caller moves is taken over.
const TAKES_OVER: u8 = 0x10;
/// Flags without which a callee must not run the request, and which this version does not know.
const UNKNOWN: u8 = 0xE0;
/// Bytes before a request's block.
pub const REQUEST_BYTES: usize = 32;
/// Bytes before a reply's block.
pub const REPLY_BYTES: usize = 16;
/// Longest header that a receiver has room for in front of its longest block: those of later versions may be longer.
pub const LONGEST_HEADER_BYTES: usize = 64;
/// Bytes before the items of a control message.
const CONTROL_HEADER_BYTES: usize = 4;
/// Headers tell their length in these.
const WORD: usize = 4;
const REQUEST_WORDS: u8 = (REQUEST_BYTES / WORD) as u8;
const REPLY_WORDS: u8 = (REPLY_BYTES / WORD) as u8;
/// Longest control message that is not a `Publish`.
pub const CONTROL_BYTES: usize = 48;
/// Bytes that a `Publish` needs beside the signature.
pub const PUBLISH_BYTES: usize = 32;

/// A message, borrowed from the bytes that it came in.
#[derive(Debug)]
pub enum Message<'b> {
    /// Run a function.
    Request(RequestHeader, &'b [u8]),
    /// What a request led to: results, or why there are none.
    Reply(u32, Result<&'b [u8], Error>),
    /// An asynchronous request was not run, or its service failed.
    Failure(u32, Error),
    /// What a running call tells.
    Progress(u32, &'b [u8]),
    /// Lists, limits, leases: [items](super::items), of which [`Control`] is one each.
    Control(&'b [u8]),
    /// The newest value of a stream.
    Sample(SampleHeader, &'b [u8]),
}

impl<'b> Message<'b> {
    /// Reads a message; `None` for anything that the format does not know.
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

/// What follows a header that says so many words of itself; it may be longer than this version's, and not shorter.
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

/// What stands in front of a request's arguments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RequestHeader {
    /// Rises within a session; names the request in the reply.
    pub id: u32,
    /// The callee's function.
    pub slot: Slot,
    /// The life of the slot that the caller knows.
    pub generation: Generation,
    /// The caller waits for a reply.
    pub wants_reply: bool,
    /// The caller wants to be told progress.
    pub wants_progress: bool,
    /// What another caller moves is taken over.
    pub takes_over: bool,
    /// An operator made it, and not the unit's program.
    pub operator: bool,
    /// Flags that this version does not know, without which the request must not be run.
    pub unknown: u8,
    /// Time until the caller's deadline when the request was made, saturating.
    pub remaining: Duration,
    /// The callee's clock as the caller last heard it, in microseconds.
    pub stamp: u64,
    /// Time since the caller heard it, saturating.
    pub since: Duration,
    /// The call's place among those that its caller has made on this link: a later one has a higher number.
    pub number: u32,
}

impl RequestHeader {
    /// The header's bytes.
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

/// What stands in front of a value of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleHeader {
    /// The sender's stream.
    pub slot: Slot,
    /// The life of the slot.
    pub generation: Generation,
    /// When the value was made, at the earliest, on the subscriber's clock in microseconds: before its start if negative.
    pub made: i64,
}

/// Bytes before the block of a sample.
pub const SAMPLE_BYTES: usize = 16;

impl SampleHeader {
    /// The header's bytes.
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

/// Bytes before the block of progress.
pub const PROGRESS_BYTES: usize = 8;

/// The header of what call `id` tells.
pub fn encode_progress(id: u32) -> [u8; PROGRESS_BYTES] {
    let [a, b, c, d] = id.to_le_bytes();
    [PROGRESS, 0, 0, (PROGRESS_BYTES / WORD) as u8, a, b, c, d]
}

/// What stands behind the header of a reply or failure whose service failed: its text, and the block of its values.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FailureDetails<'b> {
    /// The reason in words.
    pub text: &'b str,
    /// The block of the values that the signature declares, or nothing.
    pub values: &'b [u8],
}

impl<'b> FailureDetails<'b> {
    /// `None` for any other message, and where there are none.
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

    /// Bytes of a text with its length and padding.
    pub(crate) const fn text_bytes(text: &str) -> usize {
        text.len().next_multiple_of(8).saturating_add(8)
    }

    /// Writes a text, which takes [`text_bytes`](Self::text_bytes).
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

/// The message that tells why asynchronous request `id` failed.
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

/// The code of a service that failed with one of its own.
const SERVICE_FAILED: u8 = 20;

/// (code, index, first number, second number) of an error that a callee answers.
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

/// The inverse of [`error_code`]; a code of a later version reads as `Malformed`.
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

/// What travels in a session's datagrams, or in the stream as a session frame.
#[derive(Debug, PartialEq, Eq)]
pub enum SessionBody<'b> {
    /// The sender is alive.
    KeepAlive {
        /// The sender's clock in microseconds.
        stamp: u64,
        /// What comes of the peer.
        report: Report,
    },
    /// The caller still wants what a leased call started. To be answered at once, on the way that it came.
    Renew(Renewal),
    /// The answer: the caller's id of the call.
    Renewed(u32),
    /// The caller no longer wants a leased call, wherever it is.
    Release(Release),
    /// The caller has given a call up, and waits for it no longer.
    Cancel(Release),
    /// The caller gives up all its calls of a leased function up to this id, whether in flight, queued or running.
    ReleaseAll(Slot, u32),
    /// One whole message: a best-effort request, or an emergency's second copy. The priority's byte, the message.
    Message(u8, &'b [u8]),
    /// To be answered at once, in a datagram.
    Ping,
    /// The answer, with what comes of the peer.
    Pong(Report),
    /// The sender ends the link, whose stream is dead: a close code. In a datagram only.
    Close(u8),
}

/// A renewal of a leased call; its age is bounded like a request's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Renewal {
    /// The caller's id of the call.
    pub call: u32,
    /// The class that the call was made in.
    pub class: Priority,
    /// The callee's clock as the caller last heard it.
    pub stamp: u64,
    /// Time since then.
    pub since: Duration,
    /// How long before that the caller has last been seen to want it.
    pub age: Duration,
}

/// The caller gives up a call: it ends, leaves the queue, or does not begin if it arrives later.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Release {
    /// The caller's id of the call.
    pub call: u32,
    /// The class that the call was made in.
    pub class: Priority,
}

impl Release {
    fn decode(bytes: &[u8]) -> Option<Self> {
        let (&class, call) = bytes.split_first()?;
        Some(Self { call: u32::from_le_bytes(*call.first_chunk()?), class: Priority::from_wire(class)? })
    }
}

/// Longest session body that is not a message.
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

impl<'b> SessionBody<'b> {
    /// Reads a session body. All but a message may be longer than this version knows; `None` for what it does not know.
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

    /// A keep-alive's bytes.
    pub fn keep_alive(stamp: u64, report: Report) -> [u8; 14] {
        let [a, b, c, d, e, f, g, h] = stamp.to_le_bytes();
        let [_, r0, r1, r2, r3, flags] = Self::pong(report);
        [KEEP_ALIVE, a, b, c, d, e, f, g, h, r0, r1, r2, r3, flags]
    }

    /// A renewal's bytes.
    pub fn renewal(renewal: &Renewal) -> [u8; 22] {
        let [c0, c1, c2, c3] = renewal.call.to_le_bytes();
        let [a, b, c, d, e, f, g, h] = renewal.stamp.to_le_bytes();
        let [w, x, y, z] = renewal.since.as_wire().to_le_bytes();
        let [a0, a1, a2, a3] = renewal.age.as_wire().to_le_bytes();
        [RENEW, renewal.class.to_wire(), c0, c1, c2, c3, a, b, c, d, e, f, g, h, w, x, y, z, a0, a1, a2, a3]
    }

    /// The answer's bytes.
    pub fn renewed(call: u32) -> [u8; 5] {
        let [c0, c1, c2, c3] = call.to_le_bytes();
        [RENEWED, c0, c1, c2, c3]
    }

    /// The bytes that release one call.
    pub fn release(release: &Release) -> [u8; 6] {
        let [c0, c1, c2, c3] = release.call.to_le_bytes();
        [RELEASE, release.class.to_wire(), c0, c1, c2, c3]
    }

    /// The bytes that cancel one call.
    pub fn cancel(release: &Release) -> [u8; 6] {
        let [_, rest @ ..] = Self::release(release);
        let [a, b, c, d, e] = rest;
        [CANCEL, a, b, c, d, e]
    }

    /// The bytes that release all calls of a function up to `id`.
    pub fn release_all(slot: Slot, id: u32) -> [u8; 7] {
        let ([s0, s1], [i0, i1, i2, i3]) = (slot.0.to_le_bytes(), id.to_le_bytes());
        [RELEASE_ALL, s0, s1, i0, i1, i2, i3]
    }

    /// A ping's byte.
    pub const PING: [u8; 1] = [PING];

    /// A pong's bytes.
    pub fn pong(report: Report) -> [u8; 6] {
        let [r0, r1, r2, r3] = report.received.to_le_bytes();
        let flags = if report.hears { HEARS } else { 0 } | if report.holds { HOLDS } else { 0 };
        [PONG, r0, r1, r2, r3, flags]
    }

    /// The bytes that end a link with this close code.
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
    Some(Report { received: u32::from_le_bytes(*received), hears: is_set(HEARS), holds: is_set(HOLDS) })
}

#[cfg(test)]
mod tests;
