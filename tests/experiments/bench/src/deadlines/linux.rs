//! The same calls between two m_units on this machine, over loopback and in real time.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, ensure};
use cara_core::config::{Constraints, Scheduling};
use cara_processes::{discovery_port, random_fleet};
use cara_std::control::Control;
use cara_std::{
    Capacities, CommunicationSystem, Interfaces, Parameters, ParametersView, Peer, RequestOptions, Served, ServiceError,
};

use super::{Call, LOADS, Share, Tally};

/// All times are so many times those in the simulator: beside them, what a busy machine adds to each is small.
const SLOWER: u64 = 5;
/// Calls of a point.
const CALLS: u64 = 1_000;
/// How long the two may take to meet, and the last calls to end.
const PATIENCE: Duration = Duration::from_secs(60);

/// Every load in each order. The orders of a load run side by side, so that what else the machine does meets all of them alike.
pub(crate) fn measure() -> Result<Vec<Share>> {
    let mut shares = Vec::new();
    for load in LOADS {
        eprintln!("{load} % load");
        let ended = thread::scope(|scope| {
            let running = Scheduling::ALL.map(|scheduling| scope.spawn(move || share(scheduling, load, CALLS)));
            running.map(|thread| thread.join().map_err(|_| anyhow!("a thread panicked"))?)
        });
        for share in ended {
            shares.push(share?);
        }
    }
    shares.sort_by_key(|share| {
        (Scheduling::ALL.iter().position(|scheduling| *scheduling == share.scheduling), share.load)
    });
    Ok(shares)
}

/// Two m_units of which one runs one call of the other at a time.
struct Pair {
    _main: CommunicationSystem,
    _passive: CommunicationSystem,
    peer: Peer,
    /// Microseconds that runs took, beside those that they were to take.
    ran: Arc<[AtomicU64; 2]>,
}

impl Pair {
    fn start(scheduling: Scheduling) -> Result<Self> {
        let (fleet, port) = (random_fleet(), discovery_port());
        let unit = |name, id| -> Result<_> {
            let constraints = Constraints { scheduling, ..Constraints::M_UNIT };
            let capacities = Capacities { calls_running: 1, ..Capacities::default() };
            let builder = CommunicationSystem::builder(name, id)?.fleet(fleet).discovery_port(port);
            let builder = builder.interfaces(Interfaces::Loopback).insecure().control(Control::Off);
            Ok(builder.constraints(constraints).capacities(capacities).build()?)
        };
        let (main, passive) = (unit("main", 2)?, unit("passive", 1)?);
        let ran = Arc::<[AtomicU64; 2]>::default();
        let counted = ran.clone();
        let work = move |_: &Served, parameters: &mut ParametersView| -> Result<(), ServiceError> {
            let takes: i64 = parameters.variable("takes")?;
            let start = Instant::now();
            thread::sleep(Duration::from_micros(takes as u64));
            counted[0].fetch_add(start.elapsed().as_micros() as u64, Ordering::Relaxed);
            counted[1].fetch_add(takes as u64, Ordering::Relaxed);
            Ok(())
        };
        passive.my_function_list().add_function("work", &takes(0)?, work)?;
        passive.publish_my_function_list()?;
        passive.start()?;
        main.start()?;
        let end = Instant::now() + PATIENCE;
        let known = || main.m_units().into_iter().find(|peer| peer.their_function_list().contains("work"));
        let peer = loop {
            if let Some(peer) = known() {
                break peer;
            }
            ensure!(Instant::now() < end, "they did not meet");
            thread::sleep(Duration::from_millis(5));
        };
        Ok(Self { _main: main, _passive: passive, peer, ran })
    }

    /// Whether the call ended in time.
    fn call(&self, call: &Call) -> bool {
        let timeout = Some(cara_core::time::Duration::from_millis(call.timeout_ms() * SLOWER));
        let options = RequestOptions { timeout, ..RequestOptions::default() };
        let parameters = takes(call.takes * SLOWER);
        parameters.is_ok_and(|mut parameters| self.peer.call("work", &mut parameters).with(options).wait().is_ok())
    }
}

fn takes(micros: u64) -> Result<Parameters> {
    let mut parameters = Parameters::new();
    parameters.add_int("takes", 1)?;
    parameters.set_value("takes", i64::try_from(micros)?)?;
    Ok(parameters)
}

fn share(scheduling: Scheduling, load: u64, count: u64) -> Result<Share> {
    let pair = Pair::start(scheduling)?;
    let tally = Tally::default();
    let start = Instant::now();
    thread::scope(|scope| {
        for call in Call::at(load).take(count as usize) {
            thread::sleep((start + Duration::from_micros(call.due * SLOWER)).saturating_duration_since(Instant::now()));
            let (pair, tally) = (&pair, &tally);
            scope.spawn(move || tally.ended(call.which, pair.call(&call)));
        }
    });
    let [ran, asked] = [0, 1].map(|which| pair.ran[which].load(Ordering::Relaxed) as f64);
    Ok(Share { run_time: ran / asked.max(1.0), ..tally.share(scheduling, load, count).context("calls are missing")? })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each call of a unit that has next to nothing to do ends in time, which takes a second.
    #[test]
    fn calls_reach_a_unit_on_this_machine() {
        let share = share(Scheduling::Fifo, 50, 10).unwrap();
        assert!(share.met > 0.0 && share.run_time >= 1.0, "{}", share.met);
    }
}
