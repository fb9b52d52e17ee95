//! The channels and queues that are told what happens to a unit.

#[cfg(feature = "async")]
use std::sync::Weak;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{SyncSender, TrySendError};
use std::sync::{Arc, Mutex};

#[cfg(feature = "async")]
use crate::asynchronous::EventQueue;
use crate::event::UnitEvent;
use crate::locks::Rank;

#[derive(Default)]
pub(crate) struct Events {
    subscribers: Mutex<Vec<Subscriber>>,
    /// Events that any subscriber lost.
    lost: AtomicU64,
}

enum Subscriber {
    Channel {
        sender: SyncSender<UnitEvent>,
        /// Events that found no room.
        lost: Arc<AtomicU64>,
    },
    #[cfg(feature = "async")]
    Queue(Weak<EventQueue>),
}

/// What became of an event at a subscriber.
pub(crate) enum Delivered {
    Kept,
    Lost,
    Gone,
}

impl Events {
    /// A subscriber that does not keep up loses the event, and one that is gone is forgotten.
    pub(super) fn notify(&self, event: &UnitEvent) {
        tracing::debug!(?event);
        let mut subscribers = Rank::Leaf.lock(&self.subscribers);
        subscribers.retain(|subscriber| match subscriber.notify(event) {
            Delivered::Kept => true,
            Delivered::Lost => {
                self.lost.fetch_add(1, Ordering::Relaxed);
                true
            }
            Delivered::Gone => false,
        });
        #[cfg(feature = "async")]
        {
            let queues = subscribers.iter().filter_map(Subscriber::queue).collect::<Vec<_>>();
            // A waker may run code of an executor: without the lock.
            drop(subscribers);
            queues.iter().for_each(|queue| queue.wake());
        }
    }

    /// Tells `sender` what happens from here on; what is returned counts the events that found no room.
    pub(crate) fn subscribe(&self, sender: SyncSender<UnitEvent>) -> Arc<AtomicU64> {
        let lost = Arc::new(AtomicU64::new(0));
        Rank::Leaf.lock(&self.subscribers).push(Subscriber::Channel { sender, lost: lost.clone() });
        lost
    }

    #[cfg(feature = "async")]
    pub(crate) fn subscribe_queue(&self, queue: &Arc<EventQueue>) {
        Rank::Leaf.lock(&self.subscribers).push(Subscriber::Queue(Arc::downgrade(queue)));
    }

    /// No queue is told anything any more, so that its stream ends.
    #[cfg(feature = "async")]
    pub(crate) fn end_queues(&self) {
        let mut subscribers = Rank::Leaf.lock(&self.subscribers);
        let queues = subscribers.iter().filter_map(Subscriber::queue).collect::<Vec<_>>();
        subscribers.retain(|subscriber| !matches!(subscriber, Subscriber::Queue(_)));
        drop(subscribers);
        queues.iter().for_each(|queue| queue.end());
    }

    pub(super) fn lost(&self) -> u64 {
        self.lost.load(Ordering::Relaxed)
    }
}

impl Subscriber {
    fn notify(&self, event: &UnitEvent) -> Delivered {
        match self {
            Self::Channel { sender, lost } => match sender.try_send(event.clone()) {
                Ok(()) => Delivered::Kept,
                Err(TrySendError::Full(_)) => {
                    lost.fetch_add(1, Ordering::Relaxed);
                    Delivered::Lost
                }
                Err(TrySendError::Disconnected(_)) => Delivered::Gone,
            },
            #[cfg(feature = "async")]
            Self::Queue(queue) => queue.upgrade().map_or(Delivered::Gone, |queue| queue.put(event)),
        }
    }

    #[cfg(feature = "async")]
    fn queue(&self) -> Option<Arc<EventQueue>> {
        match self {
            Self::Channel { .. } => None,
            Self::Queue(queue) => queue.upgrade(),
        }
    }
}

/// However the unit ends, the streams of its events do.
#[cfg(feature = "async")]
impl Drop for Events {
    fn drop(&mut self) {
        self.end_queues();
    }
}
