//! Why one node is not there: the causes in the order in which they exclude each other.

use std::time::Duration;

use cara_std::control::protocol::{NodeInfo, RefusedInfo};
use cara_std::survey::Heard;
use cara_std::{Identity, Manager, Role};

use super::causes::{
    deaf, dial_of, duplicate, duplicate_manager, duplicate_managers, full, loopback_apart, missing_manager, no_manager,
    not_heard as not_heard_there, one_way, other_fleet, other_version, refusal, restarting, tcp_blocked, text_of,
};
use super::connected;
use super::evidence::Evidence;
use super::finding::{Finding, Id};
use super::host;
use super::left;
use super::running::Running;
use super::secured;
use super::which::Which;
use cara_tools::close_names::close;
use cara_tools::name_and_id::{full_name, quoted};

/// M_units answer a survey within milliseconds: one that has not answered after this time will not.
pub(crate) const ANSWERED: Duration = Duration::from_millis(2_500);
/// Two live m_units of one name have answered two questions each by then.
const DUPLICATES: Duration = Duration::from_millis(1_500);
/// Refusals of this long before the listening are looked at: the longest pause of a node that tries again, and a bit.
const BEFORE: Duration = Duration::from_secs(20);

/// Why a node is not there, the likeliest cause first; or that it is.
pub(crate) fn check(seen: &Evidence, which: &Which) -> Vec<Finding> {
    if let Some(unit) = seen.running.iter().find(|running| which.is(&running.unit.name, running.unit.id)) {
        return runs_here(seen, unit);
    }
    let connections = seen.running.iter().flat_map(|unit| unit.nodes.iter().map(move |node| (unit, node)));
    if let Some((unit, node)) =
        connections.filter(|(_, node)| node.connected).find(|(_, node)| which.is(&node.name, node.id))
    {
        return connected::check(seen, unit, node);
    }
    let mut ours: Vec<_> = seen.of(which).filter(|(heard, _)| seen.is_ours(heard)).collect();
    ours.sort_by_key(|(heard, _)| heard.last);
    if let Some((heard, identity)) = ours.last().filter(|(_, identity)| identity.role() == Role::MUnit) {
        return heard_m_unit(seen, heard, identity);
    }
    let mut found = duplicate_managers(seen);
    let heard = match ours.last() {
        Some((heard, identity)) => Some(heard_s_unit(seen, which, heard, identity)),
        None => strange(seen, which),
    };
    match heard {
        Some(heard) => found.extend(heard.into_iter().chain(secured::of_host(seen))),
        None => {
            found.extend(secured::of_silence(seen));
            found.extend(silent(seen, which));
        }
    }
    found
}

fn runs_here(seen: &Evidence, unit: &Running) -> Vec<Finding> {
    let mut duplicates = duplicate_managers(seen);
    duplicates.retain(|finding| finding.about.as_deref() == Some(&unit.name()));
    if !duplicates.is_empty() {
        return duplicates.into_iter().map(|finding| finding.certain(true)).collect();
    }
    let found = format!("{} is a unit of this host and has run for {} s", unit.name(), unit.unit.uptime_ms / 1000);
    // Another one of its name has had time to show itself twice.
    let certain = seen.listened >= DUPLICATES;
    vec![Finding::info(Id::Answers, found, "nothing needs to be done").about(unit.name()).certain(certain)]
}

/// In another fleet, mode or version, or with other keys, and in ours not at all.
fn strange(seen: &Evidence, which: &Which) -> Option<Vec<Finding>> {
    let (heard, identity) = seen.of(which).last()?;
    let about = identity.to_string();
    let finding = match apart(seen, &about, heard) {
        finding if finding.id == Id::OtherFleet => and_its_manager(seen, heard, finding),
        finding => finding,
    };
    // It could be of ours as well until that has had time to show itself.
    let certain = seen.listened >= ANSWERED;
    Some(vec![finding.certain(certain)])
}

