//! What tests of several modules share: patience, and two units on loopback.

use std::hash::{BuildHasher, Hasher, RandomState};
use std::sync::Arc;
use std::time::{Duration, Instant};

use cara_core::config::Constraints;

use crate::engine::link::LinkCell;
use crate::{CommunicationSystem, Interfaces, Peer, Unit};

/// Waits until `condition` holds.
#[track_caller]
pub(crate) fn until(condition: impl Fn() -> bool) {
    let end = Instant::now() + Duration::from_secs(20);
    while !condition() {
        assert!(Instant::now() < end, "not in time");
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// A fleet of its own, so that tests on one machine do not meet.
pub(crate) fn fleet() -> u32 {
    RandomState::new().build_hasher().finish() as u32
}

/// A manager in plain mode, started.
pub(crate) fn manager(fleet: u32, constraints: Constraints) -> CommunicationSystem {
    let manager = CommunicationSystem::builder("manager", 1).unwrap().interfaces(Interfaces::Loopback);
    let manager = manager.fleet(fleet).constraints(constraints).insecure().build().unwrap();
    manager.start().unwrap();
    manager
}

/// A vehicle of that manager, not started.
pub(crate) fn vehicle(fleet: u32, id: u32, constraints: Constraints) -> Unit {
    let unit = Unit::builder("agv", id, "manager", 1).unwrap().interfaces(Interfaces::Loopback);
    unit.fleet(fleet).constraints(constraints).insecure().build().unwrap()
}

/// A manager and a vehicle that have met.
pub(crate) struct Pair {
    pub(crate) manager: CommunicationSystem,
    pub(crate) agv: Unit,
    pub(crate) peer: Peer,
}

impl Pair {
    /// The vehicle offers what `offer` adds to it.
    pub(crate) fn new(constraints: Constraints, offer: impl FnOnce(&Unit)) -> Self {
        let fleet = fleet();
        let (manager, agv) = (manager(fleet, constraints), vehicle(fleet, 1, constraints));
        offer(&agv);
        agv.publish_my_function_list().unwrap();
        agv.start().unwrap();
        until(|| manager.number_of_s_units() == 1);
        let peer = manager.s_unit("agv").unwrap();
        until(|| peer.their_function_list().len() == agv.my_function_list().len());
        until(|| agv.engine().links.all().first().is_some_and(|link| link.peer.get().is_some()));
        Self { manager, agv, peer }
    }

    /// The manager's end of the link.
    pub(crate) fn near(&self) -> Arc<LinkCell> {
        self.manager.engine().links.all().remove(0)
    }

    /// The vehicle's end. As long as its lock is held, the vehicle reads and answers nothing.
    pub(crate) fn far(&self) -> Arc<LinkCell> {
        self.agv.engine().links.all().remove(0)
    }
}
