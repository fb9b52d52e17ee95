//! Settings, as the command line tells them.

use std::io::Read;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use anyhow::Context;
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Fleet, Identity, Role};
use cara_settings::board::Board;
use cara_settings::{Network, Settings, Wifi};
use cara_std::keys::{KeyRing, full_name};

use cara_tools::exit::Ended;
use cara_tools::global::Global;
use cara_tools::name_and_id::NameAndId;

/// What the board is told.
#[derive(clap::Args)]
pub(super) struct Given {
    /// The board's name.
    #[arg(long, requires = "id")]
    name: Option<String>,
    /// The board's ID number.
    #[arg(long, requires = "name")]
    id: Option<u32>,
    /// The m_unit that it belongs to. Without one the board is an m_unit itself. Further ones are those that it can be handed over
    /// to, where its image has room for their keys.
    #[arg(long, value_name = "NAME/ID")]
    manager: Vec<NameAndId>,
    /// Where the manager is, for networks on which broadcasts do not pass.
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = address_of_manager)]
    manager_address: Option<SocketAddrV4>,
    /// The board's address: dhcp, or as in 10.0.0.17/24.
    #[arg(long, value_name = "ADDRESS", default_value = "dhcp")]
    address: Address,
    /// Where other networks are reached; only with an address of the board's own.
    #[arg(long, value_name = "ADDRESS", value_parser = host)]
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
        const HOST: &str = "this is no address of a host in its network: write one as in 10.0.0.17/24";
        if text == "dhcp" {
            return Ok(Self::Dhcp);
        }
        let (address, prefix) = text.split_once('/').ok_or(FORM)?;
        let prefix = prefix.parse().ok().filter(|bits| *bits <= 32).ok_or(FORM)?;
        let address = address.parse().map_err(|_| FORM)?;
        if is_of_host(address) && !names_network(address, prefix) {
            Ok(Self::Static(address, prefix))
        } else {
            Err(HOST)
        }
    }
}

/// Whether one host can have it.
fn is_of_host(address: Ipv4Addr) -> bool {
    let [first, ..] = address.octets();
    // From 224 on they are of groups, or reserved.
    (1..224).contains(&first) && !address.is_loopback()
}

/// Whether it means the network itself, or all hosts in it. Networks of two addresses and of one have no such ones.
fn names_network(address: Ipv4Addr, prefix: u8) -> bool {
    let hosts = u32::MAX.checked_shr(prefix.into()).unwrap_or(0);
    let host = address.to_bits() & hosts;
    prefix < 31 && (host == 0 || host == hosts)
}

/// Whether a gateway is another host of the network. In a network of one address none is: it is behind that.
fn is_reached(gateway: Ipv4Addr, address: Ipv4Addr, prefix: u8) -> bool {
    let hosts = u32::MAX.checked_shr(prefix.into()).unwrap_or(0);
    let same_network = prefix == 32 || (gateway.to_bits() ^ address.to_bits()) & !hosts == 0;
    same_network && gateway != address && !names_network(gateway, prefix)
}

fn host(text: &str) -> Result<Ipv4Addr, &'static str> {
    let address = text.parse().map_err(|_| "write an IPv4 address as in 10.0.0.1")?;
    if is_of_host(address) { Ok(address) } else { Err("this is no host's address: write one as in 10.0.0.1") }
}

fn address_of_manager(text: &str) -> Result<SocketAddrV4, &'static str> {
    let address: SocketAddrV4 = text.parse().map_err(|_| "write ADDRESS:PORT as in 10.0.0.1:7000")?;
    host(&address.ip().to_string())?;
    if address.port() == 0 { Err("port 0 is no port: write the manager's `tcp_port`") } else { Ok(address) }
}

impl Given {
    /// Makes settings, or tells what is wrong with them. What is not said comes from the board's keys.
    pub(super) fn settings(&self, board: &Board, global: &Global, ring: Option<&KeyRing>) -> anyhow::Result<Settings> {
        if global.insecure && ring.is_some() {
            return Err(Ended::usage("a board in plain mode has no keys: say either --keys or --insecure"));
        }
        let managers = self.managers(ring)?;
        if ring.is_none() && managers.len() > 1 {
            return Err(Ended::usage("a board is handed over with keys only: give its --keys, or one --manager"));
        }
        let identity = self.identity(!managers.is_empty(), ring)?;
        let fleet = global.fleet.map(Fleet).or(ring.map(KeyRing::fleet)).unwrap_or(Fleet(0));
        ring.map_or(Ok(()), |ring| agree(ring, &identity, fleet, &managers))?;
        let manager = managers.first().map(|first| Manager::new(first.name(), first.id()));
        let settings = Settings {
            identity,
            manager: manager.transpose().map_err(|error| Ended::usage(error.to_string()))?,
            manager_address: self.manager_address,
            fleet,
            network: self.network()?,
            wifi: self.wifi(board)?,
            insecure: global.insecure,
        };
        if settings.is_sound() { Ok(settings) } else { Err(Ended::usage("no unit can be made of these settings")) }
    }

    fn identity(&self, has_manager: bool, ring: Option<&KeyRing>) -> anyhow::Result<Identity> {
        let (name, id) = match (&self.name, self.id, ring) {
            (Some(name), Some(id), _) => (name, id),
            (_, _, Some(ring)) => return Ok(ring.identity().clone()),
            _ => return Err(Ended::usage("the board needs a --name and an --id, or the --keys of a node")),
        };
        let role = if has_manager { Role::SUnit } else { Role::MUnit };
        Identity::new(name, id, role).map_err(|error| Ended::usage(format!("--name {name}: {error}")))
    }

