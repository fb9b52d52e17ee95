//! A vehicle that is a process of Linux and has two callers: one's call does not disturb the motion of the other, unless it stops
//! it; and that lasts, since neither may reset it.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use anyhow::{Result, bail, ensure};
use cara_apps::agv::{GO_TO, GO_TO_LEASE, RESET, STOP};
use cara_processes::Process;
use cara_std::access::AccessTable;
use cara_std::control::Control;
use cara_std::{
    CommunicationSystem, Definition, Error, Parameters, ParametersView, Peer, Priority, Served, ServiceOptions,
};

use super::inject::{BUSY, STANDS, pause, tries};
use super::processes::{OFF, ON, SAFE, motors, now, start, stopped};
use crate::board::{FLEET, LONG};
use crate::manager::{at, outcome, patiently, sets_out};

const VEHICLE: (&str, u32) = ("crane", 3);
/// Both callers may move and stop it.
const RIGHTS: &str = "\
[[allow]]
who = \"m_units\"
functions = [\"go_to\", \"stop\"]
verbs = [\"list\", \"call\"]
[[allow]]
who = \"m_units\"
functions = [\"reset\"]
verbs = \"list\"
";

/// The second one's call is refused, and the motion goes on until the first one wants it no more.
pub(super) fn held(dice: &mut fastrand::Rng) -> Result<u64> {
    let (vehicle, one, two) = stage()?;
    for () in tries() {
        let (mut seen, one, two) = (lines(&vehicle, OFF), peer(&one)?, peer(&two)?);
        moves(&vehicle, &one)?;
        pause(dice);
        let refused = outcome(|| two.block_request("go_to", &mut at([1, 2])?));
        std::thread::sleep(STANDS);
        if lines(&vehicle, OFF) > seen {
            one.release("go_to")?;
            continue;
        }
        ensure!(refused == Err(Error::Held { by: 1, operator: false }), "the second caller's call came to {refused:?}");
        let fault = now();
        one.release("go_to")?;
        seen += 1;
        return stopped(&vehicle, fault, seen, false);
    }
    bail!("for {BUSY:?} no lease was renewed in time")
}

/// The second one stops it and may not reset it; the first one moves it no more.
pub(super) fn stopped_without_right(dice: &mut fastrand::Rng) -> Result<u64> {
    let (vehicle, one, two) = stage()?;
    let (one, two) = (peer(&one)?, peer(&two)?);
    moves(&vehicle, &one)?;
    pause(dice);
    let fault = now();
    patiently(|| two.block_request("stop", &mut Parameters::new()))?;
    let took = stopped(&vehicle, fault, lines(&vehicle, OFF).max(1), false)?;
    let (refused, ons) = (outcome(|| two.block_request("reset", &mut Parameters::new())), lines(&vehicle, ON));
    ensure!(refused == Err(Error::NotAllowed), "a reset without right came to {refused:?}");
    let moved = outcome(|| one.block_request("go_to", &mut at([1, 2])?));
    ensure!(moved == Err(Error::Inhibited { by: 2, reason: 0 }), "a call behind the stop came to {moved:?}");
    std::thread::sleep(STANDS);
    ensure!(lines(&vehicle, ON) == ons, "it moves again: {:?}", vehicle.lines());
    Ok(took)
}

fn stage() -> Result<(Process, CommunicationSystem, CommunicationSystem)> {
    let vehicle = start("vehicle", &["--image", "none", "vehicle", "--shared"])?;
    Ok((vehicle, caller("one", 1)?, caller("two", 2)?))
}

fn caller(name: &str, id: u32) -> Result<CommunicationSystem> {
    let caller = CommunicationSystem::builder(name, id)?.fleet(FLEET).control(Control::Off).insecure().build()?;
    caller.start()?;
    Ok(caller)
}

fn peer(caller: &CommunicationSystem) -> Result<Peer> {
    let deadline = std::time::Instant::now() + LONG;
    loop {
        if let Some(peer) = caller.nodes_offering("reset").pop() {
            return Ok(peer);
        }
        ensure!(std::time::Instant::now() < deadline, "the vehicle has not joined");
        std::thread::sleep(STANDS / 10);
    }
}

/// Moves it.
fn moves(vehicle: &Process, caller: &Peer) -> Result<()> {
    let ons = lines(vehicle, ON);
    sets_out(caller, [1, 2])?;
    let deadline = std::time::Instant::now() + LONG;
    while lines(vehicle, ON) == ons {
        ensure!(std::time::Instant::now() < deadline, "it does not move");
        std::thread::sleep(STANDS / 100);
    }
    Ok(())
}

/// How many lines of this kind it has printed.
fn lines(vehicle: &Process, kind: &str) -> usize {
    vehicle.lines().iter().filter(|line| line.text.starts_with(kind)).count()
}

/// The vehicle's process, until its standard input ends.
pub(crate) fn stand_alone() -> Result<()> {
    let (name, id) = VEHICLE;
    let rights = AccessTable::parse("built in", RIGHTS)?;
    let unit = CommunicationSystem::builder(name, id)?.fleet(FLEET).control(Control::Off).insecure().access(rights);
    let unit = unit.build()?;
    let late = Arc::new(AtomicU64::new(0));
    let canary = late.clone();
    let functions = unit.my_function_list();
    let drive = functions.actuator(move || println!("{SAFE} {} {}", now(), canary.load(Ordering::Relaxed)))?;
    let nothing = |_: &Served, _: &mut ParametersView| Ok(());
    let stops = ServiceOptions::new().stops(&drive).priority(Priority::Emergency);
    functions.add_service(&Definition::parse(GO_TO)?, ServiceOptions::new().moves(&drive, GO_TO_LEASE), nothing)?;
    functions.add_service(&Definition::parse(STOP)?, stops, nothing)?;
    functions.add_service(&Definition::parse(RESET)?, ServiceOptions::new().resets(&drive), nothing)?;
    unit.publish_my_function_list()?;
    unit.start()?;
    std::thread::spawn(move || motors(&drive.watch(), &late));
    std::io::stdin().lines().try_for_each(|line| line.map(drop))?;
    Ok(())
}
