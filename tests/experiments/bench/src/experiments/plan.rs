//! How much of each experiment is run: in full, in minutes, or just enough to see that it works.

use std::sync::Arc;

use anyhow::{Result, bail};
use cara_processes::cable::Wire;

use crate::counted;
use crate::pair::Setting;
use crate::peers::{Contender, Outside, SECURED, SPINNING, SPINNING_SECURED};
use cara_bench_ends::{Burst, Order, Pin, pin};

/// How much is run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Extent {
    Full,
    Quick,
    Tiny,
}

impl Extent {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::Quick => "quick",
            Self::Tiny => "tiny",
        }
    }

    /// The value for this extent.
    fn of<T>(self, full: T, quick: T, tiny: T) -> T {
        match self {
            Self::Full => full,
            Self::Quick => quick,
            Self::Tiny => tiny,
        }
    }
}

/// Everything that is to be measured.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    pub(crate) extent: Extent,
    pub(crate) response: Vec<Group>,
    /// Round trips that are seconds apart.
    pub(crate) far: Vec<Group>,
    pub(crate) throughput: Group,
    pub(crate) throughput_pins: Vec<Pin>,
    pub(crate) one_way_peers: Vec<Contender>,
    /// One-way messages of each turn: enough that the first and the last ones do not count.
    pub(crate) one_way: u32,
    /// Calls of each turn whose time is taken apart.
    pub(crate) share_calls: u32,
    pub(crate) share_rounds: u32,
    /// Calls whose instructions are counted.
    pub(crate) counted_calls: u32,
    pub(crate) nodes: Vec<u32>,
    pub(crate) scale_rounds: u32,
    pub(crate) scale_calls: u32,
    pub(crate) availability: Vec<Bursts>,
    pub(crate) constrained: Constrained,
    pub(crate) link: Link,
    /// Where the experiments run that have one place only.
    pub(crate) pin: Pin,
    /// What could not be planned.
    pub(crate) notes: Vec<String>,
}

/// Cells of echo calls that share their processes.
#[derive(Debug, Clone)]
pub(crate) struct Group {
    pub(crate) setting: Setting,
    pub(crate) peers: Vec<Contender>,
    pub(crate) orders: Vec<Order>,
    pub(crate) rounds: u32,
}

/// Availability at these sizes and periods.
#[derive(Debug, Clone)]
pub(crate) struct Bursts {
    pub(crate) distribution: u8,
    pub(crate) delivery: cara_bench_ends::Delivery,
    pub(crate) chars: Vec<u32>,
    pub(crate) periods_ms: Vec<u64>,
    pub(crate) groups: u32,
    pub(crate) group: u32,
}

impl Bursts {
    pub(crate) fn burst(&self, chars: u32, period_ms: u64) -> Burst {
        Burst { chars, count: self.group, period_ms, delivery: self.delivery, insist: false }
    }
}

impl Link {
    /// Leaves out the rates that are not among these, where there are any.
    pub(crate) fn narrow(&mut self, mbit: &[u32]) -> Result<()> {
        let known = &self.availability.mbit;
        if let Some(unknown) = mbit.iter().find(|rate| !known.contains(rate)) {
            bail!("no link has {unknown} Mbit/s here: choose among {known:?}");
        }
        let is_wanted = |rate: &u32| mbit.is_empty() || mbit.contains(rate);
        self.mbit.retain(is_wanted);
        self.availability.mbit.retain(is_wanted);
        self.response.retain(|group| is_wanted(&group.setting.mbit()));
        Ok(())
    }

    pub(crate) fn wire(&self, mbit: u32) -> Wire {
        Wire { mbit, loss_percent: self.loss_percent }
    }
}

impl LinkBursts {
    /// Those that a link of this rate carries soon enough.
    pub(crate) fn sizes(&self, mbit: u32) -> impl Iterator<Item = &u32> + Clone {
        self.chars.iter().filter(move |chars| *chars * 8 / mbit / 1_000 <= LONGEST_MS)
    }

