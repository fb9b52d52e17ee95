//! Settings of a board in two pages of its flash, so that one image serves all boards of a kind. A board without writable
//! flash gets them as text.
//!
//! [`Settings`] is what a board is provisioned with: identity, manager, network. [`page`] is its layout in flash: two copies,
//! each with a generation and a checksum, so that a power cut while one is written leaves the other. The text form (`FromStr`
//! and `Display`) is for command lines and an emulator's arguments.
//!
//! With the feature `keys`, the module `keys` stores keys after the settings in the same copy, and `boots` is the boot
//! counter, in two pages of its own.
//!
//! [`board`] is the table of boards and the addresses of their pages; [`uf2`] is the
//! [file format](https://github.com/microsoft/uf2) of some boot loaders.
//!
//! The crate drives no flash controller: a board lends the bytes of its pages, and a driver for the boot counter.

#![no_std]

#[cfg(test)]
extern crate std;

pub mod board;
#[cfg(feature = "keys")]
pub mod boots;
#[cfg(feature = "keys")]
pub mod keys;
pub mod page;
mod text;
pub mod uf2;
mod wifi;

use core::net::{Ipv4Addr, SocketAddrV4};

use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::{Fleet, Identity, Role};
use serde::{Deserialize, Serialize};

pub use text::{Field, TextError};
pub use wifi::{Wifi, WifiError};

/// What one board is told.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Settings {
    /// Its identity.
    pub identity: Identity,
    /// The m_unit that it belongs to; none on a board that is an m_unit itself.
    pub manager: Option<Manager>,
    /// Where the manager is, for networks on which broadcasts do not pass.
    pub manager_address: Option<SocketAddrV4>,
    /// The fleet.
    pub fleet: Fleet,
    /// Its address.
    pub network: Network,
    /// The access point, for a board on Wi-Fi. Text never holds it, because its password is secret.
    pub wifi: Option<Wifi>,
    /// Plain mode was an explicit opt-in: the board needs no keys and proves nothing. In flash the layout encodes it.
    #[serde(skip)]
    pub insecure: bool,
}

/// How a board gets its address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Network {
    /// From a server on the network.
    Dhcp,
    /// Always the same one.
    Static {
        /// The address.
        address: Ipv4Addr,
        /// Bits of it that are the network's, at most 32.
        prefix: u8,
        /// Where other networks are reached.
        gateway: Option<Ipv4Addr>,
    },
}

impl Settings {
    /// Whether a unit can be made of them: an s_unit has a manager, an m_unit has none; a name has 1 to 32 bytes; each address is
    /// one that a host can have.
    pub fn is_sound(&self) -> bool {
        let network = match self.network {
            Network::Dhcp => true,
            Network::Static { address, prefix, gateway } => {
                prefix <= 32 && is_of_host(address) && gateway.is_none_or(is_of_host)
            }
        };
        let network = network && self.manager_address.is_none_or(|address| is_of_host(*address.ip()));
        let role = matches!(
            (self.identity.role(), &self.manager),
            (Role::SUnit, Some(manager)) if Manager::new(&manager.name, manager.id).is_ok()
        ) || (self.identity.role() == Role::MUnit && self.manager.is_none());
        let name = Identity::new(self.identity.name(), self.identity.id(), self.identity.role()).is_ok();
        network && role && name && self.wifi.as_ref().is_none_or(Wifi::is_sound)
    }
}

/// Whether one host can have it. The IP stack panics where an interface or a gateway has the address of a group.
pub(crate) const fn is_of_host(address: Ipv4Addr) -> bool {
    // From 224 on they are of groups, or reserved.
    matches!(address.octets(), [1..=126 | 128..=223, ..])
}
