//! One block: a number of callers that start together and make their calls, each call timed.

use std::sync::Barrier;
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};

use crate::clock::cpu_time;
use crate::peer::{Caller, Peer, Place};

/// Calls of each caller before those that count, as far apart as those up to [`WARM_UP_PAUSE`].
const WARM_UP: u32 = 3;
const WARM_UP_PAUSE: Duration = Duration::from_millis(100);

/// Callers that connect together: units that look for each other wait, and many that look at once hold each other up.
const AT_A_TIME: usize = 8;

/// What a client process is told to do.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Order {
    /// Length of the text.
    pub chars: u32,
    /// Concurrent callers.
    pub callers: u32,
    /// Calls of each that are timed.
    pub calls_per_caller: u32,
    /// From a reply to the next request.
    pub pause_ms: u64,
    /// Wait before the first call, so that several peers that pause can take turns.
    pub delay_us: u64,
}

/// What came of it.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Outcome {
    /// Of each call, in nanoseconds.
    pub round_trips: Vec<u64>,
    /// From the common start to the last answer, in nanoseconds.
    pub elapsed: u64,
    /// Time of all CPUs that this process used, in nanoseconds, for this many calls: those before the start count, too.
    pub cpu: u64,
    /// The calls of `cpu`.
    pub cpu_calls: u64,
}

/// The callers of a client process; those once connected stay so from block to block.
pub struct Callers<'a> {
    peer: &'a dyn Peer,
    place: &'a Place,
    address: &'a str,
    connected: Vec<Box<dyn Caller>>,
}

impl<'a> Callers<'a> {
    /// None is connected yet.
    pub fn new(peer: &'a dyn Peer, place: &'a Place, address: &'a str) -> Self {
        Self { peer, place, address, connected: Vec::new() }
    }

    /// The first caller.
    pub fn first(&mut self) -> Result<&mut dyn Caller> {
        self.connect(1)?;
        Ok(&mut **self.connected.first_mut().context("no callers")?)
    }

    fn connect(&mut self, wanted: usize) -> Result<()> {
        let (peer, place, address) = (self.peer, self.place, self.address);
        while self.connected.len() < wanted {
            let missing = (wanted - self.connected.len()).min(AT_A_TIME);
            let fresh: Vec<Result<_>> = thread::scope(|scope| {
                let threads: Vec<_> = (0..missing).map(|_| scope.spawn(|| peer.connect(place, address))).collect();
                threads.into_iter().map(|thread| thread.join().expect("connecting does not panic")).collect()
            });
            for caller in fresh {
                self.connected.push(caller.context("connecting")?);
            }
        }
        Ok(())
    }

    /// Makes the calls of one block.
    pub fn run(&mut self, order: &Order) -> Result<Outcome> {
        let wanted = order.callers as usize;
        self.connect(wanted)?;
        let text = text(order.chars);
        let barrier = Barrier::new(wanted);
        let used = cpu_time();
        let (barrier, text) = (&barrier, text.as_str());
        let timed: Vec<Result<Timed>> = thread::scope(|scope| {
            let callers = self.connected.iter_mut().take(wanted);
            let threads: Vec<_> =
                callers.map(|caller| scope.spawn(move || make_calls(&mut **caller, order, text, barrier))).collect();
            threads.into_iter().map(|thread| thread.join().expect("a caller does not panic")).collect()
        });
        let cpu = cpu_time().saturating_sub(used);
        let timed = timed.into_iter().collect::<Result<Vec<_>>>()?;
        let start = timed.iter().map(|timed| timed.start).min().context("no callers")?;
        let end = timed.iter().map(|timed| timed.end).max().context("no callers")?;
        let round_trips = timed.into_iter().flat_map(|timed| timed.round_trips).collect();
        let cpu_calls = u64::from(order.callers) * u64::from(WARM_UP + order.calls_per_caller);
        Ok(Outcome { round_trips, elapsed: nanoseconds(end - start), cpu, cpu_calls })
    }
}

/// What is sent: so many characters of one byte each.
pub fn text(chars: u32) -> String {
    ('a'..='z').cycle().take(chars as usize).collect()
}

struct Timed {
    start: Instant,
    end: Instant,
    round_trips: Vec<u64>,
}

fn make_calls(caller: &mut dyn Caller, order: &Order, text: &str, barrier: &Barrier) -> Result<Timed> {
    let pause = Duration::from_millis(order.pause_ms);
    let mut failed = None;
    for _ in 0..WARM_UP {
        thread::sleep(pause.min(WARM_UP_PAUSE));
        failed = failed.or(call(caller, text).err());
    }
    let mut round_trips = Vec::with_capacity(order.calls_per_caller as usize);
    // Everyone passes the barrier, even after a failure: the others wait there.
    barrier.wait();
    if let Some(error) = failed {
        return Err(error);
    }
    thread::sleep(Duration::from_micros(order.delay_us));
    let start = Instant::now();
    let mut end = start;
    for _ in 0..order.calls_per_caller {
        if !pause.is_zero() {
            thread::sleep(pause);
            end = Instant::now();
        }
        let before = end;
        call(caller, text)?;
        end = Instant::now();
        round_trips.push(nanoseconds(end - before));
    }
    Ok(Timed { start, end, round_trips })
}

fn call(caller: &mut dyn Caller, text: &str) -> Result<()> {
    let length = caller.echo(text)?;
    ensure!(length == text.len(), "{length} bytes came back of {}", text.len());
    Ok(())
}

fn nanoseconds(span: Duration) -> u64 {
    u64::try_from(span.as_nanos()).unwrap_or(u64::MAX)
}
