//! Gathers what there is to see, until the cause is certain or the time is over.

use std::collections::HashSet;
use std::fs;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::Path;
use std::time::{Duration, Instant};

use cara_std::survey::{Ports, Survey, SurveyKeys};
use cara_std::{Error, Fleet, Identity, Interfaces, Mode};

use super::dial::Dials;
use super::evidence::{Evidence, KeysSeen, Life};
use super::finding::Finding;
use super::running::{Running, Sources};
use super::which::Which;
use super::{holder, host, left, network, node, unasked};
use cara_tools::exit::Ended;
use cara_tools::global::Global;
use cara_tools::listening;
use cara_tools::name_and_id::quoted;

/// Between two looks at what has arrived.
const SLICE: Duration = Duration::from_millis(250);
/// After listening for so long in vain, units of this host are dialled as well.
const TRIES_OWN: Duration = Duration::from_secs(5);
/// Between two questions to the units of this host.
const REFRESH: Duration = Duration::from_secs(1);
/// When broadcasts ask all nodes, in seconds since the start: a single one may get lost.
const QUESTIONS: [u64; 5] = [0, 1, 2, 6, 12];
/// When nodes that did not answer the broadcasts are asked by unicast.
const ALONE: Duration = Duration::from_secs(3);
/// Most nodes that are asked alone, and most other fleets that are asked.
const MOST_ALONE: usize = 64;
const MOST_FLEETS: usize = 8;
/// Most boots of connected nodes that are kept.
const MOST_LIVES: usize = 16_384;

/// What was seen, and what it means.
pub(crate) struct Looked {
    pub(crate) evidence: Evidence,
    pub(crate) findings: Vec<Finding>,
}

/// Looks for `listen` at most.
pub(crate) fn look(which: Option<Which>, listen: Duration, global: &Global) -> anyhow::Result<Looked> {
    let mut sources = Sources::open(which.as_ref(), global)?;
    let running = sources.look();
    let silent = sources.unasked.iter().map(|unit| unit.fleet);
    let fleets: HashSet<u32> = running.iter().map(|running| running.unit.fleet).chain(silent).collect();
    let keys = keys(global, &running)?;
    let keyed: HashSet<u32> = keys.fleets().iter().map(|fleet| fleet.0).collect();
    let known = global.fleet.or_else(|| only(&fleets));
    let fleet = known.or_else(|| only(&keyed).filter(|_| fleets.is_empty())).unwrap_or(0);
    let (ports, mode) = (ports(global, &running), mode(global, &running, fleet));
    let evidence = Evidence {
        which,
        fleet: Fleet(fleet),
        fleet_known: global.fleet.is_some() || !fleets.is_empty(),
        interfaces: global.interfaces(),
        loopback_by_environment: !global.loopback && global.interfaces() == Interfaces::Loopback,
        mode,
        keys: KeysSeen {
            has: keys.has(Fleet(fleet)),
            refused: keys.refused().iter().map(ToString::to_string).collect(),
        },
        ports,
        port: ports.of(mode.unwrap_or(Mode::Secured)),
        listened: Duration::ZERO,
        heard: Vec::new(),
        foreign: Vec::new(),
        reach: Vec::new(),
        devices: devices(&fs::read_to_string("/proc/net/dev").unwrap_or_default()),
        dials: Vec::new(),
        running,
        unasked: sources.unasked.clone(),
        control_refused: sources.refused.clone(),
        connected_lives: Vec::new(),
        answered_alone: Vec::new(),
    };
    only_one(&evidence)?;
    match Survey::open(evidence.interfaces, ports) {
        Ok(survey) => Looking::new(survey.with_keys(keys), sources, evidence).until(listen),
        Err(Error::PortInUse) => {
            let in_use = |port: &u16| matches!(Survey::open(evidence.interfaces, *port), Err(Error::PortInUse));
            let port = ports.numbers().into_iter().find(in_use).unwrap_or(evidence.port);
            let findings = vec![host::port_in_use(port, &holder::holders(port))];
            Ok(Looked { evidence, findings })
        }
        Err(error) => Err(error.into()),
    }
}

