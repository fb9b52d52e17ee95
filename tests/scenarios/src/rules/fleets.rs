//! Large fleets: how much they broadcast, and how soon they are together.

use cara_core::distribution::connection_handler::NodeCounter;

use crate::scenario::scenarios;
use crate::{Fault, Spec, Unit, World, millis, secs};

scenarios![
    a_hundred_nodes_meet_within_twenty_broadcasts: "discovery load", Light, [ManyUnits], ["WhoHasSent"];
    a_fleet_returns_after_its_manager_restarts: "manager restart", Light, [Crash, ManyUnits], ["power-cut", "restart"];
];

fn broadcasts(units: &[Unit]) -> u64 {
    let of =
        |unit: &Unit| unit.node_counted(NodeCounter::WhoHasSent) + unit.node_counted(NodeCounter::AnnounceBroadcast);
    units.iter().map(of).sum()
}

fn fleet(world: &mut dyn World, size: u32) -> Vec<Unit> {
    let mut units = vec![world.add(Spec::manager("manager", 1).limits(|limits| limits.maximum_nodes = size as u16))];
    for id in 0..size {
        units.push(world.add(Spec::agv(&format!("agv-{id}"), 10 + id)));
    }
    let manager = units[0].clone();
    world.wait("all have joined", || manager.peers().len() == size as usize, secs(60));
    units
}

fn a_hundred_nodes_meet_within_twenty_broadcasts(world: &mut dyn World) {
    let units = fleet(world, 100);
    world.measured("100 nodes joined", world.now().since(cara_core::time::Instant::START));
    let sent = broadcasts(&units);
    assert!(sent <= 20, "{sent} broadcasts");
}

fn a_fleet_returns_after_its_manager_restarts(world: &mut dyn World) {
    let units = fleet(world, 250);
    let manager = &units[0];
    world.run_for(secs(2));
    let before = broadcasts(&units[1..]);
    world.fault(Fault::PowerCut(manager));
    world.run_for(millis(500));
    world.fault(Fault::Restart(manager));
    let back = world.now();
    world.wait("all are back", || manager.peers().len() == 250, secs(40));
    world.measured("250 nodes back after a restart", world.now().since(back));
    let sent = broadcasts(&units[1..]) - before + broadcasts(&units[..1]);
    assert!(sent <= 60, "{sent} broadcasts");
}
