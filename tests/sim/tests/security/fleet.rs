//! Wrong keys, no keys, plain against secured, floods: whole fleets on the virtual network.

use cara_core::config::Mode;
use cara_core::distribution::connection_handler::NodeCounter;
use cara_core::distribution::hello::{Hello, Limits};
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::distribution::parameters::Parameters;
use cara_core::error::CloseReason;
use cara_core::host::connections::LinkCounter;
use cara_core::host::frame::{self, Frame};
use cara_core::services::session::RequestOptions;
use cara_core::time::Duration;
use cara_sim::{Crash, HostId, Service, StreamId, UnitEvent, UnitHandle, World};

use super::Tally;

const PORT: u16 = 7_000;

fn secs(secs: u64) -> Duration {
    Duration::from_secs(secs)
}

fn program(unit: &UnitHandle) {
    unit.my_function_list().add_service("stop()", Service::new(|_, _| Ok(()))).expect("room for it");
    unit.publish_my_function_list().expect("it was added");
}

fn address(manager: &UnitHandle) -> std::net::SocketAddr {
    let mut address = manager.address();
    address.set_port(PORT);
    address
}

/// Runs two units for a minute; neither may join the other.
fn stay_apart(tally: &mut Tally, world: &mut World, manager: &UnitHandle, agv: &UnitHandle) {
    world.run_for(secs(60));
    let joined = |unit: &UnitHandle| unit.count(|event| matches!(event, UnitEvent::Joined { .. })) > 0;
    tally.note(joined(manager) || joined(agv));
}

#[test]
fn a_unit_without_the_key_joins_no_manager() {
    let mut tally = Tally::new("units with a wrong key, none, or another fleet's");
    for seed in 0..8 {
        let mut world = World::secured(seed);
        let manager = world.m_unit("depot", 1).program(program).start();
        let to = address(&manager);
        let other_root = world.s_unit("agv", 7).joins_at("depot", 1, to).keys_of_root(3).program(program).start();
        stay_apart(&mut tally, &mut world, &manager, &other_root);
        assert!(manager.counted(LinkCounter::ProofsFailed) > 0);
        let found = world.s_unit("agv", 8).joins("depot", 1).keys_of_root(3).program(program).start();
        stay_apart(&mut tally, &mut world, &manager, &found);
        assert!(manager.node_counted(NodeCounter::DatagramForged) > 0);
        let keyless = world.s_unit("agv", 9).joins_at("depot", 1, to).without_key_for("depot").start();
        stay_apart(&mut tally, &mut world, &manager, &keyless);
        assert!(keyless.node_counted(NodeCounter::RefusedKey) > 0);
        let fleet = world.s_unit("agv", 10).joins_at("depot", 1, to).fleet(5).program(program).start();
        stay_apart(&mut tally, &mut world, &manager, &fleet);
    }
    tally.close();
}

#[test]
fn a_manager_without_a_key_for_a_vehicle_says_so_to_its_operator_only() {
    let mut world = World::secured(1);
    let manager = world.m_unit("depot", 1).without_key_for("agv").start();
    let agv = world.s_unit("agv", 7).joins_at("depot", 1, address(&manager)).start();
    world.run_for(secs(20));
    assert!(manager.node_counted(NodeCounter::RefusedKey) > 0 && manager.counted(LinkCounter::KeysMissing) > 0);
    let reasons = |unit: &UnitHandle, reason| {
        unit.count(|event| matches!(event, UnitEvent::NotJoined { reason: found, .. } if *found == reason))
    };
    assert!(reasons(&agv, CloseReason::Unproven) > 0);
}

#[test]
fn plain_and_secured_units_never_meet() {
    let mut tally = Tally::new("plain against secured");
    for (manager_mode, agv_mode) in [(Mode::Plain, Mode::Secured), (Mode::Secured, Mode::Plain)] {
        for seed in 0..8 {
            let mut world = World::new(seed);
            let manager = world.m_unit("depot", 1).mode(manager_mode).program(program).start();
            let found = world.s_unit("agv", 7).joins("depot", 1).mode(agv_mode).program(program).start();
            let to = address(&manager);
            let dials = world.s_unit("agv", 8).joins_at("depot", 1, to).mode(agv_mode).program(program).start();
            stay_apart(&mut tally, &mut world, &manager, &found);
            stay_apart(&mut tally, &mut world, &manager, &dials);
        }
    }
    tally.close();
}

