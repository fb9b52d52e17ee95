//! The newest values of streams of nodes, in memory that the application lends.

use core::cell::{Cell, RefCell};
use core::fmt;
use core::task::Waker;

use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::ParametersInner;
use cara_core::error::Error;
use cara_core::services::session::{Event, ReplyBlock};
use cara_core::time::{Duration, Instant};
use embassy_sync::waitqueue::WakerRegistration;

use crate::event::Name;
use crate::link::Link;

/// Room for the newest value of a stream of a node: `BYTES` of its variables, with their names. One that is longer is refused
/// with [`Error::Full`]. Each subscription has one of its own.
pub type SubscriptionCell<const BYTES: usize> = SubscriptionInner<[u8; BYTES]>;

/// [`SubscriptionCell`] of any size; not named directly.
pub struct SubscriptionInner<B: ?Sized> {
    /// The unit's other subscriptions.
    next: Cell<Option<&'static Reading>>,
    /// Its subscription was dropped while the machine was in use.
    pub(crate) is_dropped: Cell<bool>,
    pub(crate) state: RefCell<State>,
    /// The task that waits for values. Apart, since it may end with its waker, and with it another subscription.
    task: Cell<WakerRegistration>,
    pub(crate) values: RefCell<ParametersInner<B>>,
}

/// The cell of a subscription, whatever its size.
pub(crate) type Reading = SubscriptionInner<[u8]>;

pub(crate) struct State {
    /// What it is for; `None` while it is free.
    pub(crate) wanted: Option<Wanted>,
    /// Values that have come.
    pub(crate) count: u32,
    /// The newest one is here.
    pub(crate) is_there: bool,
    pub(crate) arrived: Instant,
    /// On arrival.
    pub(crate) age: Duration,
    pub(crate) refused: Option<Error>,
}

pub(crate) struct Wanted {
    pub(crate) peer: Identity,
    pub(crate) stream: Name,
    pub(crate) interval: Duration,
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
        };
        Self {
            next: Cell::new(None),
            is_dropped: Cell::new(false),
            state: RefCell::new(state),
            task: Cell::new(WakerRegistration::new()),
            values: RefCell::new(ParametersInner::sized()),
        }
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
    pub(crate) fn is_of(&self, peer: &Identity, stream: &str) -> bool {
        self.state.borrow().wanted.as_ref().is_some_and(|wanted| wanted.peer == *peer && wanted.stream == stream)
    }

    pub(crate) fn receive(&self, now: Instant, age: Duration, block: &ReplyBlock<'_>) {
        {
            let mut values = self.values.borrow_mut();
            // Each time: the node may have published the stream with other variables.
            let outcome = values.lay_out(block.signature()).and_then(|()| block.read_into(&mut values));
            let state = &mut *self.state.borrow_mut();
            (state.refused, state.is_there) = (outcome.err(), outcome.is_ok());
            (state.arrived, state.age) = (now, age);
            state.count = state.count.wrapping_add(1);
        }
        self.task.take().wake();
    }

    pub(crate) fn was_answered(&self, answer: Option<Error>) {
        self.state.borrow_mut().refused = answer;
        self.task.take().wake();
    }

    pub(crate) fn register(&self, waker: &Waker) {
        let mut task = self.task.take();
        task.register(waker);
        self.task.set(task);
    }
}

/// The subscriptions of a unit: a list of the cells.
pub(crate) struct Readings(Option<&'static Reading>);

impl Readings {
    pub(crate) const NONE: Self = Self(None);

    pub(crate) fn iter(&self) -> impl Iterator<Item = &'static Reading> + use<> {
        core::iter::successors(self.0, |reading| reading.next.get())
    }

    pub(crate) fn of(&self, peer: &Identity, stream: &str) -> impl Iterator<Item = &'static Reading> {
        self.iter().filter(move |reading| reading.is_of(peer, stream))
    }

    pub(crate) fn add(&mut self, reading: &'static Reading) {
        reading.next.set(self.0.replace(reading));
    }

    pub(crate) fn remove(&mut self, reading: &'static Reading) {
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
