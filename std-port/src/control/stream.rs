//! Values of a node's streams, for an operator. However many ask, the node's link has one subscription.

use std::collections::HashMap;
use std::time::Instant;

use cara_core::distribution::function::Definition;
use cara_core::error::Error;
use cara_core::services::access::Verb;
use cara_core::time::Duration;

use super::protocol::{Answer, Failure, unix_ms};
use super::sink::{End, LOOK, Sink, permit, send};
use super::{select, values};
use crate::{CommunicationSystem, Identity, Log, Peer, Sample, Subscription, TheirStream};

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
    if node == OWN && name == Some(LOG) {
        return own_log(system, sink, wanted);
    }
    let peer = select::node(system, node)?;
    let Some(name) = name else { return last_values(system, &peer, sink) };
    permit(system, name, Verb::Call)?;
    let stream = peer.stream(name)?;
    let mut subscription = subscription(&stream, interval);
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

/// Selects the unit that is asked.
const OWN: &str = ".";
/// Of logs, whose values are pieces.
const LOG: &str = "log";

/// The log of the unit's own program, as far as one operator has read it.
struct OwnLog {
    log: Log,
    node: String,
    definition: Definition,
    seen: Option<u32>,
}

impl OwnLog {
    fn of<T: Send + 'static>(system: &CommunicationSystem<T>) -> Result<Self, Failure> {
        permit(system, LOG, Verb::Call)?;
        let log = system.engine().log().get().ok_or_else(|| {
            let text = "the program of this unit shows no log: it takes a `cara node` whose file does not say `[log] stream = false`, \
                        or a program that calls `show_log`";
            Failure::configuration("NoLog", text)
        })?;
        Ok(Self { log: log.clone(), node: system.identity().to_string(), definition: Log::definition()?, seen: None })
    }

    /// What was written since, as far as it is kept.
    fn report(&mut self, sink: Sink<'_>) -> Result<(), End> {
        let signature = self.definition.signature();
        for _ in 0..AT_ONCE {
            let Some((piece, seen)) = self.log.after(self.seen) else { break };
            self.seen = Some(seen);
            let value = Answer::Value {
                node: self.node.clone(),
                stream: signature.to_string(),
                unix_ms: unix_ms(),
                age_us: Some(0),
                values: values::arguments(signature.results(), &piece),
                error: None,
            };
            send(sink, value)?;
        }
        Ok(())
    }
}

fn own_log<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    sink: Sink<'_>,
    wanted: &dyn Fn() -> bool,
) -> Result<(), End> {
    let mut own = OwnLog::of(system)?;
    while !system.is_stopped() {
        own.report(sink)?;
        if !wanted() {
            return Err(End::Gone);
        }
        std::thread::sleep(LOOK);
    }
    Ok(())
}

/// How often is looked for nodes that have joined, and for streams that they have published.
const JOINED: std::time::Duration = std::time::Duration::from_millis(500);

/// Values of one stream before another has its turn.
const AT_ONCE: usize = 64;

/// With no interval each value is wanted, and of a log each piece in any case: this looks too seldom for all of them to be the newest
/// once.
fn subscription<T: Send + 'static>(stream: &TheirStream<T>, interval: Duration) -> Subscription<T> {
    if interval == Duration::ZERO || stream.definition().name() == LOG {
        stream.subscribe_to_each()
    } else {
        stream.subscribe(interval)
    }
}

/// A stream that is told, with its subscription.
struct Report<T: Send + 'static> {
    peer: Peer<T>,
    definition: Definition,
    subscription: Subscription<T>,
}

/// Values of all streams of all nodes and the unit's own log, or of those with these `names`.
pub(super) fn all<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    interval: Duration,
    names: &[String],
    sink: Sink<'_>,
    wanted: &dyn Fn() -> bool,
) -> Result<(), End> {
    let mut reported: HashMap<(Identity, String), Report<T>> = HashMap::new();
    let mut looked: Option<Instant> = None;
    let mut own = None;
    while !system.is_stopped() {
        if looked.is_none_or(|looked| looked.elapsed() >= JOINED) {
            looked = Some(Instant::now());
            subscribe(system, interval, names, &mut reported);
            if own.is_none() && is_wanted(names, LOG) {
                own = OwnLog::of(system).ok();
            }
        }
        own.iter_mut().try_for_each(|own| own.report(sink))?;
        for Report { peer, definition, subscription } in reported.values_mut() {
            // One that the node does not grant has no values; it is told when it is granted.
            for _ in 0..AT_ONCE {
                let Ok(sample) = subscription.next(Duration::ZERO) else { break };
                send(sink, answer(peer, definition, Ok(&sample)))?;
            }
        }
        if !wanted() {
            return Err(End::Gone);
        }
        std::thread::sleep(LOOK);
    }
    Ok(())
}

fn is_wanted(names: &[String], name: &str) -> bool {
    names.is_empty() || names.iter().any(|wanted| wanted == name)
}

/// Subscribes to streams that have come, and drops those that nodes have no longer.
fn subscribe<T: Send + 'static>(
    system: &CommunicationSystem<T>,
    interval: Duration,
    names: &[String],
    reported: &mut HashMap<(Identity, String), Report<T>>,
) {
    for peer in select::nodes(system).into_iter().filter(Peer::is_connected) {
        let streams = peer.streams();
        let has = |name: &str| streams.iter().any(|stream| stream.definition().name() == name);
        reported.retain(|(identity, name), _| identity != peer.identity() || has(name));
        for stream in streams.iter().filter(|stream| is_wanted(names, stream.definition().name())) {
            let key = (peer.identity().clone(), stream.definition().name().to_owned());
            if !reported.contains_key(&key) && permit(system, &key.1, Verb::Call).is_ok() {
                let (peer, definition) = (peer.clone(), stream.definition().clone());
                reported.insert(key, Report { peer, definition, subscription: subscription(stream, interval) });
            }
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
    Answer::Value {
        node: peer.identity().to_string(),
        stream: sample.map_or_else(|_| stream.to_string(), |sample| sample.signature().to_string()),
        unix_ms: unix_ms(),
        age_us: sample.ok().map(|sample| sample.age().as_micros()),
        values: sample
            .map_or_else(|_| Vec::new(), |sample| values::arguments(sample.signature().results(), &sample.values())),
        error: sample.err().filter(|error| *error != Error::TimedOut).map(Into::into),
    }
}
