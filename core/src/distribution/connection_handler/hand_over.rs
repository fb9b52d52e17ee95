//! Hand-over of a vehicle to another manager. Its manager says so on their link; the vehicle leaves, looks for the new one, and
//! goes back unless it has joined there in time. What it stores then is the commit: until that is done, nothing moves.

use super::claims::{MayMove, STORING};
use super::search::FIRST_LISTENING;
use super::{Command, Directive, Node, NodeCounter, Target};
use crate::ability::HAND_OVER;
use crate::config::HAND_OVER_TIMEOUT;
use crate::distribution::hello::Manager;
use crate::distribution::identity::Identity;
use crate::distribution::message::HandOverRefusal;
use crate::error::CloseReason;
use crate::host::mailman::LinkId;
use crate::host::port::Port;
use crate::time::Instant;

/// How far a vehicle is on its way to another manager.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HandOverStage {
    /// It has agreed to go, and leaves its manager.
    Leaves,
    /// It belongs to the new manager, also after a restart.
    Moved,
    /// It has not joined the new manager in time, or could not store that, and goes back.
    Returns,
}

/// Where a vehicle is on its way from one manager to another; empty where the build has no hand-over.
#[derive(Clone, Debug, Default)]
pub(super) struct Moving([State; HAND_OVER as usize]);

#[derive(Clone, Debug, Default)]
struct State {
    /// The manager that the unit was configured with, once it was handed over.
    home: Option<Manager>,
    underway: Option<Underway>,
    /// Not reported yet: that it has left for this manager, and how that ended.
    left: Option<Identity>,
    ended: Option<(Identity, HandOverStage)>,
}

/// A hand-over that is not committed.
#[derive(Clone, Debug)]
struct Underway {
    from: Manager,
    stage: Stage,
    /// When its stage ends by itself.
    until: Instant,
}

/// How far a hand-over has got.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    /// The unit looks for its new manager.
    Looks,
    /// It has joined there, and the claim is being stored. Whether it is stored already is not known: only a failure leads back.
    Stores,
    /// The same, for longer than calls wait; whether the port has been told.
    StoresLate(bool),
}

impl Underway {
    fn has_arrived(&self) -> bool {
        self.stage != Stage::Looks
    }
}

impl Moving {
    fn underway(&self) -> Option<&Underway> {
        self.0.first()?.underway.as_ref()
    }

    pub(super) fn is_underway(&self) -> bool {
        self.underway().is_some()
    }

    pub(super) fn until(&self) -> Instant {
        self.underway().map_or(Instant::FAR_FUTURE, |underway| underway.until)
    }

    /// Whether storing takes too long; once.
    pub(super) fn take_lateness(&mut self) -> bool {
        let underway = self.0.first_mut().and_then(|state| state.underway.as_mut());
        let Some(underway) = underway.filter(|underway| underway.stage == Stage::StoresLate(false)) else {
            return false;
        };
        underway.stage = Stage::StoresLate(true);
        true
    }

    /// The claim of its manager, the new one if it is on its way, is stored.
    pub(super) fn commit(&mut self, manager: &Identity) {
        if let Some(state) = self.0.first_mut()
            && state.underway.take_if(|underway| underway.has_arrived()).is_some()
        {
            state.ended = Some((manager.clone(), HandOverStage::Moved));
        }
    }
}

impl<P: Port> Node<P> {
    /// How far this vehicle is on its way to another manager, and that manager, or the one to which it returns; each stage once. To be
    /// asked for as [`take_claim_event`](Self::take_claim_event) is.
    pub fn take_hand_over(&mut self) -> Option<(Identity, HandOverStage)> {
        let state = self.moving.0.first_mut()?;
        let left = state.left.take().map(|to| (to, HandOverStage::Leaves));
        left.or_else(|| state.ended.take())
    }

    /// The manager that this unit was configured with and the one that it belongs to, if they differ, once a claim of `storing` is
    /// stored: the port stores them with it in one write, and passes them to [`belong_to`](Self::belong_to) at the next start. A claim
    /// of another manager than the new one commits no hand-over.
    pub fn handed_over(&self, storing: &Identity) -> Option<(Identity, Identity)> {
        let state = self.moving.0.first()?;
        let present = match &state.underway {
            Some(underway) if !(underway.has_arrived() && self.target.as_ref() == Some(storing)) => {
                underway.from.identity()
            }
            _ => self.target.clone(),
        };
        let pair = (state.home.as_ref()?.identity()?, present?);
        (pair.0 != pair.1).then_some(pair)
    }

