//! Attackers on the network: they fill tables, suppress searches, or delay a unit.

use super::*;
use crate::config::LONGEST_SEARCH;

fn announce(node: &mut Node<InMemory>, now: Instant, from: u32, announce: &Announce) {
    node.answered(now, address(from, 7_001), announce);
}

#[test]
fn made_up_names_neither_push_out_known_nodes_nor_are_kept() {
    let mut node = depot();
    for link in 0..12 {
        join(&mut node, at(1), link, &s_unit("agv", 100 + u32::from(link)));
    }
    for link in 0..6 {
        node.left(at(2), LinkId(link), CloseReason::Reset);
    }
    for id in 0..2_000 {
        let now = at(3 + u64::from(id));
        let made_up = announce_bytes(&announce_of(&m_unit("made-up", 1_000 + id), 1, 0));
        node.hear(now, address(id + 1, 7_001), &made_up);
        while node.poll(now, &mut Outbox::default(), &Plain).is_some() {}
    }
    assert_eq!((node.s_units().count(), node.nodes().count()), (12, 12), "each keeps its index");
    let real = m_unit("real", 9);
    announce(&mut node, at(20_000), 9, &announce_of(&real, 1, 0));
    assert!(node.node(&real.identity).is_some(), "a real one is heard all the same");
}

#[test]
fn a_few_strangers_are_kept_even_where_there_is_room_for_more() {
    let mut node: Node<InMemory> = Node::new(at(0), m_unit(MANAGER, MANAGER_ID), storage(64));
    for id in 0..100 {
        announce(&mut node, at(1), id + 1, &announce_of(&m_unit("made-up", 1_000 + id), 1, 0));
    }
    let ids: Vec<_> = node.nodes().map(|known| known.identity.id()).collect();
    assert_eq!((ids.len(), ids.iter().min(), ids.iter().max()), (8, Some(&1_092), Some(&1_099)), "the last ones heard");
    assert_eq!(node.counters.value(NodeCounter::Forgotten), 92);
}

#[test]
fn strangers_that_are_being_dialled_leave_no_room_until_they_are_given_up() {
    let mut node: Node<InMemory> = Node::new(at(0), m_unit(MANAGER, MANAGER_ID), storage(64));
    for id in 0..8 {
        announce(&mut node, at(1), id + 1, &announce_of(&m_unit("made-up", 1_000 + id), 1, 0));
    }
    assert_eq!(run(&mut node, at(200), &mut Outbox::default()).len(), 8);
    announce(&mut node, at(201), 9, &announce_of(&m_unit("late", 9), 1, 0));
    assert_eq!((node.nodes().count(), node.counters.value(NodeCounter::TableFull)), (8, 1));
    join(&mut node, at(202), 0, &s_unit("agv", 1));
    assert_eq!(node.nodes().count(), 9, "who joins needs no place among strangers");
    // A node that does not answer is dialled with growing back-off, and may be displaced between two attempts.
    let mut tries = 0;
    while !node.nodes().any(|known| known.identity.name() == "late") {
        tries += 1;
        run(&mut node, at(7_000 + tries * 1_000), &mut Outbox::default());
        announce(&mut node, at(7_000 + tries * 1_000), 9, &announce_of(&m_unit("late", 9), 2, 0));
    }
    assert!(tries <= 10, "{tries} s");
}

#[test]
fn a_thousand_junk_datagrams_change_nothing_but_counters() {
    for config in [m_unit(MANAGER, MANAGER_ID), s_unit("agv", 1)] {
        let mut node = node(config);
        let before = node.next_deadline();
        let mut random = Random::new(3);
        for length in 0..1_000_usize {
            let junk: Vec<u8> = (0..length % 600).map(|_| random.bits() as u8).collect();
            node.hear(at(1), address(9, 9), &junk);
        }
        assert_eq!((node.next_deadline(), node.nodes().count(), node.findings().count()), (before, 0, 0));
        let counted = [NodeCounter::DatagramMagic, NodeCounter::DatagramMalformed].map(|c| node.counters.value(c));
        assert_eq!(counted.iter().sum::<u64>(), 1_000);
    }
}

