//! Everything that a run finds: one JSON object, whose keys are the fields here. Times are in the unit of their name, ratios without
//! one. A run that was narrowed or stopped has empty lists, and `null` for `share`.

#![warn(clippy::missing_docs_in_private_items)]

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
    /// Not at all.
    Plain,
    /// With keys from files, as by default.
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
    /// What was run, where and when.
    pub(crate) run: About,
    /// Round trips back to back or 10 ms apart, of 1 to 100,000 characters. 24 turns of each cell in full.
    pub(crate) response: Vec<Response>,
    /// The paper's response time test: calls two seconds apart, the service prints, 100 calls of each size in full. All peers and sizes of a
    /// distribution wait side by side.
    pub(crate) echoes: Vec<Response>,
    /// One-way requests, offered at fixed times: one that is late does not delay those after it. A thousand in groups of a hundred per row in
    /// full. Period 0 is measured on its own, in turns with the floor; all other periods side by side.
    pub(crate) availability: Vec<Availability>,
    /// `null` until it is measured.
    pub(crate) share: Option<Share>,
    /// Managers of a mode stand side by side and make their calls in turns. The s_units share a process and its threads.
    pub(crate) scale: Vec<Scale>,
    /// Callers at the same time, and messages without an answer.
    pub(crate) throughput: Vec<Throughput>,
    /// Every minimum interval with every message size, against requests every 2 ms; six pairs at the same time.
    pub(crate) constraints: Vec<Constrained>,
    /// As `response`, calls 20 ms apart. Every pair of processes has two network namespaces, joined by virtual Ethernet with a token bucket
    /// (`tbf`) of one frame at each end and a queue of 50 ms: no delay, and no loss but that of the full queue. The peer `simulated` is the
    /// core in the simulator at the same rates, in virtual time: distribution 1, no printing, CPU time 0.
    pub(crate) link_response: Vec<OnLink<Response>>,
    /// As `availability`, in groups of 200, five in full. Texts that take over 20 ms on the link are left out.
    pub(crate) link_availability: Vec<OnLink<LinkAvailability>>,
    /// Requests every 5 ms, and then calls as far apart as the interval asks for. All settings of a rate side by side.
    pub(crate) link_constraints: Vec<OnLink<LinkConstrained>>,
    /// From the rows above, when the run ends.
    pub(crate) goals: Vec<Goal>,
}

/// What was run, where and when.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct About {
    /// Of CARA.
    pub(crate) version: String,
    /// Of the source tree, if git tells.
    pub(crate) commit: String,
    /// `full`, `quick` or `tiny`.
    pub(crate) extent: String,
    /// Figures of any other build mean nothing.
    pub(crate) is_release_build: bool,
    /// Every experiment ran to its end.
    pub(crate) is_complete: bool,
    /// Seconds since 1970.
    pub(crate) started_unix_s: u64,
    /// How long the experiments took together.
    pub(crate) seconds: f64,
    /// That the run could use.
    pub(crate) cpus: usize,
    /// As the machine names it.
    pub(crate) processor: String,
    /// The machine's load average over a minute when the run began; above 0.5 it was not quiet.
    pub(crate) load_before: f64,
    /// The same at its end; the run itself makes 1 to 2, and links up to 8.
    pub(crate) load_after: f64,
    /// Of a hundred packets so many are lost on links, at random. With any the simulator has no rows.
    #[serde(default)]
    pub(crate) loss_percent: u32,
    /// Each experiment.
    pub(crate) experiments: Vec<Done>,
    /// What could not be measured, and why.
    pub(crate) notes: Vec<String>,
    /// Each other system, and whether it was measured, absent or broken.
    pub(crate) peers: Vec<OutsideReport>,
}

/// One experiment.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Done {
    /// Its name.
    pub(crate) experiment: String,
    /// It ran to its end.
    pub(crate) is_complete: bool,
    /// How long it took.
    pub(crate) seconds: f64,
    /// Of all CPUs, how much was in use.
    pub(crate) busy: f64,
}

