//! Streams under load: many vehicles publish several values a second, and a manager, which calls them meanwhile, passes all
//! of them on to two other m_units. The manager is on one host, everything else on another one, and a cable of a given rate
//! is between them: network namespaces with a token bucket at each end.
//!
//! The manager's calls are compared within one run: blocks without values, with values, with values, and without, in turn.
//! What two kinds of blocks differ by when nothing differs, the two halves of those without values tell.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_processes::cable::{Cable, Wire};
use cara_std::{
    Capacities, CommunicationSystem, Constraints, Definition, Parameters, Peer, Priority, Relay, ServiceOptions,
    Stream, Subscription, Threads, Unit,
};
use clap::Args;
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::child::{self, Counters, Question};
use crate::parent::{Child, Place};
use crate::proc;
use crate::units::{MANAGER, name, number};

/// The other m_units.
const READERS: [(&str, u32); 2] = [("zone-1", 2), ("zone-2", 3)];
/// The stream: when the value was made, on the clock that all processes of the machine share, and where the vehicle is.
const POSE: &str = "pose(made: int, position: float[2])";
/// How often a vehicle would grant a value.
const LEAST: Duration = Duration::from_millis(20);
/// A value counts as made before it is published: where the publisher's thread lost the CPU between the two for longer than this,
/// in microseconds, its age is told as less, and the publisher says which those are.
const GAP_US: i64 = 1_000;
/// How often a reader looks at each stream.
const LOOK: Duration = Duration::from_millis(10);
/// Between two calls of a block.
const PAUSE: Duration = Duration::from_millis(4);
/// Longest wait for the fleet to be complete.
const PATIENCE: Duration = Duration::from_secs(30);
/// After values have begun or ended, before calls are counted.
const SETTLE: Duration = Duration::from_secs(1);

/// The load.
#[derive(Args, Clone, Debug)]
pub(crate) struct Plan {
    /// Vehicles.
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=1_000))]
    vehicles: u32,
    /// Values a second of each.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=50))]
    rate: u32,
    /// Million bits a second that the cable carries.
    #[arg(long, default_value_t = 20)]
    mbit: u32,
    /// Rounds of four blocks.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Calls of a block.
    #[arg(long, default_value_t = 2_000, value_parser = clap::value_parser!(u32).range(1..))]
    calls: u32,
}

/// A process of it; started by the others.
#[derive(Args)]
pub(crate) struct Part {
    #[arg(long)]
    fleet: u32,
    #[arg(long)]
    port: u16,
    #[arg(long)]
    vehicles: u32,
    #[arg(long)]
    rate: u32,
    /// Which of the other m_units.
    #[arg(long, default_value_t = 0)]
    reader: usize,
}

/// What a reader has seen of ages.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Ages {
    /// Looks at a value.
    looks: u64,
    /// When those values were made whose age was told as less than the true one by more than [`GAP_US`].
    too_young: BTreeSet<i64>,
    /// The age told less the true one, at the least and at the most.
    least_margin_us: i64,
    most_margin_us: i64,
    /// The oldest value that was seen while values came.
    oldest_us: i64,
}