    /// Up to five times what the longest text takes on a link of this rate, beyond which nothing is late any more.
    pub(crate) fn periods_ms(&self, mbit: u32) -> Vec<u64> {
        let longest = self.sizes(mbit).max().map_or(0, |chars| u64::from(*chars) * 8 * 5 / u64::from(mbit) / 1_000);
        self.periods_ms.iter().copied().filter(|period| *period <= longest.max(10)).collect()
    }
}

/// The sweep over constraints: every interval with every message size.
#[derive(Debug, Clone)]
pub(crate) struct Constrained {
    pub(crate) intervals_ms: Vec<u64>,
    pub(crate) message_sizes: Vec<u32>,
    pub(crate) chars: Vec<u32>,
    pub(crate) period_ms: u64,
    pub(crate) count: u32,
}

/// The paper's experiments on links that fill, each cell at each rate.
#[derive(Debug, Clone)]
pub(crate) struct Link {
    pub(crate) mbit: Vec<u32>,
    /// Of a hundred packets every link loses so many.
    pub(crate) loss_percent: u32,
    /// Of one rate each.
    pub(crate) response: Vec<Group>,
    pub(crate) availability: LinkBursts,
    pub(crate) constrained: Constrained,
    /// Calls under each pair of constraints.
    pub(crate) constrained_calls: u32,
}

/// A message that takes longer is left out: a group of them would take minutes.
const LONGEST_MS: u32 = 20;

/// One-way requests on a link, in both distributions; none that takes a link longer than [`LONGEST_MS`].
#[derive(Debug, Clone)]
pub(crate) struct LinkBursts {
    pub(crate) peers: Vec<Contender>,
    pub(crate) mbit: Vec<u32>,
    pub(crate) chars: Vec<u32>,
    periods_ms: Vec<u64>,
    pub(crate) groups: u32,
    pub(crate) group: u32,
}

const COMPARED: [&str; 4] = ["floor", "floor_again", "cara", SECURED];
const AMONG: [&str; 5] = ["floor", "floor_again", "cara", SECURED, "cara_among_1000_idle"];
const SPUN: [&str; 7] = ["floor", "floor_again", "cara", SECURED, SPINNING, SPINNING_SECURED, "cara_among_1000_idle"];
const SHARED: [&str; 5] = ["floor", "floor_again", "cara", SECURED, "cara_one_link"];
/// The paper's sizes, and one beyond them.
const CHARS: [u32; 8] = [1, 10, 100, 1_000, 5_000, 10_000, 20_000, 100_000];
const SOME_CHARS: [u32; 3] = [100, 1_000, 20_000];

impl Plan {
    /// The plan for a machine with these CPUs; `print` in all cells of the response time instead of some.
    pub(crate) fn new(extent: Extent, print: bool, loss_percent: u32, outside: &[Arc<Outside>]) -> Result<Self> {
        let has_two = pin::cpus(Pin::Split).is_ok();
        let pins: &[Pin] = if has_two { &[Pin::Same, Pin::Split, Pin::None] } else { &[Pin::Same, Pin::None] };
        let lacks = [
            (!has_two, "one CPU only: no rows with pin split"),
            (!counted::is_installed(), "valgrind is absent: no instructions in share"),
        ];
        let notes = lacks.into_iter().filter(|(is_lacking, _)| *is_lacking).map(|(_, note)| note.into()).collect();
        let pin = if has_two { Pin::Split } else { Pin::Same };
        let places = if extent == Extent::Full { pins } else { &pins[pins.len() - 2..pins.len() - 1] };
        let response = match extent {
            Extent::Tiny => tiny(outside),
            _ => response(extent, pins, places, print, outside),
        };
        let callers = extent.of(vec![1, 8, 64], vec![1, 8, 64], vec![1, 2]);
        let orders = callers.into_iter().map(|callers| busy_order(callers, extent.of(3_200, 1_600, 8))).collect();
        let setting = Setting { pin, distribution: 1, print: false, wire: None };
        Ok(Self {
            extent,
            response,
            far: far(extent, pin, places),
            throughput: Group { setting, peers: with(&SHARED, outside.iter()), orders, rounds: extent.of(9, 3, 1) },
            throughput_pins: places.to_vec(),
            one_way_peers: with(&COMPARED, outside.iter().filter(|outside| outside.is_one_way())),
            one_way: extent.of(40_000, 40_000, 50),
            share_calls: extent.of(400, 200, 5),
            share_rounds: extent.of(20, 3, 1),
            counted_calls: extent.of(400, 400, 20),
            nodes: extent.of(vec![1, 10, 100, 1_000, 5_000], vec![1, 10, 100, 1_000], vec![1, 3]),
            scale_rounds: extent.of(15, 3, 1),
            scale_calls: extent.of(400, 200, 5),
            availability: availability(extent),
            constrained: constrained(extent),
            link: link(extent, pin, loss_percent, outside),
            pin,
            notes,
        })
    }

