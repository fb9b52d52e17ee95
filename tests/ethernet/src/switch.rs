//! The switch: which ports get a frame, when, and with which faults.

use std::fmt;

use cara_core::random::Random;
use cara_core::time::Instant;

use crate::port::Port;
use crate::{Fault, FaultCounts, Faults};

/// Two addresses and a type.
const HEADER: usize = 14;
/// The header and 1,500 bytes.
const LONGEST: usize = 1_514;

/// An Ethernet address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Mac(pub [u8; 6]);

impl Mac {
    /// Of all ports.
    pub const BROADCAST: Self = Self([0xFF; 6]);

    /// Meant for more than one port.
    pub const fn is_group(self) -> bool {
        self.0[0] & 1 == 1
    }
}

impl fmt::Display for Mac {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [a, b, c, d, e, g] = self.0;
        write!(f, "{a:02x}:{b:02x}:{c:02x}:{d:02x}:{e:02x}:{g:02x}")
    }
}

/// One port of a [`Switch`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct PortId(usize);

/// An Ethernet switch in memory. It knows which address is behind which port from the beginning, so it floods nothing
/// but broadcasts and multicasts; a frame to an address that no port has goes nowhere.
pub struct Switch {
    ports: Vec<Port>,
    faults: Faults,
    random: Random,
    sequence: u64,
    frames: u64,
    counts: FaultCounts,
}

impl Switch {
    /// A switch without ports whose faults are drawn from `seed`.
    pub fn new(seed: u64) -> Self {
        Self {
            ports: Vec::new(),
            faults: Faults::NONE,
            random: Random::new(seed),
            sequence: 0,
            frames: 0,
            counts: FaultCounts::default(),
        }
    }

    /// Another port, with its cable plugged in.
    pub fn add_port(&mut self, mac: Mac) -> PortId {
        self.ports.push(Port::new(mac, self.faults));
        PortId(self.ports.len() - 1)
    }

    /// Sets the faults of all frames from now on.
    pub fn set_faults(&mut self, faults: Faults) {
        self.faults = faults;
        self.ports.iter_mut().for_each(|port| port.faults = faults);
    }

    /// What happens from now on to the frames that `port` sends: a fault in one direction.
    pub fn set_faults_from(&mut self, port: PortId, faults: Faults) {
        self.ports[port.0].faults = faults;
    }

    /// Pulls the cable of `port`, which loses what is on its way to it, or plugs it in.
    pub fn set_link(&mut self, port: PortId, up: bool) {
        let port = &mut self.ports[port.0];
        port.up = up;
        if !up {
            (0..port.clear()).for_each(|_| self.counts.count(Fault::LinkDown));
        }
    }

    /// Whether the cable of `port` is plugged in: what its device would say.
    pub fn is_up(&self, port: PortId) -> bool {
        self.ports[port.0].up
    }

    /// `port` sends a frame: destination, source, type, payload; no check sum.
    pub fn send(&mut self, now: Instant, port: PortId, frame: &[u8]) {
        self.frames += 1;
        let Some(destination) = frame.first_chunk().filter(|_| (HEADER..=LONGEST).contains(&frame.len())) else {
            return self.counts.count(Fault::BadLength);
        };
        if !self.ports[port.0].up {
            return self.counts.count(Fault::LinkDown);
        }
        let sent = self.ports[port.0].transmit(now, frame.len());
        if sent > now {
            self.counts.count(Fault::Bandwidth);
        }
        let destination = Mac(*destination);
        for index in 0..self.ports.len() {
            if index != port.0 && (destination.is_group() || destination == self.ports[index].mac) {
                self.carry(sent, self.ports[port.0].faults, index, frame);
            }
        }
    }

    /// The next frame that has arrived at `port` by `now`.
    pub fn receive(&mut self, now: Instant, port: PortId) -> Option<Vec<u8>> {
        self.ports[port.0].take(now)
    }

    /// When the next frame arrives at `port`, which may be in the past.
    pub fn next_arrival(&self, port: PortId) -> Option<Instant> {
        self.ports[port.0].next_arrival()
    }

    /// When the next frame arrives anywhere, which may be in the past if a port has not taken it.
    pub fn next_event(&self) -> Option<Instant> {
        self.ports.iter().filter_map(Port::next_arrival).min()
    }

    /// What happened to frames so far.
    pub fn counts(&self) -> &FaultCounts {
        &self.counts
    }

    /// How many frames were sent so far.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    fn carry(&mut self, sent: Instant, faults: Faults, to: usize, frame: &[u8]) {
        if !self.ports[to].up {
            return self.counts.count(Fault::LinkDown);
        }
        if self.happens(faults.loss) {
            return self.counts.count(Fault::Loss);
        }
        self.deliver(sent, faults, to, frame);
        if self.happens(faults.duplication) {
            self.counts.count(Fault::Duplicate);
            self.deliver(sent, faults, to, frame);
        }
    }

    fn deliver(&mut self, sent: Instant, faults: Faults, to: usize, frame: &[u8]) {
        let jitter = self.random.jitter(faults.jitter);
        if jitter.as_micros() > 0 {
            self.counts.count(Fault::Jitter);
        }
        let mut at = sent + faults.delay + jitter;
        if self.happens(faults.reordering) {
            self.counts.count(Fault::Reorder);
            at = at + self.random.jitter(faults.kept_back);
        } else {
            at = self.ports[to].in_order(at);
        }
        self.sequence += 1;
        if !self.ports[to].arrive(at, self.sequence, frame) {
            self.counts.count(Fault::QueueFull);
        }
    }

    fn happens(&mut self, share: f64) -> bool {
        // 53 bits fit a double exactly.
        share > 0.0 && (self.random.bits() >> 11) as f64 / (1u64 << 53) as f64 <= share
    }
}
