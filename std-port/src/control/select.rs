//! Which node a question means: `NAME`, `NAME/ID` or `#ID`, where needed with `@m_unit` or `@s_unit` behind it.

use std::collections::HashSet;

use crate::{CommunicationSystem, Identity, Peer};

use super::protocol::Failure;

/// Most nodes that a failure lists.
const LISTED: usize = 20;

/// The node that `selector` means; a failure lists what there is.
pub(super) fn node<T: Send + 'static>(system: &CommunicationSystem<T>, selector: &str) -> Result<Peer<T>, Failure> {
    let all = nodes(system);
    let is_meant = |peer: &&Peer<T>| means(selector, peer.name(), peer.id(), peer.identity().role().as_str());
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

/// A name may hold `/`, `#` and `@` itself, so each reading counts.
fn means(selector: &str, name: &str, id: u32, role: &str) -> bool {
    let of_role = selector.rsplit_once('@').filter(|(_, wanted)| *wanted == role);
    let is_it = |selector: &str| {
        let by_both = selector.rsplit_once('/').is_some_and(|(wanted, number)| wanted == name && is(number, id));
        selector == name || by_both || selector.strip_prefix('#').is_some_and(|number| is(number, id))
    };
    is_it(selector) || of_role.is_some_and(|(selector, _)| is_it(selector))
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
    fn means(selector: &str, name: &str, id: u32) -> bool {
        super::means(selector, name, id, "s_unit")
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