    /// Leaves out what is not among `pins` and `chars`, where these are given, and changes the number of turns.
    pub(crate) fn narrow(&mut self, pins: &[Pin], chars: &[u32], rounds: Option<u32>) {
        if !pins.is_empty() {
            self.throughput_pins.retain(|pin| pins.contains(pin));
        }
        for groups in [&mut self.response, &mut self.far] {
            groups.retain(|group| pins.is_empty() || pins.contains(&group.setting.pin));
            for group in &mut *groups {
                group.orders.retain(|order| chars.is_empty() || chars.contains(&order.chars));
                group.rounds = rounds.unwrap_or(group.rounds);
            }
            groups.retain(|group| !group.orders.is_empty());
        }
    }
}

fn order(chars: u32, calls_per_caller: u32, pause_ms: u64) -> Order {
    Order { chars, callers: 1, calls_per_caller, pause_ms, delay_us: 0 }
}

/// Calls of 100 characters, shared among so many callers; fewer than 25 each would measure how threads start.
fn busy_order(callers: u32, calls: u32) -> Order {
    let fewest = calls.min(25);
    Order { callers, ..order(100, (calls / callers).max(fewest), 0) }
}

/// Our own peers, then these other systems.
fn with<'o>(own: &[&'static str], outside: impl Iterator<Item = &'o Arc<Outside>>) -> Vec<Contender> {
    let own = own.iter().map(|name| Contender::Own(name));
    own.chain(outside.map(|outside| Contender::Outside(outside.clone()))).collect()
}

fn tiny(outside: &[Arc<Outside>]) -> Vec<Group> {
    let own = || with(&COMPARED, [].iter());
    let group = |distribution, print, peers, orders| {
        let setting = Setting { pin: Pin::None, distribution, print, wire: None };
        Group { setting, peers, orders, rounds: 1 }
    };
    let orders = || vec![order(1, 5, 0), order(20_000, 5, 0), order(100, 2, 10)];
    let mut groups =
        vec![group(1, false, own(), orders()), group(2, false, own(), orders()), group(1, true, own(), orders())];
    if !outside.is_empty() {
        let floor = with(&["floor"], outside.iter());
        groups.extend([1, 2].map(|distribution| group(distribution, false, floor.clone(), vec![order(1_000, 5, 0)])));
    }
    groups
}

fn orders(chars: &[u32], calls: u32, pause_ms: u64) -> Vec<Order> {
    chars.iter().map(|&chars| order(chars, calls, pause_ms)).collect()
}

