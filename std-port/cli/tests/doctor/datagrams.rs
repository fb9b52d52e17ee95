//! Searches of units that are not there, written from docs/wire.md.

use std::net::{Ipv4Addr, UdpSocket};

use cara_secure::mac::Authenticates;
use cara_std::keys::DiscoveryKey;

/// The part of a far host that is a manager: see `namespace`.
pub(crate) const MANAGER: &str = "manager";

/// Bytes of the fleet's code, and of the shortest `WhoHas` with it.
const CODE: usize = 16;
const LEAST: usize = 120;

/// A `WhoHas` for `boss/1`. All numbers are below 128, and so one byte each.
pub(crate) struct Search {
    version: u8,
    fleet: u32,
    port: u16,
    name: &'static str,
    id: u8,
    epoch: u8,
    key: DiscoveryKey,
    /// A unit sends from one port for all its life.
    socket: UdpSocket,
}

impl Search {
    pub(crate) fn new(fleet: u32, port: u16, key: DiscoveryKey, name: &'static str, id: u8, epoch: u8) -> Self {
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).unwrap();
        socket.set_broadcast(true).unwrap();
        Self { version: 1, fleet, port, name, id, epoch, key, socket }
    }

    pub(crate) fn of_version(self, version: u8) -> Self {
        Self { version, ..self }
    }

    /// Broadcasts it.
    pub(crate) fn send(&self) {
        self.socket.send_to(&self.bytes(), (Ipv4Addr::new(127, 255, 255, 255), self.port)).unwrap();
    }

    fn bytes(&self) -> Vec<u8> {
        let mut bytes = vec![0x43, 0x41, 0x52, 0x73, self.version, 1, 0, 0];
        bytes.extend(self.fleet.to_le_bytes());
        bytes.extend([self.id, self.name.len() as u8]);
        bytes.extend(self.name.bytes());
        let (s_unit, sequence, nonce) = (1, 1, 5);
        bytes.extend([s_unit, self.epoch, sequence, nonce]);
        bytes.extend([1, 4]);
        bytes.extend(b"boss");
        let (id_of_boss, tcp_port, expected, known) = (1, 0, 1, 0);
        bytes.extend([id_of_boss, tcp_port, expected, known]);
        bytes.resize(LEAST - CODE, 0);
        let code: [u8; CODE] = self.key.code(&[&bytes]);
        bytes.extend(code);
        bytes
    }
}
