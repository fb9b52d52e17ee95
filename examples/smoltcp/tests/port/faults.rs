//! What the port survives: cables, managers and addresses that go and come, one direction that fails, a flood.

use cara_core::error::CloseReason;
use cara_core::services::session::Event;
use cara_core::time::Duration;
use cara_ethernet::{Fault, Faults, Mac};
use smoltcp::wire::Ipv4Cidr;
use std::net::Ipv4Addr;

use crate::world::{Cable, World};

const SECOND: Duration = Duration::from_secs(1);

fn joined(seed: u64) -> World {
    let mut world = World::new(seed, 1, Faults::NONE);
    world.join();
    // The first keep-alive comes before the vehicle is ready for it; the second shows that datagrams pass.
    world.run(SECOND.times(2));
    world
}

/// The manager calls, and the vehicle answers.
fn talk(world: &mut World) {
    // Its list of functions comes after it has joined.
    world.run(SECOND);
    let (now, link) = (world.now, world.manager().links()[0]);
    let before = world.manager().replies.len();
    world.manager().call(now, link, "echo", 1).unwrap();
    world.run(SECOND);
    assert_eq!(world.manager().replies[before].2, Ok(1));
}

#[test]
fn a_link_is_as_good_as_the_first_after_twenty_others() {
    let mut world = joined(1);
    for cycle in 1..=20 {
        world.set_link(0, false);
        world.run(SECOND.times(5));
        assert!(!world.vehicles[0].unit.is_connected());
        assert_eq!(world.vehicles[0].left(), cycle);
        world.set_link(0, true);
        let now = world.now;
        world.vehicles[0].unit.link_up(now);
        world.vehicles[0].wake();
        world.join();
        talk(&mut world);
    }
}

#[test]
fn a_manager_that_is_gone_is_noticed_in_time_and_found_again() {
    for seed in 0..20 {
        let mut world = joined(seed);
        world.run(Duration::from_millis(seed * 53));
        let gone = world.now;
        let cable = world.power_cut();
        assert!(world.run_until(SECOND.times(10), |world| world.vehicles[0].left() == 1));
        let (left, news) = *world.vehicles[0].program.news.last().unwrap();
        assert_eq!(news, Event::Closed(CloseReason::Silent));
        let millis = left.since(gone).as_millis();
        assert!((2_500..=3_550).contains(&millis), "{millis} ms, seed {seed}");
        world.power_on(cable, seed + 100);
        world.join();
        talk(&mut world);
    }
}

#[test]
fn a_manager_that_was_away_for_long_is_found_again() {
    for mut world in [joined(11), World::dialing(12)] {
        world.join();
        let cable = world.power_cut();
        world.run(SECOND.times(300));
        assert!(!world.vehicles[0].unit.is_connected());
        world.power_on(cable, 13);
        world.join();
        talk(&mut world);
    }
}

#[test]
fn a_manager_that_restarts_at_once_resets_the_link() {
    let mut world = joined(14);
    let gone = world.now;
    let cable = world.power_cut();
    world.power_on(cable, 15);
    assert!(world.run_until(SECOND.times(10), |world| world.vehicles[0].left() == 1));
    let left = world.vehicles[0].program.news.iter().find(|(_, news)| matches!(news, Event::Closed(_))).unwrap();
    assert_eq!(left.1, Event::Closed(CloseReason::Reset));
    // A question in the stream follows the first missed keep-alive. The new manager knows nothing of the stream, and is
    // asked twice, since it must find out first where to answer.
    assert!(left.0.since(gone).as_millis() <= 2_600, "{:?}", left.0.since(gone));
    world.join();
    talk(&mut world);
}

#[test]
fn a_manager_that_has_moved_to_another_host_is_found() {
    let mut world = joined(16);
    world.power_cut();
    world.power_on_elsewhere(17);
    world.join();
    talk(&mut world);
}

