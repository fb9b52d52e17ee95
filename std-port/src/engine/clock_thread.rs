//! The thread that keeps time: timers of links and of the node, datagrams, and new connections. It runs no handlers and no
//! hooks, never sleeps, and looks at no file: [`look_around`](crate::threads::Driven::look_around) has a thread of its own.

use cara_core::distribution::claim::Claim;
use cara_core::distribution::connection_handler::ClaimEvent;
use cara_core::distribution::datagram;
use cara_core::distribution::identity::Role;
use cara_core::error::CloseReason;
use cara_core::time::Instant;
use core::net::SocketAddr;
use std::sync::Arc;

use super::Engine;
use super::claims::{Job, Written};
use super::link::LinkCell;
use super::worker::Worker;
use crate::event::UnitEvent;
use crate::seldom::warn_seldom;
use crate::sys::datagram::Socket;
use crate::sys::epoll::Ready;
use crate::sys::stream::Accepted;
use crate::threads::Driven;

/// Datagrams and connections that are taken in a row before timers are looked at again.
const BATCH: usize = 256;

impl<T: Send + 'static> Engine<T> {
    /// Polls every link that is due; returns when the next one is.
    pub(super) fn poll_links(&self) -> Instant {
        loop {
            let due = match self.links.due(self.now()) {
                Ok(due) => due,
                Err(next) => return next,
            };
            let Some(link) = self.links.get(due) else { continue };
            let mut state = link.lock();
            state.timer = Instant::FAR_FUTURE;
            if state.is_paused() {
                self.feed(self.now(), &link, &mut state, &mut [], None, None);
                if state.session.has_next_call() {
                    self.hand_over(&link);
                }
            }
            // Also before its deadline, where another thread wants it looked at.
            let waited = state.session.awaits_claim();
            self.poll_session(&link, &mut state);
            if waited && state.session.has_next_call() {
                self.hand_over(&link);
            }
            self.settle(&link, state);
        }
    }

    /// Takes some datagrams of a socket. Whether none is left.
    pub(super) fn datagrams_ready(&self, socket: Socket, buffer: &mut [u8]) -> bool {
        for _ in 0..BATCH {
            let Some((count, from)) = self.sockets.datagrams.receive(socket, buffer) else { return true };
            self.datagram(from, buffer.get_mut(..count).unwrap_or_default());
        }
        false
    }

    pub(super) fn datagram(&self, from: SocketAddr, bytes: &mut [u8]) {
        if let Some((link, nonce, body)) = datagram::for_session(bytes, self.keys().mode(), self.fleet)
            && let Some(link) = self.links.get(link)
        {
            return self.session_datagram(&link, from, nonce, body);
        }
        let codes = self.keys().codes();
        let (duplicate, seeker) = {
            let mut cell = self.hub.lock();
            cell.hub.node.datagram(self.now(), from, bytes, &codes);
            let seeker = cell.hub.node.asked_by().map(|(who, from)| (who.clone(), from));
            (cell.hub.node.take_duplicate(), seeker)
        };
        if let Some((who, from)) = seeker {
            self.nodes.heard_searching(self.keys(), &who, from);
        }
        if let Some(address) = duplicate {
            self.duplicate_heard(address);
        }
        self.look_at_claims();
    }

    /// Without the hub, so that an emergency does not wait for a search.
    fn session_datagram(&self, link: &Arc<LinkCell>, from: SocketAddr, nonce: u64, body: &mut [u8]) {
        let mut state = link.lock();
        let event = self.with(link, &mut state, |session, cx| session.datagram(cx, from, nonce, body));
        if let Some(event) = event {
            self.note(&mut state, event);
        }
        self.dispatch_emergencies(link, &mut state);
        if state.session.has_next_call() {
            self.hand_over(link);
        }
        self.settle(link, state);
    }

    pub(super) fn connections_ready(&self) {
        let Some(listener) = &self.sockets.listener else { return };
        for _ in 0..BATCH {
            match listener.accept() {
                Accepted::Stream(stream, address) => {
                    if self.sockets.shortens(address.ip()) {
                        // The limit was set for this connection alone.
                        listener.limit_segments(false);
                    }
                    self.accepted(stream, address);
                }
                Accepted::WouldBlock => return,
                Accepted::Exhausted => {
                    warn_seldom!("no file descriptors are left for a new connection: raise the limit (ulimit -n)");
                    if self.make_room() {
                        continue;
                    }
                    self.driver.pause_listening(listener);
                    return;
                }
            }
        }
    }

    /// Looks at the file with the keys if it is time; returns when it will be. A peer that is not in the ring any more loses
    /// its link, also where the ring was taken between two looks.
    pub(super) fn watch_keys(&self) -> Instant {
        let (ring, due) = self.key_watch.look(self.now());
        if let Some(ring) = ring {
            self.hub.lock().hub.node.expect(ring.nodes());
            // A peer that was revoked loses its link.
            for link in self.links.all() {
                let mut state = link.lock();
                if state.session.identity().is_some_and(|peer| ring.pair(peer).is_none()) {
                    self.with(&link, &mut state, |session, cx| session.unrecorded("a key was revoked").revoke(cx));
                }
                self.settle(&link, state);
            }
            // Its tag was made with the previous keys.
            if self.hub.lock().identity().0.role() == Role::MUnit {
                self.announce_claim(Claim::NONE);
            }
        }
        due
    }

    /// Does what the node wants done about claims.
    pub(super) fn look_at_claims(&self) {
        loop {
            let (handed, event) = {
                let node = &mut self.hub.lock().hub.node;
                (node.take_hand_over(), node.take_claim_event())
            };
            let has_more = handed.is_some();
            if let Some((peer, stage)) = handed {
                tracing::info!(manager = %peer, ?stage, "this vehicle is handed over");
                self.notify(UnitEvent::HandOver { peer, stage });
            }
            match event {
                None if has_more => {}
                None => return,
                Some(ClaimEvent::Keep(manager, tagged)) => self.leave_to_writer(Job::Keep(manager, tagged)),
                Some(ClaimEvent::Raise(above)) => self.leave_to_writer(Job::Raise(above)),
                // It claims as soon as it has the key.
                Some(ClaimEvent::Lead(_)) if self.leadership.has_authority() => self.leadership.wake(),
                Some(ClaimEvent::Lead(above)) => self.leave_to_writer(Job::Lead(above)),
                Some(ClaimEvent::Unkept(peer, claim)) => {
                    tracing::error!(%claim, manager = peer.name(), "a claim is obeyed until this unit ends, and is not stored; after a hand-over nothing moves until it is");
                    self.notify(UnitEvent::ClaimNotKept { peer, claim });
                }
                Some(ClaimEvent::StepDown(by)) => self.step_down(by.claim),
                Some(event) => tracing::debug!(?event, "not understood"),
            }
        }
    }

    pub(super) fn leave_to_writer(&self, job: Job) {
        let Some(me) = self.me.upgrade() else { return };
        let write = move || {
            let next = || me.claims.write_next(&me.hub, me.keys(), me.leadership.revision(me.now()));
            while let Some(written) = next() {
                me.claim_written(written);
            }
        };
        self.claims.leave_to_writer(job, write).into_iter().for_each(|job| self.claim_written(Written::Failed(job)));
    }

    fn claim_written(&self, written: Written) {
        match written {
            Written::Failed(Job::Keep(manager, tagged)) => {
                self.hub.lock().hub.node.claim_kept(&manager, tagged.claim, false);
                self.driver.wake();
            }
            Written::Obeyed => self.links.look_at_orders(),
            Written::Raised(claim, revision)
                if self.leadership.revision(self.now()) == Some(revision) && self.announce_claim(claim) =>
            {
                tracing::warn!(%claim, "this manager has raised its claim");
                // Only now: whoever hears that it leads finds the claim in use.
                self.leadership.claimed(self.now(), revision);
                self.notify(UnitEvent::Raised { claim });
                self.broadcast();
            }
            Written::Raised(..) | Written::Failed(Job::Raise(_)) => self.hub.lock().hub.node.not_raised(self.now()),
            Written::Leads(claim, revision) if self.leadership.claimed(self.now(), revision) => self.lead(claim),
            Written::Leads(..) | Written::Failed(Job::Lead(_)) => self.stand_by_further(),
            Written::Failed(Job::Heard(_)) | Written::Nothing => {}
        }
    }

    /// This standby does not command yet. One that commands by now goes on: it was asked for twice.
    fn stand_by_further(&self) {
        let node = &mut self.hub.lock().hub.node;
        if node.is_standby() {
            node.stand_by(self.now());
        }
        self.driver.wake();
    }

    /// The claim of this standby is stored: it commands, unless somebody has answered meanwhile.
    fn lead(&self, claim: Claim) {
        let leads = {
            let mut cell = self.hub.lock();
            let (identity, _) = cell.identity();
            let tagged = claim.tagged(&identity, &self.keys().codes());
            tagged.map(|tagged| !self.is_stopping() && cell.hub.node.lead(self.now(), tagged))
        };
        match leads {
            // The key with itself was taken away meanwhile.
            None => return self.stand_by_further(),
            Some(false) => return,
            Some(true) => {}
        }
        tracing::warn!(%claim, "no manager of this name and id is there any more: this standby commands");
        self.notify(UnitEvent::TookCommand { claim });
        self.driver.wake();
    }

    /// Tells all peers this manager's claim, this one or the higher one that it has, with a tag of the keys as they are now. `false`
    /// where it has no key with itself any more, or stands by.
    fn announce_claim(&self, claim: Claim) -> bool {
        {
            // At once: whichever of a raise and a look at the keys comes last has the higher claim and the newer keys.
            let mut cell = self.hub.lock();
            let (identity, _) = cell.identity();
            let node = &mut cell.hub.node;
            let Some(tagged) = claim.max(node.claim()).tagged(&identity, &self.keys().codes()) else { return false };
            if node.is_standby() || tagged.claim == Claim::NONE {
                return false;
            }
            node.set_claim(tagged);
        }
        self.on_each_link(|session, cx| session.announce_claim(cx));
        true
    }

    /// A live manager of this identity has a higher claim. Stopping ends the links, and with them all that this one ordered. What
    /// was heard is stored, so that the next start claims above it.
    fn step_down(&self, claim: Claim) {
        if self.claims.step_down(true) {
            return;
        }
        match self.claims.stands_by() {
            true => {
                tracing::warn!(%claim, "another manager of this name and id commands with a higher claim: this one stands by again")
            }
            false => {
                tracing::error!(%claim, "another manager of this name and id commands with a higher claim: this one steps down")
            }
        }
        let Some(me) = self.me.upgrade() else { return };
        // A thread of the unit would wait for itself.
        let stop = move || {
            if me.claims.stands_by() {
                return me.stand_by_again(claim);
            }
            me.stop();
            // Before the application hears of it and ends.
            me.leave_to_writer(Job::Heard(claim));
            me.claims.await_writer();
            me.notify(UnitEvent::Fenced { claim });
        };
        if let Err(error) = std::thread::Builder::new().name("cara-fenced".into()).spawn(stop) {
            tracing::error!(%error, "no thread is left to step down with: tries again when the other one is heard again");
            self.claims.step_down(false);
        }
    }

    /// All that it ordered ends with its links, and none is taken from here on.
    fn stand_by_again(&self, by: Claim) {
        self.hub.lock().hub.node.stand_by(self.now());
        self.on_each_link(|session, cx| session.close(cx, CloseReason::StoppedHere));
        self.leave_to_writer(Job::Heard(by));
        self.claims.step_down(false);
        self.notify(UnitEvent::StandsBy { by: Some(by) });
        self.leadership.wake();
        self.driver.wake();
    }
}