/// Round trips of one peer in one cell.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Response {
    /// `floor`, `floor_again`, `cara`, `cara_spinning` (both ends spin for 100 µs), `cara_among_1000_idle` (that many more s_units are
    /// connected to the server), or another system.
    pub(crate) peer: String,
    /// 1: a client and a server. 2: beside them the paper's five nodes, in a process on the client's CPU, each of which calls the same
    /// function with 1,000 characters, 1 to 20 ms after its last reply.
    pub(crate) distribution: u8,
    /// Length of the text, one byte each.
    pub(crate) chars: u32,
    /// `same`: all processes of a peer on one CPU. `split`: client and server on a CPU each. `none`: wherever the scheduler puts them.
    pub(crate) pin: Pin,
    /// `secured` for CARA with keys.
    pub(crate) mode: Mode,
    /// Whether the service prints the text, line by line into a pipe.
    pub(crate) print: bool,
    /// From a reply to the next request.
    pub(crate) pause_ms: u64,
    /// Calls; none left out.
    pub(crate) n: usize,
    /// Mean round trip.
    pub(crate) mean_us: f64,
    /// A quarter took no longer.
    pub(crate) lower_quartile_us: f64,
    /// Median round trip.
    pub(crate) p50_us: f64,
    /// Three quarters took no longer.
    pub(crate) upper_quartile_us: f64,
    /// 99 of 100 took no longer.
    pub(crate) p99_us: f64,
    /// 999 of 1,000 took no longer; with fewer calls than that, the longest.
    pub(crate) p999_us: f64,
    /// The longest.
    pub(crate) max_us: f64,
    /// Median over the turns of this block's median divided by the floor's.
    pub(crate) ratio: f64,
    /// A quarter of the turns had a ratio no larger.
    pub(crate) ratio_lower_quartile: f64,
    /// Three quarters had.
    pub(crate) ratio_upper_quartile: f64,
    /// `p99_us` divided by the floor's of the same cell.
    pub(crate) p99_ratio: f64,
    /// Secured: median over the turns of this block's median divided by that of `cara` in plain mode.
    pub(crate) plain_ratio: Option<f64>,
    /// CPU time of client and server together, what the server does for the five nodes included.
    pub(crate) cpu_us_per_call: f64,
    /// The same divided by the floor's, median over the turns.
    pub(crate) cpu_ratio: f64,
}

/// One-way requests at one period.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Availability {
    /// As in [`Response`].
    pub(crate) distribution: u8,
    /// Length of the text.
    pub(crate) chars: u32,
    /// From one offer to the next.
    pub(crate) period_ms: u64,
    /// `reliable` (in the stream), or `best_effort` (one datagram: up to 1,000 characters, longer ones are refused).
    pub(crate) delivery: Delivery,
    /// As in [`Response`].
    pub(crate) pin: Pin,
    /// As in [`Response`].
    pub(crate) mode: Mode,
    /// Whether the service prints the text: at every period but 0.
    pub(crate) print: bool,
    /// What became of them.
    #[serde(flatten)]
    pub(crate) counts: Counts,
    /// The smallest share that was executed of one group.
    pub(crate) worst_group: f64,
    /// From the first offer of a group to its last execution, median of the groups.
    pub(crate) executed_per_s: f64,
    /// The same for the floor, which waits where CARA refuses; only at period 0.
    pub(crate) floor_per_s: Option<f64>,
    /// Of the two, median of the groups; likewise.
    pub(crate) ratio: Option<f64>,
}

/// What became of one-way requests.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
pub(crate) struct Counts {
    /// Requests that the program made: `sent` and `refused`.
    pub(crate) offered: u64,
    /// Taken, and not reported as refused later.
    pub(crate) sent: u64,
    /// Not taken, with an error; or taken and reported by an event as not executed.
    pub(crate) refused: u64,
    /// What the handler itself counted.
    pub(crate) executed: u64,
    /// `sent` without those executed: vanished in silence. A reliable one fails the run, as does one that is executed twice.
    pub(crate) lost: u64,
    /// The availability that counts.
    pub(crate) executed_of_offered: f64,
    /// The paper's availability.
    pub(crate) executed_of_sent: f64,
    /// How often each refusal was given, by its text with an N for each number.
    pub(crate) reasons: BTreeMap<String, u64>,
}

