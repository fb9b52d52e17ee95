//! Findings about nodes that several judgements share.

use std::net::SocketAddr;

use cara_std::Manager;
use cara_std::control::protocol::RefusedInfo;
use cara_std::survey::Heard;

use super::dial::{Dial, Outcome};
use super::evidence::{Evidence, Life, overlapping};
use super::finding::{Finding, Id};
use cara_tools::name_and_id::quoted;

/// As the documentation and the command line write a manager.
pub(crate) fn text_of(manager: &Manager) -> String {
    format!("{}/{}", manager.name, manager.id)
}

pub(crate) fn other_version(about: &str, heard: &Heard) -> Finding {
    let (theirs, ours) = (heard.versions, super::VERSIONS);
    let found =
        format!("{about} at {} speaks version {theirs} of the protocol, and this is version {ours}", heard.source);
    let advice = if theirs.last < ours.first {
        "update the node"
    } else {
        "update the manager and this command, or put the node back"
    };
    Finding::error(Id::OtherVersion, found, advice).about(about)
}

pub(crate) fn other_fleet(seen: &Evidence, about: &str, heard: &Heard) -> Finding {
    let ours = seen.fleet.0;
    let found = format!("{about} at {} is in fleet {}, and this is fleet {ours}", heard.source, heard.fleet.0);
    let advice = match seen.fleet_known {
        true => format!("set the same fleet in both (`--fleet {}` shows that one's nodes)", heard.fleet.0),
        false => format!("no --fleet was given: try `--fleet {}`", heard.fleet.0),
    };
    Finding::error(Id::OtherFleet, found, advice).about(about)
}

/// Two lives of one identity at the same time.
pub(crate) fn duplicate(node: &str, lives: &[Life]) -> Option<Finding> {
    let (first, second) = overlapping(lives)?;
    let found = format!(
        "two live nodes are {node}: one at {} (epoch {:x}) and one at {} (epoch {:x})",
        first.at, first.epoch, second.at, second.epoch
    );
    Some(Finding::error(Id::Duplicate, found, DUPLICATE_ADVICE).about(node))
}

const DUPLICATE_ADVICE: &str = "give each node a name and id of its own; the one that was connected first stays";

/// A node without a key may be a revoked one: the advice that is read first must not let it in again.
const NO_PAIR_KEY_ADVICE: &str = "if it was revoked, or is not known to you, do nothing: it stays out. `cara keys show`, where \
                                  the fleet's root is, tells who was revoked; one that was never added and belongs here is \
                                  added there";

/// Managers of which there are two.
pub(crate) fn duplicate_managers(seen: &Evidence) -> Vec<Finding> {
    seen.managers().into_iter().filter_map(|name| duplicate_manager(seen, &name)).collect()
}

/// Two live managers of one identity: the higher claim commands.
pub(crate) fn duplicate_manager(seen: &Evidence, name: &str) -> Option<Finding> {
    let lives = seen.lives(name);
    let same = duplicate(name, &lives).map(|finding| Finding { advice: DUPLICATE_MANAGERS.to_owned(), ..finding })?;
    Some(fenced(seen, name, &lives).unwrap_or(same))
}

fn fenced(seen: &Evidence, name: &str, lives: &[Life]) -> Option<Finding> {
    let (first, second) = overlapping(lives)?;
    let [one, other] = [first, second].map(|life| seen.claim(life));
    let (one, other) = (one?, other?);
    let (new, newer, old, older) = if one > other {
        (first, one, second, other)
    } else if other > one {
        (second, other, first, one)
    } else {
        return None;
    };
    let found = format!(
        "two live managers are {name}: vehicles obey the one at {} (claim {newer}), and refuse the one at {} (claim {older}) once \
         they have met it",
        new.at, old.at
    );
    Some(Finding::error(Id::Fenced, found, FENCED_ADVICE).about(name))
}

/// Taking over moves vehicles from a manager that may be the one that is meant: the advice does not begin there.
pub(crate) const FENCED_ADVICE: &str = "find out which manager of this name and id is to command. If it is the one with the higher claim, stop \
                             the other one and leave it stopped. If not, stop the one with the higher claim first, and see that its \
                             process has ended, also where it hangs or is cut off; then start the other one again: it claims a \
                             higher one by itself";

