//! Hand-over of a connected vehicle to another manager.

use std::sync::Arc;

use cara_core::distribution::connection_handler::HandOverStage;
use cara_core::distribution::hello::Manager;
use cara_core::error::Error;
use cara_core::time::Duration;

use super::Engine;
use super::link::LinkCell;
use super::pinging::{self, Turn};
use super::reader::Cause;
use crate::error::HandOverError;
use crate::event::UnitEvent;

impl<T: Send + 'static> Engine<T> {
    /// Has the turn of a ping meanwhile, so that a link has one question at a time.
    pub(crate) fn hand_over_to(
        &self,
        link: &Arc<LinkCell>,
        to: &Manager,
        timeout: Duration,
    ) -> Result<(), HandOverError> {
        let (clock, deadline) = (self.driver.clock(), self.now() + timeout);
        let (_turn, mut state) = Turn::wait(link, clock, deadline)?;
        // A link that is kept is read by no thread until its caller is back.
        self.links.read_by(clock.now(), link, &mut state, Cause::NeedsPool);
        loop {
            match self
                .with(link, &mut state, |session, cx| session.unrecorded("a vehicle is handed over").hand_over(cx, to))
            {
                Ok(()) => break,
                Err(Error::Full(_)) => state = pinging::wait(link, state, clock, deadline)?,
                Err(error) => return Err(error.into()),
            }
        }
        self.settle(link, state);
        state = link.lock();
        loop {
            if let Some(answer) = state.session.hand_over_answer() {
                answer.map_err(HandOverError::Refused)?;
                let peer = state.session.identity().cloned();
                drop(state);
                if let Some(peer) = peer {
                    tracing::info!(vehicle = %peer, manager = %to.name, "handed over");
                    self.notify(UnitEvent::HandOver { peer, stage: HandOverStage::Leaves });
                }
                return Ok(());
            }
            state = pinging::wait(link, state, clock, deadline)?;
        }
    }
}
