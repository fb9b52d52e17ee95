//! The network: hosts with made-up addresses, datagrams, streams and timers on one virtual clock.
//!
//! It moves only in [`Network::next_event`], which jumps to the next thing that happens and returns what a host must
//! look at. Everything random comes from one generator, so that a seed replays a run exactly.

use std::collections::{BTreeMap, VecDeque};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;

use cara_core::config::PLAIN_PORT;
use cara_core::random::Random;
use cara_core::time::{Duration, Instant};

use crate::event::{HostId, NetEvent, StreamId, Trace};
use crate::faults::{Fault, FaultCounts};
use crate::path::{Chance, Path};
use crate::plan::Action;
use crate::queue::Queue;

mod datagrams;
mod dialling;
mod hosts;
mod injection;
mod streams;
mod transfer;

pub use injection::Direction;
pub use streams::Broken;

use injection::{Freeze, Freezing, Partition};
use streams::End;

/// A virtual network with its clock.
#[derive(Debug)]
pub struct Network {
    now: Instant,
    queue: Queue<Happening>,
    ready: VecDeque<NetEvent>,
    random: Random,
    hosts: Vec<Host>,
    by_address: BTreeMap<Ipv4Addr, Vec<HostId>>,
    ends: Vec<End>,
    calm: Path,
    fault_profile: Option<(u32, Path)>,
    paths: BTreeMap<(HostId, HostId), (u32, Path)>,
    /// Of each cable to each other one.
    wires: BTreeMap<(HostId, HostId), Wire>,
    partitions: Vec<Partition>,
    frozen: Vec<Freezing>,
    quiet_segments: Vec<u8>,
    split_reads: Chance,
    hears_itself: bool,
    counts: FaultCounts,
    injected: u32,
}

#[derive(Debug)]
struct Host {
    address: Ipv4Addr,
    segment: u8,
    /// The machine is on: it answers strays with a reset even where no process runs.
    power: bool,
    running: bool,
    /// Its cable is in.
    plugged: bool,
    /// The host whose cable it has: its own, unless it shares one.
    cable: HostId,
    /// Counts crashes, so that timers of an earlier life do not go off in a later one.
    life: u32,
    /// Until then it neither sees nor does anything.
    suspended: Instant,
    /// Its clock is so far ahead of the virtual time.
    ahead: Duration,
    udp_port: u16,
    listeners: Vec<u16>,
    accept_limit: usize,
    dial_port: u16,
    streams: Vec<StreamId>,
    send_buffer: usize,
    receive_window: usize,
    answers_strays: bool,
    /// What it received as datagrams, did and saw.
    trace: Trace,
}

/// The bandwidth of one direction between two cables, shared by everything that goes there.
#[derive(Debug, Default)]
struct Wire {
    free_at: Instant,
    /// Byte-microseconds that a whole number of microseconds did not cover.
    carry: u64,
}

/// What the queue holds.
#[derive(Clone, Debug)]
enum Happening {
    Datagram {
        from_host: HostId,
        from: SocketAddrV4,
        to: HostId,
        port: u16,
        bytes: Arc<[u8]>,
    },
    /// The transmitter of this end has sent its segment, or has backed off long enough.
    Step(StreamId),
    /// The reader of what this end writes may have room again.
    WindowOpens(StreamId),
    Arrive {
        writer: StreamId,
        up_to: u64,
        end: bool,
    },
    Dial {
        stream: StreamId,
        attempt: u32,
    },
    DialArrives {
        stream: StreamId,
        attempt: u32,
    },
    DialAnswered {
        stream: StreamId,
    },
    DialRefused {
        stream: StreamId,
    },
    ResetArrives {
        end: StreamId,
    },
    Remainder(StreamId),
    Timer {
        host: HostId,
        life: u32,
        token: u64,
    },
    Inject(Box<Action>),
    Heal {
        partition: u32,
    },
    Thaw {
        freeze: Freeze,
    },
    Restart {
        host: HostId,
        life: u32,
    },
    FaultProfileEnds {
        number: u32,
    },
    PathRecovers {
        from: HostId,
        to: HostId,
        number: u32,
    },
    SegmentHeard {
        segment: u8,
    },
    /// A suspended host goes on, and sees what it has missed.
    Missed(NetEvent),
}

