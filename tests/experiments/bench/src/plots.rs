//! The paper's figures from a run: 6 and 7 (response time and availability in each distribution), 8 (availability at
//! 20,000 characters in both), on loopback and on links that fill; the ratios to the floor, and those of other systems.

mod axis;
mod chart;
mod link;

use std::path::Path;

use anyhow::{Context, Result};

use crate::deadlines::Share;
use crate::experiments::SIMULATED;
use crate::results::{Availability, Mode, Response, Results};
use crate::soak::{self, Life, Processes};
use axis::Axis;
use cara_bench_ends::Delivery;
use cara_bench_ends::Pin;
use cara_core::config::Scheduling;
use chart::{Chart, Kind, Line, Point};

/// The size of figure 8.
const LONG: u32 = 20_000;

/// A figure: rows of charts, and what is said below its legend.
struct Figure {
    name: &'static str,
    rows: Vec<Vec<Chart>>,
    about: Vec<String>,
}

/// Draws every figure for which there are rows, each as SVG.
pub(crate) fn draw(results: &Results, folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    for mut figure in figures(results).into_iter().chain(link::figures(results)) {
        figure.rows.retain(|row| !row.iter().all(Chart::is_empty));
        if !figure.rows.is_empty() {
            let drawn = chart::draw(&figure.rows, &figure.about, &folder.join(figure.name));
            drawn.with_context(|| format!("drawing {}", figure.name))?;
        }
    }
    Ok(())
}

/// Draws the share of deadlines that are met over the load, as long as runs really took, and writes what was measured on Linux.
pub(crate) fn draw_deadlines(shares: &[Share], linux: bool, folder: &Path) -> Result<()> {
    let line = |scheduling: Scheduling| {
        let of = shares.iter().filter(|share| share.scheduling == scheduling);
        let points = of.map(|share| Point::new(share.load as f64 * share.run_time, share.met)).collect();
        Line::measured(scheduling.word(), points)
    };
    let (x, y) = (Axis::linear("load, %"), Axis::share("deadlines met / calls"));
    let chart = Chart::new("Deadlines met, one call at a time", x, y, Scheduling::ALL.map(line).into());
    let (name, about) = match linux {
        false => ("deadlines", ["simulator; calls of 5 to 15 ms", "time-outs of 50, 100, 200 and 400 ms"]),
        true => ("deadlines-linux", ["Linux, loopback; calls of 25 to 75 ms", "time-outs of 0.25, 0.5, 1 and 2 s"]),
    };
    std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    if linux {
        std::fs::write(folder.join(format!("{name}.json")), serde_json::to_string_pretty(shares)? + "\n")?;
    }
    chart::draw(&[vec![chart]], &about.map(str::to_owned), &folder.join(name))
}

/// Draws what the processes of a soak held over its hours.
pub(crate) fn draw_soak(processes: &Processes, folder: &Path) -> Result<()> {
    let chart = |index: usize| {
        let line = |(process, lives): (&String, &Vec<Life>)| {
            let points: Vec<_> = lives.iter().flatten().map(|sample| (sample.hours, sample.values[index])).collect();
            // More marks than this could not be told apart.
            let each = points.len().div_ceil(40).max(1);
            let means = points.chunks(each).map(|points| {
                let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / points.len() as f64;
                Point::new(mean(|point| point.0), mean(|point| point.1))
            });
            Line::measured(process, means.collect())
        };
        let name = soak::QUANTITIES[index].name;
        Chart::new(name, Axis::linear("hours"), Axis::linear(name), processes.iter().map(line).collect())
    };
    std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    let rows = [vec![chart(0), chart(1)], vec![chart(2), chart(3)]];
    chart::draw(&rows, &["lives without their first half hour".to_owned()], &folder.join("soak"))
}

