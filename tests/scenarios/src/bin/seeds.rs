//! Runs every scenario for many seeds on the simulator, with faults on; or on boards or a line, where each run keeps its memory
//! until the end, so that a scenario at a time suits.
//!
//! `seeds [--seeds N] [--quick] [--scenario NAME] [--seed N] [--secured | --embassy | --line] [--traces FILE | --write-traces FILE]`
//!
//! A trace stands for all that could be seen of a scenario's runs: what is on the wire, what units see, and when. `--traces`
//! fails where one differs from the file, which `--write-traces` has made: so a change that is to keep behaviour shows that
//! it does.

use std::num::NonZero;
use std::process::ExitCode;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use cara_scenarios::run::{Failure, Report, once};
use cara_scenarios::{Port, Scenario, all, measurements};

/// Seeds of a quick run.
const QUICK: u64 = 50;
/// Below this many seeds the faults of the profile are not required.
const FEW: u64 = 500;
/// Failures that are shown of one scenario.
const SHOWN: usize = 3;

const USAGE: &str = "seeds [--seeds N] [--quick] [--scenario NAME] [--seed N] [--secured | --embassy | --line] \
                     [--traces FILE | --write-traces FILE]";

/// What the command line says.
struct Wanted {
    seeds: u64,
    seed: Option<u64>,
    scenario: Option<String>,
    port: Port,
    /// The traces that there should be, one line each.
    traces: Option<String>,
    /// Where to write those that there are.
    write: Option<String>,
}

fn main() -> ExitCode {
    let wanted = match arguments() {
        Ok(wanted) => wanted,
        Err(problem) => {
            eprintln!("{problem}\n{USAGE}");
            return ExitCode::from(2);
        }
    };
    let named = |scenario: &Scenario| wanted.scenario.as_ref().is_none_or(|name| scenario.name == name);
    let can = |scenario: &Scenario| scenario.missing_on(wanted.port).is_none();
    let scenarios: Vec<Scenario> = all().into_iter().filter(|scenario| named(scenario) && can(scenario)).collect();
    if scenarios.is_empty() {
        eprintln!("there is no scenario of this name that the port can run");
        return ExitCode::from(2);
    }
    let start = Instant::now();
    let (mut runs, mut failed, mut traces) = (0, 0, String::new());
    for scenario in &scenarios {
        let ended = run(scenario, &wanted);
        let line = format!("{} {} {:016x}\n", scenario.name, ended.seeds, ended.trace);
        let differs = wanted.traces.as_ref().is_some_and(|known| !known.contains(&line));
        if differs {
            print!("  FAILED: the file has no such trace: {line}");
        }
        runs += ended.seeds;
        failed += u64::from(differs || !ended.passed);
        traces += &line;
    }
    if let Some(file) = &wanted.write
        && let Err(problem) = std::fs::write(file, traces)
    {
        eprintln!("{file} cannot be written: {problem}");
        return ExitCode::FAILURE;
    }
    let seconds = start.elapsed().as_secs_f64();
    println!(
        "{} scenarios, {runs} seeds in {seconds:.1} s, {:.0} seeds/s, {failed} scenarios failed",
        scenarios.len(),
        runs as f64 / seconds
    );
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn arguments() -> Result<Wanted, String> {
    let mut wanted =
        Wanted { seeds: 1_000, seed: None, scenario: None, port: Port::Simulator, traces: None, write: None };
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        let mut value = || words.next().ok_or_else(|| format!("{word} needs a value"));
        let number = |text: String| text.parse().map_err(|_| format!("{text} is no number"));
        match word.as_str() {
            "--seeds" => wanted.seeds = number(value()?)?,
            "--seed" => wanted.seed = Some(number(value()?)?),
            "--scenario" => wanted.scenario = Some(value()?),
            "--secured" => wanted.port = Port::Secured,
            "--embassy" => wanted.port = Port::Embassy,
            "--line" => wanted.port = Port::Line,
            "--quick" => wanted.seeds = QUICK,
            "--traces" => {
                let file = value()?;
                let known = std::fs::read_to_string(&file).map_err(|problem| format!("{file}: {problem}"))?;
                wanted.traces = Some(known);
            }
            "--write-traces" => wanted.write = Some(value()?),
            other => return Err(format!("{other} is unknown")),
        }
    }
    Ok(wanted)
}