/// Runs it and prints what was found.
pub(crate) fn run(plan: &Plan) -> Result<()> {
    let Plan { vehicles, rate, mbit, rounds, calls } = *plan;
    let cable = Cable::lay(Wire { mbit, loss_percent: 0 })?;
    let place = &Place::new(vehicles)?;
    place.add_m_units(&READERS)?;
    let reported = [vehicles.to_string(), rate.to_string()];
    let load = ["--vehicles", &reported[0], "--rate", &reported[1]];
    let [here, there] = &cable.hosts;
    let mut manager = here.within(|| Child::start("streams-manager", place, &load))?;
    let mut units = there.within(|| Child::start("streams-units", place, &load))?;
    let mut readers = Vec::new();
    for reader in 0..READERS.len() {
        let reader = reader.to_string();
        let which = [&load[..], &["--reader", &reader]].concat();
        readers.push(there.within(|| Child::start("streams-reader", place, &which))?);
    }
    let publish = |units: &mut Child, on: bool| -> Result<()> {
        let () = units.ask(&Question::Publish { on })?;
        std::thread::sleep(SETTLE);
        Ok(())
    };
    publish(&mut units, true)?;
    let began = Instant::now();
    for child in std::iter::once(&mut manager).chain(&mut readers) {
        ensure!(child.ask::<bool>(&Question::Subscribe)?, "not every stream has come within {PATIENCE:?}");
    }
    eprintln!("all {vehicles} streams have come at {} readers after {:?}", 1 + READERS.len(), began.elapsed());
    std::thread::sleep(SETTLE);
    let _: Ages = manager.ask(&Question::Ages)?;
    let before = snapshot(&mut manager, &mut units, &mut readers)?;
    let (mut without, mut with) = ([Vec::new(), Vec::new()], Vec::new());
    let (mut emergencies, mut bytes, mut values_ms) = (Vec::new(), [0; 2], 0);
    for round in 0..rounds {
        for on in [false, true, true, false] {
            publish(&mut units, on)?;
            let (wire, at): ([u64; 2], _) = (manager.ask(&Question::Wire)?, Instant::now());
            let times: Vec<u64> = manager.ask(&Question::Calls { function: "touch".into(), calls })?;
            if on {
                with.extend(times);
                emergencies
                    .extend(manager.ask::<Vec<u64>>(&Question::Calls { function: "halt".into(), calls: calls / 10 })?);
                let wire_after: [u64; 2] = manager.ask(&Question::Wire)?;
                (0..2).for_each(|way| bytes[way] += wire_after[way] - wire[way]);
                values_ms += at.elapsed().as_millis() as u64;
            } else {
                without[round as usize % 2].extend(times);
            }
        }
    }
    let after = snapshot(&mut manager, &mut units, &mut readers)?;
    let mut ages = Vec::new();
    for child in std::iter::once(&mut manager).chain(&mut readers) {
        ages.push(child.ask::<Ages>(&Question::Ages)?);
    }
    let late: BTreeSet<i64> = units.ask(&Question::Ages)?;
    println!(
        "{vehicles} vehicles, {rate} values a second each, 3 readers, {mbit} Mbit/s, {rounds} rounds of {calls} calls a block\n"
    );
    println!("| calls of the manager | count | p50 µs | p99 µs | longest µs |\n|---|---|---|---|---|");
    let [first, second] = &without;
    let all = [first.as_slice(), second].concat();
    for (what, times) in [
        ("without values", &all),
        ("without values, even rounds", first),
        ("without values, odd rounds", second),
        ("with values", &with),
        ("emergency, with values", &emergencies),
    ] {
        if !times.is_empty() {
            let [median, most, longest] = [50, 99, 100].map(|percent| percentile(times, percent));
            println!("| {what} | {} | {median} | {most} | {longest} |", times.len());
        }
    }
    println!(
        "\n| process | memory at the start KiB | at the end | values sent | received | overwritten | unknown |\n|---|---|---|---|---|---|---|"
    );
    for ((what, memory, counts), (_, memory_after, counts_after)) in before.iter().zip(&after) {
        let count = |name: &str| counts_after.get(name).unwrap_or(&0) - counts.get(name).unwrap_or(&0);
        let [sent, received, replaced, dropped] =
            ["SamplesSent", "SamplesReceived", "SamplesReplaced", "SamplesDropped"].map(count);
        println!("| {what} | {memory} | {memory_after} | {sent} | {received} | {replaced} | {dropped} |");
    }
    println!(
        "\n| reader | looks | too young | age told less true age µs, least | most | oldest value µs, pauses included |\n|---|---|---|---|---|---|"
    );
    for (who, Ages { looks, too_young, least_margin_us, most_margin_us, oldest_us }) in
        ["manager", "zone-1", "zone-2"].iter().zip(&ages)
    {
        let too_young = too_young.difference(&late).count();
        println!("| {who} | {looks} | {too_young} | {least_margin_us} | {most_margin_us} | {oldest_us} |");
    }
    let [to, from] = bytes.map(|bytes| bytes * 1_000 / values_ms.max(1));
    println!("\nOn the cable while values came: {from} bytes a second to the manager, {to} from it.");
    let sum = |times: &[u64]| percentile(times, 99) as i64;
    let excess = sum(&with) - sum(&all);
    println!(
        "p99 of calls with values above that without: {excess} µs (goal: 2,000); emergency, longest: {} µs (goal: 50,000).",
        percentile(&emergencies, 100)
    );
    let never = |ages: &Ages| ages.looks > 0 && ages.too_young.is_subset(&late);
    ensure!(ages.iter().all(never), "a value was told too young");
    Ok(())
}

type Snapshot = (String, u64, Counters);

fn snapshot(manager: &mut Child, units: &mut Child, readers: &mut [Child]) -> Result<Vec<Snapshot>> {
    let mut all = Vec::new();
    let named = ["manager", "vehicles", "zone-1", "zone-2"].into_iter();
    for (what, child) in named.zip([manager, units].into_iter().chain(readers)) {
        all.push((what.to_owned(), proc::memory(child.pid)?.resident_kib, child.counters()?));
    }
    Ok(all)
}

/// Of times in microseconds.
fn percentile(times: &[u64], percent: usize) -> u64 {
    let mut times = times.to_vec();
    times.sort_unstable();
    let index = (times.len() * percent / 100).min(times.len().saturating_sub(1));
    times.get(index).copied().unwrap_or(0)
}

