//! Datagrams: to one address, or to every host of a segment; lost, late, doubled or overtaken.

use std::net::{SocketAddr, SocketAddrV4};
use std::sync::Arc;

use cara_core::config::PLAIN_PORT;
use cara_core::time::{Duration, Instant};

use super::{Happening, Host, Network};
use crate::event::{HostId, NetEvent};
use crate::faults::Fault;

/// Longest datagram that the network takes.
const LONGEST_DATAGRAM: usize = 65_507;
/// A datagram that is kept back comes this much later, and up to twice as much.
const KEPT_BACK: Duration = Duration::from_millis(5);

impl Network {
    /// Sends one datagram from the host's own UDP port. `false` when the host or its interface is down, the datagram is too long or
    /// the address is no IPv4 one; `true` says nothing of its arrival.
    pub fn send_to(&mut self, host: HostId, to: SocketAddr, datagram: &[u8]) -> bool {
        let SocketAddr::V4(to) = to else { return false };
        if !self.can_send(host, datagram) {
            return false;
        }
        let wants = |port| move |host: &Host| host.udp_port == port || Self::is_discovery_port(port);
        if let Some(receiver) = self.find(*to.ip(), wants(to.port())) {
            let leaves = self.leave(host, receiver, self.path(host, receiver), datagram.len());
            self.send_datagram(host, receiver, to.port(), &Arc::from(datagram), leaves);
        }
        true
    }

    /// Sends one datagram to the discovery port of every other host of the segment. `false` as for [`Self::send_to`].
    pub fn broadcast(&mut self, host: HostId, datagram: &[u8]) -> bool {
        if !self.can_send(host, datagram) {
            return false;
        }
        let segment = self.host(host).segment;
        if self.quiet_segments.contains(&segment) {
            self.counts.count(Fault::BroadcastDropped);
            return true;
        }
        let bytes: Arc<[u8]> = Arc::from(datagram);
        for receiver in self.hosts() {
            let hears = self.host(receiver).segment == segment && (receiver != host || self.hears_itself);
            if hears {
                let leaves = self.leave(host, receiver, self.path(host, receiver), datagram.len());
                self.send_datagram(host, receiver, PLAIN_PORT, &bytes, leaves);
            }
        }
        true
    }

    /// Whether a host hears its own broadcasts, as on Linux; off at first, as on a board.
    pub fn hear_own_broadcasts(&mut self, hears: bool) {
        self.hears_itself = hears;
    }

    fn can_send(&self, host: HostId, datagram: &[u8]) -> bool {
        let Host { running, plugged, .. } = *self.host(host);
        running && plugged && datagram.len() <= LONGEST_DATAGRAM
    }

    fn send_datagram(&mut self, from_host: HostId, to: HostId, port: u16, bytes: &Arc<[u8]>, leaves: Instant) {
        let path = self.path(from_host, to);
        if self.is_cut(from_host, to) || path.loss.hits(&mut self.random) {
            self.counts.count(Fault::Loss);
            return;
        }
        let twice = path.duplicate.hits(&mut self.random);
        if twice {
            self.counts.count(Fault::Duplicate);
        }
        let sender = self.host(from_host);
        let from = SocketAddrV4::new(sender.address, sender.udp_port);
        for _ in 0..=u8::from(twice) {
            let mut at = self.arrival(leaves, path);
            if path.reorder.hits(&mut self.random) {
                self.counts.count(Fault::Reorder);
                at = at + KEPT_BACK + self.random.jitter(KEPT_BACK);
            }
            self.push(at, Happening::Datagram { from_host, from, to, port, bytes: Arc::clone(bytes) });
        }
    }

    pub(super) fn datagram_arrives(&mut self, from: SocketAddrV4, host: HostId, port: u16, bytes: Arc<[u8]>) {
        let receiver = self.host(host);
        if receiver.running && (receiver.udp_port == port || Self::is_discovery_port(port)) {
            self.ready.push_back(NetEvent::Datagram { host, from: from.into(), port, bytes });
        }
    }
}
