use std::net::SocketAddr;

use cara_std::Fleet;

use super::super::dial::{Dial, Outcome};
use super::super::evidence::samples::{LATER, answering, evidence, node_info, running, searching};
use super::*;

fn ids(seen: &Evidence) -> Vec<Id> {
    check(seen, &Which("agv".into())).iter().map(|finding| finding.id).collect()
}

fn refused(reason: &str, node: Option<&str>, address: &str) -> RefusedInfo {
    RefusedInfo {
        address: address.into(),
        node: node.map(Into::into),
        reason: reason.into(),
        text: "do this".into(),
        ago_ms: 1000,
    }
}

/// `agv` looks for `boss/1`, which answers.
fn both() -> Evidence {
    let mut seen = evidence();
    seen.heard = vec![searching("agv", 7, "boss"), answering("boss", 3)];
    seen.dials = vec![Dial { to: seen.heard[1].listens_at().unwrap(), outcome: Some(Outcome::Open) }];
    seen
}

#[test]
fn silence_is_explained_by_the_host_before_the_node() {
    let mut seen = evidence();
    assert_eq!(ids(&seen), [Id::NotHeard]);
    seen.reach[0].heard = 0;
    assert_eq!(ids(&seen), [Id::BroadcastLost]);
    seen.reach[0].heard = 1;
    seen.answered_alone = vec!["10.0.0.9:21970".parse().unwrap()];
    assert_eq!(ids(&seen), [Id::BroadcastOneWay]);
}

#[test]
fn a_node_that_dials_in_vain_is_silent() {
    let mut seen = both();
    seen.heard.remove(0);
    seen.dials[0].outcome = Some(Outcome::Refused);
    assert_eq!(ids(&seen), [Id::TcpBlocked]);
    seen.dials[0].outcome = None;
    seen.heard[0].room = Some(0);
    assert_eq!(ids(&seen), [Id::Full, Id::AskItsManager]);
}

#[test]
fn a_manager_elsewhere_may_have_it() {
    let mut seen = evidence();
    seen.heard = vec![answering("boss", 3)];
    assert_eq!(ids(&seen), [Id::AskItsManager]);
    seen.running = vec![running("boss", 1)];
    assert_eq!(ids(&seen), [Id::NotHeard], "that manager runs here and does not have it");
}

#[test]
fn where_no_manager_runs_that_is_the_cause_and_it_is_about_the_node_that_was_asked_for() {
    let mut seen = evidence();
    seen.heard = vec![searching("other", 8, "boss")];
    let reported = check(&seen, &Which("agv".into()));
    assert_eq!((reported.len(), reported[0].id, reported[0].about.as_deref()), (1, Id::NoManager, Some("agv")));
    assert!(reported[0].certain, "it need not listen for longer");
    seen.running = vec![running("bos", 1)];
    assert_eq!(ids(&seen), [Id::NotHeard, Id::WrongManager], "another one runs");
}

#[test]
fn what_the_manager_knows_is_not_listened_for() {
    let mut seen = evidence();
    seen.running = vec![running("boss", 1)];
    seen.running[0].nodes = vec![node_info("agv", 7, false)];
    let first = |seen: &Evidence| check(seen, &Which("agv".into())).remove(0);
    assert_eq!((first(&seen).id, first(&seen).certain), (Id::Lost, false), "it may come back within the next seconds");
    seen.running[0].nodes[0].left_ms = Some(20_000);
    assert!(first(&seen).certain);
    // It has never joined, and this manager has run for long.
    seen.running[0].nodes[0].left_ms = None;
    assert_eq!((first(&seen).id, first(&seen).certain), (Id::NotHeard, true));
    seen.running[0].unit.uptime_ms = 5_000;
    assert!(!first(&seen).certain);
}

/// What the manager knows of a node comes before what keeps other hosts away: both may be on this one.
#[test]
fn a_host_without_an_interface_is_told_behind_what_its_manager_knows() {
    let mut seen = evidence();
    seen.reach.clear();
    assert_eq!(ids(&seen), [Id::NoInterface], "nobody knows more");
    seen.running = vec![running("boss", 1)];
    let reported = |seen: &Evidence| check(seen, &Which("agv".into())).remove(0).found;
    assert_eq!(ids(&seen), [Id::NotHeard, Id::NoInterface]);
    assert!(reported(&seen).contains("boss/1 neither has it nor waits for it"), "{}", reported(&seen));
    seen.running[0].nodes = vec![node_info("agv", 7, false)];
    assert_eq!(ids(&seen), [Id::Lost, Id::NoInterface]);
    seen.running[0].nodes[0].left_ms = Some(20_000);
    assert!(check(&seen, &Which("agv".into()))[0].certain, "it need not listen for longer");
}