impl Network {
    /// An empty network; the same `seed` and the same calls give the same run.
    pub fn new(seed: u64) -> Self {
        Self {
            now: Instant::START,
            queue: Queue::new(),
            ready: VecDeque::new(),
            random: Random::new(seed),
            hosts: Vec::new(),
            by_address: BTreeMap::new(),
            ends: Vec::new(),
            calm: Path::LAN,
            fault_profile: None,
            paths: BTreeMap::new(),
            wires: BTreeMap::new(),
            partitions: Vec::new(),
            frozen: Vec::new(),
            quiet_segments: Vec::new(),
            split_reads: Chance::NEVER,
            hears_itself: false,
            counts: FaultCounts::default(),
            injected: 0,
        }
    }

    /// The virtual time.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// The one generator of the run, for users whose choices must replay as well.
    pub fn random(&mut self) -> &mut Random {
        &mut self.random
    }

    /// What was injected so far.
    pub fn counts(&self) -> &FaultCounts {
        &self.counts
    }

    /// A hash over what each end of a stream wrote, and over the datagrams that each host received, the fate of its streams and
    /// its notes, in their order and with their times. Equal for equal runs, also where a unit reads and writes in other
    /// portions or sets other timers.
    pub fn trace_hash(&self) -> u64 {
        let mut all = Trace::new();
        let parts = self.hosts.iter().map(|host| host.trace).chain(self.ends.iter().map(|end| end.sent));
        parts.for_each(|part| all.note(&part.hash().to_le_bytes()));
        all.hash()
    }

    /// Mixes something that a host did or saw now into [`Self::trace_hash`].
    pub fn note(&mut self, host: HostId, what: &[u8]) {
        let now = self.now;
        self.host_mut(host).trace.note_at(now, what);
    }

    // --- time

    /// [`NetEvent::Timer`] at `at` (or at once where that has passed), unless the host crashes before.
    pub fn set_timer(&mut self, host: HostId, at: Instant, token: u64) {
        let life = self.host(host).life;
        self.push(at, Happening::Timer { host, life, token });
    }

    /// When something happens next, of whatever kind.
    pub fn next_time(&self) -> Option<Instant> {
        if self.ready.is_empty() { self.queue.next_time() } else { Some(self.now) }
    }

    /// Jumps to the next event and returns it; `None` when nothing will ever happen again.
    pub fn next_event(&mut self) -> Option<NetEvent> {
        self.next_event_until(Instant::FAR_FUTURE)
    }

    /// As [`Self::next_event`], but never beyond `limit`: `None` with the clock at `limit` when nothing happens before.
    pub fn next_event_until(&mut self, limit: Instant) -> Option<NetEvent> {
        loop {
            if let Some(event) = self.ready.pop_front() {
                let Some(event) = self.hold_if_suspended(event) else { continue };
                let now = self.now;
                self.host_mut(event.host()).trace.note_event(now, &event);
                return Some(event);
            }
            let due = self.queue.next_time().filter(|at| *at <= limit);
            let Some((at, happening)) = due.and_then(|_| self.queue.pop()) else {
                if limit != Instant::FAR_FUTURE {
                    self.now = self.now.max(limit);
                }
                return None;
            };
            self.now = at;
            self.handle(happening);
        }
    }

