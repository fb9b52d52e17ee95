//! The image of an RP2040 with a W5500, unchanged, in rp2040js (`tests/rp2040`): the same checks as on the emulated board, in plain
//! mode, and what the motors' pin does, by the chip's own clock.

mod events;
mod wire;

use anyhow::{Context, Result, ensure};
use cara_apps::agv::GO_TO_LEASE;
use cara_processes::Process;
use cara_std::{Error, Renew, RequestOptions};

use crate::board::{Bench, LONG, Who};
use crate::checks::{self, Check};
use crate::keys::Keys;
use crate::manager::{self, Manager, arrives, at, patiently, sets_out};
use crate::{Arguments, run_checks};
pub(crate) use events::Events;
use events::Event;
pub(crate) use wire::Wire;

/// Where the emulator's programs are.
pub(crate) const SCRIPTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../rp2040/");

const CHECKS: [Check; 4] = [
    Check { name: "the motors' pin is on while it drives", run: driving },
    Check { name: "without renewal the pin is off as the lease ends", run: not_renewed },
    Check { name: "a manager freezes: the pin is off as the lease ends", run: frozen },
    Check { name: "a manager is killed: the pin is off at once", run: killed },
];

/// Runs all of it.
pub(crate) fn run(arguments: &Arguments) -> Result<()> {
    let cara = arguments.cara.as_deref();
    let bench = Bench::new(&arguments.image, arguments.logs, Keys::insecure(cara)?)?.rp2040();
    let passed = run_checks(&CHECKS, &bench, arguments)? + run_checks(&checks::RP2040, &bench, arguments)?;
    ensure!(passed > 0, "no check has `{}` in its name", arguments.only);
    println!("{passed} checks of an RP2040 passed");
    Ok(())
}

/// What the motors' interrupt and the way of a frame through controller and tasks take, in µs.
const TICK: u64 = 1_000;
const LEASE: u64 = GO_TO_LEASE.as_micros();

fn driving(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let (_board, events) = bench.watched_board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    sets_out(&agv, [1, 0])?;
    arrives(&agv, [1, 0])?;
    let on = events.motors(0, true)?;
    let off = events.motors(on.line, false)?;
    Ok(format!("for {} ms of the chip's clock", off.since(&on) / 1_000))
}

fn not_renewed(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let (_board, events) = bench.watched_board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    let mut took = Vec::new();
    let mut from = 0;
    for _ in 0..TIMES {
        let once = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
        patiently(|| agv.call("go_to", &mut at([1_000, 0])?).with(once).wait().map_err(Error::from))?;
        let on = events.motors(from, true)?;
        let off = events.motors(on.line, false)?;
        let request = events.last_before(&on, Event::has_payload)?;
        took.push((off.since(&request), off.since(&on)));
        from = off.line;
    }
    Ok(format!("{took:?}"))
}

fn frozen(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let (_board, events) = bench.watched_board(&cable, &Who::agv(17))?;
    let mut manager = driving_manager(bench)?;
    let on = events.motors(0, true)?;
    manager.freeze()?;
    let off = events.motors(on.line, false)?;
    let renewal = events.last_before(&off, Event::has_payload)?;
    let took = off.since(&renewal);
    Ok(format!("{took}"))
}

fn killed(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let (_board, events) = bench.watched_board(&cable, &Who::agv(17))?;
    let mut manager = driving_manager(bench)?;
    let on = events.motors(0, true)?;
    manager.kill()?;
    let off = events.motors(on.line, false)?;
    let closed = events.last_before(&off, |event| event.what.starts_with("to tcp"))?;
    let took = off.since(&closed);
    Ok(format!("{took}"))
}

/// A manager in a process of its own, for which the vehicle drives.
fn driving_manager(bench: &Bench) -> Result<Process> {
    let mut manager = Process::start("manager", &std::env::current_exe()?, manager::command(&bench.keys, None))?;
    manager.expect("driving", LONG).context("it does not drive")?;
    Ok(manager)
}

/// How often a lease ends.
const TIMES: usize = 5;
