//! Searching, answering, dialling, and trying again.

use super::*;
use crate::config::{FIRST_SEARCH, LONGEST_SEARCH, SEARCH_BUDGET, SEARCH_WINDOW};
use crate::distribution::authenticator::{Authenticator, CODE_BYTES};
use crate::distribution::datagram::{Datagram, short_hash};

const SOON: u64 = 400;

/// The times at which a node broadcasts up to `end`.
fn search_times(node: &mut Node<InMemory>, end: Instant) -> Vec<Instant> {
    let mut times = Vec::new();
    while node.next_deadline() <= end {
        let now = node.next_deadline();
        let mut outbox = Outbox::default();
        assert_eq!(node.poll(now, &mut outbox, &Plain), None);
        times.extend(outbox.broadcasts.iter().map(|_| now));
    }
    times
}

#[test]
fn an_s_unit_asks_for_its_manager_soon_and_then_more_and_more_seldom() {
    for seed in 0..50 {
        let mut node = node(NodeConfig { seed, ..s_unit("agv", 1) });
        let mut outbox = Outbox::default();
        run(&mut node, at(SOON), &mut outbox);
        let who_has = as_who_has(&outbox.broadcasts[0]);
        assert_eq!((who_has.wanted, who_has.identity.name()), (Some(manager()), "agv"));
        let mut last = at(SOON);
        let times = search_times(&mut node, at(120_000));
        let mut pause = FIRST_SEARCH;
        for time in times {
            let waited = time.since(last);
            let earliest = if last == at(SOON) { pause - Duration::from_millis(SOON) } else { pause };
            assert!(waited >= earliest && waited <= pause.times(2), "{waited:?} for {pause:?}, seed {seed}");
            (last, pause) = (time, pause.times(2).min(LONGEST_SEARCH));
        }
        assert!(last > at(100_000), "it never gives up");
    }
}

#[test]
fn an_m_unit_asks_a_few_times_and_goes_on_only_while_it_is_alone() {
    let mut alone = depot();
    assert!(search_times(&mut alone, at(100_000)).len() > 8);
    let mut joined = depot();
    join(&mut joined, at(0), 0, &s_unit("agv", 1));
    assert_eq!(search_times(&mut joined, at(100_000)).len(), 4);
    joined.left(at(100_000), LinkId(0), CloseReason::Reset);
    assert!(search_times(&mut joined, at(101_000)).len() > 1, "it is alone again");
}

/// An s_unit that was cut off searches seldom by the time that it can be reached again.
#[test]
fn an_m_unit_that_misses_an_s_unit_searches_until_it_is_back_or_for_a_minute() {
    let agvs = [s_unit("agv", 1), s_unit("agv", 2)];
    let lost = |reason| {
        let mut node = depot();
        for (link, agv) in agvs.iter().enumerate() {
            join(&mut node, at(1), link as u16, agv);
        }
        search_times(&mut node, at(100_000));
        node.left(at(100_000), LinkId(0), reason);
        node
    };
    assert_eq!(search_times(&mut lost(CloseReason::Stopped), at(300_000)), []);
    let mut node = lost(CloseReason::Silent);
    let searches = search_times(&mut node, at(110_000));
    let pauses = searches.windows(2).map(|pair| pair[1].since(pair[0]));
    assert!(searches[0] < at(100_300) && pauses.max() <= Some(Duration::from_secs(2)), "{searches:?}");
    join(&mut node, at(110_000), 2, &agvs[0]);
    assert_eq!(search_times(&mut node, at(200_000)), []);
    let mut node = lost(CloseReason::Silent);
    assert_eq!(search_times(&mut node, at(900_000)).len(), usize::from(search::MISSING_SEARCHES));
    // One that nobody missed says nothing about the one that is missing.
    join(&mut node, at(900_000), 2, &s_unit("agv", 3));
    assert_eq!(search_times(&mut node, at(999_000)), []);
}

/// A manager with no spare keys, all of whose vehicles were there.
#[test]
fn a_manager_of_a_whole_fleet_searches_for_the_first_that_is_lost() {
    let agvs = [s_unit("agv", 1), s_unit("agv", 2)];
    let whole = || {
        let mut node = depot();
        node.expect(2);
        for (link, agv) in agvs.iter().enumerate() {
            join(&mut node, at(1), link as u16, agv);
        }
        node
    };
    // Also while the last of its first searches is planned, after a longer pause than one that misses a node makes.
    for millis in [300, 1_000, 3_000, 100_000] {
        let mut node = whole();
        search_times(&mut node, at(millis));
        node.left(at(millis), LinkId(0), CloseReason::Silent);
        let searches = search_times(&mut node, at(millis + 300_000));
        let pauses = searches.windows(2).map(|pair| pair[1].since(pair[0]));
        assert!(searches[0] <= at(millis + 1_000), "{millis} {searches:?}");
        assert!(pauses.max() <= Some(Duration::from_secs(2)), "{millis} {searches:?}");
        assert!((28..=30).contains(&searches.len()), "{millis} {searches:?}");
    }
    // One that is lost towards the end of the search for another one is searched for as long.
    let mut node = whole();
    node.left(at(100_000), LinkId(0), CloseReason::Silent);
    search_times(&mut node, at(130_000));
    node.left(at(130_000), LinkId(1), CloseReason::Silent);
    join(&mut node, at(130_100), 2, &agvs[1]);
    assert!(search_times(&mut node, at(300_000)).len() >= 28);
}

