//! Searches of units that are not there, written from docs/wire.md.

use std::net::{Ipv4Addr, UdpSocket};

use cara_secure::mac::Authenticates;
use cara_std::keys::DiscoveryKey;

/// The part of a far host that is a manager: see `namespace`.
pub(crate) const MANAGER: &str = "manager";
/// And that of a vehicle.
pub(crate) const VEHICLE: &str = "vehicle";

/// Bytes of the fleet's code, and of the shortest `WhoHas` with it.
const CODE: usize = 16;
const LEAST: usize = 128;

/// A `WhoHas` for `boss/1`. All numbers are below 128, and so one byte each.
pub(crate) struct Search {
    version: u8,
    fleet: u32,
    port: u16,
    name: &'static str,
    id: u8,
    epoch: u8,
    role: u8,
    key: DiscoveryKey,
    /// A unit sends from one port for all its life.
    socket: UdpSocket,
}

impl Search {
    pub(crate) fn new(fleet: u32, port: u16, key: DiscoveryKey, name: &'static str, id: u8, epoch: u8) -> Self {
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        socket.set_broadcast(true).unwrap();
        Self { version: 2, fleet, port, name, id, epoch, role: 1, key, socket }
    }

    /// An m_unit's: with the name of `boss`, that of a second one that asks for its own identity.
    pub(crate) fn of_m_unit(self) -> Self {
        Self { role: 0, ..self }
    }

    pub(crate) fn of_version(self, version: u8) -> Self {
        Self { version, ..self }
    }

    /// Broadcasts it.
    pub(crate) fn send(&self) {
        self.socket.send_to(&self.bytes(), (Ipv4Addr::new(127, 255, 255, 255), self.port)).unwrap();
    }

    fn bytes(&self) -> Vec<u8> {
        let (who_has, codes, m_unit_wanted) = (1, 1, b"boss");
        let mut bytes = vec![0x43, 0x41, 0x52, 0x73, self.version, who_has, self.version, codes];
        bytes.extend(self.fleet.to_le_bytes());
        let (sequence, nonce, tcp_port, expected, id_of_boss) = (1, 5, 0, 1, 1);
        let name = self.name.as_bytes();
        bytes.extend(item(1, &[&[self.id, name.len() as u8], name, &[self.role, self.epoch]].concat()));
        bytes.extend(item(2, &[&[m_unit_wanted.len() as u8], &m_unit_wanted[..], &[id_of_boss]].concat()));
        bytes.extend(item(5, &[sequence, nonce, tcp_port, expected]));
        bytes.extend(item(0, &vec![0; LEAST - CODE - bytes.len() - 4]));
        let code: [u8; CODE] = self.key.code(&[&bytes]);
        bytes.extend(code);
        bytes
    }
}

/// Kind, length, body, and zeros up to a multiple of four.
fn item(kind: u16, body: &[u8]) -> Vec<u8> {
    let mut bytes = [&kind.to_le_bytes()[..], &(body.len() as u16).to_le_bytes(), body].concat();
    bytes.resize(bytes.len().next_multiple_of(4), 0);
    bytes
}
