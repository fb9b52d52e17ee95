//! Rows for people and for programs.

use std::path::Path;

use anyhow::{Context, Result};
use serde::Serialize;

use crate::block::Order;
use crate::pin::Pin;
use crate::statistics::Cell;

/// One peer in one cell. Times in microseconds.
#[derive(Debug, Serialize)]
pub(crate) struct Row {
    peer: String,
    chars: u32,
    pin: String,
    callers: u32,
    pause_ms: u64,
    n: usize,
    p50_us: f64,
    p99_us: f64,
    max_us: f64,
    /// Median over the turns of (median of this block / median of the floor's block).
    ratio: f64,
    ratio_lower_quartile: f64,
    ratio_upper_quartile: f64,
    requests_per_s: f64,
    /// Median over the turns of (requests per second / those of the floor).
    requests_ratio: f64,
    /// Both processes.
    cpu_us_per_call: f64,
}

impl Row {
    pub(crate) fn new(peer: &str, pin: Pin, order: &Order, cell: &Cell, floor: &Cell) -> Self {
        let figures = cell.figures();
        let [lower, ratio, upper] = cell.ratios(floor);
        let micros = |nanos: u64| rounded(nanos as f64 / 1e3, 1e2);
        Self {
            peer: peer.to_owned(),
            chars: order.chars,
            pin: pin.to_string(),
            callers: order.callers,
            pause_ms: order.pause_ms,
            n: figures.calls,
            p50_us: micros(figures.median),
            p99_us: micros(figures.p99),
            max_us: micros(figures.longest),
            ratio: rounded(ratio, 1e4),
            ratio_lower_quartile: rounded(lower, 1e4),
            ratio_upper_quartile: rounded(upper, 1e4),
            requests_per_s: figures.per_second.round(),
            requests_ratio: rounded(cell.throughput_ratio(floor), 1e4),
            cpu_us_per_call: rounded(figures.cpu_per_call / 1e3, 1e2),
        }
    }

    fn cell(&self) -> (&str, u64, u32, u32) {
        (&self.pin, self.pause_ms, self.callers, self.chars)
    }
}

fn rounded(value: f64, steps: f64) -> f64 {
    (value * steps).round() / steps
}

/// Prints the rows, an empty line between cells.
pub(crate) fn table(rows: &[Row]) {
    println!(
        "{:<5} {:>5} {:>7} {:>6}  {:<16} {:>7} {:>9} {:>9} {:>9} {:>6} {:>13} {:>9} {:>6} {:>8}",
        "pin",
        "pause",
        "callers",
        "chars",
        "peer",
        "n",
        "p50 us",
        "p99 us",
        "max us",
        "ratio",
        "(quartiles)",
        "req/s",
        "ratio",
        "cpu us"
    );
    let mut last = None;
    for row in rows {
        if last.replace(row.cell()).is_some_and(|last| last != row.cell()) {
            println!();
        }
        println!(
            "{:<5} {:>5} {:>7} {:>6}  {:<16} {:>7} {:>9.1} {:>9.1} {:>9.1} {:>6.3} ({:>5.3}-{:>5.3}) {:>9.0} {:>6.3} {:>8.1}",
            row.pin,
            row.pause_ms,
            row.callers,
            row.chars,
            row.peer,
            row.n,
            row.p50_us,
            row.p99_us,
            row.max_us,
            row.ratio,
            row.ratio_lower_quartile,
            row.ratio_upper_quartile,
            row.requests_per_s,
            row.requests_ratio,
            row.cpu_us_per_call,
        );
    }
}

/// Writes the rows to `path`.
pub(crate) fn json(rows: &[Row], path: &Path) -> Result<()> {
    let text = serde_json::to_string_pretty(rows)?;
    std::fs::write(path, text + "\n").with_context(|| format!("writing {}", path.display()))
}