/// Those of the command, and those of the units that can be asked, as far as their files can be read.
fn keys(global: &Global, running: &[Running]) -> anyhow::Result<SurveyKeys> {
    let mut keys = listening::keys(global)?;
    if !global.insecure && global.key_file.is_none() {
        let files = running.iter().filter_map(|unit| unit.unit.keys.as_ref()?.file.as_ref());
        files.for_each(|file| keys.add_file(Path::new(file)));
    }
    Ok(keys)
}

/// Those of both modes, unless another one is told, or is that of the units of this host.
fn ports(global: &Global, running: &[Running]) -> Ports {
    let used: HashSet<u16> = running.iter().map(|unit| unit.unit.discovery_port).collect();
    let usual = Ports::Usual.numbers();
    let other = only(&used).filter(|port| !usual.contains(port));
    global.discovery_port.or(other).map_or(Ports::Usual, Ports::One)
}

/// What was asked for, or what all units of the fleet on this host have.
fn mode(global: &Global, running: &[Running], fleet: u32) -> Option<Mode> {
    if global.insecure {
        return Some(Mode::Plain);
    }
    let mut modes = running.iter().filter(|unit| unit.unit.fleet == fleet).map(Running::mode);
    let first = modes.next()??;
    modes.all(|mode| mode == Some(first)).then_some(first)
}

fn only<T: Copy>(set: &HashSet<T>) -> Option<T> {
    set.iter().next().copied().filter(|_| set.len() == 1)
}

/// One node may be meant and no more: what is told of one is not told of another of its name.
fn only_one(seen: &Evidence) -> anyhow::Result<()> {
    let Some(which) = &seen.which else { return Ok(()) };
    let several = seen.called(which);
    if several.len() < 2 {
        return Ok(());
    }
    let names: Vec<_> = several.iter().map(|name| quoted(name)).collect();
    Err(Ended::usage(format!("several nodes are called `{}`: write {}", which.0, names.join(" or "))))
}

/// What it means.
fn judge(evidence: &Evidence) -> Vec<Finding> {
    let which = evidence.which.as_ref();
    let found = match which {
        Some(which) => node::check(evidence, which).into_iter().chain(host::control_refused(evidence)).collect(),
        None => network::check(evidence),
    };
    unasked::above(evidence, which, found)
}

struct Looking {
    survey: Survey,
    sources: Sources,
    evidence: Evidence,
    dials: Dials,
    questions: usize,
    refreshed: Option<Instant>,
    asked_fleets: HashSet<Fleet>,
    /// Once they were asked alone: where they are.
    alone: Option<HashSet<SocketAddr>>,
}

impl Looking {
    fn new(survey: Survey, sources: Sources, evidence: Evidence) -> Self {
        let asked_fleets = HashSet::from([evidence.fleet]);
        Self {
            survey,
            sources,
            evidence,
            dials: Dials::new(),
            questions: 0,
            refreshed: None,
            asked_fleets,
            alone: None,
        }
    }

    fn until(mut self, listen: Duration) -> anyhow::Result<Looked> {
        loop {
            self.ask();
            let left = listen.saturating_sub(self.survey.age());
            self.survey.listen(SLICE.min(left));
            self.gather();
            only_one(&self.evidence)?;
            let findings = judge(&self.evidence);
            let certain = findings.first().is_some_and(|finding| finding.certain);
            if certain || self.survey.age() >= listen {
                return Ok(Looked { evidence: self.evidence, findings });
            }
        }
    }

    fn ask(&mut self) {
        let due = QUESTIONS.get(self.questions).is_some_and(|at| self.survey.age() >= Duration::from_secs(*at));
        // No more broadcasts once nodes were asked by unicast: an answer from then on shows that the unicast reached
        // the node.
        if due && self.alone.is_none() {
            self.questions += 1;
            self.survey.ask(self.evidence.fleet);
        }
        let news: Vec<Fleet> = self.survey.fleets().difference(&self.asked_fleets).copied().collect();
        for fleet in news {
            if self.asked_fleets.len() <= MOST_FLEETS && self.asked_fleets.insert(fleet) {
                self.survey.ask(fleet);
            }
        }
        if self.alone.is_none() && self.survey.age() >= ALONE {
            self.ask_alone();
        }
    }

