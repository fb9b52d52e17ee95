//! Settings, as the command line tells them.

use std::io::Read;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Context;
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Fleet, Identity};
use cara_settings::board::Board;
use cara_settings::{Network, Settings, Wifi};

use crate::exit::Ended;
use crate::name_and_id::NameAndId;

/// What the board is told.
#[derive(clap::Args)]
pub(super) struct Told {
    /// The board's name.
    #[arg(long, requires = "id")]
    name: Option<String>,
    /// The board's ID number.
    #[arg(long, requires = "name")]
    id: Option<u32>,
    /// The m_unit that it belongs to. Without one the board is an m_unit itself.
    #[arg(long, value_name = "NAME/ID")]
    manager: Option<NameAndId>,
    /// Where the manager is, for networks on which broadcasts do not pass.
    #[arg(long, value_name = "ADDRESS:PORT")]
    manager_address: Option<SocketAddrV4>,
    /// The board's address: dhcp, or as in 10.0.0.17/24.
    #[arg(long, value_name = "ADDRESS", default_value = "dhcp")]
    address: Address,
    /// Where other networks are reached; only with an address of the board's own.
    #[arg(long, value_name = "ADDRESS")]
    gateway: Option<Ipv4Addr>,
    /// The access point, for a board on Wi-Fi.
    #[arg(long, value_name = "NAME")]
    wifi: Option<String>,
    /// A file with the access point's password, or - for standard input. Without it the access point is open.
    #[arg(long, value_name = "FILE", requires = "wifi")]
    wifi_password_file: Option<PathBuf>,
}

/// How the board gets its address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Address {
    Dhcp,
    Static(Ipv4Addr, u8),
}

impl FromStr for Address {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        const FORM: &str = "write dhcp, or ADDRESS/BITS as in 10.0.0.17/24";
        if text == "dhcp" {
            return Ok(Self::Dhcp);
        }
        let (address, prefix) = text.split_once('/').ok_or(FORM)?;
        let prefix = prefix.parse().ok().filter(|bits| *bits <= 32).ok_or(FORM)?;
        Ok(Self::Static(address.parse().map_err(|_| FORM)?, prefix))
    }
}

impl Told {
    /// Makes settings, or tells what is wrong with them.
    pub(super) fn settings(&self, board: &Board, fleet: u32) -> anyhow::Result<Settings> {
        let (Some(name), Some(id)) = (&self.name, self.id) else {
            return Err(Ended::usage("the board needs a --name and an --id"));
        };
        let manager = self.manager.as_ref().map(manager).transpose()?;
        let identity = match manager {
            Some(_) => Identity::s_unit(name, id),
            None => Identity::m_unit(name, id),
        };
        let settings = Settings {
            identity: identity.map_err(|error| Ended::usage(format!("--name {name}: {error}")))?,
            manager,
            manager_address: self.manager_address,
            fleet: Fleet(fleet),
            network: self.network()?,
            wifi: self.wifi(board)?,
        };
        if settings.is_sound() { Ok(settings) } else { Err(Ended::usage("no unit can be made of these settings")) }
    }

    fn network(&self) -> anyhow::Result<Network> {
        match (self.address, self.gateway) {
            (Address::Dhcp, None) => Ok(Network::Dhcp),
            (Address::Dhcp, Some(_)) => Err(Ended::usage("with --address dhcp the server tells the gateway")),
            (Address::Static(address, prefix), gateway) => Ok(Network::Static { address, prefix, gateway }),
        }
    }

    fn wifi(&self, board: &Board) -> anyhow::Result<Option<Wifi>> {
        let Some(name) = &self.wifi else {
            return match board.wireless {
                true => Err(Ended::usage(format!("{} is on Wi-Fi: name its access point with --wifi", board.name))),
                false => Ok(None),
            };
        };
        if !board.wireless {
            return Err(Ended::usage(format!("{} has no Wi-Fi: leave --wifi away", board.name)));
        }
        let password = self.wifi_password_file.as_deref().map_or(Ok(String::new()), password)?;
        let wifi = Wifi::new(name, &password).map_err(|error| Ended::usage(error.to_string()))?;
        Ok(Some(wifi))
    }
}

fn manager(NameAndId { name, id }: &NameAndId) -> anyhow::Result<Manager> {
    Manager::new(name, *id).map_err(|error| Ended::usage(format!("--manager {name}/{id}: {error}")))
}

/// The first line: passwords on a command line are seen by everybody on the computer.
fn password(file: &Path) -> anyhow::Result<String> {
    let mut text = String::new();
    if file == Path::new("-") {
        std::io::stdin().read_to_string(&mut text).context("cannot read standard input")?;
    } else {
        text = std::fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
    }
    Ok(text.lines().next().unwrap_or_default().to_owned())
}

#[cfg(test)]
mod tests {
    use super::Address;

    #[test]
    fn addresses_are_read() {
        assert_eq!("dhcp".parse(), Ok(Address::Dhcp));
        assert_eq!("10.0.0.17/24".parse(), Ok(Address::Static([10, 0, 0, 17].into(), 24)));
        for wrong in ["", "DHCP", "10.0.0.17", "10.0.0.17/33", "10.0.0/24", "10.0.0.17/-1", "::1/64"] {
            assert!(wrong.parse::<Address>().is_err(), "{wrong}");
        }
    }
}
