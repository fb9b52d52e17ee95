//! Diagnostics of the network and of this host, when no node is named.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;

use cara_std::Role;
use cara_std::control::protocol::RefusedInfo;

use super::causes::{
    dial_of, duplicate, duplicate_managers, full, missing_manager, no_manager, one_way, other_version, refusal,
    restarting, tcp_blocked, text_of,
};
use super::connected::{came_later, clock, lossy, ways};
use super::evidence::Evidence;
use super::finding::{Finding, Id, Severity};
use super::host;
use super::left;
use super::running::Running;
use super::secured;

/// Findings of one kind that are listed.
const MOST: usize = 8;
/// Returns of nodes with a new epoch, per hour, above which a manager's counter is strange; and at least so many.
const RETURNS_PER_HOUR: u64 = 6;
const RETURNS: u64 = 3;

/// All that is strange, the gravest first.
pub(crate) fn check(seen: &Evidence) -> Vec<Finding> {
    let mut found = host::check(seen);
    // A host without a network may run a whole fleet on loopback.
    found
        .iter_mut()
        .filter(|finding| finding.id == Id::NoInterface)
        .for_each(|finding| finding.severity = Severity::Warning);
    found.extend(secured::of_host(seen));
    found.extend(lives(seen));
    found.extend(managers(seen));
    found.extend(searching(seen));
    found.extend(secured::all(seen));
    found.extend(versions(seen));
    found.extend(seen.running.iter().flat_map(|unit| running(seen, unit)));
    found.extend(fleets(seen));
    found.extend(foreign(seen));
    found.extend(host::control_refused(seen));
    found.extend(several(seen));
    found.sort_by_key(|finding| finding.severity);
    once(found)
}

/// A duplicate that a unit has refused and that was heard as well is one.
fn once(found: Vec<Finding>) -> Vec<Finding> {
    let mut reported = BTreeSet::new();
    let is_new = |finding: &Finding| finding.id != Id::Duplicate || reported.insert(finding.about.clone());
    found.into_iter().filter(is_new).collect()
}

fn lives(seen: &Evidence) -> Vec<Finding> {
    let mut nodes: BTreeSet<String> = seen.ours().map(|(_, identity)| identity.to_string()).collect();
    nodes.extend(seen.connected_lives.iter().map(|life| life.node.clone()));
    let duplicates = duplicate_managers(seen);
    let judged = nodes.iter().filter_map(|node| {
        let lives = seen.lives(node);
        let managers = duplicates.iter().find(|duplicate| duplicate.about.as_ref() == Some(node)).cloned();
        managers.or_else(|| duplicate(node, &lives)).or_else(|| restarting(node, &lives))
    });
    judged.take(MOST).collect()
}

fn managers(seen: &Evidence) -> Vec<Finding> {
    let mut found = Vec::new();
    for (heard, identity) in seen.m_units() {
        let name = identity.to_string();
        found.extend(dial_of(seen, heard).and_then(|dial| tcp_blocked(seen, &name, dial)));
        let here = seen.running.iter().any(|unit| unit.name() == name);
        if heard.room == Some(0) && !here {
            found.push(Finding { severity: Severity::Warning, ..full(&name, None) });
        }
    }
    if seen.managers().is_empty() {
        let text = no_manager(seen);
        let advice = format!(
            "look on the manager's host whether it runs, and start it if not; if it does, let UDP port {} in there; or say with \
             --fleet which fleet is meant",
            seen.port
        );
        found.push(Finding::warning(Id::NoManager, text, advice));
    }
    found.extend(seen.answered_alone.iter().map(|at| one_way(seen, *at)));
    found.truncate(MOST);
    found
}

/// Nodes that look for a manager which does not run.
fn searching(seen: &Evidence) -> Vec<Finding> {
    let managers = seen.managers();
    if managers.is_empty() {
        return Vec::new();
    }
    let mut found: Vec<Finding> = Vec::new();
    let s_units = seen.ours().filter(|(_, identity)| identity.role() == Role::SUnit);
    for (heard, identity) in s_units {
        let Some(wanted) = heard.wanted.as_ref().filter(|wanted| !managers.contains(&text_of(wanted))) else {
            continue;
        };
        let name = identity.to_string();
        if found.iter().all(|known| known.about.as_deref() != Some(&name)) {
            found.push(missing_manager(seen, &name, wanted));
        }
    }
    found.truncate(MOST);
    found
}

