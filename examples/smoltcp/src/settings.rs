//! Identity and address of the unit.

use core::net::{Ipv4Addr, SocketAddrV4};

use cara_core::config::Constraints;
use cara_core::distribution::connection_handler::{NodeConfig, Target};
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::error::Error;
use smoltcp::wire::Ipv4Cidr;

use crate::resources::{CALLS, DATAGRAM_PORT, MESSAGE_SIZE};

/// Identity and address of the unit.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Name, id, fleet, manager and constraints; see the core.
    pub node: NodeConfig<SocketAddrV4>,
    /// Its address and the length of the network's prefix. Without an address it waits for one:
    /// [`SUnit::set_address`](crate::SUnit::set_address).
    pub address: Option<Ipv4Cidr>,
}

impl Settings {
    /// The settings of an s_unit of fleet 0 with this address; [`Error::BadName`]. `epoch` must differ from boot to
    /// boot, from a true random number or a counter in flash; delays and sequence numbers are drawn from it as well.
    pub fn new(
        name: &str,
        id: u32,
        target: Target<SocketAddrV4>,
        address: [u8; 4],
        prefix: u8,
        epoch: u64,
    ) -> Result<Self, Error> {
        let constraints =
            Constraints { message_size: MESSAGE_SIZE as u32, calls_per_peer: CALLS as u16, ..Constraints::S_UNIT };
        let node = NodeConfig {
            identity: Identity::s_unit(name, id)?,
            fleet: Fleet(0),
            epoch: Epoch(epoch),
            target,
            tcp_port: 0,
            udp_port: DATAGRAM_PORT,
            constraints,
            seed: epoch,
        };
        Ok(Self { node, address: Some(Ipv4Cidr::new(Ipv4Addr::from(address), prefix.min(32))) })
    }
}
