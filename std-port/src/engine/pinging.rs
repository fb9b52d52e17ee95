//! Turns to measure round trips of the protocol itself: a link has one ping at a time.

use cara_core::error::Error;
use cara_core::time::Instant;

use super::link::{LinkCell, LinkState};
use crate::clock::Clock;
use crate::locks::Locked;

/// This caller's turn to ping.
pub(crate) struct Turn<'l>(&'l LinkCell);

impl<'l> Turn<'l> {
    /// Each of several callers on a link has its turn.
    pub(super) fn wait(
        link: &'l LinkCell,
        clock: Clock,
        deadline: Instant,
    ) -> Result<(Self, Locked<'l, LinkState>), Error> {
        let mut state = link.lock();
        while state.pinging {
            state = wait(link, state, clock, deadline)?;
        }
        state.pinging = true;
        Ok((Self(link), state))
    }

    /// Unless another caller has it. The link is locked: no turn is made that would be dropped here.
    #[cfg(feature = "async")]
    pub(crate) fn take(link: &'l LinkCell, state: &mut LinkState) -> Option<Self> {
        (!std::mem::replace(&mut state.pinging, true)).then(|| Self(link))
    }
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        self.0.lock().pinging = false;
        self.0.notify();
    }
}

/// Waits until something has happened on the link.
pub(super) fn wait<'l>(
    link: &'l LinkCell,
    state: Locked<'l, LinkState>,
    clock: Clock,
    deadline: Instant,
) -> Result<Locked<'l, LinkState>, Error> {
    if !state.session.is_live() {
        return Err(Error::NotConnected);
    }
    let now = clock.now();
    if now >= deadline {
        return Err(Error::TimedOut);
    }
    Ok(state.wait(&link.room, deadline.since(now)))
}