impl<T: Send + 'static> Driven for Engine<T> {
    fn ready(&self, ready: Ready, worker: &mut Worker) {
        self.link_ready(ready, worker);
    }

    fn serve_waiting(&self, token: u64, worker: &mut Worker) {
        self.serve_link(token, worker);
    }

    fn keep_time(&self) -> Instant {
        let others = self.poll_node().min(self.driver.go_on_listening(&self.sockets));
        let look = self.links.look(others, |link, state| self.settle(link, state));
        self.look_at_claims();
        let others = others.min(self.look_at_leadership());
        let next = self.poll_links().min(others).min(look).min(self.driver.alarms.sound(self.now()));
        self.driver.went_round();
        next
    }

    fn look_around(&self) -> Instant {
        let (interfaces, up) = self.interfaces.look(&self.sockets.datagrams, &self.hub, &self.driver);
        if let Some(up) = up {
            self.notify(UnitEvent::NetworkChanged { up });
        }
        let unjoined = self.unjoined.warn(self.now(), &self.hub, self.sockets.datagrams.discovery_port());
        interfaces.min(self.watch_keys()).min(unjoined).min(self.measure_clocks())
    }

    fn read_datagrams(&self, socket: Socket, buffer: &mut [u8]) {
        let _ = self.datagrams_ready(socket, buffer);
    }

    fn accept(&self) {
        self.connections_ready();
    }
}
