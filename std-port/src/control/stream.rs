//! Values of a node's streams, for an operator. However many ask, the node's link has one subscription.

use std::time::{SystemTime, UNIX_EPOCH};

use cara_core::distribution::function::Definition;
use cara_core::error::Error;
use cara_core::services::access::Verb;
use cara_core::time::Duration;

use super::answering::{End, LOOK, Sink, permit, send};
use super::protocol::Answer;
use super::{select, values};
use crate::{CommunicationSystem, Peer, Sample};

/// How long a node may take to tell the last value of a stream.
const LAST_VALUE: Duration = Duration::from_millis(500);

pub(super) fn values<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    node: &str,
    name: Option<&str>,
    interval: Duration,
    sink: Sink<'_>,
    wanted: &dyn Fn() -> bool,
) -> Result<(), End> {
    let peer = select::node(system, node)?;
    let Some(name) = name else { return last_values(system, &peer, sink) };
    permit(system, name, Verb::Call)?;
    let stream = peer.stream(name)?;
    let mut subscription = stream.subscribe(interval);
    loop {
        match subscription.next(LOOK) {
            Ok(sample) => send(sink, answer(&peer, stream.definition(), Ok(&sample)))?,
            Err(Error::TimedOut) => {}
            Err(Error::NotRunning) => return Ok(()),
            Err(error) => return Err(error.into()),
        }
        // Also while values come: a client that has gone is seen by a write at the latest.
        if !wanted() {
            return Err(End::Gone);
        }
    }
}

fn last_values<T: Send + 'static>(system: &CommunicationSystem<T>, peer: &Peer<T>, sink: Sink<'_>) -> Result<(), End> {
    let streams = peer.streams();
    let visible = streams.iter().filter(|stream| permit(system, stream.definition().name(), Verb::Call).is_ok());
    // All of them at once, so that the slowest counts and not the sum.
    let subscribed: Vec<_> = visible.map(|stream| (stream, stream.subscribe(Duration::ZERO))).collect();
    for (stream, mut subscription) in subscribed {
        let sample = subscription.next(LAST_VALUE);
        send(sink, answer(peer, stream.definition(), sample.as_ref().map_err(|error| *error)))?;
    }
    Ok(())
}

fn answer<T: Send + 'static>(peer: &Peer<T>, stream: &Definition, sample: Result<&Sample, Error>) -> Answer {
    let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Answer::Value {
        node: peer.identity().to_string(),
        stream: sample.map_or_else(|_| stream.to_string(), |sample| sample.signature().to_string()),
        unix_ms: unix.as_millis() as u64,
        age_us: sample.ok().map(|sample| sample.age().as_micros()),
        values: sample
            .map_or_else(|_| Vec::new(), |sample| values::arguments(sample.signature().results(), &sample.values())),
        error: sample.err().filter(|error| *error != Error::TimedOut).map(Into::into),
    }
}
