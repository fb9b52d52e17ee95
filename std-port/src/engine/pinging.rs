//! Round trips of the protocol itself.

use std::sync::Arc;

use cara_core::error::Error;
use cara_core::time::{Duration, Instant};

use super::Engine;
use super::link::{LinkCell, LinkState};
use super::reader::Cause;
use crate::locks::Locked;

impl<T: Send + 'static> Engine<T> {
    /// Asks for a sign of life and returns how long it took. Of several callers on a link each has its turn.
    pub(crate) fn ping(&self, link: &Arc<LinkCell>, timeout: Duration) -> Result<Duration, Error> {
        let deadline = self.now() + timeout;
        let mut state = link.lock();
        while state.pinging {
            state = self.wait(link, state, deadline)?;
        }
        state.pinging = true;
        let took = self.round_trip(link, state, deadline);
        link.lock().pinging = false;
        link.notify();
        took
    }

    fn round_trip<'l>(
        &self,
        link: &'l Arc<LinkCell>,
        mut state: Locked<'l, LinkState>,
        deadline: Instant,
    ) -> Result<Duration, Error> {
        // A link that is kept is read by no thread until its caller is back.
        self.links.read_by(self.now(), link, &mut state, Cause::NeedsPool);
        loop {
            match self.with(link, &mut state, |session, cx| session.ping(cx)) {
                Ok(()) => break,
                Err(Error::Full(_)) => state = self.wait(link, state, deadline)?,
                Err(error) => return Err(error),
            }
        }
        self.settle(link, state);
        state = link.lock();
        loop {
            if let Some(took) = state.session.round_trip() {
                return Ok(took);
            }
            state = self.wait(link, state, deadline)?;
        }
    }

    /// Waits until something has happened on the link.
    fn wait<'l>(
        &self,
        link: &'l LinkCell,
        state: Locked<'l, LinkState>,
        deadline: Instant,
    ) -> Result<Locked<'l, LinkState>, Error> {
        if !state.session.is_live() {
            return Err(Error::NotConnected);
        }
        let now = self.now();
        if now >= deadline {
            return Err(Error::TimedOut);
        }
        Ok(state.wait(&link.room, deadline.since(now)))
    }
}
