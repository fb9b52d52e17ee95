//! Streams of simulated units: what they publish, and what they read of others.

use std::cell::RefCell;
use std::sync::Arc;

use cara_core::config::Priority;
use cara_core::distribution::block;
use cara_core::distribution::function::{Attributes, Definition};
use cara_core::distribution::function_list::Slot;
use cara_core::distribution::identity::Identity;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::stream::{Newest, Source, Value};
use cara_core::time::{Duration, Instant};

use super::handle::{Peer, UnitHandle};
use super::links::Links;
use super::service::Service;
use crate::network::Network;

/// Values of one stream that are kept of those that came.
const KEPT: usize = 64;

/// The newest value of a stream of a unit.
pub(super) struct Values(RefCell<Newest<Vec<u8>>>);

impl Values {
    pub(super) fn new(definition: &Definition) -> Self {
        let bytes = block::longest(definition.signature().results()).unwrap_or(0);
        Self(RefCell::new(Newest::new(vec![0; bytes])))
    }
}

impl Source for Values {
    fn version(&self) -> u32 {
        self.0.borrow().version()
    }

    fn newest(&self, look: &mut dyn FnMut(&Value<'_>)) {
        if let Some(value) = self.0.borrow().value() {
            look(&value);
        }
    }
}

/// A value of a stream of another unit, as it came.
#[derive(Clone, Debug)]
pub struct Sample {
    /// When it came, in virtual time.
    pub at: Instant,
    /// How old it was then, as the unit knows.
    pub age: Duration,
    /// The values.
    pub values: Arc<ParametersView>,
}

/// A stream of another unit that is read.
pub(super) struct Reading {
    peer: Peer,
    stream: String,
    /// `None` once it is unsubscribed from.
    interval: Option<Duration>,
    /// The newest ones.
    samples: Vec<Sample>,
    count: u64,
    /// Why there is no subscription, if it was refused.
    refused: Option<Error>,
}

impl Links {
    /// Subscribes to what is read of the peer of a link.
    pub(super) fn subscribe(&mut self, network: &mut Network, index: u16) {
        let Some(peer) = self.peer(index) else { return };
        let wanted: Vec<_> = self.readings.iter().filter(|reading| reading.peer.is(&peer)).collect();
        let wanted: Vec<_> =
            wanted.iter().filter_map(|reading| Some((reading.stream.clone(), reading.interval?))).collect();
        for (stream, interval) in wanted {
            self.with(network, index, |session, cx| session.subscribe(cx, &stream, interval));
        }
    }

    /// The name of a stream of the peer of a link.
    pub(super) fn stream_of(&self, index: u16, slot: Slot) -> Option<String> {
        self.link(index)?.session.their_function_list().function(slot).map(|stream| stream.name().to_owned())
    }

    fn peer(&self, index: u16) -> Option<Identity> {
        self.link(index)?.session.peer().cloned()
    }

    fn reading(&mut self, peer: &Identity, stream: &str) -> Option<&mut Reading> {
        self.readings.iter_mut().find(|reading| reading.stream == stream && reading.peer.is(peer))
    }

    pub(super) fn sample_arrived(&mut self, index: u16, stream: &str, sample: Sample) {
        let reading = self.peer(index).and_then(|peer| self.reading(&peer, stream));
        if let Some(reading) = reading {
            if reading.samples.len() == KEPT {
                reading.samples.remove(0);
            }
            reading.samples.push(sample);
            reading.count += 1;
            reading.refused = None;
        }
    }

    pub(super) fn subscription_answered(&mut self, index: u16, stream: &str, refused: Option<Error>) {
        let reading = self.peer(index).and_then(|peer| self.reading(&peer, stream));
        if let Some(reading) = reading {
            reading.refused = refused;
        }
    }
}

impl UnitHandle {
    /// Adds a stream in its text form, as in `pose(position: float[2])`, of which a subscriber gets values at least so far apart.
    ///
    /// # Panics
    /// For a text that is no stream.
    pub fn add_stream(&self, stream: &str, least_interval: Duration) -> Result<(), Error> {
        let definition = Definition::stream(stream).unwrap_or_else(|error| panic!("`{stream}`: {error}"));
        let least = u16::try_from(least_interval.as_millis()).unwrap_or(u16::MAX);
        let attributes = Attributes { priority: Priority::Low, stream: Some(least), ..Attributes::default() };
        let service = Service::stream(Values::new(&definition));
        self.machine(|machine, _| {
            let handler = super::service::Handler(std::rc::Rc::new(service));
            machine.links.functions.add_function(&definition, attributes, handler).map(drop)
        })?
    }

