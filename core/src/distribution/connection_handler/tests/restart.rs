//! Known identities that come back: challenges, and indices that keep their meaning.

use std::string::ToString;

use super::*;
use crate::config::CHALLENGE_TIMEOUT;
use crate::error::Error;

fn reborn(config: &NodeConfig<SocketAddr>) -> Hello {
    Hello { epoch: Epoch(999), ..hello_of(config) }
}

fn challenged() -> Node<InMemory> {
    let mut node = depot();
    let agv = s_unit("agv", 1);
    join(&mut node, at(1), 0, &agv);
    let admission = node.admit(at(1_000), LinkId(1), address(1, 41_000), &reborn(&agv));
    assert_eq!(admission, Admission::Wait);
    assert_eq!(due(&mut node, at(1_000)), [notify(0, Directive::Challenge)]);
    node
}

#[test]
fn an_old_link_that_answers_stays_and_the_newcomer_is_a_duplicate() {
    let mut node = challenged();
    node.challenge_answered(at(1_100), LinkId(0));
    assert_eq!(due(&mut node, at(1_100)), [notify(1, Directive::Refuse(Refusal::DuplicateIdentity))]);
    node.challenge_answered(at(1_101), LinkId(0));
    assert_eq!(run(&mut node, at(2_000), &mut Outbox::default()), []);
    node.left(at(2_001), LinkId(1), CloseReason::Reset);
    let known = node.node_of(LinkId(0)).unwrap();
    assert_eq!((known.epoch, node.connected()), (Epoch(1), 1));
    let finding = node.findings().next().unwrap();
    assert_eq!((finding.refusal, finding.address), (Refusal::DuplicateIdentity, address(1, 41_000)));
    assert_eq!(finding.identity, Some(known.identity.clone()));
}

#[test]
fn a_refused_newcomer_leaves_a_dial_that_is_another_link() {
    let mut node = challenged();
    let place = node.table.find(&s_unit("agv", 1).identity).unwrap();
    node.table.node_mut(place).unwrap().dialing = Some(LinkId(3));
    node.challenge_answered(at(1_100), LinkId(0));
    assert_eq!(due(&mut node, at(1_100)), [notify(1, Directive::Refuse(Refusal::DuplicateIdentity))]);
    assert_eq!(node.table.node(place).unwrap().dialing, Some(LinkId(3)));
}

#[test]
fn who_joins_first_or_in_the_same_life_has_not_restarted() {
    let mut node = depot();
    let agv = s_unit("agv", 1);
    let place = |node: &Node<InMemory>| node.table.find(&agv.identity).unwrap();
    join(&mut node, at(1), 0, &agv);
    let known = place(&node);
    node.table.node_mut(known).unwrap().newest = Some((hello_of(&agv).epoch, 5));
    node.left(at(2), LinkId(0), CloseReason::Reset);
    join(&mut node, at(3), 1, &agv);
    assert_eq!(node.counters.value(NodeCounter::Restarted), 0);
    // What it has announced before stays the newest.
    assert_eq!(node.table.node(place(&node)).unwrap().newest, Some((hello_of(&agv).epoch, 5)));
    node.left(at(4), LinkId(1), CloseReason::Reset);
    assert_eq!(node.admit(at(5), LinkId(2), address(1, 40_000), &reborn(&agv)), Admission::Accept);
    assert_eq!(node.counters.value(NodeCounter::Restarted), 1);
    assert_eq!(node.table.node(place(&node)).unwrap().newest, Some((Epoch(999), 0)));
}

#[test]
fn an_old_link_that_is_silent_is_superseded_in_time() {
    let mut node = challenged();
    let commands = run(&mut node, at(2_000), &mut Outbox::default());
    let (when, reason) = (at(1_000) + CHALLENGE_TIMEOUT, CloseReason::PeerRestarted);
    assert_eq!(commands, [(when, notify(0, Directive::Close(reason)))]);
    node.challenge_answered(at(2_000), LinkId(0));
    assert_eq!(due(&mut node, at(2_000)), [], "too late");
    node.left(at(2_001), LinkId(0), reason);
    assert_eq!(due(&mut node, at(2_001)), [notify(1, Directive::Admit)]);
    assert_eq!(node.node_of(LinkId(1)).map(|known| known.epoch), Some(Epoch(999)));
    assert_eq!((node.connected(), node.counters.value(NodeCounter::Restarted)), (1, 1));
    node.challenge_answered(at(2_002), LinkId(0));
    assert_eq!(due(&mut node, at(2_002)), [], "too late");
}

