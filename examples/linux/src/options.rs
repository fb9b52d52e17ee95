//! Options that all examples have.

use std::str::FromStr;

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

/// A unit's name and ID number, written as `AGV_manager/1`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NameAndId {
    /// The name.
    pub name: String,
    /// The ID number.
    pub id: u32,
}

impl FromStr for NameAndId {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (name, id) = text.rsplit_once('/').ok_or("write NAME/ID, as in AGV_manager/1")?;
        let id = id.parse().map_err(|_| "the ID behind the slash is a number from 0 to 4294967295")?;
        Ok(Self { name: name.to_owned(), id })
    }
}

#[cfg(test)]
mod tests {
    use super::NameAndId;

    #[test]
    fn a_name_and_an_id_are_told_apart() {
        assert_eq!("a/b/7".parse(), Ok(NameAndId { name: "a/b".into(), id: 7 }));
        assert!("agv".parse::<NameAndId>().is_err());
        assert!("agv/x".parse::<NameAndId>().is_err());
    }
}
