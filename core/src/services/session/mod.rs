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
mod details;
mod due;
mod granting;
mod holding;
mod inbound;
mod obeying;
mod outbound;
mod permitting;
mod pinging;
mod proving;
mod publishing;
mod renewing;
mod streaming;
mod timing;
mod wire;

pub use inbound::{Receipt, ReplyBlock, Results};
pub use outbound::{Delivery, RequestOptions};
pub use publishing::Publication;
pub use streaming::{Granted as GrantedStream, Sample};

use crate::ability::{Ability, Details, STREAMS, State, Streams};
use crate::config::{Constraints, HELLO_TIMEOUT, LINK_BUFFER_BYTES, Priority};
use crate::counters::Counters;
use crate::distribution::connection_handler::{Admission, Directive};
use crate::distribution::function_list::{Entry, Slot, TheirFunctionList};
use crate::distribution::hello::Hello;
use crate::distribution::identity::{Epoch, Fleet, Identity};
use crate::distribution::message::{LONGEST_HEADER_BYTES, SessionBody};
use crate::distribution::parameters::ParametersView;
use crate::error::{CloseReason, Error, Refusal};
use crate::host::connections::{Link, LinkCounter, Liveness};
use crate::host::frame::HEADER_BYTES;
use crate::host::mailman::LinkId;
use crate::host::secure::Secure;
use crate::services::access::Verb;
use crate::services::call::Callee;
use crate::services::calls::{Calls, RunningCall, Ticket};
use crate::services::heart::Beats;
use crate::services::lease::{ActuatorState, Lease, LeaseEnd, Order};
use crate::services::requests::{CallId, Made, Pending, Requests};
use crate::services::{Context, Port};
use crate::storage::{Buffers, Storage};
use crate::time::{Duration, Instant};
use granting::Granting;
use holding::Calling;
use permitting::decide;
use proving::{reply_to_hello, send_hello};
use timing::PeerClock;
use wire::{Phase, Wire, close_code, close_reason};

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

