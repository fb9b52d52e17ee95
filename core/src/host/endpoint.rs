//! Addresses, as the port has them: the core compares them and gives them back.

use core::fmt::{Debug, Display};
use core::net::{IpAddr, SocketAddr, SocketAddrV4};

/// Where a unit is reached: a host, and a port of it. The core never looks into one, so a link may be a serial line as
/// well; no address is on the wire.
pub trait Endpoint: Copy + Eq + Debug + Display + 'static {
    /// 0 stands for nowhere.
    fn port(&self) -> u16;
    /// Another port of the same host.
    fn at_port(&self, port: u16) -> Self;
    /// Whether both are of one host.
    fn is_of_host(&self, other: &Self) -> bool;
    /// Whether the host is this one, under an address that each host has: its units are then told apart by their ports.
    fn is_loopback(&self) -> bool;
    /// Tells hosts apart. A collision costs one search more.
    fn host_bits(&self) -> u32;
}

impl Endpoint for SocketAddrV4 {
    fn port(&self) -> u16 {
        self.port()
    }

    fn at_port(&self, port: u16) -> Self {
        Self::new(*self.ip(), port)
    }

    fn is_of_host(&self, other: &Self) -> bool {
        self.ip() == other.ip()
    }

    fn is_loopback(&self) -> bool {
        self.ip().is_loopback()
    }

    fn host_bits(&self) -> u32 {
        u32::from_le_bytes(self.ip().octets())
    }
}

impl Endpoint for SocketAddr {
    fn port(&self) -> u16 {
        self.port()
    }

    fn at_port(&self, port: u16) -> Self {
        Self::new(self.ip(), port)
    }

    fn is_of_host(&self, other: &Self) -> bool {
        self.ip() == other.ip()
    }

    fn is_loopback(&self) -> bool {
        self.ip().is_loopback()
    }

    fn host_bits(&self) -> u32 {
        match self.ip() {
            IpAddr::V4(host) => u32::from_le_bytes(host.octets()),
            IpAddr::V6(host) => host.segments().iter().fold(0, |sum, part| mix(sum ^ u32::from(*part))),
        }
    }
}

/// A hash step.
pub(crate) const fn mix(bits: u32) -> u32 {
    (bits ^ (bits >> 15)).wrapping_mul(0x9E37_79B1)
}
