//! Faults: what the network does to hosts, streams and paths, at once or on a plan.

use std::net::Ipv4Addr;

use cara_core::time::{Duration, Instant};

use super::{Happening, Network};
use crate::event::{HostId, NetEvent, StreamId};
use crate::faults::Fault;
use crate::path::{Chance, Path};
use crate::plan::{Action, Crash};

/// Which way a partition cuts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// Nothing passes between the two sets.
    Both,
    /// Nothing passes from the first set to the second; the way back is open.
    FirstToSecond,
}

#[derive(Debug)]
pub(super) struct Partition {
    number: u32,
    first: Vec<HostId>,
    second: Vec<HostId>,
    direction: Direction,
}

impl Partition {
    fn cuts(&self, from: HostId, to: HostId) -> bool {
        let forward = self.first.contains(&from) && self.second.contains(&to);
        let backward = self.first.contains(&to) && self.second.contains(&from);
        forward || (backward && self.direction == Direction::Both)
    }
}

/// What is frozen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Freeze {
    /// What this end writes.
    Stream(StreamId),
    /// All that goes from the first host to the second.
    Link(HostId, HostId),
}

#[derive(Debug)]
pub(super) struct Freezing {
    what: Freeze,
    until: Instant,
    held: Vec<Happening>,
}

impl Network {
    // --- quality of paths

    /// The quality of every path that nothing else was said of; [`Path::LAN`] at first.
    pub fn set_calm(&mut self, path: Path) {
        self.calm = path;
    }

    /// The quality of every path for `span`, instead of the calm one. A later call ends an earlier one.
    pub fn set_fault_profile(&mut self, path: Path, span: Duration) {
        self.injected += 1;
        let number = self.injected;
        self.fault_profile = Some((number, path));
        self.push(self.now + span, Happening::FaultProfileEnds { number });
    }

    /// The quality of one directed path, until it is set again.
    pub fn set_path(&mut self, from: HostId, to: HostId, path: Path) {
        self.injected += 1;
        self.paths.insert((from, to), (self.injected, path));
    }

    /// The quality of the paths between two hosts, both ways.
    pub fn set_paths_between(&mut self, one: HostId, other: HostId, path: Path) {
        self.set_path(one, other, path);
        self.set_path(other, one, path);
    }

    /// These hosts share one cable, as behind one switch port or radio: what any of them sends to a host waits for what all of them
    /// send there, and the other way round.
    pub fn share_cable(&mut self, hosts: &[HostId]) {
        let Some(&first) = hosts.first() else { return };
        let cable = self.host(first).cable;
        hosts.iter().for_each(|&host| self.host_mut(host).cable = cable);
    }

    /// The quality of one directed path for `span`; then it is as all others.
    pub fn degrade(&mut self, from: HostId, to: HostId, path: Path, span: Duration) {
        self.set_path(from, to, path);
        let number = self.injected;
        self.push(self.now + span, Happening::PathRecovers { from, to, number });
    }

    /// How often a read is lent only a random prefix of what has arrived.
    pub fn split_reads(&mut self, chance: Chance) {
        self.split_reads = chance;
    }

    pub(super) fn path_recovers(&mut self, from: HostId, to: HostId, number: u32) {
        if self.paths.get(&(from, to)).is_some_and(|(current, _)| *current == number) {
            self.paths.remove(&(from, to));
        }
    }

    // --- partitions

    /// Cuts two sets of hosts from each other until [`Self::heal`] with the number that this returns. Datagrams are
    /// lost; streams stall, and go on with their next retransmission after the healing.
    pub fn partition(&mut self, first: &[HostId], second: &[HostId], direction: Direction) -> u32 {
        self.counts.count(Fault::Partition);
        self.injected += 1;
        let number = self.injected;
        self.partitions.push(Partition { number, first: first.to_vec(), second: second.to_vec(), direction });
        number
    }

    /// As [`Self::partition`], healed after `span`.
    pub fn partition_for(&mut self, first: &[HostId], second: &[HostId], direction: Direction, span: Duration) {
        let partition = self.partition(first, second, direction);
        self.push(self.now + span, Happening::Heal { partition });
    }

    /// Ends a partition.
    pub fn heal(&mut self, partition: u32) {
        self.partitions.retain(|other| other.number != partition);
    }

    /// Ends all partitions.
    pub fn heal_all(&mut self) {
        self.partitions.clear();
    }

    /// Drops every broadcast of a segment for `span`, as some access points do; unicast passes.
    pub fn drop_broadcasts(&mut self, segment: u8, span: Duration) {
        self.quiet_segments.push(segment);
        self.push(self.now + span, Happening::SegmentHeard { segment });
    }

