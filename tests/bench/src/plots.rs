//! The paper's figures from a run: 6 and 7 (response time and availability in each distribution), 8 (availability at
//! 20,000 characters in both), the ratios to the floor, and those of other systems.

mod chart;

use std::path::Path;

use anyhow::{Context, Result};

use crate::results::{Availability, Mode, Response, Results};
use cara_bench_ends::Delivery;
use cara_bench_ends::Pin;
use chart::{Axis, Chart, Line};

/// The size of figure 8.
const LONG: u32 = 20_000;

/// Draws every figure for which there are rows, each as SVG and PNG.
pub(crate) fn draw(results: &Results, folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    for (name, charts) in figures(results) {
        let charts: Vec<Chart> = charts.into_iter().filter(|chart| !chart.is_empty()).collect();
        if !charts.is_empty() {
            chart::draw(&charts, &folder.join(name)).with_context(|| format!("drawing {name}"))?;
        }
    }
    Ok(())
}

fn figures(results: &Results) -> Vec<(&'static str, Vec<Chart>)> {
    vec![
        ("figure-6", vec![response(results, 1), availability(results, 1)]),
        ("figure-7", vec![response(results, 2), availability(results, 2)]),
        ("figure-8", vec![both(results)]),
        ("ratios", vec![ratios(results, Pin::Same), ratios(results, Pin::Split)]),
        ("other-systems", vec![others(results, Pin::Same), others(results, Pin::Split)]),
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

/// Response time over size: as far apart as the paper's, and back to back.
fn response(results: &Results, distribution: u8) -> Chart {
    let mut lines = Vec::new();
    for (pause_ms, spacing) in [(2_000, "2 s apart"), (10, "10 ms apart"), (0, "back to back")] {
        for pin in [Pin::Split, Pin::Same, Pin::None] {
            for peer in ["cara", "floor"] {
                let rows = calls(results, peer, distribution, pin, pause_ms);
                let points = rows.iter().map(|row| (f64::from(row.chars), row.p50_us)).collect();
                lines.push(Line { name: format!("{peer}, {spacing}, {pin}"), points });
            }
        }
    }
    lines.retain(|line| line.points.len() > 1);
    // One place is enough to look at.
    if let Some(place) = lines.first().and_then(|line| line.name.rsplit(", ").next().map(str::to_owned)) {
        lines.retain(|line| line.name.ends_with(&place));
    }
    let title = format!("Response time, distribution {distribution}, median");
    Chart { title, x: Axis::log("characters"), y: Axis::log("µs"), lines }
}

fn periods(row: &Availability) -> (f64, f64) {
    (row.period_ms as f64, row.counts.executed_of_offered)
}

/// Availability over period, one line per size.
fn availability(results: &Results, distribution: u8) -> Chart {
    let rows = || results.availability.iter().filter(|row| row.distribution == distribution).filter(is_reliable);
    let mut sizes: Vec<u32> = rows().map(|row| row.chars).collect();
    sizes.sort_unstable();
    sizes.dedup();
    let lines = sizes.into_iter().map(|chars| {
        let points = rows().filter(|row| row.chars == chars).map(periods).collect();
        Line { name: format!("{chars} characters"), points }
    });
    let title = format!("Availability, distribution {distribution}, reliable");
    Chart { title, x: Axis::linear("period, ms"), y: Axis::share("executed / offered"), lines: lines.collect() }
}

fn is_reliable(row: &&Availability) -> bool {
    (row.delivery, row.mode) == (Delivery::Reliable, Mode::Plain)
}

/// Availability at the paper's longest size in both distributions.
fn both(results: &Results) -> Chart {
    let line = |distribution: u8| {
        let rows = results.availability.iter().filter(is_reliable).filter(|row| row.chars == LONG);
        let points = rows.filter(|row| row.distribution == distribution).map(periods).collect();
        Line { name: format!("distribution {distribution}"), points }
    };
    let title = format!("Availability, {LONG} characters");
    let lines = vec![line(1), line(2)];
    Chart { title, x: Axis::linear("period, ms"), y: Axis::share("executed / offered"), lines }
}

/// Median round trips of CARA and other systems in proportion to the floor's; none where no other system was measured.
fn others(results: &Results, pin: Pin) -> Chart {
    let line = |peer: &str| {
        let rows = calls(results, peer, 1, pin, 0);
        let points = rows.iter().map(|row| (f64::from(row.chars), row.ratio)).collect();
        Line { name: peer.to_owned(), points }
    };
    let mut lines: Vec<Line> = results.run.peers.iter().map(|outside| line(&outside.peer)).collect();
    lines.retain(|line| !line.points.is_empty());
    if !lines.is_empty() {
        lines.insert(0, line("cara"));
    }
    let title = format!("Round trip / floor, back to back, {pin}, distribution 1");
    Chart { title, x: Axis::log("characters"), y: Axis::log("ratio"), lines }
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
            let points = rows.iter().map(|row| (f64::from(row.chars), row.ratio)).collect();
            lines.push(Line { name: format!("{peer}{label}, distribution {distribution}"), points });
        }
    }
    lines.retain(|line| !line.points.is_empty());
    Chart {
        title: format!("Round trip / floor, back to back, {pin}"),
        x: Axis::log("characters"),
        y: Axis::linear("ratio"),
        lines,
    }
}
