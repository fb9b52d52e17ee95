//! What fails in the runs that are drawn from seeds, and how long a fleet takes to be well again.

use cara_core::random::Random;
use cara_core::time::Duration;
use cara_sim::{Crash, Direction, UnitHandle, World};

pub(crate) const fn millis(millis: u64) -> Duration {
    Duration::from_millis(millis)
}

pub(crate) fn between(random: &mut Random, least: u64, most: u64) -> Duration {
    millis(least + random.below(most - least))
}

/// What happens to a manager or a vehicle, for a time that is drawn.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Fault {
    ManagerCrashes,
    ManagerHangs,
    /// From some of the others, in one direction or in both.
    ManagerIsCutOff,
    VehicleHangs,
    VehicleCrashes,
}

/// A manager and a vehicle to which something may happen, and how a crash would be.
pub(crate) struct Victims {
    manager: UnitHandle,
    vehicle: UnitHandle,
    crash: Crash,
}

/// Managers and vehicles of which any can fail.
pub(crate) trait Fallible {
    fn world(&mut self) -> &mut World;
    fn managers(&self) -> &[UnitHandle];
    fn vehicles(&self) -> &[UnitHandle];

    /// Lets everybody work for a while.
    fn run(&mut self, span: Duration);

    fn units(&self) -> impl Iterator<Item = &UnitHandle> {
        self.managers().iter().chain(self.vehicles())
    }

    fn victims(&self, random: &mut Random) -> Victims {
        let pick = |random: &mut Random, units: &[UnitHandle]| units[random.below(units.len() as u64) as usize].clone();
        let (manager, vehicle) = (pick(random, self.managers()), pick(random, self.vehicles()));
        let crash = if random.below(2) == 0 { Crash::PowerCut } else { Crash::Process };
        Victims { manager, vehicle, crash }
    }

    fn suffer(&mut self, victims: &Victims, fault: Fault, random: &mut Random) {
        let Victims { manager, vehicle, crash } = victims;
        match fault {
            Fault::ManagerCrashes => {
                let down = between(random, 100, 9_000);
                self.world().network(|network| network.crash_for(manager.host(), *crash, down));
            }
            Fault::ManagerHangs => self.world().suspend(manager, between(random, 100, 9_000)),
            Fault::ManagerIsCutOff => {
                let units = self.units().map(UnitHandle::host);
                let others: Vec<_> = units.filter(|host| *host != manager.host() && random.below(4) > 0).collect();
                let direction = if random.below(2) == 0 { Direction::Both } else { Direction::FirstToSecond };
                let span = between(random, 500, 9_000);
                self.world().network(|network| network.partition_for(&[manager.host()], &others, direction, span));
            }
            Fault::VehicleHangs => self.world().suspend(vehicle, between(random, 20, 5_000)),
            Fault::VehicleCrashes => {
                let down = between(random, 50, 3_000);
                self.world().network(|network| network.crash_for(vehicle.host(), *crash, down));
            }
        }
    }

    /// How long it took, in steps of 50 ms.
    fn until(&mut self, limit: Duration, holds: impl Fn(&Self) -> bool) -> Option<Duration> {
        let start = self.world().now();
        while !holds(self) {
            if self.world().now() >= start + limit {
                return None;
            }
            self.run(millis(50));
        }
        Some(self.world().now().since(start))
    }
}

/// Whether it runs, and does not hang.
pub(crate) fn is_awake(world: &World, unit: &UnitHandle) -> bool {
    unit.is_running() && world.network(|network| network.suspended_until(unit.host())) <= world.now()
}