#[test]
fn a_full_manager_searches_when_a_place_is_free_and_not_before() {
    let excess = s_unit("agv", 3);
    let full = || {
        let mut node = depot();
        node.expect(3);
        node.set_maximum_nodes(2);
        join(&mut node, at(1), 0, &s_unit("agv", 1));
        join(&mut node, at(1), 1, &s_unit("agv", 2));
        assert!(search_times(&mut node, at(30_000)).len() <= 4);
        assert_eq!(search_times(&mut node, at(100_000)), []);
        let refused = node.admit(at(100_000), LinkId(2), address(3, 40_000), &hello_of(&excess));
        assert_eq!(refused, Admission::Refuse(Refusal::Full));
        node
    };
    for reason in [CloseReason::Stopped, CloseReason::Silent, CloseReason::Reset] {
        let mut node = full();
        node.left(at(100_000), LinkId(0), reason);
        assert!(search_times(&mut node, at(101_000)).first().is_some_and(|first| *first <= at(100_300)), "{reason}");
        join(&mut node, at(101_000), 2, &excess);
        // Of the first four, which look for managers as well, those that are left.
        assert!(search_times(&mut node, at(200_000)).len() < 4, "it is full again");
    }
    // Also a higher maximum makes places free.
    let mut node = full();
    node.set_constraints(Constraints { maximum_nodes: 3, ..Constraints::M_UNIT });
    assert!(search_times(&mut node, at(101_000)).len() > 1);
}

/// Its search has ended by the time that the network is back.
#[test]
fn after_a_long_outage_the_first_that_is_back_makes_a_manager_search_for_the_others() {
    let agvs = [s_unit("agv", 1), s_unit("agv", 2), s_unit("agv", 3)];
    for stays in [0, 1] {
        let mut node = depot();
        for (link, agv) in agvs.iter().enumerate() {
            join(&mut node, at(1), link as u16, agv);
        }
        search_times(&mut node, at(100_000));
        for link in stays..3 {
            node.left(at(100_000), LinkId(link), CloseReason::Silent);
        }
        search_times(&mut node, at(900_000));
        join(&mut node, at(900_000), 3, &agvs[1]);
        let searches = search_times(&mut node, at(920_000));
        let pauses = searches.windows(2).map(|pair| pair[1].since(pair[0]));
        assert!(searches.first().is_some_and(|first| *first <= at(900_300)), "{stays} {searches:?}");
        assert!(pauses.max() <= Some(Duration::from_secs(2)), "{stays} {searches:?}");
        join(&mut node, at(920_000), 4, &agvs[2]);
        if stays == 0 {
            join(&mut node, at(920_000), 5, &agvs[0]);
        }
        assert_eq!(search_times(&mut node, at(999_000)), []);
    }
}

#[test]
fn a_broadcast_that_is_asked_for_goes_out_at_once_or_when_the_budget_allows() {
    let mut node = depot();
    let mut outbox = Outbox::default();
    for _ in 0..SEARCH_BUDGET {
        node.broadcast(at(100));
        node.poll(at(100), &mut outbox, &Plain);
    }
    assert_eq!(outbox.broadcasts.len(), usize::from(SEARCH_BUDGET));
    node.broadcast(at(101));
    node.broadcast(at(102));
    let times = search_times(&mut node, at(100) + SEARCH_WINDOW);
    assert_eq!(times, [at(100) + SEARCH_WINDOW], "two requests make one search, on time");
}

#[test]
fn searches_of_others_count_against_the_budget() {
    let mut node = depot();
    for host in 1..=u32::from(SEARCH_BUDGET) {
        let bytes = who_has_bytes(&search_of(
            &NodeConfig { target: Target::Manager(Manager::new("yard", 1).unwrap()), ..s_unit("agv", host) },
            1,
        ));
        node.hear(at(0), address(host, 7_001), &bytes);
    }
    let times = search_times(&mut node, at(4_000));
    assert!(times[0] >= at(0) + SEARCH_WINDOW, "{times:?}");
    assert_eq!(node.counters.value(NodeCounter::WhoHasDeferred), 1);
    assert_eq!(node.counters.value(NodeCounter::WrongManager), 4);
}

