//! The share of a 20,000-character round trip that goes into making and reading messages.

use anyhow::Result;

use super::plan::Plan;
use crate::child::OwnQuestion;
use crate::counted;
use crate::pair::{Pair, Setting};
use crate::peers::{Contender, SECURED};
use crate::progress::{Progress, is_stopped};
use crate::results::{Mode, Share, micros, ratio};
use crate::share::{Order, Times};
use crate::statistics::percentile;
use cara_bench_ends::Pin;

/// As in the paper.
const CHARS: u32 = 20_000;
/// Both ends on one CPU: the round trip is the work of both, so that shares of it mean work as well.
const PIN: Pin = Pin::Same;
/// Ours, in both modes.
const OWN: [(&str, Mode); 2] = [("cara", Mode::Plain), (SECURED, Mode::Secured)];

/// In plain mode, and with keys.
pub(super) fn measure(plan: &Plan, share: &mut Option<Share>, notes: &mut Vec<String>) -> Result<()> {
    *share = of(&OWN[0], plan, notes)?;
    let secured = of(&OWN[1], plan, notes)?;
    if let Some(share) = share {
        share.secured = secured.map(Box::new);
    }
    Ok(())
}

fn of(&(own, mode): &(&'static str, Mode), plan: &Plan, notes: &mut Vec<String>) -> Result<Option<Share>> {
    let mut pair = Pair::start(&Contender::Own(own), Setting { pin: PIN, distribution: 1, print: false, wire: None })?;
    let what = format!("share of making and reading messages, {}", mode.name());
    let bar = Progress::new(&what, plan.share_rounds as usize);
    let mut all = Times::default();
    for _ in (0..plan.share_rounds).take_while(|_| !is_stopped()) {
        let order = Order { chars: CHARS, calls: plan.share_calls };
        let times: Times = pair.ask_client(&OwnQuestion::Share { share: order })?;
        all.round_trips.extend(times.round_trips);
        all.generate.extend(times.generate);
        all.process.extend(times.process);
        bar.step();
    }
    if all.round_trips.is_empty() {
        return Ok(None);
    }
    let share = row(mode, all);
    if !counted::is_installed() || is_stopped() {
        return Ok(Some(share));
    }
    eprintln!("counting instructions, {}", mode.name());
    drop(pair);
    let counted = match counted::measure(own, CHARS, plan.counted_calls) {
        Ok(counted) => counted,
        Err(error) => {
            // What was timed stands without it.
            notes.push(format!("{own} under callgrind: {error:#}"));
            return Ok(Some(share));
        }
    };
    Ok(Some(Share {
        instructions_per_call: Some(counted.per_call),
        generate_instructions: Some(counted.generate),
        process_instructions: Some(counted.process),
        instructions: Some(counted),
        ..share
    }))
}

/// What was timed.
fn row(mode: Mode, mut times: Times) -> Share {
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
        mode,
        n,
        round_trip_us: micros(round_trip),
        generate_us: micros(generate),
        process_us: micros(process),
        generate: part(generate),
        process: part(process),
        instructions_per_call: None,
        generate_instructions: None,
        process_instructions: None,
        instructions: None,
        secured: None,
    }
}
