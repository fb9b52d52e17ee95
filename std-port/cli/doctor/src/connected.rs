//! A node that is connected: in order, or with something that will take its link away.

use cara_std::control::protocol::{DatagramsInfo, NodeInfo, QUIET_STREAM_MS, RefusedInfo};

use super::causes::{duplicate, duplicate_manager, refusal, restarting};
use super::evidence::Evidence;
use super::finding::{Finding, Id, Severity};
use super::running::Running;

use cara_tools::name_and_id::full_name;

use std::time::Duration;

/// A node that has been connected for less is watched for as long as may be listened: it may come and go.
const SETTLED: Duration = Duration::from_secs(10);
/// And any one for this long, since another one may show itself in its name.
const WATCHED: Duration = Duration::from_secs(2);
/// Missed signs of life below which nothing is said.
const FEW_MISSES: u64 = 3;
/// Segments of this size or less are used where longer ones do not pass.
const SHORT_SEGMENT: u32 = 536;
/// Missed signs of life per datagram received above which a link loses too much: one in fifty.
const LOSSY: u64 = 50;

/// What is to be said of a connected node.
pub(crate) fn check(seen: &Evidence, unit: &Running, node: &NodeInfo) -> Vec<Finding> {
    let name = format!("{}/{}", node.name, node.id);
    let lives = seen.lives(&name);
    let duplicates = duplicate(&name, &lives).or_else(|| refused_duplicate(unit, node));
    // A second manager may take the node over, or be the one that is meant to have it.
    let duplicates = duplicates.into_iter().chain(duplicate_manager(seen, &unit.name()));
    let mut found: Vec<Finding> = duplicates.map(|finding| finding.certain(true)).collect();
    found.extend(restarting(&name, &lives));
    found.extend(lossy(unit, node));
    found.extend(ways(unit, node));
    found.extend(clock(unit, node));
    if found.iter().any(|finding| finding.severity != Severity::Info) {
        return found;
    }
    let address = node.address.as_deref().unwrap_or("an unknown address");
    let text = format!("{name} is connected to {} at {address}{}", unit.name(), since(node));
    let settled = node.connected_ms.is_some_and(|ms| Duration::from_millis(ms) >= SETTLED);
    let certain = settled && seen.listened >= WATCHED;
    let advice = if found.is_empty() { "nothing needs to be done" } else { "it is in order now" };
    found.push(Finding::info(Id::Connected, text, advice).about(&name).certain(certain));
    found
}

/// For how long.
fn since(node: &NodeInfo) -> String {
    node.connected_ms
        .map_or(String::new(), |ms| format!(", without a break for {:.1} s", Duration::from_millis(ms).as_secs_f32()))
}

/// Another node of its name was refused a short while ago, while it was connected.
fn refused_duplicate(unit: &Running, node: &NodeInfo) -> Option<Finding> {
    let recent = |ago_ms: u64| ago_ms < 30_000;
    let name = full_name(node);
    let duplicate = unit.refused.iter().find(|refused| {
        let of_it = refused.node.as_ref() == Some(&name) && !came_later(node, refused);
        refused.reason == "DuplicateIdentity" && recent(refused.ago_ms) && of_it
    });
    duplicate.and_then(|refused| refusal(&unit.name(), refused))
}

/// Whether a node has connected since it was refused.
pub(crate) fn came_later(node: &NodeInfo, refused: &RefusedInfo) -> bool {
    let is_it = node.connected && refused.node.as_ref() == Some(&full_name(node));
    is_it && node.connected_ms.is_some_and(|connected| connected < refused.ago_ms)
}

/// A link on which signs of life get lost.
pub(crate) fn lossy(unit: &Running, node: &NodeInfo) -> Option<Finding> {
    // Where they do not pass at all, that is the finding.
    if node.link.and_then(|link| link.datagrams).is_some_and(|datagrams| datagrams != DatagramsInfo::Pass) {
        return None;
    }
    let node = &format!("{}/{}", node.name, node.id);
    let missed = unit.counter(node, "KeepAlivesMissed")?;
    let received = unit.counter(node, "DatagramsReceived")?;
    (missed >= FEW_MISSES && missed.saturating_mul(LOSSY) >= received).then(|| {
        let found = format!("{missed} signs of life of {node} did not come in time, and {received} datagrams did");
        let advice = "look at the radio signal, cable and switch port; at three in a row the link is lost and the node stops. \
                      A node or manager that was suspended, or whose processor is overloaded, looks the same";
        Finding::warning(Id::LossyLink, found, advice).about(node)
    })
}

