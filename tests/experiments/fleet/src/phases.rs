//! The run, phase by phase.

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use crate::Plan;
use crate::child::{Block, Called, Question};
use crate::parent::{Child, Place, broadcasts, counters, sum};
use crate::proc::{self, Memory, ThreadWatch};
use crate::report::{Comparison, Figures, Joining};
use crate::units::TEXT_BYTES;

/// How long a phase may take before the run is given up.
const PATIENCE_MS: u64 = 60_000;
/// Broadcasts are counted for so long after a start: the last of the four questions of a manager is among them.
const COUNTED: Duration = Duration::from_secs(12);
/// Calls of one block.
const CALLS: usize = 400;
/// How long nothing happens before memory is looked at.
const REST: Duration = Duration::from_secs(1);

/// The processes of the fleet that is measured.
struct Fleet {
    manager: Child,
    /// All s_units but the first.
    many: Vec<Child>,
    /// The first one, in a process of its own, as those that it is compared with.
    single: Child,
}

/// The ID number of the s_unit that has a process of its own, and of one that does not.
const SINGLE: u32 = 1;
const AMONG: u32 = 2;

impl Fleet {
    fn all(&mut self) -> impl Iterator<Item = &mut Child> {
        [&mut self.manager, &mut self.single].into_iter().chain(&mut self.many)
    }
}

/// Measures everything.
pub(crate) fn run(plan: &Plan) -> Result<Figures> {
    let nodes = usize::from(plan.nodes);
    let place = &Place::new(u32::from(plan.nodes))?;
    say("starting");
    let [empty, one] = small_manager()?;
    let mut manager = Child::manager(place, plan.nodes)?;
    let threads = ThreadWatch::new(manager.pid);
    let single = Child::units(place, SINGLE, 1)?;
    let began = single.started;
    let many = many(plan, place)?;
    let unit_threads: Vec<_> = many.iter().map(|child| ThreadWatch::new(child.pid)).collect();
    let connected_ms = connected(&mut manager, nodes, began)?;
    let mut fleet = Fleet { manager, many, single };
    let cpu_us = [cpu_us(nodes, [&fleet.manager])?, cpu_us(nodes, fleet.many.iter().chain([&fleet.single]))?];
    let dials = sum(&counters(fleet.all())?, &["Dialled"])? as f64 / nodes as f64;
    say("calling each, and all");
    let exchanged: Called = fleet.manager.ask(&Question::Exchange { chars: TEXT_BYTES as usize })?;
    std::thread::sleep(REST);
    let after = proc::memory(fleet.manager.pid)?;
    let () = fleet.manager.ask(&Question::Trim)?;
    let trimmed = proc::memory(fleet.manager.pid)?;
    let called: Called = fleet.manager.ask(&Question::CallAll)?;
    let runs = fleet.runs()?;
    std::thread::sleep(COUNTED.saturating_sub(began.elapsed()));
    let joining = Joining { all_ms: connected_ms, broadcasts: broadcasts(fleet.all())?, most_in_a_second: None };
    say("comparing the cost of a request");
    let costs = compare(plan, &mut fleet)?;
    let threads_before = threads.most();
    drop(threads);
    say("restarting the manager");
    let (restart, threads_after) = restart(plan, place, fleet)?;
    Ok(Figures {
        nodes,
        joining,
        dials,
        cpu_us,
        exchanged,
        called,
        runs,
        memory: per_node(nodes, empty, after),
        memory_of_others: per_node(nodes - 1, one, after),
        memory_trimmed: per_node(nodes, empty, trimmed),
        manager_threads: threads_before.max(threads_after),
        unit_threads: unit_threads.iter().map(ThreadWatch::most).max().unwrap_or(0),
        costs,
        restart,
    })
}

/// The processes that share all s_units but the first.
fn many(plan: &Plan, place: &Place) -> Result<Vec<Child>> {
    let (count, processes) = (u32::from(plan.nodes) - 1, u32::from(plan.processes.min(plan.nodes - 1)));
    let first = |index| AMONG + count * index / processes;
    (0..processes).map(|index| Child::units(place, first(index), first(index + 1) - first(index))).collect()
}

/// CPU time of these processes for each node.
fn cpu_us<'c>(nodes: usize, children: impl IntoIterator<Item = &'c Child>) -> Result<f64> {
    let times = children.into_iter().map(|child| proc::cpu_time(child.pid)).sum::<Result<Duration>>()?;
    Ok(times.as_secs_f64() * 1e6 / nodes as f64)
}

fn say(what: &str) {
    eprintln!("fleet: {what}");
}

impl Fleet {
    /// Fewest and most runs of `touch` on a node.
    fn runs(&mut self) -> Result<(u32, u32)> {
        let mut runs: (u32, u32) = self.single.ask(&Question::Runs)?;
        for child in &mut self.many {
            let (fewest, most): (u32, u32) = child.ask(&Question::Runs)?;
            runs = (runs.0.min(fewest), runs.1.max(most));
        }
        Ok(runs)
    }
}

