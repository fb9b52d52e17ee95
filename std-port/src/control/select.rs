//! Which node a question means: `NAME`, `NAME/ID` or `#ID`, where needed with `@m_unit` or `@s_unit` behind it.

use std::collections::HashSet;

use crate::{CommunicationSystem, Identity, Peer};

use super::protocol::Failure;

/// Most nodes that a failure lists.
const LISTED: usize = 20;

/// The node that `selector` means; a failure lists what there is.
pub(super) fn node<T: Send + 'static>(system: &CommunicationSystem<T>, selector: &str) -> Result<Peer<T>, Failure> {
    let all = nodes(system);
    let reading = |peer: &Peer<T>| reading(selector, peer.name(), peer.id(), peer.identity().role().as_str());
    let best = all.iter().filter_map(reading).min();
    let is_meant = |peer: &&Peer<T>| best.is_some() && reading(peer) == best;
    let mut meant: Vec<Peer<T>> = all.iter().filter(is_meant).cloned().collect();
    // One that is absent may be the one that is meant, unless it was taken off the roster.
    if meant.len() > 1 {
        meant.retain(|peer| !peer.is_retired());
    }
    match (meant.pop(), meant.is_empty()) {
        (Some(peer), true) => Ok(peer),
        (Some(peer), false) => {
            meant.push(peer);
            let text = format!("'{selector}' means several nodes ({}): ask for one of them", list(&meant));
            Err(Failure::configuration("AmbiguousNode", text))
        }
        (None, _) if all.is_empty() => {
            Err(Failure::configuration("UnknownNode", format!("there is no node '{selector}': none has joined yet")))
        }
        (None, _) => {
            let text = format!("there is no node '{selector}'; there are {}", list(&all));
            Err(Failure::configuration("UnknownNode", text))
        }
    }
}

/// All nodes that have joined, connected or not, and those of the roster that have not.
pub(super) fn nodes<T: Send + 'static>(system: &CommunicationSystem<T>) -> Vec<Peer<T>> {
    let mut nodes = system.s_units();
    let joined: HashSet<Identity> = nodes.iter().map(|peer| peer.identity().clone()).collect();
    nodes.extend(system.roster().into_iter().filter(|peer| !joined.contains(peer.identity())));
    nodes.extend(system.m_units());
    nodes
}

/// How a selector can be read so that it means a node, the best first: a name may hold `/`, `#` and `@` itself, and must not
/// hide the node whose whole NAME/ID is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Reading {
    NameAndId,
    Name,
    Id,
    WithRole,
}

fn reading(selector: &str, name: &str, id: u32, role: &str) -> Option<Reading> {
    let of = |selector: &str| {
        if selector.rsplit_once('/').is_some_and(|(wanted, number)| wanted == name && is(number, id)) {
            return Some(Reading::NameAndId);
        }
        let is_number = selector.strip_prefix('#').is_some_and(|number| is(number, id));
        (selector == name).then_some(Reading::Name).or(is_number.then_some(Reading::Id))
    };
    let of_role = selector.rsplit_once('@').filter(|(_, wanted)| *wanted == role);
    of(selector).or_else(|| of(of_role?.0).map(|_| Reading::WithRole))
}

fn is(number: &str, id: u32) -> bool {
    number.parse() == Ok(id)
}

fn list<T: Send + 'static>(peers: &[Peer<T>]) -> String {
    let same = |name: &str| peers.iter().filter(|other| other.identity().to_string() == name).count();
    let full = |peer: &Peer<T>| match same(&peer.identity().to_string()) {
        1 => peer.identity().to_string(),
        _ => format!("{}@{}", peer.identity(), peer.identity().role().as_str()),
    };
    let mut names: Vec<String> = peers.iter().map(full).collect();
    names.sort();
    let more = names.len().saturating_sub(LISTED);
    names.truncate(LISTED);
    let names = names.join(", ");
    if more == 0 { names } else { format!("{names} and {more} more") }
}

#[cfg(test)]
mod tests {
    use super::{Reading, reading};

    fn means(selector: &str, name: &str, id: u32) -> bool {
        reading(selector, name, id, "s_unit").is_some()
    }

    #[test]
    fn a_name_hides_no_node_whose_name_and_id_are_written() {
        let of = |name: &str, id: u32| reading("agv/17", name, id, "s_unit");
        assert_eq!((of("agv", 17), of("agv/17", 12)), (Some(Reading::NameAndId), Some(Reading::Name)));
        assert!(of("agv", 17) < of("agv/17", 12));
        assert!(reading("#7", "#7", 1, "s_unit") < reading("#7", "agv", 7, "s_unit"));
    }

    #[test]
    fn a_role_may_stand_behind() {
        assert!(means("agv/7@s_unit", "agv", 7) && means("agv@s_unit", "agv", 7) && means("#7@s_unit", "agv", 7));
        assert!(!means("agv/7@m_unit", "agv", 7) && !means("agv/7@", "agv", 7));
        assert!(means("agv@s_unit", "agv@s_unit", 1));
    }

    #[test]
    fn a_node_is_meant_by_name_by_both_or_by_id() {
        assert!(means("agv", "agv", 7) && means("agv/7", "agv", 7) && means("#7", "agv", 7));
        assert!(!means("agv/8", "agv", 7) && !means("#8", "agv", 7) && !means("ag", "agv", 7) && !means("", "agv", 7));
        assert!(!means("7", "agv", 7), "a number alone may be a name");
    }

    #[test]
    fn a_name_may_look_like_a_selector() {
        assert!(means("hall/2", "hall/2", 9) && means("hall/2/9", "hall/2", 9) && means("#7", "#7", 1));
    }
}