#[test]
fn an_s_unit_holds_back_while_another_asks_the_same() {
    for seed in 0..50 {
        let mut node = node(NodeConfig { seed, ..s_unit("agv", 1) });
        let bytes = who_has_bytes(&search_of(&s_unit("agv", 2), 1));
        node.hear(at(0), address(2, 7_001), &bytes);
        node.hear(at(2), address(3, 7_001), &who_has_bytes(&search_of(&s_unit("agv", 3), 1)));
        let first = search_times(&mut node, at(2_000))[0];
        let earliest = at(0) + FIRST_SEARCH;
        assert!(first >= earliest && first <= at(2) + FIRST_SEARCH.times(2), "{first:?}");
    }
}

#[test]
fn the_first_seeker_is_answered_alone_and_the_second_with_all_others() {
    let mut node = depot();
    let mut outbox = Outbox::default();
    run(&mut node, at(40_000), &mut Outbox::default());
    let ask = |node: &mut Node<InMemory>, millis, host| {
        node.hear(at(millis), address(host, 7_001), &who_has_bytes(&search_of(&s_unit("agv", host), 1)));
    };
    ask(&mut node, 40_001, 1);
    ask(&mut node, 40_002, 1);
    let mut before = Outbox::default();
    while node.next_deadline() <= at(40_030) {
        node.poll(node.next_deadline(), &mut before, &Plain);
    }
    assert_eq!((before.sent.len(), before.broadcasts.len()), (1, 0));
    let (to, bytes) = &before.sent[0];
    let announce = as_announce(bytes);
    assert_eq!((*to, announce.nonce, announce.tcp_port), (address(1, 7_001), 77, 7_000));

    ask(&mut node, 40_200, 2);
    ask(&mut node, 40_201, 3);
    run(&mut node, at(40_300), &mut outbox);
    let announces: Vec<_> = outbox.broadcasts.iter().map(|bytes| as_announce(bytes)).collect();
    assert_eq!(announces.iter().map(|announce| announce.nonce).collect::<Vec<_>>(), [0]);
    assert!(announces[0].sequence > announce.sequence);
}

#[test]
fn an_answer_to_this_units_question_is_dialled_at_once_and_to_another_never() {
    let mut node = node(s_unit("agv", 1));
    let mut outbox = Outbox::default();
    run(&mut node, at(SOON), &mut outbox);
    let nonce = as_who_has(&outbox.broadcasts[0]).nonce;
    let depot = m_unit(MANAGER, MANAGER_ID);
    node.hear(at(60), address(1, 7_001), &announce_bytes(&announce_of(&depot, 1, nonce ^ 2)));
    assert_eq!(node.counters.value(NodeCounter::Unasked), 1);
    assert_eq!(node.poll(at(60), &mut outbox, &Plain), None);
    node.hear(at(61), address(1, 7_001), &announce_bytes(&announce_of(&depot, 1, nonce)));
    let dial = Command::Dial { to: address(1, 7_000), identity: Some(depot.identity) };
    assert_eq!(node.poll(at(61), &mut outbox, &Plain), Some(dial));
}

#[test]
fn the_wrong_manager_is_ignored() {
    let mut node = node(s_unit("agv", 1));
    for wrong in [m_unit(MANAGER, 6), m_unit("yard", MANAGER_ID), s_unit(MANAGER, MANAGER_ID)] {
        node.hear(at(1), address(9, 7_001), &announce_bytes(&announce_of(&wrong, 1, 0)));
        let asks = WhoHas { wanted: None, ..search_of(&wrong, 2) };
        node.hear(at(1), address(9, 7_001), &who_has_bytes(&asks));
    }
    assert_eq!(run(&mut node, at(500), &mut Outbox::default()), []);
    assert_eq!(node.counters.value(NodeCounter::WrongManager), 6);
    assert_eq!(node.nodes().count(), 0);
}

#[test]
fn own_s_units_ask_a_manager_that_broadcasts_and_dial_it_when_it_answers() {
    let config = s_unit("agv", 1);
    let mut ask = search_of(&m_unit(MANAGER, MANAGER_ID), 1);
    ask.expected = 500;
    let questions = |known: &[u32]| {
        let mut node = node(config.clone());
        node.search.next = at(3_000);
        let who_has = WhoHas { known: known.iter().copied().collect(), ..ask.clone() };
        node.hear(at(0), address(1, 7_001), &who_has_bytes(&who_has));
        let mut outbox = Outbox::default();
        assert_eq!(run(&mut node, at(500), &mut outbox), [], "a broadcast alone is no reason to dial");
        assert!(outbox.broadcasts.is_empty());
        (node, outbox.sent)
    };
    let (mut node, sent) = questions(&[]);
    let [(to, bytes)] = &sent[..] else { panic!("{sent:?}") };
    let question = as_who_has(bytes);
    assert_eq!((*to, question.wanted, question.expected), (address(1, 7_001), Some(manager()), 0));
    assert_eq!(question.nonce, node.search.nonce);
    node.answered(at(500), address(1, 7_001), &announce_of(&m_unit(MANAGER, MANAGER_ID), 2, 0));
    assert!(matches!(run(&mut node, at(501), &mut Outbox::default())[..], [(_, Command::Dial { .. })]));
    assert!(questions(&[1, short_hash(&config.identity)]).1.is_empty());
}

