//! Streams: named values that change. A unit publishes them, and reads those of its nodes.

use std::fmt;
use std::marker::PhantomData;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
#[cfg(feature = "async")]
use std::task::{Poll, Waker};

use cara_core::config::Priority;
use cara_core::distribution::block;
use cara_core::distribution::function::{Attributes, Definition, Signature};
use cara_core::distribution::parameters::{FromValue, ParametersView};
use cara_core::error::{Error, ServiceError};
use cara_core::time::{Duration, Instant};
use cara_core::typed::{self, Variables};

#[cfg(feature = "async")]
use crate::engine::Alarm;
use crate::engine::streams::{OwnStream, Received, Watched};
use crate::engine::{Engine, arena, arena_bytes};
use crate::handler::{Handler, Run};
use crate::my_function_list::MyFunctionList;
use crate::peer::Peer;

/// How often a wait looks whether the unit still runs.
const LOOK: Duration = Duration::from_millis(100);

/// A stream of this unit.
///
/// Its newest value goes to each subscriber as often as that one wants it; what was not sent yet, the next value replaces.
pub struct Stream<T: Send + 'static = ()> {
    engine: Arc<Engine<T>>,
    definition: Definition,
    pub(crate) own: Arc<OwnStream>,
}

impl<T: Send + 'static> Clone for Stream<T> {
    fn clone(&self) -> Self {
        Self { engine: self.engine.clone(), definition: self.definition.clone(), own: self.own.clone() }
    }
}

impl<T: Send + 'static> fmt::Debug for Stream<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Stream").field("definition", &self.definition).finish_non_exhaustive()
    }
}

impl<T: Send + 'static> Stream<T> {
    /// Publishes a new value. It returns at once; where no node is subscribed, the value is kept for the next one.
    ///
    /// [`Error::MissingArgument`], [`Error::WrongType`] and [`Error::WrongSize`] where `values` are not what the stream
    /// declares: the value before stays then.
    pub fn publish(&self, values: &ParametersView) -> Result<(), Error> {
        let now = self.engine.now();
        self.own.put(|newest| newest.publish(now, Duration::ZERO, self.definition.signature(), values))?;
        self.engine.stream_published();
        Ok(())
    }

    /// Its name and its values.
    pub const fn definition(&self) -> &Definition {
        &self.definition
    }
}

/// A stream of this unit whose values are those of a struct.
pub struct Publisher<V, T: Send + 'static = ()> {
    stream: Stream<T>,
    values: PhantomData<fn(&V)>,
}

impl<V, T: Send + 'static> Clone for Publisher<V, T> {
    fn clone(&self) -> Self {
        Self { stream: self.stream.clone(), values: PhantomData }
    }
}

impl<V, T: Send + 'static> fmt::Debug for Publisher<V, T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.stream.fmt(f)
    }
}

impl<V: Variables, T: Send + 'static> Publisher<V, T> {
    /// As [`Stream::publish`].
    pub fn publish(&self, value: &V) -> Result<(), Error> {
        value.with_parameters(|values| self.stream.publish(values))?
    }
}

impl<T: Send + 'static> MyFunctionList<'_, T> {
    /// Adds a stream, as made by [`Definition::stream`]. A subscriber gets its values at least `least_interval` apart, in whole
    /// milliseconds, up to 65 s. Like a function it is seen by those to which the list is published.
    ///
    /// ```no_run
    /// use cara_std::{Definition, Duration, Parameters, Unit};
    ///
    /// let agv = Unit::new("agv", 7, "depot", 1)?;
    /// let pose = Definition::stream("pose(position: float[2])").expect("it is a stream");
    /// let pose = agv.my_function_list().add_stream(&pose, Duration::from_millis(20))?;
    /// agv.publish_my_function_list()?;
    ///
    /// let mut values = Parameters::new();
    /// values.add_float("position", 2)?;
    /// values.set_value("position", [3.0, 4.0])?;
    /// pose.publish(&values)?;
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    ///
    /// [`Error::TooLarge`] when its values are declared larger than any message, and what
    /// [`add_service`](Self::add_service) refuses.
    pub fn add_stream(&self, definition: &Definition, least_interval: impl Into<Duration>) -> Result<Stream<T>, Error> {
        let limit = arena_bytes(usize::MAX);
        let bytes = block::longest(definition.signature().results()).filter(|bytes| *bytes <= limit);
        let own = Arc::new(OwnStream::new(bytes.ok_or(Error::TooLarge { limit: limit as u32 })?));
        let least = u16::try_from(least_interval.into().as_millis()).unwrap_or(u16::MAX);
        let attributes = Attributes { priority: Priority::Low, stream: Some(least), ..Attributes::default() };
        // Never run: a call of a stream is refused before.
        let run = Run::Free(Arc::new(|_, _| Err(ServiceError::NotReady)));
        let handler = Handler {
            number: Handler::<T>::next_number(),
            run,
            actuator: None,
            moves: false,
            held_long: AtomicBool::new(false),
            executor: None,
            stream: Some(own.clone()),
            #[cfg(feature = "async")]
            to_its_end: false,
        };
        self.engine.services.functions_mut().add_function(definition, attributes, handler)?;
        Ok(Stream { engine: self.engine.clone(), definition: definition.clone(), own })
    }