    /// Asks each node that was heard and has not answered, by unicast; if there is none, all hosts that this host has
    /// recently exchanged packets with.
    fn ask_alone(&mut self) {
        let m_units = self.evidence.m_units();
        let silent =
            |identity: &Identity| !self.evidence.ours().any(|(heard, other)| other == identity && heard.to_us > 0);
        let mut targets: HashSet<SocketAddr> =
            m_units.iter().filter(|(_, identity)| silent(identity)).map(|(heard, _)| heard.source).collect();
        if m_units.len() == targets.len() && self.evidence.interfaces == Interfaces::All {
            let known = neighbours(&fs::read_to_string("/proc/net/arp").unwrap_or_default());
            let ports = self.evidence.ports.numbers();
            let at = |ip| ports.iter().map(move |port| SocketAddr::new(IpAddr::V4(ip), *port));
            let unknown = known.into_iter().flat_map(at);
            targets.extend(unknown.take(MOST_ALONE));
        }
        for target in targets.iter().take(MOST_ALONE) {
            // What is not sent is not answered.
            let _ = self.survey.ask_at(self.evidence.fleet, *target);
        }
        if !targets.is_empty() {
            self.alone = Some(targets);
        }
    }

    fn gather(&mut self) {
        if self.refreshed.is_none_or(|at| at.elapsed() >= REFRESH) {
            self.evidence.running = self.sources.look();
            self.refreshed = Some(Instant::now());
            let now = self.survey.age();
            let asked = |unit: &Running| now.saturating_sub(unit.asked.elapsed());
            note_lives(&mut self.evidence.connected_lives, &self.evidence.running, now, asked);
        }
        let evidence = &mut self.evidence;
        evidence.listened = self.survey.age();
        evidence.heard = self.survey.heard().to_vec();
        evidence.foreign = self.survey.foreign().to_vec();
        evidence.reach = self.survey.reach().to_vec();
        // A unit of this host that answers its operator logs a try as a link that did not come about: it gets one only
        // where nothing else has told why nodes are missing.
        let own: HashSet<u16> = evidence.running.iter().map(|unit| unit.unit.tcp_port).collect();
        let is_own = |identity: &Identity, port: u16| {
            own.contains(&port) && evidence.running.iter().any(|unit| unit.name() == identity.to_string())
        };
        let others =
            evidence.m_units().into_iter().filter_map(|(heard, identity)| Some((heard.listens_at()?, identity)));
        // Where a node is heard and does not come, a connection is what has to be known.
        let heard_here = evidence.running.iter().flat_map(|unit| &unit.nodes).any(left::searches);
        let tries_own = heard_here || evidence.listened >= TRIES_OWN;
        for (at, _) in others.filter(|(at, identity)| tries_own || !is_own(identity, at.port())) {
            self.dials.try_once(at);
        }
        evidence.dials = self.dials.all();
        if let Some(alone) = &self.alone {
            let answers = evidence.ours().filter(|(heard, _)| heard.to_us > 0);
            let hosts: HashSet<IpAddr> = alone.iter().map(SocketAddr::ip).collect();
            let late = answers.filter(|(heard, _)| hosts.contains(&heard.source.ip()));
            evidence.answered_alone = late.map(|(heard, _)| heard.source).collect();
        }
    }
}

/// Which lives of nodes the units of this host have connected: of each it is known that it had begun by now, and that it had not
/// ended when the unit was asked.
fn note_lives(lives: &mut Vec<Life>, running: &[Running], now: Duration, asked: impl Fn(&Running) -> Duration) {
    let nodes = running.iter().flat_map(|unit| unit.nodes.iter().map(move |node| (unit, node)));
    for (unit, node) in nodes.filter(|(_, node)| node.connected) {
        let epoch = node.epoch.as_deref().and_then(|text| u64::from_str_radix(text, 16).ok());
        let (Some(epoch), name) = (epoch, format!("{}/{}", node.name, node.id)) else { continue };
        let (full, asked) = (lives.len() >= MOST_LIVES, asked(unit));
        match lives.iter_mut().find(|life| life.epoch == epoch && life.node == name) {
            Some(life) => life.last = life.last.max(asked),
            None if full => {}
            None => {
                let at = node.address.clone().unwrap_or_default();
                lives.push(Life { node: name, epoch, at, first: now, last: asked });
            }
        }
    }
}

