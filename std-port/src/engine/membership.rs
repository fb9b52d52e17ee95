//! The node and its links: opening, accepting, admitting, leaving, and what is published to which node.

use std::cmp::Reverse;
use std::collections::HashMap;
use std::sync::Arc;

use cara_core::distribution::connection_handler::{Command, NodeCounter};
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::identity::Identity;
use cara_core::error::{CloseReason, Error, Limit, Refusal};
use cara_core::host::mailman::LinkId;
use cara_core::services::lease::ActuatorState;
use cara_core::services::session::{Event, Session, SessionConfig};
use cara_core::time::{Duration, Instant};
use core::net::{IpAddr, SocketAddr};

use super::Engine;
use super::link::{LinkCell, LinkState, StdMailman};
use super::peer_cell::PeerCell;
use super::reader::Cause;
use super::streams::Watched;
use super::tables::{self, session_storage};
use super::tape::{LIMITS, OFFERS, Tape, TapedSession};
use crate::event::UnitEvent;
use crate::seldom::warn_seldom;
use crate::sys::datagram::Socket;
use crate::sys::epoll::Interest;
use crate::sys::limits;
use crate::sys::stream::Stream;
use crate::threads::DATAGRAM;

/// Descriptors that are reserved for proven links and the control socket.
const KEPT_FOR_PROVEN: u64 = 24;
/// Of these, the ones that only the control socket, key files and dialling use: two for each operator's connection, and some more.
const KEPT_FOR_OPERATOR: u64 = 20;

/// The node that a link is dialled for, as far as it is known.
struct Dialed<'i>(Option<&'i Identity>);