/// Hints at any manager cause a few questions and nothing else: no dial, no entry in the table, and a delay of the unit's own
/// search by one pause at most.
#[test]
fn hints_lead_to_few_questions_and_delay_nothing() {
    for a_second in [1, 4, 20, 100] {
        for hosts in [1, 2, 1_000_u32] {
            let mut node = node(s_unit("agv", 1));
            let (mut outbox, mut first) = (Outbox::default(), None);
            for count in 0..10 * a_second {
                let depot = NodeConfig { epoch: Epoch(u64::from(count % 2)), ..m_unit(MANAGER, MANAGER_ID) };
                let from = address(2 + count % hosts, 7_001);
                let now = at(u64::from(count * 1_000 / a_second));
                run(&mut node, now, &mut outbox);
                first = first.or_else(|| (!outbox.broadcasts.is_empty()).then_some(now));
                if count % 3 == 0 {
                    node.hear(now, from, &announce_bytes(&announce_of(&depot, count, 0)));
                } else {
                    node.hear(now, from, &who_has_bytes(&search_of(&depot, count)));
                }
            }
            let what = std::format!("{a_second} a second from {hosts}");
            assert_eq!(node.nodes().count(), 0);
            let most = if hosts == 1 { 7 } else { 10 * hosts.min(4) as usize + 4 };
            assert!(outbox.sent.len() <= most, "{what}: {} questions", outbox.sent.len());
            // An attacker with many addresses uses up the budget of searches for some seconds.
            let latest = if hosts <= 2 { at(2_700) } else { at(9_000) };
            assert!(first.is_some_and(|first| first <= latest), "{what}: asks itself at {first:?}");
        }
    }
}

/// The manager may be fenced for now: what its earlier answers led to is no reason to ask it seldom.
#[test]
fn an_address_that_has_answered_is_asked_again_soon() {
    let mut node = node(s_unit("agv", 1));
    let depot = m_unit(MANAGER, MANAGER_ID);
    for count in 1..20 {
        let now = at(u64::from(count) * 1_000);
        let mut outbox = Outbox::default();
        node.hear(now, address(1, 7_001), &who_has_bytes(&search_of(&depot, count)));
        run(&mut node, now + Duration::from_millis(100), &mut outbox);
        assert_eq!(outbox.sent.len(), 1, "{count}");
        node.answered(now, address(1, 7_001), &announce_of(&depot, count, 0));
        assert_eq!(due(&mut node, now).len(), 1, "it dials");
        node.dialing(Some(&depot.identity), LinkId(0));
        node.left(now, LinkId(0), CloseReason::Refused(Refusal::Fenced));
    }
}

/// As many addresses as are asked side by side are told of again and again, and no node answers there.
#[test]
fn addresses_that_do_not_answer_give_way_to_a_new_one() {
    let mut node = node(s_unit("agv", 1));
    let (mut outbox, depot) = (Outbox::default(), m_unit(MANAGER, MANAGER_ID));
    for count in 0..400 {
        let now = at(u64::from(count) * 25);
        run(&mut node, now, &mut outbox);
        node.hear(now, address(2 + count % 4, 7_001), &announce_bytes(&announce_of(&depot, count, 0)));
        if count >= 200 {
            node.hear(now, address(9, 7_001), &announce_bytes(&announce_of(&depot, count, 0)));
        }
    }
    assert!(outbox.sent.iter().any(|(to, _)| *to == address(9, 7_001)), "the new one is never asked");
}

/// How many searches a unit sends within ten minutes if `others` search every `pause`.
fn searches_among(others: &NodeConfig<SocketAddr>, pause: Duration, seed: u64) -> usize {
    let mut node = node(NodeConfig { seed, ..s_unit("agv", 1) });
    let mut outbox = Outbox::default();
    let mut now = at(0);
    let mut sequence = 0;
    while now < at(600_000) {
        sequence += 1;
        node.hear(now, address(9, 7_001), &who_has_bytes(&search_of(others, sequence)));
        now = now + pause;
        run(&mut node, now, &mut outbox);
    }
    outbox.broadcasts.len()
}