fn versions(seen: &Evidence) -> Vec<Finding> {
    let mut reported = BTreeSet::new();
    let strange = seen.heard.iter().filter(|heard| !heard.same_version());
    let first = strange.filter(|heard| reported.insert(heard.source));
    first
        .take(MOST)
        .map(|heard| {
            let about = heard.identity.as_ref().map_or("a node".to_owned(), ToString::to_string);
            Finding { severity: Severity::Warning, ..other_version(&about, heard) }
        })
        .collect()
}

/// What a unit of this host has met.
fn running(seen: &Evidence, unit: &Running) -> Vec<Finding> {
    let mut found: Vec<Finding> = host::few_descriptors(unit).into_iter().chain(host::access_table(unit)).collect();
    found.extend(host::claim_not_stored(unit));
    found.extend(host::unit_refused(seen, unit));
    found.extend(secured::failed_proofs(unit));
    if unit.is_full() {
        found.push(no_room(seen, unit));
    }
    // A refused version that was heard here as well is told already.
    let reported =
        |address: &str| seen.heard.iter().any(|heard| !heard.same_version() && heard.source.to_string() == address);
    let refusals = unit
        .refused
        .iter()
        .filter(|refused| !reported(&refused.address))
        .filter(|refused| !(unit.is_full() && refused.reason == "Full"))
        .filter(|refused| !is_over(seen, refused))
        .filter_map(|refused| refusal(&unit.name(), refused));
    found.extend(refusals.take(MOST).map(|finding| Finding { severity: Severity::Warning, ..finding }));
    let connected = unit.nodes.iter().filter(|node| node.connected);
    found.extend(connected.clone().filter_map(|node| lossy(unit, node)).take(MOST));
    found.extend(connected.clone().flat_map(|node| ways(unit, node)).take(MOST));
    found.extend(connected.filter_map(|node| clock(unit, node)).take(MOST));
    found.extend(returns(unit));
    found.extend(left::all(seen, unit).into_iter().take(MOST));
    found
}

/// Whether the node that was refused has joined since, here or another unit of this host.
fn is_over(seen: &Evidence, refused: &RefusedInfo) -> bool {
    seen.running.iter().flat_map(|unit| &unit.nodes).any(|node| came_later(node, refused))
}

/// A unit that is full, and the nodes that it has refused for that.
fn no_room(seen: &Evidence, unit: &Running) -> Finding {
    let finding = full(&unit.name(), Some(unit.unit.constraints.maximum_nodes));
    let refused = unit.refused.iter().filter(|refused| refused.reason == "Full" && !is_over(seen, refused));
    let names: BTreeSet<&str> = refused.filter_map(|refused| refused.node.as_deref()).take(MOST).collect();
    let names: Vec<&str> = names.into_iter().collect();
    let more = if names.is_empty() { String::new() } else { format!("; it refused {}", names.join(", ")) };
    Finding { severity: Severity::Warning, found: finding.found.clone() + &more, ..finding }
}

/// Nodes that come back with a new epoch again and again, by the unit's counter.
fn returns(unit: &Running) -> Option<Finding> {
    let count = unit.own_counter("Restarted")?;
    let hours = unit.unit.uptime_ms / 3_600_000 + 1;
    (count >= RETURNS && count >= hours * RETURNS_PER_HOUR).then(|| {
        let found =
            format!("nodes of {} have restarted {count} times in {} s", unit.name(), unit.unit.uptime_ms / 1000);
        let advice = "see which with `cara watch`; look at power supply, watchdog and log of those";
        Finding::warning(Id::Restarting, found, advice).about(unit.name())
    })
}

fn fleets(seen: &Evidence) -> Vec<Finding> {
    let mut fleets: BTreeMap<u32, BTreeSet<String>> = BTreeMap::new();
    for heard in seen.heard.iter().filter(|heard| heard.fleet != seen.fleet && !heard.is_survey()) {
        let who = heard.identity.as_ref().map_or_else(|| heard.source.to_string(), ToString::to_string);
        fleets.entry(heard.fleet.0).or_default().insert(who);
    }
    let reported = fleets.iter().take(MOST).map(|(fleet, nodes)| {
        let names: Vec<&str> = nodes.iter().take(3).map(String::as_str).collect();
        let more = if nodes.len() > names.len() { " and others" } else { "" };
        let found =
            format!("fleet {fleet} is on this network too: {}{more}; this is fleet {}", names.join(", "), seen.fleet.0);
        let advice = "in order if that is meant; a node of it that should be here needs this fleet";
        Finding::info(Id::OtherFleet, found, advice).about(format!("fleet {fleet}"))
    });
    reported.collect()
}