impl<T: Send + 'static> Engine<T> {
    /// Puts a stream into the table of links. `None` when the table is full.
    fn open_link(&self, mut stream: Stream, address: SocketAddr, dialed: Option<Dialed<'_>>) -> Option<Arc<LinkCell>> {
        let mut links = self.links.table_mut();
        let index = links.iter().position(Option::is_none)?;
        let id = LinkId(u16::try_from(index).ok()?);
        let now = self.now();
        let storage = session_storage(&self.links.capacities, self.services.own_functions());
        let (serial, hello, constraints) = {
            let mut cell = self.hub.lock();
            let serial = cell.open(id);
            let node = &mut cell.hub.node;
            if let Some(Dialed(identity)) = dialed {
                node.dialing(identity, id);
            }
            let nonce = node.nonce();
            (serial, node.hello(now, id, nonce), *node.constraints())
        };
        let nonce = hello.nonce;
        let dialed = dialed.is_some();
        let config = SessionConfig { link: id, dialed, address, nonce, constraints };
        let mut session = Session::new(now, config, self.keys().cipher(), storage);
        let capacities = &self.links.capacities;
        session.let_list_grow(capacities.their_functions, capacities.their_signature_bytes);
        if let Some(span) = self.key_watch.renews_every() {
            session.renew_every(span);
        }
        let tape = self.core_recordings.as_ref().and_then(|folder| {
            let path = folder.join(format!("{serial}.core"));
            let started = Tape::start(&path, now, &hello, (dialed, address), &constraints, capacities);
            started
                .inspect_err(|error| warn_seldom!(path = %path.display(), "no core session is recorded: {error}"))
                .ok()
        });
        let session = TapedSession::new(session, tape);
        stream.spin(self.spin);
        let link = Arc::new(LinkCell::new(self.driver.unit_number()?, id, serial, stream, session, dialed));
        *links.get_mut(index)? = Some(link.clone());
        drop(links);
        let interest = if dialed { Interest::READ_EDGE.and_writable() } else { Interest::READ_EDGE };
        if self.driver.pool().epoll.add(&link.stream, link.token(), interest).is_err() {
            link.lock().session.disconnected(CloseReason::DialFailed);
        }
        self.settle(&link, link.lock());
        Some(link)
    }

    pub(super) fn accepted(&self, stream: Stream, address: SocketAddr) {
        let mut stream = stream;
        if limits::left_above(&stream) < KEPT_FOR_PROVEN && self.make_room() {
            // Moved to the descriptor that is free now, so that the number of the next one shows when too many are open.
            stream = stream.with_lowest_number();
        }
        if limits::left_above(&stream) < KEPT_FOR_OPERATOR {
            self.accounts.connection_refused();
            warn_seldom!(%address, "a connection was dropped: too few descriptors are left; raise the limit (ulimit -n)");
            return;
        }
        if self.links.is_full() {
            self.make_room();
        }
        if self.open_link(stream, address, None).is_none() {
            self.accounts.connection_refused();
            warn_seldom!(%address, "a connection was dropped: {}", Limit::Links);
        }
    }

    /// Ends a link whose peer has proven nothing, so that connections that say nothing keep no others out: of the
    /// host that has most of them, the one that has waited longest. One whose hello waits to be read has spoken.
    /// Whether there was one.
    pub(super) fn make_room(&self) -> bool {
        let mut unproven = self.unproven();
        let mut of_host: HashMap<IpAddr, usize> = HashMap::new();
        unproven.iter().for_each(|(host, _)| *of_host.entry(*host).or_default() += 1);
        unproven.sort_unstable_by_key(|(host, link)| (Reverse(of_host.get(host).copied()), link.serial));
        for (_, link) in unproven {
            let Some(mut state) = link.try_lock() else { continue };
            if state.session.is_proven() || link.stream.has_unread() {
                continue;
            }
            self.with(&link, &mut state, |session, cx| session.close(cx, CloseReason::HelloTimeout));
            self.settle(&link, state);
            self.hub.lock().hub.node.counters.add(NodeCounter::GaveWay, 1);
            return true;
        }
        false
    }

    /// Links that others have opened and that have proven nothing, with the hosts they come from. One in use is left out.
    fn unproven(&self) -> Vec<(IpAddr, Arc<LinkCell>)> {
        let host = |link: &Arc<LinkCell>| {
            let state = link.try_lock()?;
            let is_unproven = !state.session.dialed() && !state.session.is_proven();
            is_unproven.then(|| state.session.address().ip())
        };
        let mut links = self.links.all();
        links.retain(|link| link.peer.get().is_none());
        links.into_iter().filter_map(|link| Some((host(&link)?, link))).collect()
    }

    fn dial(&self, to: SocketAddr, identity: Option<&Identity>) {
        let stream = Stream::connect(to, self.sockets.shortens(to.ip()));
        let stream = stream.map_err(|errno| self.unjoined.dial_ended(Some(errno.into()))).ok();
        if stream.and_then(|stream| self.open_link(stream, to, Some(Dialed(identity)))).is_none() {
            self.hub.lock().hub.node.dial_failed(self.now(), identity);
            let (peer, reason) = (identity.cloned(), CloseReason::DialFailed);
            self.notify(UnitEvent::NotJoined { address: to, peer, reason });
        }
        self.driver.wake();
    }

    /// Another live unit has this one's identity.
    pub(super) fn duplicate_heard(&self, address: SocketAddr) {
        if self.claims.stands_by() {
            // As where two of them start at once.
            return tracing::info!(%address, "another manager of this name and id commands too: the one with the lower claim stands by next");
        }
        let refusal = Refusal::DuplicateIdentity;
        let own = self.hub.lock().hub.node.identity().clone();
        warn_seldom!(%address, name = own.name(), id = own.id(), "{refusal}");
        self.notify(UnitEvent::NotJoined { address, peer: Some(own), reason: CloseReason::Refused(refusal) });
    }

    /// The connection that this unit opened is there, or could not be opened.
    pub(super) fn connected(&self, link: &Arc<LinkCell>, state: &mut LinkState) {
        match link.stream.finish_connect() {
            Ok(false) => {}
            Ok(true) => {
                self.links.read_by(self.now(), link, state, Cause::Opened);
                self.with(link, state, |session, cx| session.connected(cx));
            }
            Err(reason) => {
                self.links.read_by(self.now(), link, state, Cause::Opened);
                state.session.disconnected(reason);
            }
        }
    }

    /// The hub has taken the peer, which has its place from here on.
    pub(super) fn joined(&self, link: &Arc<LinkCell>, state: &mut LinkState) {
        let Some(identity) = state.session.identity().cloned() else { return };
        let limit = usize::from(self.hub.lock().hub.node.constraints().maximum_nodes);
        let peer = self.nodes.write().join(&identity, limit, link);
        if let Some(own) = peer.own_constraints(*state.session.constraints()) {
            self.with(link, state, |session, cx| session.unrecorded(LIMITS).set_constraints(cx, own));
        }
        let _ = link.peer.set(peer);
        // Who publishes from here on finds the peer, and waits for this link's lock to tell it. What was published before,
        // and after the session looked, or found no room in it, is told now.
        let grew = tables::make_publication_room(state, self.services.own_functions());
        self.with(link, state, |session, cx| {
            if grew || session.is_behind(cx) {
                session.publish(cx);
            }
        });
        state.notices.push(Event::Joined);
    }

    /// Does what an event asks for, and tells it.
    pub(super) fn act_on(&self, link: &Arc<LinkCell>, event: Event) {
        if let Event::Closed(reason) = event {
            return self.link_ended(link, reason);
        }
        if let Event::Actuator { slot, state } = event {
            return self.actuator_reported(link, slot, state);
        }
        match event {
            Event::Sample(_) => {
                if link.peer.get().is_some_and(|peer| peer.streams.pass_on(self.now())) {
                    self.stream_published();
                }
                return;
            }
            Event::Subscribed(slot, answer) => {
                if let Some((peer, name)) = link.peer.get().zip(link.their_function(slot)) {
                    peer.streams.answered(&name, answer);
                }
                return;
            }
            Event::ListChanged => {
                // What is read of it is subscribed to.
                if let Some(peer) = link.peer.get() {
                    peer.streams.all().iter().for_each(|watched| self.tell_interval_on(link, peer, watched));
                    self.look_for_clock(link);
                }
            }
            _ => {}
        }
        self.notify_of(link, event);
        if let Event::Answered | Event::Acknowledged { .. } = event {
            link.notify();
        }
    }

    /// The peer has told the state of what a function moves. Subscribers hear of its latch alone.
    fn actuator_reported(&self, link: &LinkCell, slot: Slot, state: ActuatorState) {
        let mut held = link.lock();
        let before = held.actuators.insert(slot, state).unwrap_or_default();
        let name = held.session.their_function_list().function(slot).map(|function| function.name().to_owned());
        drop(held);
        link.notify();
        let Some(peer) = link.peer.get().filter(|_| before.latch != state.latch) else { return };
        if let Some(function) = name {
            self.notify(UnitEvent::Inhibited { peer: peer.identity.clone(), function, latch: state.latch });
        }
    }

    /// Tells subscribers of an event on a link.
    fn notify_of(&self, link: &LinkCell, event: Event) {
        let reported = UnitEvent::of(event, &link.lock().session, &*self.services.functions(), str::to_owned);
        reported.into_iter().for_each(|event| self.notify(event));
    }

    /// The link's id is free for another link only when nothing here means the old one by it any more.
    fn link_ended(&self, link: &Arc<LinkCell>, reason: CloseReason) {
        let (host, dialed) = {
            let mut state = link.lock();
            // It is not put back.
            state.registration.is_out = false;
            let _ = self.driver.pool().epoll.remove(&link.stream);
            (state.session.address().ip(), state.session.dialed())
        };
        self.sockets.note_segments(host, dialed, reason);
        self.accounts.retire(link);
        if let Some(peer) = link.peer.get() {
            peer.leave(link, reason);
            self.services.run_lost_hook();
        }
        self.unjoined.dial_ended(super::unjoined::dial_error(link, reason));
        self.notify_of(link, Event::Closed(reason));
        self.links.cancel_timer(link.id);
        self.hub.lock().hub.node.left(self.now(), link.id, reason);
        self.links.remove(link);
        // The hub may have something to do earlier than before.
        self.driver.wake();
    }

    /// Passes on what the hub wants done, to the link that it meant and to no other.
    fn carry_out(&self, command: Command<SocketAddr>, serial: Option<u32>) {
        match command {
            Command::Dial { to, identity } => self.dial(to, identity.as_ref()),
            Command::Notify(id, directive) => {
                let Some(link) = self.link_of(id, serial) else { return };
                let mut state = link.lock();
                let event = self.with(&link, &mut state, |session, cx| session.direct(cx, directive));
                if let Some(Event::Joined) = event {
                    self.joined(&link, &mut state);
                    // What follows the hello has waited.
                    self.feed(self.now(), &link, &mut state, &mut [], None, None);
                }
                self.settle(&link, state);
            }
        }
    }

    /// The link that a command means, unless that one has ended: another may have got its place.
    fn link_of(&self, id: LinkId, serial: Option<u32>) -> Option<Arc<LinkCell>> {
        self.links.get(id).filter(|link| Some(link.serial) == serial)
    }

    /// Searches for nodes now (paper, listing line 6).
    pub(crate) fn broadcast(&self) {
        self.hub.lock().hub.node.broadcast(self.now());
        self.driver.wake();
    }

    /// Makes all functions of the unit's list visible: to one node, or to all and those that come later. Returns the
    /// links that are to acknowledge, each with its serial.
    pub(crate) fn publish(&self, to: Option<&Identity>) -> Result<Vec<(Arc<LinkCell>, u32)>, Error> {
        let slots: Vec<Slot> = self.services.functions().iter().map(|function| function.slot).collect();
        {
            let publications = &mut self.hub.lock().hub.publications;
            for &slot in &slots {
                match to {
                    None => publications.publish_to_all(slot)?,
                    Some(identity) => publications.publish_to(identity, slot)?,
                }
            }
        }
        let peers: Vec<_> = self.nodes.read().connected().cloned().collect();
        let chosen = peers.into_iter().filter(|peer| to.is_none_or(|identity| peer.identity == *identity));
        Ok(chosen.filter_map(|peer| self.publish_on(&peer.link()?)).collect())
    }

    fn publish_on(&self, link: &Arc<LinkCell>) -> Option<(Arc<LinkCell>, u32)> {
        let mut state = link.lock();
        if !state.session.is_live() {
            return None;
        }
        tables::make_publication_room(&mut state, self.services.own_functions());
        let serial = self.with(link, &mut state, |session, cx| session.publish(cx));
        self.settle(link, state);
        Some((link.clone(), serial))
    }

    /// Removes a function: its slot's callers learn that it is gone.
    pub(crate) fn remove_function(&self, name: &str) -> Result<(), Error> {
        let (slot, _) = self.services.functions_mut().remove(name)?;
        self.hub.lock().hub.publications.withdraw(slot);
        self.on_each_link(|session, cx| {
            session.unrecorded(OFFERS).withdraw(cx, slot);
        });
        Ok(())
    }

    /// A stream of this unit has a new value: it goes to each node whose turn it is.
    pub(crate) fn stream_published(&self) {
        for link in self.links.all() {
            if !link.has_subscriptions() {
                continue;
            }
            let mut state = link.lock();
            if state.session.unrecorded(OFFERS).stream_changed(self.now()) {
                self.settle(&link, state);
            }
        }
    }

    /// A node is told at which interval its stream is read here, if it still is.
    pub(crate) fn tell_interval(&self, peer: &PeerCell, watched: &Watched) {
        if let Some(link) = peer.link() {
            self.tell_interval_on(&link, peer, watched);
        }
    }

    fn tell_interval_on(&self, link: &Arc<LinkCell>, peer: &PeerCell, watched: &Watched) {
        // Read under the lock of the link, so that of two threads the later one sends the newest interval.
        let reported = self.on_link(link, |session, cx| match peer.streams.interval(&watched.name) {
            Some(interval) => session.subscribe(cx, &watched.name, interval).map(drop),
            None => {
                session.unsubscribe(cx, &watched.name);
                Ok(())
            }
        });
        if let Err(error @ Error::UnknownFunction) = reported {
            watched.was_answered(Err(error));
        }
    }

    /// Waits until each peer has read what it was told, at most until `timeout`; returns those that have not.
    pub(crate) fn await_acknowledgements(
        &self,
        reported: &[(Arc<LinkCell>, u32)],
        timeout: Duration,
    ) -> Vec<Arc<LinkCell>> {
        let deadline = self.now() + timeout;
        let missing = reported.iter().filter(|(link, serial)| !self.await_acknowledgement(link, *serial, deadline));
        missing.map(|(link, _)| link.clone()).collect()
    }

    fn await_acknowledgement(&self, link: &LinkCell, serial: u32, deadline: Instant) -> bool {
        let mut state = link.lock();
        loop {
            let now = self.now();
            if state.session.is_acknowledged(serial) || !state.session.is_live() || now >= deadline {
                return state.session.is_acknowledged(serial);
            }
            state = state.wait(&link.room, deadline.since(now));
        }
    }

    /// Lends the node the mailman of the unit's datagrams.
    pub(super) fn poll_node(&self) -> Instant {
        // Before the node's lock: a thread that reads a new key file keeps the ring to itself meanwhile.
        let codes = self.keys().codes();
        if self.hub.lock().hub.node.searches_at() <= self.now() {
            // Discovery datagrams may lie unread for as long as this thread was busy with other units.
            let mut buffer = [0; DATAGRAM];
            let emptied = [Socket::Shared, Socket::Own].map(|socket| self.datagrams_ready(socket, &mut buffer));
            if emptied != [true; 2] {
                self.hub.lock().hub.node.left_unread();
            }
        }
        loop {
            let (command, serial) = {
                let mut cell = self.hub.lock();
                let mut mailman = StdMailman { stream: None, datagrams: &self.sockets.datagrams };
                let Some(command) = cell.hub.node.poll(self.now(), &mut mailman, &codes) else {
                    return cell.hub.node.next_deadline();
                };
                let serial = cell.serial_of(&command);
                (command, serial)
            };
            self.carry_out(command, serial);
        }
    }
}