#[test]
fn who_asks_all_the_time_silences_nobody_for_good() {
    let same_question = s_unit("shouter", 2);
    let another = NodeConfig { target: Target::Manager(Manager::new("yard", 1).unwrap()), ..s_unit("shouter", 2) };
    for seed in 0..4 {
        let asked = searches_among(&same_question, Duration::from_millis(10), seed);
        assert!((1..=400).contains(&asked), "{asked} while one asks the same all the time");
        let asked = searches_among(&another, Duration::from_millis(50), seed);
        assert!((10..=400).contains(&asked), "{asked} while one uses the budget up");
    }
}

#[test]
fn a_question_waits_two_seconds_at_most_whatever_is_expected() {
    for seed in 0..20 {
        let mut node = node(NodeConfig { seed, ..s_unit("agv", 1) });
        let crowded = Announce { expected: u16::MAX, ..announce_of(&m_unit(MANAGER, MANAGER_ID), 1, 0) };
        node.hear(at(0), address(1, 7_001), &announce_bytes(&crowded));
        let mut outbox = Outbox::default();
        run(&mut node, at(2_000), &mut outbox);
        assert_eq!(outbox.sent.len(), 1);
    }
}

#[test]
fn a_refusal_after_the_hello_keeps_the_unit_from_dialling_that_life_for_long() {
    let depot = m_unit(MANAGER, MANAGER_ID);
    let refused = |refusal| {
        let mut node = node(s_unit("agv", 1));
        dial_manager(&mut node, at(1), 1);
        node.dialing(Some(&depot.identity), LinkId(0));
        join(&mut node, at(300), 0, &depot);
        node.left(at(301), LinkId(0), CloseReason::Refused(refusal));
        node
    };
    for refusal in [Refusal::DuplicateIdentity, Refusal::WrongManager, Refusal::Role] {
        let mut node = refused(refusal);
        announce(&mut node, at(400), 1, &announce_of(&depot, 2, 0));
        assert_eq!(run(&mut node, at(301) + LONGEST_SEARCH - Duration::from_millis(1), &mut Outbox::default()), []);
        let dials = run(&mut node, at(20_000), &mut Outbox::default());
        assert!(!dials.is_empty(), "but it does not give up");

        let mut node = refused(refusal);
        let restarted = NodeConfig { epoch: Epoch(200), ..depot.clone() };
        announce(&mut node, at(400), 1, &announce_of(&restarted, 1, 0));
        assert_eq!(run(&mut node, at(1_000), &mut Outbox::default()).len(), 1, "another life may think otherwise");
    }
    let mut node = refused(Refusal::Full);
    assert!(node.next_deadline() < at(301) + LONGEST_SEARCH);
    announce(&mut node, at(400), 1, &announce_of(&depot, 2, 0));
    assert_eq!(run(&mut node, at(1_000), &mut Outbox::default()).len(), 1, "there is room now");
}

#[test]
fn links_that_never_joined_start_no_search() {
    let mut with_peers = depot();
    join(&mut with_peers, at(1), 0, &s_unit("agv", 1));
    run(&mut with_peers, at(60_000), &mut Outbox::default());
    let mut joined = node(s_unit("agv", 1));
    join(&mut joined, at(1), 0, &m_unit(MANAGER, MANAGER_ID));
    run(&mut joined, at(60_000), &mut Outbox::default());
    for mut node in [with_peers, joined] {
        assert_eq!(node.next_deadline(), Instant::FAR_FUTURE);
        for reason in [CloseReason::Refused(Refusal::Full), CloseReason::HelloTimeout, CloseReason::Reset] {
            node.left(at(60_001), LinkId(7), reason);
        }
        assert_eq!(node.next_deadline(), Instant::FAR_FUTURE);
    }
}
