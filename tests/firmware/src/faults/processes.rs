//! Faults of a vehicle that is a process of Linux: what holds its application's state for ever, and a second manager of its
//! manager's name.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use cara_apps::agv::{GO_TO, GO_TO_LEASE};
use cara_processes::Process;
use cara_std::{Definition, LeaseWatch, ParametersView, Served, ServiceOptions, Unit};
use rustix::time::{ClockId, clock_gettime};

use super::inject::{BUSY, STANDS, pause, tries};
use super::kind::{Bound, Failing, Kind};
use super::{Stop, Target, shared};
use crate::board::{FLEET, LONG, Who};

/// What the vehicle prints, each with the time of the system's clock in microseconds.
pub(super) const ON: &str = "motors on";
pub(super) const OFF: &str = "motors off";
pub(super) const SAFE: &str = "safe hook";
/// What it is told.
const HOLD: &str = "hold";
/// Between two looks of the motors' loop at the lease.
const TICK: Duration = Duration::from_millis(1);
/// In which hook and motors' loop have their turn on a Linux host, beyond what the vehicle's canary was late.
const TURN: Duration = Duration::from_millis(50);
/// In microseconds.
const BOUND: u64 = GO_TO_LEASE.as_micros() + micros(TURN);

/// A vehicle and its managers, each a process.
pub(super) struct Processes;

impl Target for Processes {
    fn name(&self) -> &'static str {
        "Linux processes"
    }

    fn has_own_clock(&self) -> bool {
        false
    }

    fn bound(&self, kind: &Kind) -> Result<Bound> {
        if matches!(kind.failing, Failing::Held | Failing::NoRight) {
            return Ok(Bound { micros: micros(TURN), of: "turn" });
        }
        Ok(Bound { micros: BOUND, of: "lease + turn" })
    }

    fn fail(&self, kind: &Kind, number: u32, dice: &mut fastrand::Rng) -> Result<Stop> {
        let stopped = match kind.failing {
            Failing::StateHeld => state_is_held(dice),
            Failing::Held => shared::held(dice),
            Failing::NoRight => shared::stopped_without_right(dice),
            _ => second_manager(dice),
        };
        let announced = stopped.with_context(|| format!("{}, number {number}", kind.name))?;
        Ok(Stop { announced, renewed: announced, ..Stop::default() })
    }
}

/// A method of the application never gives the state back, and the manager hangs.
fn state_is_held(dice: &mut fastrand::Rng) -> Result<u64> {
    let (mut vehicle, mut manager) = (vehicle()?, manager()?);
    vehicle.expect(ON, LONG)?;
    vehicle.send(HOLD)?;
    vehicle.expect(HOLD, LONG)?;
    pause(dice);
    let fault = now();
    manager.freeze()?;
    stopped(&vehicle, fault, 1, true)
}

/// A second manager does not start beside the first one, starts when the first one hangs, and the first one moves nothing
/// when it goes on.
fn second_manager(dice: &mut fastrand::Rng) -> Result<u64> {
    let (mut vehicle, mut first) = beside_a_second_manager()?;
    pause(dice);
    let fault = now();
    first.freeze()?;
    let took = stopped(&vehicle, fault, 1, true)?;
    let second = manager()?;
    vehicle.expect(ON, LONG)?;
    first.thaw()?;
    std::thread::sleep(STANDS);
    let offs = vehicle.lines().iter().filter(|line| line.text.starts_with(OFF)).count();
    // A busy host may let the second one's lease end; the first one must not be what moves the vehicle then.
    let running = second.seen("driving", LONG).is_ok();
    ensure!(running && offs <= 2, "the first manager came back: {:?}", vehicle.lines());
    Ok(took)
}

/// A vehicle that drives, and its manager, beside which a second one has not started.
fn beside_a_second_manager() -> Result<(Process, Process)> {
    for () in tries() {
        let (mut vehicle, first) = (vehicle()?, manager()?);
        vehicle.expect(ON, LONG)?;
        let ended = manager()?.wait(LONG)?;
        ensure!(!ended.success(), "a second manager ran beside the first one");
        if !vehicle.has(OFF) {
            return Ok((vehicle, first));
        }
    }
    bail!("for {BUSY:?} the vehicle stopped again and again though its manager was there")
}