const DUPLICATE_MANAGERS: &str = "find out which of the two is to command, and stop the other one: where they hear each other, the one with the lower claim \
     steps down by itself, with exit code 6";

/// A node that has come with one epoch after the other.
pub(crate) fn restarting(node: &str, lives: &[Life]) -> Option<Finding> {
    let restarts = lives.len().checked_sub(1).filter(|restarts| *restarts > 0 && overlapping(lives).is_none())?;
    let times = if restarts == 1 { "once".to_owned() } else { format!("{restarts} times") };
    let span = lives.last()?.last.saturating_sub(lives.first()?.first).as_secs_f32();
    let found = format!("{node} has restarted {times} within {span:.1} s");
    let advice = "look at its power supply, its watchdog's reset reason and its log; a node that was just switched on or \
                  updated is in order if this does not go on";
    Some(Finding::error(Id::Restarting, found, advice).about(node).certain(restarts > 1))
}

/// A manager that says it takes no more nodes.
pub(crate) fn full(manager: &str, limit: Option<u16>) -> Finding {
    let found = match limit {
        Some(limit) => format!("{manager} has as many nodes connected as it takes: maximum_nodes is {limit}"),
        None => format!("{manager} says that it has room for no more nodes"),
    };
    let advice = format!(
        "raise maximum_nodes of {manager}, or take a node away: `cara --unit {} set . maximum_nodes NUMBER` on its host takes \
         up to 16 more than it was started with; more needs its configuration and a restart",
        quoted(manager)
    );
    Finding::error(Id::Full, found, advice).about(manager)
}

/// A connection to an m_unit that did not open, though it shows itself.
pub(crate) fn tcp_blocked(seen: &Evidence, manager: &str, dial: &Dial) -> Option<Finding> {
    let trouble = dial.outcome?.trouble()?;
    let (port, host) = (dial.to.port(), dial.to.ip());
    let found = format!("{manager} shows itself, and a connection to its TCP port {port} at {host} {trouble}");
    let way = match seen.running.iter().any(|unit| unit.name() == manager) {
        true => format!("let TCP port {port} in in the firewall of this host (`nft list ruleset`, `iptables -S`)"),
        false => format!(
            "let TCP port {port} in in the firewall of {host}, out in that of this host, and through what is between \
             (`nft list ruleset`, `iptables -S`)"
        ),
    };
    let advice = match dial.outcome {
        Some(Outcome::Refused) => {
            format!("{way}; if nothing rejects it, look whether {manager} still runs, and at its log")
        }
        _ => way,
    };
    Some(Finding::error(Id::TcpBlocked, found, advice).about(manager).certain(true))
}

/// A node and its manager of which one was heard over loopback alone, and the other one from other hosts alone.
pub(crate) fn loopback_apart(seen: &Evidence, node: &str, manager: &str) -> Option<Finding> {
    let sources = |name: &str| -> Vec<SocketAddr> {
        let of_it = seen.ours().filter(|(_, identity)| identity.to_string() == name);
        of_it.map(|(heard, _)| heard.source).collect()
    };
    let is_local = |sources: &[SocketAddr]| sources.iter().all(|source| source.ip().is_loopback());
    let is_far = |sources: &[SocketAddr]| !sources.iter().any(|source| source.ip().is_loopback());
    let (of_node, of_manager) = (sources(node), sources(manager));
    let (local, far, at) = match (of_node.first()?, of_manager.first()?) {
        (_, at) if is_local(&of_node) && is_far(&of_manager) => (node, manager, at),
        (at, _) if is_far(&of_node) && is_local(&of_manager) => (manager, node, at),
        _ => return None,
    };
    let found =
        format!("{local} is heard over loopback alone, and {far} at {at} and not over loopback: they do not meet");
    let advice = format!(
        "start {local} without CARA_INTERFACES, `--loopback` and `interfaces = \"lo\"`; if it has none of these, look for what \
         this host's firewall keeps in (`nft list ruleset`)"
    );
    Some(Finding::error(Id::LoopbackOnly, found, advice).about(local))
}

