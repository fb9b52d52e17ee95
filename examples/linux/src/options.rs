//! Options that all examples have.

use std::str::FromStr;

use cara_std::Interfaces;
use clap::Args;

/// Where a unit looks for others.
#[derive(Args, Clone, Copy, Debug)]
pub struct Network {
    /// Units of different fleets do not meet.
    #[arg(long, default_value_t = 0)]
    pub fleet: u32,
    /// Use loopback only.
    #[arg(long)]
    pub loopback: bool,
    /// End when standard input is closed, so that nothing outlives who started it.
    #[arg(long)]
    pub attended: bool,
}

impl Network {
    /// What the options say; without them, what the environment says.
    pub fn interfaces(&self) -> Interfaces {
        if self.loopback { Interfaces::Loopback } else { Interfaces::from_environment() }
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
