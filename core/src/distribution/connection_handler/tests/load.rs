//! The load of discovery on a network, and how long it takes: the figures of `docs/performance.md`.
//! Print them with `cargo test -p cara-core --lib connection_handler::tests::load -- --nocapture --test-threads 1`.

use std::println;
use std::string::String;

use super::network::{Network, Sort};
use super::*;

const SIZES: [u32; 4] = [20, 100, 250, 1_000];
const LATENCY: Duration = Duration::from_millis(3);
const SEEDS: u64 = 5;

/// The worst of several seeds.
#[derive(Default)]
struct Worst {
    last: Duration,
    most: Duration,
    searches: usize,
    answers: usize,
    broadcasts: usize,
    busiest: usize,
    /// Most broadcasts within ten seconds.
    in_ten: usize,
    unicasts: usize,
    dials: usize,
    crowd: usize,
}

impl Worst {
    fn add(&mut self, network: &Network, start: Instant) {
        let joins = network.joins().unwrap_or_default();
        let since = |at: Option<&Instant>| at.map_or(Duration::MAX, |at| at.since(start));
        self.last = self.last.max(since(joins.last()));
        self.most = self.most.max(since(joins.get(joins.len() * 95 / 100)));
        self.searches = self.searches.max(network.count(Sort::Search));
        self.answers = self.answers.max(network.count(Sort::Answer));
        self.broadcasts = self.broadcasts.max(network.broadcasts.len());
        let busiest = Network::busiest(&network.broadcast_times(), Duration::from_secs(1));
        self.busiest = self.busiest.max(busiest);
        self.in_ten = self.in_ten.max(Network::busiest(&network.broadcast_times(), Duration::from_secs(10)));
        self.unicasts = self.unicasts.max(network.unicasts);
        self.dials = self.dials.max(network.dials);
        self.crowd = self.crowd.max(Network::busiest(&joins, Duration::from_millis(10)));
    }

    fn show(&self, what: &str) -> String {
        let Self { searches, answers, broadcasts, busiest, in_ten, unicasts, dials, crowd, .. } = self;
        let (most, last) = (self.most.as_millis(), self.last.as_millis());
        let row = std::format!(
            "| {what} | {most} ms | {last} ms | {searches} + {answers} = {broadcasts} | {busiest} | {in_ten} | {unicasts} | {dials} | {crowd} |"
        );
        println!("{row}");
        row
    }

    /// Whatever nodes come and when, no ten seconds bring more broadcasts than this.
    fn assert_calm(&self, what: &str) {
        assert!(self.in_ten <= 50, "{} broadcasts in ten seconds, {what}", self.in_ten);
    }

    fn assert_within(&self, last: Duration, broadcasts: usize, what: &str) {
        let row = self.show(what);
        assert!(self.last <= last && self.broadcasts <= broadcasts, "{row}");
    }
}

fn title(text: &str) {
    println!(
        "\n{text}\n| s_units | 95 % joined | all joined | who-has + announce broadcasts | most in 1 s | most in 10 s | unicasts | dials | most links in 10 ms |"
    );
    println!("|---|---|---|---|---|---|---|---|---|");
}

/// Runs until `seconds` after `start`; what was sent before `count_from` does not count.
fn measure(worst: &mut Worst, mut network: Network, count_from: Instant, start: Instant, seconds: u64) {
    if count_from > Instant::START {
        network.run_until(count_from);
        network.broadcasts.clear();
        (network.unicasts, network.dials) = (0, 0);
    }
    network.run_until(start + Duration::from_secs(seconds));
    worst.add(&network, start);
}

#[test]
fn everything_is_switched_on_at_once() {
    for loss in [0, 2, 5, 10] {
        title(&std::format!("At once, {loss} % loss"));
        for size in SIZES {
            let mut worst = Worst::default();
            for seed in 0..SEEDS {
                let mut network = Network::new(seed, loss, LATENCY);
                network.add_fleet(MANAGER, size, at(0), at(0), Duration::ZERO);
                measure(&mut worst, network, at(0), at(0), 60);
            }
            let (last, broadcasts) = if loss == 0 { (5, 20) } else { (30, 40) };
            worst.assert_within(Duration::from_secs(last), broadcasts, &std::format!("{size}"));
        }
    }
}

