//! Streams of a node, as a board reads them: the newest value of each, with its age, in memory that the application lends.

use core::cell::{Cell, RefCell};
use core::fmt;
use core::future::poll_fn;
use core::task::Poll;

use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::{ParametersInner, ParametersView};
use cara_core::error::{Error, Limit};
use cara_core::services::session::{Event, ReplyBlock};
use cara_core::time::{Duration, Instant};
use cara_core::typed::Variables;
use embassy_sync::waitqueue::WakerRegistration;

use crate::event::Name;
use crate::handle::Handle;
use crate::machine::{Link, Machine};
use crate::peer::Peer;
use crate::time::now;

/// Room for the newest value of a stream of a node: `BYTES` of its variables, with their names. One that is longer is refused
/// with [`Error::Full`]. Each subscription has one of its own.
pub type SubscriptionCell<const BYTES: usize> = SubscriptionInner<[u8; BYTES]>;

/// [`SubscriptionCell`] of any size; not named directly.
pub struct SubscriptionInner<B: ?Sized> {
    /// The unit's other subscriptions.
    next: Cell<Option<&'static Reading>>,
    state: RefCell<State>,
    values: RefCell<ParametersInner<B>>,
}

/// The cell of a subscription, whatever its size.
pub(crate) type Reading = SubscriptionInner<[u8]>;

struct State {
    /// What it is for; `None` while it is free.
    wanted: Option<Wanted>,
    /// Values that have come.
    count: u32,
    /// The newest one is here.
    is_there: bool,
    arrived: Instant,
    /// On arrival.
    age: Duration,
    refused: Option<Error>,
    task: WakerRegistration,
}

struct Wanted {
    peer: Identity,
    stream: Name,
    interval: Duration,
}

impl<const BYTES: usize> SubscriptionInner<[u8; BYTES]> {
    /// Free, and without a value.
    pub const fn new() -> Self {
        let state = State {
            wanted: None,
            count: 0,
            is_there: false,
            arrived: Instant::START,
            age: Duration::ZERO,
            refused: None,
            task: WakerRegistration::new(),
        };
        Self { next: Cell::new(None), state: RefCell::new(state), values: RefCell::new(ParametersInner::sized()) }
    }
}

impl<const BYTES: usize> Default for SubscriptionInner<[u8; BYTES]> {
    fn default() -> Self {
        Self::new()
    }
}

impl<B: ?Sized> fmt::Debug for SubscriptionInner<B> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SubscriptionCell").finish_non_exhaustive()
    }
}

impl Reading {
    fn is_of(&self, peer: &Identity, stream: &str) -> bool {
        self.state.borrow().wanted.as_ref().is_some_and(|wanted| wanted.peer == *peer && wanted.stream == stream)
    }

    fn receive(&self, now: Instant, age: Duration, block: &ReplyBlock<'_>) {
        let mut values = self.values.borrow_mut();
        // Each time: the node may have published the stream with other variables.
        let outcome = values.lay_out(block.signature()).and_then(|()| block.read_into(&mut values));
        let state = &mut *self.state.borrow_mut();
        (state.refused, state.is_there) = (outcome.err(), outcome.is_ok());
        (state.arrived, state.age) = (now, age);
        state.count = state.count.wrapping_add(1);
        state.task.wake();
    }

    fn was_answered(&self, answer: Option<Error>) {
        let mut state = self.state.borrow_mut();
        state.refused = answer;
        state.task.wake();
    }
}

/// The subscriptions of a unit: a list of the cells.
pub(crate) struct Readings(Option<&'static Reading>);

impl Readings {
    pub(crate) const NONE: Self = Self(None);

    fn iter(&self) -> impl Iterator<Item = &'static Reading> + use<> {
        core::iter::successors(self.0, |reading| reading.next.get())
    }

    fn of(&self, peer: &Identity, stream: &str) -> impl Iterator<Item = &'static Reading> {
        self.iter().filter(move |reading| reading.is_of(peer, stream))
    }

    fn add(&mut self, reading: &'static Reading) {
        reading.next.set(self.0.replace(reading));
    }

    fn remove(&mut self, reading: &'static Reading) {
        let next = reading.next.take();
        match self.iter().find(|other| other.next.get().is_some_and(|next| core::ptr::eq(next, reading))) {
            Some(before) => before.next.set(next),
            None => self.0 = next,
        }
    }
}

/// A value of a stream has come, if that is what happened.
pub(crate) fn came(readings: &Readings, link: &Link, now: Instant, event: &Event, lent: &[u8]) {
    let Event::Sample(sample) = event else { return };
    let Some(session) = &link.session else { return };
    let Some((peer, block)) = session.peer().zip(session.results(&sample.values, lent).ok()) else { return };
    readings.of(peer, block.signature().name()).for_each(|reading| reading.receive(now, sample.age, &block));
}

