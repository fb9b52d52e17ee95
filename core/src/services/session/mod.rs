//! One link to one peer: the s_unit's session with its manager, and each peer of an m_unit.
//!
//! A [`Session`] turns bytes into [`Event`]s and requests into bytes. It never waits: the port lends it a [`Context`],
//! runs the handler of an [`Event::Incoming`] outside of any lock, and brings the answer with [`Session::answer`]. It asks the
//! unit's [`Hub`](super::hub::Hub) by itself, through the [`Door`](super::hub::Door) in its context.
//!
//! # What a port does
//! - bytes arrive: [`Session::receive`] until they are consumed and nothing more comes out, then [`Session::next_call`]
//!   until it returns `None`, running what it returns;
//! - the stream is writable: [`Session::writable`];
//! - a session datagram arrives: [`Session::datagram`];
//! - [`Session::deadline`] has come, and after every other call that may have ended the link: [`Session::poll`] until
//!   it returns `None`;
//! - the hub has a [`Command`](crate::distribution::connection_handler::Command) for a link: [`Session::direct`];
//! - [`Event::Closed`] is the last event: the port forgets the link and tells the hub's node that it
//!   [left](crate::distribution::connection_handler::Node::left).

mod answering;
mod consulting;
mod details;
mod granting;
mod holding;
mod inbound;
mod lending;
mod obeying;
mod outbound;
mod permitting;
mod pinging;
mod proving;
mod publishing;
mod renewing;
mod streaming;
mod timing;

pub use inbound::{Receipt, ReplyBlock, Results};
pub use outbound::{Delivery, RequestOptions};
pub use publishing::Publication;
pub use streaming::{Granted as GrantedStream, Sample};

use crate::ability::{Ability, DETAILS, Details, STREAMS, State, Streams};
use crate::config::{Constraints, HELLO_TIMEOUT, LEASES, LINK_BUFFER_BYTES, Mode, Priority};
use crate::counters::Counters;
use crate::distribution::function_list::{Entry, Slot, TheirFunctionList};
use crate::distribution::hello::Hello;
use crate::distribution::identity::{Epoch, Fleet, Identity};
use crate::distribution::message::LONGEST_HEADER_BYTES;
use crate::distribution::message::SessionBody;
use crate::error::{CloseReason, Error, Refusal};
use crate::host::connections::{Link, LinkCounter, Liveness};
use crate::host::frame::{Frame, HEADER_BYTES};
use crate::host::mailman::LinkId;
use crate::host::secure::Secure;
use crate::services::calls::{Calls, RunningCall, Ticket};
use crate::services::lease::{ActuatorState, Granted, Held, LeaseEnd, Order};
use crate::services::requests::{CallId, Pending, Requests};
use crate::services::{Context, Port};
use crate::storage::{Buffers, Storage};
use crate::time::{Duration, Instant};
use timing::{PeerClock, Timers};

/// Longest hello frame.
const HELLO_BYTES: usize = 320;
/// Longest frame body of a peer that has proven nothing: with its header too short to need a buffer of the pool.
const UNPROVEN_BYTES: usize = crate::config::MINIMUM_CHUNK_BYTES - HEADER_BYTES - 1;
/// A challenge goes in the stream and in so many datagrams: one lost segment or datagram must not make a live peer look
/// dead, and its place go to a duplicate.
const CHALLENGE_DATAGRAMS: usize = 3;
/// Most that a chunk adds to its piece of a message, without sealing.
const FRAME_BYTES: usize = HEADER_BYTES + 6;
/// Messages of the protocol itself fit this, however small `message_size` is.
const LEAST_MESSAGE_BYTES: usize = 512;

/// What a session begins with.
#[derive(Clone, Debug)]
pub struct SessionConfig<E> {
    /// The link's index.
    pub link: LinkId,
    /// This unit opens the connection, as opposed to: it accepted one.
    pub dialed: bool,
    /// The other end of the stream.
    pub address: E,
    /// [`Node::nonce`](crate::distribution::connection_handler::Node::nonce)
    pub nonce: u64,
    /// This unit's constraints.
    pub constraints: Constraints,
}

