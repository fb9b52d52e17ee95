//! The thread that keeps time: timers of links and of the node, datagrams, and new connections. It runs no handlers and no
//! hooks, never sleeps, and looks at no file: [`look_around`](crate::threads::Driven::look_around) has a thread of its own.

use cara_core::distribution::datagram;
use cara_core::time::{Duration, Instant};
use core::net::SocketAddr;
use std::sync::Arc;

use super::Engine;
use super::link::LinkCell;
use crate::locks::lock;
use crate::seldom::warn_seldom;
use crate::sys::datagram::Socket;
use crate::sys::stream::Accepted;
use crate::threads::Source;

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
            let Some(link) = self.link(due) else { continue };
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

    /// What a unit moves has been stopped: its links look at their orders now.
    pub(crate) fn look_at_orders(&self) {
        self.links.bring_timers_forward();
        self.wake_clock();
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
        if let Some((link, nonce, body)) = datagram::for_session(bytes, self.mode(), self.fleet)
            && let Some(link) = self.link(link)
        {
            return self.session_datagram(&link, from, nonce, body);
        }
        let codes = self.keys().codes();
        let duplicate = {
            let mut cell = self.hub();
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
                    if lock(&self.short_segments).contains(&address.ip()) {
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
                    self.pause_listening();
                    return;
                }
            }
        }
    }
}

/// A unit for which there are no descriptors takes no connections for so long. Its clock goes on.
const PAUSE: Duration = Duration::from_millis(100);

impl<T: Send + 'static> Engine<T> {
    fn pause_listening(&self) {
        let Some(listener) = &self.sockets.listener else { return };
        self.thread_pool().unwatch(listener);
        *lock(&self.sockets.listens_at) = Some(self.now() + PAUSE);
    }

    /// Takes connections again when the pause is over; returns when that is.
    pub(super) fn go_on_listening(&self) -> Instant {
        let mut at = lock(&self.sockets.listens_at);
        match *at {
            Some(due) if due <= self.now() => {
                let unit_number = self.unit_number();
                if let Some((listener, unit_number)) = self.sockets.listener.as_ref().zip(unit_number)
                    && self.thread_pool().watch(unit_number, Source::Listener, listener).is_err()
                {
                    *at = Some(self.now() + PAUSE);
                    return self.now() + PAUSE;
                }
                *at = None;
                Instant::FAR_FUTURE
            }
            Some(due) => due,
            None => Instant::FAR_FUTURE,
        }
    }
}