    fn handle(&mut self, happening: Happening) {
        let Some(happening) = self.hold_if_frozen(happening) else { return };
        match happening {
            Happening::Datagram { from, to, port, bytes, .. } => self.datagram_arrives(from, to, port, bytes),
            Happening::Step(stream) => self.step(stream),
            Happening::WindowOpens(stream) => self.window_opens(stream),
            Happening::Arrive { writer, up_to, end } => self.arrive(writer, up_to, end),
            Happening::Dial { stream, attempt } => self.dial(stream, attempt),
            Happening::DialArrives { stream, attempt } => self.dial_arrives(stream, attempt),
            Happening::DialAnswered { stream } => self.dial_answered(stream),
            Happening::DialRefused { stream } => self.dial_refused(stream, false),
            Happening::ResetArrives { end } => self.reset_arrives(end),
            Happening::Remainder(stream) => self.announce_readable(stream),
            Happening::Timer { host, life, token } => self.timer(host, life, token),
            Happening::Inject(action) => self.inject(*action),
            Happening::Heal { partition } => self.heal(partition),
            Happening::Thaw { freeze } => self.thaw_if_due(freeze),
            Happening::Restart { host, life } if self.host(host).life == life => self.restart(host),
            Happening::Restart { .. } => (),
            Happening::FaultProfileEnds { number } => {
                self.fault_profile = self.fault_profile.filter(|(current, _)| *current != number)
            }
            Happening::PathRecovers { from, to, number } => self.path_recovers(from, to, number),
            Happening::Missed(event) => self.see_missed(event),
            Happening::SegmentHeard { segment } => self.quiet_segments.retain(|quiet| *quiet != segment),
        }
    }

    fn timer(&mut self, host: HostId, life: u32, token: u64) {
        let Host { running, life: current, .. } = *self.host(host);
        if running && life == current {
            self.ready.push_back(NetEvent::Timer { host, token });
        }
    }

    // --- shared by the parts

    fn host(&self, id: HostId) -> &Host {
        &self.hosts[id.index()]
    }

    fn host_mut(&mut self, id: HostId) -> &mut Host {
        &mut self.hosts[id.index()]
    }

    fn push(&mut self, at: Instant, happening: Happening) {
        self.queue.push(at.max(self.now), happening);
    }

    fn path(&self, from: HostId, to: HostId) -> Path {
        let special = if self.paths.is_empty() { None } else { self.paths.get(&(from, to)) };
        special.or(self.fault_profile.as_ref()).map_or(self.calm, |(_, path)| *path)
    }

    /// When something that leaves at `at` arrives.
    fn arrival(&mut self, at: Instant, path: Path) -> Instant {
        if path.delay > self.calm.delay {
            self.counts.count(Fault::Delay);
        }
        let late = self.random_below(path.jitter);
        if late > Duration::ZERO {
            self.counts.count(Fault::Jitter);
        }
        at + path.delay + late
    }

    fn random_below(&mut self, limit: Duration) -> Duration {
        if limit == Duration::ZERO { limit } else { self.random.jitter(limit) }
    }

    /// Sends `length` bytes at the path's bandwidth behind whatever goes that way; returns when the last byte leaves.
    fn leave(&mut self, from: HostId, to: HostId, path: Path, length: usize) -> Instant {
        let rate = path.bytes_per_second;
        if rate == 0 {
            return self.now;
        }
        self.counts.count(Fault::Bandwidth);
        let (now, cables) = (self.now, (self.host(from).cable, self.host(to).cable));
        let wire = self.wires.entry(cables).or_default();
        if wire.free_at < now {
            *wire = Wire { free_at: now, carry: 0 };
        }
        let work = (length as u64).saturating_mul(1_000_000).saturating_add(wire.carry);
        wire.carry = work % rate;
        wire.free_at = wire.free_at + Duration::from_micros(work / rate);
        wire.free_at
    }

    /// The running host at `address` for which `wants` holds; the newest of several.
    fn find(&self, address: Ipv4Addr, wants: impl Fn(&Host) -> bool) -> Option<HostId> {
        let candidates = self.by_address.get(&address)?;
        candidates.iter().rev().copied().find(|id| wants(self.host(*id)))
    }

    fn is_discovery_port(port: u16) -> bool {
        port == PLAIN_PORT
    }
}
