//! The paper's experiments on a link that fills: every pair of processes has two hosts and a cable of a rate to itself.

use std::time::Duration;

use anyhow::{Context, Result};
use cara_bench_ends::{Burst, Delivery, Limits, Order};
use cara_processes::cable::Cable;

use super::availability::{counts, per_second};
use super::plan::Plan;
use super::response::{Cells, rows, turns};
use crate::lanes::side_by_side;
use crate::pair::{Delivered, Pair, Setting};
use crate::peers::{Contender, SECURED};
use crate::progress::{Progress, is_stopped};
use crate::results::{LinkAvailability, LinkConstrained, Mode, OnLink, Results, micros, ratio};
use crate::statistics::{Cell, quartile};

/// Pairs that start at the same time.
const AT_A_TIME: usize = 8;
/// What the links of pairs that run side by side carry together at most, in Mbit/s: more would fill two CPUs before it fills the links.
const TOGETHER: u32 = 400;
/// A request that is executed later than this behind the time at which the last one of its group was due has come too late.
/// As long as what waits in the link's own queue.
pub(super) const GRACE: Duration = Duration::from_millis(50);
/// Longest text of a datagram.
const DATAGRAM_CHARS: u32 = 1_000;

/// Rows that say why there are none, where this machine or user can have no cable.
pub(super) fn measure(plan: &Plan, results: &mut Results) -> Result<()> {
    if let Err(reason) = Cable::lay(plan.link.wire(plan.link.mbit.first().copied().unwrap_or(10))) {
        let reason = format!("{reason:#}");
        eprintln!("link: skipped: {reason}");
        for &mbit in &plan.link.mbit {
            results.link_response.push(OnLink::skipped(mbit, &reason));
            results.link_availability.push(OnLink::skipped(mbit, &reason));
            results.link_constraints.push(OnLink::skipped(mbit, &reason));
        }
        return Ok(());
    }
    let response = response(plan, results);
    let availability = availability(plan, results);
    let constraints = constraints(plan, results);
    response.and(availability).and(constraints)
}

/// All rates at the same time, one distribution after the other.
fn response(plan: &Plan, results: &mut Results) -> Result<()> {
    let mut outcome = Ok(());
    for distribution in [1, 2] {
        let groups = plan.link.response.iter().filter(|group| group.setting.distribution == distribution);
        let found = side_by_side(groups.collect(), plan.link.mbit.len(), |group| {
            let (mut cells, mbit) = (Cells::new(), group.setting.mbit());
            let ended =
                turns(group, &mut cells, &format!("link: response, {mbit} Mbit/s, distribution {distribution}"));
            (rows(group, &cells).into_iter().map(move |row| OnLink::measured(mbit, row)), ended)
        });
        for (rows, ended) in found {
            results.link_response.extend(rows);
            outcome = outcome.and(ended);
        }
    }
    outcome
}

/// A pair that goes from period to period.
struct Lane<'p> {
    contender: &'p Contender,
    setting: Setting,
    delivery: Delivery,
    chars: u32,
    periods_ms: Vec<u64>,
}