    pub(super) fn is_cut(&self, from: HostId, to: HostId) -> bool {
        let plugged = self.host(from).plugged && self.host(to).plugged;
        !plugged || self.partitions.iter().any(|partition| partition.cuts(from, to))
    }

    /// Takes the host's only interface down or up again: unlike under a partition the host knows, and its sends fail.
    /// [`NetEvent::AddressChanged`] follows. Streams stall, as with a partition.
    pub fn plug(&mut self, host: HostId, plugged: bool) {
        if !plugged {
            self.counts.count(Fault::Partition);
        }
        self.host_mut(host).plugged = plugged;
        self.ready.push_back(NetEvent::AddressChanged { host });
    }

    // --- freezing

    /// Holds what the writer of `stream` sends for `span`; it arrives all at once after that. The rest of the link,
    /// datagrams among it, goes on.
    pub fn freeze_stream(&mut self, stream: StreamId, span: Duration) {
        self.freeze(Freeze::Stream(stream), span);
    }

    /// Holds everything that goes from one host to another for `span`; it arrives all at once after that.
    pub fn freeze_link(&mut self, from: HostId, to: HostId, span: Duration) {
        self.freeze(Freeze::Link(from, to), span);
    }

    /// Ends all freezing: what was held arrives now.
    pub fn thaw_all(&mut self) {
        let now = self.now;
        for freezing in std::mem::take(&mut self.frozen) {
            freezing.held.into_iter().for_each(|happening| self.push(now, happening));
        }
    }

    fn freeze(&mut self, what: Freeze, span: Duration) {
        self.counts.count(Fault::Freeze);
        let until = self.now + span;
        match self.frozen.iter_mut().find(|freezing| freezing.what == what) {
            Some(freezing) => freezing.until = freezing.until.max(until),
            None => self.frozen.push(Freezing { what, until, held: Vec::new() }),
        }
        self.push(until, Happening::Thaw { freeze: what });
    }

    pub(super) fn thaw_if_due(&mut self, what: Freeze) {
        let now = self.now;
        let due = self.frozen.iter().position(|freezing| freezing.what == what && freezing.until <= now);
        if let Some(index) = due {
            let freezing = self.frozen.remove(index);
            freezing.held.into_iter().for_each(|happening| self.push(now, happening));
        }
    }

    /// Gives back what may happen now; what something frozen holds it keeps.
    pub(super) fn hold_if_frozen(&mut self, happening: Happening) -> Option<Happening> {
        if self.frozen.is_empty() {
            return Some(happening);
        }
        let (stream, link) = match &happening {
            Happening::Datagram { from_host, to, .. } => (None, (*from_host, *to)),
            Happening::Arrive { writer, .. } => (Some(*writer), self.link_of(*writer)),
            Happening::ResetArrives { end } => (Some(end.peer()), self.link_of(end.peer())),
            _ => return Some(happening),
        };
        let holds = |freezing: &&mut Freezing| match freezing.what {
            Freeze::Stream(frozen) => stream == Some(frozen),
            Freeze::Link(from, to) => link == (from, to),
        };
        match self.frozen.iter_mut().find(holds) {
            Some(freezing) => freezing.held.push(happening),
            None => return Some(happening),
        }
        None
    }

    // --- hosts

    /// Ends the host's process, or cuts its power; [`NetEvent::Crashed`] follows. Until [`Self::restart`] it neither
    /// sends nor hears. Without effect on a host that is down.
    pub fn crash(&mut self, host: HostId, crash: Crash) {
        if self.host(host).running {
            self.counts.count(match crash {
                Crash::PowerCut => Fault::PowerCut,
                Crash::Process => Fault::ProcessKilled,
            });
            self.take_down(host, crash);
        }
    }

    /// Ends the host's process as if it had wanted that: no fault. [`NetEvent::Crashed`] follows all the same.
    pub fn stop(&mut self, host: HostId) {
        if self.host(host).running {
            self.take_down(host, Crash::Process);
        }
    }

    fn take_down(&mut self, host: HostId, crash: Crash) {
        let crashed = self.host_mut(host);
        crashed.life += 1;
        crashed.suspended = Instant::START;
        crashed.running = false;
        crashed.power = crash == Crash::Process;
        crashed.listeners.clear();
        for stream in crashed.streams.clone() {
            match crash {
                Crash::PowerCut => self.bury(stream),
                Crash::Process if self.readable(stream) > 0 => self.reset(stream),
                Crash::Process => self.close(stream),
            }
        }
        self.ready.retain(|event| event.host() != host);
        self.ready.push_back(NetEvent::Crashed { host });
    }

    /// Brings a crashed host back without listeners; [`NetEvent::Restarted`] follows. Without effect on a running one.
    pub fn restart(&mut self, host: HostId) {
        let back = self.host_mut(host);
        if back.running {
            return;
        }
        back.running = true;
        back.power = true;
        self.counts.count(Fault::Restart);
        self.ready.push_back(NetEvent::Restarted { host });
    }

