//! The paper's figures 6 to 8 on links that fill, a column for each rate; best effort and constraints on them.

use cara_bench_ends::Delivery;

use super::axis::Axis;
use super::chart::{Chart, Kind, Line, Point};
use super::{Figure, LONG, ON_LINKS, paper, paper_falls, round_trips};
use crate::experiments::SIMULATED;
use crate::results::{LinkAvailability, LinkConstrained, Mode, Response, Results, measured};

/// From this share on, and at every longer period, requests count as available.
const AVAILABLE: f64 = 0.95;
/// The longest text of a best-effort request.
const SHORT: u32 = 1_000;

pub(super) fn figures(results: &Results) -> Vec<Figure> {
    let mut rates: Vec<u32> = measured(&results.link_response).map(|(mbit, _)| mbit).collect();
    rates.sort_unstable();
    rates.dedup();
    let offered = measured(&results.link_availability).filter(|(_, row)| row.peer != SIMULATED);
    let n = offered.map(|(_, row)| row.counts.offered).min().unwrap_or(0);
    let called = measured(&results.link_response).filter(|(_, row)| row.peer != SIMULATED);
    let calls = called.map(|(_, row)| row.n).min().unwrap_or(0);
    let of_calls = format!("response time: n = {calls} a point, bars: quartiles");
    let of_requests = format!("availability: n = {n} a point, bars: worst and best group");
    let ring = format!("ring: from here on {} % and more in time", AVAILABLE * 100.0);
    let full = "dotted, upright: texts of so many characters fill the link";
    let about = |lines: &[&str]| lines.iter().map(|line| (*line).to_owned()).collect::<Vec<_>>();
    let columns = |chart: &dyn Fn(u32) -> Chart| rates.iter().map(|&mbit| chart(mbit)).collect::<Vec<_>>();
    let both = |distribution| {
        vec![
            columns(&|mbit| response(results, mbit, distribution)),
            columns(&|mbit| by_size(results, mbit, distribution)),
        ]
    };
    let said = [of_calls.as_str(), of_requests.as_str(), ring.as_str(), full];
    vec![
        Figure { name: "link-6", rows: both(1), about: about(&said) },
        Figure { name: "link-7", rows: both(2), about: about(&said) },
        Figure {
            name: "link-8",
            rows: [1, 2].map(|distribution| columns(&|mbit| long(results, mbit, distribution))).into(),
            about: about(&said[1..]),
        },
        Figure {
            name: "link-best-effort",
            rows: vec![[1, 2].map(|distribution| slowest(results, distribution)).into()],
            about: about(&said[1..]),
        },
        Figure {
            name: "link-constraints",
            rows: vec![
                columns(&|mbit| {
                    constraints(results, mbit, "executed in time / offered", |row| Some(row.in_time_of_offered))
                }),
                columns(&|mbit| {
                    constraints(results, mbit, "refused / offered", |row| {
                        Some(row.counts.refused as f64 / row.counts.offered.max(1) as f64)
                    })
                }),
                columns(&|mbit| constraints(results, mbit, "round trip, ms, median", |row| Some(row.p50_us? / 1e3))),
            ],
            about: about(&[
                "reliable, plain; one-way requests every 5 ms",
                "message_size is enough for every text drawn",
                "no line: every call is refused",
            ]),
        },
    ]
}

/// Response time by size, with what the bits of the text alone take there and back.
fn response(results: &Results, mbit: u32, distribution: u8) -> Chart {
    let rows = measured(&results.link_response).filter(|(rate, row)| (*rate, row.distribution) == (mbit, distribution));
    let of = |peer: &str, mode: Mode| {
        let is_wanted = move |row: &&Response| row.peer == peer && row.mode == mode;
        round_trips(rows.clone().map(|(_, row)| row).filter(is_wanted)).into_iter().map(in_ms).collect::<Vec<_>>()
    };
    let mut lines: Vec<Line> =
        ON_LINKS.iter().map(|(peer, mode, name)| Line::measured(*name, of(peer, *mode))).collect();
    let wire = [1_000.0, 100_000.0].map(|chars| (chars, 2.0 * chars * 8.0 / f64::from(mbit) / 1e3));
    lines.push(Line::of(Kind::Reckoned, "the bits of both texts alone", &wire));
    let title = format!("Response time, {mbit} Mbit/s, distribution {distribution}");
    Chart::new(title, Axis::log("characters"), Axis::log("ms, median"), lines)
}

fn in_ms(point: Point) -> Point {
    let spread = point.spread.map(|(low, high)| (low / 1e3, high / 1e3));
    Point { y: point.y / 1e3, spread, ..point }
}

/// Requests that were executed in time, by period.
fn in_time(results: &Results, mbit: u32, is_wanted: impl Fn(&LinkAvailability) -> bool) -> Vec<Point> {
    let rows = measured(&results.link_availability).filter(|(rate, row)| *rate == mbit && is_wanted(row));
    let point = |row: &LinkAvailability| {
        Point::new(row.period_ms as f64, row.in_time_of_offered).with_spread(row.worst_group, row.best_group)
    };
    let mut points: Vec<Point> = rows.map(|(_, row)| point(row)).collect();
    points.sort_by(|one, other| one.x.total_cmp(&other.x));
    // The shortest period from which on nothing falls; none where nothing ever fell.
    let fallen = points.iter().rposition(|point| point.y < AVAILABLE);
    if let Some(knee) = fallen.and_then(|last| points.get_mut(last + 1)) {
        knee.is_knee = true;
    }
    points
}