/// The slices that one session lives in.
pub struct SessionStorage<S: Storage> {
    /// [`LINK_BUFFER_BYTES`] for partial frames.
    pub small: S::Slice<u8>,
    /// One slot per call in flight to the peer.
    pub pending: S::Slice<Option<Pending>>,
    /// One slot per call of the peer that runs here, and one more for emergencies.
    pub running: S::Slice<Option<RunningCall>>,
    /// One slot per function of this unit's own list.
    pub publications: S::Slice<Publication>,
    /// One slot per function of the peer's list that is kept.
    pub their_functions: S::Slice<Entry>,
    /// Bytes for the signatures of those.
    pub their_signatures: S::Slice<u8>,
}

/// What happened on a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
// A wide tag: the rest is then moved in words, and not byte by byte.
#[repr(u32)]
pub enum Event {
    /// Both ends have accepted each other: the link is live, and has told the peer what is published to it.
    Joined,
    /// A call whose arguments are in the lent parameters: run its handler, then [`Session::answer`].
    Incoming(Incoming),
    /// The end of a call of this unit; [`Session::results`] shows what it returned.
    Reply(CallId, Result<Results, Error>),
    /// An asynchronous request was refused by the peer, or its service failed.
    Failed(CallId, Error),
    /// The peer's list of functions changed.
    ListChanged,
    /// The peer has read this unit's list up to `serial`, and keeps no room for `skipped` functions of it.
    Acknowledged {
        /// As returned by [`Session::publish`].
        serial: u32,
        /// Functions that the peer keeps no room for.
        skipped: u16,
    },
    /// A lease on a function of this unit ended without being renewed: run its safe hook before anything else.
    LeaseExpired(Slot),
    /// The peer ended the lease that a call of this unit held on its function.
    LeaseEnded {
        /// The call that held it.
        call: CallId,
        /// The peer's function.
        slot: Slot,
        /// Why.
        why: LeaseEnd,
    },
    /// The peer tells the state of what a function of it moves: before its list is complete for one that has had an order
    /// or is inhibited, and when that changes, within a keep-alive interval.
    Actuator {
        /// The peer's function.
        slot: Slot,
        /// Its state.
        state: ActuatorState,
    },
    /// What a call of this unit tells while it runs; [`Session::progress_values`] shows the values.
    Progress(CallId, <Details as Ability>::Of<Results>),
    /// The caller has given up a call that runs: its handler is to be told, and the answer reaches no one.
    Cancelled(<Details as Ability>::Of<Ticket>),
    /// A value of a stream of the peer.
    Sample(<Streams as Ability>::Of<Sample>),
    /// What became of a subscription to a stream of the peer; after an error it has ended.
    Subscribed(Slot, <Streams as Ability>::Of<Result<GrantedStream, Error>>),
    /// The peer answered a [`Session::ping`].
    Answered,
    /// The link has ended; every call in flight and every lease has been reported before.
    Closed(CloseReason),
}

/// A call of the peer that is to be run now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Incoming {
    /// Answers it.
    pub ticket: Ticket,
    /// The function of this unit's list.
    pub slot: Slot,
    /// Its class.
    pub priority: Priority,
    /// Whether the caller waits for an answer.
    pub wants_reply: bool,
    /// After this nobody waits for the answer.
    pub deadline: Instant,
    /// Its hold of the service's lease, if there is one.
    pub order: Option<Order>,
}

/// Where the link stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// The port is opening the connection, or waits for the peer's hello.
    AwaitingHello { until: Instant },
    /// The peer is to prove that it has the key: with a message, then with a sealed frame.
    Proving { until: Instant },
    /// The hub decides about the peer.
    Deciding,
    /// Both have accepted.
    Live,
    /// The link has ended; what was in flight is being reported.
    Ending(CloseReason),
    /// Everything has been reported.
    Ended,
}

/// What is known of the peer since its hello.
struct Remote<E> {
    hello: Hello,
    /// The highest version that both ends speak.
    version: u8,
    /// When its hello came.
    heard: Instant,
    /// Where its session datagrams go.
    datagrams: E,
}