#[test]
fn an_old_link_that_breaks_lets_the_newcomer_in_at_once() {
    let mut node = challenged();
    node.left(at(1_001), LinkId(0), CloseReason::Reset);
    assert_eq!(due(&mut node, at(1_001)), [notify(1, Directive::Admit)]);
    assert_eq!(node.node_of(LinkId(1)).map(Known::link), Some(Some(LinkId(1))));
    assert_eq!(run(&mut node, at(2_000), &mut Outbox::default()), []);
    assert_eq!(node.connected(), 1);
}

#[test]
fn a_newcomer_that_gives_up_leaves_everything_as_it_was() {
    let mut node = challenged();
    node.left(at(1_001), LinkId(1), CloseReason::Reset);
    node.challenge_answered(at(1_002), LinkId(0));
    assert_eq!(run(&mut node, at(2_000), &mut Outbox::default()), []);
    assert_eq!(node.node_of(LinkId(0)).map(|known| known.epoch), Some(Epoch(1)));
}

/// Otherwise the next link with its number would be taken for one of that node.
#[test]
fn the_link_of_a_refused_newcomer_is_no_nodes_link() {
    for hello in [reborn(&s_unit("agv", 1)), hello_of(&s_unit("agv", 1))] {
        let mut node = depot();
        join(&mut node, at(1), 0, &s_unit("agv", 1));
        assert_eq!(node.admit(at(1_000), LinkId(1), address(1, 41_000), &hello), Admission::Wait);
        assert!(node.node_of(LinkId(1)).is_none() && node.table.of_link(LinkId(1)).is_some());
        node.challenge_answered(at(1_001), LinkId(0));
        assert!(matches!(due(&mut node, at(1_001))[..], [Command::Notify(LinkId(1), Directive::Refuse(_))]));
        assert_eq!(node.table.of_link(LinkId(1)), None);
        assert!(node.node_of(LinkId(0)).is_some());
    }
}

#[test]
fn a_second_newcomer_is_refused() {
    let mut node = challenged();
    let third = node.admit(at(1_001), LinkId(2), address(1, 42_000), &reborn(&s_unit("agv", 1)));
    assert_eq!(third, Admission::Refuse(Refusal::DuplicateIdentity));
    node.left(at(1_002), LinkId(2), CloseReason::Reset);
    let commands = run(&mut node, at(2_000), &mut Outbox::default());
    assert!(matches!(commands[..], [(_, Command::Notify(LinkId(0), Directive::Close(_)))]), "{commands:?}");
}

#[test]
fn a_peer_that_dials_again_in_one_life_waits_for_its_old_link_to_show_itself() {
    let agv = s_unit("agv", 1);
    let mut node = depot();
    join(&mut node, at(1), 0, &agv);
    let again = |node: &mut Node<InMemory>| node.admit(at(1_000), LinkId(1), address(1, 41_000), &hello_of(&agv));
    assert_eq!(again(&mut node), Admission::Wait);
    assert_eq!(due(&mut node, at(1_000)), [notify(0, Directive::Challenge)]);
    node.challenge_answered(at(1_001), LinkId(0));
    assert_eq!(due(&mut node, at(1_001)), [notify(1, Directive::Refuse(Refusal::AlreadyConnected))]);
    assert_eq!(again(&mut node), Admission::Wait);
    let commands = run(&mut node, at(1_500), &mut Outbox::default());
    let superseded =
        [(at(1_000), notify(0, Directive::Challenge)), (at(1_300), notify(0, Directive::Close(CloseReason::Reset)))];
    assert_eq!(commands, superseded);
    assert_eq!(node.counters.value(NodeCounter::Restarted), 0);
}