/// One rate after the other; at each, all sizes and peers in both distributions, on a cable each, as many side by side as the CPUs
/// bear.
fn availability(plan: &Plan, results: &mut Results) -> Result<()> {
    let bursts = &plan.link.availability;
    let mut outcome = Ok(());
    for &mbit in bursts.mbit.iter().take_while(|_| !is_stopped()) {
        let mut lanes = Vec::new();
        let (sizes, periods) = (bursts.sizes(mbit), bursts.periods_ms(mbit));
        for (distribution, &chars) in
            [1, 2].into_iter().flat_map(|number| sizes.clone().map(move |chars| (number, chars)))
        {
            let wire = Some(plan.link.wire(mbit));
            let setting = Setting { pin: plan.pin, distribution, print: true, wire };
            for contender in &bursts.peers {
                let is_ours = contender.name_and_mode().0 == "cara";
                let datagrams = is_ours && chars <= DATAGRAM_CHARS;
                let deliveries =
                    [Delivery::Reliable, Delivery::BestEffort].into_iter().take(1 + usize::from(datagrams));
                for delivery in deliveries {
                    let mut periods_ms = periods.clone();
                    let first = lanes.len() % periods_ms.len().max(1);
                    periods_ms.rotate_left(first);
                    lanes.push(Lane { contender, setting, delivery, chars, periods_ms });
                }
            }
        }
        let bar = Progress::new(
            &format!("link: availability, {mbit} Mbit/s, {} pairs", lanes.len()),
            lanes.len() * periods.len(),
        );
        while !lanes.is_empty() && !is_stopped() {
            let later = lanes.split_off(lanes.len().min((TOGETHER / mbit.max(1)).max(1) as usize));
            let started = side_by_side(std::mem::replace(&mut lanes, later), AT_A_TIME, |lane| {
                (lane.contender.tolerate(Pair::start(lane.contender, lane.setting)), lane)
            });
            let count = started.len();
            for (rows, ended) in side_by_side(started, count, |(pair, lane)| lane.run(plan, pair, &bar)) {
                results.link_availability.extend(rows.into_iter().map(|row| OnLink::measured(mbit, row)));
                outcome = outcome.and(ended);
            }
        }
    }
    results.link_availability.sort_by(|one, other| {
        let order = |on: &OnLink<LinkAvailability>| {
            on.row.as_ref().map(|row| {
                let best_effort = row.delivery == Delivery::BestEffort;
                (row.distribution, row.peer.clone(), row.mode.name(), best_effort, row.chars, on.mbit, row.period_ms)
            })
        };
        order(one).cmp(&order(other))
    });
    outcome
}

/// Connects, and has both ends touch what they need.
fn warm_up(pair: &mut Pair, chars: u32) -> Result<()> {
    let (delivery, insist) = (Delivery::Reliable, false);
    pair.burst(&Burst { chars, count: 3, period_ms: 50, delivery, insist }).context("the first messages").map(drop)
}

impl Lane<'_> {
    /// The rows of all periods that are complete, and why there are no more.
    fn run(self, plan: &Plan, pair: Result<Option<Pair>>, bar: &Progress) -> (Vec<LinkAvailability>, Result<()>) {
        let (bursts, mut rows) = (&plan.link.availability, Vec::new());
        let mut pair = match pair {
            Ok(Some(pair)) => pair,
            Ok(None) => return (rows, Ok(())),
            Err(error) => return (rows, Err(error)),
        };
        if let Err(error) = self.contender.tolerate(warm_up(&mut pair, self.chars)) {
            return (rows, Err(error));
        }
        for &period_ms in self.periods_ms.iter().take_while(|_| !is_stopped()) {
            let (chars, delivery) = (self.chars, self.delivery);
            let burst = Burst { chars, count: bursts.group, period_ms, delivery, insist: false };
            let within = GRACE + Duration::from_millis(period_ms) * bursts.group.saturating_sub(1);
            let groups = (0..bursts.groups).map(|_| pair.burst_within(&burst, Some(within)));
            let groups = groups.collect::<Result<Vec<_>>>().with_context(|| {
                format!("{}, {:?}: {chars} characters every {period_ms} ms", self.contender.name(), self.setting)
            });
            match self.contender.tolerate(groups) {
                Ok(groups) => rows.extend(groups.filter(|groups| !groups.is_empty()).map(|groups| {
                    let Setting { distribution, print, .. } = self.setting;
                    row(self.contender.name_and_mode(), distribution, print, self.setting.mbit(), &burst, &groups)
                })),
                Err(error) => return (rows, Err(error)),
            }
            if !self.contender.works() {
                break;
            }
            bar.step();
        }
        (rows, Ok(()))
    }
}

/// What became of these groups of requests.
pub(super) fn row(
    (peer, mode): (&str, Mode),
    distribution: u8,
    print: bool,
    mbit: u32,
    burst: &Burst,
    groups: &[Delivered],
) -> LinkAvailability {
    let shares = || groups.iter().map(|group| ratio(group.in_time as f64 / f64::from(burst.count.max(1))));
    let bits_per_s = f64::from(burst.chars) * 8e3 / burst.period_ms.max(1) as f64;
    LinkAvailability {
        peer: peer.to_owned(),
        distribution,
        chars: burst.chars,
        period_ms: burst.period_ms,
        delivery: burst.delivery,
        mode,
        print,
        load: ratio(bits_per_s / (f64::from(mbit) * 1e6)),
        counts: counts(groups),
        in_time_of_offered: ratio(shares().sum::<f64>() / groups.len().max(1) as f64),
        worst_group: shares().fold(1.0, f64::min),
        best_group: shares().fold(0.0, f64::max),
        executed_per_s: quartile(groups.iter().map(per_second).collect(), 2).round(),
    }
}

