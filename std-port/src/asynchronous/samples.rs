//! A stream of a node, as a stream of tasks.

use std::fmt;
use std::future::poll_fn;
use std::pin::Pin;
use std::task::{Context, Poll};

use cara_core::error::Error;
use cara_core::time::Duration;
use futures_core::Stream;
use futures_core::stream::FusedStream;

use crate::engine::Alarm;
use crate::stream::{Sample, Subscription, TheirStream};

impl<T: Send + 'static> TheirStream<T> {
    /// As [`subscribe`](Self::subscribe), for a task.
    ///
    /// ```no_run
    /// # async fn follow(depot: cara_std::CommunicationSystem) -> Result<(), cara_std::Error> {
    /// use cara_std::Duration;
    ///
    /// let mut pose = depot.s_unit("agv-07")?.stream("pose")?.subscribe_async(Duration::from_millis(100));
    /// while let Some(sample) = pose.next().await {
    ///     let sample = sample?;
    ///     let [x, y]: [f64; 2] = sample.value("position")?;
    ///     println!("{x} {y}, {} ms ago", sample.age().as_millis());
    /// }
    /// # Ok(())
    /// # }
    /// ```
    pub fn subscribe_async(&self, interval: impl Into<Duration>) -> SampleStream<T> {
        SampleStream::new(self.subscribe(interval))
    }
}

/// The values of a stream of a node as they come, from [`TheirStream::subscribe_async`]. Bounded: of the values that came
/// since the last one was taken, the newest is returned, and the others are passed over.
///
/// An error is the last item: [`Error::NotAllowed`], [`Error::UnknownFunction`], [`Error::StaleFunction`] or [`Error::Full`]
/// where the node grants no subscription, [`Error::NotRunning`] when this unit has been stopped. While the node is away the
/// stream waits.
///
/// Dropping it ends the subscription. Dropping what [`next`](Self::next) returns loses no value.
#[must_use = "values are taken by `next`"]
pub struct SampleStream<T: Send + 'static = ()> {
    subscription: Subscription<T>,
    /// Goes off when the handle's pace lets another value through.
    alarm: Alarm,
    ended: bool,
}

impl<T: Send + 'static> SampleStream<T> {
    fn new(subscription: Subscription<T>) -> Self {
        let alarm = Alarm::new(subscription.engine().driver.clone());
        Self { subscription, alarm, ended: false }
    }

    /// The next value; `None` behind an error.
    pub async fn next(&mut self) -> Option<Result<Sample, Error>> {
        poll_fn(|cx| self.poll(cx)).await
    }

    /// The newest value, as of [`Subscription::latest`].
    pub fn latest(&self) -> Option<Sample> {
        self.subscription.latest()
    }

    fn poll(&mut self, cx: &Context<'_>) -> Poll<Option<Result<Sample, Error>>> {
        if self.ended {
            return Poll::Ready(None);
        }
        let polled = self.subscription.poll_next(cx.waker(), &mut self.alarm);
        if let Poll::Ready(Err(_)) = polled {
            self.ended = true;
        }
        polled.map(Some)
    }
}

impl<T: Send + 'static> fmt::Debug for SampleStream<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("SampleStream").field(&self.subscription).finish()
    }
}

impl<T: Send + 'static> Stream for SampleStream<T> {
    type Item = Result<Sample, Error>;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        self.poll(cx)
    }
}

impl<T: Send + 'static> FusedStream for SampleStream<T> {
    fn is_terminated(&self) -> bool {
        self.ended
    }
}
