//! A unit's events as a stream.

use std::collections::VecDeque;
use std::fmt;
use std::future::poll_fn;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};

use futures_core::Stream;
use futures_core::stream::FusedStream;

use crate::engine::Delivered;
use crate::event::UnitEvent;
use crate::locks::lock;

/// So many events were lost here, because the stream was full: what they would have told is to be looked up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0} events were lost, because they were not taken in time: look up what is connected, and what runs")]
pub struct EventsLost(pub u64);

/// What a unit and its streams share.
#[derive(Debug)]
pub(crate) struct EventQueue {
    state: Mutex<State>,
    room: usize,
    lost: AtomicU64,
}

#[derive(Debug, Default)]
struct State {
    /// With one entry beyond the room at most, which counts the events that found none.
    waiting: VecDeque<Result<UnitEvent, EventsLost>>,
    task: Option<Waker>,
    ended: bool,
}

impl EventQueue {
    pub(super) fn new(room: usize) -> Arc<Self> {
        Arc::new(Self { state: Mutex::default(), room, lost: AtomicU64::new(0) })
    }

    /// Keeps an event, or counts it as lost, at its place. The task is woken by [`wake`](Self::wake).
    pub(crate) fn put(&self, event: &UnitEvent) -> Delivered {
        let waiting = &mut lock(&self.state).waiting;
        if waiting.len() < self.room {
            waiting.push_back(Ok(event.clone()));
            return Delivered::Kept;
        }
        match waiting.back_mut() {
            Some(Err(EventsLost(count))) => *count += 1,
            _ => waiting.push_back(Err(EventsLost(1))),
        }
        self.lost.fetch_add(1, Ordering::Relaxed);
        Delivered::Lost
    }

    /// Wakes the task that waits, if there is something for it.
    pub(crate) fn wake(&self) {
        let mut state = lock(&self.state);
        let is_due = state.ended || !state.waiting.is_empty();
        let task = if is_due { state.task.take() } else { None };
        drop(state);
        task.into_iter().for_each(Waker::wake);
    }

    /// Nothing more comes.
    pub(crate) fn end(&self) {
        lock(&self.state).ended = true;
        self.wake();
    }

    fn poll_next(&self, cx: &Context<'_>) -> Poll<Option<Result<UnitEvent, EventsLost>>> {
        let mut state = lock(&self.state);
        if let Some(event) = state.waiting.pop_front() {
            return Poll::Ready(Some(event));
        }
        if state.ended {
            return Poll::Ready(None);
        }
        let earlier = state.task.replace(cx.waker().clone());
        drop(state);
        drop(earlier);
        Poll::Pending
    }
}

/// The events of a unit from [`Handle::events_async`](crate::Handle::events_async) on, in their order, until the unit is
/// stopped. Bounded: where its task does not keep up, an [`EventsLost`] stands in place of those that found no room.
///
/// Dropping the stream ends the subscription. Dropping what [`next`](Self::next) returns loses no event.
#[must_use = "events are taken by `next`"]
pub struct EventStream {
    queue: Arc<EventQueue>,
}

impl EventStream {
    pub(super) const fn new(queue: Arc<EventQueue>) -> Self {
        Self { queue }
    }

    /// The next event; `None` when the unit has been stopped and all have been taken.
    pub async fn next(&mut self) -> Option<Result<UnitEvent, EventsLost>> {
        poll_fn(|cx| self.queue.poll_next(cx)).await
    }

    /// How many events this stream has lost so far, those included that it has yet to tell.
    pub fn lost(&self) -> u64 {
        self.queue.lost.load(Ordering::Relaxed)
    }
}

impl fmt::Debug for EventStream {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("EventStream").field("lost", &self.lost()).finish_non_exhaustive()
    }
}

impl Stream for EventStream {
    type Item = Result<UnitEvent, EventsLost>;

    fn poll_next(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.queue.poll_next(cx)
    }
}

impl FusedStream for EventStream {
    fn is_terminated(&self) -> bool {
        let state = lock(&self.queue.state);
        state.ended && state.waiting.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(name: &str) -> UnitEvent {
        UnitEvent::NetworkChanged { up: vec![name.to_owned()] }
    }

    #[test]
    fn what_finds_no_room_is_counted_where_it_would_have_stood() {
        let queue = EventQueue::new(2);
        let mut cx = Context::from_waker(Waker::noop());
        let mut stream = EventStream::new(queue.clone());
        let mut next = || Pin::new(&mut stream).poll_next(&mut cx);
        for name in ["a", "b", "c", "d"] {
            queue.put(&event(name));
        }
        assert_eq!(next(), Poll::Ready(Some(Ok(event("a")))));
        assert!(matches!(queue.put(&event("e")), Delivered::Lost), "the mark of what is lost takes a place");
        assert_eq!(next(), Poll::Ready(Some(Ok(event("b")))));
        queue.put(&event("f"));
        assert_eq!(next(), Poll::Ready(Some(Err(EventsLost(3)))));
        assert_eq!(next(), Poll::Ready(Some(Ok(event("f")))));
        assert_eq!(next(), Poll::Pending);
        queue.end();
        assert_eq!(next(), Poll::Ready(None));
        assert_eq!((stream.lost(), stream.is_terminated()), (3, true));
    }
}