impl<T> Machine<T> {
    /// What a node says of this unit's subscriptions.
    pub(crate) fn note_subscriptions(&mut self, index: u16, event: &Event) {
        match *event {
            Event::ListChanged => {
                for reading in self.readings.iter() {
                    self.notify_subscription(index, reading);
                }
            }
            Event::Subscribed(slot, answer) => {
                let Some(session) = self.link(index).and_then(|link| link.session.as_ref()) else { return };
                let stream = session.their_function_list().function(slot);
                let Some((peer, stream)) = session.peer().zip(stream) else { return };
                self.readings.of(peer, stream.name()).for_each(|reading| reading.was_answered(answer.err()));
            }
            _ => {}
        }
    }

    /// Tells the node of a link what is wanted of the stream of a cell: of several subscriptions to it the shortest interval.
    fn notify_subscription(&mut self, index: u16, reading: &Reading) {
        let state = reading.state.borrow();
        let Some(Wanted { peer, stream, .. }) = &state.wanted else { return };
        if self.link(index).and_then(Link::peer) != Some(peer) {
            return;
        }
        let interval = |reading: &Reading| Some(reading.state.borrow().wanted.as_ref()?.interval);
        let interval = self.readings.of(peer, stream).filter_map(interval).min();
        let reported = self.with(index, |session, cx| match interval {
            Some(interval) => session.subscribe(cx, stream, interval).map(drop),
            None => {
                session.unsubscribe(cx, stream);
                Ok(())
            }
        });
        drop(state);
        if let Some(Err(error @ Error::UnknownFunction)) = reported {
            reading.was_answered(Some(error));
        }
    }

    fn begin_reading(&mut self, reading: &'static Reading) {
        self.readings.add(reading);
        self.indices().for_each(|index| self.notify_subscription(index, reading));
    }

    fn end_reading(&mut self, reading: &'static Reading) {
        self.readings.remove(reading);
        self.indices().for_each(|index| self.notify_subscription(index, reading));
        reading.state.borrow_mut().wanted = None;
    }
}

impl<T> Peer<T> {
    /// Has the node send values of its stream at least `interval` apart, as often as it grants with zero, until the subscription
    /// is dropped. The last value comes at once; after a reconnection the subscription is made again by itself. The newest value
    /// is kept in `cell`.
    ///
    /// [`Error::Full`] while the cell has another subscription, [`Error::BadName`]. What the node refuses, and a stream that it
    /// does not have, [`Subscription::next`] tells.
    pub fn subscribe<const BYTES: usize>(
        &self,
        stream: &str,
        interval: Duration,
        cell: &'static SubscriptionCell<BYTES>,
    ) -> Result<Subscription<T>, Error> {
        let stream = Name::try_from(stream).map_err(|_| Error::BadName)?;
        {
            let state = &mut *cell.state.borrow_mut();
            if state.wanted.is_some() {
                return Err(Error::Full(Limit::Subscriptions));
            }
            state.wanted = Some(Wanted { peer: self.identity.clone(), stream, interval });
            (state.is_there, state.refused) = (false, None);
        }
        let reading: &'static Reading = cell;
        let seen = reading.state.borrow().count;
        self.unit.act(|machine| machine.begin_reading(reading));
        Ok(Subscription { unit: self.unit, reading, seen })
    }
}

/// A subscription to a stream of a node; it ends when it is dropped.
#[must_use = "dropped, it ends"]
pub struct Subscription<T: 'static> {
    unit: Handle<T>,
    reading: &'static Reading,
    /// Values that had come when the last one was told.
    seen: u32,
}

impl<T> fmt::Debug for Subscription<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Subscription").finish_non_exhaustive()
    }
}

impl<T> Subscription<T> {
    /// Lends the newest value and its age, which is never too low; `None` until one has come. It stays when the node leaves, and
    /// grows older.
    pub fn latest<R>(&self, look: impl FnOnce(&ParametersView, Duration) -> R) -> Option<R> {
        let age = {
            let state = self.reading.state.borrow();
            state.is_there.then(|| state.age + now().since(state.arrived))
        };
        age.map(|age| look(&self.reading.values.borrow(), age))
    }

    /// The newest value as a struct that derives [`Variables`], and its age; `None` until one has come. Errors as of
    /// [`Variables::from_parameters`], where the node's stream has other variables.
    pub fn newest<V: Variables>(&self) -> Option<Result<(V, Duration), Error>> {
        self.latest(|values, age| Ok((V::from_parameters(values)?, age)))
    }

    /// Waits for the next value, which [`latest`](Self::latest) then lends: of those that come meanwhile, the newest. Cancelling
    /// loses nothing.
    ///
    /// [`Error::NotAllowed`], [`Error::UnknownFunction`], [`Error::StaleFunction`] or [`Error::Full`] where the node grants no
    /// subscription, until its list changes, or the cell is too small.
    pub async fn next(&mut self) -> Result<(), Error> {
        poll_fn(|cx| {
            let state = &mut *self.reading.state.borrow_mut();
            if let Some(error) = state.refused {
                return Poll::Ready(Err(error));
            }
            if state.count == self.seen {
                state.task.register(cx.waker());
                return Poll::Pending;
            }
            self.seen = state.count;
            Poll::Ready(Ok(()))
        })
        .await
    }
}

impl<T> Drop for Subscription<T> {
    fn drop(&mut self) {
        self.unit.act(|machine| machine.end_reading(self.reading));
    }
}
