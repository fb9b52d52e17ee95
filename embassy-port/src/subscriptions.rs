//! Streams of a node, as a board reads them: the newest value of each, with its age.

use core::fmt;
use core::future::poll_fn;
use core::task::Poll;

use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, Limit};
use cara_core::services::session::Event;
use cara_core::time::Duration;
use cara_core::typed::Variables;

use crate::event::Name;
use crate::handle::Handle;
use crate::link::Link;
use crate::machine::Machine;
use crate::peer::Peer;
use crate::readings::{Reading, SubscriptionCell, Wanted};
use crate::time::now;

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

    /// Ends those that were dropped while the machine was in use.
    fn end_dropped(&mut self) {
        while let Some(reading) = self.readings.iter().find(|reading| reading.is_dropped.take()) {
            self.end_reading(reading);
        }
    }
}

impl<T> Peer<T> {
    /// Has the node send values of its stream at least `interval` apart, as often as it grants with zero, until the subscription
    /// is dropped. The last value comes at once; after a reconnection the subscription is made again by itself. The newest value
    /// is kept in `cell`.
    ///
    /// [`Error::Full`] while the cell has another subscription, [`Error::BadName`]. What the node refuses, and a stream that it
    /// does not have, [`Subscription::next`] tells.
    ///
    /// ```
    /// use cara_core::error::Error;
    /// use cara_core::time::Duration;
    /// use cara_embassy::{Peer, SubscriptionCell};
    ///
    /// async fn follow<T>(agv: &Peer<T>, cell: &'static SubscriptionCell<64>) -> Result<(), Error> {
    ///     let mut pose = agv.subscribe("pose", Duration::from_millis(100), cell)?;
    ///     loop {
    ///         pose.next().await?;
    ///         let position = pose.latest(|values, _age| values.variable::<[f64; 2]>("position"));
    ///         // … `position` is `Some`: a value has come …
    ///     }
    /// }
    /// ```
    pub fn subscribe<const BYTES: usize>(
        &self,
        stream: &str,
        interval: Duration,
        cell: &'static SubscriptionCell<BYTES>,
    ) -> Result<Subscription<T>, Error> {
        let stream = Name::try_from(stream).map_err(|_| Error::BadName)?;
        // A subscription that was dropped may have the cell still.
        self.unit.act(|machine| self.unit.shared.unwanted.release(machine));
        {
            let () = Self::MAY_CALL;
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
            let (refused, count) = {
                let state = self.reading.state.borrow();
                (state.refused, state.count)
            };
            if let Some(error) = refused {
                return Poll::Ready(Err(error));
            }
            if count == self.seen {
                self.reading.register(cx.waker());
                return Poll::Pending;
            }
            self.seen = count;
            Poll::Ready(Ok(()))
        })
        .await
    }
}

impl<T> Drop for Subscription<T> {
    fn drop(&mut self) {
        match self.unit.shared.machine.try_borrow_mut() {
            Ok(mut machine) => {
                machine.end_reading(self.reading);
                machine.wake_runner();
            }
            Err(_) => {
                self.reading.is_dropped.set(true);
                self.unit.shared.unwanted.readings.set(Some(Machine::end_dropped));
            }
        }
    }
}
