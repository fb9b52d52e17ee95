//! Feeds what happens on links into the state machines of the unit, and does what they return, as the front page of
//! `cara_core::services` says. Nothing here waits or runs a handler.
//!
//! The large functions are kept apart: merged into their callers, the frames of all of them would lie on the stack at
//! once, though only one runs at a time.

use cara_core::config::Mode;
use cara_core::distribution::authenticator::Authenticator as _;
use cara_core::distribution::claim::{Claim, StoredClaim};
use cara_core::distribution::connection_handler::{ClaimEvent, Command, NodeCounter};
use cara_core::distribution::datagram;
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::identity::{Identity, Role};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{CloseReason, Error, Refusal};
use cara_core::host::mailman::LinkId;
use cara_core::host::port::Port as _;
use cara_core::services::Context;
use cara_core::services::lease::{Lease, Stage};
use cara_core::services::session::Event;
use cara_core::time::{Duration, Instant};
use core::net::SocketAddrV4;
use core::task::Context as TaskContext;

use crate::connection::Progress;
use crate::event::{Name, UnitEvent};
use crate::link::Link;
use crate::machine::{Machine, Started};
use crate::mail::Connection;
use crate::port::{Board, HANDS_OVER, LinkSession};
#[cfg(feature = "streams")]
use crate::readings::came;
use crate::replies::ended;
#[cfg(feature = "details")]
use crate::replies::reported;
use crate::time::now;

/// How long a peer that dialled may take for its hello, and for its proof, if it keeps others from dialling or another one
/// waits for its proof. A slow controller needs most of this for its own part of the proof.
const PATIENCE: Duration = Duration::from_millis(300);
/// Refused links are logged at most this often.
const LOGGED: Duration = Duration::from_secs(1);
/// How often the address is checked, and the cable where another task waits for a change of the network: embassy-net wakes one
/// task only.
const LOOK: Duration = Duration::from_secs(3);
/// The same while there is no address.
const AWAY: Duration = Duration::from_millis(250);

/// What the runner has to do outside of the machine.
pub(crate) enum Job {
    /// Run the safe hook of a service.
    Safe(Slot),
    /// Run the hook for a lost peer.
    Lost,
}

impl<T> Machine<T> {
    /// Whether something has been stopped, or seen to be over, and its safe hook is to run: also by an interrupt, or on another
    /// link than the one that is to end its order.
    pub(crate) fn awaits_hook(&self) -> bool {
        self.moves() && self.functions.iter().any(|function| function.handler.lease.is_some_and(Lease::awaits_hook))
    }

    /// Whether a call of a peer moves something.
    pub(crate) fn moves(&self) -> bool {
        self.links.iter().any(|link| link.session.as_ref().is_some_and(LinkSession::moves))
    }

    /// Whether a call of this function moves something.
    pub(crate) fn moves_by(&self, slot: Slot) -> bool {
        self.links.iter().any(|link| link.session.as_ref().is_some_and(|session| session.moves_by(slot)))
    }

    /// Whether all that is listed stands: nothing moves for a call, and nothing slows down any more.
    fn stands(&self) -> bool {
        let mut leases = self.functions.iter().filter_map(|function| function.handler.lease);
        !self.moves() && leases.all(|lease| lease.stage(now()) == Stage::Dead)
    }

    /// Lets the session of a link do what is due, or look whether it is: `None` when nothing is.
    #[inline(never)]
    pub(crate) fn poll_link(&mut self, index: u16, look: bool) -> Option<Event> {
        let Self { links, mail, pool, functions, reply, access, hub, proof, .. } = self;
        let link = links.get_mut(usize::from(index))?;
        let session = link.session.as_mut()?;
        let access = access.0;
        let mut cx = Context { now: now(), mailman: mail, buffers: pool, functions, access, hub, keys: proof };
        if cx.now < session.deadline() && !look {
            return None;
        }
        let event = session.poll(&mut cx)?;
        ended(link, reply, &event, &[]);
        #[cfg(feature = "details")]
        reported(link, reply, &event, &[]);
        #[cfg(feature = "streams")]
        came(&self.readings, link, now(), &event, &[]);
        Some(event)
    }