/// From the fault until both the motors' loop and the safe hook have stopped the vehicle for the `nth` time, in microseconds;
/// where it is `excused`, less what the vehicle's canary was late meanwhile.
pub(super) fn stopped(vehicle: &Process, fault: u64, nth: usize, excused: bool) -> Result<u64> {
    let deadline = std::time::Instant::now() + LONG;
    let at = |what: &str| -> Result<(u64, u64)> {
        let line = loop {
            let line = vehicle.lines().into_iter().filter(|line| line.text.starts_with(what)).nth(nth - 1);
            if let Some(line) = line {
                break line;
            }
            ensure!(std::time::Instant::now() < deadline, "no `{what}` in {:?}", vehicle.lines());
            std::thread::sleep(TICK);
        };
        let mut numbers = line.text.split_whitespace().filter_map(|word| word.parse().ok());
        let missing = || format!("no times in `{}`", line.text);
        Ok((numbers.next().with_context(missing)?, numbers.next().with_context(missing)?))
    };
    let ((motors, motors_late), (hook, hook_late)) = (at(OFF)?, at(SAFE)?);
    let took = |at: u64, late: u64| at.saturating_sub(fault).saturating_sub(if excused { late } else { 0 });
    let (motors, hook) = (took(motors, motors_late), took(hook, hook_late));
    if motors.max(hook) > BOUND {
        println!(
            "motors stood after {motors} us, the hook ran after {hook}; off that the canary's {motors_late} and {hook_late}"
        );
    }
    Ok(motors.max(hook))
}

fn vehicle() -> Result<Process> {
    start("vehicle", &["--image", "none", "vehicle"])
}

fn manager() -> Result<Process> {
    start("manager", &["--image", "none", "manager"])
}

pub(super) fn start(name: &str, arguments: &[&str]) -> Result<Process> {
    Process::start(name, &std::env::current_exe()?, arguments)
}

/// The vehicle's process: drives while its lease is live, and says when its motors go on and off.
pub(crate) fn stand_alone() -> Result<()> {
    let Who { name, id, .. } = Who::agv(17);
    let unit = Unit::builder(&name, id, "depot", 1)?.fleet(FLEET).insecure().build()?;
    let late = Arc::new(AtomicU64::new(0));
    let canary = late.clone();
    let safe = move || println!("{SAFE} {} {}", now(), canary.load(Ordering::Relaxed));
    let go_to = |_: &Served, _: &mut ParametersView| Ok(());
    let functions = unit.my_function_list();
    let lease =
        functions.add_service(&Definition::parse(GO_TO)?, ServiceOptions::new().lease(GO_TO_LEASE, safe), go_to)?;
    unit.publish_my_function_list()?;
    unit.start()?;
    std::thread::spawn(move || motors(&lease, &late));
    for line in std::io::stdin().lines() {
        if line? == HOLD {
            let unit = unit.clone();
            std::thread::spawn(move || unit.with_state(|()| hold()));
        }
    }
    Ok(())
}

fn hold() {
    println!("{HOLD}");
    loop {
        std::thread::park();
    }
}

/// The motors' loop. It is the canary as well: how late its turns came within the last lease, at the worst.
pub(super) fn motors(lease: &LeaseWatch, late: &AtomicU64) {
    let mut on = false;
    let mut worst = (now(), 0);
    loop {
        let before = now();
        std::thread::sleep(TICK);
        let held_up = (now() - before).saturating_sub(micros(TICK));
        if held_up >= worst.1 || now() - worst.0 > GO_TO_LEASE.as_micros() {
            worst = (now(), held_up);
        }
        late.store(worst.1, Ordering::Relaxed);
        if lease.is_live() != on {
            on = !on;
            println!("{} {} {}", if on { ON } else { OFF }, now(), worst.1);
        }
    }
}

/// The system's clock, which is the same in all processes.
pub(super) fn now() -> u64 {
    let time = clock_gettime(ClockId::Boottime);
    time.tv_sec as u64 * 1_000_000 + time.tv_nsec as u64 / 1_000
}

const fn micros(span: Duration) -> u64 {
    span.as_micros() as u64
}
