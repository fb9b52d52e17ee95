//! Every counter of a unit in the text form that Prometheus reads (OpenMetrics).
//!
//! | name | what | labels |
//! |---|---|---|
//! | `cara_node_*_total` | discovery and membership | `unit` |
//! | `cara_links_*_total` | all links, those that have ended included | `unit` |
//! | `cara_link_*_total` | the links to one node | `unit`, `peer`, `role` |
//! | `cara_clock_*_seconds` | how far the clock of a node is from the unit's, where the node tells it, and the error of that | `unit`, `peer`, `role` |
//! | `cara_unit_*` | the port: buffers, links, calls, events | `unit` |
//!
//! A name is the counter's in the API, as `RequestsSent`, in lower case: `cara_link_requests_sent_total`.

use std::fmt;

use cara_core::distribution::identity::{Identity, Role};
use cara_core::time::Duration;
use prometheus_client::collector::Collector;
use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::Registry;

use crate::engine::clocks::ClockOffset;
use crate::engine::{Engine, Group, Reading};

/// The content type of [`metrics`](crate::CommunicationSystem::metrics), for the HTTP response.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// The text of a unit's counters.
pub(crate) fn text<T: Send + 'static>(engine: &Engine<T>, unit: &Identity) -> String {
    let mut registry = Registry::default();
    registry.register_collector(Box::new(Snapshot::of(engine, unit)));
    let mut text = String::new();
    // A `String` takes whatever is written to it.
    let _ = encode(&mut text, &registry);
    text
}

/// All numbers as they were at one time.
#[derive(Debug)]
struct Snapshot {
    unit: String,
    uptime: Duration,
    readings: Vec<Reading>,
    peers: Vec<PeerSnapshot>,
}

#[derive(Debug)]
struct PeerSnapshot {
    peer: String,
    role: &'static str,
    connected: bool,
    readings: Vec<Reading>,
    clock: Option<ClockOffset>,
}

impl PeerSnapshot {
    fn labels<'s>(&'s self, unit: &'s str) -> [(&'static str, &'s str); 3] {
        [("unit", unit), ("peer", self.peer.as_str()), ("role", self.role)]
    }
}

impl Snapshot {
    fn of<T: Send + 'static>(engine: &Engine<T>, unit: &Identity) -> Self {
        let cells: Vec<_> = {
            let peers = engine.nodes.read();
            [Role::SUnit, Role::MUnit]
                .into_iter()
                .flat_map(|role| peers.of_role(role).cloned().collect::<Vec<_>>())
                .collect()
        };
        let peers = cells.iter().map(|cell| PeerSnapshot {
            peer: cell.identity.to_string(),
            role: cell.identity.role().as_str(),
            connected: cell.is_connected(),
            readings: engine.accounts.of_peer(cell),
            clock: cell.clock_offset(engine.now()),
        });
        Self { unit: unit.to_string(), uptime: engine.uptime(), peers: peers.collect(), readings: engine.readings() }
    }

    fn encode_unit(&self, encoder: &mut DescriptorEncoder<'_>, reading: &Reading) -> fmt::Result {
        let kind = if reading.gauge { MetricType::Gauge } else { MetricType::Counter };
        let (name, labels) = (name(reading), [("unit", self.unit.as_str())]);
        let mut family = encoder.encode_descriptor(&name, reading.help, None, kind)?;
        encode_value(reading, family.encode_family(&labels)?)
    }

    /// The metric of one counter, for each node.
    fn encode_peers(&self, encoder: &mut DescriptorEncoder<'_>, index: usize, first: &Reading) -> fmt::Result {
        let name = name(first);
        let mut family = encoder.encode_descriptor(&name, first.help, None, MetricType::Counter)?;
        for peer in &self.peers {
            if let Some(reading) = peer.readings.get(index) {
                encode_value(reading, family.encode_family(&peer.labels(&self.unit))?)?;
            }
        }
        Ok(())
    }

    fn encode_state(&self, encoder: &mut DescriptorEncoder<'_>) -> fmt::Result {
        let help = "Time since the unit was made.";
        let mut family = encoder.encode_descriptor("cara_unit_uptime_seconds", help, None, MetricType::Gauge)?;
        let uptime = self.uptime.as_micros() as f64 / 1e6;
        ConstGauge::new(uptime).encode(family.encode_family(&[("unit", self.unit.as_str())])?)?;
        let help = "Whether the node is connected.";
        let mut family = encoder.encode_descriptor("cara_link_connected", help, None, MetricType::Gauge)?;
        for peer in &self.peers {
            ConstGauge::new(i64::from(peer.connected)).encode(family.encode_family(&peer.labels(&self.unit))?)?;
        }
        Ok(())
    }

    /// Nothing of nodes that do not tell their clocks.
    fn encode_clocks(
        &self,
        encoder: &mut DescriptorEncoder<'_>,
        name: &str,
        help: &str,
        micros: impl Fn(&ClockOffset) -> f64,
    ) -> fmt::Result {
        let mut clocks = self.peers.iter().filter_map(|peer| peer.clock.as_ref().map(|clock| (peer, clock))).peekable();
        if clocks.peek().is_none() {
            return Ok(());
        }
        let mut family = encoder.encode_descriptor(name, help, None, MetricType::Gauge)?;
        clocks.try_for_each(|(peer, clock)| {
            ConstGauge::new(micros(clock) / 1e6).encode(family.encode_family(&peer.labels(&self.unit))?)
        })
    }
}

impl Collector for Snapshot {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        for reading in &self.readings {
            self.encode_unit(&mut encoder, reading)?;
        }
        let first = self.peers.first().map(|peer| peer.readings.as_slice()).unwrap_or_default();
        for (index, reading) in first.iter().enumerate() {
            self.encode_peers(&mut encoder, index, reading)?;
        }
        self.encode_state(&mut encoder)?;
        let help = "How far the node's clock is ahead of the unit's.";
        self.encode_clocks(&mut encoder, "cara_clock_offset_seconds", help, |clock| clock.offset_us as f64)?;
        let help = "By how much the offset of the node's clock may be wrong.";
        self.encode_clocks(&mut encoder, "cara_clock_error_seconds", help, |clock| clock.error.as_micros() as f64)
    }
}

fn encode_value(reading: &Reading, metric: prometheus_client::encoding::MetricEncoder<'_>) -> fmt::Result {
    if reading.gauge {
        ConstGauge::new(i64::try_from(reading.value).unwrap_or(i64::MAX)).encode(metric)
    } else {
        ConstCounter::new(reading.value).encode(metric)
    }
}

/// `cara_`, what it is about, and the counter's name in lower case.
fn name(reading: &Reading) -> String {
    let group = match reading.group {
        Group::Node => "node",
        Group::Links => "links",
        Group::Link => "link",
        Group::Unit => "unit",
    };
    let mut name = format!("cara_{group}");
    for character in reading.name.chars() {
        if character.is_ascii_uppercase() {
            name.push('_');
        }
        name.push(character.to_ascii_lowercase());
    }
    name
}