    /// Reads what has arrived on a link: `None` when there was nothing that led anywhere.
    pub(crate) fn read_link(
        &mut self,
        index: u16,
        scratch: &mut [u8],
        arguments: Option<&mut ParametersView>,
    ) -> Option<Option<Event>> {
        let Self { links, mail, pool, functions, reply, access, hub, proof, .. } = self;
        let link = links.get_mut(usize::from(index))?;
        // There is one place for a reply. While a task has not taken the last one, a link that may bring another one is not read.
        let holds_back = reply.is_taken() && link.awaits_reply();
        let session = link.session.as_mut()?;
        if holds_back {
            session.hold_back();
            return None;
        }
        let peeked = mail.connections.get_mut(usize::from(index))?.peek(scratch);
        let lent = scratch.get_mut(..peeked)?;
        let access = access.0;
        let mut cx = Context { now: now(), mailman: mail, buffers: pool, functions, access, hub, keys: proof };
        let receipt = session.receive(&mut cx, lent, arguments);
        if let Some(event) = &receipt.event {
            ended(link, reply, event, lent);
            #[cfg(feature = "details")]
            reported(link, reply, event, lent);
            #[cfg(feature = "streams")]
            came(&self.readings, link, now(), event, lent);
        }
        mail.connections.get_mut(usize::from(index))?.take(receipt.consumed);
        (receipt.consumed > 0 || receipt.event.is_some()).then_some(receipt.event)
    }

    /// Whether no link has anything left to read, or a call to begin.
    pub(crate) fn has_read_all(&self) -> bool {
        self.links.iter().zip(self.mail.connections.iter()).all(|(link, line)| {
            let session = link.session.as_ref();
            line.has_been_read()
                && session.is_none_or(|session| {
                    !session.holds_received() && !session.has_next_call() && !session.has_next_emergency()
                })
        })
    }

    /// Takes a datagram that has arrived: `None` when there is none.
    #[inline(never)]
    pub(crate) fn read_datagram(
        &mut self,
        scratch: &mut [u8],
        context: &mut TaskContext<'_>,
    ) -> Option<Option<(u16, Event)>> {
        let Some((length, from)) = self.mail.receive(scratch, context)? else {
            self.hub.node.counters.count(NodeCounter::DatagramMalformed);
            return Some(None);
        };
        let bytes = scratch.get_mut(..length).unwrap_or_default();
        let (mode, fleet) = (self.proof.codes().mode(), self.hub.node.fleet());
        if let Some((LinkId(link), nonce, body)) = datagram::for_session(bytes, mode, fleet)
            && let Some(event) = self.with(link, |session, cx| session.datagram(cx, from, nonce, body))
        {
            return Some(event.map(|event| (link, event)));
        }
        self.hub.node.datagram(now(), from, bytes, self.proof.codes());
        if let Some(address) = self.hub.node.take_duplicate() {
            let peer = Some(self.hub.node.identity().clone());
            let reason = CloseReason::Refused(Refusal::DuplicateIdentity);
            self.notify(UnitEvent::NotJoined { address, peer, reason });
        }
        Some(None)
    }

