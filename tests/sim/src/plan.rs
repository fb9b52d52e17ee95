//! Random schedules of faults.

use cara_core::random::Random;
use cara_core::time::Duration;

use crate::event::HostId;
use crate::network::{Direction, Network};
use crate::path::{Chance, Path};

/// How a host goes down.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Crash {
    /// The power fails: nothing is said, and bytes to it vanish.
    PowerCut,
    /// The process is killed: the machine closes its streams and refuses new ones.
    Process,
}

/// One fault to inject.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// All paths get this quality for a while.
    FaultProfile {
        /// The quality.
        path: Path,
        /// How long.
        span: Duration,
    },
    /// One directed path gets this quality for a while.
    Degrade {
        /// Sender.
        from: HostId,
        /// Receiver.
        to: HostId,
        /// The quality.
        path: Path,
        /// How long.
        span: Duration,
    },
    /// Two sets of hosts are cut from each other.
    Partition {
        /// One set.
        first: Vec<HostId>,
        /// The other.
        second: Vec<HostId>,
        /// Which way.
        direction: Direction,
        /// How long.
        span: Duration,
    },
    /// All that goes from one host to another is held, datagrams as well.
    Freeze {
        /// Sender.
        from: HostId,
        /// Receiver.
        to: HostId,
        /// How long.
        span: Duration,
    },
    /// The streams from one host to another are held; datagrams pass.
    FreezeStreams {
        /// Sender.
        from: HostId,
        /// Receiver.
        to: HostId,
        /// How long.
        span: Duration,
    },
    /// A segment drops broadcasts.
    DropBroadcasts {
        /// The segment.
        segment: u8,
        /// How long.
        span: Duration,
    },
    /// A host goes down and comes back.
    Crash {
        /// The host.
        host: HostId,
        /// How it goes down.
        crash: Crash,
        /// How long it stays down.
        down: Duration,
    },
    /// A host sees and does nothing for a while.
    Suspend {
        /// The host.
        host: HostId,
        /// How long.
        span: Duration,
    },
    /// A host gets a free address.
    ChangeAddress {
        /// The host.
        host: HostId,
    },
    /// All streams of a host are reset.
    ResetStreams {
        /// The host.
        host: HostId,
    },
    /// Reads are lent random prefixes from now on.
    SplitReads {
        /// How often.
        chance: Chance,
    },
}

/// A random schedule of faults: the same seed and settings give the same one.
///
/// All faults begin before the plan's end and are over soon after: paths recover, partitions heal and hosts are back,
/// so that a test can then ask for what must hold in the end.
///
/// ```
/// use cara_core::time::Duration;
/// use cara_sim::{FaultPlan, Network};
/// let mut network = Network::new(7);
/// let hosts = [network.add_host(), network.add_host()];
/// FaultPlan::mild(7).over(Duration::from_secs(20)).schedule(&mut network, &hosts);
/// ```
#[derive(Clone, Debug)]
pub struct FaultPlan {
    random: Random,
    from: Duration,
    over: Duration,
    pause: Duration,
    longest: Duration,
    loss: u32,
    split: Chance,
    crashes: bool,
    addresses: bool,
}

impl FaultPlan {
    /// A bad day: a fault about every second, each up to half a second, loss up to 3 %.
    pub fn mild(seed: u64) -> Self {
        Self {
            // Apart from the network's own seed, which is often the same number.
            random: Random::new(seed ^ 0x5EED_FA17),
            from: Duration::ZERO,
            over: Duration::from_secs(10),
            pause: Duration::from_secs(1),
            longest: Duration::from_millis(500),
            loss: 3,
            split: Chance::percent(10.0),
            crashes: true,
            addresses: true,
        }
    }

    /// As bad as it gets: a fault about every 300 ms, each up to three seconds, loss up to 30 %.
    pub fn harsh(seed: u64) -> Self {
        Self {
            pause: Duration::from_millis(300),
            longest: Duration::from_secs(3),
            loss: 30,
            split: Chance::percent(50.0),
            ..Self::mild(seed)
        }
    }

    /// The first fault comes no earlier than this after the scheduling.
    pub fn starting_after(self, calm: Duration) -> Self {
        Self { from: calm, ..self }
    }

    /// Faults begin within this time (10 s).
    pub fn over(self, span: Duration) -> Self {
        Self { over: span, ..self }
    }

    /// The same plan without crashes.
    pub fn without_crashes(self) -> Self {
        Self { crashes: false, ..self }
    }

    /// The same plan without changes of address.
    pub fn without_address_changes(self) -> Self {
        Self { addresses: false, ..self }
    }

