//! Evidence for tests: a host in order, in fleet 7.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use cara_std::control::protocol::{ConstraintsInfo, KeysInfo, NodeInfo, UnitInfo};
use cara_std::survey::{Heard, Ports, Reach, Standing, Versions};
use cara_std::sys::interfaces::Interface;
use cara_std::{Epoch, Fleet, Identity, Interfaces, Manager, Mode};

use super::{Evidence, KeysSeen, Life};
use crate::VERSIONS;
use crate::running::{Counted, Running};

pub(crate) const FLEET: Fleet = Fleet(7);
/// What a unit speaks that is too new.
pub(crate) const LATER: Versions = Versions { first: 9, last: 9 };

/// Listened long enough, and no node was heard.
pub(crate) fn evidence() -> Evidence {
    Evidence {
        which: None,
        fleet: FLEET,
        fleet_known: true,
        interfaces: Interfaces::All,
        loopback_by_environment: false,
        mode: None,
        keys: KeysSeen { has: true, refused: Vec::new() },
        ports: Ports::Usual,
        port: 21_971,
        listened: Duration::from_secs(16),
        heard: Vec::new(),
        foreign: Vec::new(),
        reach: vec![reach("eth0", "10.0.0.1")],
        devices: vec!["eth0".into()],
        dials: Vec::new(),
        running: Vec::new(),
        unasked: Vec::new(),
        control_refused: None,
        connected_lives: Vec::new(),
        answered_alone: Vec::new(),
    }
}

/// An interface on which broadcasts come back.
pub(crate) fn reach(name: &str, address: &str) -> Reach {
    let broadcast = Some("10.0.0.255".parse().unwrap());
    let interface =
        Interface { name: name.into(), address: address.parse().unwrap(), broadcast, up: true, refused: None };
    Reach { interface, port: 21_971, sent: 3, refused: None, heard: 3 }
}

pub(crate) fn life(node: &str, epoch: u64, first: u64, last: u64) -> Life {
    let (first, last) = (Duration::from_millis(first), Duration::from_millis(last));
    Life { node: node.into(), epoch, at: format!("10.0.0.{epoch}:5000"), first, last }
}

/// An s_unit that looks for `wanted/1`.
pub(crate) fn searching(name: &str, id: u32, wanted: &str) -> Heard {
    heard(Identity::s_unit(name, id).unwrap(), Some(Manager::new(wanted, 1).unwrap()))
}

/// An m_unit `name/1` that answers.
pub(crate) fn answering(name: &str, room: u16) -> Heard {
    let identity = Identity::m_unit(name, 1).unwrap();
    Heard { tcp_port: Some(4000), room: Some(room), answers: 1, searches: 0, to_us: 1, ..heard(identity, None) }
}

fn heard(identity: Identity, wanted: Option<Manager>) -> Heard {
    Heard {
        source: SocketAddr::new("10.0.0.9".parse().unwrap(), 5000),
        mode: Mode::Secured,
        standing: Standing::Proven { generation: 1, root: 1 },
        versions: VERSIONS,
        fleet: FLEET,
        identity: Some(identity),
        epoch: Some(Epoch(1)),
        wanted,
        stands_by: false,
        tcp_port: None,
        room: None,
        claim: None,
        searches: 1,
        answers: 0,
        others: 0,
        first: Duration::from_secs(1),
        last: Duration::from_secs(1),
        by_broadcast: true,
        to_us: 0,
    }
}

/// An m_unit of this host, without nodes.
pub(crate) fn running(name: &str, id: u32) -> Running {
    let constraints = ConstraintsInfo {
        request_timeout_us: 2_000_000,
        minimum_interval_us: 0,
        maximum_nodes: 64,
        message_size: 32 * 1024,
        chunk_size: 4096,
        keep_alive_us: 1_000_000,
        calls_per_peer: 64,
        scheduling: Default::default(),
    };
    let unit = UnitInfo {
        name: name.into(),
        id,
        role: "m_unit".into(),
        fleet: FLEET.0,
        mode: Some("secured".into()),
        keys: Some(KeysInfo { file: None, generations: vec![1] }),
        version: VERSIONS.last,
        release: None,
        discovery_port: 21_971,
        tcp_port: 4000,
        epoch: "1".into(),
        uptime_ms: 100_000,
        interfaces: Vec::new(),
        constraints,
        connected: 0,
        leading: None,
    };
    let (nodes, refused, counters) = (Vec::new(), Vec::new(), Vec::new());
    Running { unit, nodes, asked: Instant::now(), refused, counters, files: None }
}

pub(crate) fn node_info(name: &str, id: u32, connected: bool) -> NodeInfo {
    NodeInfo {
        name: name.into(),
        id,
        role: "s_unit".into(),
        connected,
        expected: true,
        address: connected.then(|| "10.0.0.7:5000".into()),
        version: None,
        epoch: None,
        connected_ms: connected.then_some(61_500),
        left_ms: (!connected).then_some(9_000),
        left_reason: (!connected).then(|| "Silent".into()),
        left_text: (!connected).then(|| "nothing was heard".into()),
        searched_ms: None,
        searched_from: None,
        limits: None,
        link: None,
        clock: None,
        functions: 0,
    }
}

impl Running {
    /// Sets the counters of a link.
    pub(crate) fn count(&mut self, node: &str, counters: &[(&str, u64)]) {
        let counters = counters.iter().map(|(name, count)| ((*name).to_owned(), *count)).collect();
        self.counters = vec![Counted { node: Some(node.into()), counters }];
    }
}
