//! The experiments of the paper's section 3, one after the other, and what goes beyond them.

mod availability;
mod constraints;
mod far;
pub(crate) mod goals;
mod link;
mod plan;
mod response;
mod resume;
mod scale;
mod share;
mod simulated;
mod throughput;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Result, bail};
use clap::{Args, ValueEnum};

use crate::page;
use crate::peers::{Outside, Selection};
use crate::plots;
use crate::progress::{is_stopped, stop_at_interrupt, was_stopped};
use crate::results::{About, Done, Results, measured, ratio};
use crate::table;
use cara_bench_ends::Pin;
use cara_processes::files;
use plan::{Extent, Plan};
pub(crate) use simulated::SIMULATED;

/// What to run.
#[derive(Args)]
pub(crate) struct Options {
    /// Every kind of row in a few minutes: fewer calls, and the slowest cells left out.
    #[arg(long)]
    quick: bool,
    /// Every kind of row in seconds, to see that the program works. The figures mean nothing.
    #[arg(long, conflicts_with = "quick")]
    tiny: bool,
    /// The passive node prints in every cell of the response time, not only in some.
    #[arg(long)]
    print: bool,
    /// Only these experiments.
    #[arg(long, value_delimiter = ',')]
    only: Vec<Experiment>,
    /// Only these places, where an experiment has several.
    #[arg(long, value_delimiter = ',')]
    pins: Vec<Pin>,
    /// Only these lengths of the text in the response time.
    #[arg(long, value_delimiter = ',', value_parser = clap::value_parser!(u32).range(1..=100_000))]
    chars: Vec<u32>,
    /// So many turns of each cell of the response time instead of the usual.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    rounds: Option<u32>,
    /// Only links of these rates, in Mbit/s.
    #[arg(long, value_delimiter = ',')]
    mbit: Vec<u32>,
    /// Links lose so many of a hundred packets, at random; the simulator's have no rows then.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=50))]
    loss_percent: u32,
    #[command(flatten)]
    outside: Selection,
    /// Writes all rows there as one JSON object, again after each experiment.
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
    /// Keeps the complete experiments of this file, which an earlier run of the same commit and form wrote on this
    /// machine, and makes the others.
    #[arg(long, value_name = "FILE")]
    resume: Option<PathBuf>,
    /// Draws the paper's figures 6, 7 and 8 and the ratios there, as SVG.
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    /// Makes the tables of this page anew, `docs/performance.md`.
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
}

/// One kind of row each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Experiment {
    Response,
    Echoes,
    Throughput,
    Share,
    Scale,
    Constraints,
    Availability,
    Link,
    Simulated,
}

impl Experiment {
    /// As rows and options say it.
    fn name(self) -> &'static str {
        match self {
            Self::Response => "response",
            Self::Echoes => "echoes",
            Self::Throughput => "throughput",
            Self::Share => "share",
            Self::Scale => "scale",
            Self::Constraints => "constraints",
            Self::Availability => "availability",
            Self::Link => "link",
            Self::Simulated => "simulated",
        }
    }

    fn measure(self, plan: &Plan, results: &mut Results) -> Result<()> {
        match self {
            Self::Response => response::measure(plan, &mut results.response),
            Self::Echoes => far::measure(&plan.far, &mut results.echoes),
            Self::Throughput => throughput::measure(plan, &mut results.throughput),
            Self::Share => share::measure(plan, &mut results.share, &mut results.run.notes),
            Self::Scale => scale::measure(plan, &mut results.scale),
            Self::Constraints => constraints::measure(plan, &mut results.constraints),
            Self::Availability => availability::measure(plan, &mut results.availability),
            Self::Link => link::measure(plan, results),
            Self::Simulated => simulated::measure(plan, results),
        }
    }
}

