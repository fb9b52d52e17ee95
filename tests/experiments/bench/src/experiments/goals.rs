//! The project's goals, and which of them a run reaches; each figure comes from the rows of the run itself.

use cara_bench_ends::{Delivery, Pin};

use crate::peers::SPINNING;
use crate::results::{Availability, Goal, Kind, Mode, Response, Results, ratio};

/// Where round trips have goals.
const PINS: [Pin; 2] = [Pin::Same, Pin::Split];
const MODES: [Mode; 2] = [Mode::Plain, Mode::Secured];
const ALL: [u32; 8] = [1, 10, 100, 1_000, 5_000, 10_000, 20_000, 100_000];
const OURS: &str = "cara";
/// Bytes of memory per node.
const NODE_BYTES: f64 = 8_192.0;

/// What a figure must be.
#[derive(Clone, Copy)]
enum Limit {
    AtMost(f64),
    AtLeast(f64),
    Below(f64),
}

impl Limit {
    fn admits(self, figure: f64) -> bool {
        match self {
            Self::AtMost(limit) => figure <= limit,
            Self::AtLeast(limit) => figure >= limit,
            Self::Below(limit) => figure < limit,
        }
    }

    fn text(self) -> String {
        match self {
            Self::AtMost(limit) => format!("≤ {limit}"),
            Self::AtLeast(limit) => format!("≥ {limit}"),
            Self::Below(limit) => format!("< {limit}"),
        }
    }

    /// The figure that is furthest from it, with what it belongs to.
    fn worst<T>(self, figures: impl Iterator<Item = (f64, T)>) -> Option<(f64, T)> {
        match self {
            Self::AtLeast(_) => figures.min_by(|one, other| one.0.total_cmp(&other.0)),
            _ => figures.max_by(|one, other| one.0.total_cmp(&other.0)),
        }
    }
}

fn goal(quantity: &str, cell: impl Into<String>, limit: Limit, figure: Option<f64>) -> Goal {
    let is_reached = figure.map(|figure| limit.admits(figure));
    Goal { quantity: quantity.into(), cell: cell.into(), goal: limit.text(), figure, is_reached }
}

/// All of them, in the order of the project's own list.
pub(crate) fn of(results: &Results) -> Vec<Goal> {
    [
        round_trips(results),
        best_peer(results),
        distribution_2(results),
        requests(results),
        cpu(results),
        availability(results),
        secured(results),
        share(results),
        scale(results),
        one_way(results),
    ]
    .concat()
}

/// Back to back, silent.
fn calls<'r>(results: &'r Results, peer: &str, mode: Mode, distribution: u8, pin: Pin) -> Vec<&'r Response> {
    let cell = |row: &Response| (row.mode, row.distribution, row.pin, row.pause_ms, row.print);
    let is_wanted = |row: &&Response| row.peer == peer && cell(row) == (mode, distribution, pin, 0, false);
    results.response.iter().filter(is_wanted).collect()
}

/// The worst of these sizes.
fn worst(
    quantity: &str,
    (pin, sizes, limit): (Pin, &[u32], Limit),
    rows: &[&Response],
    figure: impl Fn(&Response) -> Option<f64>,
) -> Goal {
    let rows = rows.iter().filter(|row| sizes.contains(&row.chars));
    let found = limit.worst(rows.filter_map(|row| Some((figure(row)?, row.chars))));
    let range = match sizes {
        [only] => format!("{pin}, {only} characters"),
        _ => format!("{pin}, {} to {} characters", sizes.first().unwrap_or(&0), sizes.last().unwrap_or(&0)),
    };
    let at = found.filter(|_| sizes.len() > 1).map(|(_, chars)| format!("; the worst: {chars}")).unwrap_or_default();
    goal(quantity, range + &at, limit, found.map(|(figure, _)| figure))
}