/// The hello of a vehicle that does not exist, or of one that is connected.
fn hello(id: u32, nonce: u64) -> Vec<u8> {
    let limits = Limits { message_size: 1_024, chunk_size: 1_024, calls: 8, minimum_interval: 0 };
    let hello = Hello {
        versions: cara_core::config::VERSIONS,
        capabilities: 0,
        fleet: Fleet(0),
        identity: Identity::s_unit("agv", id).expect("a name"),
        wanted: Some(cara_core::distribution::hello::Manager::new("depot", 1).expect("a name")),
        epoch: Epoch(nonce),
        claim: None,
        obeyed: None,
        nonce,
        limits,
        link: 0,
        udp_port: 7_001,
        stamp: 0,
        keep_alive: 1_000,
        skipped: 0,
    };
    let (mut bytes, mut framed) = ([0; 300], [0; 320]);
    let length = hello.encode(Mode::Secured, &mut bytes).expect("it fits");
    let length = frame::encode(&Frame::Hello(&bytes[..length]), 0, &mut framed);
    framed[..length].to_vec()
}

/// Opens connections and says hello on each, with the identity of a unit that is connected every other time.
fn flood(world: &mut World, host: HostId, to: std::net::SocketAddr, round: u64) -> Vec<StreamId> {
    let streams: Vec<_> = (0..8).map(|_| world.network(|network| network.connect(host, to))).collect();
    world.run_for(Duration::from_millis(5));
    for (number, stream) in streams.iter().enumerate() {
        let says = hello(if number % 2 == 0 { 7 } else { 1_000 }, round * 100 + number as u64);
        let _ = world.network(|network| network.write(*stream, &[&says]));
    }
    streams
}

/// Rounds of a flood before another vehicle comes, behind its joining, and of all of it at least and at most.
const ROUNDS_BEFORE: u64 = 50;
const ROUNDS_BEHIND: u64 = 50;
const ROUNDS: std::ops::Range<u64> = 200..4_000;

/// A call of a vehicle that is connected, with a deadline.
fn call_in_time(world: &mut World, manager: &UnitHandle, agv: &UnitHandle) -> bool {
    let options = RequestOptions { timeout: Some(Duration::from_millis(50)), ..RequestOptions::default() };
    let mut parameters = Parameters::<64>::sized();
    world.block_on(manager.block_request_with(agv, "stop", &mut parameters, options)) == Ok(())
}

/// What a flood must not cause: a join without a proof, a loss, or a challenge of a live link.
fn harmed(manager: &UnitHandle) -> bool {
    let strange = |event: &UnitEvent| matches!(event, UnitEvent::Joined { peer } if peer.id() == 1_000);
    manager.count(strange) > 0
        || manager.count(|event| matches!(event, UnitEvent::Left { .. })) > 0
        || manager.node_counted(NodeCounter::Challenged) > 0
}

/// Calls to a connected vehicle keep their deadline, and another vehicle joins, while an attacker opens link after
/// link: the flood goes on until it has joined, and some rounds more.
#[test]
fn a_flood_of_half_open_links_keeps_nobody_out() {
    let mut tally = Tally::new("half-open links of a flood");
    for seed in 0..4 {
        let mut world = World::secured(seed);
        let manager = world.m_unit("depot", 1).start();
        let agv = world.s_unit("agv", 7).joins("depot", 1).program(program).start();
        assert!(world.run_until(|_| manager.knows(&agv, "stop"), secs(20)));
        let late = world.s_unit("agv", 8).joins("depot", 1).program(program).start();
        world.crash(&late, Crash::PowerCut);
        let attacker = world.network(|network| network.add_host());
        let to = address(&manager);
        let mut joined = None;
        for round in 0..ROUNDS.end {
            let streams = flood(&mut world, attacker, to, round);
            if round == ROUNDS_BEFORE {
                world.restart(&late);
            }
            let came_to_something = !call_in_time(&mut world, &manager, &agv) || harmed(&manager);
            for stream in streams {
                tally.note(came_to_something);
                world.network(|network| {
                    if network.is_open(stream) && round % 3 == 0 {
                        network.close(stream)
                    }
                });
            }
            if round > ROUNDS_BEFORE && manager.knows(&late, "stop") {
                joined.get_or_insert(round);
            }
            if round + 1 >= ROUNDS.start && joined.is_some_and(|joined| round >= joined + ROUNDS_BEHIND) {
                break;
            }
        }
        assert!(joined.is_some(), "nobody joins during a flood, seed {seed}");
        assert!(manager.node_counted(NodeCounter::GaveWay) > 0);
    }
    tally.close();
}
