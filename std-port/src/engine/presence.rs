//! A manager asks for its own identity before it starts.

use std::net::SocketAddr;

use cara_core::distribution::authenticator::Authenticator;
use cara_core::distribution::datagram::SEARCH_BYTES;
use cara_core::distribution::hello::ClaimReport;
use cara_core::distribution::identity::Role;
use cara_core::distribution::presence::{Heard, PRESENCE_PAUSE, PRESENCE_WAIT, Presence};
use cara_core::time::Duration;

use super::hub::SharedHub;
use super::keys::Keys;
use crate::clock::Clock;
use crate::sys::datagram::{Datagrams, Socket};
use crate::sys::epoll::{Epoll, Events, Interest};
use crate::sys::random;

/// Datagrams that are read before the time is looked at: a flood does not hold up the start.
const BATCH: usize = 64;

/// A unit of this identity that answers: where, and its claim.
type Running = (SocketAddr, Option<ClaimReport>);

/// What asks, and hears the answers.
pub(super) struct SelfSearch<'e> {
    pub(super) datagrams: &'e Datagrams,
    pub(super) keys: &'e Keys,
    pub(super) clock: Clock,
}

impl SelfSearch<'_> {
    /// Where a live manager of this unit's identity answers; `None` after a wait in which none did.
    pub(super) fn running_elsewhere(&self, hub: &SharedHub) -> std::io::Result<Option<Running>> {
        let presence = {
            let node = &hub.lock().hub.node;
            if node.identity().role() != Role::MUnit {
                return Ok(None);
            }
            Presence::new(node.identity().clone(), node.fleet(), node.epoch(), random())
        };
        let set = Epoll::new()?;
        for socket in [Socket::Shared, Socket::Own] {
            set.add(self.datagrams.fd(socket), 0, Interest::READ_LEVEL)?;
        }
        self.wait(presence, &set)
    }

    fn wait(&self, mut presence: Presence, set: &Epoll) -> std::io::Result<Option<Running>> {
        let (codes, mut events) = (self.keys.codes(), Events::new(2));
        let mut next = self.clock.now();
        let end = next + PRESENCE_WAIT;
        loop {
            let now = self.clock.now();
            if now >= end {
                return Ok(None);
            }
            if now >= next {
                let mut out = [0; SEARCH_BYTES];
                let sent = presence.question(&codes, &mut out).map(|question| self.datagrams.broadcast(question));
                tracing::debug!(?sent, "asked whether this unit runs already");
                next = now + PRESENCE_PAUSE;
            }
            set.wait(&mut events, Some(next.min(end).since(now).max(Duration::from_millis(1))))?;
            if let Some(running) = self.hear(&presence, &codes) {
                return Ok(Some(running));
            }
        }
    }

    fn hear(&self, presence: &Presence, codes: &impl Authenticator) -> Option<Running> {
        for socket in [Socket::Shared, Socket::Own] {
            let mut buffer = [0; SEARCH_BYTES + 1];
            for _ in 0..BATCH {
                let Some((length, from)) = self.datagrams.receive(socket, &mut buffer) else { break };
                let mut out = [0; SEARCH_BYTES];
                match presence.hear(from, buffer.get(..length).unwrap_or_default(), codes, &mut out) {
                    Heard::Nothing => {}
                    Heard::Answer(answer) => drop(self.datagrams.send_to(from, answer)),
                    Heard::Running { at, claim } => return Some((at, claim)),
                }
            }
        }
        None
    }
}