/// A pair that goes from interval to interval.
struct Constraint {
    contender: Contender,
    mbit: u32,
    message_size: u32,
    chars: u32,
    delivery: Delivery,
}

/// Every interval with every message size, all side by side at one rate after the other.
fn constraints(plan: &Plan, results: &mut Results) -> Result<()> {
    let sweep = &plan.link.constrained;
    let mut outcome = Ok(());
    for &mbit in plan.link.mbit.iter().take_while(|_| !is_stopped()) {
        let mut lanes = Vec::new();
        for contender in ["cara", SECURED].map(Contender::Own) {
            for (&message_size, &chars) in
                sweep.message_sizes.iter().flat_map(|size| sweep.chars.iter().map(move |chars| (size, chars)))
            {
                let lane = |delivery| Constraint { contender: contender.clone(), mbit, message_size, chars, delivery };
                lanes.push(lane(Delivery::Reliable));
                lanes.extend((chars <= DATAGRAM_CHARS).then(|| lane(Delivery::BestEffort)));
            }
        }
        let count = lanes.len();
        let bar = Progress::new(&format!("link: constraints, {mbit} Mbit/s"), count * sweep.intervals_ms.len());
        let started = side_by_side(lanes, AT_A_TIME, |lane| (Pair::start(&lane.contender, lane.setting(plan)), lane));
        for (rows, ended) in side_by_side(started, count, |(pair, lane)| lane.run(plan, pair, &bar)) {
            results.link_constraints.extend(rows.into_iter().map(|row| OnLink::measured(mbit, row)));
            outcome = outcome.and(ended);
        }
    }
    outcome
}

impl Constraint {
    fn setting(&self, plan: &Plan) -> Setting {
        Setting { pin: plan.pin, distribution: 1, print: true, wire: Some(plan.link.wire(self.mbit)) }
    }

    fn run(self, plan: &Plan, pair: Result<Pair>, bar: &Progress) -> (Vec<LinkConstrained>, Result<()>) {
        let mut rows = Vec::new();
        let outcome = pair.and_then(|mut pair| {
            warm_up(&mut pair, self.chars)?;
            for &interval_ms in plan.link.constrained.intervals_ms.iter().take_while(|_| !is_stopped()) {
                rows.push(self.row(plan, &mut pair, interval_ms)?);
                bar.step();
            }
            Ok(())
        });
        (rows, outcome)
    }

    fn row(&self, plan: &Plan, pair: &mut Pair, minimum_interval_ms: u64) -> Result<LinkConstrained> {
        let (sweep, chars) = (&plan.link.constrained, self.chars);
        let (period_ms, count) = (sweep.period_ms, sweep.count);
        pair.constrain(Limits { minimum_interval_ms, message_size: self.message_size })?;
        let burst = Burst { chars, count, period_ms, delivery: self.delivery, insist: false };
        let within = GRACE + Duration::from_millis(period_ms) * count.saturating_sub(1);
        let delivered = pair.burst_within(&burst, Some(within))?;
        // Calls keep the interval, so that what is timed is the call and not its refusal.
        let pause_ms = minimum_interval_ms.max(period_ms) + 1;
        let order = Order { chars, callers: 1, calls_per_caller: plan.link.constrained_calls, pause_ms, delay_us: 0 };
        std::thread::sleep(Duration::from_millis(pause_ms));
        let called = pair.block(&order);
        let figures = called.as_ref().ok().map(|turn| Cell { turns: vec![turn.clone()] }.figures());
        Ok(LinkConstrained {
            minimum_interval_ms,
            message_size: self.message_size,
            chars,
            period_ms,
            delivery: self.delivery,
            mode: self.contender.name_and_mode().1,
            in_time_of_offered: ratio(delivered.in_time as f64 / f64::from(count.max(1))),
            executed_per_s: per_second(&delivered).round(),
            counts: counts(&[delivered]),
            calls: figures.as_ref().map_or(0, |figures| figures.calls),
            p50_us: figures.as_ref().map(|figures| micros(figures.median)),
            p99_us: figures.as_ref().map(|figures| micros(figures.p99)),
            call_refused: called.err().map(|error| format!("{:#}", error.root_cause())),
        })
    }
}
