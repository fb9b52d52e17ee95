//! Every decision about a hello.

use super::*;
use crate::config::Versions;

fn decide(node: &mut Node<InMemory>, hello: &Hello) -> Admission {
    node.admit(at(10), LinkId(9), address(9, 40_000), hello)
}

#[test]
fn each_hello_has_its_outcome() {
    let agv = || hello_of(&s_unit("agv", 1));
    let other = || hello_of(&m_unit("other", 9));
    let wanted = |name: &str, id| Some(Manager::new(name, id).unwrap());
    let cases: [(&str, Hello, Admission); 13] = [
        ("an own s_unit", agv(), Admission::Accept),
        ("an m_unit", other(), Admission::Accept),
        ("another fleet", Hello { fleet: Fleet(8), ..agv() }, Admission::Refuse(Refusal::Fleet)),
        ("another fleet's m_unit", Hello { fleet: Fleet(8), ..other() }, Admission::Refuse(Refusal::Fleet)),
        ("another's name", Hello { wanted: wanted("yard", 5), ..agv() }, Admission::Refuse(Refusal::WrongManager)),
        ("another's id", Hello { wanted: wanted("depot", 6), ..agv() }, Admission::Refuse(Refusal::WrongManager)),
        ("an s_unit of nobody", Hello { wanted: None, ..agv() }, Admission::Refuse(Refusal::WrongManager)),
        (
            "an m_unit for another",
            Hello { wanted: wanted("yard", 5), ..other() },
            Admission::Refuse(Refusal::WrongManager),
        ),
        ("an m_unit for this one", Hello { wanted: wanted("depot", 5), ..other() }, Admission::Accept),
        ("itself", hello_of(&m_unit("depot", 5)), Admission::Refuse(Refusal::DuplicateIdentity)),
        (
            "its own identity in another life",
            Hello { epoch: Epoch(1), ..hello_of(&m_unit("depot", 5)) },
            Admission::Refuse(Refusal::DuplicateIdentity),
        ),
        ("an s_unit of its own name and id", Hello { ..hello_of(&s_unit("depot", 5)) }, Admission::Accept),
        ("an m_unit of its own name", hello_of(&m_unit("depot", 6)), Admission::Accept),
    ];
    for (what, hello, expected) in cases {
        let mut node = depot();
        assert_eq!(decide(&mut node, &hello), expected, "{what}");
        assert_eq!(node.connected(), usize::from(expected == Admission::Accept), "{what}");
        let refused = matches!(expected, Admission::Refuse(_));
        assert_eq!(node.findings().count(), usize::from(refused), "{what}");
    }
}

#[test]
fn a_node_without_a_key_is_counted_and_found() {
    let mut node = depot();
    let agv = s_unit("agv", 1).identity;
    node.refuse_without_key(at(10), address(9, 40_000), &agv);
    let found: Vec<_> = node.findings().map(|finding| (finding.refusal, finding.identity.clone())).collect();
    assert_eq!((node.counters.value(NodeCounter::RefusedKey), found), (1, [(Refusal::NoKey, Some(agv))].into()));
}

#[test]
fn an_s_unit_takes_its_manager_only() {
    let cases = [
        (hello_of(&m_unit("depot", 5)), Admission::Accept),
        (hello_of(&m_unit("depot", 6)), Admission::Refuse(Refusal::WrongManager)),
        (hello_of(&m_unit("yard", 5)), Admission::Refuse(Refusal::WrongManager)),
        (hello_of(&s_unit("other", 6)), Admission::Refuse(Refusal::Role)),
    ];
    for (hello, expected) in cases {
        assert_eq!(decide(&mut node(s_unit("agv", 1)), &hello), expected, "{:?}", hello.identity);
    }
}

#[test]
fn the_next_node_is_refused_as_full_until_one_leaves_or_the_limit_is_raised() {
    let mut node = depot();
    node.set_maximum_nodes(2);
    join(&mut node, at(1), 0, &s_unit("a", 1));
    join(&mut node, at(2), 1, &m_unit("b", 2));
    let third = hello_of(&s_unit("c", 3));
    assert_eq!(decide(&mut node, &third), Admission::Refuse(Refusal::Full));
    assert_eq!(node.counters.value(NodeCounter::RefusedFull), 1);
    // A connected node that returns takes no further slot.
    let again = Hello { epoch: Epoch(50), ..hello_of(&s_unit("a", 1)) };
    assert_eq!(decide(&mut node, &again), Admission::Wait);
    node.left(at(11), LinkId(9), CloseReason::Reset);
    node.left(at(12), LinkId(1), CloseReason::Reset);
    assert_eq!(decide(&mut node, &third), Admission::Accept);
    node.set_maximum_nodes(3);
    assert_eq!(node.admit(at(13), LinkId(5), address(4, 1), &hello_of(&s_unit("d", 4))), Admission::Accept);
    assert_eq!((node.number_of_s_units(), node.number_of_m_units()), (3, 0));
}