/// One link to one peer.
pub struct Session<P: Port> {
    link: Link<P::Storage, P::Cipher>,
    phase: Phase,
    dialed: bool,
    /// The hub has taken the peer.
    joined: bool,
    nonce: u64,
    fleet: Fleet,
    /// The pause between keep-alives, in milliseconds, that this unit's hello has named.
    reported_keep_alive: u32,
    constraints: Constraints,
    remote: Option<Remote<P::Endpoint>>,
    peer_address: P::Endpoint,
    liveness: Liveness,
    /// The hub waits for a sign of life.
    challenged: bool,
    /// More of the stream is there and is not read for now.
    holds: bool,
    pings: pinging::Pings,
    clock: PeerClock,
    timers: Timers,
    renewal: renewing::Renewal,
    requests: Requests<P::Storage>,
    calls: Calls<P::Storage>,
    obedience: obeying::Obedience,
    publishing: publishing::Publishing<P::Storage>,
    theirs: TheirFunctionList<P::Storage>,
    granted: heapless::Vec<Granted, LEASES>,
    ends: granting::Ends,
    held: heapless::Vec<Held, LEASES>,
    answered: holding::Answered,
    releases: holding::Releases,
    streaming: State<streaming::Streaming, { STREAMS as usize }>,
    details: State<details::OfCalls, { DETAILS as usize }>,
    /// The newest call that was to move something.
    last_order: Option<(Slot, CallId)>,
    /// How often something was received, by which [`Results`] are known to be the last ones.
    step: u32,
}

impl<P: Port> Session<P> {
    /// A session on a link that is being opened or was accepted.
    pub fn new(
        now: Instant,
        config: SessionConfig<P::Endpoint>,
        cipher: P::Cipher,
        storage: SessionStorage<P::Storage>,
    ) -> Self {
        let SessionConfig { link, dialed, address, nonce, constraints } = config;
        let chunk_limit = usize::from(constraints.chunk_size);
        debug_assert!(storage.small.len() >= LINK_BUFFER_BYTES);
        let proven = cipher.is_sealing();
        let mut link = Link::new(link, cipher, storage.small, chunk_limit, message_limit(&constraints));
        if !proven {
            // Whoever has proven nothing gets no more than the link's own bytes.
            link.set_chunk_limit(UNPROVEN_BYTES);
        }
        Self {
            link,
            phase: Phase::AwaitingHello { until: now + HELLO_TIMEOUT },
            dialed,
            joined: false,
            nonce,
            fleet: Fleet(0),
            reported_keep_alive: 0,
            constraints,
            remote: None,
            peer_address: address,
            liveness: Liveness::new(now, constraints.keep_alive),
            challenged: false,
            holds: false,
            pings: pinging::Pings::new(),
            clock: PeerClock::new(),
            timers: Timers::new(now),
            renewal: renewing::Renewal::new(),
            requests: Requests::new(storage.pending),
            calls: Calls::new(storage.running),
            obedience: obeying::Obedience::new(),
            publishing: publishing::Publishing::new(storage.publications),
            theirs: TheirFunctionList::new(storage.their_functions, storage.their_signatures),
            granted: heapless::Vec::new(),
            ends: granting::Ends::new(),
            held: heapless::Vec::new(),
            answered: holding::Answered::new(),
            releases: holding::Releases::new(),
            streaming: State::NEW,
            details: State::NEW,
            last_order: None,
            step: 0,
        }
    }

    /// The slices that the session lived in, for the next one: so a port without an allocator opens link after link.
    /// For a session that has ended; of one that has not, what is in flight is forgotten without a word.
    pub fn into_storage(mut self, buffers: &mut dyn Buffers<P::Storage>) -> SessionStorage<P::Storage> {
        self.link.release(buffers);
        self.calls.release(buffers);
        let (their_functions, their_signatures) = self.theirs.into_slices();
        SessionStorage {
            small: self.link.into_small(),
            pending: self.requests.into_slots(),
            running: self.calls.into_slots(),
            publications: self.publishing.into_table(),
            their_functions,
            their_signatures,
        }
    }

    /// This unit opened the connection.
    pub const fn dialed(&self) -> bool {
        !P::MANAGES || self.dialed
    }