/// Milliseconds from `began` until all are connected; they offer their functions then as well.
fn connected(manager: &mut Child, count: usize, began: Instant) -> Result<f64> {
    let (in_time, at): (bool, Instant) = manager.ask_when(&Question::Connected { count, within_ms: PATIENCE_MS })?;
    ensure!(in_time, "not all of {count} nodes were connected after {PATIENCE_MS} ms");
    let in_time: bool = manager.ask(&Question::Offering { count, within_ms: PATIENCE_MS })?;
    ensure!(in_time, "not all of {count} nodes offered their functions after {PATIENCE_MS} ms");
    Ok(at.saturating_duration_since(began).as_secs_f64() * 1e3)
}

/// The memory of a manager's process that has no node, and tables for one only; and when one has come and has been
/// sent what each of the others is sent.
fn small_manager() -> Result<[Memory; 2]> {
    let place = &Place::new(1)?;
    let mut manager = Child::manager(place, 1)?;
    std::thread::sleep(REST);
    let empty = proc::memory(manager.pid)?;
    let _unit = Child::units(place, SINGLE, 1)?;
    connected(&mut manager, 1, Instant::now())?;
    let _: Called = manager.ask(&Question::Exchange { chars: TEXT_BYTES as usize })?;
    std::thread::sleep(REST);
    Ok([empty, proc::memory(manager.pid)?])
}

/// KiB of resident memory and of anonymous memory that each node added.
fn per_node(nodes: usize, empty: Memory, full: Memory) -> [f64; 2] {
    [(empty.resident_kib, full.resident_kib), (empty.anonymous_kib, full.anonymous_kib)]
        .map(|(before, after)| (after as f64 - before as f64) / nodes as f64)
}

/// The cost of a request with one node, with one node again, and with all of them, in turns: on one CPU, where the time
/// is the work of both ends, and on two, where it includes waking the other one.
fn compare(plan: &Plan, fleet: &mut Fleet) -> Result<[Comparison; 2]> {
    let mut alone = Pair::start()?;
    let mut again = Pair::start()?;
    let place = &Place::new(0)?;
    let raw_server = Child::floor("floor-server", place, plan.nodes)?;
    let mut raw = Child::floor("floor-client", place, plan.nodes)?;
    let [first, second] = proc::two_cpus()?;
    let mut both = [Comparison::default(), Comparison::default()];
    for (comparison, other) in both.iter_mut().zip([first, second]) {
        let managers = [&alone.manager, &again.manager, &fleet.manager, &raw].map(|child| (child.pid, first));
        let units = [&alone.unit, &again.unit, &fleet.single, &raw_server].into_iter().chain(&fleet.many);
        let units = units.map(|child| (child.pid, other));
        managers.into_iter().chain(units).try_for_each(|(pid, cpu)| proc::pin(pid, Some(cpu)))?;
        let managers = [&mut alone.manager, &mut again.manager, &mut fleet.manager, &mut raw];
        turns(plan.rounds, comparison, managers)?;
    }
    fleet.many.iter().chain([&fleet.single]).try_for_each(|child| proc::pin(child.pid, None))?;
    Ok(both)
}

fn turns(rounds: u32, comparison: &mut Comparison, callers: [&mut Child; 4]) -> Result<()> {
    let [alone, again, all, raw] = callers;
    let node = |node| Question::Block { node, calls: CALLS };
    // The first turn warms up and does not count.
    for turn in 0..=rounds {
        let one: Block = alone.ask(&node(Some(SINGLE)))?;
        let blocks = [
            again.ask(&node(Some(SINGLE)))?,
            all.ask(&node(Some(SINGLE)))?,
            all.ask(&node(Some(AMONG)))?,
            all.ask(&node(None))?,
        ];
        let raw = [raw.ask(&node(Some(SINGLE)))?, raw.ask(&node(None))?];
        if turn > 0 {
            comparison.add(one, blocks, raw);
        }
    }
    Ok(())
}

/// A manager with one node.
struct Pair {
    manager: Child,
    unit: Child,
}

impl Pair {
    fn start() -> Result<Self> {
        let place = &Place::new(1)?;
        let mut manager = Child::manager(place, 1)?;
        let unit = Child::units(place, SINGLE, 1)?;
        connected(&mut manager, 1, Instant::now())?;
        Ok(Self { manager, unit })
    }
}

/// Kills the manager's process and starts a new one.
fn restart(plan: &Plan, place: &Place, fleet: Fleet) -> Result<(Joining, usize)> {
    let Fleet { manager, mut many, mut single } = fleet;
    let before = broadcasts(many.iter_mut().chain([&mut single]))?;
    let killed = manager.kill()?;
    let mut manager = Child::manager(place, plan.nodes)?;
    let threads = ThreadWatch::new(manager.pid);
    let all_ms = connected(&mut manager, usize::from(plan.nodes), killed)?;
    let (mut last, mut most) = (before, 0);
    loop {
        let total = broadcasts(many.iter_mut().chain([&mut single, &mut manager]))?;
        most = most.max(total.saturating_sub(last));
        last = total;
        if killed.elapsed() >= COUNTED {
            break;
        }
        std::thread::sleep(Duration::from_secs(1));
    }
    let joining = Joining { all_ms, broadcasts: last - before, most_in_a_second: Some(most) };
    Ok((joining, threads.most()))
}
