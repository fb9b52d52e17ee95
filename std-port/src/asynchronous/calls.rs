//! What calls hold, and round trips.

use cara_core::error::Error;
use cara_core::services::lease::LeaseEnd;
use cara_core::time::Duration;

use crate::heart::Hold;
use crate::peer::Peer;

impl<T: Send + 'static> Peer<T> {
    /// Measures a round trip of the protocol itself, with no function involved. [`Error::TimedOut`] when no answer comes in
    /// time. Dropped before it has ended, it gives its turn to the next caller.
    pub async fn ping_async(&self, timeout: impl Into<Duration>) -> Result<Duration, Error> {
        self.engine.await_ping(&self.link()?, timeout.into()).await
    }

    /// As [`publish_my_function_list`](Self::publish_my_function_list), and ends when the node has read the list;
    /// [`Error::TimedOut`] otherwise. Dropped before it has ended, the list is published all the same.
    pub async fn publish_and_wait_async(&self, timeout: impl Into<Duration>) -> Result<(), Error> {
        let reported = self.engine.publish(Some(&self.cell.identity))?;
        match self.engine.acknowledgements(reported, timeout.into()).await.is_empty() {
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
        engine.end_of_order(&call.link, call.id, timeout.into()).await
    }
}
