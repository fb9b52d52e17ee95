//! Streams: opening, order, bandwidth, buffers, closing.

use super::*;
use cara_sim::{Broken, Chance, Crash, Fault};
use proptest::prelude::*;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Whatever a path does, a stream's bytes arrive all, once and in order.
    #[test]
    fn bytes_are_whole_under_loss_jitter_and_bandwidth(
        seed in any::<u64>(),
        length in 1..40_000usize,
        loss in 0.0..20.0f64,
        jitter in 0..50u64,
        kilobits in prop::sample::select(vec![0u64, 500, 10_000]),
        window in 500..70_000usize,
        send_buffer in 1..10_000usize,
        splits in 0.0..100.0f64,
    ) {
        let path = Path::LAN.loss_percent(loss).jitter(millis(jitter)).bits_per_second(kilobits * 1000);
        let mut pair = Pair::open(seed);
        pair.network.set_calm(path);
        pair.network.set_buffers(pair.left, send_buffer, window);
        pair.network.set_buffers(pair.right, send_buffer, window);
        pair.network.split_reads(Chance::percent(splits));
        let message = message(length);
        let (got, _) = transfer(&mut pair.network, pair.dialled, &message);
        prop_assert!(got == message, "{} of {} bytes", got.len(), message.len());
    }

    /// A reader that consumes only some of what it is lent sees the rest again, in place.
    #[test]
    fn what_is_not_consumed_is_lent_again(seed in any::<u64>(), takes in prop::collection::vec(0..9usize, 1..40)) {
        let mut pair = Pair::open(seed);
        pair.network.split_reads(Chance::percent(50.0));
        let message = message(60);
        prop_assert_eq!(pair.network.write(pair.dialled, &[&message]), Ok(60));
        let (mut got, mut takes) = (Vec::new(), takes.into_iter().chain(std::iter::repeat(1)));
        while let Some(event) = pair.network.next_event() {
            let NetEvent::Readable { stream, .. } = event else { continue };
            for _ in 0..20 {
                pair.network.read(stream, |bytes| {
                    let taken = takes.next().unwrap().min(bytes.len());
                    got.extend_from_slice(&bytes[..taken]);
                    taken
                });
            }
        }
        while got.len() < message.len() {
            got.extend(read_all(&mut pair.network, pair.accepted));
        }
        prop_assert_eq!(got, message);
    }
}

#[test]
fn twenty_thousand_bytes_take_160_ms_on_one_megabit() {
    let mut pair = Pair::open(1);
    pair.network.set_calm(Path::LAN.delay(Duration::ZERO).bits_per_second(1_000_000));
    let start = pair.network.now();
    let (_, last) = transfer(&mut pair.network, pair.dialled, &message(20_000));
    assert_eq!(last.since(start), millis(160));
    assert!(pair.network.counts().of(Fault::Bandwidth) > 0);
}

#[test]
fn two_streams_share_the_bandwidth_of_their_path() {
    let mut pair = Pair::open(1);
    let to = at_port(&pair.network, pair.right, PORT);
    let second = pair.network.connect(pair.left, to);
    while pair.network.next_event().is_some() {}
    pair.network.set_calm(Path::LAN.delay(Duration::ZERO).bits_per_second(1_000_000));
    let start = pair.network.now();
    for stream in [pair.dialled, second] {
        assert_eq!(pair.network.write(stream, &[&message(8000)]), Ok(8000));
    }
    let mut ends = Vec::new();
    while pair.network.next_event().is_some() {
        ends.push(pair.network.now().since(start));
    }
    assert_eq!(ends.last(), Some(&millis(128)), "16,000 bytes in all");
}

#[test]
fn hosts_of_one_cable_share_its_bandwidth() {
    for (shared, expected) in [(false, 64), (true, 128)] {
        let mut pair = Pair::open(1);
        let third = pair.network.add_host();
        let to = at_port(&pair.network, pair.right, PORT);
        let second = pair.network.connect(third, to);
        while pair.network.next_event().is_some() {}
        if shared {
            pair.network.share_cable(&[pair.left, third]);
        }
        pair.network.set_calm(Path::LAN.delay(Duration::ZERO).bits_per_second(1_000_000));
        let start = pair.network.now();
        for stream in [pair.dialled, second] {
            assert_eq!(pair.network.write(stream, &[&message(8000)]), Ok(8000));
        }
        while pair.network.next_event().is_some() {}
        assert_eq!(pair.network.now().since(start), millis(expected), "shared: {shared}");
    }
}

#[test]
fn a_datagram_waits_for_one_segment_and_not_for_the_whole_message() {
    let mut pair = Pair::open(1);
    pair.network.set_calm(Path::LAN.delay(Duration::ZERO).bits_per_second(1_000_000));
    pair.network.write(pair.dialled, &[&message(8000)]).expect("open");
    let (start, to) = (pair.network.now(), pair.network.address(pair.right));
    assert!(pair.network.send_to(pair.left, to, b"stop"));
    let (at, event) = pair.next_other();
    assert!(matches!(event, NetEvent::Datagram { .. }));
    assert_eq!(at.since(start), Duration::from_micros((1460 + 4) * 8));
}

#[test]
fn a_full_send_buffer_takes_a_part_and_tells_when_there_is_room() {
    let mut pair = Pair::open(1);
    pair.network.set_calm(Path::LAN.bits_per_second(1_000_000));
    pair.network.set_buffers(pair.left, 4000, 64_000);
    assert_eq!(pair.network.write(pair.dialled, &[&message(3000), &message(3000)]), Ok(4000));
    assert_eq!(pair.network.write(pair.dialled, &[b"x"]), Ok(0));
    let (_, event) = pair.next_other();
    assert_eq!(event, NetEvent::Writable { host: pair.left, stream: pair.dialled });
    assert!(pair.network.unsent(pair.dialled) <= 2000);
}