#[test]
fn who_is_asked_alone_answers_at_once_and_alone() {
    let mut node = depot();
    run(&mut node, at(40_000), &mut Outbox::default());
    for host in 1..4 {
        let ask = WhoHas { expected: 0, ..search_of(&s_unit("agv", host), 1) };
        node.hear(at(40_001), address(host, 7_001), &who_has_bytes(&ask));
    }
    let mut outbox = Outbox::default();
    node.poll(at(40_001), &mut outbox, &Plain);
    assert_eq!((outbox.sent.len(), outbox.broadcasts.len()), (3, 0));
    run(&mut node, at(42_000), &mut outbox);
    assert!(outbox.broadcasts.is_empty(), "nobody else holds back for them");
}

/// A dial that says nothing does not keep another address of the same node waiting, and what fails there ends neither.
#[test]
fn two_addresses_that_have_answered_are_dialled_side_by_side() {
    let mut node = node(s_unit("agv", 1));
    let depot = m_unit(MANAGER, MANAGER_ID);
    let mut outbox = Outbox::default();
    node.answered(at(1), address(9, 7_001), &announce_of(&depot, 1, 0));
    assert_eq!(run(&mut node, at(1), &mut outbox).len(), 1);
    node.dialing(Some(&depot.identity), LinkId(0));
    node.answered(at(2), address(1, 7_001), &announce_of(&depot, 2, 0));
    let actions = run(&mut node, at(1_000), &mut outbox);
    let Some((when, Command::Dial { to, .. })) = actions.first() else { panic!("{actions:?}") };
    assert!(*to == address(1, 7_000) && *when <= at(400) && actions.len() == 1, "{actions:?}");
    // There may be no room for another link: the first one goes on.
    node.dial_failed(at(1_000), Some(&depot.identity));
    assert_eq!(node.node(&depot.identity).map(Known::state), Some(NodeState::Dialing));
    node.dialing(Some(&depot.identity), LinkId(1));
    node.left(at(2_001), LinkId(0), CloseReason::HelloTimeout);
    join(&mut node, at(2_002), 1, &depot);
    assert_eq!(node.node(&depot.identity).map(Known::link), Some(Some(LinkId(1))));
}

#[test]
fn of_two_m_units_the_smaller_dials_and_the_larger_answers() {
    let (small, large) = (m_unit("a", 1), m_unit("b", 1));
    let mut of_small = node(small.clone());
    of_small.hear(at(0), address(2, 7_001), &who_has_bytes(&search_of(&large, 1)));
    let mut outbox = Outbox::default();
    assert_eq!(run(&mut of_small, at(100), &mut outbox), []);
    let [(to, bytes)] = &outbox.sent[..] else { panic!("{:?}", outbox.sent) };
    assert_eq!(*to, address(2, 7_001));

    let mut of_large = node(large.clone());
    of_large.hear(at(100), address(1, 7_001), bytes);
    of_large.hear(at(100), address(1, 7_001), &who_has_bytes(&search_of(&small, 1)));
    let mut outbox = Outbox::default();
    assert_eq!(run(&mut of_large, at(200), &mut outbox), []);
    assert_eq!(outbox.sent.iter().map(|(to, _)| *to).collect::<Vec<_>>(), [address(1, 7_001); 2]);
    assert_eq!(as_announce(&outbox.sent[1].1).nonce, 77, "the answer to the broadcast");
    of_small.hear(at(200), address(2, 7_001), &outbox.sent[0].1);
    let dial = Command::Dial { to: address(2, 7_000), identity: Some(large.identity) };
    assert_eq!(run(&mut of_small, at(200), &mut Outbox::default()), [(at(200), dial)]);
}

/// Each node that is expected costs the others a millisecond.
#[test]
fn a_manager_expects_no_more_nodes_than_it_knows_of() {
    let expected = |node: &mut Node<InMemory>| {
        let mut outbox = Outbox::default();
        run(node, at(100), &mut outbox);
        as_who_has(&outbox.broadcasts[0]).expected
    };
    assert_eq!(expected(&mut depot()), Constraints::M_UNIT.maximum_nodes);
    for (known, reported) in [(0, 1), (3, 3), (u16::MAX, Constraints::M_UNIT.maximum_nodes)] {
        let mut node = depot();
        node.expect(known);
        assert_eq!(expected(&mut node), reported);
    }
}