    /// The time after which everything is as it was, counted from the scheduling.
    pub fn ends_after(&self) -> Duration {
        self.from + self.over + self.longest
    }

    /// Puts the plan's faults into the network's queue, for these hosts.
    pub fn schedule(self, network: &mut Network, hosts: &[HostId]) {
        let now = network.now();
        for (at, action) in self.actions(hosts) {
            network.schedule(now + at, action);
        }
    }

    /// What happens when, counted from the scheduling.
    pub fn actions(mut self, hosts: &[HostId]) -> Vec<(Duration, Action)> {
        let mut actions = vec![(self.from, Action::SplitReads { chance: self.split })];
        let mut at = self.from;
        loop {
            at = at + self.random.jitter(self.pause.times(2)) + Duration::from_micros(1);
            if at >= self.from + self.over || hosts.is_empty() {
                break;
            }
            if let Some(action) = self.draw(hosts) {
                actions.push((at, action));
            }
        }
        actions.push((self.ends_after(), Action::SplitReads { chance: Chance::NEVER }));
        actions
    }

    fn draw(&mut self, hosts: &[HostId]) -> Option<Action> {
        let span = Duration::from_millis(1) + self.random.jitter(self.longest);
        let (host, other) = self.pair(hosts);
        let action = match self.random.below(17) {
            0..4 => Action::FaultProfile { path: self.quality(), span },
            4..6 => Action::Degrade { from: host, to: other, path: self.quality(), span },
            6..8 => self.cut(hosts, span),
            8 => Action::Freeze { from: host, to: other, span },
            9..11 => Action::FreezeStreams { from: host, to: other, span },
            11 => Action::DropBroadcasts { segment: 0, span },
            12 if self.addresses => Action::ChangeAddress { host },
            13 => Action::ResetStreams { host },
            16 => Action::Suspend { host, span },
            14 if self.crashes => Action::Crash { host, crash: Crash::PowerCut, down: span },
            15 if self.crashes => Action::Crash { host, crash: Crash::Process, down: span },
            _ => return None,
        };
        Some(action)
    }

    fn pair(&mut self, hosts: &[HostId]) -> (HostId, HostId) {
        let count = hosts.len() as u64;
        let first = self.random.below(count);
        let second = (first + 1 + self.random.below(count.saturating_sub(1))) % count;
        (hosts[first as usize], hosts[second as usize])
    }

    fn quality(&mut self) -> Path {
        let percent =
            |random: &mut Random, limit: u32| Chance::parts_per_million(random.below(limit.into()) as u32 * 10_000);
        let random = &mut self.random;
        Path {
            delay: random.jitter(Duration::from_millis(20)),
            jitter: random.jitter(Duration::from_millis(20)),
            loss: percent(random, self.loss + 1),
            duplicate: percent(random, self.loss + 1),
            reorder: percent(random, self.loss + 1),
            bytes_per_second: [0, 12_500, 125_000, 1_250_000][random.below(4) as usize],
        }
    }

    fn cut(&mut self, hosts: &[HostId], span: Duration) -> Action {
        let (mut first, mut second): (Vec<_>, Vec<_>) = hosts.iter().partition(|_| self.random.below(2) == 0);
        if first.is_empty() {
            first.extend(second.pop());
        } else if second.is_empty() {
            second.extend(first.pop());
        }
        let direction = if self.random.below(3) == 0 { Direction::FirstToSecond } else { Direction::Both };
        Action::Partition { first, second, direction, span }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hosts() -> Vec<HostId> {
        (0..4).map(HostId).collect()
    }

    #[test]
    fn the_same_seed_gives_the_same_plan_and_another_seed_another() {
        assert_eq!(FaultPlan::harsh(3).actions(&hosts()), FaultPlan::harsh(3).actions(&hosts()));
        assert_ne!(FaultPlan::harsh(3).actions(&hosts()), FaultPlan::harsh(4).actions(&hosts()));
    }

    #[test]
    fn harsh_is_denser_than_mild() {
        let count = |plan: fn(u64) -> FaultPlan| (0..20).map(|seed| plan(seed).actions(&hosts()).len()).sum::<usize>();
        assert!(count(FaultPlan::harsh) > 2 * count(FaultPlan::mild));
    }

    #[test]
    fn crashes_can_be_left_out() {
        let actions = (0..50).flat_map(|seed| FaultPlan::harsh(seed).without_crashes().actions(&hosts()));
        assert!(actions.into_iter().all(|(_, action)| !matches!(action, Action::Crash { .. })));
    }
}