/// Runs them; what was measured is written and shown even where the run is stopped or an experiment fails.
pub(crate) fn run(options: &Options) -> Result<()> {
    can_write(options)?;
    stop_at_interrupt()?;
    let (outside, absent) = options.outside.find()?;
    let plan = plan(options, &outside)?;
    let mut results = Results { run: about(&plan), ..Results::default() };
    let earlier = options.resume.as_deref().map(|path| resume::read(path, &results.run)).transpose()?;
    results.run.peers = earlier.iter().flat_map(|earlier| earlier.run.peers.iter().cloned()).collect();
    let mut failures = Vec::new();
    for experiment in Experiment::value_variants() {
        if is_stopped() || !(options.only.is_empty() || options.only.contains(experiment)) {
            continue;
        }
        if let Some(earlier) = earlier.as_ref().filter(|earlier| resume::has(earlier, experiment.name())) {
            eprintln!("{}: kept from the earlier run", experiment.name());
            resume::keep(earlier, experiment.name(), &mut results);
            continue;
        }
        let (since, busy) = (Instant::now(), Busy::begin());
        let outcome = experiment.measure(&plan, &mut results);
        let is_complete = outcome.is_ok() && !is_stopped();
        let seconds = since.elapsed().as_secs_f64().round();
        let (experiment, busy) = (experiment.name().to_owned(), ratio(busy.end()));
        eprintln!("{experiment}: {seconds} s, {:.0} % of the CPUs in use", busy * 100.0);
        match outcome {
            Err(error) if !was_stopped() => {
                let failure = format!("{experiment}: {error:#}");
                eprintln!("{failure}");
                results.run.notes.push(failure.clone());
                failures.push(failure);
            }
            _ => {}
        }
        results.run.experiments.push(Done { experiment, is_complete, seconds, busy });
        results.run.peers = outside.iter().map(|outside| outside.report()).chain(absent.iter().cloned()).collect();
        earlier.iter().for_each(|earlier| resume::add_notes(&earlier.run.peers, &mut results.run.peers));
        results.run.seconds = results.run.experiments.iter().map(|done| done.seconds).sum();
        results.run.load_after = load();
        if let Err(error) = write(&results, options.json.as_deref()) {
            eprintln!("{error:#}");
        }
    }
    results.run.is_complete = !is_stopped() && failures.is_empty() && options.only.is_empty();
    results.goals = goals::of(&results);
    let written = write(&results, options.json.as_deref());
    table::show(&results);
    let drawn = options.plots.as_deref().map_or(Ok(()), |folder| plots::draw(&results, folder));
    let paged = options.page.as_deref().map_or(Ok(()), |page| page::write(&results, page));
    failures.extend([written, drawn, paged].into_iter().filter_map(Result::err).map(|error| format!("{error:#}")));
    failures.extend(silent_losses(&results));
    if failures.is_empty() { Ok(()) } else { bail!("{}", failures.join("\n")) }
}

/// Fails unless what comes of the run can be written where it is wanted.
fn can_write(options: &Options) -> Result<()> {
    options.json.as_deref().map_or(Ok(()), Results::can_write)?;
    options.plots.as_deref().map_or(Ok(()), files::can_write_in)
}

fn plan(options: &Options, outside: &[Arc<Outside>]) -> Result<Plan> {
    let extent = match (options.quick, options.tiny) {
        (true, _) => Extent::Quick,
        (_, true) => Extent::Tiny,
        _ => Extent::Full,
    };
    let mut plan = Plan::new(extent, options.print, options.loss_percent, outside)?;
    plan.narrow(&options.pins, &options.chars, options.rounds);
    plan.link.narrow(&options.mbit)?;
    Ok(plan)
}

fn write(results: &Results, path: Option<&Path>) -> Result<()> {
    path.map_or(Ok(()), |path| results.write(path))
}

fn about(plan: &Plan) -> About {
    let started = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let git = std::process::Command::new("git").args(["rev-parse", "--short", "HEAD"]).output().ok();
    let commit = git.filter(|git| git.status.success()).and_then(|git| String::from_utf8(git.stdout).ok());
    About {
        version: env!("CARGO_PKG_VERSION").into(),
        commit: commit.unwrap_or_default().trim().into(),
        extent: plan.extent.name().into(),
        is_release_build: !cfg!(debug_assertions),
        started_unix_s: started.as_secs(),
        processor: processor(),
        cpus: std::thread::available_parallelism().map_or(1, usize::from),
        load_before: load(),
        loss_percent: plan.link.loss_percent,
        notes: plan.notes.clone(),
        ..About::default()
    }
}