/// `m` has chosen `z`, and hears of `z` and of two others, of which it would dial one and be dialled by the other.
#[test]
fn an_m_unit_that_has_chosen_others_meets_those_alone() {
    let own = m_unit("m", 1);
    let [chosen, larger, smaller] = ["z", "x", "b"].map(|name| m_unit(name, 1));
    let mut node = node(own.clone());
    node.choose(Box::new([chosen.identity.clone()]));
    let question = |config: &NodeConfig<SocketAddr>| who_has_bytes(&search_of(config, 1));
    let asks = |config: &NodeConfig<SocketAddr>| {
        let wanted = Some(Manager::new("m", 1).unwrap());
        who_has_bytes(&WhoHas { wanted, expected: 0, ..search_of(config, 2) })
    };
    for other in [&larger, &smaller] {
        node.hear(at(0), address(2, 7_001), &question(other));
        node.hear(at(0), address(2, 7_001), &asks(other));
        node.hear(at(0), address(2, 7_001), &announce_bytes(&announce_of(other, 3, 0)));
    }
    let mut outbox = Outbox::default();
    assert_eq!(run(&mut node, at(200), &mut outbox), []);
    assert_eq!((&outbox.sent[..], node.counters.value(NodeCounter::WrongManager)), (&[][..], 6));
    node.hear(at(200), address(3, 7_001), &question(&chosen));
    node.hear(at(200), address(3, 7_001), &asks(&s_unit("agv", 1)));
    assert_eq!(run(&mut node, at(2_000), &mut outbox), []);
    assert_eq!(outbox.sent.len(), 2, "one question to the chosen one, and the answer to its own s_unit");
    let admitted = |node: &mut Node<InMemory>, config: &NodeConfig<SocketAddr>, link| {
        let hello = Hello {
            wanted: config.identity.name().eq("agv").then(|| Manager::new("m", 1).unwrap()),
            ..hello_of(config)
        };
        node.admit(at(2_000), LinkId(link), address(9, 40_000), &hello)
    };
    assert_eq!(admitted(&mut node, &larger, 1), Admission::Refuse(Refusal::WrongManager));
    assert_eq!(admitted(&mut node, &chosen, 2), Admission::Accept);
    assert_eq!(admitted(&mut node, &s_unit("agv", 1), 3), Admission::Accept);
    assert_eq!(node.findings().count(), 1, "others that are about are no finding");
}

#[test]
fn own_datagrams_are_ignored_and_a_double_is_told() {
    let mut node = depot();
    let own = m_unit(MANAGER, MANAGER_ID);
    node.hear(at(0), address(1, 7_001), &who_has_bytes(&search_of(&own, 1)));
    assert_eq!((node.counters.value(NodeCounter::OwnIdentity), node.findings().count()), (0, 0));
    let double = NodeConfig { epoch: Epoch(3), ..own };
    node.hear(at(0), address(2, 7_001), &who_has_bytes(&search_of(&double, 1)));
    assert_eq!(node.counters.value(NodeCounter::OwnIdentity), 1);
    assert_eq!(node.findings().next().map(|finding| finding.refusal), Some(Refusal::DuplicateIdentity));
    // It is told once, and the double is answered, since it would hear nothing otherwise, and asked in turn.
    assert_eq!((node.take_duplicate(), node.take_duplicate()), (Some(address(2, 7_001)), None));
    let mut outbox = Outbox::default();
    run(&mut node, at(1), &mut outbox);
    assert_eq!(outbox.sent.iter().map(|(to, _)| *to).collect::<Vec<_>>(), [address(2, 7_001); 2]);
    node.hear(at(2), address(2, 7_001), &who_has_bytes(&search_of(&double, 2)));
    assert_eq!(node.take_duplicate(), None);
    let announce = as_announce(&outbox.sent[0].1);
    let mut other = super::node(double);
    other.hear(at(3), address(1, 7_001), &announce_bytes(&announce));
    assert_eq!(other.take_duplicate(), Some(address(1, 7_001)));
}

/// A node that claims one boot after the other does not fill the application's log.
#[test]
fn doubles_are_told_now_and_then_only() {
    let mut node = depot();
    let own = m_unit(MANAGER, MANAGER_ID);
    let mut reported = 0;
    for life in 0..1_000 {
        let double = NodeConfig { epoch: Epoch(1_000 + life), ..own.clone() };
        node.hear(at(life * 20), address(2, 7_001), &who_has_bytes(&search_of(&double, 1)));
        reported += u32::from(node.take_duplicate().is_some());
    }
    assert_eq!(reported, 3, "in 20 s");
}

#[test]
fn a_network_that_comes_back_is_searched_soon() {
    let mut node = node(s_unit("agv", 1));
    let mut outbox = Outbox::default();
    run(&mut node, at(60_000), &mut outbox);
    let before = outbox.broadcasts.len();
    assert!(node.next_deadline() > at(61_000), "pauses have grown");
    node.network_changed(at(60_000));
    run(&mut node, at(60_400), &mut outbox);
    assert_eq!(outbox.broadcasts.len(), before + 1);
}