fn foreign(seen: &Evidence) -> Vec<Finding> {
    let mut hosts: BTreeMap<IpAddr, u64> = BTreeMap::new();
    for foreign in &seen.foreign {
        *hosts.entry(foreign.source.ip()).or_default() += u64::from(foreign.datagrams);
    }
    let ports: Vec<String> = seen.ports.numbers().iter().map(u16::to_string).collect();
    let ports = ports.join(" or ");
    let reported = hosts.iter().take(MOST).map(|(host, datagrams)| {
        let found = format!("{host} sent {datagrams} datagrams to UDP port {ports} that are not CARA's");
        let advice = "they are dropped; if they are many, find the program there and give it another port";
        Finding::warning(Id::ForeignDatagrams, found, advice).about(host)
    });
    reported.collect()
}

fn several(seen: &Evidence) -> Option<Finding> {
    (seen.running.len() > 1).then(|| {
        let names: Vec<String> = seen.running.iter().map(Running::name).collect();
        let found = format!("{} units run on this host: {}", names.len(), names.join(", "));
        Finding::info(Id::SeveralUnits, found, "say with --unit which one is meant")
    })
}

#[cfg(test)]
mod tests {
    use cara_std::survey::{Foreign, Heard};
    use cara_std::{Epoch, Fleet};
    use std::time::Duration;

    use super::super::evidence::samples::{LATER, answering, evidence, node_info, running, searching};
    use super::super::running::Counted;
    use super::*;

    fn ids(seen: &Evidence) -> Vec<Id> {
        check(seen).iter().map(|finding| finding.id).collect()
    }

    fn in_order() -> Evidence {
        let mut unit = running("boss", 1);
        unit.nodes = vec![node_info("agv", 7, true)];
        Evidence { heard: vec![answering("boss", 3)], running: vec![unit], ..evidence() }
    }

    #[test]
    fn a_network_in_order_has_no_findings() {
        assert_eq!(ids(&in_order()), []);
        assert_eq!(ids(&evidence()), [Id::NoManager]);
    }

    #[test]
    fn all_that_is_strange_is_listed_the_gravest_first() {
        let mut seen = in_order();
        seen.heard.push(Heard { fleet: Fleet(9), ..searching("far", 1, "chief") });
        seen.heard.push(Heard {
            versions: LATER,
            source: "10.0.0.8:1".parse().unwrap(),
            ..searching("old", 2, "boss")
        });
        seen.heard.push(searching("lost", 3, "boos"));
        seen.heard.push(Heard { epoch: Some(Epoch(5)), first: Duration::from_secs(4), ..searching("lost", 3, "boos") });
        seen.foreign = vec![Foreign { source: "10.0.0.5:1".parse().unwrap(), datagrams: 3 }];
        let unit = &mut seen.running[0];
        unit.count("agv/7", &[("KeepAlivesMissed", 50), ("DatagramsReceived", 100)]);
        unit.counters.push(Counted { node: None, counters: vec![("Restarted".into(), 100)] });
        let expected = [
            Id::Restarting,
            Id::WrongManager,
            Id::OtherVersion,
            Id::LossyLink,
            Id::Restarting,
            Id::ForeignDatagrams,
            Id::OtherFleet,
        ];
        assert_eq!(ids(&seen), expected);
    }

    #[test]
    fn a_refusal_of_a_node_that_has_joined_since_is_not_told() {
        let mut seen = in_order();
        seen.running.push(running("chief", 2));
        let refused = |node: &str, reason: &str, ago_ms| RefusedInfo {
            address: "10.0.0.2:5".into(),
            node: Some(node.into()),
            reason: reason.into(),
            text: "text".into(),
            ago_ms,
        };
        // agv/7 has been connected to the other one for a minute.
        seen.running[1].refused = vec![refused("agv/7", "WrongManager", 70_000)];
        assert_eq!(ids(&seen), [Id::SeveralUnits]);
        seen.running[1].refused = vec![refused("agv/7", "WrongManager", 50_000), refused("agv/8", "NoKey", 70_000)];
        assert_eq!(ids(&seen), [Id::WrongManager, Id::NoPairKey, Id::SeveralUnits]);
        seen.running[1].refused = vec![refused("agv/7", "Full", 70_000), refused("agv/8", "Full", 50_000)];
        seen.running[1].unit.connected = 64;
        let full = check(&seen).remove(0);
        assert!(full.found.ends_with("; it refused agv/8"), "{full:?}");
    }

    #[test]
    fn a_full_manager_and_a_second_unit_are_told() {
        let mut seen = in_order();
        seen.running[0].unit.connected = 64;
        seen.running.push(running("second", 2));
        assert_eq!(ids(&seen), [Id::Full, Id::SeveralUnits]);
    }
}
