//! Hosts: their addresses, ports and limits.

use std::net::{Ipv4Addr, SocketAddr, SocketAddrV4};

use cara_core::time::{Duration, Instant};

use super::{Host, Network};
use crate::event::{HostId, Trace};

/// The UDP port of a host that never asked for another one.
const OWN_PORT: u16 = 40_000;
/// First port that a host dials from.
pub(super) const FIRST_DIAL_PORT: u16 = 50_000;

impl Network {
    /// Adds a host with an address of its own in segment 0, which is on and listens to nothing but datagrams.
    pub fn add_host(&mut self) -> HostId {
        self.add_host_in(0)
    }

    /// Adds a host in a segment. Broadcasts stay inside a segment; all else is routed.
    pub fn add_host_in(&mut self, segment: u8) -> HostId {
        let number = self.hosts.len() as u16 + 1;
        let [high, low] = number.to_be_bytes();
        self.add_host_at(segment, Ipv4Addr::new(10, segment, high, low), OWN_PORT)
    }

    /// Adds a host at an address, which another may have as well (two processes on one machine, told apart by their
    /// ports), with its own UDP port.
    ///
    /// # Panics
    /// With more than 65,000 hosts.
    pub fn add_host_at(&mut self, segment: u8, address: Ipv4Addr, udp_port: u16) -> HostId {
        assert!(self.hosts.len() < 65_000, "a network has at most 65,000 hosts");
        let id = HostId(self.hosts.len() as u16);
        self.hosts.push(Host {
            address,
            segment,
            power: true,
            running: true,
            plugged: true,
            cable: id,
            life: 0,
            suspended: Instant::START,
            ahead: Duration::ZERO,
            udp_port,
            listeners: Vec::new(),
            accept_limit: usize::MAX,
            dial_port: FIRST_DIAL_PORT,
            streams: Vec::new(),
            send_buffer: 8 * 1024,
            receive_window: 64 * 1024,
            answers_strays: true,
            trace: Trace::new(),
        });
        self.by_address.entry(address).or_default().push(id);
        id
    }

    /// Its clock is so far ahead of the virtual time, by which everything here goes; zero at first.
    pub fn set_clock(&mut self, host: HostId, ahead: Duration) {
        self.host_mut(host).ahead = ahead;
    }

    /// What the clock of a host shows.
    pub fn clock(&self, host: HostId) -> Instant {
        self.now + self.host(host).ahead
    }

    /// The virtual time at which the clock of a host shows this.
    pub fn time_of(&self, host: HostId, clock: Instant) -> Instant {
        match clock {
            Instant::FAR_FUTURE => clock,
            _ => Instant::START + clock.since(Instant::START + self.host(host).ahead),
        }
    }

    /// All hosts in the order of adding.
    pub fn hosts(&self) -> impl Iterator<Item = HostId> + use<> {
        (0..self.hosts.len() as u16).map(HostId)
    }

    /// The host's address with its own UDP port.
    pub fn address(&self, host: HostId) -> SocketAddr {
        let host = self.host(host);
        SocketAddrV4::new(host.address, host.udp_port).into()
    }

    /// The host's own UDP port from now on; datagrams to the discovery port reach it as well.
    pub fn bind(&mut self, host: HostId, udp_port: u16) {
        self.host_mut(host).udp_port = udp_port;
    }

    /// Takes streams dialled to this port.
    pub fn listen(&mut self, host: HostId, port: u16) {
        let listeners = &mut self.host_mut(host).listeners;
        if !listeners.contains(&port) {
            listeners.push(port);
        }
    }

    /// At most this many streams at a time, dialled ones included; further dials are refused, as on a board whose
    /// sockets are all in use.
    pub fn limit_streams(&mut self, host: HostId, limit: usize) {
        self.host_mut(host).accept_limit = limit;
    }

    /// Bytes that a stream of this host takes before they leave (8 KiB), and bytes that it takes in before they are
    /// read (64 KiB).
    pub fn set_buffers(&mut self, host: HostId, send_buffer: usize, receive_window: usize) {
        let host = self.host_mut(host);
        host.send_buffer = send_buffer.max(1);
        host.receive_window = receive_window.max(1);
    }

    /// Whether the host, once it is back after a power cut, resets streams of its earlier life (on at first); off
    /// for a firewall that drops strays.
    pub fn answer_strays(&mut self, host: HostId, answers: bool) {
        self.host_mut(host).answers_strays = answers;
    }

    /// Whether the host has an interface that is up.
    pub fn is_plugged(&self, host: HostId) -> bool {
        self.host(host).plugged
    }

    /// Whether a process runs on the host.
    pub fn is_running(&self, host: HostId) -> bool {
        self.host(host).running
    }
}
