//! How many times something crosses the network from the start of a vehicle to the first call of it. Whatever waits for
//! anything else takes as long on a slow network as on a fast one, so the difference of the two is ways alone.

use super::*;
use cara_core::config::Mode;
use cara_sim::Path;

/// Where managers listen.
const PORT: u16 = 7_000;

/// From the start of a vehicle until its manager can call it, over a network that takes so long for one way.
fn until_callable(seed: u64, mode: Mode, fixed_address: bool, way: Duration) -> Duration {
    let mut world = World::of_mode(seed, mode);
    world.network(|network| network.set_calm(Path::LAN.delay(way)));
    let manager = world.m_unit("manager", 1).start();
    world.run_for(secs(1));
    let agv = world.s_unit("agv", 7);
    let agv = match fixed_address {
        true => agv.joins_at("manager", 1, (manager.address().ip(), PORT).into()),
        false => agv.joins("manager", 1),
    };
    let start = world.now();
    let agv = agv.program(|unit| {
        unit.my_function_list().add_service("go_to()", Service::new(|_, _| Ok(()))).expect("it is the first one");
        unit.publish_my_function_list().expect("it runs");
    });
    let _agv = agv.start();
    assert!(world.run_until(|_| manager.knows("agv", "go_to"), secs(30)), "seed {seed}");
    world.now().since(start)
}

/// How many ways it takes, in tenths. Two ways are a round trip. Pauses of the discovery are drawn, so it is the median.
fn ways(mode: Mode, fixed_address: bool) -> u64 {
    let ways = |seed| {
        let [fast, slow] = [1, 101].map(|way| until_callable(seed, mode, fixed_address, millis(way)).as_micros());
        slow.saturating_sub(fast) / 10_000
    };
    let mut ways: Vec<u64> = (0..21).map(ways).collect();
    ways.sort_unstable();
    ways[10]
}

#[test]
fn a_vehicle_is_called_after_three_and_a_half_round_trips() {
    assert_eq!(
        ways(Mode::Secured, false),
        70,
        "who-has, announce, two of the connection, hello, hello and proof, list"
    );
    assert_eq!(ways(Mode::Plain, false), 70, "who-has, announce, two of the connection, hello, hello, list");
    assert_eq!(ways(Mode::Secured, true), 50, "two of the connection, hello, hello and proof, list");
}