/// Back to back at every size, everywhere, also among idle links and beside other systems; then 10 ms apart; then with
/// the service printing. In `places` only, what is not back to back and silent.
fn response(extent: Extent, pins: &[Pin], places: &[Pin], print: bool, outside: &[Arc<Outside>]) -> Vec<Group> {
    let mut groups = Vec::new();
    let mut add = |setting, peers: Vec<Contender>, rounds, orders| {
        groups.push(Group { setting, peers, orders, rounds });
    };
    let own = || with(&COMPARED, [].iter());
    let calls = extent.of(200, 100, 5);
    for distribution in [1, 2] {
        for &pin in pins {
            let setting = Setting { pin, distribution, print, wire: None };
            let is_shortened = extent == Extent::Quick && (pin == Pin::None || distribution == 2);
            // Spinning is for ends with a CPU each.
            let spins = distribution == 1 && pin == Pin::Split;
            let others = if spins { &SPUN[..] } else { &AMONG[..] };
            let peers = if is_shortened { &COMPARED[..] } else { others };
            let outside = if is_shortened || print { &[] } else { outside };
            add(setting, with(peers, outside.iter()), extent.of(24, 4, 1), orders(&CHARS, calls, 0));
        }
        for &pin in places {
            let setting = Setting { pin, distribution, print, wire: None };
            let (chars, rounds) = extent.of((&CHARS[..], 12), (&SOME_CHARS[..], 1), (&SOME_CHARS[..], 1));
            // In distribution 2 the peers do not wait side by side.
            let calls = if extent == Extent::Full && distribution == 1 { 20 } else { 10 };
            add(setting, own(), rounds, orders(chars, calls, 10));
        }
        for &pin in places.iter().filter(|_| !print && (extent == Extent::Full || distribution == 1)) {
            let setting = Setting { pin, distribution, print: true, wire: None };
            add(setting, own(), extent.of(12, 4, 1), orders(&CHARS, calls, 0));
        }
    }
    groups
}

/// The paper's pause between a reply and the next request.
const PAUSE_MS: u64 = 2_000;

/// As the paper's: with printing, a hundred calls of each size in full. Distribution 2 at one place only.
fn far(extent: Extent, pin: Pin, places: &[Pin]) -> Vec<Group> {
    let group = |(distribution, pin)| {
        let chars = extent.of(&CHARS[..], &SOME_CHARS, &[100]);
        let (rounds, calls) = match (extent, distribution) {
            (Extent::Full, _) => (10, 10),
            (Extent::Quick, 1) => (1, 3),
            _ => (1, 2),
        };
        let pause_ms = extent.of(PAUSE_MS, PAUSE_MS, 50);
        let setting = Setting { pin, distribution, print: true, wire: None };
        Group { setting, peers: with(&COMPARED, [].iter()), orders: orders(chars, calls, pause_ms), rounds }
    };
    places.iter().map(|&pin| (1, pin)).chain([(2, pin)]).map(group).collect()
}

fn availability(extent: Extent) -> Vec<Bursts> {
    use cara_bench_ends::Delivery::{BestEffort, Reliable};
    let (groups, group) = extent.of((10, 100), (1, 100), (1, 5));
    let bursts = |distribution, delivery, chars: &[u32], periods_ms: &[u64]| Bursts {
        distribution,
        delivery,
        chars: chars.to_vec(),
        periods_ms: periods_ms.to_vec(),
        groups,
        group,
    };
    let all = [0, 1, 2, 5, 10, 20, 50, 70, 80, 100];
    let periods: &[u64] = extent.of(&all[..], &[0, 1, 10, 20, 70], &[0, 1]);
    let chars: &[u32] = extent.of(&[100, 1_000, 5_000, 10_000, 20_000], &[100, 20_000], &[100, 20_000]);
    // A datagram holds at most 1,400 bytes: a longer text is refused at once, whatever the period.
    let short: &[u32] = extent.of(chars, &[1_000], &[100]);
    let short_periods: &[u64] = extent.of(&all[..], &[0, 1, 10], &[0, 1]);
    let refused: &[u32] = extent.of(&[], &[5_000], &[5_000]);
    [1, 2]
        .into_iter()
        .flat_map(|distribution| {
            [
                bursts(distribution, Reliable, chars, periods),
                bursts(distribution, BestEffort, short, short_periods),
                bursts(distribution, BestEffort, refused, &[0]),
            ]
        })
        .collect()
}

