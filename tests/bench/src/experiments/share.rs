//! The share of a 20,000-character round trip that goes into making and reading messages.

use anyhow::Result;

use super::plan::Plan;
use crate::child::OwnQuestion;
use crate::pair::{Pair, Setting};
use crate::peers::Contender;
use crate::progress::{bar, is_stopped};
use crate::results::{Mode, Share, micros, ratio};
use crate::share::{Order, Times};
use crate::statistics::percentile;
use cara_bench_ends::Pin;

/// As in the paper.
const CHARS: u32 = 20_000;
/// Both ends on one CPU: the round trip is the work of both, so that shares of it mean work as well.
const PIN: Pin = Pin::Same;

pub(super) fn measure(plan: &Plan, share: &mut Option<Share>) -> Result<()> {
    let mut pair = Pair::start(&Contender::Own("cara"), Setting { pin: PIN, distribution: 1, print: false })?;
    let bar = bar("share of making and reading messages", plan.share_rounds as usize);
    let mut all = Times::default();
    for _ in 0..plan.share_rounds {
        if is_stopped() {
            break;
        }
        let order = Order { chars: CHARS, calls: plan.share_calls };
        let times: Times = pair.ask_client(&OwnQuestion::Share { share: order })?;
        all.round_trips.extend(times.round_trips);
        all.generate.extend(times.generate);
        all.process.extend(times.process);
        bar.inc(1);
    }
    bar.finish_and_clear();
    *share = (!all.round_trips.is_empty()).then(|| of(all));
    Ok(())
}

fn of(mut times: Times) -> Share {
    let n = times.round_trips.len();
    let [round_trip, generate, process] =
        [&mut times.round_trips, &mut times.generate, &mut times.process].map(|times| {
            times.sort_unstable();
            percentile(times, 50.0)
        });
    let part = |nanos: u64| ratio(nanos as f64 / round_trip.max(1) as f64);
    Share {
        chars: CHARS,
        pin: PIN,
        mode: Mode::Plain,
        n,
        round_trip_us: micros(round_trip),
        generate_us: micros(generate),
        process_us: micros(process),
        generate: part(generate),
        process: part(process),
    }
}