#[test]
fn a_table_that_is_full_of_connected_nodes_refuses_as_full() {
    let mut node: Node<InMemory> = Node::new(at(0), m_unit(MANAGER, MANAGER_ID), storage(2));
    join(&mut node, at(1), 0, &s_unit("a", 1));
    join(&mut node, at(1), 1, &s_unit("b", 2));
    assert_eq!(decide(&mut node, &hello_of(&s_unit("c", 3))), Admission::Refuse(Refusal::Full));
}

#[test]
fn of_crossing_links_both_ends_keep_the_one_that_the_smaller_dialled() {
    // Both have found and dialled each other, as with fixed addresses. `small` and `large` get the hellos in each possible order.
    let (small, large) = (m_unit("small", 1), m_unit("large", 2));
    let by_small_address = address(1, 40_000);
    for small_first in [true, false] {
        let mut of_small = node(small.clone());
        let mut of_large = node(large.clone());
        // `small` dials link 0, `large` dials link 1.
        let hear = |node: &mut Node<InMemory>, peer: &NodeConfig<SocketAddr>| {
            node.answered(at(1), address(peer.identity.id(), 7_001), &announce_of(peer, 1, 0));
        };
        hear(&mut of_small, &large);
        run(&mut of_small, at(100), &mut Outbox::default());
        of_small.dialing(Some(&large.identity), LinkId(0));
        // The application of `large` asked it to dial, as if its identity were the smaller one.
        of_large.table.place_of(&small.identity, by_small_address, small.epoch).unwrap();
        let place = of_large.table.find(&small.identity).unwrap();
        of_large.table.set_state(place, NodeState::Dialing);
        of_large.dialing(Some(&small.identity), LinkId(1));

        let links = if small_first { [0, 1] } else { [1, 0] };
        for link in links {
            of_small.admit(at(101), LinkId(link), address(2, 7_000), &hello_of(&large));
        }
        for link in [0, 1] {
            of_large.admit(at(101), LinkId(link), by_small_address, &hello_of(&small));
        }
        for node in [&mut of_small, &mut of_large] {
            // An answer to the challenge no longer matters.
            node.challenge_answered(at(101), LinkId(1));
            let reason = CloseReason::Refused(Refusal::AlreadyConnected);
            let decided = [notify(1, Directive::Challenge), notify(1, Directive::Close(reason))];
            let commands = due(node, at(101));
            assert!(commands.is_empty() || commands == decided, "{commands:?}");
            node.left(at(101), LinkId(1), reason);
            let admitted = due(node, at(101));
            assert!(
                admitted.is_empty() == commands.is_empty()
                    && admitted.iter().all(|reported| *reported == notify(0, Directive::Admit))
            );
            let link = node.nodes().next().unwrap().link();
            assert_eq!(link, Some(LinkId(0)), "first: {}", if small_first { "small" } else { "large" });
            node.left(at(102), LinkId(1), CloseReason::Reset);
            assert_eq!(node.connected(), 1);
        }
    }
}

#[test]
fn a_hello_that_comes_twice_changes_nothing() {
    let mut node = depot();
    let config = s_unit("agv", 1);
    join(&mut node, at(1), 3, &config);
    join(&mut node, at(2), 3, &config);
    assert_eq!((node.connected(), node.counters.value(NodeCounter::Joined)), (1, 1));
}

#[test]
fn the_last_refusal_of_each_reason_and_address_is_kept() {
    let mut node = depot();
    let foreign = Hello { fleet: Fleet(8), ..hello_of(&s_unit("agv", 1)) };
    for millis in 1..=5 {
        node.admit(at(millis), LinkId(0), address(1, 1_000 + millis as u16), &foreign);
    }
    for host in 2..=4 {
        node.admit(at(10), LinkId(0), address(host, 1), &foreign);
    }
    assert_eq!(node.findings().count(), 4);
    // The fifth address replaces the oldest.
    node.admit(at(11), LinkId(0), address(5, 1), &foreign);
    let mut hosts: Vec<_> = node.findings().map(|finding| finding.address.ip()).collect();
    hosts.sort();
    assert_eq!(hosts, (2..=5).map(|host| address(host, 1).ip()).collect::<Vec<_>>());
}

#[test]
fn a_datagram_of_another_version_is_told() {
    let mut node = depot();
    let mut bytes = who_has_bytes(&search_of(&s_unit("agv", 1), 1));
    bytes[4] = 9;
    node.hear(at(1), address(1, 7_001), &bytes);
    let finding = node.findings().next().unwrap();
    let versions = Versions { first: 9, last: 9 };
    assert_eq!((finding.refusal, finding.address), (Refusal::Version(versions), address(1, 7_001)));
    assert_eq!(node.counters.value(NodeCounter::DatagramVersion), 1);
}

#[test]
fn a_session_datagram_of_no_link_is_counted() {
    let mut node = depot();
    let bytes = crate::distribution::datagram::session_header(Mode::Plain, VERSIONS.last, FLEET, 4, 42);
    node.hear(at(2), address(1, 1), &bytes);
    assert_eq!(node.counters.value(NodeCounter::DatagramUnknownLink), 1);
}
