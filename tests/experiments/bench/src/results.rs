//! Everything that a run finds, as the one JSON object that `docs/performance.md` describes key by key.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use crate::peers::OutsideReport;

use cara_bench_ends::Delivery;
use cara_bench_ends::Pin;
use cara_processes::files::can_write;

/// How messages are protected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Mode {
    Plain,
    Secured,
}

impl Mode {
    /// As rows say it.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::Secured => "secured",
        }
    }
}

/// A whole run, complete or not.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Results {
    pub(crate) run: About,
    pub(crate) response: Vec<Response>,
    pub(crate) echoes: Vec<Response>,
    pub(crate) availability: Vec<Availability>,
    /// `null` until it is measured.
    pub(crate) share: Option<Share>,
    pub(crate) scale: Vec<Scale>,
    pub(crate) throughput: Vec<Throughput>,
    pub(crate) constraints: Vec<Constrained>,
    pub(crate) link_response: Vec<OnLink<Response>>,
    pub(crate) link_availability: Vec<OnLink<LinkAvailability>>,
    pub(crate) link_constraints: Vec<OnLink<LinkConstrained>>,
    /// From the rows above, when the run ends.
    pub(crate) goals: Vec<Goal>,
}

/// What was run, where and when.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct About {
    pub(crate) version: String,
    pub(crate) commit: String,
    pub(crate) extent: String,
    pub(crate) is_release_build: bool,
    pub(crate) is_complete: bool,
    pub(crate) started_unix_s: u64,
    pub(crate) seconds: f64,
    pub(crate) cpus: usize,
    pub(crate) processor: String,
    pub(crate) load_before: f64,
    pub(crate) load_after: f64,
    #[serde(default)]
    pub(crate) loss_percent: u32,
    pub(crate) experiments: Vec<Done>,
    pub(crate) notes: Vec<String>,
    pub(crate) peers: Vec<OutsideReport>,
}

/// One experiment.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Done {
    pub(crate) experiment: String,
    pub(crate) is_complete: bool,
    pub(crate) seconds: f64,
    /// Of all CPUs, how much was in use.
    pub(crate) busy: f64,
}

/// Round trips of one peer in one cell.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Response {
    pub(crate) peer: String,
    pub(crate) distribution: u8,
    pub(crate) chars: u32,
    pub(crate) pin: Pin,
    pub(crate) mode: Mode,
    pub(crate) print: bool,
    pub(crate) pause_ms: u64,
    pub(crate) n: usize,
    pub(crate) mean_us: f64,
    pub(crate) lower_quartile_us: f64,
    pub(crate) p50_us: f64,
    pub(crate) upper_quartile_us: f64,
    pub(crate) p99_us: f64,
    pub(crate) p999_us: f64,
    pub(crate) max_us: f64,
    pub(crate) ratio: f64,
    pub(crate) ratio_lower_quartile: f64,
    pub(crate) ratio_upper_quartile: f64,
    pub(crate) p99_ratio: f64,
    pub(crate) plain_ratio: Option<f64>,
    pub(crate) cpu_us_per_call: f64,
    pub(crate) cpu_ratio: f64,
}

/// One-way requests at one period.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Availability {
    pub(crate) distribution: u8,
    pub(crate) chars: u32,
    pub(crate) period_ms: u64,
    pub(crate) delivery: Delivery,
    pub(crate) pin: Pin,
    pub(crate) mode: Mode,
    pub(crate) print: bool,
    #[serde(flatten)]
    pub(crate) counts: Counts,
    pub(crate) worst_group: f64,
    pub(crate) executed_per_s: f64,
    pub(crate) floor_per_s: Option<f64>,
    pub(crate) ratio: Option<f64>,
}

/// What became of one-way requests.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Counts {
    pub(crate) offered: u64,
    pub(crate) sent: u64,
    pub(crate) refused: u64,
    pub(crate) executed: u64,
    pub(crate) lost: u64,
    pub(crate) executed_of_offered: f64,
    pub(crate) executed_of_sent: f64,
    pub(crate) reasons: BTreeMap<String, u64>,
}

/// Where the time of a round trip goes.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Share {
    pub(crate) chars: u32,
    pub(crate) pin: Pin,
    pub(crate) mode: Mode,
    pub(crate) n: usize,
    pub(crate) round_trip_us: f64,
    pub(crate) generate_us: f64,
    pub(crate) process_us: f64,
    pub(crate) generate: f64,
    pub(crate) process: f64,
    pub(crate) instructions_per_call: Option<f64>,
    pub(crate) generate_instructions: Option<f64>,
    pub(crate) process_instructions: Option<f64>,
    /// `null` without callgrind.
    pub(crate) instructions: Option<Instructions>,
    /// The same with keys; within that, `null`.
    pub(crate) secured: Option<Box<Share>>,
}

/// What callgrind counts of a round trip outside of the kernel; parts are of the process that they are named after.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Instructions {
    pub(crate) calls: u32,
    #[serde(skip)]
    pub(crate) per_call: f64,
    #[serde(skip)]
    pub(crate) generate: f64,
    #[serde(skip)]
    pub(crate) process: f64,
    pub(crate) client_per_call: f64,
    pub(crate) client_generate: f64,
    pub(crate) client_process: f64,
    pub(crate) server_per_call: f64,
    pub(crate) server_generate: f64,
    pub(crate) server_process: f64,
}