/// The dial of what a manager tells of itself.
pub(crate) fn dial_of<'e>(seen: &'e Evidence, heard: &Heard) -> Option<&'e Dial> {
    let at = heard.listens_at()?;
    seen.dials.iter().find(|dial| dial.to == at)
}

/// A node answers when it is asked alone, and not when all are.
pub(crate) fn one_way(seen: &Evidence, at: SocketAddr) -> Finding {
    let found = format!("the node at {at} answers when it is asked alone, and does not when all are asked");
    let advice = format!(
        "look for what keeps broadcasts to UDP port {} from it: a firewall there, another netmask, a router between two networks, \
         an access point that drops broadcasts; or tell s_units their manager's address",
        seen.port
    );
    Finding::error(Id::BroadcastOneWay, found, advice).about(at).certain(true)
}

/// An m_unit that is heard, and answers no question.
pub(crate) fn deaf(seen: &Evidence, name: &str, at: SocketAddr) -> Finding {
    let found = format!("{name} is heard at {at}, and answers neither when all are asked nor when it is asked alone");
    let advice = format!("let UDP in on the host of {name}: port {} for broadcasts, and port {}", seen.port, at.port());
    Finding::error(Id::BroadcastOneWay, found, advice).about(name)
}

/// A node looks for a manager that was not heard.
pub(crate) fn missing_manager(seen: &Evidence, node: &str, wanted: &Manager) -> Finding {
    let wanted = text_of(wanted);
    let (managers, not_heard) = (seen.managers(), not_heard(seen, &wanted));
    if managers.is_empty() {
        let found = format!("{node} looks for its manager {wanted}, and {}", no_manager(seen));
        return Finding::error(Id::NoManager, found, not_heard).about(node);
    }
    let others = managers.join(", ");
    let found = format!(
        "{node} looks for the manager {wanted}, which was not heard in {:.0} s; {others} runs",
        seen.listened.as_secs_f32()
    );
    let advice =
        format!("if {others} is meant, set the manager's name and id in {node} to it. If {wanted} is: {not_heard}");
    Finding::error(Id::WrongManager, found, advice).about(node)
}

/// That none was heard is known, and that none runs is not.
pub(crate) fn no_manager(seen: &Evidence) -> String {
    let standbys = seen.standbys();
    let standbys = match standbys.is_empty() {
        true => String::new(),
        false => format!(" ({} stands by, and does not command yet: its log says why)", standbys.join(", ")),
    };
    format!(
        "no manager of fleet {} was heard in {:.0} s, and none runs on this host{standbys}",
        seen.fleet.0,
        seen.listened.as_secs_f32()
    )
}

/// What to do where a manager is not heard.
pub(crate) fn not_heard(seen: &Evidence, manager: &str) -> String {
    format!(
        "look on its host whether {manager} runs (`cara doctor {}` there), and start it if not; if it does, let UDP port {} in there, \
         compare the netmasks, and look for what drops broadcasts between",
        quoted(manager),
        seen.port
    )
}

