//! Partitions, freezing, crashes and changed addresses.

use super::*;
use cara_sim::{Crash, Direction, Fault};

#[test]
fn a_partition_stalls_a_stream_which_goes_on_after_healing() {
    let mut pair = Pair::open(1);
    pair.network.partition_for(&[pair.left], &[pair.right], Direction::Both, millis(500));
    pair.network.write(pair.dialled, &[b"late"]).expect("open");
    assert_eq!(pair.read_for(millis(599)), b"", "tries at 0, 200 and 600 ms");
    assert_eq!(pair.read_for(millis(2)), b"late");
    assert_eq!(pair.network.counts().of(Fault::Partition), 1);
    assert_eq!(pair.network.counts().of(Fault::Retransmission), 2);
}

#[test]
fn a_partition_in_one_direction_leaves_the_other_open() {
    let mut pair = Pair::open(1);
    let partition = pair.network.partition(&[pair.left], &[pair.right], Direction::FirstToSecond);
    let (to_left, to_right) = (pair.network.address(pair.left), pair.network.address(pair.right));
    pair.network.send_to(pair.left, to_right, b"lost");
    pair.network.send_to(pair.right, to_left, b"heard");
    let (_, event) = pair.next_other();
    assert_eq!(event.host(), pair.left);
    pair.network.heal(partition);
    pair.network.send_to(pair.left, to_right, b"heard");
    assert_eq!(pair.next_other().1.host(), pair.right);
}

#[test]
fn a_frozen_stream_keeps_its_bytes_and_gives_them_after_thawing() {
    let mut pair = Pair::open(1);
    pair.network.freeze_stream(pair.dialled, millis(800));
    for word in [b"go ", b"to "] {
        pair.network.write(pair.dialled, &[word]).expect("open");
    }
    let to = pair.network.address(pair.right);
    pair.network.send_to(pair.left, to, b"alive");
    assert_eq!(pair.read_for(millis(799)), b"");
    assert_eq!(pair.read_for(millis(2)), b"go to ");
    assert_eq!(pair.network.counts().of(Fault::Retransmission), 0, "frozen bytes are in flight, not lost");
}

#[test]
fn datagrams_pass_beside_a_frozen_stream_and_not_through_a_frozen_link() {
    let mut pair = Pair::open(1);
    let to = pair.network.address(pair.right);
    pair.network.freeze_stream(pair.dialled, millis(100));
    pair.network.send_to(pair.left, to, b"beside");
    let start = pair.network.now();
    assert_eq!(pair.next_other().0.since(start), Path::LAN.delay);

    pair.network.freeze_link(pair.left, pair.right, millis(100));
    pair.network.send_to(pair.left, to, b"held");
    let start = pair.network.now();
    assert_eq!(pair.next_other().0.since(start), millis(100));
}

#[test]
fn thawing_at_once_gives_what_was_held() {
    let mut pair = Pair::open(1);
    pair.network.freeze_link(pair.left, pair.right, Duration::from_secs(8));
    pair.network.write(pair.dialled, &[b"stop"]).expect("open");
    assert_eq!(pair.read_for(millis(50)), b"");
    pair.network.thaw_all();
    assert_eq!(pair.read_for(millis(1)), b"stop");
}

#[test]
fn a_host_back_from_a_power_cut_resets_streams_of_its_earlier_life_when_they_speak() {
    let mut pair = Pair::open(1);
    pair.network.crash_for(pair.right, Crash::PowerCut, millis(1000));
    pair.network.write(pair.dialled, &[b"are you there?"]).expect("half open");
    let events: Vec<_> = (0..3).map(|_| pair.next_other().1).collect();
    let expected = [
        NetEvent::Crashed { host: pair.right },
        NetEvent::Restarted { host: pair.right },
        NetEvent::Reset { host: pair.left, stream: pair.dialled },
    ];
    assert_eq!(events, expected);
}

#[test]
fn a_host_that_answers_no_strays_leaves_the_other_half_open() {
    let mut pair = Pair::open(1);
    pair.network.answer_strays(pair.right, false);
    pair.network.crash_for(pair.right, Crash::PowerCut, millis(1));
    pair.network.write(pair.dialled, &[b"are you there?"]).expect("half open");
    assert_eq!(pair.read_for(Duration::from_secs(60)), b"");
    assert!(pair.network.is_open(pair.dialled));
}

#[test]
fn bytes_on_their_way_to_a_crashed_host_are_asked_for_until_it_is_back() {
    let mut pair = Pair::open(1);
    pair.network.write(pair.dialled, &[b"in flight"]).expect("open");
    pair.network.crash_for(pair.right, Crash::PowerCut, millis(300));
    let events: Vec<_> = (0..3).map(|_| pair.next_other().1).collect();
    assert_eq!(events[2], NetEvent::Reset { host: pair.left, stream: pair.dialled });
}

#[test]
fn timers_of_an_earlier_life_do_not_go_off() {
    let mut pair = Pair::open(1);
    let now = pair.network.now();
    pair.network.set_timer(pair.right, now + millis(10), 1);
    pair.network.crash_for(pair.right, Crash::Process, millis(1));
    while let Some(event) = pair.network.next_event() {
        assert!(!matches!(event, NetEvent::Timer { .. }), "{event:?}");
    }
}

#[test]
fn a_changed_address_breaks_old_streams_and_takes_new_ones() {
    let mut pair = Pair::open(1);
    let new = [10, 0, 99, 99].into();
    pair.network.change_address(pair.right, new);
    pair.network.write(pair.dialled, &[b"x"]).expect("half open");
    assert_eq!(pair.read_for(Duration::from_secs(10)), b"");
    pair.network.connect(pair.left, SocketAddr::new(new.into(), PORT));
    assert!(matches!(pair.next_other().1, NetEvent::Accepted { .. }));
}

#[test]
fn dropped_broadcasts_are_counted_and_unicast_passes() {
    let mut pair = Pair::open(1);
    pair.network.drop_broadcasts(0, millis(100));
    assert!(pair.network.broadcast(pair.left, b"who has"));
    let to = pair.network.address(pair.right);
    pair.network.send_to(pair.left, to, b"unicast");
    let NetEvent::Datagram { bytes, .. } = pair.next_other().1 else { panic!("unicast passes") };
    assert_eq!(&bytes[..], b"unicast");
    assert_eq!(pair.network.counts().of(Fault::BroadcastDropped), 1);
}

#[test]
fn a_suspended_host_sees_nothing_and_then_everything_in_order() {
    let mut pair = Pair::open(1);
    pair.network.suspend(pair.right, millis(500));
    let to = pair.network.address(pair.right);
    let start = pair.network.now();
    for number in 0..3 {
        pair.network.send_to(pair.left, to, &[number]);
    }
    for number in 0..3 {
        let (at, event) = pair.next_other();
        assert_eq!(at.since(start), millis(500));
        assert!(matches!(event, NetEvent::Datagram { bytes, .. } if bytes[..] == [number]));
    }
}