    /// Publishes a new value of a stream of this unit.
    pub fn put(&self, stream: &str, values: &ParametersView) -> Result<(), Error> {
        self.machine(|machine, network| {
            let functions = &machine.links.functions;
            let slot = functions.find(stream).ok_or(Error::UnknownFunction)?;
            let function = functions.function(slot).ok_or(Error::UnknownFunction)?;
            let own = function.handler.0.values.as_ref().ok_or(Error::UnknownFunction)?;
            let now = network.clock(self.host());
            own.0.borrow_mut().publish(now, Duration::ZERO, function.signature, values)
        })??;
        for index in self.live_links() {
            let wanted = self.machine(|machine, network| {
                let now = network.clock(self.host());
                machine.links.link_mut(index).is_some_and(|link| link.session.stream_changed(now))
            })?;
            if wanted {
                self.work(index);
            }
        }
        Ok(())
    }

    /// Reads a stream of a peer from now on, also after a reconnection. Another interval takes the place of the one before.
    pub fn subscribe(&self, peer: impl Into<Peer>, stream: &str, interval: Duration) -> Result<(), Error> {
        let (peer, stream) = (peer.into(), stream.to_owned());
        self.machine(|machine, _| {
            let readings = &mut machine.links.readings;
            match readings.iter_mut().find(|reading| reading.peer == peer && reading.stream == stream) {
                Some(reading) => reading.interval = Some(interval),
                None => {
                    let (interval, samples, count, refused) = (Some(interval), Vec::new(), 0, None);
                    readings.push(Reading { peer: peer.clone(), stream, interval, samples, count, refused });
                }
            }
        })?;
        if let Ok(index) = self.link_to(&peer) {
            self.machine(|machine, network| machine.links.subscribe(network, index))?;
            self.work(index);
        }
        Ok(())
    }

    /// Reads it no more.
    pub fn unsubscribe(&self, peer: impl Into<Peer>, stream: &str) -> Result<(), Error> {
        let peer = peer.into();
        self.machine(|machine, _| {
            let readings = machine.links.readings.iter_mut();
            let ended = readings.filter(|reading| reading.peer == peer && reading.stream == stream);
            ended.for_each(|reading| reading.interval = None);
        })?;
        if let Ok(index) = self.link_to(&peer) {
            self.machine(|machine, network| {
                machine.links.with(network, index, |session, cx| session.unsubscribe(cx, stream));
            })?;
            self.work(index);
        }
        Ok(())
    }

    /// The newest values of a stream that have come, the last one last.
    pub fn samples(&self, peer: impl Into<Peer>, stream: &str) -> Vec<Sample> {
        self.of_reading(&peer.into(), stream, |reading| reading.samples.clone()).unwrap_or_default()
    }

    /// How many values of a stream have come.
    pub fn samples_counted(&self, peer: impl Into<Peer>, stream: &str) -> u64 {
        self.of_reading(&peer.into(), stream, |reading| reading.count).unwrap_or(0)
    }

    /// Why there is no subscription to a stream, if it was refused.
    pub fn subscription_refused(&self, peer: impl Into<Peer>, stream: &str) -> Option<Error> {
        self.of_reading(&peer.into(), stream, |reading| reading.refused).flatten()
    }

    fn of_reading<R>(&self, peer: &Peer, stream: &str, look: impl FnOnce(&Reading) -> R) -> Option<R> {
        let found = self.machine(|machine, _| {
            let mut readings = machine.links.readings.iter();
            readings.find(|reading| reading.peer == *peer && reading.stream == stream).map(look)
        });
        found.ok().flatten()
    }
}