/// Where the time of a round trip goes.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Share {
    /// Length of the text.
    pub(crate) chars: u32,
    /// As in [`Response`].
    pub(crate) pin: Pin,
    /// As in [`Response`].
    pub(crate) mode: Mode,
    /// Round trips.
    pub(crate) n: usize,
    /// Median.
    pub(crate) round_trip_us: f64,
    /// Making both messages once more, median: text into `Parameters`, check against the signature, encode.
    pub(crate) generate_us: f64,
    /// Reading both messages, median: decode, UTF-8 check, text out.
    pub(crate) process_us: f64,
    /// `generate_us` / `round_trip_us`.
    pub(crate) generate: f64,
    /// `process_us` / `round_trip_us`.
    pub(crate) process: f64,
    /// Of both processes, by callgrind, which sees no kernel; `null` without valgrind.
    pub(crate) instructions_per_call: Option<f64>,
    /// The part of them that makes messages, with all that it calls; `null` likewise.
    pub(crate) generate_instructions: Option<f64>,
    /// The part of them that reads messages; `null` likewise.
    pub(crate) process_instructions: Option<f64>,
    /// `null` without callgrind.
    pub(crate) instructions: Option<Instructions>,
    /// The same with keys; within that, `null`.
    pub(crate) secured: Option<Box<Share>>,
}

/// What callgrind counts of a round trip outside of the kernel; parts are of the process that they are named after.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Instructions {
    /// Calls that are counted: the difference of a long run and a short one, so that connecting is not in it.
    pub(crate) calls: u32,
    /// Of both processes.
    #[serde(skip)]
    pub(crate) per_call: f64,
    /// Of both processes, making messages.
    #[serde(skip)]
    pub(crate) generate: f64,
    /// Of both processes, reading messages.
    #[serde(skip)]
    pub(crate) process: f64,
    /// Of the client.
    pub(crate) client_per_call: f64,
    /// Making messages there.
    pub(crate) client_generate: f64,
    /// Reading messages there.
    pub(crate) client_process: f64,
    /// Of the server.
    pub(crate) server_per_call: f64,
    /// Making messages there.
    pub(crate) server_generate: f64,
    /// Reading messages there.
    pub(crate) server_process: f64,
}

/// One of the project's goals.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Goal {
    /// What is compared with what.
    pub(crate) quantity: String,
    /// Where; with several sizes, the one with the worst figure.
    pub(crate) cell: String,
    /// What the figure must be.
    pub(crate) goal: String,
    /// `null` where this run did not measure it.
    pub(crate) figure: Option<f64>,
    /// `null` likewise.
    pub(crate) is_reached: Option<bool>,
}

/// A manager with so many nodes.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Scale {
    /// Connected to the manager.
    pub(crate) nodes: u32,
    /// Managers on one CPU, s_units on the other if `split`.
    pub(crate) pin: Pin,
    /// As in [`Response`].
    pub(crate) mode: Mode,
    /// Calls.
    pub(crate) n: usize,
    /// A request with one int to one of them and its reply: median over the turns of the blocks' medians.
    pub(crate) request_us: f64,
    /// The same to that of the manager with the fewest nodes, in the same turn.
    pub(crate) request_ratio: f64,
    /// To each in turn.
    pub(crate) each_us: f64,
    /// The same to `request_us` of the manager with the fewest nodes.
    pub(crate) each_ratio: f64,
    /// Growth of the manager's resident memory since no node was connected, after each has exchanged 20,000 characters with it, divided
    /// by the nodes; with few nodes mostly what the first one makes the process touch.
    pub(crate) rss_per_node_bytes: i64,
    /// From the start of the s_units' process until all are connected.
    pub(crate) discovery_s: f64,
}

/// Requests or one-way messages per second.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Throughput {
    /// What is counted.
    pub(crate) kind: Kind,
    /// As in [`Response`], each caller with a connection of its own (further ones of CARA are s_units that share threads); `cara_one_link`:
    /// all callers on one link.
    pub(crate) peer: String,
    /// Threads that call at the same time.
    pub(crate) callers: u32,
    /// Length of the text.
    pub(crate) chars: u32,
    /// As in [`Response`].
    pub(crate) pin: Pin,
    /// As in [`Response`].
    pub(crate) mode: Mode,
    /// Calls, or messages.
    pub(crate) n: usize,
    /// Of all callers together; messages executed.
    pub(crate) requests_per_s: f64,
    /// To the floor's in the same turn, median over the turns.
    pub(crate) ratio: f64,
    /// Refusals of one-way messages: those at the offer are offered again until they are taken, those reported later are not.
    pub(crate) refused: u64,
    /// One-way messages that were taken, and neither executed nor reported; any of CARA's fails the run.
    pub(crate) lost: u64,
}

