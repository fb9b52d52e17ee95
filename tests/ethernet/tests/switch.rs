//! What the switch does with frames, and that each fault is injected, counted and the same for the same seed.

use cara_core::time::{Duration, Instant};
use cara_ethernet::{Fault, Faults, Mac, PortId, Switch};

const MILLISECOND: Duration = Duration::from_millis(1);

fn mac(last: u8) -> Mac {
    Mac([2, 0, 0, 0, 0, last])
}

fn frame(to: Mac, from: Mac, number: u8) -> Vec<u8> {
    [&to.0[..], &from.0, &[8, 0, number]].concat()
}

/// A switch with ports of the addresses 0, 1 and 2.
fn switch(seed: u64, faults: Faults) -> (Switch, [PortId; 3]) {
    let mut switch = Switch::new(seed);
    let ports = [0, 1, 2].map(|last| switch.add_port(mac(last)));
    switch.set_faults(faults);
    (switch, ports)
}

/// The numbers of the frames that arrive at `port`, however late.
fn arrivals(switch: &mut Switch, port: PortId) -> Vec<u8> {
    std::iter::from_fn(|| switch.receive(Instant::FAR_FUTURE, port)).map(|frame| frame[14]).collect()
}

/// Sends 100 numbered frames from port 0 to port 1, a millisecond apart.
fn send_hundred(switch: &mut Switch, ports: &[PortId; 3]) {
    for number in 0..100 {
        let now = Instant::START + MILLISECOND.times(number);
        switch.send(now, ports[0], &frame(mac(1), mac(0), number as u8));
    }
}

fn hundred(seed: u64, faults: Faults) -> (Vec<u8>, Switch) {
    let (mut switch, ports) = switch(seed, faults);
    send_hundred(&mut switch, &ports);
    (arrivals(&mut switch, ports[1]), switch)
}

#[test]
fn a_frame_goes_to_its_address_and_a_broadcast_to_all_others() {
    let (mut switch, ports) = switch(1, Faults::NONE);
    switch.send(Instant::START, ports[0], &frame(mac(2), mac(0), 7));
    switch.send(Instant::START, ports[1], &frame(Mac::BROADCAST, mac(1), 8));
    switch.send(Instant::START, ports[1], &frame(mac(9), mac(1), 9));
    assert_eq!(ports.map(|port| arrivals(&mut switch, port)), [vec![8], vec![], vec![7, 8]]);
    assert_eq!(switch.next_event(), None);
    assert_eq!(switch.frames(), 3);
}

#[test]
fn a_frame_arrives_after_its_delay_and_not_before() {
    let (mut switch, ports) = switch(1, Faults { delay: MILLISECOND.times(5), ..Faults::NONE });
    switch.send(Instant::START + MILLISECOND, ports[0], &frame(mac(1), mac(0), 1));
    let arrival = Instant::START + MILLISECOND.times(6);
    assert_eq!((switch.next_event(), switch.next_arrival(ports[1])), (Some(arrival), Some(arrival)));
    assert_eq!(switch.receive(arrival - Duration::from_micros(1), ports[1]), None);
    assert!(switch.receive(arrival, ports[1]).is_some());
}

#[test]
fn loss_is_as_frequent_as_told_and_the_same_for_the_same_seed() {
    let lost = |seed| 100 - hundred(seed, Faults::loss(0.1)).0.len();
    let all: usize = (0..100).map(lost).sum();
    assert!((900..1_100).contains(&all), "{all} of 10,000 lost at 10 %");
    assert_eq!(hundred(3, Faults::loss(0.1)).0, hundred(3, Faults::loss(0.1)).0);
    assert_ne!(hundred(3, Faults::loss(0.1)).0, hundred(4, Faults::loss(0.1)).0);
    assert_eq!(hundred(3, Faults::loss(1.0)).0, []);
    assert_eq!(hundred(3, Faults::loss(0.0)).0.len(), 100);
}

#[test]
fn jitter_keeps_the_order_and_reordering_does_not() {
    let (jittered, switch) = hundred(1, Faults { jitter: MILLISECOND.times(20), ..Faults::NONE });
    assert!(jittered.is_sorted() && jittered.len() == 100);
    assert!(switch.counts().of(Fault::Jitter) > 90);
    let (reordered, switch) = hundred(1, Faults { reordering: 0.2, ..Faults::NONE });
    assert!(!reordered.is_sorted() && reordered.len() == 100);
    assert!((5..50).contains(&switch.counts().of(Fault::Reorder)));
}

#[test]
fn a_doubled_frame_arrives_twice() {
    let (doubled, switch) = hundred(1, Faults { duplication: 1.0, ..Faults::NONE });
    assert_eq!(doubled.len(), 200);
    assert_eq!(switch.counts().of(Fault::Duplicate), 100);
}

#[test]
fn limited_bandwidth_delays_what_comes_behind() {
    // A frame of 15 bytes has 120 bits.
    let (mut switch, ports) = switch(1, Faults { bandwidth: 120_000, delay: Duration::ZERO, ..Faults::NONE });
    for number in 0..3 {
        switch.send(Instant::START, ports[0], &frame(mac(1), mac(0), number));
    }
    let mut times = Vec::new();
    while let Some(at) = switch.next_event() {
        times.push(at.as_micros());
        switch.receive(at, ports[1]);
    }
    assert_eq!(times, [1_000, 2_000, 3_000]);
    assert_eq!(switch.counts().of(Fault::Bandwidth), 3);
}

#[test]
fn a_pulled_cable_loses_what_is_under_way_and_what_is_sent() {
    let (mut switch, ports) = switch(1, Faults::NONE);
    switch.send(Instant::START, ports[0], &frame(mac(1), mac(0), 1));
    switch.set_link(ports[1], false);
    switch.send(Instant::START, ports[0], &frame(mac(1), mac(0), 2));
    switch.send(Instant::START, ports[1], &frame(mac(0), mac(1), 3));
    assert!(!switch.is_up(ports[1]));
    switch.set_link(ports[1], true);
    switch.send(Instant::START, ports[0], &frame(mac(1), mac(0), 4));
    assert_eq!(ports.map(|port| arrivals(&mut switch, port)), [vec![], vec![4], vec![]]);
    assert_eq!(switch.counts().of(Fault::LinkDown), 3);
}

#[test]
fn faults_may_be_in_one_direction_only() {
    let (mut switch, ports) = switch(1, Faults::NONE);
    switch.set_faults_from(ports[0], Faults::loss(1.0));
    switch.send(Instant::START, ports[0], &frame(mac(1), mac(0), 1));
    switch.send(Instant::START, ports[1], &frame(mac(0), mac(1), 2));
    assert_eq!(ports.map(|port| arrivals(&mut switch, port)), [vec![2], vec![], vec![]]);
}

#[test]
fn frames_of_a_wrong_length_and_without_room_are_counted() {
    let (mut switch, ports) = switch(1, Faults::NONE);
    switch.send(Instant::START, ports[0], &[0; 13]);
    switch.send(Instant::START, ports[0], &[0; 1_515]);
    assert_eq!(switch.counts().of(Fault::BadLength), 2);
    (0..5_000).for_each(|_| switch.send(Instant::START, ports[0], &frame(mac(1), mac(0), 1)));
    assert_eq!(arrivals(&mut switch, ports[1]).len() + switch.counts().of(Fault::QueueFull) as usize, 5_000);
    assert!(switch.counts().of(Fault::QueueFull) > 0);
    assert!(switch.counts().to_string().starts_with("loss 0, jitter 0"), "{}", switch.counts());
}
