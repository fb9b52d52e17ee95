//! A board that publishes where it is with each tick of its motors' loop, 50 times a second, to a manager that calls it
//! meanwhile. The same calls are made without a subscription in the same run, and the two halves of those tell what
//! differs when nothing does.
//!
//! How often values come is counted in the board's own ticks: while it drives, each moves it by the same way.

use std::time::Instant;

use anyhow::{Context, Result, ensure};
use cara_std::{Duration, Peer, Subscription};
use clap::Args;

use crate::board::{Bench, LONG, Who};
use crate::manager::{Manager, position, sets_out};

/// What is measured.
#[derive(Args)]
pub(crate) struct Streams {
    /// Rounds of four blocks.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Calls of a block.
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..))]
    calls: u32,
}

/// Between two calls, so that values come among them.
const PAUSE: std::time::Duration = std::time::Duration::from_millis(10);
/// How often values are wanted: as often as the motors' loop comes round.
const INTERVAL: Duration = Duration::from_millis(20);
/// The way of a tick, in units.
const WAY_OF_A_TICK: f64 = 0.04;
/// Of a hundred ticks of the board at least so many come as values: a tick that is late is followed by one that is early,
/// whose value waits for its turn and may be replaced.
const LEAST_SHARE: f64 = 0.8;

/// Runs it and prints what was found.
pub(crate) fn run(bench: &Bench, Streams { rounds, calls }: &Streams) -> Result<()> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let _board = bench.board(&cable, &Who::agv(17))?;
    let agv = manager.meet_offering(&Who::agv(17), "charge")?;
    let charge: f64 = agv.stream("charge")?.subscribe(INTERVAL).next(Duration::from(LONG))?.value("percent")?;
    ensure!(charge == 100.0, "its battery is full, and it tells {charge} %");
    let (mut without, mut with) = ([Vec::new(), Vec::new()], Vec::new());
    let (mut values, mut ticks) = (0, 0.0);
    let mut target = 0;
    for round in 0..*rounds {
        for subscribed in [false, true, true, false] {
            // It drives all the time, to and fro.
            target = 1_000 - target;
            let drives = || sets_out(&agv, [target, 0]);
            drives()?;
            if !subscribed {
                without[round as usize % 2].extend(call(&agv, *calls)?);
                continue;
            }
            let mut pose = agv.stream("pose")?.subscribe(INTERVAL);
            let began = at(&mut pose)?;
            let before = received(&agv)?;
            with.extend(call(&agv, *calls)?);
            let (ended, after) = (at(&mut pose)?, received(&agv)?);
            values += after - before;
            ticks += (ended - began).abs() / WAY_OF_A_TICK;
        }
    }
    let [first, second] = &without;
    let all = [first.as_slice(), second].concat();
    println!("| calls | count | p50 µs | p99 µs |\n|---|---|---|---|");
    let named = [
        ("without values", &all),
        ("with values", &with),
        ("even rounds without", first),
        ("odd rounds without", second),
    ];
    for (what, times) in named {
        println!("| {what} | {} | {} | {} |", times.len(), percentile(times, 50), percentile(times, 99));
    }
    let ratio = |one: &[u64], other: &[u64]| {
        let [p50, p99] =
            [50, 99].map(|percent| percentile(one, percent) as f64 / percentile(other, percent).max(1) as f64);
        format!("p50 {p50:.3}, p99 {p99:.3}")
    };
    println!("with / without: {}; odd / even rounds without: {}", ratio(&with, &all), ratio(second, first));
    println!("{values} values came in {ticks:.0} ticks of the board");
    ensure!(values as f64 >= LEAST_SHARE * ticks && ticks > 0.0, "{values} values in {ticks:.0} ticks");
    Ok(())
}

/// Where it is, from a value that has just come.
fn at(pose: &mut Subscription) -> Result<f64> {
    let [x, _]: [f64; 2] = pose.next(Duration::from(LONG)).context("no value comes")?.value("position")?;
    Ok(x)
}

fn received(agv: &Peer) -> Result<u64> {
    let counters = agv.counters();
    counters.iter().find(|(name, _)| *name == "SamplesReceived").map(|(_, count)| *count).context("no such counter")
}

/// Calls in a row, each of which is answered; how long each took, in microseconds.
fn call(agv: &Peer, calls: u32) -> Result<Vec<u64>> {
    (0..calls)
        .map(|_| {
            std::thread::sleep(PAUSE);
            let began = Instant::now();
            position(agv)?;
            Ok(began.elapsed().as_micros() as u64)
        })
        .collect()
}

fn percentile(times: &[u64], percent: usize) -> u64 {
    let mut times = times.to_vec();
    times.sort_unstable();
    times.get((times.len() * percent / 100).min(times.len().saturating_sub(1))).copied().unwrap_or(0)
}