/// The names in the system's table of network devices, without loopback.
fn devices(table: &str) -> Vec<String> {
    let names = table.lines().skip(2).filter_map(|line| line.split_once(':'));
    names.map(|(name, _)| name.trim().to_owned()).filter(|name| name != "lo").collect()
}

/// The hosts in the system's table of neighbours that answered once.
fn neighbours(table: &str) -> Vec<Ipv4Addr> {
    let complete = |flags: &str| {
        flags.strip_prefix("0x").and_then(|hex| u32::from_str_radix(hex, 16).ok()).is_some_and(|bits| bits & 2 != 0)
    };
    let rows = table.lines().skip(1).filter_map(|line| {
        let mut words = line.split_whitespace();
        let ip = words.next()?.parse().ok()?;
        words.nth(1).is_some_and(complete).then_some(ip)
    });
    rows.collect()
}

#[cfg(test)]
mod tests {
    use cara_std::control::protocol::NodeInfo;

    use super::super::evidence::overlapping;
    use super::super::evidence::samples::{life, node_info, running};
    use super::*;

    /// On a host that is slow a report is read late, and again and again until the next one comes.
    #[test]
    fn a_report_shows_no_life_that_is_later_than_its_question() {
        let mut unit = running("boss", 1);
        unit.nodes = vec![NodeInfo { epoch: Some("1".into()), ..node_info("agv", 7, true) }];
        let units = [unit];
        let overlaps = |lives: &[Life], other: &Life| {
            let mut all = vec![lives[0].clone(), other.clone()];
            all.sort_by_key(|life| life.first);
            overlapping(&all).is_some()
        };
        // The node has started again in the third second, and is seen since.
        let (second, again) = (Duration::from_secs, life("agv/7", 2, 2_000, 5_000));
        let mut lives = Vec::new();
        note_lives(&mut lives, &units, second(1), |_| second(1));
        note_lives(&mut lives, &units, second(3), |_| second(1));
        assert_eq!((lives.len(), lives[0].first, lives[0].last), (1, second(1), second(1)));
        assert!(!overlaps(&lives, &again));
        // Also where it is read for the first time then.
        let mut late = Vec::new();
        note_lives(&mut late, &units, second(3), |_| second(1));
        assert!(!overlaps(&late, &again));
        // A life that is told of in an answer to a later question goes on.
        for lives in [&mut lives, &mut late] {
            note_lives(lives, &units, second(4), |_| second(3));
            assert!(overlaps(lives, &again));
        }
    }

    #[test]
    fn devices_and_neighbours_are_read_from_the_systems_tables() {
        let table = "Inter-|   Receive\n face |bytes\n    lo:  1 2 3\n  eth0: 4 5 6\nwlan0:7 8\n";
        assert_eq!(devices(table), ["eth0", "wlan0"]);
        let table = "IP address       HW type     Flags       HW address            Mask     Device\n\
                     10.0.0.2         0x1         0x2         02:00:00:00:00:02     *        eth0\n\
                     10.0.0.3         0x1         0x0         00:00:00:00:00:00     *        eth0\n\
                     nonsense\n";
        assert_eq!(neighbours(table), [Ipv4Addr::new(10, 0, 0, 2)]);
        assert!(neighbours("").is_empty() && devices("").is_empty());
    }

    #[test]
    fn one_value_of_all_is_taken_and_two_are_not() {
        assert_eq!(only(&HashSet::from([7])), Some(7));
        assert_eq!(only(&HashSet::from([7, 8])), None);
        assert_eq!(only::<u32>(&HashSet::new()), None);
    }
}