/// Microseconds on the clock that all processes share.
fn clock() -> i64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec * 1_000_000 + now.tv_nsec / 1_000
}

/// The vehicles' process.
pub(crate) fn units(part: &Part) -> Result<()> {
    let threads = Threads::new()?;
    let mut streams = Vec::new();
    let mut units = Vec::new();
    for id in 1..=part.vehicles {
        let builder = Unit::builder(&name(id), id, MANAGER.0, MANAGER.1)?;
        let unit = builder.fleet(part.fleet).discovery_port(part.port).threads(&threads).build()?;
        let functions = unit.my_function_list();
        functions.add_function("touch", &number()?, |parameters: Parameters| parameters)?;
        let halts = ServiceOptions::new().idempotent().priority(Priority::Emergency);
        functions.add_service(&Definition::parse("halt()")?, halts, |_: &cara_std::Served, _: &mut _| Ok(()))?;
        streams.push(functions.add_stream(&Definition::stream(POSE)?, LEAST)?);
        unit.publish_my_function_list()?;
        unit.start()?;
        units.push(unit);
    }
    let on = Arc::new(AtomicBool::new(false));
    let (publishes, rate) = (on.clone(), part.rate);
    let late = Arc::new(Mutex::new(BTreeSet::new()));
    let recorded = late.clone();
    std::thread::spawn(move || publish(&streams, rate, &publishes, &recorded));
    child::serve(|question| {
        Ok(match question {
            Question::Publish { on: wanted } => {
                on.store(wanted, Ordering::Relaxed);
                json!(null)
            }
            Question::Ages => json!(*held(&late)),
            Question::Counters => json!(sums(units.iter().flat_map(Unit::counters))),
            question => anyhow::bail!("vehicles do not answer {question:?}"),
        })
    })
}

/// Each vehicle at its own time of the period, as vehicles are.
fn publish(streams: &[Stream], rate: u32, on: &AtomicBool, late: &Mutex<BTreeSet<i64>>) -> Result<()> {
    let mut values = Parameters::new();
    values.add_int("made", 1)?;
    values.add_float("position", 2)?;
    let step = Duration::from_secs(1) / rate / streams.len() as u32;
    let mut next = Instant::now();
    for (turn, stream) in streams.iter().cycle().enumerate() {
        next += step;
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
        if on.load(Ordering::Relaxed) {
            values.set_value("position", [turn as f64, 0.5])?;
            let made = clock();
            values.set_value("made", made)?;
            stream.publish(&values)?;
            if clock() - made > GAP_US {
                held(late).insert(made);
            }
        }
    }
    Ok(())
}