fn axes() -> (Axis, Axis) {
    (Axis::log("period, ms"), Axis::share("executed in time / offered"))
}

/// The period at which so many characters fill the link.
fn full(chars: u32, mbit: u32) -> (f64, String) {
    (f64::from(chars) * 8.0 / f64::from(mbit) / 1e3, format!("{chars} characters"))
}

/// CARA's availability, one line per size.
fn by_size(results: &Results, mbit: u32, distribution: u8) -> Chart {
    let mut sizes: Vec<u32> = measured(&results.link_availability).map(|(_, row)| row.chars).collect();
    sizes.sort_unstable();
    sizes.dedup();
    let of = |chars: u32| {
        in_time(results, mbit, |row| {
            let cell = (row.peer.as_str(), row.mode, row.delivery, row.chars, row.distribution);
            cell == ("cara", Mode::Plain, Delivery::Reliable, chars, distribution)
        })
    };
    let mut lines: Vec<Line> =
        sizes.iter().map(|&chars| Line::measured(format!("CARA, {chars} characters"), of(chars))).collect();
    lines.extend([10_000, LONG].into_iter().filter_map(|longest| paper(distribution, longest)));
    let (x, y) = axes();
    let mut chart = Chart::new(format!("Availability, {mbit} Mbit/s, distribution {distribution}"), x, y, lines);
    chart.knees = sizes.iter().map(|&chars| full(chars, mbit)).filter(|(period, _)| *period >= 1.0).collect();
    chart.knees.extend([10_000, LONG].into_iter().flat_map(|longest| paper_falls(distribution, longest)));
    chart
}

/// Availability at the paper's longest text, one line per peer.
fn long(results: &Results, mbit: u32, distribution: u8) -> Chart {
    let of = |peer: &str, mode: Mode| {
        in_time(results, mbit, |row| {
            let cell = (row.peer.as_str(), row.mode, row.delivery, row.chars, row.distribution);
            cell == (peer, mode, Delivery::Reliable, LONG, distribution)
        })
    };
    let mut lines: Vec<Line> =
        ON_LINKS.iter().map(|(peer, mode, name)| Line::measured(*name, of(peer, *mode))).collect();
    lines.extend(paper(distribution, LONG));
    let (x, y) = axes();
    let title = format!("{LONG} characters, {mbit} Mbit/s, distribution {distribution}");
    let mut chart = Chart::new(title, x, y, lines);
    chart.knees = std::iter::once(full(LONG, mbit)).chain(paper_falls(distribution, LONG)).collect();
    chart
}

/// Best effort beside reliable on the slowest link.
fn slowest(results: &Results, distribution: u8) -> Chart {
    let mbit = measured(&results.link_availability).map(|(mbit, _)| mbit).min().unwrap_or(0);
    let of = |peer: &str, mode: Mode, delivery: Delivery| {
        in_time(results, mbit, |row| {
            let cell = (row.peer.as_str(), row.mode, row.delivery, row.chars, row.distribution);
            cell == (peer, mode, delivery, SHORT, distribution)
        })
    };
    let mut lines = Vec::new();
    for (peer, mode, name) in ON_LINKS {
        lines.push(Line::measured(name, of(peer, mode, Delivery::Reliable)));
        lines.push(Line::measured(format!("{name}, best effort"), of(peer, mode, Delivery::BestEffort)));
    }
    let (x, y) = axes();
    let title = format!("{SHORT} characters, {mbit} Mbit/s, distribution {distribution}");
    let mut chart = Chart::new(title, x, y, lines);
    chart.knees = vec![full(SHORT, mbit)];
    chart
}

/// A figure against the minimum interval, one line per size of the text, where the longest message is allowed.
fn constraints(
    results: &Results,
    mbit: u32,
    label: &'static str,
    figure: impl Fn(&LinkConstrained) -> Option<f64>,
) -> Chart {
    let rows = || measured(&results.link_constraints).filter(|(rate, _)| *rate == mbit).map(|(_, row)| row);
    let longest = rows().map(|row| row.message_size).max().unwrap_or(0);
    let rows = || {
        rows().filter(|row| (row.message_size, row.mode, row.delivery) == (longest, Mode::Plain, Delivery::Reliable))
    };
    let mut sizes: Vec<u32> = rows().map(|row| row.chars).collect();
    sizes.sort_unstable();
    sizes.dedup();
    let line = |chars: u32| {
        let point = |row: &LinkConstrained| Some(Point::new(row.minimum_interval_ms as f64, figure(row)?));
        let points = rows().filter(|row| row.chars == chars).filter_map(point).collect();
        Line::measured(format!("{chars} characters"), points)
    };
    let lines = sizes.into_iter().map(line).collect();
    let y = if label.starts_with("round trip") { Axis::log(label) } else { Axis::share(label) };
    Chart::new(format!("Constraints, {mbit} Mbit/s"), Axis::linear("minimum interval, ms"), y, lines)
}