#[test]
fn another_fleet_or_version_counts_only_where_ours_is_silent() {
    let mut seen = evidence();
    seen.heard = vec![Heard { fleet: Fleet(9), ..searching("agv", 7, "boss") }];
    assert_eq!(ids(&seen), [Id::OtherFleet]);
    seen.heard = vec![Heard { versions: LATER, ..searching("agv", 7, "boss") }];
    assert_eq!(ids(&seen), [Id::OtherVersion]);
    seen.heard.extend(both().heard);
    seen.dials = both().dials;
    assert_eq!(ids(&seen), [Id::NotJoining]);
    seen.heard = vec![Heard { versions: LATER, identity: None, ..searching("agv", 7, "boss") }];
    assert_eq!(ids(&seen), [Id::OtherVersion, Id::NotHeard], "one that cannot be read may be the one");
}

#[test]
fn the_manager_that_it_looks_for_is_compared_with_those_that_run() {
    let mut seen = both();
    assert_eq!(ids(&seen), [Id::NotJoining]);
    seen.heard[1] = answering("bos", 3);
    assert_eq!(ids(&seen), [Id::WrongManager]);
    seen.heard.truncate(1);
    assert_eq!(ids(&seen), [Id::NoManager]);
    seen.heard.push(Heard { fleet: Fleet(9), ..answering("boss", 3) });
    assert_eq!(ids(&seen), [Id::OtherFleet]);
    seen.heard[1] = Heard { versions: LATER, ..answering("boss", 3) };
    assert_eq!(ids(&seen), [Id::OtherVersion]);
}

#[test]
fn a_closed_port_or_a_full_manager_is_named() {
    let mut seen = both();
    seen.dials[0].outcome = Some(Outcome::TimedOut);
    assert_eq!(ids(&seen), [Id::TcpBlocked]);
    seen.dials[0].outcome = Some(Outcome::Open);
    seen.heard[1].room = Some(0);
    assert_eq!(ids(&seen), [Id::Full]);
    seen.heard[1].room = Some(1);
    let mut unit = running("boss", 1);
    unit.unit.connected = 64;
    seen.running = vec![unit];
    assert_eq!(ids(&seen), [Id::Full]);
    // It takes connections, and drops them.
    seen.running[0].unit.connected = 27;
    seen.running[0].files = Some(crate::running::Files { limit: 64, open: 44 });
    assert_eq!(ids(&seen), [Id::FewDescriptors]);
}

/// Its own host's cable is out: nobody is to look after the manager first.
#[test]
fn a_node_of_a_host_that_is_cut_off_is_not_told_that_no_manager_runs() {
    let mut seen = evidence();
    seen.heard = vec![Heard { source: "127.0.0.1:5000".parse().unwrap(), ..searching("agv", 7, "boss") }];
    assert_eq!(ids(&seen), [Id::NoManager]);
    seen.reach[0].interface.up = false;
    assert_eq!(ids(&seen), [Id::InterfaceDown, Id::NoManager]);
}

#[test]
fn the_firewall_that_is_meant_is_that_of_either_host() {
    let mut seen = both();
    seen.dials[0].outcome = Some(Outcome::Refused);
    let advice = |seen: &Evidence| check(seen, &Which("agv".into())).remove(0).advice;
    assert!(advice(&seen).contains("firewall of 10.0.0.9, out in that of this host"), "{}", advice(&seen));
    assert!(!advice(&seen).contains("restart"), "its vehicles would stop");
    seen.running = vec![running("boss", 1)];
    assert!(advice(&seen).contains("in in the firewall of this host"), "{}", advice(&seen));
}

#[test]
fn who_is_heard_over_loopback_alone_does_not_meet_another_host() {
    let first = |seen: &Evidence| check(seen, &Which("agv".into())).remove(0);
    let local = |heard: Heard| Heard { source: "127.0.0.1:5000".parse().unwrap(), ..heard };
    let mut seen = both();
    seen.heard[0] = local(searching("agv", 7, "boss"));
    let found = first(&seen);
    assert_eq!((found.id, found.about.as_deref()), (Id::LoopbackOnly, Some("agv/7")));
    assert!(found.found.contains("boss/1 at 10.0.0.9:5000 and not over loopback"), "{found:?}");
    seen.heard[1] = local(answering("boss", 3));
    assert_eq!(ids(&seen), [Id::NotJoining], "both are on this host");
    seen.heard[0] = searching("agv", 7, "boss");
    let found = first(&seen);
    assert_eq!((found.id, found.about.as_deref()), (Id::LoopbackOnly, Some("boss/1")));
    seen.heard.push(answering("boss", 3));
    assert_eq!(ids(&seen), [Id::NotJoining], "it is heard from both");
}