fn figures(results: &Results) -> Vec<Figure> {
    let figure = |name, charts, about: &[&str]| Figure {
        name,
        rows: vec![charts],
        about: about.iter().map(|line| (*line).to_owned()).collect(),
    };
    let apart = results.echoes.iter().map(|row| row.n).min().unwrap_or(0);
    let spread = format!("2 s apart: n = {apart} a point, printing");
    let loopback = [&spread, "bars: quartiles; availability:", "worst group. Loopback never fills"];
    vec![
        figure("figure-6", vec![response(results, 1), availability(results, 1)], &loopback),
        figure("figure-7", vec![response(results, 2), availability(results, 2)], &loopback),
        figure("figure-8", vec![both(results)], &["bars: worst group", "loopback never fills"]),
        figure(
            "ratios",
            vec![ratios(results, Pin::Same), ratios(results, Pin::Split)],
            &["bars: quartiles of the turns"],
        ),
        figure(
            "other-systems",
            vec![others(results, Pin::Same), others(results, Pin::Split)],
            &["bars: quartiles of the turns"],
        ),
    ]
}

/// Rows of these calls in plain mode, at one place without printing.
fn calls<'r>(results: &'r Results, peer: &str, distribution: u8, pin: Pin, pause_ms: u64) -> Vec<&'r Response> {
    calls_in(Mode::Plain, results, peer, distribution, pin, pause_ms)
}

fn calls_in<'r>(
    mode: Mode,
    results: &'r Results,
    peer: &str,
    distribution: u8,
    pin: Pin,
    pause_ms: u64,
) -> Vec<&'r Response> {
    let is_wanted = |row: &&Response| {
        let cell = (row.mode, row.distribution, row.pin, row.pause_ms);
        row.peer == peer && cell == (mode, distribution, pin, pause_ms) && !row.print
    };
    results.response.iter().filter(is_wanted).collect()
}

/// Medians and quartiles of round trips by size.
fn round_trips<'r>(rows: impl Iterator<Item = &'r Response>) -> Vec<Point> {
    let point = |row: &Response| {
        Point::new(f64::from(row.chars), row.p50_us).with_spread(row.lower_quartile_us, row.upper_quartile_us)
    };
    rows.map(point).collect()
}

/// In proportion to the floor's, by size.
fn proportions(rows: &[&Response]) -> Vec<Point> {
    let point = |row: &&Response| {
        Point::new(f64::from(row.chars), row.ratio).with_spread(row.ratio_lower_quartile, row.ratio_upper_quartile)
    };
    rows.iter().map(point).collect()
}

/// Response time over size: as far apart as the paper's, and back to back.
fn response(results: &Results, distribution: u8) -> Chart {
    let places = [Pin::Split, Pin::Same, Pin::None];
    let of = |row: &&Response, pin| row.distribution == distribution && row.pin == pin;
    let pin = places.into_iter().find(|pin| results.echoes.iter().any(|row| of(&row, *pin))).unwrap_or(Pin::None);
    let echoes = results.echoes.iter().filter(|row| of(row, pin));
    let mut lines = Vec::new();
    for (peer, mode, name) in PEERS {
        let rows = echoes.clone().filter(|row| row.peer == peer && row.mode == mode);
        lines.push(Line::measured(format!("{name}, 2 s apart"), round_trips(rows)));
    }
    for peer in ["floor", "cara"] {
        let rows = calls(results, peer, distribution, pin, 0);
        lines.push(Line::measured(format!("{peer}, back to back, silent"), round_trips(rows.into_iter())));
    }
    let title = format!("Response time, distribution {distribution}, loopback");
    Chart::new(title, Axis::log("characters"), Axis::log("µs, median"), lines)
}

/// Whose curves are drawn, and their names there.
const PEERS: [(&str, Mode, &str); 4] = [
    ("floor", Mode::Plain, "plain sockets"),
    ("cara", Mode::Plain, "CARA"),
    ("cara", Mode::Secured, "CARA, secured"),
    (SIMULATED, Mode::Plain, "CARA, simulated"),
];

/// Whose curves are drawn where every pair has a cable.
const ON_LINKS: [(&str, Mode, &str); 6] =
    [PEERS[0], PEERS[1], PEERS[2], PEERS[3], ("zenoh", Mode::Plain, "zenoh"), ("omniorb", Mode::Plain, "omniORB")];

fn periods<'r>(rows: impl Iterator<Item = &'r Availability>) -> Vec<Point> {
    let point = |row: &Availability| {
        let share = row.counts.executed_of_offered;
        // Period 0 stands a little left of 1 ms.
        Point::new((row.period_ms as f64).max(0.5), share).with_spread(row.worst_group, share)
    };
    rows.map(point).collect()
}

