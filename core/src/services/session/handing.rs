//! Hand-over of a vehicle to another manager: the question of its manager, and the vehicle's answer. How it goes on is decided by
//! the unit's node (`connection_handler/hand_over.rs`).

use super::Phase;
use super::granting::Granting;
use super::wire::Wire;
use crate::ability::{Begins, HAND_OVER, State};
use crate::distribution::hello::{Hello, Manager};
use crate::distribution::identity::Role;
use crate::distribution::message::{Control, HandOverRefusal};
use crate::error::{CloseReason, Error, Limit};
use crate::services::{Context, Port};

/// What was asked of the peer. It answers in the order of the questions: only the answer to the last one counts.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Asked {
    open: u8,
    answer: Option<Result<(), HandOverRefusal>>,
}

impl Begins for Asked {
    const BEGIN: &'static Self = &Self { open: 0, answer: None };
}

pub(super) type HandingPart = State<Asked, { HAND_OVER as usize }>;

impl HandingPart {
    pub(super) fn ask<P: Port>(
        &mut self,
        wire: &mut Wire<P>,
        cx: &mut Context<'_, P>,
        to: &Manager,
    ) -> Result<(), Error> {
        if wire.phase != Phase::Live {
            return Err(Error::NotConnected);
        }
        let asked = self.get_mut().filter(|_| wire.identity().is_some_and(|peer| peer.role() == Role::SUnit));
        let asked = asked.ok_or(Error::Unsupported)?;
        // So many that nobody answers: the peer does not understand them.
        let open = asked.open.checked_add(1).ok_or(Error::Unsupported)?;
        if !wire.send_control(cx, &Control::HandOver { name: to.name.as_bytes(), id: to.id }) {
            return Err(Error::Full(Limit::SendQueue));
        }
        wire.flush(cx);
        *asked = Asked { open, answer: None };
        Ok(())
    }

    /// Returns whether this unit waits for this answer.
    pub(super) fn answered(&mut self, refusal: Option<HandOverRefusal>) -> bool {
        let Some(asked) = self.get_mut() else { return false };
        let Some(open) = asked.open.checked_sub(1) else { return false };
        *asked = Asked { open, answer: (open == 0).then_some(refusal.map_or(Ok(()), Err)) };
        open == 0
    }

    pub(super) fn answer(&self) -> Option<Result<(), HandOverRefusal>> {
        self.answer
    }
}

impl Granting {
    /// The manager hands this vehicle over. If nothing stands against it, the link ends at once, so that no call of the old manager
    /// begins after the decision.
    pub(super) fn hand_over_arrived<P: Port>(&self, wire: &mut Wire<P>, cx: &mut Context<'_, P>, to: Option<Manager>) {
        let refusal = self.hand_over(wire, cx, to).err();
        // A manager that misses the answer sees that the link has ended.
        wire.send_control(cx, &Control::HandedOver { refusal });
        match refusal {
            None => wire.close(cx, CloseReason::StoppedHere),
            Some(_) => wire.flush(cx),
        }
    }

    fn hand_over<P: Port>(
        &self,
        wire: &Wire<P>,
        cx: &mut Context<'_, P>,
        mut to: Option<Manager>,
    ) -> Result<(), HandOverRefusal> {
        let hello = wire.hello().ok_or(HandOverRefusal::Other)?;
        let identity = to.as_ref().and_then(Manager::identity).ok_or(HandOverRefusal::Other)?;
        if !self.is_quiet(wire, cx) || self.obedience.waits || self.obedience.gives_way() {
            return Err(HandOverRefusal::Moves);
        }
        if cx.keys.credentials(&Hello { identity, ..hello.clone() }).is_none() {
            return Err(HandOverRefusal::NoKey);
        }
        let (now, link, mut result) = (cx.now, wire.link.id(), Err(HandOverRefusal::Other));
        cx.hub.enter(&mut |hub| {
            if let Some(to) = to.take() {
                result = hub.node.hand_over(now, link, to);
            }
        });
        result
    }
}
