//! Which IPv4 interfaces there are, and where a broadcast on each goes.

use std::io;
use std::net::Ipv4Addr;

/// On which interfaces a unit looks for others.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Interfaces {
    /// Every IPv4 interface that is up, loopback included.
    #[default]
    All,
    /// Loopback only: what arrives from elsewhere is not even read. For tests and demonstrations.
    Loopback,
}

impl Interfaces {
    /// What the environment variable `CARA_INTERFACES` says: `lo` for [`Self::Loopback`], anything else for all.
    pub fn from_environment() -> Self {
        match std::env::var_os("CARA_INTERFACES") {
            None => Self::All,
            Some(value) if value.is_empty() || value == "all" => Self::All,
            Some(value) if value == "lo" => Self::Loopback,
            Some(value) => {
                tracing::warn!(?value, "CARA_INTERFACES is neither `lo` nor `all`: loopback alone is used");
                Self::Loopback
            }
        }
    }

    /// The address to bind to, so that only these interfaces reach the socket.
    pub const fn bind_address(self) -> Ipv4Addr {
        match self {
            Self::All => Ipv4Addr::UNSPECIFIED,
            Self::Loopback => Ipv4Addr::LOCALHOST,
        }
    }

    /// Whether a datagram from `source` may be looked at.
    pub const fn accept(self, source: Ipv4Addr) -> bool {
        match self {
            Self::All => true,
            Self::Loopback => source.is_loopback(),
        }
    }
}

/// One IPv4 address of an interface.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interface {
    /// The system's name of the interface, such as `eth0`.
    pub name: String,
    /// The unit's own address there.
    pub address: Ipv4Addr,
    /// Where a broadcast to all nodes there goes; `None` for point-to-point links, which have none.
    pub broadcast: Option<Ipv4Addr>,
    /// Whether the interface is up and has a carrier.
    pub up: bool,
}

impl Interface {
    /// Whether broadcasts can go out here.
    pub const fn is_usable(&self) -> bool {
        self.up && self.broadcast.is_some()
    }
}

/// All IPv4 addresses of all interfaces, those that are down included.
pub fn interfaces() -> io::Result<Vec<Interface>> {
    let found = if_addrs::get_if_addrs()?;
    Ok(found.into_iter().filter_map(interface).collect())
}

fn interface(found: if_addrs::Interface) -> Option<Interface> {
    let up = found.is_oper_up();
    let if_addrs::IfAddr::V4(v4) = found.addr else { return None };
    let broadcast = match (v4.ip.is_loopback(), found.is_p2p) {
        // The system gives none for loopback, yet it carries them.
        (true, _) => Some(directed_broadcast(v4.ip, v4.netmask)),
        (_, true) => None,
        _ if v4.prefixlen >= 31 => None,
        _ => Some(v4.broadcast.unwrap_or_else(|| directed_broadcast(v4.ip, v4.netmask))),
    };
    Some(Interface { name: found.name, address: v4.ip, broadcast, up })
}

fn directed_broadcast(address: Ipv4Addr, netmask: Ipv4Addr) -> Ipv4Addr {
    Ipv4Addr::from_bits(address.to_bits() | !netmask.to_bits())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loopback_is_found_up_and_with_its_broadcast_address() {
        let all = interfaces().unwrap();
        let loopback = all.iter().find(|interface| interface.address == Ipv4Addr::LOCALHOST).unwrap();
        assert!(loopback.up, "{all:?}");
        assert_eq!(loopback.broadcast, Some(Ipv4Addr::new(127, 255, 255, 255)));
    }

    #[test]
    fn the_broadcast_address_has_all_host_bits_set() {
        let broadcast = |address: [u8; 4], mask: [u8; 4]| directed_broadcast(address.into(), mask.into()).octets();
        assert_eq!(broadcast([192, 168, 3, 7], [255, 255, 255, 0]), [192, 168, 3, 255]);
        assert_eq!(broadcast([10, 1, 2, 3], [255, 255, 240, 0]), [10, 1, 15, 255]);
    }

    #[test]
    fn loopback_only_takes_nothing_from_elsewhere() {
        assert!(Interfaces::Loopback.accept(Ipv4Addr::LOCALHOST));
        assert!(!Interfaces::Loopback.accept(Ipv4Addr::new(192, 168, 0, 1)));
        assert!(Interfaces::All.accept(Ipv4Addr::new(192, 168, 0, 1)));
    }
}