/// A clock that differs from the manager's.
pub(crate) fn clock(unit: &Running, node: &NodeInfo) -> Option<Finding> {
    let name = full_name(node);
    let trouble = node.clock?.trouble()?;
    let found = format!("{name}: {trouble}, compared with that of {}", unit.name());
    let advice = "look on both hosts whether the clock is set by NTP or PTP (`timedatectl`): until then times of their logs and \
                  recordings do not fit together. Leases and time-outs do not depend on it";
    Some(Finding::warning(Id::ClockWrong, found, advice).about(&name))
}

/// Which way to a connected node is blocked, as far as either end knows.
pub(crate) fn ways(unit: &Running, node: &NodeInfo) -> Vec<Finding> {
    let name = format!("{}/{}", node.name, node.id);
    let (own, address) = (unit.name(), node.address.as_deref().unwrap_or("an unknown address"));
    let blocked = match node.link.and_then(|link| link.datagrams) {
        None | Some(DatagramsInfo::Pass) => None,
        Some(DatagramsInfo::ToUnit) => {
            Some(format!("datagrams of {own} do not arrive at {name} ({address}); those of {name} do here"))
        }
        Some(DatagramsInfo::ToNode) => {
            Some(format!("no datagrams of {name} ({address}) arrive at {own}; those of {own} do there"))
        }
        Some(DatagramsInfo::None) => {
            Some(format!("no datagrams pass between {own} and {name} ({address}); the connection does"))
        }
    };
    let blocked = blocked.map(|found| {
        let advice = "let UDP through the firewalls and NATs between the two, from and to any port; until then signs of life and \
                      best-effort calls go in the connection, and a stop has no second way";
        Finding::warning(Id::DatagramsBlocked, found, advice).about(&name)
    });
    let silent = node.link.map(|link| link.stream_ms).filter(|silent| *silent > QUIET_STREAM_MS);
    let died = unit.counter(&name, "StreamsDied").filter(|died| *died > 0);
    let short = node.link.and_then(|link| link.segment).filter(|segment| *segment <= SHORT_SEGMENT);
    let stream = match (silent, died) {
        (Some(silent), _) => Some(format!(
            "the connection to {name} has brought nothing for {} s, though it is heard by datagrams",
            silent / 1000
        )),
        (None, Some(died)) => {
            let times = if died == 1 { "once".to_owned() } else { format!("{died} times") };
            Some(format!("the connection to {name} was dead {times} though {name} was heard, and was opened again"))
        }
        (None, None) => None,
    };
    let stream = stream.map(|found| {
        let (more, advice) = match short {
            Some(segment) => (
                format!(", now with segments of {segment} bytes"),
                "a part of the path seems to drop long packets: look at the MTU of its tunnels, switches and radios",
            ),
            None => (
                String::new(),
                "look for a firewall or a NAT between the two that drops TCP, or forgets sessions that are idle or older than its restart",
            ),
        };
        let severity = if silent.is_some() { Severity::Warning } else { Severity::Info };
        Finding { severity, ..Finding::warning(Id::StreamDead, found + &more, advice) }.about(&name)
    });
    blocked.into_iter().chain(stream).collect()
}

#[cfg(test)]
mod tests {
    use cara_std::control::protocol::{ClockInfo, LinkInfo};
    use cara_std::survey::Heard;
    use cara_std::{Claim, Epoch};

