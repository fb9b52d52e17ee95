//! The image of an RP2040 with a W5500, unchanged, in rp2040js (`tests/rp2040`): checks of the emulated board, and what the motors' pin does, by the chip's own clock.

mod events;
mod wire;

use std::process::Command;

use anyhow::{Context, Result, ensure};
use cara_apps::agv::GO_TO_LEASE;
use cara_processes::Process;
use cara_std::{Error, Renew, RequestOptions};

use crate::board::{Bench, LONG, Who};
use crate::checks::restarts::works;
use crate::checks::{self, Check};
use crate::manager::{self, Manager, at, drives, patiently, sets_out};
use crate::{Arguments, run_checks};
use events::Event;
pub(crate) use events::Events;
pub(crate) use wire::Wire;

/// Where the emulator's programs are.
pub(crate) const SCRIPTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../rp2040/");

const CHECKS: [Check; 5] = [
    Check { name: "the motors' pin is on while it drives", run: driving },
    Check { name: "without renewal the pin is off as the lease ends", run: not_renewed },
    Check { name: "a manager freezes: the pin is off as the lease ends", run: frozen },
    Check { name: "a manager is killed: the pin is off at once", run: killed },
    Check { name: "its button calls the manager's mechanic", run: button },
];

/// What a board does with flash, where it has keys.
const SECURED: [Check; 2] = [
    Check { name: "power is cut while it stores a claim", run: claims },
    Check { name: "no cut of power in flash repeats a count of starts", run: starts },
];

/// Runs all of it.
pub(crate) fn run(arguments: &Arguments) -> Result<()> {
    let bench = crate::bench(arguments)?;
    let others: [&[Check]; 2] =
        if arguments.insecure { [&checks::RP2040, &[]] } else { [&checks::RP2040_SECURED, &SECURED] };
    let mut passed = run_checks(&CHECKS, &bench, arguments)?;
    for checks in others {
        passed += run_checks(checks, &bench, arguments)?;
    }
    ensure!(passed > 0, "no check has `{}` in its name", arguments.only);
    println!("{passed} checks of an RP2040 passed");
    Ok(())
}

// All of these are times of the chip's clock, in µs.
const LEASE: u64 = GO_TO_LEASE.as_micros();
/// The period of the motors' interrupt.
const TICK: u64 = 1_000;
/// In which a frame gets from the controller to the unit.
const READ: u64 = 1_000;
/// The longest turn of the executor.
const POLL: u64 = 20_000;
/// How often a lease ends in a check.
const TIMES: usize = 20;

fn driving(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let (board, events) = bench.watched_board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    ensure!(events.count_of_motors() <= 1, "the pin changes before it is sent anywhere");
    drives(&board, [1, 0], || sets_out(&agv, [1, 0]))?;
    let on = events.motors(0, true)?;
    let off = events.motors(on.line, false)?;
    Ok(format!("for {} ms of the chip's clock", off.since(&on) / 1_000))
}

fn not_renewed(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let (_board, events) = bench.watched_board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    let mut ends = Vec::new();
    let mut from = 0;
    for _ in 0..TIMES {
        let once = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
        patiently(|| agv.call("go_to", &mut at([1_000, 0])?).with(once).wait().map_err(Error::from))?;
        let on = events.motors(from, true)?;
        let off = events.motors(on.line, false)?;
        let request = events.last_before(&on, Event::has_payload)?;
        ends.push(lease_ended(&request, &off)?);
        from = off.line;
    }
    ends.sort_unstable();
    let (first, last) = (ends[0], ends[TIMES - 1]);
    Ok(format!("{TIMES} times, {first} to {last} us behind the request"))
}

fn frozen(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let (_board, events) = bench.watched_board(&cable, &Who::agv(17))?;
    let mut manager = driving_manager(bench)?;
    let on = events.motors(0, true)?;
    manager.freeze()?;
    let off = events.motors(on.line, false)?;
    let renewal = events.last_before(&off, Event::has_payload)?;
    Ok(format!("{} us behind the last renewal", lease_ended(&renewal, &off)?))
}

/// How long the motors were on behind the last message that renewed their lease. That may have been on its way for a while, which
/// counts.
fn lease_ended(renewal: &Event, off: &Event) -> Result<u64> {
    let took = off.since(renewal);
    ensure!(
        (LEASE / 2..=LEASE + READ + TICK).contains(&took),
        "the motors go off {took} us behind {renewal:?}, in place of {LEASE}"
    );
    Ok(took)
}

fn killed(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let (_board, events) = bench.watched_board(&cable, &Who::agv(17))?;
    let mut manager = driving_manager(bench)?;
    let on = events.motors(0, true)?;
    manager.kill()?;
    let off = events.motors(on.line, false)?;
    let closed = events.last_before(&off, Event::is_segment)?;
    let took = off.since(&closed);
    ensure!(took <= READ + POLL + TICK, "the motors go off {took} us behind the end of the connection");
    Ok(format!("{took} us behind the end of the connection"))
}

/// A manager in a process of its own, for which the vehicle drives.
fn driving_manager(bench: &Bench) -> Result<Process> {
    let mut manager = Process::start("manager", &std::env::current_exe()?, manager::command(&bench.keys, None))?;
    manager.expect("driving", LONG).context("it does not drive")?;
    Ok(manager)
}

fn button(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let board = bench.board(&cable, &Who::agv(17))?;
    manager.meet(&Who::agv(17))?;
    manager.offer_mechanic()?;
    ensure!(board.last_with("a mechanic comes").is_none(), "it calls without its button");
    board.press()?;
    board.logs("a mechanic comes in 5 minutes")?;
    Ok("pressed once".into())
}

/// A claim is stored before the first moving call under it. Wherever power is cut then, nothing has moved, and the next life serves.
fn claims(bench: &Bench, _: u32) -> Result<String> {
    for phase in ["before", "within", "after"] {
        let cable = bench.cable()?;
        let who = Who::agv(17);
        let manager = Manager::start(&bench.keys)?;
        let (board, events) = bench.board_that_loses_power(&cable, &who, phase)?;
        let agv = manager.meet(&who)?;
        // Until one comes in time on a busy host; the link ends with the board.
        let mut place = at([1, 0])?;
        board.loses_power(|| drop(agv.call("go_to", &mut place).wait())).context(phase)?;
        ensure!(events.count_of_motors() <= 1, "power is cut {phase}, and it has moved");
        let board = bench.board(&cable, &who)?;
        works(&manager, &board, &who).context(phase)?;
    }
    Ok("before, within and after".into())
}

/// The image counts its starts where it has keys.
fn starts(bench: &Bench, _: u32) -> Result<String> {
    let keys = bench.keys.others()?;
    let (settings, _) = keys.reported("rp2040", &Who::agv(17), "10.77.0.100/24")?;
    let mut node = Command::new("node");
    node.arg(SCRIPTS.to_owned() + "starts.mjs").arg(bench.image().with_extension("uf2")).arg(settings);
    let output = node.output().context("cannot start node")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
}
