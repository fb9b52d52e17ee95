//! What a node costs its manager: time to be found, memory, and what the others make of a request to one.

use std::time::Duration;

use anyhow::{Context, Result};

use super::plan::Plan;
use crate::child::Handle;
use crate::nodes::{Question, draw_keys};
use crate::progress::{Progress, is_stopped};
use crate::results::{Mode, Scale, micros, ratio};
use crate::statistics::{percentile, quartile};
use cara_bench_ends::clock;
use cara_bench_ends::{Pin, pin};

/// How long all nodes may take to join.
const WITHIN_S: u64 = 240;
/// How long nothing happens before memory is looked at.
const REST: Duration = Duration::from_millis(500);

/// A manager with its nodes.
struct Fleet {
    nodes: u32,
    mode: Mode,
    manager: Handle,
    _units: Handle,
    _keys: Option<tempfile::TempDir>,
    rss_per_node: i64,
    discovery: f64,
    /// Medians of each turn, in nanoseconds: of calls of one node, and of each in turn.
    one: Vec<u64>,
    each: Vec<u64>,
}

/// Fleets of all numbers of nodes, in plain mode and then with keys.
pub(super) fn measure(plan: &Plan, rows: &mut Vec<Scale>) -> Result<()> {
    [Mode::Plain, Mode::Secured].into_iter().try_for_each(|mode| in_mode(mode, plan, rows))
}

/// All fleets of a mode stand side by side, and make their calls in turns.
fn in_mode(mode: Mode, plan: &Plan, rows: &mut Vec<Scale>) -> Result<()> {
    let bar =
        Progress::new(&format!("nodes on one manager, {}", mode.name()), plan.nodes.len() + plan.scale_rounds as usize);
    let mut fleets = Vec::new();
    let mut failure = Ok(());
    for &nodes in plan.nodes.iter().take_while(|_| !is_stopped()) {
        match Fleet::start(nodes, mode, plan.pin).with_context(|| format!("a manager with {nodes} nodes")) {
            Ok(fleet) => fleets.push(fleet),
            // The smaller ones are measured all the same.
            Err(error) => {
                failure = Err(error);
                break;
            }
        }
        bar.step();
    }
    for _ in (0..plan.scale_rounds).take_while(|_| !is_stopped()) {
        fleets.iter_mut().try_for_each(|fleet| fleet.turn(plan.scale_calls))?;
        bar.step();
    }
    let first = fleets.first();
    rows.extend(fleets.iter().filter_map(|fleet| Some(fleet.row(first?, plan))));
    failure
}

impl Fleet {
    fn start(nodes: u32, mode: Mode, pin: Pin) -> Result<Self> {
        let [manager_cpu, units_cpu] = pin::cpus(pin)?;
        let run = fastrand::u32(1..);
        let keys = (mode == Mode::Secured).then(|| draw_keys(run, nodes)).transpose()?;
        let folder = keys.as_ref().and_then(|keys| keys.path().to_str());
        let run = run.to_string();
        let start = |role: &str, cpu: Option<usize>| {
            let mut arguments = [role, "--run", &run, "--count", &nodes.to_string()].map(String::from).to_vec();
            arguments.extend(cpu.into_iter().flat_map(|cpu| ["--cpu".into(), cpu.to_string()]));
            arguments.extend(folder.into_iter().flat_map(|folder| ["--keys".into(), folder.into()]));
            Handle::start(&arguments)
        };
        let mut manager = start("manager", manager_cpu)?;
        std::thread::sleep(REST);
        let empty: u64 = manager.order(&Question::Resident)?;
        let began = clock::now();
        let units = start("units", units_cpu)?;
        let joined: u64 = manager.order(&Question::Connected { within_s: WITHIN_S })?;
        let () = manager.order(&Question::Exchange)?;
        std::thread::sleep(REST);
        let full: u64 = manager.order(&Question::Resident)?;
        let rss_per_node = (full as i64 - empty as i64) / i64::from(nodes.max(1));
        let discovery = joined.saturating_sub(began) as f64 / 1e9;
        let (one, each) = (Vec::new(), Vec::new());
        Ok(Self { nodes, mode, manager, _units: units, _keys: keys, rss_per_node, discovery, one, each })
    }

    fn turn(&mut self, calls: u32) -> Result<()> {
        for each in [false, true] {
            let mut times: Vec<u64> = self.manager.order(&Question::Block { calls, each })?;
            times.sort_unstable();
            let medians = if each { &mut self.each } else { &mut self.one };
            medians.push(percentile(&times, 50.0));
        }
        Ok(())
    }

    /// `first` has one node.
    fn row(&self, first: &Self, plan: &Plan) -> Scale {
        let middle = |own: &[u64]| micros(quartile(own.iter().map(|nanos| *nanos as f64).collect(), 2) as u64);
        let compared = |own: &[u64]| {
            let ratios = own.iter().zip(&first.one).map(|(own, first)| *own as f64 / (*first).max(1) as f64);
            ratio(quartile(ratios.collect(), 2))
        };
        Scale {
            nodes: self.nodes,
            pin: plan.pin,
            mode: self.mode,
            n: self.one.len() * plan.scale_calls as usize,
            request_us: middle(&self.one),
            request_ratio: compared(&self.one),
            each_us: middle(&self.each),
            each_ratio: compared(&self.each),
            rss_per_node_bytes: self.rss_per_node,
            discovery_s: (self.discovery * 1e3).round() / 1e3,
        }
    }
}