#[test]
fn an_s_unit_that_loses_its_manager_searches_again() {
    let mut node = node(s_unit("agv", 1));
    assert_eq!(dial_manager(&mut node, at(1), 1), address(1, 7_000));
    let depot = m_unit(MANAGER, MANAGER_ID);
    node.dialing(Some(&depot.identity), LinkId(0));
    join(&mut node, at(300), 0, &depot);
    assert_eq!(run(&mut node, at(1_000), &mut Outbox::default()), []);
    assert_eq!((node.number_of_m_units(), node.next_deadline()), (1, Instant::FAR_FUTURE));
    node.left(at(10_000), LinkId(0), CloseReason::Silent);
    let times = search_times(&mut node, at(12_000));
    assert!(times[0] <= at(10_000 + 2 * SOON), "{times:?}");
    assert_eq!(dial_manager(&mut node, at(12_001), 2), address(1, 7_000));
}

#[test]
fn what_fails_at_once_is_not_tried_again_at_once() {
    let mut node = node(s_unit("agv", 1));
    let depot = m_unit(MANAGER, MANAGER_ID);
    let mut now = at(1);
    let mut pauses = Vec::new();
    for sequence in 1..=6 {
        dial_manager(&mut node, now, sequence);
        now = now + Duration::from_millis(200);
        node.dialing(Some(&depot.identity), LinkId(0));
        join(&mut node, now, 0, &depot);
        now = now + Duration::from_millis(1);
        node.left(now, LinkId(0), CloseReason::Protocol);
        pauses.push(node.next_deadline().since(now));
        now = node.next_deadline();
    }
    assert!(pauses[5] >= LONGEST_SEARCH.divided_by(2), "{pauses:?}");
}

#[test]
fn a_dial_that_fails_or_is_never_heard_of_again_is_tried_again() {
    let mut node = node(s_unit("agv", 1));
    let depot = m_unit(MANAGER, MANAGER_ID);
    dial_manager(&mut node, at(1), 1);
    node.dial_failed(at(300), Some(&depot.identity));
    assert!(!search_times(&mut node, at(2_000)).is_empty());
    dial_manager(&mut node, at(2_001), 2);
    node.dialing(Some(&depot.identity), LinkId(3));
    node.left(at(2_300), LinkId(3), CloseReason::DialFailed);
    assert!(!search_times(&mut node, at(10_000)).is_empty());
    // The port forgets to say anything.
    dial_manager(&mut node, at(10_001), 3);
    assert!(!search_times(&mut node, at(40_000)).is_empty());
    assert_eq!(node.counters.value(NodeCounter::DialFailed), 3);
}

#[test]
fn a_refusal_that_only_people_can_remove_is_asked_about_seldom() {
    let wait = |refusal| {
        let mut node = node(s_unit("agv", 1));
        dial_manager(&mut node, at(1), 1);
        node.dialing(Some(&m_unit(MANAGER, MANAGER_ID).identity), LinkId(3));
        node.left(at(300), LinkId(3), CloseReason::Refused(refusal));
        assert!(node.findings().any(|finding| finding.refusal == refusal));
        node.next_deadline().since(at(300))
    };
    assert!(wait(Refusal::WrongManager) >= LONGEST_SEARCH);
    assert!(wait(Refusal::Full) < LONGEST_SEARCH);
}

#[test]
fn the_smaller_m_unit_dials_again_and_again() {
    let mut node = node(m_unit("a", 1));
    let peer = m_unit("b", 2);
    node.answered(at(0), address(2, 7_001), &announce_of(&peer, 1, 0));
    let mut now = at(100);
    let mut pauses = Vec::new();
    run(&mut node, now, &mut Outbox::default());
    node.dialing(Some(&peer.identity), LinkId(0));
    assert_eq!(node.admit(now, LinkId(0), address(2, 7_000), &hello_of(&peer)), Admission::Accept);
    node.left(now + Duration::from_secs(5), LinkId(0), CloseReason::Silent);
    let mut last = now + Duration::from_secs(5);
    while pauses.len() < 8 {
        now = node.next_deadline();
        if let Some(Command::Dial { to, .. }) = node.poll(now, &mut Outbox::default(), &Plain) {
            assert_eq!(to, address(2, 7_000));
            pauses.push(now.since(last));
            last = now;
            node.dial_failed(now, Some(&peer.identity));
        }
    }
    assert!(pauses[0] <= FIRST_SEARCH.times(2) && pauses[7] >= LONGEST_SEARCH, "{pauses:?}");
}