    /// As [`Self::crash`], restarted after `down`.
    pub fn crash_for(&mut self, host: HostId, crash: Crash, down: Duration) {
        self.crash(host, crash);
        let life = self.host(host).life;
        self.push(self.now + down, Happening::Restart { host, life });
    }

    /// Stops the host for `span`, as a laptop that is closed: its machine goes on to take bytes, its program sees nothing
    /// until then, and all that it has missed at once after that.
    pub fn suspend(&mut self, host: HostId, span: Duration) {
        self.counts.count(Fault::Suspend);
        let until = self.now + span;
        let host = self.host_mut(host);
        host.suspended = host.suspended.max(until);
    }

    /// When a suspended host goes on; in the past for all others.
    pub fn suspended_until(&self, host: HostId) -> Instant {
        self.host(host).suspended
    }

    /// Gives back what its host may see now.
    pub(super) fn hold_if_suspended(&mut self, event: NetEvent) -> Option<NetEvent> {
        let until = self.host(event.host()).suspended;
        let of_fate =
            matches!(event, NetEvent::Crashed { .. } | NetEvent::Restarted { .. } | NetEvent::AddressChanged { .. });
        if of_fate || until <= self.now {
            return Some(event);
        }
        self.push(until, Happening::Missed(event));
        None
    }

    /// What was missed and still means something.
    pub(super) fn see_missed(&mut self, event: NetEvent) {
        let current = match &event {
            NetEvent::Connected { stream, .. }
            | NetEvent::Accepted { stream, .. }
            | NetEvent::Readable { stream, .. }
            | NetEvent::Writable { stream, .. }
            | NetEvent::Closed { stream, .. } => self.is_open(*stream),
            _ => self.is_running(event.host()),
        };
        if current {
            self.ready.push_back(event);
        }
    }

    /// Gives the host another address; [`NetEvent::AddressChanged`] follows. Its streams lead nowhere from now on,
    /// and neither of their ends is told.
    pub fn change_address(&mut self, host: HostId, address: Ipv4Addr) {
        self.counts.count(Fault::AddressChange);
        let old = std::mem::replace(&mut self.host_mut(host).address, address);
        if let Some(hosts) = self.by_address.get_mut(&old) {
            hosts.retain(|other| *other != host);
        }
        self.by_address.entry(address).or_default().push(host);
        self.ready.push_back(NetEvent::AddressChanged { host });
    }

    /// Resets a stream from within the network: both ends see it at once.
    pub fn reset_by_network(&mut self, stream: StreamId) {
        self.counts.count(Fault::Reset);
        self.reset_arrives(stream);
        self.reset_arrives(stream.peer());
    }

    // --- plans

    /// Does `action` at `at`.
    pub fn schedule(&mut self, at: Instant, action: Action) {
        self.push(at, Happening::Inject(Box::new(action)));
    }

    /// Does `action` now.
    pub fn inject(&mut self, action: Action) {
        match action {
            Action::FaultProfile { path, span } => self.set_fault_profile(path, span),
            Action::Degrade { from, to, path, span } => self.degrade(from, to, path, span),
            Action::Partition { first, second, direction, span } => {
                self.partition_for(&first, &second, direction, span);
            }
            Action::Freeze { from, to, span } => self.freeze_link(from, to, span),
            Action::FreezeStreams { from, to, span } => self.freeze_streams(from, to, span),
            Action::DropBroadcasts { segment, span } => self.drop_broadcasts(segment, span),
            Action::Crash { host, crash, down } => self.crash_for(host, crash, down),
            Action::Suspend { host, span } => self.suspend(host, span),
            Action::ChangeAddress { host } => {
                let address = self.free_address(host);
                self.change_address(host, address);
            }
            Action::ResetStreams { host } => {
                for stream in self.host(host).streams.clone() {
                    self.reset_by_network(stream);
                }
            }
            Action::SplitReads { chance } => self.split_reads(chance),
        }
    }

    fn freeze_streams(&mut self, from: HostId, to: HostId, span: Duration) {
        for stream in self.host(from).streams.clone() {
            if self.link_of(stream) == (from, to) {
                self.freeze_stream(stream, span);
            }
        }
    }

    fn free_address(&mut self, host: HostId) -> Ipv4Addr {
        let [_, segment, high, low] = self.host(host).address.octets();
        let candidates = (0..=u8::MAX).map(|block| Ipv4Addr::new(11 + block % 100, segment, high, low));
        let free = |address: &Ipv4Addr| self.by_address.get(address).is_none_or(Vec::is_empty);
        candidates.into_iter().find(free).unwrap_or(Ipv4Addr::new(10, segment, high, low))
    }
}