    /// Does what the node wants done about claims; whether anything was.
    #[inline(never)]
    pub(crate) fn look_at_claims(&mut self) {
        match self.hub.node.take_claim_event() {
            None => {}
            Some(ClaimEvent::Keep(manager, tagged)) => self.unstored = Some((manager, tagged)),
            Some(ClaimEvent::Unkept(peer, claim)) => self.notify(UnitEvent::ClaimNotKept { peer, claim }),
            Some(ClaimEvent::Raise(above)) if Board::MANAGES => {
                let claimant = self.proof.seed();
                self.raise_claim(above.raised(claimant));
            }
            Some(ClaimEvent::StepDown(by)) if Board::MANAGES => {
                self.stop();
                self.notify(UnitEvent::Fenced { claim: by.claim });
            }
            Some(_) => {}
        }
        // Writing to flash may hold up the processor.
        if self.stands()
            && let Some((manager, tagged)) = self.unstored.take()
        {
            let away = self.hub.node.handed_over(&manager);
            let key = match away {
                Some((home, present)) if HANDS_OVER && present == manager => self.proof.key_away(&present, &home),
                _ => self.proof.key_of(&manager),
            };
            let stored = self.store.zip(key).is_some_and(|(store, key)| store(&StoredClaim { tagged, key }));
            self.hub.node.claim_kept(&manager, tagged.claim, stored);
        }
        if HANDS_OVER && let Some((peer, stage)) = self.hub.node.take_hand_over() {
            self.notify(UnitEvent::HandOver { peer, stage });
        }
    }

    /// The claim of an m_unit, and what a vehicle has stored; [`Error::NoOwnKey`] for an m_unit that has no key with itself.
    #[inline(never)]
    pub(crate) fn begin_claims(
        &mut self,
        claim: Claim,
        manager: Option<&Identity>,
        obeyed: &StoredClaim,
    ) -> Result<(), Error> {
        if Board::MANAGES && self.hub.node.identity().role() == Role::MUnit {
            let tagged = claim.tagged(self.hub.node.identity(), self.proof.codes()).ok_or(Error::NoOwnKey)?;
            self.hub.node.set_claim(tagged);
        }
        if let Some(manager) = manager.filter(|_| self.store.is_some() && self.proof.mode() == Mode::Secured) {
            let away = if HANDS_OVER { self.proof.manager_away(manager, &obeyed.key) } else { None };
            if let Some(present) = &away {
                self.hub.node.belong_to(manager, present);
            }
            let is_known = away.is_some() || self.proof.has_key(manager, &obeyed.key);
            if is_known && obeyed.tagged.claim != Claim::NONE {
                self.hub.node.keep_obeyed(now(), away.as_ref().unwrap_or(manager), obeyed.tagged);
            }
            self.hub.node.store_claims();
        }
        Ok(())
    }

    /// An m_unit's claim is stored, and counts from then on.
    fn raise_claim(&mut self, claim: Claim) {
        let identity = self.hub.node.identity().clone();
        let Some(tagged) = claim.tagged(&identity, self.proof.codes()) else { return };
        if let Some(store) = self.store_own {
            // A write to flash may hold up the renewals of its orders with other vehicles for longer than they last.
            let renews = self.links.iter().any(|link| link.session.as_ref().is_some_and(LinkSession::renews));
            if renews || !self.stands() {
                return self.hub.node.not_raised(now());
            }
            if !store(claim) {
                self.hub.node.counters.count(NodeCounter::ClaimsNotKept);
                return self.notify(UnitEvent::ClaimNotKept { peer: identity, claim });
            }
        }
        self.hub.node.set_claim(tagged);
        for index in self.indices() {
            self.with(index, |session, cx| session.announce_claim(cx));
        }
        self.hub.node.broadcast(now());
        self.notify(UnitEvent::Raised { claim });
    }

    /// Ends every connection in an orderly way, and searches no more.
    pub(crate) fn stop(&mut self) {
        self.stopped = true;
        for index in self.indices() {
            self.with(index, |session, cx| session.close(cx, CloseReason::StoppedHere));
        }
    }

