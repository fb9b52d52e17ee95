//! What the doctor knows when it judges: plain values, so that each judgement can be tested by itself.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::time::Duration;

use cara_std::control::RunningUnit;
use cara_std::survey::{Foreign, Heard, Ports, Reach, Standing};
use cara_std::{Claim, Fleet, Identity, Interfaces, Manager, Mode, Role};

use super::dial::Dial;
use super::running::Running;
use super::which::Which;
use cara_tools::name_and_id::full_name;

/// Two lives that overlap by less than this may be one after the other: datagrams overtake each other.
const OVERTAKING: Duration = Duration::from_millis(200);

/// All that was seen.
#[derive(Clone, Debug)]
pub(crate) struct Evidence {
    /// The node that is asked about; the host and the whole network without one.
    pub(crate) which: Option<Which>,
    pub(crate) fleet: Fleet,
    /// The fleet was given, or is that of a unit of this host.
    pub(crate) fleet_known: bool,
    pub(crate) interfaces: Interfaces,
    /// Loopback alone is used because the environment says so, not the command line.
    pub(crate) loopback_by_environment: bool,
    /// The mode of the fleet, where it is known: as asked for, or that of its units on this host.
    pub(crate) mode: Option<Mode>,
    pub(crate) keys: KeysSeen,
    /// Where is listened.
    pub(crate) ports: Ports,
    /// The one of them that is meant where one is named.
    pub(crate) port: u16,
    /// How long was listened.
    pub(crate) listened: Duration,
    pub(crate) heard: Vec<Heard>,
    pub(crate) foreign: Vec<Foreign>,
    pub(crate) reach: Vec<Reach>,
    /// Network devices that the system has, with or without an address, loopback left out.
    pub(crate) devices: Vec<String>,
    pub(crate) dials: Vec<Dial>,
    /// Units of this host that can be asked, as they were last.
    pub(crate) running: Vec<Running>,
    /// Units of this host that hold a control socket and cannot be asked.
    pub(crate) unasked: Vec<RunningUnit>,
    /// Why units of this host could not be asked.
    pub(crate) control_refused: Option<String>,
    /// Lives of connected nodes as those units saw them.
    pub(crate) connected_lives: Vec<Life>,
    /// Nodes that answered when they were asked alone, and not when all were.
    pub(crate) answered_alone: Vec<SocketAddr>,
}

/// What keys of the fleet there are.
#[derive(Clone, Debug)]
pub(crate) struct KeysSeen {
    /// There are some.
    pub(crate) has: bool,
    /// Files that were not taken, and why.
    pub(crate) refused: Vec<String>,
}

/// One life of a node, as far as it was seen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Life {
    /// `NAME/ID`.
    pub(crate) node: String,
    pub(crate) epoch: u64,
    /// Where it was seen.
    pub(crate) at: String,
    /// It had begun by then.
    pub(crate) first: Duration,
    /// It had not ended by then: before `first`, where that is when a report was read that was asked for earlier.
    pub(crate) last: Duration,
}

impl Evidence {
    /// Units of our fleet and version, and, as far as that is known, of our mode and keys; without standbys, which do nothing yet.
    pub(crate) fn ours(&self) -> impl Iterator<Item = (&Heard, &Identity)> {
        self.units().filter(|(heard, _)| self.is_ours(heard) && !heard.stands_by)
    }

    /// M_units of our fleet that stand by and command nobody, and where they were heard.
    pub(crate) fn standbys(&self) -> Vec<String> {
        let standbys = self.units().filter(|(heard, _)| self.is_ours(heard) && heard.stands_by);
        standbys.map(|(heard, identity)| format!("{identity} at {}", heard.source)).collect()
    }

    pub(crate) fn is_ours(&self, heard: &Heard) -> bool {
        let same_mode = self.mode.is_none_or(|mode| mode == heard.mode);
        heard.same_version() && heard.fleet == self.fleet && same_mode && heard.standing != Standing::OtherKeys
    }