/// Why a unit that was heard is none of ours.
fn apart(seen: &Evidence, about: &str, heard: &Heard) -> Finding {
    if !heard.same_version() {
        return other_version(about, heard);
    }
    if heard.fleet != seen.fleet {
        return other_fleet(seen, about, heard);
    }
    if seen.mode.is_some_and(|mode| mode != heard.mode) {
        // Of a manager that was not heard the mode is not known.
        let known = |manager: &&Manager| seen.managers().contains(&text_of(manager));
        let wanted = heard.wanted.as_ref();
        let finding = secured::mode_mismatch(seen, about, heard, wanted.filter(known));
        let Some(unknown) = wanted.filter(|wanted| !known(wanted)).map(text_of) else { return finding };
        let found = format!("{}; it looks for the manager {unknown}, which was not heard", finding.found);
        return Finding { found, ..finding };
    }
    secured::wrong_keys(seen, about, heard)
}

/// A node of another fleet may look for another manager as well.
fn and_its_manager(seen: &Evidence, heard: &Heard, finding: Finding) -> Finding {
    let managers = seen.managers();
    let Some(wanted) = heard.wanted.as_ref().map(text_of).filter(|wanted| !managers.contains(wanted)) else {
        return finding;
    };
    if managers.is_empty() || !seen.fleet_known {
        return finding;
    }
    let found = format!("{}; and it looks for the manager {wanted}, and {} runs", finding.found, managers.join(", "));
    let advice = format!("{}, and set the manager's name and id in it to those of the one that runs", finding.advice);
    Finding { found, advice, ..finding }
}

/// Nothing was heard of it: host and network come before the node itself.
fn silent(seen: &Evidence, which: &Which) -> Vec<Finding> {
    let refused = refusals(seen, which, None);
    if !refused.is_empty() {
        return refused;
    }
    let (no_way, mut found): (Vec<_>, Vec<_>) =
        host::check(seen).into_iter().partition(|finding| keeps_here(finding.id));
    // A manager of this host knows more of the node than its interfaces tell: units of one host meet without any.
    let (first, behind) = if seen.running.is_empty() { (no_way, Vec::new()) } else { (Vec::new(), no_way) };
    found.splice(0..0, first);
    found.extend(seen.answered_alone.first().map(|alone| one_way(seen, *alone)));
    // A node that knows its manager's address dials it, again and again, and does not search meanwhile.
    let m_units = seen.m_units();
    let dials = m_units.iter().filter_map(|(heard, identity)| Some((dial_of(seen, heard)?, identity)));
    let blocked = dials.filter_map(|(dial, identity)| tcp_blocked(seen, &identity.to_string(), dial));
    // It may still turn out to search for another manager, unless that of this host has heard it search for it.
    let searches = left(seen, which).is_some_and(|(_, node)| left::searches(node));
    found.extend(blocked.map(|finding| finding.certain(searches)));
    // Its manager hears whatever it says, so that once it has had time to come back there is nothing to wait for.
    let lost = left::of(seen, which).map(|lost| lost.certain(seen.listened >= ANSWERED && left::for_long(seen, which)));
    if !found.is_empty() {
        let lost = lost.filter(|lost| lost.id == Id::Lost);
        return found.into_iter().chain(lost).chain(behind).collect();
    }
    if let Some(cause) = lost.or_else(|| no_manager_for_any(seen, which)) {
        return [cause].into_iter().chain(behind).collect();
    }
    // A sender that cannot be decoded may be the missing node.
    let unreadable = seen.heard.iter().filter(|heard| heard.identity.is_none() && !heard.same_version());
    found.extend(unreadable.map(|heard| other_version("a node", heard)));
    found.truncate(8);
    let elsewhere = seen.managers_elsewhere();
    let no_room =
        m_units.iter().filter(|(heard, identity)| heard.room == Some(0) && elsewhere.contains(&identity.to_string()));
    found.extend(no_room.map(|(_, identity)| full(&identity.to_string(), None)));
    found.push(match elsewhere.is_empty() {
        true => not_heard(seen, which).certain(seen.listened >= ANSWERED && missed_for_long(seen, which)),
        false => ask_its_manager(seen, which, &elsewhere),
    });
    found.extend(waiting_for_another(seen).into_iter().chain(behind));
    found
}