#[test]
fn an_index_keeps_meaning_the_same_node_when_another_leaves() {
    let mut node = depot();
    let agvs = [s_unit("agv-1", 31), s_unit("agv-2", 22), s_unit("agv-3", 13)];
    join(&mut node, at(1), 7, &m_unit("other", 1));
    for (link, agv) in (0..).zip(&agvs) {
        join(&mut node, at(2), link, agv);
    }
    let name = |node: &Node<InMemory>, index| node.s_unit(index).unwrap().identity.name().to_string();
    node.left(at(3), LinkId(0), CloseReason::Reset);
    assert_eq!((name(&node, 1), name(&node, 2)), ("agv-2".into(), "agv-3".into()));
    assert!(!node.s_unit(0).unwrap().is_joined());
    join(&mut node, at(4), 4, &s_unit("agv-4", 4));
    assert_eq!(name(&node, 3), "agv-4");
    join(&mut node, at(5), 5, &agvs[0]);
    assert_eq!((name(&node, 0), node.s_unit(0).unwrap().link()), ("agv-1".into(), Some(LinkId(5))));
    let names: Vec<_> = node.s_units().map(|known| known.identity.name()).collect();
    assert_eq!(names, ["agv-1", "agv-2", "agv-3", "agv-4"]);
    assert_eq!(node.m_unit(0).unwrap().identity.name(), "other");
    assert_eq!((node.s_unit(4).is_none(), node.m_unit(1).is_none()), (true, true));
    assert_eq!((node.number_of_s_units(), node.number_of_m_units()), (4, 1));
}

#[test]
fn nodes_are_found_by_name_id_and_address() {
    let mut node = depot();
    join(&mut node, at(1), 0, &s_unit("a", 1));
    join(&mut node, at(1), 1, &s_unit("b", 1));
    join(&mut node, at(1), 2, &m_unit("c", 3));
    assert_eq!(node.find("b").unwrap().link(), Some(LinkId(1)));
    assert_eq!(node.find_id(3).unwrap().identity.name(), "c");
    assert_eq!(node.find_id(1).unwrap().identity.name(), "a");
    node.left(at(2), LinkId(0), CloseReason::Reset);
    assert_eq!(node.find_id(1).unwrap().identity.name(), "b", "connected ones come first");
    assert_eq!(node.find("d").err(), Some(Error::NotConnected));
    assert!(node.find_id(2).is_none());
    let names: Vec<_> = node.find_address(address(1, 9)).map(|known| known.identity.name()).collect();
    assert_eq!(names, ["a", "b"]);
    let gone = node.find("a").unwrap();
    assert_eq!((gone.state(), gone.epoch, gone.limits.is_some()), (NodeState::Away, Epoch(1), true));
}

/// Calling the wrong vehicle is worse than an error: an ambiguous name is refused, even if only one of the nodes is connected.
#[test]
fn a_name_that_several_nodes_have_is_refused() {
    let mut node = depot();
    join(&mut node, at(1), 0, &s_unit("agv", 7));
    assert_eq!(node.find("agv").unwrap().identity.id(), 7);
    join(&mut node, at(1), 1, &s_unit("agv", 8));
    assert_eq!(node.find("agv").err(), Some(Error::Ambiguous { ids: [7, 8] }));
    node.left(at(2), LinkId(0), CloseReason::Reset);
    assert_eq!(node.find("agv").err(), Some(Error::Ambiguous { ids: [7, 8] }));
}

#[test]
fn the_node_that_left_first_is_forgotten_first() {
    let mut node: Node<InMemory> = Node::new(at(0), m_unit(MANAGER, MANAGER_ID), storage(3));
    for (link, name) in (0..).zip(["a", "b", "c"]) {
        join(&mut node, at(1), link, &s_unit(name, 10 - u32::from(link)));
    }
    node.left(at(2), LinkId(1), CloseReason::Reset);
    node.left(at(3), LinkId(0), CloseReason::Reset);
    join(&mut node, at(4), 3, &s_unit("d", 1));
    assert_eq!((node.find("a").is_ok(), node.find("b").is_err()), (true, true));
    assert_eq!(node.s_unit(1).unwrap().identity.name(), "d", "its index is free as well");
    assert_eq!(node.counters.value(NodeCounter::Forgotten), 1);
}