/// A node that a unit of this host has refused.
pub(crate) fn refusal(manager: &str, refused: &RefusedInfo) -> Option<Finding> {
    let id = match refused.reason.as_str() {
        "DuplicateIdentity" => Id::Duplicate,
        "Full" => Id::Full,
        "WrongManager" => Id::WrongManager,
        "Fleet" => Id::OtherFleet,
        "Version" => Id::OtherVersion,
        "NoKey" => Id::NoPairKey,
        "Fenced" => Id::Fenced,
        // Each end has dialled the other: one link is refused, and the other one is in use.
        "AlreadyConnected" => return None,
        _ => Id::Refused,
    };
    let who = refused.node.as_deref().unwrap_or("a node");
    let ago = refused.ago_ms / 1000;
    let found = format!("{manager} refused {who} at {} {ago} s ago: {}", refused.address, refused.reason);
    let advice = match id {
        Id::Duplicate => DUPLICATE_ADVICE.to_owned(),
        Id::NoPairKey => NO_PAIR_KEY_ADVICE.to_owned(),
        Id::Fenced => FENCED_ADVICE.to_owned(),
        _ => refused.text.clone(),
    };
    Some(Finding::error(id, found, advice).about(who))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use cara_std::{Claim, Epoch};

    use super::super::evidence::samples::{answering, evidence, life};
    use super::*;

    #[test]
    fn lives_one_after_the_other_are_restarts_and_overlapping_ones_duplicates() {
        let once = [life("a/1", 1, 0, 1000), life("a/1", 2, 2000, 2000)];
        assert_eq!(duplicate("a/1", &once), None);
        assert!(!restarting("a/1", &once).unwrap().certain);
        let often = [life("a/1", 1, 0, 1000), life("a/1", 2, 2000, 2000), life("a/1", 3, 3000, 3000)];
        assert!(restarting("a/1", &often).unwrap().certain);
        let duplicates = [life("a/1", 1, 0, 3000), life("a/1", 2, 2000, 2000)];
        assert_eq!(restarting("a/1", &duplicates), None);
        assert_eq!(duplicate("a/1", &duplicates).unwrap().id, Id::Duplicate);
        assert_eq!(restarting("a/1", &duplicates[..1]), None);
    }

    #[test]
    fn of_two_live_managers_the_higher_claim_commands() {
        let said = |epoch, term: u64| Heard {
            epoch: Some(Epoch(epoch)),
            claim: Some(Claim { term, claimant: 0 }),
            last: Duration::from_secs(3),
            ..answering("boss", 1)
        };
        let found = |one, other| {
            let seen = Evidence { heard: vec![said(1, one), said(2, other)], ..evidence() };
            let mut found = duplicate_managers(&seen);
            assert_eq!(found.len(), 1);
            found.remove(0)
        };
        for finding in [found(5, 4), found(4, 5)] {
            let reported = "(claim 5.0000), and refuse the one at 10.0.0.9:5000 (claim 4.0000)";
            assert!(finding.id == Id::Fenced && finding.found.contains(reported), "{finding:?}");
            assert_eq!(finding.about.as_deref(), Some("boss/1"));
        }
        let equal = found(4, 4);
        assert_eq!((equal.id, equal.advice.as_str()), (Id::Duplicate, DUPLICATE_MANAGERS));
        let mut untold = Evidence { heard: vec![said(1, 4), said(2, 5)], ..evidence() };
        untold.heard[0].claim = None;
        assert_eq!(duplicate_managers(&untold)[0].id, Id::Duplicate);
    }

    #[test]
    fn a_standby_is_no_second_manager_and_no_manager() {
        let standby =
            Heard { epoch: Some(Epoch(2)), last: Duration::from_secs(3), stands_by: true, ..answering("boss", 1) };
        let boss = Heard { epoch: Some(Epoch(1)), last: Duration::from_secs(3), ..answering("boss", 1) };
        let mut seen = Evidence { heard: vec![boss, standby], ..evidence() };
        assert_eq!((duplicate_managers(&seen), seen.managers().len()), (Vec::new(), 1));
        seen.heard.remove(0);
        assert!(seen.managers().is_empty());
        assert!(no_manager(&seen).contains("boss/1 at 10.0.0.9:5000 stands by, and does not command yet"));
    }

    #[test]
    fn a_refusal_of_the_second_link_of_a_pair_is_none() {
        let refused = |reason: &str| RefusedInfo {
            address: "10.0.0.2:5".into(),
            node: Some("a/1".into()),
            reason: reason.into(),
            text: "text".into(),
            ago_ms: 3000,
        };
        assert_eq!(refusal("m/1", &refused("AlreadyConnected")), None);
        assert_eq!(refusal("m/1", &refused("Role")).unwrap().id, Id::Refused);
        assert_eq!(refusal("m/1", &refused("Full")).unwrap().id, Id::Full);
        let fenced = refusal("m/1", &refused("Fenced")).unwrap();
        assert!(fenced.id == Id::Fenced && fenced.about.as_deref() == Some("a/1"), "{fenced:?}");
        assert!(fenced.advice.contains("has ended") && !fenced.advice.contains("take-over"), "{}", fenced.advice);
        let keyless = refusal("m/1", &refused("NoKey")).unwrap();
        assert!(keyless.advice.contains("do nothing") && !keyless.advice.contains("derive"), "{}", keyless.advice);
    }
}