    /// As [`add_stream`](Self::add_stream), for a stream of a struct that derives [`Variables`].
    ///
    /// ```no_run
    /// # #[cfg(feature = "derive")] {
    /// use cara_std::{Duration, Unit, Variables};
    ///
    /// #[derive(Variables)]
    /// struct Pose {
    ///     position: [f64; 2],
    /// }
    ///
    /// # fn run(agv: Unit) -> Result<(), cara_std::Error> {
    /// let pose = agv.my_function_list().add_stream_of::<Pose>("pose", Duration::from_millis(20))?;
    /// agv.publish_my_function_list()?;
    /// pose.publish(&Pose { position: [3.0, 4.0] })
    /// # }
    /// # }
    /// ```
    pub fn add_stream_of<V: Variables>(
        &self,
        name: &str,
        least_interval: impl Into<Duration>,
    ) -> Result<Publisher<V, T>, Error> {
        let stream = self.add_stream(&typed::stream_of::<V>(name)?, least_interval)?;
        Ok(Publisher { stream, values: PhantomData })
    }

    pub(crate) fn stream(&self, name: &str) -> Option<Stream<T>> {
        let functions = self.engine.services.functions();
        let function = functions.function(functions.find(name)?)?;
        let own = function.handler.stream.clone()?;
        Some(Stream { engine: self.engine.clone(), definition: function.signature.to_definition(), own })
    }
}

/// A stream of a node.
pub struct TheirStream<T: Send + 'static = ()> {
    peer: Peer<T>,
    definition: Definition,
    least_interval: Duration,
}

impl<T: Send + 'static> fmt::Debug for TheirStream<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TheirStream").field("definition", &self.definition).finish_non_exhaustive()
    }
}

impl<T: Send + 'static> Peer<T> {
    /// A stream that the node has published to this unit. [`Error::UnknownFunction`] where it has none of this name,
    /// [`Error::NotConnected`].
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// use cara_std::Duration;
    ///
    /// let mut pose = depot.s_unit("agv-07")?.stream("pose")?.subscribe(Duration::from_millis(100));
    /// let sample = pose.next(Duration::from_secs(5))?;
    /// let [x, y]: [f64; 2] = sample.values().variable("position")?;
    /// println!("{x} {y}, {} ms ago", sample.age().as_millis());
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn stream(&self, name: &str) -> Result<TheirStream<T>, Error> {
        let link = self.link()?;
        let state = link.lock();
        let known = state.session.their_function_list().named(name);
        let (stream, least) =
            known.and_then(|known| Some((known, known.attributes.stream?))).ok_or(Error::UnknownFunction)?;
        let definition = stream.signature.to_definition();
        drop(state);
        Ok(TheirStream { peer: self.clone(), definition, least_interval: Duration::from_millis(least.into()) })
    }

    /// The streams that the node has published to this unit.
    pub fn streams(&self) -> Vec<TheirStream<T>> {
        let names = self.their_function_list();
        names.names().filter_map(|name| self.stream(name).ok()).collect()
    }
}