/// What keeps nodes of other hosts away, and none of this one.
fn keeps_here(id: Id) -> bool {
    matches!(id, Id::NoInterface | Id::LoopbackOnly)
}

fn not_heard(seen: &Evidence, which: &Which) -> Finding {
    let mut found = format!(
        "nothing was heard from {} in {:.0} s on {}, UDP port {}, fleet {}",
        which.0,
        seen.listened.as_secs_f32(),
        seen.interfaces_up().join(", "),
        seen.port,
        seen.fleet.0
    );
    let managers: Vec<_> = seen.running.iter().filter(|unit| unit.is_m_unit()).map(Running::name).collect();
    match left(seen, which) {
        Some((unit, node)) if node.left_ms.is_some() && !node.expected => {
            found.push_str(&format!("; it has been connected to {}, and was taken off its roster", unit.name()));
        }
        Some((unit, node)) if node.left_ms.is_some() => {
            found.push_str(&format!("; it has been connected to {}", unit.name()));
        }
        Some((unit, _)) => found.push_str(&format!("; {} waits for it, and it has not joined", unit.name())),
        None if managers.is_empty() => {}
        None => found.push_str(&format!("; {} neither has it nor waits for it", managers.join(", "))),
    }
    if let Some(name) = nearest(seen, which) {
        found.push_str(&format!("; there is {name}"));
    }
    let advice = "check that it is switched on, cabled to this network and started; that its fleet, UDP port and netmask are \
                  these; a node that is connected, or was told its manager's address, is silent here (see its log), and \
                  another cable or network carries no broadcast to here";
    Finding::error(Id::NotHeard, found, advice).about(&which.0)
}

/// `NAME/ID` of the node whose name is closest.
fn nearest(seen: &Evidence, which: &Which) -> Option<String> {
    // A node that is waited for has the name itself.
    let others = seen.running.iter().flat_map(|unit| &unit.nodes).filter(|node| !which.is(&node.name, node.id));
    let nodes = others.map(full_name);
    let known: Vec<String> = seen.units().map(|(_, identity)| identity.to_string()).chain(nodes).collect();
    let wanted = which.0.rsplit_once('/').map_or(which.0.as_str(), |(name, _)| name);
    let name_of = |full: &'_ str| full.rsplit_once('/').map_or(0, |(name, _)| name.len());
    let names = known.iter().filter_map(|full| full.get(..name_of(full)));
    let closest = *close(wanted, names).first()?;
    known.iter().find(|full| full.get(..name_of(full)) == Some(closest)).cloned()
}

/// A unit of this host that has had the node connected, or waits for it.
fn left<'e>(seen: &'e Evidence, which: &Which) -> Option<(&'e Running, &'e NodeInfo)> {
    let mut nodes = seen.running.iter().flat_map(|unit| unit.nodes.iter().map(move |node| (unit, node)));
    nodes.find(|(_, node)| which.is(&node.name, node.id))
}

fn ask_its_manager(seen: &Evidence, which: &Which, managers: &[String]) -> Finding {
    let found = format!(
        "nothing was heard from {} in {:.0} s; it may be connected, since a connected node says nothing to others",
        which.0,
        seen.listened.as_secs_f32()
    );
    let advice = format!("run `cara doctor {}` on the host of {}", quoted(&which.0), managers.join(" or "));
    Finding::warning(Id::AskItsManager, found, advice).about(&which.0)
}

/// A manager of this host misses it, and has run for longer than a node that looks for it is silent.
fn missed_for_long(seen: &Evidence, which: &Which) -> bool {
    let mut misses = seen.running.iter().filter(|unit| unit.unit.uptime_ms >= left::RETURNS_MILLIS);
    misses.any(|unit| unit.nodes.iter().any(|node| node.expected && !node.connected && which.is(&node.name, node.id)))
}

