//! All scenarios of a port as a test program: each once, side by side, bounded in time.

use std::process::ExitCode;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc;
use std::thread;
use std::time::{Duration, Instant};

use crate::run::Failure;
use crate::{Port, Scenario, all, run};

/// A scenario that takes longer than this in real time has failed.
const LIMIT: Duration = Duration::from_secs(90);
/// The seed of plain `cargo test`.
const SEED: u64 = 1;

/// Runs what the port can and the command line asks for: names that contain one of its words, or with `--exact` are one of
/// them; all without a word.
pub fn main(port: Port, threads: usize) -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let words: Vec<&String> = arguments.iter().filter(|word| !word.starts_with('-')).collect();
    let exact = arguments.iter().any(|word| word == "--exact");
    let named = |scenario: &Scenario, word: &str| scenario.name == word || (!exact && scenario.name.contains(word));
    let wanted = |scenario: &Scenario| words.is_empty() || words.iter().any(|word| named(scenario, word));
    let can = |scenario: &Scenario| scenario.missing_on(port).is_none();
    let scenarios: Vec<Scenario> = all().into_iter().filter(|scenario| can(scenario) && wanted(scenario)).collect();
    if arguments.iter().any(|word| word == "--list") {
        scenarios.iter().for_each(|scenario| println!("{}: test", scenario.name));
        return ExitCode::SUCCESS;
    }
    report(&run_all(&scenarios, port, threads))
}

/// Name, how it ended, how long it took.
type Ended = (&'static str, Result<(), Failure>, Duration);

fn run_all(scenarios: &[Scenario], port: Port, threads: usize) -> Vec<Ended> {
    let (next, ended) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                while let Some(scenario) = scenarios.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let start = Instant::now();
                    let result = bounded(*scenario, port);
                    let verdict = if result.is_ok() { "ok" } else { "FAILED" };
                    println!("test {} ... {verdict} ({} ms)", scenario.name, start.elapsed().as_millis());
                    ended.lock().expect("no holder panics").push((scenario.name, result, start.elapsed()));
                }
            });
        }
    });
    ended.into_inner().expect("no holder panics")
}

/// Runs a scenario in a thread of its own, which is left behind if it does not end.
fn bounded(scenario: Scenario, port: Port) -> Result<(), Failure> {
    let (sender, receiver) = mpsc::channel();
    thread::spawn(move || {
        let _ = sender.send(run::once(&scenario, port, SEED, scenario.profile).map(drop));
    });
    receiver.recv_timeout(LIMIT).unwrap_or_else(|_| Err(format!("not over after {} s", LIMIT.as_secs())))
}

fn report(ended: &[Ended]) -> ExitCode {
    let failed: Vec<_> = ended.iter().filter_map(|(name, result, _)| Some((name, result.as_ref().err()?))).collect();
    for (name, failure) in &failed {
        println!("\n---- {name}\n{failure}");
    }
    println!("\n{} passed, {} failed", ended.len() - failed.len(), failed.len());
    if failed.is_empty() && !ended.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
