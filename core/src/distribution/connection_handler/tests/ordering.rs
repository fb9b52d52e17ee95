//! Datagrams that overtake each other, and hostile ones.

use proptest::prelude::*;

use super::*;

/// Calls `visit` with every order of `items`.
fn orders<T: Clone>(items: &[T], chosen: &mut Vec<T>, visit: &mut impl FnMut(&[T])) {
    if items.is_empty() {
        return visit(chosen);
    }
    for index in 0..items.len() {
        let mut rest = items.to_vec();
        chosen.push(rest.remove(index));
        orders(&rest, chosen, visit);
        chosen.pop();
    }
}

fn state(node: &Node<InMemory>) -> Vec<impl Clone + PartialEq + core::fmt::Debug + use<>> {
    let mut all: Vec<_> = node
        .nodes()
        .map(|known| (known.identity.clone(), known.newest, known.listens, known.address, known.epoch, known.state()))
        .collect();
    all.sort_by(|one, other| one.0.cmp(&other.0));
    all
}

#[test]
fn any_order_of_six_datagrams_ends_in_the_same_state() {
    let (one, two) = (m_unit("one", 11), m_unit("two", 12));
    let moved = |config: &NodeConfig<SocketAddr>, tcp_port| NodeConfig { tcp_port, ..config.clone() };
    let nonce = depot().search.nonce;
    let datagrams = [
        who_has_bytes(&search_of(&moved(&one, 7_000), 9)),
        announce_bytes(&announce_of(&moved(&one, 7_010), 6, nonce)),
        announce_bytes(&announce_of(&moved(&one, 7_020), 8, 0)),
        announce_bytes(&announce_of(&moved(&one, 7_030), 7, nonce)),
        announce_bytes(&announce_of(&moved(&two, 7_040), 2, nonce)),
        announce_bytes(&announce_of(&moved(&two, 7_050), 1, nonce)),
    ];
    let mut expected = None;
    let mut count = 0;
    orders(&datagrams, &mut Vec::new(), &mut |order| {
        let mut node = depot();
        for (millis, bytes) in (1..).zip(order) {
            node.hear(at(millis), address(3, 7_001), bytes);
        }
        let state = state(&node);
        assert_eq!(expected.get_or_insert_with(|| state.clone()), &state);
        count += 1;
    });
    assert_eq!(count, 720);
    let mut node = depot();
    datagrams.iter().for_each(|bytes| {
        node.hear(at(1), address(3, 7_001), bytes);
    });
    let dialled: Vec<_> = run(&mut node, at(200), &mut Outbox::default())
        .into_iter()
        .map(|(_, action)| match action {
            Command::Dial { to, .. } => to.port(),
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(dialled.len(), 2);
    assert!(dialled.contains(&7_030) && dialled.contains(&7_040), "the newest answer of each: {dialled:?}");
}

/// Only a live unit answers a question with a fresh nonce: so another boot that does is newer, however small its epoch.
#[test]
fn another_life_that_answers_is_news_at_once() {
    let mut node = depot();
    let peer = m_unit("one", 11);
    node.answered(at(1), address(3, 7_001), &announce_of(&peer, 9, 0));
    let reborn = NodeConfig { epoch: Epoch(2), tcp_port: 7_777, ..peer.clone() };
    node.hear(at(2), address(3, 7_001), &announce_bytes(&announce_of(&reborn, 1, 0)));
    assert_eq!(node.node(&peer.identity).unwrap().epoch, Epoch(100), "a broadcast proves nothing");
    for _ in 0..2 {
        node.answered(at(3), address(3, 7_001), &announce_of(&reborn, 1, 0));
        let known = node.node(&peer.identity).unwrap();
        assert_eq!((known.epoch, known.address.port()), (Epoch(2), 7_777));
    }
    assert_eq!(node.counters.value(NodeCounter::Outdated), 1, "the same once more");
}

fn valid(kind: u8) -> Vec<u8> {
    let agv = s_unit("agv-with-a-long-name", 70_000);
    let mut who_has = search_of(&m_unit("one", 11), 5);
    who_has.known.extend([1, 2, u32::MAX]);
    match kind {
        0 => who_has_bytes(&search_of(&agv, 9)),
        1 => who_has_bytes(&who_has),
        _ => announce_bytes(&announce_of(&m_unit("two", 12), 7, 0)),
    }
}

proptest! {
    #[test]
    fn no_datagram_makes_a_node_panic_or_restless(
        kinds in prop::collection::vec((0u8..3, prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..4)), 1..20),
        noise in prop::collection::vec(any::<u8>(), 0..64),
    ) {
        for config in [m_unit(MANAGER, MANAGER_ID), s_unit("agv", 1)] {
            let mut node: Node<InMemory> = Node::new(at(0), config, storage(4));
            node.hear(at(1), address(9, 9), &noise);
            for (kind, mutations) in &kinds {
                let mut bytes = valid(*kind);
                for (place, value) in mutations {
                    let place = place.index(bytes.len());
                    bytes[place] = *value;
                }
                node.hear(at(2), address(9, 9), &bytes);
            }
            run(&mut node, at(1_000), &mut Outbox::default());
        }
    }
}
