//! Carries out the attempts of an attack, several at a time, and makes its row.

use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};

use anyhow::{Context, Result};

use crate::tally::{Counters, Report, Row};
use crate::target::{Target, Visit};

/// Counters that show an operator an attack, and a board's log lines that do.
const TELLING: [&str; 25] = [
    "FramesRefused",
    "ProofsFailed",
    "FarewellsInClear",
    "KeysMissing",
    "RefusedKey",
    "RefusedMode",
    "RefusedDuplicate",
    "RefusedFleet",
    "GaveWay",
    "ConnectionsRefused",
    "DatagramMagic",
    "DatagramFleet",
    "DatagramMalformed",
    "DatagramForged",
    "DatagramNotForUs",
    "DatagramUnknownLink",
    "DatagramsForged",
    "DatagramsRepeated",
    "DatagramsDropped",
    "Outdated",
    "Unasked",
    "RequestsForbidden",
    "RequestsTooSoon",
    // Lines of a board's log: its counters cannot be read from outside.
    "could not join",
    "has left",
];

/// Names of the telling counters that have risen.
pub fn risen(before: &Counters, after: &Counters) -> Vec<String> {
    let value = |counters: &Counters, name: &str| counters.get(name).copied().unwrap_or(0);
    TELLING.iter().filter(|name| value(after, name) > value(before, name)).map(|&name| name.to_owned()).collect()
}

/// Makes an attempt for each of `cases`, each on its own visit; `act` returns whether it succeeded.
pub fn attack<C: Sync>(
    report: &mut Report,
    target: &dyn Target,
    attack: &str,
    cases: &[C],
    act: impl Fn(&C, Visit<'_>) -> Result<bool> + Sync,
) -> Result<()> {
    row(report, target, attack, cases, false, visiting(target, act))
}

/// As [`attack`], with the key.
pub fn control<C: Sync>(
    report: &mut Report,
    target: &dyn Target,
    name: &str,
    cases: &[C],
    act: impl Fn(&C, Visit<'_>) -> Result<bool> + Sync,
) -> Result<()> {
    row(report, target, name, cases, true, visiting(target, act))
}

/// `act` with a visit of its own.
fn visiting<C>(
    target: &dyn Target,
    act: impl Fn(&C, Visit<'_>) -> Result<bool> + Sync,
) -> impl Fn(&C) -> Result<bool> + Sync {
    move |case| target.visit().and_then(|visit| act(case, visit))
}

/// A row of attempts that make their connections themselves.
pub fn row<C: Sync>(
    report: &mut Report,
    target: &dyn Target,
    attack: &str,
    cases: &[C],
    control: bool,
    act: impl Fn(&C) -> Result<bool> + Sync,
) -> Result<()> {
    let before = target.counters()?;
    let successes = each(target.workers(), cases, act).with_context(|| format!("{attack}, {}", target.name()))?;
    report.add(Row {
        attack: attack.to_owned(),
        target: target.name().to_owned(),
        attempts: cases.len() as u64,
        successes,
        noticed: risen(&before, &target.counters()?),
        control,
    });
    Ok(())
}

/// Tries each case, `workers` at a time; the number of successes.
pub fn each<C: Sync>(workers: usize, cases: &[C], act: impl Fn(&C) -> Result<bool> + Sync) -> Result<u64> {
    let (next, successes, failed) = (AtomicUsize::new(0), AtomicU64::new(0), Mutex::new(None));
    std::thread::scope(|scope| {
        for _ in 0..workers.min(cases.len()) {
            scope.spawn(|| {
                while let Some(case) = cases.get(next.fetch_add(1, Ordering::Relaxed)) {
                    match act(case) {
                        Ok(success) => drop(successes.fetch_add(u64::from(success), Ordering::Relaxed)),
                        Err(error) => {
                            next.store(cases.len(), Ordering::Relaxed);
                            failed.lock().unwrap_or_else(std::sync::PoisonError::into_inner).get_or_insert(error);
                        }
                    }
                }
            });
        }
    });
    match failed.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner) {
        Some(error) => Err(error),
        None => Ok(successes.into_inner()),
    }
}