    /// Both ends have accepted each other.
    pub fn is_live(&self) -> bool {
        self.phase == Phase::Live
    }

    /// The link has ended and everything about it has been reported.
    pub fn is_ended(&self) -> bool {
        self.phase == Phase::Ended
    }

    /// The peer has proven who it is, or has said it where nobody has to prove it. Of links that have not come so far, the
    /// oldest gives way to a new one.
    pub const fn is_proven(&self) -> bool {
        self.remote.is_some() && !matches!(self.phase, Phase::Proving { .. })
    }

    /// The peer's hello, once it has come. It may be anybody's as long as the peer [is not proven](Self::is_proven).
    pub fn hello(&self) -> Option<&Hello> {
        self.remote.as_ref().map(|remote| &remote.hello)
    }

    /// The version of the protocol that the link uses, once the peer's hello has come.
    pub fn version(&self) -> Option<u8> {
        self.remote.as_ref().map(|remote| remote.version)
    }

    /// The peer's identity, once it has told it. It may be anybody's as long as the peer [is not proven](Self::is_proven).
    pub fn identity(&self) -> Option<&Identity> {
        self.hello().map(|hello| &hello.identity)
    }

    /// The peer, from joining on.
    pub fn peer(&self) -> Option<&Identity> {
        self.identity().filter(|_| self.joined)
    }

    /// The peer's boot epoch, once it has told it.
    pub fn epoch(&self) -> Option<Epoch> {
        self.hello().map(|hello| hello.epoch)
    }

    /// The other end of the stream.
    pub const fn address(&self) -> P::Endpoint {
        self.peer_address
    }

    /// This unit's constraints, as this link keeps them.
    pub const fn constraints(&self) -> &Constraints {
        &self.constraints
    }

    /// The nonce that the peer's session datagrams carry.
    pub const fn nonce(&self) -> u64 {
        self.nonce
    }

    /// What the peer has published to this unit.
    pub const fn their_function_list(&self) -> &TheirFunctionList<P::Storage> {
        &self.theirs
    }

    /// What happened on this link.
    pub const fn counters(&self) -> &Counters<LinkCounter, { LinkCounter::COUNT }> {
        &self.link.counters
    }

    /// The newest call of a leased function of the peer.
    pub const fn last_order(&self) -> Option<(Slot, CallId)> {
        self.last_order
    }

    /// Calls of this unit that wait for a reply.
    pub fn calls_in_flight(&self) -> usize {
        self.requests.in_flight()
    }

    /// Whether a call of the peer moves something here.
    pub fn moves(&self) -> bool {
        !self.granted.is_empty()
    }

    /// Calls of the peer that run or wait here.
    pub const fn calls_held(&self) -> u16 {
        self.calls.held()
    }

    /// How long ago the peer was last heard.
    pub fn silent_for(&self, now: Instant) -> Duration {
        self.liveness.silent_for(now)
    }

    /// How long ago something came in the stream: what it told is as old at least.
    pub fn stream_silent_for(&self, now: Instant) -> Duration {
        self.liveness.stream_silent_for(now)
    }

    /// Whether session datagrams of the peer come; `None` while that is not known.
    pub const fn hears_datagrams(&self) -> Option<bool> {
        match (self.liveness.hears(), self.liveness.is_deaf()) {
            (false, false) => None,
            (hears, _) => Some(hears),
        }
    }

    /// Whether those of this unit come to the peer, as it told last.
    pub const fn is_heard(&self) -> bool {
        self.liveness.is_heard()
    }

    /// More bytes of the stream are there, and the port does not read them for now: the peer is told, which otherwise takes the
    /// stream for dead. Until the next [`receive`](Self::receive).
    pub const fn hold_back(&mut self) {
        self.holds = true;
    }

    /// Bytes of messages and frames that the network has not taken yet.
    pub fn bytes_queued(&self) -> usize {
        self.link.queued()
    }

    /// Bytes wait for the stream to become writable. Those that gather do not: they have a deadline.
    pub fn wants_to_write(&self) -> bool {
        self.link.wants_to_write()
    }

    /// Whether anything is kept of the bytes that came. Otherwise [`receive`](Self::receive) has nothing more to say after
    /// it has taken all of them, and need not be called with nothing.
    pub fn holds_received(&self) -> bool {
        self.link.holds_received()
    }

