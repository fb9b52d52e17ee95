//! Datagrams: their receivers, and loss, duplication and reordering.

use super::*;
use cara_core::config::PLAIN_PORT;
use cara_sim::Fault;

/// Sends `count` numbered datagrams, one each 100 µs, and returns the numbers in the order of arrival.
fn send_numbers(network: &mut Network, count: u64) -> Vec<u64> {
    let (left, right) = (network.add_host(), network.add_host());
    let to = network.address(right);
    for number in 0..count {
        network.set_timer(left, Instant::from_micros(number * 100), number);
    }
    let mut numbers = Vec::new();
    while let Some(event) = network.next_event() {
        match event {
            NetEvent::Timer { token, .. } => assert!(network.send_to(left, to, &token.to_le_bytes())),
            NetEvent::Datagram { bytes, .. } => numbers.push(u64::from_le_bytes(bytes[..].try_into().unwrap())),
            other => panic!("{other:?}"),
        }
    }
    numbers
}

#[test]
fn all_arrive_in_order_on_a_calm_path() {
    assert_eq!(send_numbers(&mut Network::new(1), 100), (0..100).collect::<Vec<_>>());
}

#[test]
fn loss_loses_about_as_many_as_it_says() {
    let mut network = Network::new(1);
    network.set_calm(Path::LAN.loss_percent(20.0));
    let arrived = send_numbers(&mut network, 1000).len();
    assert!((750..850).contains(&arrived), "{arrived}");
    assert_eq!(network.counts().of(Fault::Loss), 1000 - arrived as u64);
}

#[test]
fn duplication_doubles_and_invents_nothing() {
    let mut network = Network::new(1);
    network.set_calm(Path::LAN.duplicate_percent(10.0));
    let mut numbers = send_numbers(&mut network, 1000);
    assert_eq!(numbers.len() as u64, 1000 + network.counts().of(Fault::Duplicate));
    assert!(numbers.len() > 1050);
    numbers.sort_unstable();
    numbers.dedup();
    assert_eq!(numbers, (0..1000).collect::<Vec<_>>());
}

#[test]
fn reordering_lets_later_ones_overtake_and_so_does_jitter() {
    for path in [Path::LAN.reorder_percent(5.0), Path::LAN.jitter(millis(2))] {
        let mut network = Network::new(1);
        network.set_calm(path);
        let mut numbers = send_numbers(&mut network, 500);
        assert!(!numbers.is_sorted());
        numbers.sort_unstable();
        assert_eq!(numbers, (0..500).collect::<Vec<_>>());
        assert!(network.counts().of(Fault::Reorder) + network.counts().of(Fault::Jitter) > 0);
    }
}

#[test]
fn a_broadcast_reaches_every_other_host_of_its_segment_once() {
    let mut network = Network::new(1);
    let sender = network.add_host();
    let mut near: Vec<_> = (0..3).map(|_| network.add_host()).collect();
    network.add_host_in(1);
    let expected_from = network.address(sender);
    let hearers = |network: &mut Network| {
        assert!(network.broadcast(sender, b"who has"));
        std::iter::from_fn(|| network.next_event())
            .map(|event| match event {
                NetEvent::Datagram { host, from, port: PLAIN_PORT, .. } if from == expected_from => host,
                other => panic!("{other:?}"),
            })
            .collect::<Vec<_>>()
    };
    assert_eq!(hearers(&mut network), near);
    network.hear_own_broadcasts(true);
    near.insert(0, sender);
    assert_eq!(hearers(&mut network), near);
}

#[test]
fn two_processes_of_one_address_are_told_apart_by_port() {
    let mut network = Network::new(1);
    let sender = network.add_host();
    let address = [10, 0, 7, 7].into();
    let (one, two) = (network.add_host_at(0, address, 5001), network.add_host_at(0, address, 5002));
    for (port, expected) in [(5001, Some(one)), (5002, Some(two)), (5003, None)] {
        assert!(network.send_to(sender, SocketAddr::new(address.into(), port), b"x"));
        assert_eq!(network.next_event().map(|event| event.host()), expected);
    }
}

#[test]
fn a_host_that_is_down_neither_sends_nor_hears() {
    let mut pair = Pair::open(1);
    pair.network.crash(pair.right, cara_sim::Crash::PowerCut);
    let to = pair.network.address(pair.right);
    assert!(pair.network.send_to(pair.left, to, b"x"), "sending says nothing of arrival");
    assert!(!pair.network.send_to(pair.right, to, b"x"));
    assert_eq!(pair.network.next_event(), Some(NetEvent::Crashed { host: pair.right }));
    assert_eq!(pair.network.next_event(), None);
}