#[test]
fn a_refusal_of_the_manager_says_it_itself() {
    let mut seen = both();
    let mut unit = running("boss", 1);
    unit.refused =
        vec![refused("DuplicateIdentity", Some("agv/7"), "10.0.0.3:1"), refused("Full", Some("other/8"), "10.0.0.4:1")];
    seen.running = vec![unit];
    assert_eq!(ids(&seen), [Id::Duplicate]);
    seen.running[0].refused[0].ago_ms = 1_000_000;
    assert_eq!(ids(&seen), [Id::NotJoining], "that was long ago");
    seen.running[0].refused = vec![refused("Malformed", None, "10.0.0.9:33333")];
    assert_eq!(ids(&seen), [Id::Refused], "the host is the same");
}

#[test]
fn twins_and_restarts_are_told_apart() {
    let mut seen = both();
    let second = Heard {
        epoch: Some(cara_std::Epoch(2)),
        first: Duration::from_secs(3),
        last: Duration::from_secs(3),
        ..searching("agv", 7, "boss")
    };
    seen.heard.push(second);
    assert_eq!(ids(&seen), [Id::Restarting]);
    seen.heard[0].last = Duration::from_secs(6);
    assert_eq!(ids(&seen), [Id::Duplicate]);
}

#[test]
fn connected_answering_and_own_units_are_no_trouble() {
    let mut seen = both();
    let mut unit = running("boss", 1);
    unit.nodes = vec![node_info("agv", 7, true)];
    seen.running = vec![unit];
    assert_eq!(ids(&seen), [Id::Connected]);
    seen.running[0].nodes[0].connected = false;
    assert_eq!(ids(&seen), [Id::NotJoining]);
    let boss = |seen: &Evidence| check(seen, &Which("boss".into()))[0].id;
    assert_eq!(boss(&seen), Id::Answers);
    seen.running.clear();
    assert_eq!(boss(&seen), Id::Answers);
    seen.heard[1].to_us = 0;
    assert_eq!(boss(&seen), Id::BroadcastOneWay, "it is heard, and answers nobody");
    seen.dials = vec![Dial { to: SocketAddr::new(seen.heard[1].source.ip(), 4000), outcome: Some(Outcome::Refused) }];
    assert_eq!(boss(&seen), Id::TcpBlocked);
}

#[test]
fn another_fleet_and_another_manager_are_told_together() {
    let mut seen = evidence();
    seen.heard = vec![Heard { fleet: Fleet(9), ..searching("agv", 7, "bos") }, answering("boss", 3)];
    let reported = |seen: &Evidence| check(seen, &Which("agv".into())).remove(0);
    assert!(
        reported(&seen).found.ends_with("and it looks for the manager bos/1, and boss/1 runs"),
        "{:?}",
        reported(&seen)
    );
    seen.heard[0] = Heard { fleet: Fleet(9), ..searching("agv", 7, "boss") };
    assert!(!reported(&seen).found.contains("looks for"));
    seen.fleet_known = false;
    assert_eq!(reported(&seen).advice, "no --fleet was given: try `--fleet 9`");
}

#[test]
fn a_node_of_the_same_name_and_another_id_is_named() {
    let mut seen = evidence();
    let mut unit = running("boss", 1);
    unit.nodes = vec![node_info("agv-17", 17, true)];
    seen.running = vec![unit];
    let found = check(&seen, &Which("agv-17/18".into())).remove(0);
    assert!(found.found.ends_with("; there is agv-17/17"), "{found:?}");
    // It is waited for, and is no other one.
    seen.running[0].nodes[0] = node_info("agv-17", 17, false);
    seen.running[0].nodes[0].left_ms = None;
    let found = check(&seen, &Which("agv-17".into())).remove(0);
    assert!(found.found.ends_with("boss/1 waits for it, and it has not joined"), "{found:?}");
    assert!(found.found.contains("on eth0, UDP port 21971, fleet 7"), "{found:?}");
}