    use super::super::evidence::samples::{answering, evidence, life, node_info, running};
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
    fn the_way_that_is_blocked_is_told_and_no_more_than_is_known() {
        let mut seen = connected();
        let link = LinkInfo {
            silent_ms: 100,
            calls: 0,
            calls_here: 0,
            queued_bytes: 0,
            stream_ms: 3_000,
            datagrams: None,
            segment: Some(1_448),
            cipher: None,
        };
        let mut reported = |link: LinkInfo, died| {
            seen.running[0].nodes[0].link = Some(link);
            seen.running[0].count("agv/7", &[("StreamsDied", died)]);
            let found = check(&seen, &seen.running[0], &seen.running[0].nodes[0]);
            found.into_iter().map(|finding| (finding.id, finding.found)).collect::<Vec<_>>()
        };
        for datagrams in [None, Some(DatagramsInfo::Pass)] {
            assert_eq!(reported(LinkInfo { datagrams, ..link }, 0)[0].0, Id::Connected);
        }
        for (datagrams, text) in [
            (DatagramsInfo::ToUnit, "datagrams of boss/1 do not arrive at agv/7"),
            (DatagramsInfo::ToNode, "no datagrams of agv/7 (10.0.0.7:5000) arrive at boss/1"),
            (DatagramsInfo::None, "no datagrams pass between boss/1 and agv/7"),
        ] {
            let found = reported(LinkInfo { datagrams: Some(datagrams), ..link }, 0);
            assert!(found.len() == 1 && found[0].0 == Id::DatagramsBlocked && found[0].1.contains(text), "{found:?}");
        }
        assert_eq!(
            reported(LinkInfo { stream_ms: 8_100, ..link }, 0)[0].0,
            Id::Connected,
            "a probe may be due only now"
        );
        let silent = reported(LinkInfo { stream_ms: 9_500, ..link }, 0);
        assert!(silent.len() == 1 && silent[0].0 == Id::StreamDead && silent[0].1.contains("for 9 s"), "{silent:?}");
        let died = reported(link, 2);
        assert_eq!([died[0].0, died[1].0], [Id::StreamDead, Id::Connected]);
        assert!(died[0].1.contains("dead 2 times") && !died[0].1.contains("segments"), "{died:?}");
        let short = reported(LinkInfo { segment: Some(524), ..link }, 1);
        assert!(short[0].1.contains("segments of 524 bytes"), "{short:?}");
    }

    #[test]
    fn a_clock_that_is_wrong_is_told() {
        let mut seen = connected();
        for (offset_us, expected) in
            [(100_000, Id::Connected), (2_000_000, Id::ClockWrong), (-2_000_000, Id::ClockWrong)]
        {
            seen.running[0].nodes[0].clock = Some(ClockInfo { offset_us, error_us: 100, age_ms: 5 });
            assert_eq!(ids(&seen), [expected], "{offset_us}");
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

    #[test]
    fn a_second_manager_is_told_beside_a_connected_node() {
        let mut seen = connected();
        let said = |epoch, term| Heard {
            epoch: Some(Epoch(epoch)),
            claim: Some(Claim { term, claimant: 0 }),
            last: Duration::from_secs(3),
            ..answering("boss", 1)
        };
        seen.heard = vec![said(1, 4), Heard { first: Duration::from_secs(4), ..said(2, 4) }];
        assert_eq!(ids(&seen), [Id::Connected], "it has started again");
        seen.heard = vec![said(1, 4), said(2, 5)];
        assert_eq!(ids(&seen), [Id::Fenced]);
        seen.heard[1] = said(2, 4);
        assert_eq!(ids(&seen), [Id::Duplicate]);
    }

    #[test]
    fn a_refusal_before_the_node_joined_is_over() {
        let mut seen = connected();
        let refused = |ago_ms| RefusedInfo {
            address: "10.0.0.2:5".into(),
            node: Some("agv/7".into()),
            reason: "DuplicateIdentity".into(),
            text: "text".into(),
            ago_ms,
        };
        seen.running[0].nodes[0].connected_ms = Some(20_000);
        for (ago_ms, expected) in [(19_000, Id::Duplicate), (21_000, Id::Connected)] {
            seen.running[0].refused = vec![refused(ago_ms)];
            assert_eq!(ids(&seen), [expected], "{ago_ms}");
        }
    }
}