/// Nodes that look for one manager hold back for each other: where none runs, that is why this one is not heard.
fn no_manager_for_any(seen: &Evidence, which: &Which) -> Option<Finding> {
    if !seen.managers().is_empty() || !seen.unasked.is_empty() {
        return None;
    }
    let (wanted, other) = seen.ours().find_map(|(heard, identity)| Some((heard.wanted.as_ref()?, identity)))?;
    let wanted = text_of(wanted);
    let found = format!(
        "{}; {other} looks for {wanted}. {} was not heard; of nodes that look for one manager in vain they hold back for each \
         other, so that it may be among them",
        no_manager(seen),
        which.0
    );
    let advice = format!("{}; if {} does not join then, run the doctor again", not_heard_there(seen, &wanted), which.0);
    Some(Finding::error(Id::NoManager, found, advice).about(&which.0).certain(seen.listened >= ANSWERED))
}

/// Nodes that look for the same manager hold back for each other, so one may speak for those that are not heard.
fn waiting_for_another(seen: &Evidence) -> Option<Finding> {
    let searching = seen.ours().filter_map(|(heard, identity)| Some((heard.wanted.as_ref()?, identity)));
    let missing = |wanted: &Manager| !seen.managers().contains(&text_of(wanted));
    let (wanted, identity) = searching.into_iter().find(|(wanted, _)| missing(wanted))?;
    let found = missing_manager(seen, &identity.to_string(), wanted);
    Some(Finding { severity: super::finding::Severity::Warning, ..found })
}

fn heard_m_unit(seen: &Evidence, heard: &Heard, identity: &Identity) -> Vec<Finding> {
    let name = identity.to_string();
    let lives = seen.lives(&name);
    let mut found: Vec<Finding> = duplicate_manager(seen, &name).into_iter().chain(restarting(&name, &lives)).collect();
    let dial = dial_of(seen, heard);
    found.extend(dial.and_then(|dial| tcp_blocked(seen, &name, dial)));
    let answers = seen.ours().any(|(heard, other)| other == identity && heard.to_us > 0);
    if found.is_empty() && seen.answered_alone.contains(&heard.source) {
        found.push(one_way(seen, heard.source));
    } else if found.is_empty() && !answers {
        found.push(deaf(seen, &name, heard.source));
    } else if found.is_empty() {
        let text = format!("{name} is there: it answers at {}, and takes connections", heard.source);
        let open = dial.is_some_and(|dial| dial.outcome.is_some());
        let advice = "nothing needs to be done";
        found.push(Finding::info(Id::Answers, text, advice).about(&name).certain(open));
    }
    found
}

/// It looks for its manager, and is not connected to one that can be asked.
fn heard_s_unit(seen: &Evidence, which: &Which, heard: &Heard, identity: &Identity) -> Vec<Finding> {
    let name = identity.to_string();
    let lives = seen.lives(&name);
    let duplicates = duplicate(&name, &lives);
    if let Some(found) = duplicates {
        return vec![found.certain(true)];
    }
    let refused = refusals(seen, which, Some(heard));
    if !refused.is_empty() {
        return refused;
    }
    let restarts = restarting(&name, &lives);
    let Some(wanted) = &heard.wanted else { return restarts.into_iter().collect() };
    let mut found: Vec<Finding> = restarts.into_iter().collect();
    let cause = of_its_manager(seen, &name, heard, wanted);
    if cause.as_ref().is_some_and(|cause| cause.id == Id::NoManager) {
        // A node of this host is heard over loopback, whatever keeps other hosts away.
        found.extend(host::check(seen));
    }
    found.extend(cause);
    if found.is_empty() {
        found.extend(secured::generations(seen, &name, heard));
    }
    if found.is_empty() {
        found.push(not_joining(seen, &name, wanted));
    }
    found
}

