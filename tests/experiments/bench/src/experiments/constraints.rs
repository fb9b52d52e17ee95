//! Minimum interval and message size, set on the passive node: what they let through, and how fast.

use anyhow::{Context, Result};

use super::availability::{counts, per_second};
use super::plan::Plan;
use crate::lanes::side_by_side;
use crate::pair::{Pair, Setting};
use crate::peers::{Contender, SECURED};
use crate::progress::{Progress, is_stopped};
use crate::results::{Constrained, Mode};
use cara_bench_ends::Burst;
use cara_bench_ends::Pin;
use cara_bench_ends::{Delivery, Limits};

/// Settings that are measured at the same time; each waits most of it.
const LANES: usize = 6;

/// A pair that goes from interval to interval.
struct Lane {
    contender: Contender,
    message_size: u32,
    chars: u32,
}

pub(super) fn measure(plan: &Plan, rows: &mut Vec<Constrained>) -> Result<()> {
    let sweep = &plan.constrained;
    let mut lanes = Vec::new();
    for contender in ["cara", SECURED].map(Contender::Own) {
        for &message_size in &sweep.message_sizes {
            let lane = |&chars: &u32| Lane { contender: contender.clone(), message_size, chars };
            lanes.extend(sweep.chars.iter().map(lane));
        }
    }
    let bar = Progress::new("constraints", sweep.intervals_ms.len() * lanes.len());
    let mut outcome = Ok(());
    for (found, ended) in side_by_side(lanes, LANES, |lane| lane.run(plan, &bar)) {
        rows.extend(found);
        outcome = outcome.and(ended);
    }
    rows.sort_by_key(|row| (row.mode == Mode::Secured, row.minimum_interval_ms, row.message_size, row.chars));
    outcome
}

impl Lane {
    /// The rows of all intervals that are complete, and why there are no more.
    fn run(&self, plan: &Plan, bar: &Progress) -> (Vec<Constrained>, Result<()>) {
        let (sweep, mut rows) = (&plan.constrained, Vec::new());
        let setting = Setting { pin: plan.pin, distribution: 1, print: false, wire: None };
        let outcome = Pair::start(&self.contender, setting).and_then(|mut pair| {
            for &minimum_interval_ms in sweep.intervals_ms.iter().take_while(|_| !is_stopped()) {
                let limits = Limits { minimum_interval_ms, message_size: self.message_size };
                let (chars, count, period_ms) = (self.chars, sweep.count, sweep.period_ms);
                let burst = Burst { chars, count, period_ms, delivery: Delivery::Reliable, insist: false };
                let row = row(&mut pair, plan.pin, limits, &burst);
                let row = row.with_context(|| format!("{limits:?}, {chars} characters"))?;
                rows.push(Constrained { mode: self.contender.name_and_mode().1, ..row });
                bar.step();
            }
            Ok(())
        });
        (rows, outcome)
    }
}

/// The row of a pair in plain mode.
fn row(pair: &mut Pair, pin: Pin, limits: Limits, burst: &Burst) -> Result<Constrained> {
    pair.constrain(limits)?;
    let delivered = pair.burst(burst)?;
    let executed_per_s = per_second(&delivered).round();
    Ok(Constrained {
        minimum_interval_ms: limits.minimum_interval_ms,
        message_size: limits.message_size,
        chars: burst.chars,
        period_ms: burst.period_ms,
        pin,
        mode: Mode::Plain,
        counts: counts(&[delivered]),
        executed_per_s,
    })
}
