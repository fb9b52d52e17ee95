//! Options that all examples have.

use anyhow::Result;
use cara_std::keys::{FleetKeys, KeyRing, parse_node};
use cara_std::{Builder, Fleet, Interfaces};
use clap::Args;

/// Where a unit looks for others.
#[derive(Args, Clone, Copy, Debug)]
pub struct Network {
    /// Units of different fleets do not meet.
    #[arg(long, global = true, default_value_t = 0)]
    pub fleet: u32,
    /// Use loopback only.
    #[arg(long, global = true)]
    pub loopback: bool,
    /// Plain mode, without keys: any host on the network can read what the unit sends, and speak as any unit.
    #[arg(long, global = true)]
    pub insecure: bool,
    /// End when standard input is closed, so that the program does not outlive its parent.
    #[arg(long, global = true)]
    pub attended: bool,
}

impl Network {
    /// A unit where the options say; without them, where the environment says. Unless told, it has the keys that are found
    /// for it.
    pub fn place<R>(&self, builder: Builder<(), R>) -> Builder<(), R> {
        let interfaces = if self.loopback { Interfaces::Loopback } else { Interfaces::from_environment() };
        let builder = builder.fleet(self.fleet).interfaces(interfaces);
        if self.insecure { builder.insecure() } else { builder }
    }

    /// The same for a unit whose keys were drawn in this process.
    pub fn place_with<R>(&self, builder: Builder<(), R>, ring: KeyRing) -> Builder<(), R> {
        let builder = self.place(builder);
        if self.insecure { builder } else { builder.keys(ring) }
    }

    /// Draws keys for nodes that are all in this process, so that they need no key files.
    pub fn draw_keys(&self, nodes: &[&str]) -> Result<FleetKeys> {
        let mut keys = FleetKeys::draw(Fleet(self.fleet))?;
        for node in nodes {
            keys.add(&parse_node(node).map_err(anyhow::Error::msg)?, &[])?;
        }
        Ok(keys)
    }
}
