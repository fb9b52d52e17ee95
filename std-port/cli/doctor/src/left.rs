//! Nodes that were connected to a unit of this host, have left, and have not come back.

use cara_std::control::protocol::NodeInfo;

use super::evidence::Evidence;
use super::finding::{Finding, Id, Severity};
use super::running::Running;
use super::which::Which;
use cara_tools::name_and_id::full_name;

/// A node that is asked about, has left or was heard searching, and is not connected.
pub(crate) fn of(seen: &Evidence, which: &Which) -> Option<Finding> {
    let nodes = seen.running.iter().flat_map(|unit| unit.nodes.iter().map(move |node| (unit, node)));
    let mut left: Vec<_> = nodes.filter(|(_, node)| which.is(&node.name, node.id) && since(node).is_some()).collect();
    left.sort_by_key(|(_, node)| since(node));
    left.first().and_then(|(unit, node)| finding(unit, node))
}

/// A node that looks for its manager says something within this time, so that it would be back.
pub(crate) const RETURNS_MILLIS: u64 = 17_000;

/// Whether a node that is asked about has been silent for so long that it would be back if it could.
pub(crate) fn for_long(seen: &Evidence, which: &Which) -> bool {
    let nodes = seen.running.iter().flat_map(|unit| &unit.nodes).filter(|node| which.is(&node.name, node.id));
    let mut ago = nodes.filter_map(since);
    ago.any(|ago| ago >= RETURNS_MILLIS)
}

/// How long ago its manager heard a node that is not connected.
fn since(node: &NodeInfo) -> Option<u64> {
    node.searched_ms.or(node.left_ms).filter(|_| !node.connected)
}

/// It was heard searching so short a while ago that it still does.
pub(crate) fn searches(node: &NodeInfo) -> bool {
    !node.connected && node.searched_ms.is_some_and(|ago| ago < RETURNS_MILLIS)
}

/// All that have left a unit, and are neither heard nor connected to another one; the latest first.
pub(crate) fn all(seen: &Evidence, unit: &Running) -> Vec<Finding> {
    let is_there = |node: &NodeInfo| {
        let mut others = seen.running.iter().flat_map(|unit| &unit.nodes).filter(|other| other.connected);
        others.any(|other| (&other.name, other.id) == (&node.name, node.id))
            || seen.ours().any(|(_, identity)| (identity.name(), identity.id()) == (node.name.as_str(), node.id))
    };
    let mut left: Vec<&NodeInfo> =
        unit.nodes.iter().filter(|node| !node.connected && (is_fenced(node) || !is_there(node))).collect();
    // What it was refused for is told by itself.
    let is_refused =
        |node: &NodeInfo| unit.refused.iter().any(|refused| refused.node.as_ref() == Some(&full_name(node)));
    left.retain(|node| !(searches(node) && is_refused(node)));
    left.sort_by_key(|node| since(node));
    let severity = |node: &NodeInfo| {
        if was_stopped(node) && node.searched_ms.is_none() { Severity::Info } else { Severity::Warning }
    };
    left.iter().filter_map(|node| Some(Finding { severity: severity(node), ..finding(unit, node)? })).collect()
}

fn is_fenced(node: &NodeInfo) -> bool {
    node.left_reason.as_deref() == Some("Fenced")
}

fn was_stopped(node: &NodeInfo) -> bool {
    node.left_reason.as_deref() == Some("Stopped")
}

fn finding(unit: &Running, node: &NodeInfo) -> Option<Finding> {
    let name = format!("{}/{}", node.name, node.id);
    if let Some(under) = node.left_text.as_ref().filter(|_| is_fenced(node)) {
        let found = format!("{} refuses {}: it is {under}", name, unit.name());
        return Some(Finding::error(Id::Fenced, found, super::causes::FENCED_ADVICE).about(name));
    }
    let heard = span(since(node)? / 1000);
    if searches(node) {
        return Some(not_joining(unit, node));
    }
    let port = unit.unit.discovery_port;
    let (why, advice) = match node.left_reason.as_deref() {
        _ if node.searched_ms.is_some() => {
            let found = format!(
                "{name} searched for {} until {heard} ago, from {}, and has not been heard since; it did not join",
                unit.name(),
                from(node)
            );
            return Some(Finding::error(Id::Lost, found, ENDED).about(name));
        }
        Some("Silent") => ("nothing was heard from it any more", HUNG),
        Some("Stopped") => ("its program was stopped in an orderly way", "start it again if it is wanted"),
        Some("Reset") => ("its connection was closed: its program ended, or the network reset it", ENDED),
        _ => (node.left_text.as_deref().unwrap_or("why is not known"), ENDED),
    };
    let found = format!("{name} left {} {heard} ago and has not been heard searching since: {why}", unit.name());
    let advice = format!(
        "{advice}. If it does run, its broadcasts to UDP port {port} do not arrive here: look at the firewall of this host and \
         the network between; one that was told its manager's address does not search"
    );
    Some(Finding::error(Id::Lost, found, advice).about(name))
}

/// Where it was heard.
fn from(node: &NodeInfo) -> &str {
    node.searched_from.as_deref().unwrap_or("an unknown address")
}

