//! A thousand s_units and their manager on one network of datagrams. Links open without delay.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::*;

const UNITS: u32 = 1_000;

/// (when, order, to, from, bytes).
type Flight = (Instant, u64, usize, usize, Vec<u8>);

struct Fleet1000 {
    units: Vec<Node<InMemory>>,
    configs: Vec<NodeConfig<SocketAddr>>,
    /// When each unit is switched on.
    on: Vec<Instant>,
    flying: BinaryHeap<Reverse<Flight>>,
    /// (when, unit): when to poll each unit; may have duplicates.
    timers: BinaryHeap<Reverse<(Instant, usize)>>,
    random: Random,
    order: u64,
    loss_percent: u64,
    latency: Duration,
    broadcasts: usize,
    joined_at: Vec<Option<Instant>>,
    dials: usize,
}

impl Fleet1000 {
    /// The manager is unit 0.
    fn new(seed: u64, manager_at: Instant, units_at: Instant, loss_percent: u64, latency: Duration) -> Self {
        let mut depot = m_unit(MANAGER, MANAGER_ID);
        depot.constraints.maximum_nodes = UNITS as u16;
        depot.seed = seed;
        let mut configs = Vec::from([depot]);
        configs.extend((1..=UNITS).map(|id| NodeConfig { seed: seed ^ u64::from(id) << 32, ..s_unit("agv", id) }));
        let mut on = std::vec![units_at; configs.len()];
        on[0] = manager_at;
        let nodes = |index| if index == 0 { UNITS as usize + 8 } else { 2 };
        let units: Vec<Node<InMemory>> = configs
            .iter()
            .enumerate()
            .map(|(index, config)| Node::new(on[index], config.clone(), storage(nodes(index))))
            .collect();
        let timers = units.iter().enumerate().map(|(index, node)| Reverse((node.next_deadline(), index))).collect();
        Self {
            joined_at: std::vec![None; units.len()],
            units,
            configs,
            on,
            flying: BinaryHeap::new(),
            timers,
            random: Random::new(seed ^ 0xABCD),
            order: 0,
            loss_percent,
            latency,
            broadcasts: 0,
            dials: 0,
        }
    }

    fn host(index: usize) -> SocketAddr {
        address(index as u32 + 1, 7_001)
    }

    fn run_until(&mut self, end: Instant) {
        loop {
            let flight = self.flying.peek().map_or(Instant::FAR_FUTURE, |Reverse((when, ..))| *when);
            let timer = self.timers.peek().map_or(Instant::FAR_FUTURE, |Reverse((when, _))| *when);
            if flight.min(timer) > end {
                return;
            }
            if flight <= timer {
                let Reverse((now, _, to, from, bytes)) = self.flying.pop().unwrap();
                if now >= self.on[to] {
                    self.units[to].hear(now, Self::host(from), &bytes);
                    self.work(to, now);
                }
            } else {
                let Reverse((now, index)) = self.timers.pop().unwrap();
                if self.units[index].next_deadline() <= now {
                    self.work(index, now);
                }
            }
        }
    }

    fn work(&mut self, index: usize, now: Instant) {
        let mut outbox = Outbox::default();
        while let Some(action) = self.units[index].poll(now, &mut outbox, &Plain) {
            let Command::Dial { to, .. } = action else { panic!("{action:?}") };
            assert_eq!(to, address(1, 7_000));
            self.connect(index, now);
        }
        for bytes in outbox.broadcasts {
            self.broadcasts += 1;
            for to in (0..self.units.len()).filter(|to| *to != index) {
                self.fly(now, to, index, bytes.clone());
            }
        }
        for (to, bytes) in outbox.sent {
            let to = (0..self.units.len()).find(|unit| Self::host(*unit) == to).unwrap();
            self.fly(now, to, index, bytes);
        }
        self.timers.push(Reverse((self.units[index].next_deadline(), index)));
    }

    fn fly(&mut self, now: Instant, to: usize, from: usize, bytes: Vec<u8>) {
        if self.random.below(100) < self.loss_percent {
            return;
        }
        self.order += 1;
        let half = self.latency.divided_by(2);
        let when = now + half + self.random.jitter(half);
        self.flying.push(Reverse((when, self.order, to, from, bytes)));
    }

