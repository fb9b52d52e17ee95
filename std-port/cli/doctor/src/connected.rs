//! A node that is connected: in order, or with something that will take its link away.

use cara_std::control::protocol::NodeInfo;

use super::causes::{duplicate, refusal, restarting};
use super::evidence::Evidence;
use super::finding::{Finding, Id};
use super::running::Running;

use std::time::Duration;

/// A node that has been connected for less is watched for as long as may be listened: it may come and go.
const SETTLED: Duration = Duration::from_secs(10);
/// And any one for this long, since another one may show itself in its name.
const WATCHED: Duration = Duration::from_secs(2);
/// Missed signs of life below which nothing is said.
const FEW_MISSES: u64 = 3;
/// Missed signs of life per datagram received above which a link loses too much: one in fifty.
const LOSSY: u64 = 50;

/// What is to be said of a connected node.
pub(crate) fn check(seen: &Evidence, unit: &Running, node: &NodeInfo) -> Vec<Finding> {
    let name = format!("{}/{}", node.name, node.id);
    let lives = seen.lives(&name);
    let duplicates = duplicate(&name, &lives).or_else(|| refused_duplicate(unit, &name));
    let mut found: Vec<Finding> = duplicates.map(|finding| finding.certain(true)).into_iter().collect();
    found.extend(restarting(&name, &lives));
    found.extend(lossy(unit, &name));
    if !found.is_empty() {
        return found;
    }
    let address = node.address.as_deref().unwrap_or("an unknown address");
    let text = format!("{name} is connected to {} at {address}{}", unit.name(), since(node));
    let settled = node.connected_ms.is_some_and(|ms| Duration::from_millis(ms) >= SETTLED);
    let certain = settled && seen.listened >= WATCHED;
    vec![Finding::info(Id::Connected, text, "nothing needs to be done").about(&name).certain(certain)]
}

/// For how long.
fn since(node: &NodeInfo) -> String {
    node.connected_ms
        .map_or(String::new(), |ms| format!(", without a break for {:.1} s", Duration::from_millis(ms).as_secs_f32()))
}

/// Another node of its name was refused a short while ago.
fn refused_duplicate(unit: &Running, name: &str) -> Option<Finding> {
    let recent = |ago_ms: u64| ago_ms < 30_000;
    let duplicate = unit.refused.iter().find(|refused| {
        refused.reason == "DuplicateIdentity" && recent(refused.ago_ms) && refused.node.as_deref() == Some(name)
    });
    duplicate.and_then(|refused| refusal(&unit.name(), refused))
}

/// A link on which signs of life get lost.
pub(crate) fn lossy(unit: &Running, node: &str) -> Option<Finding> {
    let missed = unit.counter(node, "KeepAlivesMissed")?;
    let received = unit.counter(node, "DatagramsReceived")?;
    (missed >= FEW_MISSES && missed.saturating_mul(LOSSY) >= received).then(|| {
        let found = format!("{missed} signs of life of {node} did not come in time, and {received} datagrams did");
        let advice = "look at the radio signal, cable and switch port; at three in a row the link is lost and the node stops. \
                      A node or manager that was suspended, or whose processor is overloaded, looks the same";
        Finding::warning(Id::LossyLink, found, advice).about(node)
    })
}

#[cfg(test)]
mod tests {
    use super::super::evidence::samples::{evidence, life, node_info, running};
    use super::*;

    fn ids(seen: &Evidence) -> Vec<Id> {
        let unit = &seen.running[0];
        check(seen, unit, &unit.nodes[0]).iter().map(|finding| finding.id).collect()
    }

    fn connected() -> Evidence {
        let mut unit = running("boss", 1);
        unit.nodes = vec![node_info("agv", 7, true)];
        Evidence { running: vec![unit], listened: WATCHED, ..evidence() }
    }

    #[test]
    fn in_order_is_told_with_address_and_time() {
        let seen = connected();
        let found = check(&seen, &seen.running[0], &seen.running[0].nodes[0]);
        assert_eq!(found[0].found, "agv/7 is connected to boss/1 at 10.0.0.7:5000, without a break for 61.5 s");
        assert!(found.len() == 1 && found[0].certain);
    }

    #[test]
    fn a_link_is_lossy_by_the_share_that_is_missing() {
        let mut seen = connected();
        for (missed, received, lossy) in [(2, 10, false), (3, 150, true), (3, 151, false), (40, 1000, true)] {
            seen.running[0].count("agv/7", &[("KeepAlivesMissed", missed), ("DatagramsReceived", received)]);
            let expected = if lossy { vec![Id::LossyLink] } else { vec![Id::Connected] };
            assert_eq!(ids(&seen), expected, "{missed} of {received}");
        }
    }

    #[test]
    fn a_life_that_goes_on_beside_the_connected_one_is_a_duplicate() {
        let mut seen = connected();
        seen.connected_lives = vec![life("agv/7", 1, 0, 9000), life("agv/7", 2, 3000, 3000)];
        assert_eq!(ids(&seen), [Id::Duplicate]);
        seen.connected_lives[0].last = seen.connected_lives[0].first;
        assert_eq!(ids(&seen), [Id::Restarting]);
    }
}
