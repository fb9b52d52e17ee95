//! The channels that are told what happens to a unit.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, TrySendError};
use std::sync::{Arc, Mutex};

use crate::event::UnitEvent;
use crate::locks::Rank;

#[derive(Default)]
pub(super) struct Events {
    subscribers: Mutex<Vec<Subscriber>>,
    /// Events that any subscriber lost.
    lost: AtomicU64,
}

struct Subscriber {
    sender: SyncSender<UnitEvent>,
    /// Events that found no room.
    lost: Arc<AtomicU64>,
}

impl Events {
    /// A subscriber that does not keep up loses the event, and one that is gone is forgotten.
    pub(super) fn tell(&self, event: &UnitEvent) {
        tracing::debug!(?event);
        Rank::Leaf.lock(&self.subscribers).retain(|subscriber| match subscriber.sender.try_send(event.clone()) {
            Ok(()) => true,
            Err(TrySendError::Full(_)) => {
                subscriber.lost.fetch_add(1, Ordering::Relaxed);
                self.lost.fetch_add(1, Ordering::Relaxed);
                true
            }
            Err(TrySendError::Disconnected(_)) => false,
        });
    }

    pub(super) fn subscribe(&self, sender: SyncSender<UnitEvent>) -> Arc<AtomicU64> {
        let lost = Arc::new(AtomicU64::new(0));
        Rank::Leaf.lock(&self.subscribers).push(Subscriber { sender, lost: lost.clone() });
        lost
    }

    pub(super) fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }
}