    fn connect(&mut self, index: usize, now: Instant) {
        self.dials += 1;
        let theirs = hello_of(&self.configs[index]);
        let link = LinkId(index as u16);
        assert_eq!(self.units[0].admit(now, link, address(index as u32 + 1, 40_000), &theirs), Admission::Accept);
        self.units[index].dialing(Some(&self.configs[0].identity), LinkId(0));
        let ours = hello_of(&self.configs[0]);
        assert_eq!(self.units[index].admit(now, LinkId(0), address(1, 7_000), &ours), Admission::Accept);
        self.joined_at[index] = Some(now);
    }

    /// The most links opened within any 10 ms.
    fn busiest(&self) -> usize {
        let mut times: Vec<_> = self.joined_at.iter().flatten().copied().collect();
        times.sort();
        let ten = Duration::from_millis(10);
        let within = |from: Instant| times.iter().filter(move |at| **at >= from && **at < from + ten);
        times.iter().map(|from| within(*from).count()).max().unwrap_or(0)
    }

    fn all_joined_at(&self) -> Option<Instant> {
        self.joined_at[1..].iter().copied().collect::<Option<Vec<_>>>()?.into_iter().max()
    }
}

fn assert_joined(fleet: &Fleet1000, start: Instant, what: &str) {
    let joined = fleet.all_joined_at();
    assert!(joined.is_some_and(|joined| joined <= start + Duration::from_secs(2)), "{joined:?} {what}");
    assert!(fleet.broadcasts <= 20, "{} broadcasts {what}", fleet.broadcasts);
    assert_eq!(fleet.dials, UNITS as usize, "{what}");
    assert!(fleet.busiest() <= 50, "{} links within 10 ms {what}", fleet.busiest());
}

#[test]
fn a_fleet_that_is_switched_on_at_once_joins_within_two_seconds_and_twenty_broadcasts() {
    for (seed, latency) in (1..=6).zip([10, 200, 200, 1_000, 1_000, 5_000]) {
        let mut fleet = Fleet1000::new(seed, Instant::START, Instant::START, 0, Duration::from_micros(latency));
        fleet.run_until(at(30_000));
        assert_joined(&fleet, Instant::START, &std::format!("seed {seed}"));
    }
}

#[test]
fn a_fleet_that_comes_to_a_running_manager_joins_within_two_seconds_and_twenty_broadcasts() {
    for (seed, latency) in (1..=6).zip([10, 200, 200, 1_000, 1_000, 5_000]) {
        let start = at(60_000);
        let mut fleet = Fleet1000::new(seed, Instant::START, start, 0, Duration::from_micros(latency));
        fleet.run_until(start);
        fleet.broadcasts = 0;
        fleet.run_until(start + Duration::from_secs(6));
        assert_joined(&fleet, start, &std::format!("seed {seed}"));
    }
}

#[test]
fn a_fleet_that_waits_for_its_manager_joins_within_two_seconds_and_twenty_broadcasts() {
    for seed in 1..=3 {
        let start = at(60_000);
        let mut fleet = Fleet1000::new(seed, start, Instant::START, 0, Duration::from_millis(1));
        fleet.run_until(start);
        // Five pauses double from 250 ms on, then there is one search every 8 to 16 s: for all units together.
        assert!(fleet.broadcasts <= 40, "{} broadcasts in the first minute, seed {seed}", fleet.broadcasts);
        fleet.broadcasts = 0;
        fleet.run_until(start + Duration::from_secs(5));
        assert_joined(&fleet, start, &std::format!("seed {seed}"));
    }
}

#[test]
fn a_lossy_network_delays_few_units_a_little() {
    for seed in 1..=3 {
        let mut fleet = Fleet1000::new(seed, Instant::START, Instant::START, 5, Duration::from_millis(2));
        fleet.run_until(at(30_000));
        let joined = fleet.all_joined_at();
        assert!(joined.is_some_and(|joined| joined <= at(10_000)), "{joined:?}, seed {seed}");
        let soon = fleet.joined_at[1..].iter().flatten().filter(|joined| **joined <= at(2_000)).count();
        assert!(soon >= 850, "{soon} within two seconds, seed {seed}");
        assert!(fleet.broadcasts <= 30, "{} broadcasts, seed {seed}", fleet.broadcasts);
    }
}