#[test]
fn a_reader_that_does_not_read_stops_the_writer() {
    let mut pair = Pair::open(1);
    pair.network.set_buffers(pair.right, 8000, 10_000);
    let mut taken = 0;
    for _ in 0..100 {
        taken += pair.network.write(pair.dialled, &[&message(1000)]).expect("open");
        while pair.network.next_event().is_some() {}
    }
    assert_eq!(taken, 10_000 + 8 * 1024, "the reader's window and the writer's buffer");
    assert_eq!(read_all(&mut pair.network, pair.accepted).len(), 10_000);
    assert_eq!(pair.read_for(millis(10)).len(), 8 * 1024);
}

#[test]
fn the_end_comes_behind_the_bytes() {
    let mut pair = Pair::open(1);
    pair.network.set_calm(Path::LAN.bits_per_second(1_000_000));
    pair.network.write(pair.dialled, &[b"last words"]).expect("open");
    pair.network.close(pair.dialled);
    assert_eq!(pair.network.write(pair.dialled, &[b"more"]), Err(Broken));
    assert_eq!(pair.network.next_event(), Some(NetEvent::Readable { host: pair.right, stream: pair.accepted }));
    assert_eq!(read_all(&mut pair.network, pair.accepted), b"last words");
    assert_eq!(pair.network.next_event(), Some(NetEvent::Closed { host: pair.right, stream: pair.accepted }));
    pair.network.close(pair.accepted);
    assert_eq!(pair.network.next_event(), None);
}

#[test]
fn writing_to_an_end_that_closed_is_answered_with_a_reset() {
    let mut pair = Pair::open(1);
    pair.network.close(pair.accepted);
    assert!(matches!(pair.next_other().1, NetEvent::Closed { .. }));
    pair.network.write(pair.dialled, &[b"anybody?"]).expect("half closed");
    assert_eq!(pair.next_other().1, NetEvent::Reset { host: pair.left, stream: pair.dialled });
    assert_eq!(pair.network.write(pair.dialled, &[b"x"]), Err(Broken));
}

#[test]
fn a_reset_is_heard_at_the_other_end() {
    let mut pair = Pair::open(1);
    pair.network.reset(pair.dialled);
    assert_eq!(pair.next_other().1, NetEvent::Reset { host: pair.right, stream: pair.accepted });
    assert!(!pair.network.is_open(pair.dialled));
}

#[test]
fn a_dial_is_refused_where_nobody_listens_and_times_out_where_nobody_is() {
    let mut pair = Pair::open(1);
    let to = at_port(&pair.network, pair.right, 1);
    let start = pair.network.now();
    let stream = pair.network.connect(pair.left, to);
    let refused = |timed_out| NetEvent::Refused { host: pair.left, stream, timed_out };
    assert_eq!(pair.network.next_event(), Some(refused(false)));
    assert_eq!(pair.network.now().since(start), Duration::from_micros(400));

    let stream = pair.network.connect(pair.left, SocketAddr::from(([10, 9, 9, 9], PORT)));
    let start = pair.network.now();
    let expected = NetEvent::Refused { host: pair.left, stream, timed_out: true };
    assert_eq!(pair.network.next_event(), Some(expected));
    assert_eq!(pair.network.now().since(start), Duration::from_secs(31));
}

#[test]
fn a_host_takes_no_more_streams_than_its_limit_until_one_is_closed() {
    let mut pair = Pair::open(1);
    pair.network.limit_streams(pair.right, 1);
    let to = at_port(&pair.network, pair.right, PORT);
    pair.network.connect(pair.left, to);
    assert!(matches!(pair.next_other().1, NetEvent::Refused { timed_out: false, .. }));
    pair.network.close(pair.dialled);
    pair.network.close(pair.accepted);
    while pair.network.next_event().is_some() {}
    pair.network.connect(pair.left, to);
    assert!(matches!(pair.next_other().1, NetEvent::Accepted { .. }));
}

#[test]
fn a_dial_that_was_given_up_is_reset_at_the_accepting_end() {
    let mut pair = Pair::open(1);
    let to = at_port(&pair.network, pair.right, PORT);
    let given_up = pair.network.connect(pair.left, to);
    pair.network.close(given_up);
    let NetEvent::Accepted { stream, .. } = pair.next_other().1 else { panic!("the dial was on its way") };
    assert_eq!(pair.next_other().1, NetEvent::Reset { host: pair.right, stream });
}

#[test]
fn a_killed_process_closes_its_streams_and_a_power_cut_says_nothing() {
    let mut killed = Pair::open(1);
    killed.network.crash(killed.left, Crash::Process);
    assert!(matches!(killed.next_other().1, NetEvent::Crashed { .. }));
    assert!(matches!(killed.next_other().1, NetEvent::Closed { .. }));

    let mut cut = Pair::open(1);
    cut.network.crash(cut.left, Crash::PowerCut);
    assert!(matches!(cut.next_other().1, NetEvent::Crashed { .. }));
    assert_eq!(cut.network.next_event(), None);
}

#[test]
fn a_stream_into_an_outage_is_given_up_in_the_end() {
    let mut pair = Pair::open(1);
    pair.network.partition(&[pair.left], &[pair.right], cara_sim::Direction::Both);
    pair.network.write(pair.dialled, &[b"hello?"]).expect("open");
    let start = pair.network.now();
    let (at, event) = pair.next_other();
    assert_eq!(event, NetEvent::Reset { host: pair.left, stream: pair.dialled });
    assert!(at.since(start) > Duration::from_secs(600));
}