    /// Looks what became of the sockets.
    #[inline(never)]
    pub(crate) fn look_at_lines(&mut self) {
        let now = now();
        for index in self.indices() {
            let Some(line) = self.mail.connections.get_mut(usize::from(index)) else { continue };
            match line.progress(now) {
                Progress::None => {}
                Progress::Connected => {
                    self.with(index, |session, cx| session.connected(cx));
                }
                Progress::Broken => self.disconnected(index, CloseReason::DialFailed),
                Progress::Accepted(_) if !Board::MANAGES => self.hang_up(index),
                Progress::Accepted(from) => match self.open(index, from, false) {
                    Some(()) => {
                        self.with(index, |session, cx| session.connected(cx));
                    }
                    None => self.hang_up(index),
                },
            }
            if self.mail.connections.get(usize::from(index)).is_some_and(Connection::has_ended) {
                self.disconnected(index, CloseReason::Reset);
            }
        }
        if Board::MANAGES {
            self.show_one_out(now);
            self.listen();
        }
    }

    /// Closes the oldest link without a proof, if no socket listens, because the stack then refuses dials; and if there
    /// is a second one without a proof, since a board handles one proof at a time.
    fn show_one_out(&mut self, now: Instant) {
        let mut pending = self.pending();
        let Some(first) = pending.next() else { return };
        let second = pending.next();
        if second.is_none() && self.mail.connections.iter().any(Connection::takes_connections) {
            return;
        }
        let (since, index) = pending.chain(second).fold(first, core::cmp::min);
        if now >= since + PATIENCE {
            self.hub.node.counters.count(NodeCounter::GaveWay);
            self.with(index, |session, cx| session.close(cx, CloseReason::HelloTimeout));
        }
    }

    fn disconnected(&mut self, index: u16, reason: CloseReason) {
        if let Some(session) = self.link_mut(index).and_then(|link| link.session.as_mut()) {
            session.disconnected(reason);
        }
    }

    fn hang_up(&mut self, index: u16) {
        let up = self.address.is_some();
        if let Some(line) = self.mail.connections.get_mut(usize::from(index)) {
            if up { line.close() } else { line.abort() }
        }
    }

    /// Writes what waits for room, where there is some now.
    pub(crate) fn write_links(&mut self) {
        for index in self.indices() {
            let wants =
                self.link(index).and_then(|link| link.session.as_ref()).is_some_and(LinkSession::wants_to_write);
            if wants && self.mail.connections.get(usize::from(index)).is_some_and(Connection::can_write) {
                self.with(index, |session, cx| session.writable(cx));
            }
        }
    }

    /// The cable was pulled or plugged in, or the address changed: every connection is dead, whatever TCP still hopes.
    #[inline(never)]
    pub(crate) fn look_at_network(&mut self, context: &mut TaskContext<'_>) {
        let now = now();
        // Not each time: it wakes another task that waits for a change, which then takes the place, and wakes this one.
        if now >= self.look {
            self.look = now + if self.address.is_some() { LOOK } else { AWAY };
            self.mail.wake_on_change(context);
        } else if self.address.is_some() && !self.mail.is_cut() {
            return;
        }
        let address = self.mail.address();
        if address == self.address {
            return;
        }
        let was_away = core::mem::replace(&mut self.address, address).is_none();
        log!("the address is now {:?}", address.map(|address| address.octets()));
        if address.is_some() {
            self.hub.node.network_changed(now);
        }
        // That there is one at last is no news at the start.
        if core::mem::replace(&mut self.has_started, true) {
            self.notify(UnitEvent::NetworkChanged { up: address });
        }
        for index in self.indices() {
            // Frames pass before a driver that asks for its cable now and then reports it: this link is of the new address.
            if was_away && self.link(index).is_some_and(Link::is_live) {
                continue;
            }
            self.disconnected(index, CloseReason::Reset);
            if let Some(line) = self.mail.connections.get_mut(usize::from(index)) {
                line.abort();
            }
        }
    }