#[test]
fn a_fixed_address_is_dialled_without_any_broadcast() {
    let to = address(8, 7_000);
    let mut node = node(NodeConfig { target: Target::Fixed(manager(), to), ..s_unit("agv", 1) });
    let mut outbox = Outbox::default();
    let mut dials = 0;
    while dials < 5 {
        let now = node.next_deadline();
        if let Some(action) = node.poll(now, &mut outbox, &Plain) {
            assert_eq!(action, Command::Dial { to, identity: Some(m_unit(MANAGER, MANAGER_ID).identity) });
            node.dialing(Some(&m_unit(MANAGER, MANAGER_ID).identity), LinkId(0));
            node.left(now + Duration::from_secs(1), LinkId(0), CloseReason::DialFailed);
            dials += 1;
        }
    }
    // What is heard of the manager elsewhere does not change the address.
    node.hear(at(100), address(1, 7_001), &announce_bytes(&announce_of(&m_unit(MANAGER, MANAGER_ID), 1, 0)));
    node.broadcast(at(101));
    let action = run(&mut node, at(101), &mut outbox).pop().map(|(_, action)| action);
    assert!(matches!(action, Some(Command::Dial { to: found, .. }) if found == to), "{action:?}");
    assert!(outbox.broadcasts.is_empty());
}

/// Units that search for nothing.
enum Placed {}

impl Port for Placed {
    type Storage = crate::storage::Boxed;
    type Cipher = Plain;
    type Endpoint = SocketAddr;
    const DISCOVERS: bool = false;
}

#[test]
fn where_nothing_is_discovered_the_address_is_dialled_and_nobody_is_heard() {
    let (to, depot) = (address(8, 7_000), m_unit(MANAGER, MANAGER_ID));
    let config = NodeConfig { target: Target::Fixed(manager(), to), ..s_unit("agv", 1) };
    let mut node: Node<Placed> = Node::new(Instant::START, config, storage(2));
    let mut outbox = Outbox::default();
    let mut dials = 0;
    while dials < 5 {
        let now = node.next_deadline();
        if let Some(action) = node.poll(now, &mut outbox, &Plain) {
            assert_eq!(action, Command::Dial { to, identity: Some(depot.identity.clone()) });
            node.dialing(Some(&depot.identity), LinkId(0));
            let seeker = search_of(&s_unit("agv", 2), 1);
            for heard in [announce_bytes(&announce_of(&depot, 1, 0)), who_has_bytes(&seeker)] {
                node.datagram(now, address(1, 7_001), &heard, &Plain);
            }
            node.left(now + Duration::from_secs(1), LinkId(0), CloseReason::DialFailed);
            dials += 1;
        }
    }
    assert_eq!(node.counters.value(NodeCounter::DatagramNotForUs), 10);
    assert_eq!((outbox.broadcasts.len(), outbox.sent.len()), (0, 0));
}

#[test]
fn a_full_managers_broadcast_is_no_invitation() {
    let mut node = node(s_unit("agv", 1));
    let full = Announce { room: 0, expected: 0, ..announce_of(&m_unit(MANAGER, MANAGER_ID), 1, 0) };
    node.hear(at(0), address(1, 7_001), &announce_bytes(&full));
    assert_eq!(run(&mut node, at(400), &mut Outbox::default()), []);
    assert_eq!(node.findings().next().map(|finding| finding.refusal), Some(Refusal::Full));
}

#[test]
fn a_hello_that_is_quicker_than_the_ports_note_counts() {
    let mut node = node(s_unit("agv", 1));
    let depot = m_unit(MANAGER, MANAGER_ID);
    dial_manager(&mut node, at(1), 1);
    join(&mut node, at(300), 0, &depot);
    node.dialing(Some(&depot.identity), LinkId(0));
    assert_eq!(run(&mut node, at(60_000), &mut Outbox::default()), []);
    assert_eq!(node.node(&depot.identity).map(Known::link), Some(Some(LinkId(0))));
}

#[test]
fn a_manager_that_has_moved_is_asked_for_soon_however_long_it_was_away() {
    for seed in 0..20 {
        let mut node = node(NodeConfig { seed, ..s_unit("agv", 1) });
        search_times(&mut node, at(100_000));
        dial_manager(&mut node, at(100_000), 1);
        node.dialing(Some(&m_unit(MANAGER, MANAGER_ID).identity), LinkId(0));
        node.left(at(100_300), LinkId(0), CloseReason::DialFailed);
        let next = node.next_deadline();
        assert!(next <= at(100_300) + FIRST_SEARCH.times(2), "{next:?}");
        // One that cannot be reached although it answers is not asked for that often.
        let mut sequence = 1;
        let mut pause = Duration::ZERO;
        for _ in 0..8 {
            let now = node.next_deadline();
            sequence += 1;
            dial_manager(&mut node, now, sequence);
            node.dialing(Some(&m_unit(MANAGER, MANAGER_ID).identity), LinkId(0));
            let ended = now + Duration::from_secs(1);
            node.left(ended, LinkId(0), CloseReason::DialFailed);
            pause = node.next_deadline().since(ended);
        }
        assert!(pause >= LONGEST_SEARCH, "{pause:?}");
    }
}