/// One question in four is answered, and half of what would hold back others is not heard.
#[test]
fn where_half_of_all_datagrams_are_lost_everybody_joins_in_the_end() {
    title("At once, 50 % loss");
    for size in [20, 100, 250] {
        let mut worst = Worst::default();
        for seed in 0..SEEDS {
            let mut network = Network::new(seed, 50, LATENCY);
            network.add_fleet(MANAGER, size, at(0), at(0), Duration::ZERO);
            measure(&mut worst, network, at(0), at(0), 600);
        }
        worst.assert_within(Duration::from_secs(600), 250, &std::format!("{size}"));
    }
}

#[test]
fn units_and_manager_are_switched_on_at_random() {
    for (spread, broadcasts) in [(1_000, 20), (2_000, 20), (5_000, 40), (30_000, 160)] {
        title(&std::format!("At random within {spread} ms, no loss"));
        for size in SIZES {
            let mut worst = Worst::default();
            for seed in 0..SEEDS {
                let mut network = Network::new(seed, 0, LATENCY);
                let manager_on = Instant::START + Random::new(seed).jitter(Duration::from_millis(spread));
                network.add_fleet(MANAGER, size, manager_on, at(0), Duration::from_millis(spread));
                measure(&mut worst, network, at(0), at(0), 90);
            }
            // Units that start within two seconds hold back for each other; those that start within half a minute, in groups.
            worst.assert_within(Duration::from_millis(spread + 5_000), broadcasts, &std::format!("{size}"));
            worst.assert_calm(&std::format!("{size} within {spread} ms"));
        }
    }
}

#[test]
fn the_manager_restarts() {
    for (away, notice, loss) in [(1, 0, 0), (1, 4_000, 0), (30, 0, 0), (30, 0, 5), (1, 4_000, 10)] {
        title(&std::format!("Manager away {away} s, noticed within {notice} ms, {loss} % loss"));
        for size in SIZES {
            let mut worst = Worst::default();
            for seed in 0..SEEDS {
                let mut network = Network::new(seed, loss, LATENCY);
                network.notice = Duration::from_millis(notice);
                network.add_fleet(MANAGER, size, at(0), at(0), Duration::ZERO);
                network.switch(0, at(60_000), at(60_000 + away * 1_000));
                measure(&mut worst, network, at(60_000), at(60_000 + away * 1_000), 60);
            }
            let (last, broadcasts) = if loss == 0 { (10, 20) } else { (40, 40) };
            worst.assert_within(Duration::from_secs(last), broadcasts, &std::format!("{size}"));
        }
    }
}

#[test]
fn one_s_unit_comes_to_a_running_manager() {
    let (mut total, mut longest, mut broadcasts) = (0, 0, 0);
    for seed in 0..200 {
        let mut network = Network::new(seed, 0, LATENCY);
        network.add_fleet(MANAGER, 1, at(0), at(60_000), Duration::ZERO);
        network.run_until(at(60_000));
        network.broadcasts.clear();
        network.run_until(at(62_000));
        let took = network.joins().expect("it joined")[0].since(at(60_000)).as_millis();
        (total, longest, broadcasts) = (total + took, longest.max(took), broadcasts.max(network.broadcasts.len()));
    }
    println!("\nOne s_unit, 200 seeds: {} ms on average, {longest} ms at most", total / 200);
    // Longer than its own 400 ms only if the manager has just asked for a fleet of a thousand.
    assert!(longest <= 1_500 && broadcasts <= 1, "{longest} ms, {broadcasts} broadcasts");
}

#[test]
fn two_fleets_share_a_network() {
    for (spread, loss) in [(0, 0), (2_000, 0), (0, 5)] {
        title(&std::format!("Two managers and two fleets, within {spread} ms, {loss} % loss"));
        for size in [20, 100, 500] {
            let mut worst = Worst::default();
            for seed in 0..SEEDS {
                let mut network = Network::new(seed, loss, LATENCY);
                for name in ["east", "west"] {
                    network.add_fleet(name, size, at(0), at(0), Duration::from_millis(spread));
                }
                measure(&mut worst, network, at(0), at(0), 60);
            }
            let last = if loss == 0 { 5 } else { 30 };
            worst.assert_within(Duration::from_secs(last), 2 * 20, &std::format!("2 × {size}"));
        }
    }
}