/// Its manager hears it, answers, and gets no connection of it.
fn not_joining(unit: &Running, node: &NodeInfo) -> Finding {
    let (name, manager, host) = (format!("{}/{}", node.name, node.id), unit.name(), from(node));
    let ago = node.searched_ms.unwrap_or_default() / 1000;
    let found = format!("{manager} heard {name} search for it {ago} s ago, from {host}, and {name} has not joined");
    let advice = format!(
        "if it does not join within the next seconds: look at the firewalls of this host and of {host} for what drops its \
         connection to TCP port {} here, or the answers by UDP from here; its log says how far it comes",
        unit.unit.tcp_port
    );
    Finding::error(Id::NotJoining, found, advice).about(name)
}

const HUNG: &str = "look at its power supply, cable or radio, and whether its program hangs or is stopped; it comes back by \
                    itself once that is mended";
const ENDED: &str = "look whether its program runs, and at its log, power supply and network; it comes back by itself";

/// A time for people.
fn span(seconds: u64) -> String {
    match seconds {
        0..=119 => format!("{seconds} s"),
        120..=7_199 => format!("{} min", seconds / 60),
        _ => format!("{} h", seconds / 3600),
    }
}

#[cfg(test)]
mod tests {
    use super::super::evidence::samples::{evidence, node_info, running, searching};
    use super::*;

    fn lost() -> Evidence {
        let mut unit = running("boss", 1);
        unit.nodes = vec![node_info("agv", 7, false), node_info("other", 8, true)];
        Evidence { running: vec![unit], ..evidence() }
    }

    #[test]
    fn who_has_left_is_told_with_time_and_reason() {
        let mut seen = lost();
        let found = of(&seen, &Which("agv".into())).unwrap();
        let text =
            "agv/7 left boss/1 9 s ago and has not been heard searching since: nothing was heard from it any more";
        assert_eq!((found.id, found.found.as_str()), (Id::Lost, text));
        assert_eq!(of(&seen, &Which("other".into())), None, "it is connected");
        seen.running[0].nodes[0].left_ms = None;
        assert_eq!(of(&seen, &Which("agv".into())), None, "an older manager does not say");
    }

    #[test]
    fn whoever_is_heard_is_not_lost_and_whoever_was_stopped_is_no_trouble() {
        let mut seen = lost();
        let severities = |seen: &Evidence| all(seen, &seen.running[0]).iter().map(|f| f.severity).collect::<Vec<_>>();
        assert_eq!(severities(&seen), [Severity::Warning]);
        seen.running[0].nodes[0].left_reason = Some("Stopped".into());
        assert_eq!(severities(&seen), [Severity::Info]);
        seen.heard = vec![searching("agv", 7, "boss")];
        assert_eq!(severities(&seen), []);
    }

    #[test]
    fn a_node_that_its_manager_hears_searching_runs() {
        let mut seen = lost();
        let node = &mut seen.running[0].nodes[0];
        (node.left_ms, node.left_reason) = (Some(50_000), Some("Stopped".into()));
        (node.searched_ms, node.searched_from) = (Some(4_000), Some("10.0.0.7:5000".into()));
        let which = Which("agv".into());
        let found = of(&seen, &which).unwrap();
        let text = "boss/1 heard agv/7 search for it 4 s ago, from 10.0.0.7:5000, and agv/7 has not joined";
        assert_eq!((found.id, found.found.as_str()), (Id::NotJoining, text));
        assert!(!for_long(&seen, &which), "it may come within the next seconds");
        assert_eq!(all(&seen, &seen.running[0])[0].severity, Severity::Warning);
        seen.running[0].nodes[0].searched_ms = Some(40_000);
        let found = of(&seen, &which).unwrap();
        assert!(found.id == Id::Lost && found.found.contains("until 40 s ago"), "{found:?}");
        assert!(for_long(&seen, &which) && !found.advice.contains("start it again"), "{found:?}");
        // It has never joined.
        (seen.running[0].nodes[0].left_ms, seen.running[0].nodes[0].searched_ms) = (None, Some(4_000));
        assert_eq!(of(&seen, &which).map(|found| found.id), Some(Id::NotJoining));
    }

    #[test]
    fn a_node_under_another_manager_is_no_lost_one() {
        let mut seen = lost();
        seen.running[0].nodes[0] = NodeInfo {
            left_reason: Some("Fenced".into()),
            left_text: Some("under another manager: claim 3.86d7, address 10.0.0.7:7000".into()),
            left_ms: None,
            ..node_info("agv", 7, false)
        };
        // It answers searches, as it is well.
        seen.heard = vec![searching("agv", 7, "boss")];
        let found = all(&seen, &seen.running[0]);
        assert_eq!(found.iter().map(|finding| finding.id).collect::<Vec<_>>(), [Id::Fenced]);
        assert!(found[0].found.contains("claim 3.86d7, address 10.0.0.7:7000"), "{}", found[0].found);
    }

    #[test]
    fn times_are_short() {
        assert_eq!([119, 120, 7_200].map(span), ["119 s", "2 min", "2 h"]);
    }
}