#[test]
fn an_m_unit_that_cannot_reach_a_peer_any_more_asks_where_it_is() {
    // With as many nodes as it knows of it has nothing planned when it loses one.
    for known_nodes in [u16::MAX, 2] {
        asks_where_its_peer_is(known_nodes);
    }
}

fn asks_where_its_peer_is(known_nodes: u16) {
    let mut node = node(m_unit("a", 1));
    node.expect(known_nodes);
    let peer = m_unit("b", 2);
    join(
        &mut node,
        at(0),
        1,
        &NodeConfig { target: Target::Manager(Manager::new("a", 1).unwrap()), ..s_unit("agv", 1) },
    );
    node.answered(at(0), address(2, 7_001), &announce_of(&peer, 1, 0));
    // Its first searches are over before it loses the peer.
    run(&mut node, at(100), &mut Outbox::default());
    join(&mut node, at(100), 0, &peer);
    run(&mut node, at(60_000), &mut Outbox::default());
    node.left(at(60_000), LinkId(0), CloseReason::Silent);
    let mut searches = Vec::new();
    while node.next_deadline() < at(200_000) {
        let now = node.next_deadline();
        let mut outbox = Outbox::default();
        if let Some(Command::Dial { identity, .. }) = node.poll(now, &mut outbox, &Plain) {
            node.dial_failed(now, identity.as_ref());
        }
        searches.extend(outbox.broadcasts.iter().map(|_| now));
    }
    let count = if known_nodes == 2 { usize::from(search::MISSING_SEARCHES) } else { 4 };
    assert_eq!(searches.len(), count, "{searches:?}");
    let moved = announce_of(&peer, 2, node.search.nonce);
    node.hear(at(200_000), address(3, 7_001), &announce_bytes(&moved));
    let actions = run(&mut node, at(200_001), &mut Outbox::default());
    assert!(matches!(actions[..], [(_, Command::Dial { to, .. })] if to == address(3, 7_000)), "{actions:?}");
}

/// Secured mode with the fleet's code alone: there is no key of any pair.
struct FleetOnly;

impl Authenticator for FleetOnly {
    fn mode(&self) -> Mode {
        Mode::Secured
    }

    fn sign_for_fleet(&self, _: &[u8]) -> [u8; CODE_BYTES] {
        [7; CODE_BYTES]
    }

    fn is_of_fleet(&self, _: &[u8], code: &[u8; CODE_BYTES]) -> bool {
        *code == [7; CODE_BYTES]
    }

    fn sign_for(&self, _: &Identity, _: &[u8]) -> Option<[u8; CODE_BYTES]> {
        None
    }

    fn is_of(&self, _: &Identity, _: &[u8], _: &[u8; CODE_BYTES]) -> bool {
        false
    }
}

/// Asks a secured manager; what it answered, and how many it has withheld.
fn answers_of_secured(search: &WhoHas) -> (Vec<(SocketAddr, Vec<u8>)>, u64) {
    let mut node = depot();
    let (mut bytes, mut outbox) = ([0; SEARCH_BYTES], Outbox::default());
    let length = search.encode(FLEET, &FleetOnly, &mut bytes).unwrap().len();
    node.datagram(at(0), address(3, 7_001), &bytes[..length], &FleetOnly);
    while node.next_deadline() <= at(3_000) {
        node.poll(node.next_deadline(), &mut outbox, &FleetOnly);
    }
    (outbox.sent, node.counters.value(NodeCounter::AnnounceWithheld))
}

#[test]
fn whoever_looks_at_a_secured_network_needs_the_fleets_key_alone() {
    let survey = WhoHas { wanted: None, ..search_of(&s_unit("survey", 9), 1) };
    let (sent, withheld) = answers_of_secured(&survey);
    assert_eq!((sent.len(), sent[0].0, withheld), (1, address(3, 7_001), 0));
    let read = Datagram::decode(&sent[0].1, FLEET, &FleetOnly);
    let Ok(Datagram::Announce(answer)) = read else { panic!("{read:?}") };
    assert_eq!((answer.nonce, answer.identity.name()), (0, MANAGER));
    // A second manager of one name hears of the first by what only their identity can sign.
    let duplicate = NodeConfig { epoch: Epoch(77), ..m_unit(MANAGER, MANAGER_ID) };
    let (sent, withheld) = answers_of_secured(&WhoHas { wanted: None, ..search_of(&duplicate, 1) });
    assert_eq!((sent.len(), withheld), (1, 1), "it is asked in turn");
    // A vehicle without a key of the pair gets none, and the operator is told.
    let (sent, withheld) = answers_of_secured(&search_of(&s_unit("agv", 9), 1));
    assert_eq!((sent.len(), withheld), (0, 1));
}