    /// Does what an event asks for, or leaves it to the runner.
    pub(crate) fn recorded(&mut self, index: u16, event: Event) -> Option<Job> {
        #[cfg(feature = "streams")]
        self.note_subscriptions(index, &event);
        match event {
            // No handle here pings.
            Event::Reply(..) | Event::Answered => {}
            Event::Incoming(call) => (self.started, self.started_on) = (Started::Call(call), index),
            Event::Closed(reason) => return self.closed(index, reason),
            Event::Acknowledged { skipped: 0, .. } => self.wakers.news.wake(),
            Event::LeaseExpired(slot) => {
                self.notify_of(index, event);
                self.wakers.leases.wake();
                return Some(Job::Safe(slot));
            }
            // A task that waits for the end of its call looks again.
            #[cfg(feature = "details")]
            Event::Cancelled(_) => self.wakers.leases.wake(),
            event => self.notify_of(index, event),
        }
        None
    }

    #[inline(never)]
    fn notify_of(&mut self, index: u16, event: Event) {
        let Some(session) = self.link(index).and_then(|link| link.session.as_ref()) else { return };
        let name = |name: &str| Name::try_from(name).unwrap_or_default();
        let Some(reported) = UnitEvent::of(event, session, &self.functions, name) else { return };
        match &reported {
            UnitEvent::Joined { peer } => log!("{} has joined", peer.name()),
            UnitEvent::Left { peer, .. } => log!("{} has left", peer.name()),
            UnitEvent::NotJoined { peer, reason, .. } => self.log_refused(peer.as_ref(), *reason),
            _ => {}
        }
        self.notify(reported);
    }

    /// Does what the hub wants done.
    pub(crate) fn act(&mut self, command: Command<SocketAddrV4>) {
        match command {
            Command::Dial { to, identity } => self.dial(to, identity.as_ref()),
            Command::Notify(LinkId(index), directive) => {
                if let Some(Some(event)) = self.with(index, |session, cx| session.direct(cx, directive)) {
                    self.notify_of(index, event);
                }
            }
        }
    }

    #[inline(never)]
    fn dial(&mut self, to: SocketAddrV4, identity: Option<&Identity>) {
        let dialed = self.free_link().filter(|index| {
            let line = self.mail.connections.get_mut(usize::from(*index));
            line.is_some_and(|line| line.dial(to))
        });
        match dialed {
            Some(index) => {
                if self.open(index, to, true).is_some() {
                    self.hub.node.dialing(identity, LinkId(index));
                }
            }
            None => self.hub.node.dial_failed(now(), identity),
        }
    }

    /// A link has ended.
    fn closed(&mut self, index: u16, reason: CloseReason) -> Option<Job> {
        self.notify_of(index, Event::Closed(reason));
        let had_joined = self.end(index)?;
        // Calls that no task has taken yet must not begin for a caller that is gone.
        self.forget_calls_of(index);
        #[cfg(feature = "details")]
        self.wakers.leases.wake();
        self.hang_up(index);
        self.hub.node.left(now(), LinkId(index), reason);
        had_joined.then_some(Job::Lost)
    }

    /// Peers can make links end in this way as fast as they can dial, so the log is rate-limited.
    fn log_refused(&mut self, reported: Option<&Identity>, reason: CloseReason) {
        let now = now();
        if now >= self.logged {
            self.logged = now + LOGGED;
            log!("{} could not join, or be joined: {:?}", reported.map_or("somebody", Identity::name), reason);
        }
    }

    /// Gets the memory of a link's session back. Whether its peer had joined.
    #[inline(never)]
    fn end(&mut self, index: u16) -> Option<bool> {
        let Self { links, pool, counters, .. } = self;
        let link = links.get_mut(usize::from(index))?;
        let session = link.session.take()?;
        counters.merge(session.counters());
        let had_joined = session.peer().is_some();
        link.storage = Some(session.into_storage(pool));
        link.interrupt();
        link.reported = None;
        link.serial = link.serial.wrapping_add(1);
        Some(had_joined)
    }
}