fn sums(counts: impl Iterator<Item = (&'static str, u64)>) -> Counters {
    let mut sum = Counters::new();
    counts.for_each(|(name, count)| *sum.entry(name.to_owned()).or_default() += count);
    sum
}

/// What a reading process shares with the thread that looks at its values.
#[derive(Default)]
struct Reading {
    subscriptions: Mutex<Vec<Subscription>>,
    ages: Mutex<Ages>,
    /// Subscriptions whose value has been seen.
    seen: AtomicU64,
}

fn held<V>(lock: &Mutex<V>) -> std::sync::MutexGuard<'_, V> {
    lock.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Reading {
    /// Looks at every stream again and again.
    fn look(&self) {
        loop {
            std::thread::sleep(LOOK);
            let mut seen = 0;
            let mut found = Vec::new();
            for subscription in held(&self.subscriptions).iter() {
                // Before the look: the value is at least so old when its age is told.
                let now = clock();
                let Some(sample) = subscription.latest() else { continue };
                let Ok(made) = sample.value::<i64>("made") else { continue };
                seen += 1;
                found.push((made, now - made, sample.age().as_micros() as i64));
            }
            let ages = &mut *held(&self.ages);
            for (made, truth, reported) in found {
                let margin = reported - truth;
                if margin < -GAP_US {
                    ages.too_young.insert(made);
                }
                let is_first = ages.looks == 0;
                ages.looks += 1;
                ages.least_margin_us = if is_first { margin } else { ages.least_margin_us.min(margin) };
                ages.most_margin_us = ages.most_margin_us.max(margin);
                ages.oldest_us = ages.oldest_us.max(truth);
            }
            self.seen.store(seen, Ordering::Relaxed);
        }
    }

    /// Subscribes to a stream of each node that `find` finds, and waits until a value of each has come.
    fn subscribe(&self, vehicles: u32, mut find: impl FnMut(u32) -> Option<Subscription>) -> bool {
        let end = Instant::now() + PATIENCE;
        for id in 1..=vehicles {
            let subscription = loop {
                if let Some(subscription) = find(id) {
                    break subscription;
                }
                if Instant::now() >= end {
                    eprintln!("{} has no stream here", name(id));
                    return false;
                }
                std::thread::sleep(LOOK);
            };
            held(&self.subscriptions).push(subscription);
        }
        while self.seen.load(Ordering::Relaxed) < u64::from(vehicles) {
            if Instant::now() >= end {
                eprintln!("{} of {vehicles} streams have brought a value", self.seen.load(Ordering::Relaxed));
                return false;
            }
            std::thread::sleep(LOOK);
        }
        true
    }
}

fn started(part: &Part, who: (&str, u32)) -> Result<CommunicationSystem> {
    let nodes = u16::try_from(part.vehicles)?.saturating_add(8);
    let constraints = Constraints { maximum_nodes: nodes, ..Constraints::M_UNIT };
    // A stream that is passed on is a function: of the manager's list, and of what its readers keep of it.
    let functions = usize::from(nodes);
    let capacities = Capacities {
        functions,
        signature_bytes: functions * 64,
        their_functions: functions,
        their_signature_bytes: functions * 64,
        ..Capacities::default()
    };
    let builder = CommunicationSystem::builder(who.0, who.1)?.constraints(constraints).capacities(capacities);
    let system = builder.fleet(part.fleet).discovery_port(part.port).build()?;
    system.start()?;
    system.broadcast();
    Ok(system)
}

fn looking() -> Arc<Reading> {
    let reading = Arc::new(Reading::default());
    let looks = reading.clone();
    std::thread::spawn(move || looks.look());
    reading
}

/// The manager's process: it reads all streams, passes them on, and calls.
pub(crate) fn manager(part: &Part) -> Result<()> {
    let system = started(part, MANAGER)?;
    let reading = looking();
    let mut relays: Vec<Relay> = Vec::new();
    child::serve(|question| {
        Ok(match question {
            Question::Subscribe => {
                let find = |id| {
                    let peer = system.s_unit(&name(id)).ok()?;
                    let subscription = peer.stream("pose").ok()?.subscribe(LEAST);
                    let relay = system.relay_stream(&name(id), "pose", LEAST);
                    relays.push(relay.inspect_err(|error| eprintln!("{}: {error}", name(id))).ok()?);
                    Some(subscription)
                };
                let have_come = reading.subscribe(part.vehicles, find);
                system.publish_my_function_list()?;
                json!(have_come)
            }
            Question::Calls { function, calls } => json!(call(&system, &function, calls)?),
            Question::Ages => json!(std::mem::take(&mut *held(&reading.ages))),
            Question::Wire => json!(wire()?),
            Question::Counters => json!(sums(system.counters().into_iter())),
            question => anyhow::bail!("the manager does not answer {question:?}"),
        })
    })
}

/// Another m_unit's process: it reads what the manager passes on.
pub(crate) fn reader(part: &Part) -> Result<()> {
    let who = READERS.get(part.reader).context("there is no such reader")?;
    let system = started(part, *who)?;
    let reading = looking();
    child::serve(|question| {
        Ok(match question {
            Question::Subscribe => {
                let find = |id| {
                    let stream = system.m_unit(MANAGER.0).ok()?.stream(&format!("{}/pose", name(id))).ok()?;
                    Some(stream.subscribe(LEAST))
                };
                json!(reading.subscribe(part.vehicles, find))
            }
            Question::Ages => json!(std::mem::take(&mut *held(&reading.ages))),
            Question::Counters => json!(sums(system.counters().into_iter())),
            question => anyhow::bail!("a reader does not answer {question:?}"),
        })
    })
}

/// Calls the vehicles in turn; how long each call took, in microseconds. A call that fails ends it.
fn call(system: &CommunicationSystem, function: &str, calls: u32) -> Result<Vec<u64>> {
    let peers: Vec<Peer> = system.s_units().into_iter().filter(Peer::is_connected).collect();
    let mut number = number()?;
    let mut times = Vec::new();
    for peer in peers.iter().cycle().take(calls as usize) {
        std::thread::sleep(PAUSE);
        let began = Instant::now();
        peer.call(function, &mut number).wait().with_context(|| format!("{peer:?}: {function}"))?;
        times.push(began.elapsed().as_micros() as u64);
    }
    Ok(times)
}

/// Bytes that have left this host and that have come to it.
fn wire() -> Result<[u64; 2]> {
    let devices = std::fs::read_to_string("/proc/thread-self/net/dev")?;
    let line = devices.lines().find_map(|line| line.trim().strip_prefix("wire:")).context("there is no cable")?;
    let counts: Vec<u64> = line.split_whitespace().filter_map(|count| count.parse().ok()).collect();
    Ok([*counts.get(8).context("no bytes sent")?, *counts.first().context("no bytes received")?])
}
