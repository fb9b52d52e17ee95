//! Availability: one-way requests at fixed periods, counted by the service that executes them.

use std::collections::BTreeMap;

use anyhow::{Context, Result};

use super::plan::{Bursts, Plan};
use crate::pair::{Delivered, Pair, Setting};
use crate::peers::Contender;
use crate::progress::{bar, is_stopped};
use crate::results::{Availability, Counts, Mode, ratio};
use crate::statistics::quartile;
use cara_bench_ends::Burst;
use cara_bench_ends::Delivery;

pub(super) fn measure(plan: &Plan, rows: &mut Vec<Availability>) -> Result<()> {
    for distribution in [1, 2] {
        let setting = Setting { pin: plan.pin, distribution, print: false };
        let start = |peer| Pair::start(&Contender::Own(peer), setting);
        let mut pairs = [start("floor")?, start("cara")?];
        for bursts in plan.availability.iter().filter(|bursts| bursts.distribution == distribution) {
            of(setting, &mut pairs, bursts, rows)?;
        }
    }
    Ok(())
}

fn of(setting: Setting, pairs: &mut [Pair; 2], bursts: &Bursts, rows: &mut Vec<Availability>) -> Result<()> {
    let delivery = if bursts.delivery == Delivery::Reliable { "reliable" } else { "best effort" };
    let what = format!("availability: {delivery}, distribution {}", bursts.distribution);
    let bar = bar(&what, bursts.chars.len() * bursts.periods_ms.len() * bursts.groups as usize);
    for &chars in &bursts.chars {
        for &period_ms in &bursts.periods_ms {
            let burst = Burst { chars, count: bursts.group, period_ms, delivery: bursts.delivery, insist: false };
            let mut cell = Groups::default();
            for _ in 0..bursts.groups {
                if is_stopped() {
                    break;
                }
                let outcome = cell.take_turns(pairs, &burst);
                outcome.with_context(|| format!("{chars} characters every {period_ms} ms"))?;
                bar.inc(1);
            }
            rows.extend(cell.row(setting, &burst));
        }
    }
    bar.finish_and_clear();
    Ok(())
}

/// The groups of one cell.
#[derive(Default)]
struct Groups {
    cara: Vec<Delivered>,
    /// The floor's speed in the same turns, at period 0.
    floor_per_s: Vec<f64>,
}

impl Groups {
    fn take_turns(&mut self, [floor, cara]: &mut [Pair; 2], burst: &Burst) -> Result<()> {
        if burst.period_ms == 0 && burst.delivery == Delivery::Reliable {
            self.floor_per_s.push(per_second(&floor.burst(burst)?));
        }
        self.cara.push(cara.burst(burst)?);
        Ok(())
    }

    fn row(&self, setting: Setting, burst: &Burst) -> Option<Availability> {
        let speeds: Vec<f64> = self.cara.iter().map(per_second).collect();
        let ratios: Vec<f64> = speeds.iter().zip(&self.floor_per_s).map(|(own, floor)| own / floor.max(1e-9)).collect();
        let group = f64::from(burst.count.max(1));
        let worst = self.cara.iter().map(|group| group.executed).min()?;
        let has_floor = !self.floor_per_s.is_empty();
        Some(Availability {
            distribution: setting.distribution,
            chars: burst.chars,
            period_ms: burst.period_ms,
            delivery: burst.delivery,
            pin: setting.pin,
            mode: Mode::Plain,
            counts: counts(&self.cara),
            worst_group: ratio(worst as f64 / group),
            executed_per_s: quartile(speeds, 2).round(),
            floor_per_s: has_floor.then(|| quartile(self.floor_per_s.clone(), 2).round()),
            ratio: has_floor.then(|| ratio(quartile(ratios, 2))),
        })
    }
}

/// Executed per second, from the first offer to the last execution.
pub(super) fn per_second(delivered: &Delivered) -> f64 {
    delivered.executed as f64 * 1e9 / delivered.elapsed.max(1) as f64
}

/// The sums over all groups. Sent is what was taken and not reported as refused afterwards.
pub(super) fn counts(groups: &[Delivered]) -> Counts {
    let sum = |of: fn(&Delivered) -> u64| groups.iter().map(of).sum::<u64>();
    let offered = sum(|group| group.offered.taken + group.offered.refused);
    let refused = sum(|group| group.offered.refused + group.failed);
    let executed = sum(|group| group.executed);
    let sent = offered.saturating_sub(refused);
    let mut reasons: BTreeMap<String, u64> = BTreeMap::new();
    let late = groups.iter().map(|group| ("reported after it was sent", group.failed));
    let early = groups.iter().flat_map(|group| group.offered.reasons.iter().map(|(why, count)| (why.as_str(), *count)));
    for (why, count) in late.chain(early).filter(|(_, count)| *count > 0) {
        *reasons.entry(why.to_owned()).or_default() += count;
    }
    let part = |of: u64| if of == 0 { 0.0 } else { ratio(executed as f64 / of as f64) };
    Counts {
        offered,
        sent,
        refused,
        executed,
        lost: sent.saturating_sub(executed),
        executed_of_offered: part(offered),
        executed_of_sent: part(sent),
        reasons,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cara_bench_ends::Offered;

    #[test]
    fn refused_and_lost_are_told_apart() {
        let reasons = BTreeMap::from([("full".to_owned(), 2)]);
        let offered = Offered { taken: 8, refused: 2, reasons, start: 0 };
        let group = Delivered { offered, executed: 6, failed: 1, elapsed: 1_000 };
        let counts = counts(&[group.clone(), group]);
        assert_eq!((counts.offered, counts.sent, counts.refused), (20, 14, 6));
        assert_eq!((counts.executed, counts.lost), (12, 2));
        assert_eq!((counts.executed_of_offered, counts.executed_of_sent), (0.6, 0.8571));
        assert_eq!((counts.reasons["full"], counts.reasons["reported after it was sent"]), (4, 2));
    }
}