#[test]
fn without_a_manager_it_goes_on_looking() {
    let mut world = joined(18);
    world.power_cut();
    world.run(SECOND.times(10));
    let before = world.switch.borrow().frames();
    world.run(SECOND.times(120));
    let sent = world.switch.borrow().frames() - before;
    assert!((8..30).contains(&sent), "{sent} frames in two minutes");
}

#[test]
fn one_direction_that_fails_ends_the_link_on_both_sides() {
    for deaf in [true, false] {
        let mut world = joined(3);
        let port = if deaf { world.manager().cable.port } else { world.vehicles[0].cable.port };
        world.switch.borrow_mut().set_faults_from(port, Faults::loss(1.0));
        assert!(world.run_until(SECOND.times(30), |world| world.vehicles[0].left() == 1));
        assert!(world.run_until(SECOND.times(30), |world| world.manager().left.len() == 1));
        world.set_faults(Faults::NONE);
        world.join();
        talk(&mut world);
    }
}

#[test]
fn another_address_is_a_new_link() {
    let mut world = joined(4);
    let now = world.now;
    world.vehicles[0].unit.set_address(now, Some(Ipv4Cidr::new(Ipv4Addr::new(10, 0, 0, 99), 24)));
    world.vehicles[0].wake();
    assert!(world.run_until(SECOND.times(30), |world| world.vehicles[0].left() == 1));
    world.join();
    talk(&mut world);
}

#[test]
fn without_an_address_it_waits_for_one() {
    let mut world = joined(5);
    let now = world.now;
    world.vehicles[0].unit.set_address(now, None);
    world.vehicles[0].wake();
    world.run(SECOND.times(30));
    assert!(!world.vehicles[0].unit.is_connected());
    let now = world.now;
    world.vehicles[0].unit.set_address(now, Some(Ipv4Cidr::new(Ipv4Addr::new(10, 0, 0, 1), 24)));
    world.vehicles[0].wake();
    world.join();
}

#[test]
fn a_flood_of_junk_changes_nothing() {
    let mut world = joined(6);
    let noise = Cable::new(&world.switch, [2, 0, 0, 0, 9, 9]);
    let mut random = cara_core::random::Random::new(6);
    for _ in 0..2_000 {
        let mut frame = vec![0; 14 + random.below(1_400) as usize];
        frame.fill_with(|| random.bits() as u8);
        let to = if random.below(2) == 0 { Mac::BROADCAST } else { Mac([2, 0, 0, 0, 1, 1]) };
        frame[..6].copy_from_slice(&to.0);
        // IPv4 to a UDP port of CARA, as far as it goes, or anything at all.
        if random.below(2) == 0 && frame.len() > 60 {
            frame[12..14].copy_from_slice(&[8, 0]);
            let header = [0x45, 0, 0, 46, 0, 0, 0x40, 0, 64, 17, 0, 0, 10, 0, 0, 77, 10, 0, 0, 255];
            frame[14..34].copy_from_slice(&header);
            frame[24..26].copy_from_slice(&checksum(&header).to_be_bytes());
            frame[34..42].copy_from_slice(&[0x55, 0xD2, 0x55, 0xD2, 0, 26, 0, 0]);
            frame[42..46].copy_from_slice(b"CARp");
        }
        world.switch.borrow_mut().send(world.now, noise.port, &frame);
        world.run(Duration::from_millis(1));
    }
    assert_eq!((world.vehicles[0].left(), world.manager().left.len()), (0, 0));
    talk(&mut world);
    assert_eq!(world.switch.borrow().counts().of(Fault::BadLength), 0);
    let node = &world.vehicles[0].unit.node().counters;
    let dropped: u64 = node.iter().map(|(_, value)| value).sum();
    assert!(dropped > 100, "hardly any junk came through: {node:?}");
}

/// The check sum of an IPv4 header.
fn checksum(header: &[u8]) -> u16 {
    let sum: u32 = header.chunks(2).map(|pair| u32::from(pair[0]) << 8 | u32::from(pair[1])).sum();
    !((sum & 0xFFFF) + (sum >> 16)) as u16
}
