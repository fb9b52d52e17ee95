//! From a fault to motors that stand: how long that takes at most, beside the bound that follows from the image's constants.
//!
//! The image is the AGV's with the feature `faults`. Its clock counts instructions (QEMU's `-icount`), and it measures by
//! itself, so that a busy host changes nothing but the phase of each fault. A fault is counted from the last sign before
//! it that the manager wants the vehicle to drive, as the image's `faults` module says.

mod fenced;
mod hearts;
mod inject;
mod kind;
mod orders;
mod processes;
mod shared;
mod stopping;

use anyhow::{Result, ensure};
use clap::Args;

use crate::board::Bench;
use kind::{Bound, KINDS, Kind};
pub(crate) use processes::stand_alone;
pub(crate) use shared::stand_alone as stand_alone_shared;

/// How often what fails.
#[derive(Args, Clone, Debug)]
pub(crate) struct Faults {
    /// Faults of each kind.
    #[arg(long, default_value_t = 6, value_parser = clap::value_parser!(u32).range(1..))]
    each: u32,
    /// Only kinds whose names contain this.
    #[arg(long, default_value = "")]
    kind: String,
    /// From which the moments of the faults follow; drawn if not given.
    #[arg(long)]
    seed: Option<u64>,
    /// Tells the times that the host's clock measured beside their bounds, and fails only for what the faults led to: when a
    /// thread gets its turn is up to the host. Times of a board's own clock are compared all the same.
    #[arg(long)]
    busy_host: bool,
}

/// What a fault led to, in microseconds of the board's clock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Stop {
    /// From the call that announced the fault until the motors were off.
    announced: u64,
    /// From the last renewal of the lease until then.
    renewed: u64,
    /// From the first datagram behind that call which ends a motion until then; 0 where the stream was ahead of it.
    heard: u64,
    /// The longest turn of the executor so far.
    turn: u64,
}

/// Where things fail: the emulated board with its manager. A kind that fails elsewhere, as in processes of Linux, has another
/// one; [`Kind::target`] says which.
trait Target {
    /// In the table.
    fn name(&self) -> &'static str;

    /// Whether its times are those of a clock of its own, which stands still where the host is busy.
    fn has_own_clock(&self) -> bool;

    /// Within which time the motors must stand.
    fn bound(&self, kind: &Kind) -> Result<Bound>;

    /// Makes something fail, and checks what must be so behind it.
    fn fail(&self, kind: &Kind, number: u32, dice: &mut fastrand::Rng) -> Result<Stop>;
}

/// Makes everything fail, prints the table, and fails if any stop took longer than its bound.
pub(crate) fn run(bench: Bench, faults: &Faults) -> Result<()> {
    let seed = faults.seed.unwrap_or_else(|| fastrand::u64(..));
    println!("seed {seed}");
    let mut dice = fastrand::Rng::with_seed(seed);
    let kinds: Vec<&Kind> = KINDS.iter().filter(|kind| kind.name.contains(&faults.kind)).collect();
    ensure!(!kinds.is_empty(), "no kind of fault has `{}` in its name", faults.kind);
    let (mut rows, mut late) = (Vec::new(), Vec::new());
    for kind in kinds {
        let target = kind.target(&bench)?;
        let bound = target.bound(kind)?;
        let stops =
            (0..faults.each).map(|number| target.fail(kind, number, &mut dice)).collect::<Result<Vec<Stop>>>()?;
        let row = Row::of(kind, target.name(), bound, &stops, bench.machine().instruction());
        println!("{row}");
        if row.longest > row.bound.micros && (target.has_own_clock() || !faults.busy_host) {
            late.push(kind.name);
        }
        rows.push(row);
    }
    println!("\n{HEAD}");
    rows.iter().for_each(|row| println!("{row}"));
    let faults: usize = rows.iter().map(|row| row.faults).sum();
    println!("\n{faults} faults; one instruction is {} ns of the board's clock", 1 << bench.machine().instruction());
    ensure!(late.is_empty(), "motors went on beyond the bound: {}", late.join(", "));
    Ok(())
}

const HEAD: &str = "\
| fault | on | times | longest, ms | longest, instructions | bound, ms | of | left, ms |
|---|---|---|---|---|---|---|---|";

/// A row of the table.
struct Row {
    kind: &'static Kind,
    on: &'static str,
    bound: Bound,
    faults: usize,
    longest: u64,
    /// As a power of two, in nanoseconds.
    instruction: u32,
}

impl Row {
    fn of(kind: &'static Kind, on: &'static str, bound: Bound, stops: &[Stop], instruction: u32) -> Self {
        let longest = stops.iter().map(|stop| kind.took(stop)).max().unwrap_or(0);
        Self { kind, on, bound, faults: stops.len(), longest, instruction }
    }
}

impl std::fmt::Display for Row {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { kind, on, bound, faults, longest, instruction } = self;
        let millis = |micros: i64| micros as f64 / 1_000.0;
        let instructions = (longest * 1_000) >> instruction;
        let left = bound.micros as i64 - *longest as i64;
        let (took, allowed, left) = (millis(*longest as i64), millis(bound.micros as i64), millis(left));
        write!(
            f,
            "| {} | {on} | {faults} | {took:.1} | {instructions} | {allowed:.1} | {} | {left:.1} |",
            kind.name, bound.of
        )
    }
}