impl<T: Send + 'static> TheirStream<T> {
    /// Its name and its values.
    pub const fn definition(&self) -> &Definition {
        &self.definition
    }

    /// The shortest interval that the node grants.
    pub const fn least_interval(&self) -> Duration {
        self.least_interval
    }

    /// Has the node send values at least `interval` apart, until the subscription is dropped; with zero as often as it grants.
    /// The last value comes at once. After a reconnection the subscription is made again by itself.
    pub fn subscribe(&self, interval: impl Into<Duration>) -> Subscription<T> {
        self.subscription(interval.into(), false)
    }

    /// As [`subscribe`](Self::subscribe), as often as the node grants; a reader that is late gets the values that came meanwhile one
    /// after another, up to 64 KiB of them.
    #[cfg(feature = "control")]
    pub(crate) fn subscribe_to_each(&self) -> Subscription<T> {
        self.subscription(Duration::ZERO, true)
    }

    fn subscription(&self, interval: Duration, each: bool) -> Subscription<T> {
        let (watched, id) = self.peer.cell.streams.subscribe(self.definition.name(), interval, each);
        self.peer.engine.tell_interval(&self.peer.cell, &watched);
        Subscription { peer: self.peer.clone(), watched, id, interval, seen: 0, due: Instant::START }
    }
}

/// A value of a stream of a node, with its age.
#[derive(Clone)]
pub struct Sample {
    received: Received,
    age: Duration,
}

impl fmt::Debug for Sample {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Sample").field("signature", &self.signature()).field("age", &self.age).finish_non_exhaustive()
    }
}

impl Sample {
    /// How old it was when it was returned; never too low, and at most by the time that a keep-alive takes too high.
    pub const fn age(&self) -> Duration {
        self.age
    }

    /// The stream that it is of.
    pub fn signature(&self) -> Signature<'_> {
        // It was read from the node's list.
        Signature::decode(&self.received.signature).expect("a node's list has what can be read alone")
    }

    /// The values.
    pub fn values(&self) -> Box<ParametersView> {
        let mut values = arena(self.received.block.len());
        // Checked when it came.
        let _ = self.read_into(&mut values);
        values
    }

    /// Puts the values into `parameters`, as the results of a call; on an error they are unchanged.
    pub fn read_into(&self, parameters: &mut ParametersView) -> Result<(), Error> {
        block::read(self.signature().results(), &self.received.block, parameters)
    }

    /// Its values as a struct that derives [`Variables`]; errors as of [`Variables::from_parameters`], where the node's stream
    /// has other variables.
    pub fn read<V: Variables>(&self) -> Result<V, Error> {
        V::from_parameters(&self.values())
    }

    /// One of its values, as of [`ParametersView::variable`].
    ///
    /// ```no_run
    /// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
    /// # let pose = depot.s_unit("agv-07")?.stream("pose")?.subscribe(cara_std::Duration::from_millis(100));
    /// if let Some(sample) = pose.latest() {
    ///     let [x, y]: [f64; 2] = sample.value("position")?;
    ///     println!("{x} {y}");
    /// }
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn value<V: for<'a> FromValue<'a>>(&self, name: &str) -> Result<V, Error> {
        self.values().variable(name)
    }
}

/// A subscription to a stream of a node; it ends when it is dropped.
pub struct Subscription<T: Send + 'static = ()> {
    peer: Peer<T>,
    watched: Arc<Watched>,
    id: u64,
    interval: Duration,
    /// Values of the stream that had come when the last one was returned.
    seen: u64,
    /// When [`next`](Self::next) returns another one: other handles may want more of them.
    due: Instant,
}

impl<T: Send + 'static> fmt::Debug for Subscription<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {:?}", self.watched.name, self.peer)
    }
}