/// One link to one peer.
pub struct Session<P: Port> {
    wire: Wire<P>,
    pings: pinging::Pings,
    renewal: renewing::Renewal,
    calling: Calling<P>,
    calls: Calls<P::Storage>,
    granting: Granting,
    streaming: streaming::StreamsPart,
    details: details::DetailsPart,
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
        let mut wire = Wire {
            link,
            phase: Phase::AwaitingHello { until: now + HELLO_TIMEOUT },
            dialed,
            nonce,
            fleet: Fleet(0),
            reported_keep_alive: 0,
            constraints,
            remote: None,
            peer_address: address,
            liveness: Liveness::new(now, constraints.keep_alive),
            holds: false,
            joined: false,
            challenged: false,
            clock: PeerClock::new(),
            due: due::Due::new(),
            pace: State::NEW,
            last_write: Instant::START,
            publishing: publishing::Publishing::new(storage.publications),
            theirs: TheirFunctionList::new(storage.their_functions, storage.their_signatures),
            step: 0,
        };
        wire.due.set(due::Part::KeepAlive, now);
        wire.note_liveness();
        Self {
            wire,
            pings: pinging::Pings::new(),
            renewal: renewing::Renewal::new(),
            calling: Calling::new(Requests::new(storage.pending)),
            calls: Calls::new(storage.running),
            granting: Granting::new(),
            streaming: State::NEW,
            details: State::NEW,
        }
    }

    /// The slices that the session lived in, for the next one: so a port without an allocator opens link after link.
    /// For a session that has ended; of one that has not, what is in flight is forgotten without a word.
    pub fn into_storage(mut self, buffers: &mut dyn Buffers<P::Storage>) -> SessionStorage<P::Storage> {
        self.wire.link.release(buffers);
        self.calls.release(buffers);
        let (their_functions, their_signatures) = self.wire.theirs.into_slices();
        SessionStorage {
            small: self.wire.link.into_small(),
            pending: self.calling.requests.into_slots(),
            running: self.calls.into_slots(),
            publications: self.wire.publishing.into_table(),
            their_functions,
            their_signatures,
        }
    }

    /// This unit opened the connection.
    pub const fn dialed(&self) -> bool {
        self.wire.dialed()
    }

    /// Both ends have accepted each other.
    pub fn is_live(&self) -> bool {
        self.wire.phase == Phase::Live
    }

    /// The link has ended and everything about it has been reported.
    pub fn is_ended(&self) -> bool {
        self.wire.phase == Phase::Ended
    }

    /// The peer has proven who it is, or has said it where nobody has to prove it. Of links that have not come so far, the
    /// oldest gives way to a new one.
    pub const fn is_proven(&self) -> bool {
        self.wire.remote.is_some() && !matches!(self.wire.phase, Phase::Proving { .. })
    }

    /// The peer's hello, once it has come. It may be anybody's as long as the peer [is not proven](Self::is_proven).
    pub fn hello(&self) -> Option<&Hello> {
        self.wire.hello()
    }

    /// The version of the protocol that the link uses, once the peer's hello has come.
    pub fn version(&self) -> Option<u8> {
        self.wire.remote.as_ref().map(|remote| remote.version)
    }

    /// The peer's identity, once it has told it. It may be anybody's as long as the peer [is not proven](Self::is_proven).
    pub fn identity(&self) -> Option<&Identity> {
        self.wire.identity()
    }

    /// The peer, from joining on.
    pub fn peer(&self) -> Option<&Identity> {
        self.wire.identity().filter(|_| self.wire.joined)
    }

    /// The peer's boot epoch, once it has told it.
    pub fn epoch(&self) -> Option<Epoch> {
        self.wire.hello().map(|hello| hello.epoch)
    }

    /// The other end of the stream.
    pub const fn address(&self) -> P::Endpoint {
        self.wire.peer_address
    }

    /// This unit's constraints, as this link keeps them.
    pub const fn constraints(&self) -> &Constraints {
        &self.wire.constraints
    }

    /// The nonce that the peer's session datagrams carry.
    pub const fn nonce(&self) -> u64 {
        self.wire.nonce
    }

    /// What the peer has published to this unit.
    pub const fn their_function_list(&self) -> &TheirFunctionList<P::Storage> {
        &self.wire.theirs
    }

    /// What happened on this link.
    pub const fn counters(&self) -> &Counters<LinkCounter, { LinkCounter::COUNT }> {
        &self.wire.link.counters
    }

    /// The newest call of a leased function of the peer.
    pub const fn last_order(&self) -> Option<(Slot, CallId)> {
        self.calling.last_order
    }

    /// Calls of this unit that wait for a reply.
    pub fn calls_in_flight(&self) -> usize {
        self.calling.requests.in_flight()
    }

    /// Whether a call of the peer moves something here.
    pub fn moves(&self) -> bool {
        !self.granting.granted.is_empty()
    }

    /// Calls of the peer that run or wait here.
    pub const fn calls_held(&self) -> u16 {
        self.calls.held()
    }

    /// How long ago the peer was last heard.
    pub fn silent_for(&self, now: Instant) -> Duration {
        self.wire.liveness.silent_for(now)
    }

    /// How long ago something came in the stream: what it told is as old at least.
    pub fn stream_silent_for(&self, now: Instant) -> Duration {
        self.wire.liveness.stream_silent_for(now)
    }

    /// Whether session datagrams of the peer come; `None` while that is not known.
    pub const fn hears_datagrams(&self) -> Option<bool> {
        match (self.wire.liveness.hears(), self.wire.liveness.is_deaf()) {
            (false, false) => None,
            (hears, _) => Some(hears),
        }
    }

    /// Whether those of this unit come to the peer, as it told last.
    pub const fn is_heard(&self) -> bool {
        self.wire.liveness.is_heard()
    }

    /// More bytes of the stream are there, and the port does not read them for now: the peer is told, which otherwise takes the
    /// stream for dead. Until the next [`receive`](Self::receive).
    pub const fn hold_back(&mut self) {
        self.wire.holds = true;
    }

    /// Bytes of messages and frames that the network has not taken yet.
    pub fn bytes_queued(&self) -> usize {
        self.wire.link.queued()
    }

    /// Bytes wait for the stream to become writable. Those that gather do not: they have a deadline.
    pub fn wants_to_write(&self) -> bool {
        self.wire.link.wants_to_write()
    }

    /// Whether anything is kept of the bytes that came. Otherwise [`receive`](Self::receive) has nothing more to say after
    /// it has taken all of them, and need not be called with nothing.
    pub fn holds_received(&self) -> bool {
        self.wire.link.holds_received()
    }

    /// The connection is open: the one who dialed introduces itself first.
    pub fn connected(&mut self, cx: &mut Context<'_, P>) {
        self.wire.phase = Phase::AwaitingHello { until: cx.now + HELLO_TIMEOUT };
        if self.wire.dialed() {
            send_hello(&mut self.wire, cx);
        }
    }

    /// The hub takes the peer. The link is live from here on, unless it ends here.
    fn accept(&mut self, cx: &mut Context<'_, P>) {
        if !self.wire.dialed() {
            reply_to_hello(&mut self.wire, cx);
        }
        if self.wire.phase != Phase::Deciding {
            return;
        }
        self.wire.phase = Phase::Live;
        self.wire.due.set(due::Part::KeepAlive, cx.now);
        self.renewal.rest(&mut self.wire, cx.now);
        debug!("link {} is live", self.wire.link.id().0);
    }

    /// The peer has said who it is, or has proven it: what becomes of the link?
    pub(super) fn consult(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        let Some(remote) = &self.wire.remote else { return None };
        let (now, link, from, hello) = (cx.now, self.wire.link.id(), self.wire.peer_address, &remote.hello);
        let mut admission = Admission::Wait;
        cx.hub.enter(&mut |hub| admission = hub.node.admit(now, link, from, hello));
        match admission {
            Admission::Accept => return self.admitted(cx),
            Admission::Refuse(refusal) => self.wire.refuse(cx, refusal),
            Admission::Wait => {}
        }
        None
    }

    /// The peer is alive, for which the hub may have asked.
    pub(super) fn show_life(&mut self, cx: &mut Context<'_, P>) {
        if core::mem::take(&mut self.wire.challenged) && !self.has_given_way(cx) {
            let (now, link) = (cx.now, self.wire.link.id());
            cx.hub.enter(&mut |hub| hub.node.challenge_answered(now, link));
        }
    }

    /// Does what the hub wants of this link because of another one. What it comes too late for, it passes over.
    pub fn direct(&mut self, cx: &mut Context<'_, P>, directive: Directive) -> Option<Event> {
        match directive {
            Directive::Challenge => self.challenge(cx),
            Directive::Yield => {
                if self.granting.obedience.give_way(&mut self.wire, cx.now) {
                    self.challenge(cx);
                }
            }
            Directive::Admit => return self.admitted(cx),
            Directive::Refuse(refusal) => self.wire.refuse(cx, refusal),
            Directive::Close(reason) => self.wire.close(cx, reason),
        }
        None
    }

    /// The hub has taken the peer, which is told what is published to it.
    fn admitted(&mut self, cx: &mut Context<'_, P>) -> Option<Event> {
        if self.wire.phase != Phase::Deciding {
            return None;
        }
        self.accept(cx);
        if self.wire.phase != Phase::Live {
            return None;
        }
        self.wire.joined = true;
        if self.is_advertised(cx) {
            self.pump(cx);
        } else {
            self.publish(cx);
        }
        Some(Event::Joined)
    }

    /// Makes what the hub has published to the peer visible to it, as it is now and as far as the access table lets it be
    /// seen. Returns the serial that comes back with [`Event::Acknowledged`].
    pub fn publish(&mut self, cx: &mut Context<'_, P>) -> u32 {
        let Some(remote) = &self.wire.remote else { return 0 };
        let (functions, publishing, identity) = (cx.functions, &mut self.wire.publishing, &remote.hello.identity);
        cx.hub.enter(&mut |hub| {
            // What was hidden since the last time is withdrawn: a change that comes before the link is live reaches it only here.
            for slot in publishing.all_slots() {
                let is_visible = hub.publications.is_visible(identity, slot);
                publishing.want(slot, functions.generation(slot).filter(|_| is_visible));
            }
            publishing.version = hub.publications.version();
        });
        self.end_of_changes(cx)
    }

    /// Whether anything was published since the last [`publish`](Self::publish) here: where others publish meanwhile, a port
    /// looks once more when they find the link.
    pub fn is_behind(&self, cx: &mut Context<'_, P>) -> bool {
        let mut newest = self.wire.publishing.version;
        cx.hub.enter(&mut |hub| newest = hub.publications.version());
        newest != self.wire.publishing.version
    }

    /// Ends the link because the key of its pair is no longer valid.
    pub fn revoke(&mut self, cx: &mut Context<'_, P>) {
        self.wire.refuse(cx, Refusal::NoKey);
    }

    /// Ends the link in an orderly way; [`poll`](Self::poll) reports what was in flight.
    pub fn close(&mut self, cx: &mut Context<'_, P>, reason: CloseReason) {
        self.wire.close(cx, reason);
    }

    /// The connection below has ended.
    pub fn disconnected(&mut self, reason: CloseReason) {
        self.wire.end(reason);
    }

    /// Asks the peer of a live link for a sign of life.
    fn challenge(&mut self, cx: &mut Context<'_, P>) {
        if self.wire.phase == Phase::Live {
            self.wire.challenged = true;
            self.pings.send(&mut self.wire, cx.now);
            self.wire.flush(cx);
            for _ in 0..CHALLENGE_DATAGRAMS {
                self.wire.send_datagram(cx, &SessionBody::PING, &[]);
            }
        }
    }

    /// The stream takes bytes again.
    pub fn writable(&mut self, cx: &mut Context<'_, P>) {
        self.wire.flush(cx);
        self.renewal.pump(&mut self.wire, cx);
        if P::CALLS {
            self.calling.send_releases(&mut self.wire, cx);
        }
        self.pump(cx);
        if STREAMS {
            self.streaming.send_samples(&mut self.wire, cx);
        }
    }

    /// Asks the peer for a sign of life and measures how long it takes: [`Event::Answered`] comes with it, and
    /// [`round_trip`](Self::round_trip) tells. A ping before it that has not been answered is given up.
    ///
    /// [`Error::NotConnected`] on a link that is not live, [`Error::Full`] where the stream has no room.
    pub fn ping(&mut self, cx: &mut Context<'_, P>) -> Result<(), Error> {
        self.pings.ping(&mut self.wire, cx)
    }

    /// How long the answer to the last [`ping`](Self::ping) took, once it has come.
    pub fn round_trip(&self) -> Option<Duration> {
        self.pings.round_trip()
    }

    /// Makes the keys of a secured link anew each time they are as old as `span`, or up to an eighth younger, instead of
    /// [`HANDSHAKE_LIFE`](crate::config::HANDSHAKE_LIFE); at least
    /// [`SHORTEST_HANDSHAKE_LIFE`](crate::config::SHORTEST_HANDSHAKE_LIFE). Holds from the next handshake on, for the end that
    /// dialled: the other one follows.
    pub fn renew_every(&mut self, span: Duration) {
        self.renewal.renew_every(span);
    }

    /// This unit's claim is another one: the peer is told.
    pub fn announce_claim(&mut self, cx: &mut Context<'_, P>) {
        self.granting.obedience.has_news = true;
        self.pump(cx);
    }

    /// Wants values of a stream of the peer, at least `interval` apart; the peer may grant a longer one, which comes as
    /// [`Event::Subscribed`]. Of several calls for one stream the last one counts. The subscription ends with the link, and when
    /// the peer publishes another stream in its place: a port subscribes again with [`Event::ListChanged`], which changes nothing
    /// where nothing has changed. [`Error::UnknownFunction`] where the peer has no such stream, [`Error::NotConnected`].
    pub fn subscribe(&mut self, cx: &mut Context<'_, P>, stream: &str, interval: Duration) -> Result<Slot, Error> {
        self.streaming.wish(&mut self.wire, cx, stream, Some(interval))
    }

    /// Wants no more values of a stream of the peer.
    pub fn unsubscribe(&mut self, cx: &mut Context<'_, P>, stream: &str) {
        // Where there is no such stream, none comes.
        let _ = self.streaming.wish(&mut self.wire, cx, stream, None);
    }

    /// A stream of this unit has a new value: [`poll`](Self::poll) then sends it where it is due. Whether the peer has any
    /// subscription.
    pub fn stream_changed(&mut self, now: Instant) -> bool {
        self.streaming.changed(&mut self.wire, now)
    }

    /// Streams of this unit that the peer is subscribed to.
    pub fn subscriptions(&self) -> u16 {
        self.streaming.active()
    }

    /// Requests a function of the peer. With `wants_reply`, its end comes as [`Event::Reply`]
    /// under the returned id; without, only a failure comes back.
    ///
    /// Nothing is sent on an error: [`Error::UnknownFunction`], [`Error::Mismatch`], [`Error::MissingArgument`], [`Error::WrongType`],
    /// [`Error::WrongSize`], [`Error::ResultWouldNotFit`], [`Error::TooLarge`], [`Error::TooSoon`], [`Error::Full`],
    /// [`Error::SlowHeart`], [`Error::NotConnected`].
    pub fn request(
        &mut self,
        cx: &mut Context<'_, P>,
        callee: Callee<'_>,
        parameters: &ParametersView,
        options: &RequestOptions,
        wants_reply: bool,
    ) -> Result<CallId, Error> {
        let result = self.calling.request(&mut self.wire, cx, callee, parameters, options, wants_reply);
        match result {
            Ok(_) => self.wire.link.counters.count(LinkCounter::RequestsSent),
            Err(_) => self.wire.link.counters.count(LinkCounter::RequestsWithheld),
        }
        result
    }

    /// A call is made that may have to wait for room: in [`RequestOptions::made`] it keeps its place among those that move the
    /// same thing, and is refused as [`Error::Replaced`] behind a later one.
    pub fn make(&mut self) -> Made {
        self.calling.requests.make()
    }

    /// Whether this unit renews the lease of a call.
    pub fn holds(&self, call: CallId) -> bool {
        self.calling.holds(call)
    }

    /// How long the leases that calls of a function hold last, counted from when the last answer to a renewal came; `None` where
    /// none is renewed. An answer names its call and not its renewal, of which several may be on their way: one that was held up
    /// makes this too long by as much.
    pub fn lease_left(&self, now: Instant, slot: Slot) -> Option<Duration> {
        self.calling.lease_left(now, slot)
    }

    /// A heart has stopped: what names it is released.
    pub fn release_beats(&mut self, cx: &mut Context<'_, P>, beats: Beats) {
        self.calling.release_beats(&mut self.wire, cx, beats);
    }

    /// The caller does not want a call any more: its reply, should it still come, counts as late, and the lease that it
    /// holds, or would begin, is released. Other calls are untouched. Also for a call that has been answered and holds a
    /// lease.
    pub fn cancel(&mut self, cx: &mut Context<'_, P>, id: CallId) {
        self.calling.cancel(&mut self.wire, cx, id);
    }

    /// The caller gives a call up, and still wants to hear its answer: the handler is told and what it moves stops, as by
    /// [`cancel`](Self::cancel), which ends the call where no answer comes in time.
    pub fn cancel_but_wait(&mut self, cx: &mut Context<'_, P>, id: CallId) {
        self.calling.cancel_but_wait(&mut self.wire, cx, id);
    }

    /// Releases all calls of a function of the peer, those that are on their way as well: what they started stops.
    ///
    /// [`Error::Full`] where the peer can be told in no way now: nothing is renewed any more, and it may be tried again.
    pub fn release(&mut self, cx: &mut Context<'_, P>, slot: Slot) -> Result<(), Error> {
        self.calling.release(&mut self.wire, cx, slot)
    }

    /// Writes what has gathered now.
    pub fn flush_gathered(&mut self, cx: &mut Context<'_, P>) {
        self.wire.flush(cx);
    }

    /// How many calls of this unit may be in flight.
    pub fn call_slots(&self) -> usize {
        self.calling.requests.slots()
    }

    /// Lends more slots for calls of this unit, a multiple of those before. Returns the slots that are not needed any
    /// more: the new ones if they are no such multiple.
    pub fn lend_calls(
        &mut self,
        pending: <P::Storage as Storage>::Slice<Option<Pending>>,
    ) -> <P::Storage as Storage>::Slice<Option<Pending>> {
        self.calling.requests.grow(pending)
    }

    /// Slots for calls of the peer that run here, and how many calls of it run or wait.
    pub fn running_slots(&self) -> (usize, u16) {
        (self.calls.slots(), self.calls.held())
    }

    /// Lends more slots for calls of the peer that run here. Returns the slots that are not needed any more: the new ones if
    /// they are fewer than before.
    pub fn lend_running(
        &mut self,
        running: <P::Storage as Storage>::Slice<Option<RunningCall>>,
    ) -> <P::Storage as Storage>::Slice<Option<RunningCall>> {
        self.calls.grow(running)
    }

    /// Lets the peer's list grow to so many functions, and so many bytes of signatures, where the storage has an allocator.
    pub const fn let_list_grow(&mut self, functions: usize, bytes: usize) {
        self.wire.theirs.let_grow(functions, bytes);
    }

    /// Functions of this unit's own list that the peer can be told of.
    pub fn publication_slots(&self) -> usize {
        self.wire.publishing.slots()
    }

    /// Lends more slots for functions of this unit's own list. Returns the slots that are not needed any more: the new
    /// ones if they are fewer.
    pub fn lend_publications(
        &mut self,
        publications: <P::Storage as Storage>::Slice<Publication>,
    ) -> <P::Storage as Storage>::Slice<Publication> {
        self.wire.publishing.grow(publications)
    }

    /// The application has finished what an order of this lease started: no renewal keeps it alive, no hook runs. `false` where
    /// no call of this peer has that order, or it has ended before: that one was not finished, and its hook runs.
    pub fn end_order(&mut self, cx: &mut Context<'_, P>, lease: &Lease, order: Order) -> bool {
        self.granting.end_order(&mut self.wire, cx, lease, order)
    }

    /// Whether the peer has read this unit's list up to `serial`.
    pub fn is_acknowledged(&self, serial: u32) -> bool {
        self.wire.publishing.is_acknowledged(serial)
    }

    /// Hides a function from the peer.
    pub fn withdraw(&mut self, cx: &mut Context<'_, P>, slot: Slot) -> u32 {
        self.wire.publishing.want(slot, None);
        self.end_of_changes(cx)
    }

    /// The access table of the context is another one than before: the peer is told what it may see from here on,
    /// leases end that it may not hold any more, and of what it has published this unit sees what it may. For a live link; before that, what is published is under the new table anyway.
    /// Returns the serial that comes back with [`Event::Acknowledged`].
    pub fn access_changed(&mut self, cx: &mut Context<'_, P>) -> u32 {
        self.wire.publishing.fill_buckets();
        self.granting.cut_forbidden(&mut self.wire, cx);
        let remote = self.wire.remote.as_ref();
        self.wire.theirs.show_only(|name| decide(cx.table(), remote, name, Verb::Publish).is_allowed());
        self.end_of_changes(cx)
    }

    pub(super) fn end_of_changes(&mut self, cx: &mut Context<'_, P>) -> u32 {
        let serial = self.wire.publishing.end_changes();
        self.granting.cut_gone(&mut self.wire, cx);
        self.pump(cx);
        serial
    }

    /// Whether the peer was told of everything up to the unit's newest publication, or will be as soon as there is room.
    pub(super) fn is_advertised(&self, cx: &mut Context<'_, P>) -> bool {
        self.wire.publishing.has_begun() && !self.is_behind(cx)
    }

    /// Changes the limits of this unit; the peer is told.
    pub fn set_constraints(&mut self, cx: &mut Context<'_, P>, constraints: Constraints) {
        self.wire.constraints = constraints;
        self.wire.link.set_message_limit(message_limit(&constraints));
        self.wire.publishing.notify_limits();
        self.pump(cx);
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

#[cfg(test)]
mod tests;