    /// Its manager, and those that it can be handed over to.
    pub(super) fn managers(&self, ring: Option<&KeyRing>) -> anyhow::Result<Vec<Identity>> {
        if self.manager.is_empty() {
            let vehicle = ring.filter(|ring| ring.identity().role() == Role::SUnit);
            return Ok(vehicle.map(manager_of).transpose()?.into_iter().collect());
        }
        let identity = |NameAndId { name, id }: &NameAndId| {
            Identity::m_unit(name, *id).map_err(|error| Ended::usage(format!("--manager {name}/{id}: {error}")))
        };
        self.manager.iter().map(identity).collect()
    }

    fn network(&self) -> anyhow::Result<Network> {
        match (self.address, self.gateway) {
            (Address::Dhcp, None) => Ok(Network::Dhcp),
            (Address::Dhcp, Some(_)) => Err(Ended::usage("with --address dhcp the server tells the gateway")),
            (Address::Static(address, prefix), Some(gateway)) if !is_reached(gateway, address, prefix) => {
                Err(Ended::usage(format!("--gateway {gateway} is no other host of the network of {address}/{prefix}")))
            }
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

/// The only m_unit that a vehicle has keys with.
fn manager_of(ring: &KeyRing) -> anyhow::Result<Identity> {
    match ring.peers().as_slice() {
        [only] => Ok((*only).clone()),
        [] => Err(Ended::usage(format!(
            "{} has keys for no peer: give it an m_unit with `cara keys derive`",
            full_name(ring.identity())
        ))),
        several => {
            let names: Vec<_> = several.iter().map(|peer| format!("--manager {peer}")).collect();
            Err(Ended::usage(format!("{} has several m_units: say {}", ring.identity(), names.join(" or "))))
        }
    }
}

/// Keys are of no use to another unit than theirs, and without those with its managers.
fn agree(ring: &KeyRing, identity: &Identity, fleet: Fleet, managers: &[Identity]) -> anyhow::Result<()> {
    if (ring.identity(), ring.fleet()) != (identity, fleet) {
        let (found, wanted) = (full_name(ring.identity()), full_name(identity));
        let text = format!(
            "--keys are those of {found} in fleet {}, and the board would be {wanted} in fleet {}: leave --name, --id and \
             --fleet away, or give its own file",
            ring.fleet().0,
            fleet.0
        );
        return Err(Ended::usage(text));
    }
    let Some(manager) = managers.iter().find(|manager| ring.pair(manager).is_none()) else { return Ok(()) };
    let (node, fleet) = (full_name(identity), fleet.0);
    let command = format!("cara keys derive --fleet {fleet} {node} --manager {manager}");
    Err(Ended::usage(format!("{node} has no key with {manager}: `{command}`")))
}

/// The first line: every user of the computer can see passwords on a command line.
fn password(file: &Path) -> anyhow::Result<String> {
    let mut text = String::new();
    if file == Path::new("-") {
        std::io::stdin().read_to_string(&mut text).context("cannot read standard input")?;
    } else {
        text = std::fs::read_to_string(file).with_context(|| format!("cannot read {}", file.display()))?;
    }
    match text.lines().next().unwrap_or_default() {
        "" => {
            let text = format!(
                "{} has no password in its first line: for an open access point leave --wifi-password-file away",
                file.display()
            );
            Err(Ended::usage(text))
        }
        password => Ok(password.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::{Address, address_of_manager, is_reached};

    #[test]
    fn addresses_are_read() {
        assert_eq!("dhcp".parse(), Ok(Address::Dhcp));
        assert_eq!("10.0.0.17/24".parse(), Ok(Address::Static([10, 0, 0, 17].into(), 24)));
        for wrong in ["", "DHCP", "10.0.0.17", "10.0.0.17/33", "10.0.0/24", "10.0.0.17/-1", "::1/64"] {
            assert!(wrong.parse::<Address>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_gateway_is_another_host_of_the_network() {
        let is_reached = |gateway: [u8; 4], prefix| is_reached(gateway.into(), [10, 0, 0, 17].into(), prefix);
        for (gateway, prefix) in [([10, 0, 0, 1], 24), ([10, 0, 9, 1], 16), ([10, 0, 0, 16], 31), ([10, 0, 1, 1], 32)] {
            assert!(is_reached(gateway, prefix), "{gateway:?}/{prefix}");
        }
        for (gateway, prefix) in
            [([10, 0, 1, 1], 24), ([10, 0, 0, 17], 24), ([10, 0, 0, 255], 24), ([10, 0, 0, 18], 31)]
        {
            assert!(!is_reached(gateway, prefix), "{gateway:?}/{prefix}");
        }
    }

    #[test]
    fn a_managers_address_is_one_that_can_be_dialled() {
        assert!(address_of_manager("10.0.0.1:7000").is_ok());
        for wrong in ["10.0.0.1:0", "10.0.0.1", "0.0.0.0:7000", "255.255.255.255:7000", "127.0.0.1:7000", "[::1]:7000"]
        {
            assert!(address_of_manager(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn an_address_is_one_of_a_host() {
        for right in ["10.0.0.1/24", "10.0.0.254/24", "10.0.1.0/16", "192.168.0.0/31", "10.0.0.255/32", "10.0.0.17/0"] {
            assert!(right.parse::<Address>().is_ok(), "{right}");
        }
        let wrong = ["255.255.255.255/24", "0.0.0.0/24", "224.0.0.1/4", "127.0.0.1/8", "10.0.0.0/24", "10.0.0.255/24"];
        for wrong in wrong {
            assert!(wrong.parse::<Address>().is_err(), "{wrong}");
        }
    }
}