    /// The interfaces that are used and up, each once.
    pub(crate) fn interfaces_up(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for reach in self.reach.iter().filter(|reach| reach.interface.up) {
            if !names.contains(&reach.interface.name.as_str()) {
                names.push(&reach.interface.name);
            }
        }
        names
    }

    /// All senders with an identity, except other surveys.
    pub(crate) fn units(&self) -> impl Iterator<Item = (&Heard, &Identity)> {
        self.heard
            .iter()
            .filter(|heard| !heard.is_survey())
            .filter_map(|heard| heard.identity.as_ref().map(|identity| (heard, identity)))
    }

    /// What was heard from the node that is asked about, in any fleet and version.
    pub(crate) fn of<'e>(&'e self, which: &'e Which) -> impl Iterator<Item = (&'e Heard, &'e Identity)> {
        self.units().filter(|(_, identity)| which.is_identity(identity))
    }

    /// `NAME/ID` of all that a name or an ID may mean: units of this host, what they have or wait for, and what was heard. One
    /// that was taken off the roster is meant where there is no other.
    pub(crate) fn called(&self, which: &Which) -> BTreeSet<String> {
        let nodes = || self.running.iter().flat_map(|unit| &unit.nodes).filter(|node| which.is(&node.name, node.id));
        let counts = nodes().filter(|node| node.connected || node.expected);
        let here = self.running.iter().filter(|unit| which.is(&unit.unit.name, unit.unit.id)).map(Running::name);
        let heard = self.ours().filter(|(_, identity)| which.is_identity(identity));
        let mut called: BTreeSet<_> = here.chain(counts.map(full_name)).collect();
        called.extend(heard.map(|(_, identity)| identity.to_string()));
        if called.is_empty() {
            called.extend(nodes().map(full_name));
        }
        if called.contains(&which.0) { BTreeSet::from([which.0.clone()]) } else { called }
    }

    /// M_units of our fleet that were heard, each once, as it was heard last.
    pub(crate) fn m_units(&self) -> Vec<(&Heard, &Identity)> {
        let mut found: Vec<(&Heard, &Identity)> = Vec::new();
        for (heard, identity) in self.m_units_heard() {
            match found.iter_mut().find(|(_, known)| *known == identity) {
                Some(known) if known.0.last < heard.last => *known = (heard, identity),
                Some(_) => {}
                None => found.push((heard, identity)),
            }
        }
        found
    }

    fn m_units_heard(&self) -> impl Iterator<Item = (&Heard, &Identity)> {
        self.ours().filter(|(_, identity)| identity.role() == Role::MUnit)
    }

    /// Names of the m_units of our fleet that run, heard or on this host.
    pub(crate) fn managers(&self) -> Vec<String> {
        let here = self.running.iter().filter(|running| running.is_m_unit() && running.unit.fleet == self.fleet.0);
        let mut names: Vec<String> = here.map(Running::name).collect();
        names.extend(self.unasked.iter().filter(|unit| unit.fleet == self.fleet.0).map(|unit| unit.unit.clone()));
        names.extend(self.m_units().iter().map(|(_, identity)| identity.to_string()));
        names.sort();
        names.dedup();
        names
    }

    /// Names of m_units that were heard and do not run on this host, or cannot be asked.
    pub(crate) fn managers_elsewhere(&self) -> Vec<String> {
        let mut here: Vec<String> = self.running.iter().map(Running::name).collect();
        here.extend(self.unasked.iter().map(|unit| unit.unit.clone()));
        self.managers().into_iter().filter(|name| !here.contains(name)).collect()
    }

    /// What was heard of a manager, in our fleet.
    pub(crate) fn manager(&self, wanted: &Manager) -> Option<&Heard> {
        self.m_units().into_iter().find(|(_, identity)| wanted.is(identity)).map(|(heard, _)| heard)
    }

    /// The claim of one life of a manager of our fleet, as it said last.
    pub(crate) fn claim(&self, life: &Life) -> Option<Claim> {
        let of_it = |heard: &&Heard| heard.epoch.is_some_and(|epoch| epoch.0 == life.epoch);
        let said = self.m_units_heard().filter(|(_, identity)| identity.to_string() == life.node);
        said.map(|(heard, _)| heard).filter(of_it).max_by_key(|heard| heard.last)?.claim
    }

    /// The lives of a node of our fleet, heard or connected, the earliest first.
    pub(crate) fn lives(&self, node: &str) -> Vec<Life> {
        let mut lives: BTreeMap<u64, Life> = BTreeMap::new();
        let heard = self.ours().filter(|(_, identity)| identity.to_string() == node).filter_map(|(heard, _)| {
            let (node, at) = (node.to_owned(), heard.source.to_string());
            Some(Life { node, epoch: heard.epoch?.0, at, first: heard.first, last: heard.last })
        });
        let connected = self.connected_lives.iter().filter(|life| life.node == node).cloned();
        for life in heard.chain(connected) {
            let known = lives.entry(life.epoch).or_insert_with(|| life.clone());
            known.first = known.first.min(life.first);
            known.last = known.last.max(life.last);
        }
        let mut lives: Vec<Life> = lives.into_values().collect();
        lives.sort_by_key(|life| life.first);
        lives
    }
}