    /// The connection is open: the one who dialed introduces itself first.
    pub fn connected(&mut self, cx: &mut Context<'_, P>) {
        self.phase = Phase::AwaitingHello { until: cx.now + HELLO_TIMEOUT };
        if self.dialed() {
            self.send_hello(cx);
        }
    }

    /// The hub takes the peer. The link is live from here on, unless it ends here.
    fn accept(&mut self, cx: &mut Context<'_, P>) {
        if !self.dialed() {
            self.reply_to_hello(cx);
        }
        if self.phase != Phase::Deciding {
            return;
        }
        self.phase = Phase::Live;
        self.timers.keep_alive = cx.now;
        self.rest_until_renewal(cx.now);
        debug!("link {} is live", self.link.id().0);
    }

    /// The peer is not taken, and told why.
    fn refuse(&mut self, cx: &mut Context<'_, P>, refusal: Refusal) {
        match refusal {
            Refusal::NoKey => {
                // The code of a proof that failed: the peer need not know which of the two it was.
                self.link.counters.count(LinkCounter::KeysMissing);
                self.farewell(cx, &Frame::Close(close_code(CloseReason::BadProof)));
            }
            _ => self.farewell(cx, &Frame::Refuse(refusal.to_wire())),
        }
        self.end(CloseReason::Refused(refusal));
    }

    /// Ends the link because the key of its pair is no longer valid.
    pub fn revoke(&mut self, cx: &mut Context<'_, P>) {
        self.refuse(cx, Refusal::NoKey);
    }

    /// Ends the link in an orderly way; [`poll`](Self::poll) reports what was in flight.
    pub fn close(&mut self, cx: &mut Context<'_, P>, reason: CloseReason) {
        if matches!(reason, CloseReason::Protocol | CloseReason::Oversize) {
            self.link.counters.count(LinkCounter::FramesRefused);
        }
        self.farewell(cx, &Frame::Close(close_code(reason)));
        self.end(reason);
    }

    /// The connection below has ended.
    pub fn disconnected(&mut self, reason: CloseReason) {
        self.end(reason);
    }

    /// Asks the peer of a live link for a sign of life.
    fn challenge(&mut self, cx: &mut Context<'_, P>) {
        if self.phase == Phase::Live {
            self.challenged = true;
            self.send_ping(cx.now);
            self.flush(cx);
            for _ in 0..CHALLENGE_DATAGRAMS {
                self.send_datagram(cx, &SessionBody::PING, &[]);
            }
        }
    }

    /// The stream takes bytes again.
    pub fn writable(&mut self, cx: &mut Context<'_, P>) {
        self.flush(cx);
        self.pump_renewal(cx);
        if P::CALLS {
            self.send_releases(cx);
        }
        self.pump(cx);
        if STREAMS {
            self.send_samples(cx);
        }
    }

    /// Changes the limits of this unit; the peer is told.
    pub fn set_constraints(&mut self, cx: &mut Context<'_, P>, constraints: Constraints) {
        self.constraints = constraints;
        self.link.set_message_limit(message_limit(&constraints));
        self.publishing.notify_limits();
        self.pump(cx);
    }

    fn send_hello(&mut self, cx: &mut Context<'_, P>) {
        let (mut bytes, mut length) = ([0; HELLO_BYTES], 0);
        let (now, mode, link) = (cx.now, self.mode(), self.link.id());
        let (nonce, remote, fleet, reported) =
            (self.nonce, &self.remote, &mut self.fleet, &mut self.reported_keep_alive);
        cx.hub.enter(&mut |hub| {
            let mut hello = hub.node.hello(now, link, nonce);
            if let Some(remote) = remote {
                hello.obeyed = hub.node.obeyed_report(now, &remote.hello.identity);
            }
            (*fleet, *reported) = (hello.fleet, hello.keep_alive);
            length = hello.encode(mode, &mut bytes).unwrap_or(0);
        });
        let bytes = bytes.get(..length).unwrap_or(&[]);
        self.link.cipher().introduce(bytes);
        self.send_frame(&Frame::Hello(bytes));
        self.flush(cx);
    }