/// What the machine says that it has.
fn processor() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    model.map(|(_, model)| model.trim().to_owned()).unwrap_or_default()
}

/// How much of all CPUs is in use.
struct Busy([u64; 2]);

impl Busy {
    fn begin() -> Self {
        Self(Self::so_far())
    }

    /// Since the beginning, from 0 to 1.
    fn end(&self) -> f64 {
        let [busy, all] = Self::so_far();
        busy.saturating_sub(self.0[0]) as f64 / all.saturating_sub(self.0[1]).max(1) as f64
    }

    /// Ticks of all CPUs: in use, and all.
    fn so_far() -> [u64; 2] {
        let text = std::fs::read_to_string("/proc/stat").unwrap_or_default();
        let first = text.lines().next().unwrap_or_default();
        // User, nice, system, idle, waiting for a disk, two kinds of interrupts, taken by the host.
        let ticks: Vec<u64> = first.split_whitespace().skip(1).take(8).map_while(|word| word.parse().ok()).collect();
        let (all, idle) = (ticks.iter().sum(), ticks.iter().skip(3).take(2).sum::<u64>());
        [u64::saturating_sub(all, idle), all]
    }
}

/// Processes that ran or wanted to, over the last minute.
fn load() -> f64 {
    let text = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    text.split_whitespace().next().and_then(|load| load.parse().ok()).unwrap_or(0.0)
}

/// Reliable requests that neither ran nor were refused: none of ours may be, at any load. Other systems may lose some.
fn silent_losses(results: &Results) -> Vec<String> {
    let reliable = results.availability.iter().filter(|row| row.delivery == cara_bench_ends::Delivery::Reliable);
    let lost = reliable.map(|row| (&row.counts, row.chars, row.period_ms));
    let constrained = results.constraints.iter().map(|row| (&row.counts, row.chars, row.period_ms));
    let is_outside = |peer: &str| results.run.peers.iter().any(|outside| outside.peer == peer);
    let one_way = results.throughput.iter().filter(|row| row.lost > 0 && !is_outside(&row.peer));
    let one_way = one_way.map(|row| format!("{}, one-way messages on {}: {} vanished", row.peer, row.pin, row.lost));
    let on_link = measured(&results.link_availability).map(|(_, row)| row);
    let on_link = on_link.filter(|row| row.peer == "cara" && row.delivery == cara_bench_ends::Delivery::Reliable);
    let on_link = on_link.map(|row| (&row.counts, row.chars, row.period_ms));
    let counted = lost.chain(constrained).chain(on_link);
    counted
        .filter(|(counts, ..)| counts.lost > 0 || counts.executed > counts.sent)
        .map(|(counts, chars, period_ms)| {
            format!(
                "{chars} characters every {period_ms} ms: {} sent, {} executed, {} vanished",
                counts.sent, counts.executed, counts.lost
            )
        })
        .chain(one_way)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::{Availability, Counts, Mode};
    use cara_bench_ends::Delivery;

    fn row(delivery: Delivery, counts: Counts) -> Availability {
        Availability {
            distribution: 1,
            chars: 100,
            period_ms: 1,
            delivery,
            pin: Pin::Same,
            mode: Mode::Plain,
            print: false,
            counts,
            worst_group: 1.0,
            executed_per_s: 1.0,
            floor_per_s: None,
            ratio: None,
        }
    }

    fn losses(delivery: Delivery, counts: Counts) -> usize {
        silent_losses(&Results { availability: vec![row(delivery, counts)], ..Results::default() }).len()
    }

    #[test]
    fn what_vanishes_or_is_doubled_fails_the_run() {
        let counts = |executed, lost| Counts { offered: 10, sent: 9, refused: 1, executed, lost, ..Counts::default() };
        assert_eq!(losses(Delivery::Reliable, counts(9, 0)), 0);
        assert_eq!(losses(Delivery::Reliable, counts(8, 1)), 1);
        assert_eq!(losses(Delivery::Reliable, counts(10, 0)), 1);
        assert_eq!(losses(Delivery::BestEffort, counts(8, 1)), 0);
    }
}
