//! The thread that keeps time: timers of links and of the node, datagrams, and new connections. It runs no handlers and no
//! hooks, never sleeps, and looks at no file: [`look_around`](crate::threads::Driven::look_around) has a thread of its own.

use cara_core::distribution::claim::Claim;
use cara_core::distribution::datagram;
use cara_core::distribution::identity::Role;
use cara_core::time::Instant;
use core::net::SocketAddr;
use std::sync::Arc;

use super::Engine;
use super::link::LinkCell;
use super::worker::Worker;
use crate::event::UnitEvent;
use crate::keys::KeyRing;
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

    /// Whether none is left.
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
        let duplicate = {
            let mut cell = self.hub.lock();
            cell.hub.node.datagram(self.now(), from, bytes, &codes);
            cell.hub.node.take_duplicate()
        };
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
                        // The one that it was meant for is there.
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
            let claim = {
                let mut cell = self.hub.lock();
                cell.hub.node.expect(ring.nodes());
                cell.hub.node.claim()
            };
            self.end_links_without_keys(&ring);
            // Its tag is of the keys before.
            if self.hub.lock().identity().0.role() == Role::MUnit && claim != Claim::NONE {
                self.announce_claim(claim);
            }
        }
        due
    }

    /// A peer that was revoked loses its link.
    fn end_links_without_keys(&self, ring: &KeyRing) {
        for link in self.links.all() {
            let mut state = link.lock();
            if state.session.identity().is_some_and(|peer| ring.pair(peer).is_none()) {
                self.with(&link, &mut state, |session, cx| session.revoke(cx));
            }
            self.settle(&link, state);
        }
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
        self.poll_links().min(others).min(look).min(self.driver.alarms.sound(self.now()))
    }

    fn look_around(&self) -> Instant {
        let (interfaces, up) = self.interfaces.look(&self.sockets.datagrams, &self.hub, &self.driver);
        if let Some(up) = up {
            self.notify(UnitEvent::NetworkChanged { up });
        }
        interfaces.min(self.watch_keys())
    }

    fn read_datagrams(&self, socket: Socket, buffer: &mut [u8]) {
        let _ = self.datagrams_ready(socket, buffer);
    }

    fn accept(&self) {
        self.connections_ready();
    }
}
