//! Minimum interval and message size, set on the passive node: what they let through, and how fast.

use anyhow::{Context, Result};

use super::availability::{counts, per_second};
use super::plan::Plan;
use crate::pair::{Pair, Setting};
use crate::peers::Contender;
use crate::progress::{bar, is_stopped};
use crate::results::{Constrained, Mode};
use cara_bench_ends::Burst;
use cara_bench_ends::Pin;
use cara_bench_ends::{Delivery, Limits};

pub(super) fn measure(plan: &Plan, rows: &mut Vec<Constrained>) -> Result<()> {
    let sweep = &plan.constrained;
    let setting = Setting { pin: plan.pin, distribution: 1, print: false };
    let mut pair = Pair::start(&Contender::Own("cara"), setting)?;
    let settings = sweep.intervals_ms.len() * sweep.message_sizes.len();
    let bar = bar("constraints", settings * sweep.chars.len());
    for &minimum_interval_ms in &sweep.intervals_ms {
        for &message_size in &sweep.message_sizes {
            for &chars in &sweep.chars {
                if is_stopped() {
                    return Ok(());
                }
                let limits = Limits { minimum_interval_ms, message_size };
                let (count, period_ms) = (sweep.count, sweep.period_ms);
                let burst = Burst { chars, count, period_ms, delivery: Delivery::Reliable, insist: false };
                rows.push(
                    row(&mut pair, plan.pin, limits, &burst)
                        .with_context(|| format!("{limits:?}, {chars} characters"))?,
                );
                bar.inc(1);
            }
        }
    }
    bar.finish_and_clear();
    Ok(())
}

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