fn link(extent: Extent, pin: Pin, loss_percent: u32, outside: &[Arc<Outside>]) -> Link {
    let outside = || outside.iter().filter(|outside| outside.has_cable());
    let mbit = extent.of(vec![10, 20, 100], vec![20], vec![100]);
    let chars: &[u32] = extent.of(&CHARS, &SOME_CHARS, &[100]);
    let (rounds, calls) = extent.of((5, 20), (2, 5), (1, 3));
    let group = |(distribution, mbit)| {
        let wire = Some(Wire { mbit, loss_percent });
        let setting = Setting { pin, distribution, print: true, wire };
        Group { setting, peers: with(&COMPARED, outside()), orders: orders(chars, calls, 20), rounds }
    };
    let cells = [1, 2].into_iter().flat_map(|distribution| mbit.iter().map(move |&mbit| (distribution, mbit)));
    Link {
        response: cells.map(group).collect(),
        availability: LinkBursts {
            peers: with(&["floor", "cara", SECURED], outside().filter(|outside| outside.is_one_way())),
            // The slowest one fills with what a datagram holds.
            mbit: [extent.of(&[2][..], &[2], &[]), &mbit].concat(),
            chars: extent.of(vec![1_000, 10_000, 20_000], vec![1_000, 20_000], vec![1_000, 20_000]),
            periods_ms: extent.of(vec![1, 2, 5, 8, 10, 15, 20, 30, 50, 80], vec![5, 10, 20], vec![1]),
            groups: extent.of(5, 1, 1),
            group: extent.of(200, 100, 5),
        },
        constrained: Constrained {
            intervals_ms: extent.of(vec![0, 2, 5, 10, 20, 50], vec![0, 10], vec![0]),
            message_sizes: extent.of(vec![1_024, 8_192, 32_768], vec![1_024, 32_768], vec![32_768]),
            chars: extent.of(vec![100, 1_000, 5_000, 20_000], vec![1_000, 20_000], vec![1_000]),
            period_ms: 5,
            count: extent.of(400, 100, 5),
        },
        constrained_calls: extent.of(50, 10, 2),
        mbit,
        loss_percent,
    }
}

fn constrained(extent: Extent) -> Constrained {
    Constrained {
        intervals_ms: extent.of(vec![0, 1, 2, 5, 10, 20, 50], vec![0, 2, 10], vec![0, 5]),
        message_sizes: extent.of(vec![1_024, 8_192, 32_768], vec![1_024, 32_768], vec![1_024, 32_768]),
        chars: extent.of(vec![100, 1_000, 5_000, 20_000], vec![100, 20_000], vec![100, 20_000]),
        period_ms: extent.of(2, 2, 1),
        count: extent.of(1_000, 100, 5),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn in_full_a_hundred_echoes_two_seconds_apart_are_made_of_each_size() {
        let plan = Plan::new(Extent::Full, false, 0, &[]).unwrap();
        for distribution in [1, 2] {
            let group = plan.far.iter().find(|group| group.setting.distribution == distribution).unwrap();
            assert!(group.setting.print);
            assert_eq!(group.orders.iter().map(|order| order.chars).collect::<Vec<_>>(), CHARS);
            for order in &group.orders {
                assert_eq!((group.rounds * order.calls_per_caller, order.pause_ms), (100, 2_000));
            }
        }
    }

    #[test]
    fn in_full_a_thousand_requests_are_made_at_each_period_in_groups_of_a_hundred() {
        let plan = Plan::new(Extent::Full, false, 0, &[]).unwrap();
        for distribution in [1, 2] {
            let reliable = |bursts: &&Bursts| {
                bursts.distribution == distribution && bursts.delivery == cara_bench_ends::Delivery::Reliable
            };
            let bursts = plan.availability.iter().find(reliable).unwrap();
            assert_eq!((bursts.groups * bursts.group, bursts.group), (1_000, 100));
            assert!([10_000, 20_000].iter().all(|chars| bursts.chars.contains(chars)), "{:?}", bursts.chars);
            assert!(
                [10, 20, 70, 80].iter().all(|period| bursts.periods_ms.contains(period)),
                "{:?}",
                bursts.periods_ms
            );
        }
    }
}