fn round_trips(results: &Results) -> Vec<Goal> {
    let of = |pin| match pin {
        Pin::Split => vec![(&ALL[..], 1.05)],
        _ => vec![(&ALL[..7], 1.10), (&ALL[7..], 1.15)],
    };
    let mut goals = Vec::new();
    for pin in PINS {
        let rows = calls(results, OURS, Mode::Plain, 1, pin);
        goals.extend(of(pin).into_iter().map(|(sizes, most)| {
            worst("round trip / floor, median", (pin, sizes, Limit::AtMost(most)), &rows, |row| Some(row.ratio))
        }));
    }
    goals.extend(PINS.map(|pin| {
        let rows = calls(results, OURS, Mode::Plain, 1, pin);
        worst("p99 / floor's p99", (pin, &ALL[..7], Limit::AtMost(1.25)), &rows, |row| Some(row.p99_ratio))
    }));
    goals.extend(MODES.map(|mode| {
        let rows = calls(results, SPINNING, mode, 1, Pin::Split);
        let quantity = format!("both ends spin, {}: round trip / floor, median", mode.name());
        worst(&quantity, (Pin::Split, &ALL, Limit::Below(1.0)), &rows, |row| Some(row.ratio))
    }));
    goals
}

fn best_peer(results: &Results) -> Vec<Goal> {
    let mut goals = Vec::new();
    for pin in PINS {
        for own in calls(results, OURS, Mode::Plain, 1, pin) {
            let others = results.run.peers.iter().flat_map(|outside| {
                let rows = calls(results, &outside.peer, Mode::Plain, 1, pin);
                rows.into_iter().filter(|row| row.chars == own.chars)
            });
            let best = others.min_by(|one, other| one.ratio.total_cmp(&other.ratio));
            goals.extend(best.map(|best| {
                let cell = format!("{pin}, {} characters, the best: {}", own.chars, best.peer);
                let figure = ratio(own.ratio / best.ratio.max(1e-9));
                goal("round trip / that of the best other system", cell, Limit::Below(1.0), Some(figure))
            }));
        }
    }
    if goals.is_empty() {
        let cell = "no other system was measured";
        goals.push(goal("round trip / that of the best other system", cell, Limit::Below(1.0), None));
    }
    goals
}

fn distribution_2(results: &Results) -> Vec<Goal> {
    let of = |pin| {
        let rows = calls(results, OURS, Mode::Plain, 2, pin);
        let (median, tail) = ((pin, &ALL[..], Limit::AtMost(1.10)), (pin, &ALL[..], Limit::AtMost(1.25)));
        [
            worst("distribution 2: round trip / floor, median", median, &rows, |row| Some(row.ratio)),
            worst("distribution 2: p99 / floor's p99", tail, &rows, |row| Some(row.p99_ratio)),
        ]
    };
    PINS.map(of).concat()
}

fn requests(results: &Results) -> Vec<Goal> {
    let mut goals = Vec::new();
    for pin in PINS {
        for callers in [1, 8, 64] {
            let row = results.throughput.iter().find(|row| {
                let cell = (row.kind, row.mode, row.pin, row.callers);
                row.peer == OURS && cell == (Kind::Request, Mode::Plain, pin, callers)
            });
            let cell = format!("{pin}, {callers} callers");
            goals.push(goal("requests/s / floor's", cell, Limit::AtLeast(0.95), row.map(|row| row.ratio)));
        }
    }
    goals
}

fn cpu(results: &Results) -> Vec<Goal> {
    let of = |pin| {
        let rows = calls(results, OURS, Mode::Plain, 1, pin);
        worst("CPU per call / floor's", (pin, &ALL[..], Limit::AtMost(1.15)), &rows, |row| Some(row.cpu_ratio))
    };
    PINS.map(of).to_vec()
}

fn availability(results: &Results) -> Vec<Goal> {
    let mut goals = Vec::new();
    for distribution in [1, 2] {
        for mode in MODES {
            let cell = format!("distribution {distribution}, {}", mode.name());
            let rows = || {
                let is_wanted = move |row: &&Availability| {
                    (row.distribution, row.mode, row.delivery) == (distribution, mode, Delivery::Reliable)
                };
                results.availability.iter().filter(is_wanted)
            };
            let spaced = rows().filter(|row| row.period_ms > 0).map(|row| (row.counts.executed_of_offered, ()));
            let limit = Limit::AtLeast(1.0);
            let least = limit.worst(spaced).map(|(figure, ())| figure);
            goals.push(goal("executed / offered, periods of 1 ms and more", &cell, limit, least));
            let at_once = || rows().filter(|row| row.period_ms == 0);
            let lost = at_once().map(|row| row.counts.lost as f64).reduce(|one, other| one + other);
            goals.push(goal("lost without an error at period 0", &cell, Limit::AtMost(0.0), lost));
            if mode == Mode::Plain {
                let limit = Limit::AtLeast(0.9);
                let slowest = limit.worst(at_once().filter_map(|row| Some((row.ratio?, row.chars))));
                let at = slowest.map(|(_, chars)| format!("{cell}; the worst: {chars} characters")).unwrap_or(cell);
                goals.push(goal("executed/s / floor's at period 0", at, limit, slowest.map(|(figure, _)| figure)));
            }
        }
    }
    goals
}

