//! Links that are being opened, and links that have ended: when to dial again.

use super::known::NodeState;
use super::search::{LOST_LISTENING, back_off};
use super::timetable::Task;
use super::{Node, Target};
use crate::distribution::identity::Identity;
use crate::error::{CloseReason, Refusal};
use crate::host::mailman::LinkId;
use crate::host::port::Port;
use crate::time::{Duration, Instant};

/// A link that lasted shorter counts as a failed attempt, so that it is dialled again with back-off.
const SETTLED: Duration = Duration::from_secs(1);
/// As many failed attempts a refusal counts for if an operator has to remove its cause.
const HOPELESS: u8 = 5;

impl<P: Port> Node<P> {
    /// The port is opening the link that [`Command::Dial`](super::Command::Dial) asked for.
    pub fn dialing(&mut self, identity: Option<&Identity>, link: LinkId) {
        let Some(place) = identity.and_then(|identity| self.table.find(identity)) else { return };
        let Some(known) = self.table.node_mut(place) else { return };
        match known.state {
            // The hello has arrived before the port's call.
            NodeState::Joined(joined) if joined == link => known.dialed = true,
            NodeState::Joined(_) | NodeState::Dialing => {
                known.dialing = Some(link);
                self.table.set_link(link, Some(place));
            }
            NodeState::Away => {}
        }
    }

    /// The link that [`Command::Dial`](super::Command::Dial) asked for could not be opened.
    pub fn dial_failed(&mut self, now: Instant, identity: Option<&Identity>) {
        let place = identity.and_then(|identity| self.table.find(identity));
        // An earlier dial to another address of the node may still succeed.
        let dialing = |place: &usize| {
            self.table.node(*place).is_some_and(|known| known.state == NodeState::Dialing && known.dialing.is_none())
        };
        if let Some(place) = place.filter(dialing) {
            self.dial_ended(now, place);
        }
    }

    /// A link has ended, in whatever state. A newcomer may have waited for that.
    pub fn left(&mut self, now: Instant, link: LinkId, reason: CloseReason) {
        let Some(place) = self.table.of_link(link) else { return };
        self.table.set_link(link, None);
        let Some(known) = self.table.node_mut(place) else { return };
        let (address, identity) = (known.address, known.identity.clone());
        if known.newcomer.take_if(|newcomer| newcomer.link == link).is_some() {
            known.dialing.take_if(|dialing| *dialing == link);
            self.table.cancel(place);
            return;
        }
        if let CloseReason::Refused(refusal) = reason
            && known.newcomer.is_none()
        {
            self.note_of(now, address, &identity, refusal);
        }
        let Some(known) = self.table.node_mut(place) else { return };
        if known.dialing.take_if(|dialing| *dialing == link).is_some() {
            if known.state == NodeState::Dialing {
                self.lose_hope(now, place, reason);
                self.dial_ended(now, place);
            }
        } else if known.link() == Some(link) {
            debug!("link {} left: {}", link.0, reason);
            self.manager_left(now, &identity);
            self.part(now, place, reason);
        }
    }

    /// The link of a connected node has ended.
    fn part(&mut self, now: Instant, place: usize, reason: CloseReason) {
        let was_full = P::MANAGES && self.is_full();
        self.table.set_state(place, NodeState::Away);
        self.table.cancel(place);
        let Some(known) = self.table.node_mut(place) else { return };
        let settled = now.since(known.since) >= SETTLED;
        if settled {
            known.attempts = 0;
        } else {
            // The peer's hello precedes its refusal, so a link that it refuses may have joined here first.
            self.lose_hope(now, place, reason);
        }
        if let Some(newcomer) = self.table.node_mut(place).and_then(|known| known.newcomer.take()) {
            return self.take_place(now, place, newcomer);
        }
        let is_followed = reason == CloseReason::PeerRestarted
            && self.table.node(place).is_some_and(|known| known.listens.is_some() && self.dials(&known.identity));
        if is_followed {
            // Another boot of it has been found, and is where this one is dialled.
            self.table.schedule(place, now, Task::Dial);
        }
        // One that was stopped in an orderly way says so itself when it is back.
        let is_orderly = matches!(reason, CloseReason::Stopped | CloseReason::StoppedHere);
        if P::MANAGES && !is_orderly {
            self.miss(now, place);
        }
        if was_full {
            self.place_is_free(now);
        }
        match self.config.target {
            _ if is_followed => {}
            Target::Everybody if is_orderly => {}
            Target::Everybody | Target::Fixed(..) => self.retry(now, place),
            Target::Manager(_) => {}
        }
        self.search_again(now, settled.then_some(LOST_LISTENING));
    }

    /// The dialled peer has refused for a reason that does not pass by itself.
    fn lose_hope(&mut self, now: Instant, place: usize, reason: CloseReason) {
        let CloseReason::Refused(refusal) = reason else { return };
        use Refusal::{AlreadyConnected, Driving, Fenced, Full, Standby};
        if matches!(refusal, Full | AlreadyConnected | Fenced | Driving | Standby) {
            return;
        }
        if let Target::Manager(_) = self.config.target {
            self.search.attempt = self.search.attempt.max(HOPELESS);
        }
        if let Some(known) = self.table.node_mut(place) {
            known.attempts = known.attempts.max(HOPELESS);
            known.not_before = now + back_off(HOPELESS);
        }
    }
}