/// What is counted per second.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Kind {
    /// Calls that wait for their replies.
    Request,
    /// Messages that do not, over one connection.
    OneWay,
}

/// One-way requests under constraints of the paper.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct Constrained {
    /// Least time between two requests of one node.
    pub(crate) minimum_interval_ms: u64,
    /// Longest message in bytes.
    pub(crate) message_size: u32,
    /// Length of the text.
    pub(crate) chars: u32,
    /// From one offer to the next.
    pub(crate) period_ms: u64,
    /// As in [`Response`].
    pub(crate) pin: Pin,
    /// As in [`Response`].
    pub(crate) mode: Mode,
    /// What became of them.
    #[serde(flatten)]
    pub(crate) counts: Counts,
    /// From the first offer to the last execution.
    pub(crate) executed_per_s: f64,
}

/// A row of a link of so many million bits a second in each direction, or why there is none.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct OnLink<T> {
    /// Its rate in each direction.
    pub(crate) mbit: u32,
    /// Why there is no row.
    pub(crate) skipped: Option<String>,
    /// What was measured.
    #[serde(flatten)]
    pub(crate) row: Option<T>,
}

impl<T> OnLink<T> {
    /// A row of a link of this rate.
    pub(crate) fn measured(mbit: u32, row: T) -> Self {
        Self { mbit, skipped: None, row: Some(row) }
    }

    /// No row, and why.
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
    /// `floor`, `cara`, `simulated`, or another system.
    pub(crate) peer: String,
    /// As in [`Response`].
    pub(crate) distribution: u8,
    /// Length of the text.
    pub(crate) chars: u32,
    /// From one offer to the next, to five times what the longest text takes on the link, and to 10 ms at least.
    pub(crate) period_ms: u64,
    /// `reliable`, or `best_effort` for what a datagram holds.
    pub(crate) delivery: Delivery,
    /// As in [`Response`].
    pub(crate) mode: Mode,
    /// Whether the service is told to print the text: CARA's and the floor's do.
    pub(crate) print: bool,
    /// Bits of the texts offered, divided by the link's rate, without any header.
    pub(crate) load: f64,
    /// What became of them.
    #[serde(flatten)]
    pub(crate) counts: Counts,
    /// Executed 50 ms after the last request of the group was due / offered. The floor refuses nothing: it offers late, and that counts here.
    pub(crate) in_time_of_offered: f64,
    /// The same of the group with the smallest share.
    pub(crate) worst_group: f64,
    /// The same of the one with the largest.
    pub(crate) best_group: f64,
    /// From the first offer of a group to its last execution, median of the groups.
    pub(crate) executed_per_s: f64,
}

/// Constraints of the paper on a link.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) struct LinkConstrained {
    /// As in [`Constrained`].
    pub(crate) minimum_interval_ms: u64,
    /// As in [`Constrained`].
    pub(crate) message_size: u32,
    /// Length of the text.
    pub(crate) chars: u32,
    /// From one offer to the next.
    pub(crate) period_ms: u64,
    /// Of the one-way requests.
    pub(crate) delivery: Delivery,
    /// As in [`Response`].
    pub(crate) mode: Mode,
    /// What became of them.
    #[serde(flatten)]
    pub(crate) counts: Counts,
    /// As in [`LinkAvailability`].
    pub(crate) in_time_of_offered: f64,
    /// From the first offer to the last execution.
    pub(crate) executed_per_s: f64,
    /// Calls that were timed; 0 where they are refused.
    pub(crate) calls: usize,
    /// `null` where calls are refused.
    pub(crate) p50_us: Option<f64>,
    /// 99 of 100 took no longer; `null` likewise.
    pub(crate) p99_us: Option<f64>,
    /// Why calls are refused.
    pub(crate) call_refused: Option<String>,
}

impl Results {
    /// What an earlier run wrote.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
        // Where another crate has it keep numbers as they are written, it reads none of a flattened member but through a value.
        let rows = serde_json::from_str::<serde_json::Value>(&text).and_then(serde_json::from_value);
        rows.with_context(|| format!("{} is no complete file of a run", path.display()))
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

/// To so many steps of one.
fn rounded(value: f64, steps: f64) -> f64 {
    (value * steps).round() / steps
}
