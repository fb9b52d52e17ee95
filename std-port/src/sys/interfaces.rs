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
    /// Why the system did not take the last broadcast here.
    pub refused: Option<io::ErrorKind>,
}

impl Interface {
    /// Whether broadcasts can go out here.
    pub(crate) const fn is_usable(&self) -> bool {
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
    // The system's own value is not used: without one, getifaddrs shows the interface's address in its place, and scripts
    // set any other. Each kernel takes the address with all host bits set as a broadcast.
    let broadcast = directed_broadcast(v4.ip, v4.netmask).filter(|_| v4.ip.is_loopback() || !found.is_p2p);
    Some(Interface { name: found.name, address: v4.ip, broadcast, up, refused: None })
}

/// The address with all host bits set; `None` for a network of one or two addresses, which has none.
fn directed_broadcast(address: Ipv4Addr, netmask: Ipv4Addr) -> Option<Ipv4Addr> {
    let host = !netmask.to_bits();
    (host > 1).then(|| Ipv4Addr::from_bits(address.to_bits() | host))
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
        let broadcast = |address: [u8; 4], mask: [u8; 4]| directed_broadcast(address.into(), mask.into());
        assert_eq!(broadcast([192, 168, 3, 7], [255, 255, 255, 0]), Some([192, 168, 3, 255].into()));
        assert_eq!(broadcast([10, 1, 2, 3], [255, 255, 240, 0]), Some([10, 1, 15, 255].into()));
        assert_eq!(broadcast([10, 1, 2, 1], [255, 255, 255, 252]), Some([10, 1, 2, 3].into()));
        assert_eq!(broadcast([10, 1, 2, 1], [255, 255, 255, 254]), None);
        assert_eq!(broadcast([10, 1, 2, 1], [255, 255, 255, 255]), None);
    }

    /// As after `ip address add ADDRESS/24 dev NAME`, and with a value that nobody else has.
    #[test]
    fn what_the_system_says_of_broadcasts_is_not_believed() {
        for said in [None, Some([10, 91, 3, 1].into()), Some([10, 91, 3, 77].into()), Some([255; 4].into())] {
            let [address, netmask] = [[10, 91, 3, 1], [255, 255, 255, 0]].map(Ipv4Addr::from);
            let v4 = if_addrs::Ifv4Addr { ip: address, netmask, prefixlen: 24, broadcast: said };
            let found = if_addrs::Interface {
                name: "v0".into(),
                addr: if_addrs::IfAddr::V4(v4),
                index: None,
                oper_status: if_addrs::IfOperStatus::Up,
                is_p2p: false,
            };
            assert_eq!(interface(found).unwrap().broadcast, Some([10, 91, 3, 255].into()), "{said:?}");
        }
    }

    #[test]
    fn loopback_only_takes_nothing_from_elsewhere() {
        assert!(Interfaces::Loopback.accept(Ipv4Addr::LOCALHOST));
        assert!(!Interfaces::Loopback.accept(Ipv4Addr::new(192, 168, 0, 1)));
        assert!(Interfaces::All.accept(Ipv4Addr::new(192, 168, 0, 1)));
    }
}