    /// This unit was handed over to `present` in an earlier life. Has no effect on one that is now configured with another manager than
    /// `home`, or with a fixed address.
    pub fn belong_to(&mut self, home: &Identity, present: &Identity) {
        if let Target::Manager(configured) = &self.config.target
            && configured.is(home)
            && let Ok(manager) = Manager::new(present.name(), present.id())
            && let Some(state) = self.moving.0.first_mut()
        {
            state.home = Some(configured.clone());
            self.turn_to(manager);
        }
    }

    fn turn_to(&mut self, manager: Manager) {
        self.target = manager.identity();
        self.config.target = Target::Manager(manager);
    }

    /// The manager on this link hands the unit over to another one. From here on it looks for that one, and the session ends the link.
    pub(crate) fn hand_over(&mut self, now: Instant, link: LinkId, to: Manager) -> Result<(), HandOverRefusal> {
        let from = match &self.config.target {
            Target::Manager(from) => from.clone(),
            Target::Fixed(..) => return Err(HandOverRefusal::Fixed),
            Target::Everybody => return Err(HandOverRefusal::Other),
        };
        let known = self.target.as_ref().and_then(|target| self.node(target));
        let present = known.and_then(|known| known.link());
        let Some(identity) = to.identity().filter(|_| to != from && present == Some(link)) else {
            return Err(HandOverRefusal::Other);
        };
        // Another link of the same manager that waits for this one to end would take its place.
        let is_followed = known.is_some_and(|known| known.newcomer.is_some() || known.task.is_some());
        if self.moving.is_underway() || is_followed {
            return Err(HandOverRefusal::Underway);
        }
        if !self.claims.can_keep(&identity) {
            return Err(HandOverRefusal::NotStored);
        }
        let Some(state) = self.moving.0.first_mut() else { return Err(HandOverRefusal::Other) };
        state.home.get_or_insert_with(|| from.clone());
        state.underway = Some(Underway { from, stage: Stage::Looks, until: now + HAND_OVER_TIMEOUT });
        state.left = Some(identity);
        self.turn_to(to);
        // Its last search may have been a long one.
        self.search.attempt = 0;
        Ok(())
    }

    /// This manager has been joined: if the unit is on its way there, the port is to store that. One without a claim, by which it
    /// could be stored, is left again when the time is over.
    pub(super) fn arrived(&mut self, now: Instant, manager: &Identity) {
        if self.target.as_ref() == Some(manager)
            && self.claims.knows(manager)
            && let Some(underway) = self.moving.0.first_mut().and_then(|state| state.underway.as_mut())
            && underway.stage == Stage::Looks
        {
            (underway.stage, underway.until) = (Stage::Stores, now + STORING);
            self.claims.want_kept(now, manager);
        }
    }

    /// What a hand-over says about a moving call of this manager.
    pub(super) fn may_move_on_the_way(&self, manager: &Identity) -> Option<MayMove> {
        // One that was left, or turned back from, commands nothing more, though its link may not have ended yet.
        if HAND_OVER && self.target.as_ref().is_some_and(|target| target != manager) {
            return Some(MayMove::No);
        }
        let underway = self.moving.underway()?;
        Some(if underway.stage == Stage::Stores { MayMove::Waits } else { MayMove::No })
    }

    /// Goes back if the new manager was not found in time, or could not be stored.
    pub(super) fn poll_hand_over(&mut self, now: Instant) -> Option<Command<P::Endpoint>> {
        let underway = self.moving.underway()?;
        let target = self.target.clone()?;
        let has_arrived = underway.has_arrived();
        if has_arrived && self.claims.is_unasked(&target) {
            // It has raised its claim meanwhile.
            self.claims.want_kept(now, &target);
        }
        let has_failed = has_arrived && self.claims.has_failed(&target);
        if now < underway.until && !has_failed {
            return None;
        }
        let underway = self.moving.0.first_mut()?.underway.as_mut()?;
        if has_arrived && !has_failed {
            (underway.stage, underway.until) = (Stage::StoresLate(false), Instant::FAR_FUTURE);
            self.counters.count(NodeCounter::ClaimsNotKept);
            return None;
        }
        let state = self.moving.0.first_mut()?;
        let Underway { from, .. } = state.underway.take()?;
        let back = from.identity();
        state.ended = back.clone().map(|back| (back, HandOverStage::Returns));
        if let Some(back) = back.filter(|_| has_failed) {
            // The file may say that it belongs to the other one all the same.
            self.claims.want_kept(now, &back);
        }
        self.turn_to(from);
        // At once: nobody commands it meanwhile. Where a link is still to end, that searches again.
        self.search.attempt = 0;
        self.search_again(now, Some(FIRST_LISTENING));
        let place = self.table.find(&target)?;
        let known = self.table.node(place)?;
        let link = known.link().or(known.dialing);
        if link.is_none() {
            self.table.cancel(place);
        }
        link.map(|link| Command::Notify(link, Directive::Close(CloseReason::StoppedHere)))
    }
}
