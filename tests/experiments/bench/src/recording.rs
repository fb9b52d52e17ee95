//! What a recording costs the round trip of a call: blocks of three managers in turn, of which the third is recorded.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_bench_ends::{Caller, Peer, Place};
use cara_recording::{Limits, Recorder};
use cara_std::CommunicationSystem;
use cara_std::control::execute;
use cara_std::control::protocol::Question;

use crate::peers::cara::Cara;
use crate::statistics::{percentile, quartile};

const MANAGERS: [&str; 3] = ["not recorded", "not recorded again", "recorded"];
const TURNS: usize = 60;
const CALLS: usize = 200;
const TEXT: &str =
    "A hundred characters, as in the first column of the tables of round trips, go there and come back. ..";
/// How long the recorder may take to write what has come.
const LAST: Duration = Duration::from_secs(10);

/// Prints the median round trip of each, and its ratio to that of the first in the same turn, without a pause between calls and with.
pub(crate) fn measure() -> Result<()> {
    let place = Place { run: fastrand::u32(1..), print: false, client: 0 };
    let server = Cara::LinkEach.start_server(&place)?;
    let folder = tempfile::tempdir()?;
    let (mut callers, mut recorder) = (Vec::new(), None);
    for id in 2..2 + MANAGERS.len() as u32 {
        let (system, caller) = Cara::LinkEach.manager(&place, &server.address, id)?;
        if callers.len() + 1 == MANAGERS.len() {
            recorder = Some(record(system, &folder.path().join("a.mcap"))?);
        }
        callers.push(caller);
    }
    for pause in [Duration::ZERO, Duration::from_millis(1)] {
        let mut turns = Vec::new();
        for turn in 0..TURNS {
            let medians: Vec<u64> =
                callers.iter_mut().map(|caller| block(&mut **caller, pause)).collect::<Result<_>>()?;
            // Links settle in the first ones.
            turns.extend((turn >= TURNS / 10).then_some(medians));
        }
        println!("{CALLS} calls in a block, {} ms between them:", pause.as_millis());
        for (index, name) in MANAGERS.iter().enumerate() {
            let of = |figure: fn(u64, u64) -> f64| {
                let figures = turns.iter().map(|medians| figure(medians[index], medians[0])).collect();
                quartile(figures, 2)
            };
            let (us, ratio) = (of(|own, _| own as f64 / 1e3), of(|own, first| own as f64 / first as f64));
            println!("  {name:<20} {us:7.1} us  {ratio:.3}");
        }
    }
    let (recorder, followed) = recorder.context("the last manager is recorded")?;
    let (all, end) = (2 * TURNS * CALLS, Instant::now() + LAST);
    while followed.load(Ordering::Relaxed) <= all && Instant::now() < end {
        std::thread::sleep(Duration::from_millis(1));
    }
    let outcome = recorder.end(LAST);
    println!("{} messages recorded, {} lost", outcome.messages, outcome.lost);
    ensure!(outcome.messages >= all as u64, "not every call is recorded");
    Ok(())
}

/// Records what the manager's program calls from here on, and counts it: the first is that it is followed.
fn record(system: CommunicationSystem, file: &Path) -> Result<(Recorder, Arc<AtomicUsize>)> {
    let recorder = Recorder::start(file, Limits { size: 64 << 20, keep: 1 }, BTreeMap::new())?;
    let (own, followed) = (recorder.clone(), Arc::<AtomicUsize>::default());
    let counted = followed.clone();
    let follow = move || {
        execute(&system, &Question::Commands, &mut |answer| {
            own.take(&answer);
            counted.fetch_add(1, Ordering::Relaxed);
            ControlFlow::Continue(())
        });
    };
    std::thread::Builder::new().spawn(follow)?;
    while followed.load(Ordering::Relaxed) == 0 {
        std::thread::sleep(Duration::from_millis(1));
    }
    Ok((recorder, followed))
}

/// The median round trip of a block, in nanoseconds.
fn block(caller: &mut dyn Caller, pause: Duration) -> Result<u64> {
    let mut times = Vec::new();
    for _ in 0..CALLS {
        std::thread::sleep(pause);
        let start = Instant::now();
        caller.echo(TEXT)?;
        times.push(start.elapsed().as_nanos() as u64);
    }
    times.sort_unstable();
    Ok(percentile(&times, 50.0))
}