#[cfg(test)]
mod tests {
    use cara_core::config::Constraints;

    use super::*;
    use crate::testing::{fleet, manager, until, vehicle};

    /// A link ends after the hub has said what is to become of it: the command is not for the link that has got its place.
    #[test]
    fn a_command_for_a_link_that_has_ended_reaches_no_other_link() {
        let fleet = fleet();
        let manager = manager(fleet, Constraints::M_UNIT);
        let engine = manager.engine();
        let first = vehicle(fleet, 1, Constraints::S_UNIT);
        first.start().unwrap();
        until(|| manager.number_of_s_units() == 1);
        let ended = engine.links.all().remove(0);
        let serial = engine.hub.lock().serials.get(&ended.id).copied();
        assert!(engine.link_of(ended.id, serial).is_some_and(|link| Arc::ptr_eq(&link, &ended)));
        first.stop();
        until(|| manager.number_of_s_units() == 0);
        until(|| engine.links.get(ended.id).is_none());
        let second = vehicle(fleet, 2, Constraints::S_UNIT);
        second.start().unwrap();
        until(|| manager.number_of_s_units() == 1);
        let newcomer = engine.links.all().remove(0);
        assert_eq!((newcomer.id, newcomer.serial != ended.serial), (ended.id, true), "it has the same index");
        assert!(engine.link_of(ended.id, serial).is_none());
        let its_own = engine.hub.lock().serials.get(&newcomer.id).copied();
        assert!(engine.link_of(newcomer.id, its_own).is_some());
    }
}