impl<T: Send + 'static> Subscription<T> {
    /// The newest value, with its age; `None` until one has come. It stays when the node leaves, and grows older.
    pub fn latest(&self) -> Option<Sample> {
        let (newest, _) = self.watched.newest();
        newest.map(|received| self.sample(received))
    }

    /// The newest value as a struct that derives [`Variables`], and its age; `None` until one has come. Errors as of
    /// [`Sample::read`].
    pub fn newest<V: Variables>(&self) -> Option<Result<(V, Duration), Error>> {
        self.latest().map(|sample| Ok((sample.read()?, sample.age)))
    }

    fn sample(&self, received: Received) -> Sample {
        let age = received.age_at(self.peer.engine.now());
        Sample { received, age }
    }

    /// Waits for the next value, and returns the newest one: of those that came meanwhile, the others are passed over. A first call
    /// returns what has come before it.
    ///
    /// [`Error::TimedOut`]; [`Error::NotAllowed`], [`Error::UnknownFunction`], [`Error::StaleFunction`] or [`Error::Full`] where
    /// the node grants no subscription, until its list changes; [`Error::NotRunning`] when this unit has been stopped.
    pub fn next(&mut self, timeout: impl Into<Duration>) -> Result<Sample, Error> {
        let engine = self.peer.engine.clone();
        let deadline = engine.now() + timeout.into();
        loop {
            let now = engine.now();
            if self.due > now && self.due <= deadline {
                std::thread::sleep(self.due.since(now).into());
            }
            let left = deadline.since(engine.now()).min(LOOK);
            match self.watched.wait(self.id, self.seen, left.into()) {
                Ok((received, count)) => {
                    self.seen = count;
                    self.due = self.due.max(now) + self.interval;
                    return Ok(self.sample(received));
                }
                Err(Error::TimedOut) if engine.is_stopping() => return Err(Error::NotRunning),
                Err(Error::TimedOut) if engine.now() < deadline => {}
                Err(error) => return Err(error),
            }
        }
    }

    /// The next value for a task, which is woken when one has come and the pace lets it through, when the node has refused, and
    /// when this unit is stopped.
    #[cfg(feature = "async")]
    pub(crate) fn poll_next(&mut self, waker: &Waker, alarm: &mut Alarm) -> Poll<Result<Sample, Error>> {
        let engine = &self.peer.engine;
        let now = engine.now();
        let is_early = self.due > now;
        // What has come waits for its time: by then there may be a newer one.
        let seen = if is_early { u64::MAX } else { self.seen };
        match self.watched.poll(self.id, seen, waker) {
            Some(Ok((received, count))) => {
                self.seen = count;
                self.due = self.due.max(now) + self.interval;
                Poll::Ready(Ok(self.sample(received)))
            }
            Some(Err(error)) => Poll::Ready(Err(error)),
            // Looked at behind the waker, which the end of the unit wakes.
            None if engine.is_stopping() => Poll::Ready(Err(Error::NotRunning)),
            None => {
                if is_early {
                    alarm.set(self.due, waker);
                }
                Poll::Pending
            }
        }
    }

    /// The unit that reads.
    #[cfg(feature = "async")]
    pub(crate) const fn engine(&self) -> &Arc<Engine<T>> {
        &self.peer.engine
    }

    /// The values as they come; ends where [`next`](Self::next) fails for another reason than time.
    pub fn iter(&mut self) -> impl Iterator<Item = Sample> + '_ {
        std::iter::from_fn(|| {
            loop {
                match self.next(LOOK) {
                    Ok(sample) => return Some(sample),
                    Err(Error::TimedOut) => {}
                    Err(_) => return None,
                }
            }
        })
    }
}

impl<T: Send + 'static> Drop for Subscription<T> {
    fn drop(&mut self) {
        self.peer.cell.streams.unsubscribe(&self.watched, self.id);
        self.peer.engine.tell_interval(&self.peer.cell, &self.watched);
    }
}

/// A stream of a node that this unit passes on as one of its own; dropped, it ends, and nodes are told.
pub struct Relay<T: Send + 'static = ()> {
    stream: Stream<T>,
    subscription: Subscription<T>,
}

impl<T: Send + 'static> fmt::Debug for Relay<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?} as {}", self.subscription, self.stream.definition.name())
    }
}

impl<T: Send + 'static> Relay<T> {
    /// Passes on a stream of a node under the name `node/stream`: however many read it there, the node's link has one
    /// subscription. Each value is as old as it is here.
    pub(crate) fn new(peer: &Peer<T>, stream: &str, interval: Duration) -> Result<Self, Error> {
        let theirs = peer.stream(stream)?;
        let text = theirs.definition.to_string();
        let values = text.split_once("-> ").map_or("()", |(_, values)| values);
        let definition =
            Definition::stream(&format!("{}/{stream}{values}", peer.name())).map_err(|_| Error::BadName)?;
        let own = MyFunctionList { engine: &peer.engine };
        let stream = own.add_stream(&definition, interval.max(theirs.least_interval))?;
        let subscription = theirs.subscribe(interval);
        subscription.watched.relay_to(&stream.own);
        Ok(Self { stream, subscription })
    }

    /// The unit's own stream.
    pub const fn stream(&self) -> &Stream<T> {
        &self.stream
    }
}

impl<T: Send + 'static> Drop for Relay<T> {
    fn drop(&mut self) {
        // Where it has been removed by hand, there is nothing to remove.
        let _ = self.stream.engine.remove_function(self.stream.definition.name());
    }
}