/// One of the project's goals.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Goal {
    pub(crate) quantity: String,
    pub(crate) cell: String,
    pub(crate) goal: String,
    /// `null` where this run did not measure it.
    pub(crate) figure: Option<f64>,
    pub(crate) is_reached: Option<bool>,
}

/// A manager with so many nodes.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Scale {
    pub(crate) nodes: u32,
    pub(crate) pin: Pin,
    pub(crate) mode: Mode,
    pub(crate) n: usize,
    pub(crate) request_us: f64,
    pub(crate) request_ratio: f64,
    pub(crate) each_us: f64,
    pub(crate) each_ratio: f64,
    pub(crate) rss_per_node_bytes: i64,
    pub(crate) discovery_s: f64,
}

/// Requests or one-way messages per second.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Throughput {
    pub(crate) kind: Kind,
    pub(crate) peer: String,
    pub(crate) callers: u32,
    pub(crate) chars: u32,
    pub(crate) pin: Pin,
    pub(crate) mode: Mode,
    pub(crate) n: usize,
    pub(crate) requests_per_s: f64,
    pub(crate) ratio: f64,
    pub(crate) refused: u64,
    pub(crate) lost: u64,
}

/// What is counted per second.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Kind {
    Request,
    OneWay,
}

/// One-way requests under constraints of the paper.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Constrained {
    pub(crate) minimum_interval_ms: u64,
    pub(crate) message_size: u32,
    pub(crate) chars: u32,
    pub(crate) period_ms: u64,
    pub(crate) pin: Pin,
    pub(crate) mode: Mode,
    #[serde(flatten)]
    pub(crate) counts: Counts,
    pub(crate) executed_per_s: f64,
}

/// A row of a link of so many million bits a second in each direction, or why there is none.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct OnLink<T> {
    pub(crate) mbit: u32,
    pub(crate) skipped: Option<String>,
    #[serde(flatten)]
    pub(crate) row: Option<T>,
}

impl<T> OnLink<T> {
    pub(crate) fn measured(mbit: u32, row: T) -> Self {
        Self { mbit, skipped: None, row: Some(row) }
    }

    pub(crate) fn skipped(mbit: u32, reason: &str) -> Self {
        Self { mbit, skipped: Some(reason.to_owned()), row: None }
    }
}

/// The rows of a list that were measured, each with the rate of its link.
pub(crate) fn measured<T>(rows: &[OnLink<T>]) -> impl Iterator<Item = (u32, &T)> + Clone {
    rows.iter().filter_map(|on| Some((on.mbit, on.row.as_ref()?)))
}

/// One-way requests at one period on a link.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct LinkAvailability {
    pub(crate) peer: String,
    pub(crate) distribution: u8,
    pub(crate) chars: u32,
    pub(crate) period_ms: u64,
    pub(crate) delivery: Delivery,
    pub(crate) mode: Mode,
    pub(crate) print: bool,
    pub(crate) load: f64,
    #[serde(flatten)]
    pub(crate) counts: Counts,
    pub(crate) in_time_of_offered: f64,
    pub(crate) worst_group: f64,
    pub(crate) best_group: f64,
    pub(crate) executed_per_s: f64,
}

/// Constraints of the paper on a link.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct LinkConstrained {
    pub(crate) minimum_interval_ms: u64,
    pub(crate) message_size: u32,
    pub(crate) chars: u32,
    pub(crate) period_ms: u64,
    pub(crate) delivery: Delivery,
    pub(crate) mode: Mode,
    #[serde(flatten)]
    pub(crate) counts: Counts,
    pub(crate) in_time_of_offered: f64,
    pub(crate) executed_per_s: f64,
    pub(crate) calls: usize,
    /// `null` where calls are refused.
    pub(crate) p50_us: Option<f64>,
    pub(crate) p99_us: Option<f64>,
    pub(crate) call_refused: Option<String>,
}

impl Results {
    /// What an earlier run wrote.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
        serde_json::from_str(&text).with_context(|| format!("{} is no complete file of a run", path.display()))
    }

    /// Fails unless [`write`](Self::write) can write there.
    pub(crate) fn can_write(path: &Path) -> Result<()> {
        can_write(path)?;
        can_write(&part(path)).with_context(|| format!("{} is first written beside it", path.display()))
    }

    /// Writes all of it; a reader finds the old file or the new one, never a part.
    pub(crate) fn write(&self, path: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self)? + "\n";
        let fresh = part(path);
        std::fs::write(&fresh, text).with_context(|| format!("writing {}", fresh.display()))?;
        std::fs::rename(&fresh, path).with_context(|| format!("writing {}", path.display()))
    }
}

/// Where a file is written before it has its name.
fn part(path: &Path) -> PathBuf {
    path.with_extension("part")
}

/// Microseconds with two digits behind the point.
pub(crate) fn micros(nanos: u64) -> f64 {
    rounded(nanos as f64 / 1e3, 1e2)
}

/// A ratio with four digits.
pub(crate) fn ratio(value: f64) -> f64 {
    rounded(value, 1e4)
}

fn rounded(value: f64, steps: f64) -> f64 {
    (value * steps).round() / steps
}