/// How the runs of a scenario ended.
struct Ended {
    seeds: u64,
    /// All passed, and everything expected was reached.
    passed: bool,
    trace: u64,
}

fn run(scenario: &Scenario, wanted: &Wanted) -> Ended {
    let seeds: Vec<u64> = match wanted.seed {
        Some(seed) => vec![seed],
        None => (0..wanted.seeds).collect(),
    };
    let start = Instant::now();
    let (report, failures) = run_each(scenario, wanted.port, &seeds);
    let all_faults = wanted.seed.is_none() && wanted.port == Port::Simulator;
    let missing = if !all_faults { Vec::new() } else { missing(scenario, &report, wanted.seeds < FEW) };
    show(scenario, seeds.len(), start.elapsed(), &report);
    for (seed, failure) in failures.iter().take(SHOWN) {
        println!("  FAILED with seed {seed}: {}", failure.replace('\n', "\n    "));
        let port = match wanted.port {
            Port::Embassy => " --embassy",
            Port::Line => " --line",
            Port::Secured => " --secured",
            Port::Simulator | Port::Linux => "",
        };
        println!(
            "  replay: cargo run --release --package cara-scenarios --bin seeds -- --scenario {} --seed {seed}{port}",
            scenario.name
        );
    }
    if failures.len() > SHOWN {
        println!("  and {} more seeds", failures.len() - SHOWN);
    }
    for name in &missing {
        println!("  FAILED: `{name}` was never reached");
    }
    let passed = failures.is_empty() && missing.is_empty();
    Ended { seeds: seeds.len() as u64, passed, trace: report.trace }
}

/// Runs the seeds on all processors; what they reached together, and which failed, in their order.
fn run_each(scenario: &Scenario, port: Port, seeds: &[u64]) -> (Report, Vec<(u64, Failure)>) {
    let threads = thread::available_parallelism().map_or(1, NonZero::get);
    let next = AtomicUsize::new(0);
    let work = || {
        let (mut report, mut failures) = (Report::default(), Vec::new());
        while let Some(&seed) = seeds.get(next.fetch_add(1, Ordering::Relaxed)) {
            match once(scenario, port, seed, scenario.profile) {
                Ok(run) => report.merge(run),
                Err(failure) => failures.push((seed, failure)),
            }
        }
        (report, failures)
    };
    let (mut report, mut failures) = (Report::default(), Vec::new());
    thread::scope(|scope| {
        let threads: Vec<_> = (0..threads).map(|_| scope.spawn(work)).collect();
        for thread in threads {
            let (part, failed) = thread.join().expect("what a scenario panics with is caught");
            report.merge(part);
            failures.extend(failed);
        }
    });
    failures.sort_by_key(|(seed, _)| *seed);
    (report, failures)
}

/// What the runs should have injected or reached, and did not.
fn missing(scenario: &Scenario, report: &Report, few: bool) -> Vec<&'static str> {
    // In few runs of a scenario that sends a few datagrams, the profile may well spare them all.
    let profile = if few { &[] } else { scenario.profile_faults() };
    let expected = profile.iter().chain(scenario.expects);
    expected.copied().filter(|name| !report.has(name)).collect()
}

fn show(scenario: &Scenario, seeds: usize, took: Duration, report: &Report) {
    println!("{} ({}): {seeds} seeds, {:.2} s", scenario.name, scenario.rule, took.as_secs_f64());
    let faults: Vec<String> = report.faults.iter().map(|(name, count)| format!("{name} {count}")).collect();
    println!("  faults: {}", if faults.is_empty() { "none".to_owned() } else { faults.join(", ") });
    let states: Vec<String> = report.states.iter().map(|(name, count)| format!("{} {count}", words(name))).collect();
    println!("  states: {}", states.join(", "));
    measurements(report).iter().for_each(|line| println!("  {line}"));
}

/// `RepliesLate` as `replies late`.
fn words(name: &str) -> String {
    let mut words = String::new();
    for letter in name.chars() {
        if letter.is_uppercase() && !words.is_empty() && !words.ends_with(' ') {
            words.push(' ');
        }
        words.extend(letter.to_lowercase());
    }
    words
}