fn secured(results: &Results) -> Vec<Goal> {
    let rows = calls(results, OURS, Mode::Secured, 1, Pin::Same);
    let of = |(chars, most)| {
        let limit = Limit::AtMost(most);
        worst("secured round trip / floor, median", (Pin::Same, &[chars], limit), &rows, |row| Some(row.ratio))
    };
    [(100, 1.15), (20_000, 1.8), (100_000, 2.6)].map(of).to_vec()
}

fn share(results: &Results) -> Vec<Goal> {
    let share = results.share.as_ref().map(|share| ratio(share.generate + share.process));
    vec![goal("generating + processing / round trip", "same, 20000 characters", Limit::AtMost(0.07), share)]
}

fn scale(results: &Results) -> Vec<Goal> {
    let of = |mode: Mode| {
        let row = results.scale.iter().find(|row| (row.nodes, row.mode) == (1_000, mode));
        let cell = format!("1000 nodes, {}", mode.name());
        let memory = row.map(|row| row.rss_per_node_bytes as f64);
        [
            goal("request among nodes / with one", &cell, Limit::AtMost(1.15), row.map(|row| row.request_ratio)),
            goal("bytes of the manager per node", cell, Limit::AtMost(NODE_BYTES), memory),
        ]
    };
    MODES.map(of).concat()
}

fn one_way(results: &Results) -> Vec<Goal> {
    let of = |pin| {
        let speed = |peer: &str| {
            let cell = (Kind::OneWay, Mode::Plain, pin);
            results.throughput.iter().find(|row| row.peer == peer && (row.kind, row.mode, row.pin) == cell)
        };
        let figure = speed(OURS).zip(speed("zenoh")).map(|(own, zenoh)| ratio(own.ratio / zenoh.ratio.max(1e-9)));
        goal("one-way messages/s / zenoh's", format!("{pin}, 100 characters"), Limit::AtLeast(1.0), figure)
    };
    PINS.map(of).to_vec()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::Throughput;

    fn throughput(kind: Kind, peer: &str, ratio: f64) -> Throughput {
        Throughput {
            kind,
            peer: peer.into(),
            callers: 1,
            chars: 100,
            pin: Pin::Split,
            mode: Mode::Plain,
            n: 1,
            requests_per_s: 1.0,
            ratio,
            refused: 0,
            lost: 0,
        }
    }

    fn reached(results: &Results, quantity: &str, cell: &str) -> Option<bool> {
        let all = of(results);
        all.into_iter().find(|goal| goal.quantity == quantity && goal.cell.starts_with(cell)).unwrap().is_reached
    }

    #[test]
    fn what_was_not_measured_is_neither_reached_nor_missed() {
        assert!(of(&Results::default()).iter().all(|goal| goal.figure.is_none() && goal.is_reached.is_none()));
    }

    #[test]
    fn a_figure_is_held_against_its_goal() {
        let throughput = vec![
            throughput(Kind::Request, OURS, 0.95),
            throughput(Kind::OneWay, OURS, 1.9),
            throughput(Kind::OneWay, "zenoh", 2.0),
        ];
        let results = Results { throughput, ..Results::default() };
        assert_eq!(reached(&results, "requests/s / floor's", "split, 1 callers"), Some(true));
        assert_eq!(reached(&results, "requests/s / floor's", "split, 8"), None);
        assert_eq!(reached(&results, "one-way messages/s / zenoh's", "split"), Some(false));
    }

    #[test]
    fn the_worst_is_the_furthest_from_the_goal() {
        let figures = || [1.0, 3.0, 2.0].into_iter().map(|figure| (figure, ()));
        assert_eq!(Limit::AtMost(1.0).worst(figures()), Some((3.0, ())));
        assert_eq!(Limit::AtLeast(1.0).worst(figures()), Some((1.0, ())));
    }
}
