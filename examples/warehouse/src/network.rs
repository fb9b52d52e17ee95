//! Who is who in the warehouse, and where they look for each other.

use cara_std::keys::FleetKeys;
use cara_std::{Builder, Fleet, Identity, Interfaces};
use clap::Args;

/// The manager's name and ID number.
pub const MANAGER: (&str, u32) = ("warehouse", 1);
/// The mechanic's.
pub const MECHANIC: (&str, u32) = ("mechanic", 2);
/// Of the unit that offers shared places.
pub const PLACES: (&str, u32) = ("places", 3);
/// Of the first vehicle; the others follow.
const FIRST_ID: u32 = 101;
/// Most vehicles.
pub const MOST_VEHICLES: u32 = 1_000;

/// The name of a vehicle, from 1.
pub fn vehicle_name(number: u32) -> String {
    format!("agv-{number}")
}

/// The ID number of a vehicle, from 1.
pub const fn vehicle_id(number: u32) -> u32 {
    FIRST_ID + number - 1
}

/// Where the units of one run meet: on loopback, unless a board is among them, in a fleet of their own, with keys from the folder that `CARA_KEYS` names.
#[derive(Args, Clone, Copy, Debug)]
pub struct Network {
    /// Units of different fleets do not meet.
    #[arg(long)]
    pub fleet: u32,
    /// Also on the machine's other networks, where boards are.
    #[arg(long)]
    pub everywhere: bool,
}

impl Network {
    /// A unit of this run.
    pub fn place<R>(&self, builder: Builder<(), R>) -> Builder<(), R> {
        builder.fleet(self.fleet).interfaces(if self.everywhere { Interfaces::All } else { Interfaces::Loopback })
    }

    /// Draws keys for all units of a run.
    pub fn draw_keys(&self, vehicles: u32) -> anyhow::Result<FleetKeys> {
        let mut keys = FleetKeys::draw(Fleet(self.fleet))?;
        let manager = Identity::m_unit(MANAGER.0, MANAGER.1)?;
        keys.add(&manager, &[])?;
        keys.add(&Identity::m_unit(MECHANIC.0, MECHANIC.1)?, &[])?;
        let vehicles = (1..=vehicles).map(|number| Identity::s_unit(&vehicle_name(number), vehicle_id(number)));
        keys.add_all(&vehicles.collect::<Result<Vec<_>, _>>()?, &[manager])?;
        Ok(keys)
    }
}
