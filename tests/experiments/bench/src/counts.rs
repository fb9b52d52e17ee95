//! Counts of a blocking round trip that hold its speed where times cannot: what each end asks of the kernel for it.
//!
//! perf counts them without slowing the ends down, which decide by the pace of the calls which thread reads.

use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Child, Command, Stdio};

use anyhow::{Context, Result, anyhow, bail, ensure};
use cara_bench_ends::{Order, Pin, pin};
use rustix::process::{Pid, Signal, kill_process};

use crate::pair::{Pair, Setting};
use crate::peers::{Contender, SECURED};

/// What is counted: its name here, perf's event, and which of them count. Of switches, those of a thread that waits.
const EVENTS: [(&str, &str, Option<&str>); 3] = [
    ("system calls", "raw_syscalls:sys_enter", None),
    ("switches", "sched:sched_switch", Some("prev_state != 0")),
    ("wake-ups", "sched:sched_waking", None),
];
const ENDS: [&str; 2] = ["client", "server"];
/// Both ends know by then that the calls follow each other at once.
const WARM_UP: u32 = 200;
const CALLS: u32 = 2_000;
/// Turns that a cell has to stay within its bounds: what else the machine does only adds.
const TURNS: usize = 12;

/// Calls that are alike, and the most that each of [`EVENTS`] may be of one at each end, in hundredths.
struct Cell {
    peer: &'static str,
    chars: u32,
    pin: Pin,
    most: Counts,
}

type Counts = [u64; EVENTS.len()];

/// An end writes once and reads once for a call, waits once and wakes the other end; on one CPU it finds bytes more often
/// than it waits. Beyond that the clock is put off once a millisecond, which slower calls have more of. Each bound is so low
/// that one more for each call is too many.
const CELLS: [Cell; 8] = [
    Cell { peer: "cara", chars: 100, pin: Pin::Same, most: [240, 115, 115] },
    Cell { peer: "cara", chars: 100, pin: Pin::Split, most: [260, 125, 115] },
    Cell { peer: "cara", chars: 20_000, pin: Pin::Same, most: [240, 115, 115] },
    Cell { peer: "cara", chars: 20_000, pin: Pin::Split, most: [260, 125, 115] },
    Cell { peer: SECURED, chars: 100, pin: Pin::Same, most: [240, 115, 115] },
    Cell { peer: SECURED, chars: 100, pin: Pin::Split, most: [260, 125, 115] },
    Cell { peer: SECURED, chars: 20_000, pin: Pin::Same, most: [260, 115, 115] },
    Cell { peer: SECURED, chars: 20_000, pin: Pin::Split, most: [300, 135, 115] },
];

/// Counts every cell and prints it beside its bounds; an error names what has grown.
pub(crate) fn check() -> Result<()> {
    let mut grown = Vec::new();
    let mut pair: Option<(&str, Pair)> = None;
    for cell @ Cell { peer, chars, pin, most } in &CELLS {
        if pair.as_ref().is_none_or(|(running, _)| running != peer) {
            let setting = Setting { pin: Pin::None, distribution: 1, print: false, wire: None };
            pair = Some((peer, Pair::start(&Contender::Own(peer), setting)?));
        }
        let (_, pair) = pair.as_mut().context("it was started")?;
        for (end, counts) in ENDS.iter().zip(cell.count(pair)?) {
            let counts = EVENTS.iter().zip(counts.iter().zip(most)).map(|((event, ..), (count, most))| {
                let [count, most] = [count, most].map(|hundredths| *hundredths as f64 / 100.0);
                (format!("{count:.2} {event} (at most {most:.2})"), count > most)
            });
            let (counts, has_grown): (Vec<_>, Vec<_>) = counts.unzip();
            let row = format!("{peer}, {chars} characters, {pin} CPU, {end}: {}", counts.join(", "));
            println!("{row}");
            grown.extend(has_grown.contains(&true).then_some(row));
        }
    }
    ensure!(grown.is_empty(), "a round trip takes more: {}", grown.join("; "));
    Ok(())
}

impl Cell {
    /// The least of as many turns as it takes to stay within the bounds, in hundredths.
    fn count(&self, pair: &mut Pair) -> Result<[Counts; ENDS.len()]> {
        for (process, cpu) in pair.processes().into_iter().zip(pin::cpus(self.pin)?) {
            pin::move_to(process, cpu)?;
        }
        let order = Order { chars: self.chars, callers: 1, calls_per_caller: WARM_UP, pause_ms: 0, delay_us: 0 };
        let mut least = [[u64::MAX; EVENTS.len()]; ENDS.len()];
        for _ in 0..TURNS {
            pair.block(&order)?;
            let [client, server] = pair.processes();
            let counters = [Counter::start(client)?, Counter::start(server)?];
            pair.block(&Order { calls_per_caller: CALLS, ..order.clone() })?;
            for (least, counter) in least.iter_mut().zip(counters) {
                let counts = counter.stop()?;
                *least = std::array::from_fn(|event| least[event].min(counts[event] * 100 / u64::from(CALLS)));
            }
            if least.iter().all(|counts| counts.iter().zip(self.most).all(|(count, most)| *count <= most)) {
                break;
            }
        }
        Ok(least)
    }
}

/// perf, which counts in all threads of one process.
struct Counter(Child);

impl Counter {
    /// Returns when it counts.
    fn start(process: u32) -> Result<Self> {
        let mut perf = Command::new("perf");
        perf.args(["stat", "--field-separator=,", "--control=fd:0,1", "--pid", &process.to_string()]);
        for (_, event, filter) in EVENTS {
            perf.args(["--event", event]).args(filter.iter().flat_map(|filter| ["--filter", filter]));
        }
        perf.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut counter = Self(perf.spawn().context("cannot start perf")?);
        let perf = &mut counter.0;
        let (questions, answers) = perf.stdin.as_mut().zip(perf.stdout.as_mut()).context("perf has no pipes")?;
        // One that could not begin has ended, and answers nothing.
        let asked = questions.write_all(b"ping\n");
        let mut answer = String::new();
        BufReader::new(answers).read_line(&mut answer)?;
        if asked.is_err() || answer.trim() != "ack" {
            bail!("perf does not count: {}", counter.report()?.trim());
        }
        Ok(counter)
    }

    /// How often each of [`EVENTS`] has happened.
    fn stop(mut self) -> Result<Counts> {
        kill_process(Pid::from_child(&self.0), Signal::INT)?;
        let report = self.report()?;
        let counts = report.lines().filter_map(|line| line.split(',').next()?.parse().ok()).collect::<Vec<u64>>();
        counts.try_into().map_err(|_| anyhow!("perf says: {report}"))
    }

    /// What it says at its end.
    fn report(&mut self) -> Result<String> {
        let mut report = String::new();
        self.0.stderr.take().context("it has ended")?.read_to_string(&mut report)?;
        self.0.wait()?;
        Ok(report)
    }
}

impl Drop for Counter {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