/// Two lives that were going on at the same time.
pub(crate) fn overlapping(lives: &[Life]) -> Option<(&Life, &Life)> {
    let pairs = lives
        .iter()
        .enumerate()
        .flat_map(|(index, first)| lives.iter().skip(index + 1).map(move |second| (first, second)));
    pairs.into_iter().find(|(first, second)| first.last > second.first + OVERTAKING && second.last >= first.first)
}

#[cfg(test)]
pub(crate) mod samples;

#[cfg(test)]
mod tests {
    use cara_std::control::protocol::NodeInfo;

    use super::samples::{evidence, life, node_info, running, searching};
    use super::*;

    #[test]
    fn lives_overlap_when_the_earlier_one_is_seen_again() {
        let (first, second) = (life("a/1", 1, 0, 900), life("a/1", 2, 1000, 1000));
        assert_eq!(overlapping(&[first.clone(), second.clone()]), None);
        let again = Life { last: Duration::from_millis(3000), ..first };
        assert_eq!(overlapping(&[again.clone(), second.clone()]), Some((&again, &second)));
    }

    #[test]
    fn a_name_that_several_have_means_all_of_them_unless_the_id_is_told() {
        let mut seen = evidence();
        let mut unit = running("boss", 1);
        let absent = |id, expected| NodeInfo { expected, ..node_info("agv", id, false) };
        unit.nodes = vec![node_info("agv", 7, true), absent(8, true), absent(9, false), node_info("x", 7, true)];
        seen.running = vec![unit];
        seen.heard = vec![searching("agv", 8, "boss"), searching("agv", 10, "boss")];
        let called = |text: &str| seen.called(&Which(text.into())).into_iter().collect::<Vec<_>>().join(" ");
        assert_eq!(called("agv"), "agv/10 agv/7 agv/8", "agv/9 was taken off the roster");
        assert_eq!(
            (called("agv/8"), called("agv/9"), called("#7")),
            ("agv/8".into(), "agv/9".into(), "agv/7 x/7".into())
        );
        assert_eq!((called("boss"), called("none")), ("boss/1".into(), String::new()));
    }

    #[test]
    fn a_node_that_is_heard_and_then_connected_has_one_life() {
        let mut seen = evidence();
        seen.connected_lives =
            vec![life("agv/7", 5, 1000, 2000), life("agv/7", 5, 500, 800), life("agv/7", 6, 3000, 3000)];
        let lives = seen.lives("agv/7");
        assert_eq!(
            lives.iter().map(|life| (life.epoch, life.first.as_millis(), life.last.as_millis())).collect::<Vec<_>>(),
            [(5, 500, 2000), (6, 3000, 3000)]
        );
        assert!(seen.lives("agv/8").is_empty());
    }
}
