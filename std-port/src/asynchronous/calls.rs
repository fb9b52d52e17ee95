//! What calls hold, and round trips.

use cara_core::error::Error;
use cara_core::services::lease::LeaseEnd;
use cara_core::time::Duration;

use super::looking::LinkWait;
use crate::engine::Turn;
use crate::engine::link::LinkState;
use crate::engine::reader::Cause;
use crate::heart::Hold;
use crate::peer::Peer;

impl<T: Send + 'static> Peer<T> {
    /// Measures a round trip of the protocol itself, with no function involved. [`Error::TimedOut`] when no answer comes in
    /// time. Dropped before it has ended, it gives its turn to the next caller.
    pub async fn ping_async(&self, timeout: impl Into<Duration>) -> Result<Duration, Error> {
        let (engine, link) = (&self.engine, self.link()?);
        let wait = LinkWait::new(engine, timeout.into());
        let take_turn = |state: &mut LinkState| match state.session.is_live() {
            true => Turn::take(&link, state).map(Ok),
            false => Some(Err(Error::NotConnected)),
        };
        let _turn = wait.until(&link, take_turn).await?;
        let mut asked = false;
        let ask = |state: &mut LinkState| {
            if !state.session.is_live() {
                return Some(Err(Error::NotConnected));
            }
            if !asked {
                // A link that is kept is read by no thread until its caller is back.
                engine.links.read_by(engine.now(), &link, state, Cause::NeedsPool);
                match engine.with(&link, state, |session, cx| session.ping(cx)) {
                    Ok(()) => asked = true,
                    Err(Error::Full(_)) => {}
                    Err(error) => return Some(Err(error)),
                }
            }
            state.session.round_trip().filter(|_| asked).map(Ok)
        };
        wait.until(&link, ask).await
    }

    /// As [`publish_my_function_list`](Self::publish_my_function_list), and ends when the node has read the list;
    /// [`Error::TimedOut`] otherwise. Dropped before it has ended, the list is published all the same.
    pub async fn publish_and_wait_async(&self, timeout: impl Into<Duration>) -> Result<(), Error> {
        let reported = self.engine.publish(Some(&self.cell.identity))?;
        match LinkWait::new(&self.engine, timeout.into()).acknowledgements(reported).await.is_empty() {
            true => Ok(()),
            false => Err(Error::TimedOut),
        }
    }
}

impl<T: Send + 'static> Hold<T> {
    /// Releases it, as dropping does, and ends when the node has told that it is over there, and how: within a keep-alive
    /// interval as a rule. [`Error::TimedOut`] when it has not told so in time, [`Error::Interrupted`] when the link ended
    /// before. Dropped before it has ended, it is released all the same.
    pub async fn release_async(self, timeout: impl Into<Duration>) -> Result<LeaseEnd, Error> {
        let (engine, call) = (self.engine.clone(), self.call.clone());
        drop(self);
        let look = |state: &mut LinkState| {
            let nonce = state.session.nonce() as u32;
            let last = state.actuators.values().filter_map(|actuator| actuator.last);
            let end = last.filter(|last| (last.link, last.call) == (nonce, call.id.0)).find_map(|last| last.end);
            match end {
                Some(end) => Some(Ok(end)),
                None => (!state.session.is_live()).then_some(Err(Error::Interrupted)),
            }
        };
        LinkWait::new(&engine, timeout.into()).until(&call.link, look).await
    }
}
