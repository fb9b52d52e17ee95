//! What a manager asks who may lead: see [`Authority`].

use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::time::Duration;

/// Lets one of all managers of an identity lead at a time: it hands out one key for each identity and fleet, as etcd does
/// (crate `cara-etcd`). Set with [`Builder::authority`](crate::Builder::authority).
///
/// A manager with an authority claims only while it has the key. A thread of its own asks for the key and renews it, so that
/// a call may take its time: nothing else waits for it, and a key that is not renewed in time counts no more.
pub trait Authority: Send + 'static {
    /// Asks for the key of this manager, or renews it. `None` if another one has it. On an error the key stays what it was, until
    /// its time is over.
    fn hold(
        &mut self,
        manager: &Identity,
        fleet: Fleet,
    ) -> Result<Option<Key>, Box<dyn std::error::Error + Send + Sync>>;

    /// Gives the key back, if it has it, so that another one gets it at once: called when the manager does not command any more.
    /// [`stop`](crate::CommunicationSystem::stop) waits half a second for it.
    fn release(&mut self);
}

/// The key that an [`Authority`] has given.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Key {
    /// Counts the holders: higher than for any key that was given for this identity before. The same for as long as it is
    /// renewed. The manager's claim has a higher term.
    pub revision: u64,
    /// No other one gets it for so long after it was asked for. The manager counts from before it asked, and 10 % less.
    pub lasts: Duration,
}
