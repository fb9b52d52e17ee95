//! Runs every scenario for many seeds on the simulator, with faults on; or on boards, where each run keeps its memory
//! until the end, so that a scenario at a time suits.
//!
//! `seeds [--seeds N] [--quick] [--scenario NAME] [--seed N] [--embassy]`

use std::process::ExitCode;
use std::time::{Duration, Instant};

use cara_scenarios::run::{Report, once};
use cara_scenarios::{Port, Scenario, all, measurements};

/// Seeds of a quick run.
const QUICK: u64 = 50;
/// Below this many seeds the faults of the weather are not required.
const FEW: u64 = 500;
/// Failures that are shown of one scenario.
const SHOWN: usize = 3;

/// What the command line says.
struct Wanted {
    seeds: u64,
    seed: Option<u64>,
    scenario: Option<String>,
    port: Port,
}

fn main() -> ExitCode {
    let wanted = match arguments() {
        Ok(wanted) => wanted,
        Err(problem) => {
            eprintln!("{problem}\nseeds [--seeds N] [--quick] [--scenario NAME] [--seed N] [--embassy]");
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
    let results: Vec<(u64, bool)> = scenarios.iter().map(|scenario| run(scenario, &wanted)).collect();
    let runs: u64 = results.iter().map(|(runs, _)| runs).sum();
    let failed = results.iter().filter(|(_, passed)| !passed).count();
    let seconds = start.elapsed().as_secs_f64();
    println!(
        "{} scenarios, {runs} seeds in {seconds:.1} s, {:.0} seeds/s, {failed} scenarios failed",
        scenarios.len(),
        runs as f64 / seconds
    );
    if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn arguments() -> Result<Wanted, String> {
    let mut wanted = Wanted { seeds: 1_000, seed: None, scenario: None, port: Port::Simulator };
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
            "--quick" => wanted.seeds = QUICK,
            other => return Err(format!("{other} is unknown")),
        }
    }
    Ok(wanted)
}

/// Runs one scenario; how many seeds, and whether all passed and everything expected was reached.
fn run(scenario: &Scenario, wanted: &Wanted) -> (u64, bool) {
    let seeds: Vec<u64> = match wanted.seed {
        Some(seed) => vec![seed],
        None => (0..wanted.seeds).collect(),
    };
    let start = Instant::now();
    let (mut report, mut failures) = (Report::default(), Vec::new());
    for &seed in &seeds {
        match once(scenario, wanted.port, seed, scenario.weather) {
            Ok(run) => report.merge(run),
            Err(failure) => failures.push((seed, failure)),
        }
    }
    let all_faults = wanted.seed.is_none() && wanted.port == Port::Simulator;
    let missing = if !all_faults { Vec::new() } else { missing(scenario, &report, wanted.seeds < FEW) };
    show(scenario, seeds.len(), start.elapsed(), &report);
    for (seed, failure) in failures.iter().take(SHOWN) {
        println!("  FAILED with seed {seed}: {}", failure.replace('\n', "\n    "));
        let port = match wanted.port {
            Port::Embassy => " --embassy",
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
    (seeds.len() as u64, failures.is_empty() && missing.is_empty())
}

/// What the runs should have injected or reached, and did not.
fn missing(scenario: &Scenario, report: &Report, few: bool) -> Vec<&'static str> {
    // In few runs of a scenario that sends a few datagrams, the weather may well spare them all.
    let weather = if few { &[] } else { scenario.weather_faults() };
    let expected = weather.iter().chain(scenario.expects);
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