    /// Puts a frame into the stream, sealed if frames are.
    fn send_frame(&mut self, frame: &Frame<'_>) -> bool {
        if self.link.cipher().is_sealing() { self.link.send_frame(frame) } else { self.link.send_clear(frame) }
    }

    fn mode(&mut self) -> Mode {
        self.link.cipher().mode()
    }

    /// A last frame, behind what is being written, as far as the network takes it now.
    fn farewell(&mut self, cx: &mut Context<'_, P>, frame: &Frame<'_>) {
        if !matches!(self.phase, Phase::Ending(_) | Phase::Ended) {
            // What was accepted goes first: a frame would overtake it.
            let _ = self.link.flush(cx.mailman, cx.buffers);
            self.send_frame(frame);
            let _ = self.link.flush(cx.mailman, cx.buffers);
        }
    }

    fn flush(&mut self, cx: &mut Context<'_, P>) {
        self.timers.gathered = Instant::FAR_FUTURE;
        if let Err(reason) = self.link.flush(cx.mailman, cx.buffers) {
            self.end(reason);
        }
    }

    fn end(&mut self, reason: CloseReason) {
        if !matches!(self.phase, Phase::Ending(_) | Phase::Ended) {
            debug!("link {} ends: {}", self.link.id().0, reason);
            self.phase = Phase::Ending(reason);
        }
    }

    /// Longest block that the peer takes.
    fn peer_message_size(&self) -> u32 {
        self.hello().map_or(0, |hello| hello.limits.message_size)
    }

    /// Our own minimum interval or the peer's, whichever is longer.
    fn interval(&self) -> Duration {
        let theirs = self.hello().map_or(0, |hello| hello.limits.minimum_interval);
        self.constraints.minimum_interval.max(Duration::from_micros(u64::from(theirs)))
    }
}

fn message_limit(constraints: &Constraints) -> usize {
    (constraints.message_size as usize).saturating_add(LONGEST_HEADER_BYTES).max(LEAST_MESSAGE_BYTES)
}

/// Bytes that a pool buffer needs so that a message of `message_size` fits, framed, in chunks of any allowed size.
pub const fn buffer_bytes(message_size: u32, overhead: usize) -> usize {
    let total = (message_size as usize).saturating_add(LONGEST_HEADER_BYTES);
    let total = if total < LEAST_MESSAGE_BYTES { LEAST_MESSAGE_BYTES } else { total };
    let payload = crate::config::MINIMUM_CHUNK_BYTES.saturating_sub(overhead).saturating_sub(FRAME_BYTES);
    let frames = match total.checked_div(payload) {
        Some(frames) => frames.saturating_add(2),
        None => 2,
    };
    total.saturating_add(frames.saturating_mul(FRAME_BYTES.saturating_add(overhead)))
}

const fn close_code(reason: CloseReason) -> u8 {
    match reason {
        CloseReason::Stopped | CloseReason::StoppedHere => 1,
        CloseReason::Reset => 2,
        CloseReason::Silent => 3,
        CloseReason::PeerRestarted => 4,
        CloseReason::Protocol => 5,
        CloseReason::Oversize => 6,
        CloseReason::HelloTimeout => 7,
        CloseReason::Refused(_) => 8,
        CloseReason::DialFailed => 9,
        CloseReason::Exhausted => 10,
        CloseReason::Unproven => 11,
        CloseReason::BadProof => 12,
        CloseReason::StreamDead { long: false } => 13,
        CloseReason::StreamDead { long: true } => 14,
    }
}

const fn close_reason(code: u8) -> CloseReason {
    match code {
        1 => CloseReason::Stopped,
        3 => CloseReason::Silent,
        4 => CloseReason::PeerRestarted,
        5 => CloseReason::Protocol,
        6 => CloseReason::Oversize,
        7 => CloseReason::HelloTimeout,
        10 => CloseReason::Exhausted,
        12 => CloseReason::BadProof,
        13 => CloseReason::StreamDead { long: false },
        14 => CloseReason::StreamDead { long: true },
        _ => CloseReason::Reset,
    }
}

#[cfg(test)]
mod tests;