/// What the paper's text says of availability: lowest value, periods, sizes.
fn paper(distribution: u8, longest: u32) -> Option<Line> {
    let (low, from, sizes) = match (distribution, longest) {
        (1, ..=10_000) => (0.81, 20.0, "up to 10,000 characters"),
        (1, _) => (0.97, 70.0, "20,000 characters"),
        _ => return None,
    };
    let name = format!("the paper's lowest, distribution 1, {sizes}");
    Some(Line::of(Kind::Paper, name, &[(from, low), (100.0, low)]))
}

/// Where the paper's text sees availability fall, in distribution 2.
fn paper_falls(distribution: u8, longest: u32) -> Vec<(f64, String)> {
    match (distribution, longest) {
        (2, ..=10_000) => vec![(20.0, "paper: falls below 20 ms".into())],
        (2, _) => vec![(80.0, "paper: falls below 80 ms".into())],
        _ => Vec::new(),
    }
}

/// Availability over period, one line per size.
fn availability(results: &Results, distribution: u8) -> Chart {
    let rows = || results.availability.iter().filter(|row| row.distribution == distribution).filter(is_reliable);
    let mut sizes: Vec<u32> = rows().map(|row| row.chars).collect();
    sizes.sort_unstable();
    sizes.dedup();
    let line =
        |chars: u32| Line::measured(format!("{chars} characters"), periods(rows().filter(|row| row.chars == chars)));
    let mut lines: Vec<Line> = sizes.into_iter().map(line).collect();
    lines.extend([10_000, LONG].into_iter().filter_map(|longest| paper(distribution, longest)));
    let title = format!("Availability, distribution {distribution}, loopback");
    let mut chart = Chart::new(title, Axis::log("period, ms (leftmost: 0)"), Axis::share("executed / offered"), lines);
    chart.knees = [10_000, LONG].into_iter().flat_map(|longest| paper_falls(distribution, longest)).collect();
    chart
}

fn is_reliable(row: &&Availability) -> bool {
    (row.delivery, row.mode) == (Delivery::Reliable, Mode::Plain)
}

/// Availability at the paper's longest size in both distributions.
fn both(results: &Results) -> Chart {
    let line = |distribution: u8| {
        let rows = results.availability.iter().filter(is_reliable).filter(|row| row.chars == LONG);
        let rows = rows.filter(|row| row.distribution == distribution);
        Line::measured(format!("distribution {distribution}"), periods(rows))
    };
    let title = format!("Availability, {LONG} characters, loopback");
    let lines = [line(1), line(2)].into_iter().chain(paper(1, LONG)).collect();
    let mut chart = Chart::new(title, Axis::log("period, ms (leftmost: 0)"), Axis::share("executed / offered"), lines);
    chart.knees = paper_falls(2, LONG);
    chart
}

/// Median round trips of CARA and other systems in proportion to the floor's; none where no other system was measured.
fn others(results: &Results, pin: Pin) -> Chart {
    let line = |peer: &str| Line::measured(peer, proportions(&calls(results, peer, 1, pin, 0)));
    let mut lines: Vec<Line> = results.run.peers.iter().map(|outside| line(&outside.peer)).collect();
    lines.retain(|line| !line.points.is_empty());
    if !lines.is_empty() {
        lines.insert(0, line("cara"));
    }
    Chart::new(format!("Round trip / floor, {pin}, distribution 1"), Axis::log("characters"), Axis::log("ratio"), lines)
}

/// Median round trips in proportion to the floor's, with the control.
fn ratios(results: &Results, pin: Pin) -> Chart {
    let peers = [
        (Mode::Plain, "floor_again", ""),
        (Mode::Plain, "cara", ""),
        (Mode::Secured, "cara", ", secured"),
        (Mode::Plain, "cara_among_1000_idle", ""),
    ];
    let mut lines = Vec::new();
    for distribution in [1, 2] {
        for (mode, peer, label) in peers {
            let rows = calls_in(mode, results, peer, distribution, pin, 0);
            lines.push(Line::measured(format!("{peer}{label}, distribution {distribution}"), proportions(&rows)));
        }
    }
    lines.retain(|line| !line.points.is_empty());
    Chart::new(format!("Round trip / floor, back to back, {pin}"), Axis::log("characters"), Axis::log("ratio"), lines)
}