/// What is wrong with the manager that a node looks for, as seen from here.
fn of_its_manager(seen: &Evidence, name: &str, node: &Heard, wanted: &Manager) -> Option<Finding> {
    let manager = text_of(wanted);
    let keys = secured::two_modes(seen, name, node);
    if let Some(found) = keys.or_else(|| secured::generations(seen, name, node).filter(|found| found.certain)) {
        return Some(found.certain(seen.listened >= ANSWERED));
    }
    let here =
        seen.running.iter().find(|unit| unit.name() == manager && unit.is_m_unit() && unit.unit.fleet == seen.fleet.0);
    let Some(heard) = seen.manager(wanted) else {
        // What hangs, or cannot be asked, is told of by itself.
        if here.is_some() || seen.unasked.iter().any(|unit| unit.unit == manager) {
            return None;
        }
        let abroad = seen.units().find(|(_, identity)| wanted.is(identity));
        let found = match abroad {
            Some((heard, _)) => apart(seen, &manager, heard),
            None => missing_manager(seen, name, wanted),
        };
        return Some(found.certain(seen.listened >= ANSWERED));
    };
    if let Some(apart) = loopback_apart(seen, name, &manager) {
        return Some(apart.certain(seen.listened >= ANSWERED));
    }
    if let Some(blocked) = dial_of(seen, heard).and_then(|dial| tcp_blocked(seen, &manager, dial)) {
        return Some(blocked);
    }
    let limit = here.filter(|unit| unit.is_full()).map(|unit| unit.unit.constraints.maximum_nodes);
    if heard.room == Some(0) || limit.is_some() {
        return Some(full(&manager, limit).certain(true));
    }
    if let Some(exhausted) = here.and_then(host::exhausted) {
        return Some(exhausted.certain(true));
    }
    seen.answered_alone.contains(&heard.source).then(|| one_way(seen, heard.source))
}

/// What the units of this host say about why they refused it.
fn refusals(seen: &Evidence, which: &Which, heard: Option<&Heard>) -> Vec<Finding> {
    let recent = u64::try_from((seen.listened + BEFORE).as_millis()).unwrap_or(u64::MAX);
    let same_host = |refused: &RefusedInfo| {
        let ip = refused.address.parse().ok().map(|address: std::net::SocketAddr| address.ip());
        refused.node.is_none()
            && heard.is_some_and(|heard| ip == Some(heard.source.ip()) && !ip.is_some_and(|ip| ip.is_loopback()))
    };
    let of_it = |refused: &&RefusedInfo| {
        refused.ago_ms <= recent
            && (refused.node.as_deref().is_some_and(|node| which.is_text(node)) || same_host(refused))
    };
    let reported =
        seen.running.iter().flat_map(|unit| unit.refused.iter().filter(of_it).map(move |refused| (unit, refused)));
    let mut reported: Vec<_> = reported.collect();
    reported.sort_by_key(|(_, refused)| refused.ago_ms);
    let mut found: Vec<Finding> = Vec::new();
    for finding in reported.iter().filter_map(|(unit, refused)| refusal(&unit.name(), refused)) {
        if found.iter().all(|known| known.id != finding.id) {
            found.push(finding.certain(true));
        }
    }
    found
}

fn not_joining(seen: &Evidence, name: &str, wanted: &Manager) -> Finding {
    let manager = text_of(wanted);
    let port = seen.manager(wanted).and_then(|heard| heard.tcp_port);
    let port = port.map_or("its TCP port".to_owned(), |port| format!("TCP port {port}"));
    let found = format!(
        "{name} and its manager {manager} are both heard here, and {name} still looks for it after {:.0} s",
        seen.listened.as_secs_f32()
    );
    let advice = format!(
        "if it does not join within the next seconds: what {manager} sends (UDP port {}) does not reach {name}, or {port} of \
         {manager} is closed to it; look at the firewalls of both",
        seen.port
    );
    let is_here = seen.running.iter().any(|unit| unit.name() == manager);
    let advice = match is_here {
        true => format!("{advice}; the log of {name} says how far it comes"),
        false => format!("{advice}, and run `cara doctor {}` on the manager's host", quoted(name)),
    };
    Finding::error(Id::NotJoining, found, advice).about(name)
}

#[cfg(test)]
mod tests;
