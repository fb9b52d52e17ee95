//! Availability: one-way requests at fixed periods, counted by the service that executes them.

use std::collections::BTreeMap;

use anyhow::{Context, Result};

use super::plan::{Bursts, Plan};
use crate::lanes::side_by_side;
use crate::pair::{Delivered, Pair, Setting};
use crate::peers::{Contender, SECURED};
use crate::progress::{Progress, is_stopped};
use crate::results::{Availability, Counts, Mode, ratio};
use crate::statistics::quartile;
use cara_bench_ends::Burst;
use cara_bench_ends::Delivery;

/// Pairs that start at the same time.
const AT_A_TIME: usize = 8;
/// Ours, in both modes.
const OWN: [Contender; 2] = [Contender::Own("cara"), Contender::Own(SECURED)];

/// First what keeps a CPU busy, on its own; then whatever waits between its requests, side by side.
pub(super) fn measure(plan: &Plan, rows: &mut Vec<Availability>) -> Result<()> {
    let alone = [1, 2].map(|distribution| at_once(plan, distribution, rows));
    let outcome = alone.into_iter().chain([spaced(plan, rows)]).collect();
    rows.sort_by_key(|row| {
        (row.distribution, row.mode == Mode::Secured, row.delivery == Delivery::BestEffort, row.chars, row.period_ms)
    });
    outcome
}

/// Period 0, in turns with the floor.
fn at_once(plan: &Plan, distribution: u8, rows: &mut Vec<Availability>) -> Result<()> {
    let setting = Setting { pin: plan.pin, distribution, print: false, wire: None };
    let bursts: Vec<_> = plan.availability.iter().filter(|bursts| bursts.distribution == distribution).collect();
    let mut floor = Pair::start(&Contender::Own("floor"), setting)?;
    let started = side_by_side(OWN.iter().collect(), OWN.len(), |own| Pair::start(own, setting));
    let mut pairs = started.into_iter().collect::<Result<Vec<_>>>()?;
    let steps = bursts.iter().filter(|bursts| bursts.periods_ms.contains(&0)).map(|bursts| bursts.chars.len()).sum();
    let bar = Progress::new(&format!("availability at period 0, distribution {distribution}"), steps);
    for bursts in bursts.into_iter().filter(|bursts| bursts.periods_ms.contains(&0)) {
        for &chars in &bursts.chars {
            let burst = bursts.burst(chars, 0);
            let mut cells = [Groups::default(), Groups::default()];
            for _ in (0..bursts.groups).take_while(|_| !is_stopped()) {
                let compared = burst.delivery == Delivery::Reliable;
                let floor_per_s = compared.then(|| floor.burst(&burst)).transpose()?.as_ref().map(per_second);
                for (cell, pair) in cells.iter_mut().zip(&mut pairs) {
                    cell.floor_per_s.extend(floor_per_s);
                    cell.own.push(pair.burst(&burst).with_context(|| format!("{chars} characters at once"))?);
                }
            }
            rows.extend(cells.iter().zip(&OWN).filter_map(|(cell, own)| cell.row(own, setting, &burst)));
            bar.step();
        }
    }
    Ok(())
}

/// A pair that goes from period to period.
struct Lane<'p> {
    contender: &'static Contender,
    setting: Setting,
    bursts: &'p Bursts,
    chars: u32,
    periods_ms: Vec<u64>,
}

/// All periods that leave the CPUs idle most of the time: each size, delivery, distribution and mode has a pair of its
/// own, and begins with another period than its neighbours.
fn spaced(plan: &Plan, rows: &mut Vec<Availability>) -> Result<()> {
    let mut lanes = Vec::new();
    for bursts in &plan.availability {
        let setting = Setting { pin: plan.pin, distribution: bursts.distribution, print: true, wire: None };
        let spaced: Vec<u64> = bursts.periods_ms.iter().copied().filter(|period| *period > 0).collect();
        for (&chars, contender) in bursts.chars.iter().flat_map(|chars| OWN.iter().map(move |own| (chars, own))) {
            let mut periods_ms = spaced.clone();
            periods_ms.rotate_left(lanes.len() % spaced.len().max(1));
            lanes.push(Lane { contender, setting, bursts, chars, periods_ms });
        }
    }
    lanes.retain(|lane| !lane.periods_ms.is_empty());
    let groups = lanes.iter().map(|lane| lane.periods_ms.len() * lane.bursts.groups as usize).sum();
    let bar = Progress::new(&format!("availability, {} pairs side by side", lanes.len()), groups);
    let started = side_by_side(lanes, AT_A_TIME, |lane| (Pair::start(lane.contender, lane.setting), lane));
    let count = started.len();
    let mut outcome = Ok(());
    for (found, ended) in side_by_side(started, count, |(pair, lane)| lane.run(pair, &bar)) {
        rows.extend(found);
        outcome = outcome.and(ended);
    }
    outcome
}

impl Lane<'_> {
    /// The rows of all periods that are complete, and why there are no more.
    fn run(self, pair: Result<Pair>, bar: &Progress) -> (Vec<Availability>, Result<()>) {
        let mut rows = Vec::new();
        let outcome = pair.and_then(|mut pair| {
            for &period_ms in &self.periods_ms {
                let burst = self.bursts.burst(self.chars, period_ms);
                let mut cell = Groups::default();
                for _ in (0..self.bursts.groups).take_while(|_| !is_stopped()) {
                    let reported = || format!("{} characters every {period_ms} ms", self.chars);
                    cell.own.push(pair.burst(&burst).with_context(reported)?);
                    bar.step();
                }
                rows.extend(cell.row(self.contender, self.setting, &burst));
            }
            Ok(())
        });
        (rows, outcome)
    }
}

/// The groups of one cell.
#[derive(Default)]
struct Groups {
    own: Vec<Delivered>,
    /// The floor's speed in the same turns, at period 0.
    floor_per_s: Vec<f64>,
}

impl Groups {
    fn row(&self, contender: &Contender, setting: Setting, burst: &Burst) -> Option<Availability> {
        let speeds: Vec<f64> = self.own.iter().map(per_second).collect();
        let ratios: Vec<f64> = speeds.iter().zip(&self.floor_per_s).map(|(own, floor)| own / floor.max(1e-9)).collect();
        let group = f64::from(burst.count.max(1));
        let worst = self.own.iter().map(|group| group.executed).min()?;
        let has_floor = !self.floor_per_s.is_empty();
        Some(Availability {
            distribution: setting.distribution,
            chars: burst.chars,
            period_ms: burst.period_ms,
            delivery: burst.delivery,
            pin: setting.pin,
            mode: contender.name_and_mode().1,
            print: setting.print,
            counts: counts(&self.own),
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
        let group = Delivered { offered, executed: 6, failed: 1, elapsed: 1_000, in_time: 0 };
        let counts = counts(&[group.clone(), group]);
        assert_eq!((counts.offered, counts.sent, counts.refused), (20, 14, 6));
        assert_eq!((counts.executed, counts.lost), (12, 2));
        assert_eq!((counts.executed_of_offered, counts.executed_of_sent), (0.6, 0.8571));
        assert_eq!((counts.reasons["full"], counts.reasons["reported after it was sent"]), (4, 2));
    }
}
