//! `cargo xtask demo`: the paper's listing between real processes, then losses of power in the middle of it.
//!
//! Everything is checked from what the processes print; each wait has a deadline, and no process outlives this one.

use std::path::Path;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use cara_processes::Process;
use cara_processes::ticker::Ticker;

use crate::{binaries, workspace};

mod listing;
mod stage;
mod warehouse;

use stage::{EXPIRED, STEP, Stage, TRY};
pub(crate) use warehouse::{Options, check as check_warehouse, run as warehouse};

/// How long after the manager the last AGV starts.
const LATE: Duration = Duration::from_secs(5);
/// How long an AGV may drive on when its manager is gone: the lease of `go_to` and a tick of its motors' loop, as
/// `cara-apps` has them, and what a machine takes to run the loop and to print. What a busy one holds up comes on top.
const DRIVES_ON: Duration = Duration::from_millis(400 + 20 + 150);
/// How many of its reports, two a second, an AGV that stopped must show that it stands.
const REPORTS: usize = 4;

/// What takes part in it.
pub(crate) const PROGRAMS: [&str; 3] = ["agv", "agv_manager", "cara"];

/// Runs the demonstration; success only if everything in it happened.
pub(crate) fn run() -> Result<ExitCode> {
    binaries::build(&PROGRAMS)?;
    let programs = workspace::target().join("debug");
    between(&programs, &programs)?;
    Ok(ExitCode::SUCCESS)
}

/// Runs it with a manager and AGVs of two folders, which may be of different builds.
pub(crate) fn between(manager: &Path, agvs: &Path) -> Result<()> {
    let stage = Stage::new(manager, agvs)?;
    play(&stage).context("the demonstration failed")?;
    println!("\neverything happened, in {:.1} s", stage.seconds());
    Ok(())
}

fn play(stage: &Stage) -> Result<()> {
    stage.title("Keys for the fleet");
    stage.make_keys()?;
    stage.title("The listing: a manager, and AGVs that come while it searches");
    let mut manager = stage.manager()?;
    let began = Instant::now();
    let [mut first, mut second] = listing::run(stage, &mut manager)?;
    let third = late(stage, &mut manager, began)?;
    restart(stage, &mut manager, &mut second)?;
    hang_manager(stage, &mut manager, &mut first)?;
    let place = lose_manager(stage, manager, &mut first)?;
    return_of_manager(stage, &mut first, &place)?;
    end(stage, [first, second, third])
}

/// The last AGV comes seconds after the manager, and gets what was published to all before it came.
fn late(stage: &Stage, manager: &mut Process, began: Instant) -> Result<Process> {
    stage.title("An AGV that comes late");
    std::thread::sleep(LATE.saturating_sub(began.elapsed()));
    let third = stage.agv(3)?;
    stage.show(&format!("agv-3 starts {:.1} s after the manager", began.elapsed().as_secs_f64()));
    stage.heard(&manager.seen("joined agv-3/13", STEP)?, manager);
    stage.heard(&third.seen("call_mechanic: one comes in 5 minutes", STEP)?, &third);
    let units = stage.until(manager, "units", "= 3 s_units")?;
    ensure!(units.contains("2 is agv-3/13"), "agv-3 is not at index 2: {units}");
    Ok(third)
}

/// An AGV loses power and comes back: the same place among the s_units, another run, the position lost.
fn restart(stage: &Stage, manager: &mut Process, agv: &mut Process) -> Result<()> {
    stage.title("An AGV loses power and comes back");
    stage.sends(manager, agv, "go_to 1 2 0", |stage, agv| stage.arrives(agv, "[2.000, 0.000]"))?;
    stage.until(manager, "pos_info 1", "= position [2, 0]")?;
    let before = epoch(&stage.command(manager, "units", "1 is agv-2/12, epoch")?)?;
    agv.kill()?;
    stage.show("agv-2 is killed (SIGKILL)");
    stage.heard(&manager.expect("left agv-2/12", STEP)?, manager);
    stage.command(manager, "units", "1 is agv-2/12, away")?;
    stage.command(manager, "pos_info 1", "! ")?;
    *agv = stage.agv(2)?;
    stage.show("agv-2 is started again");
    stage.heard(&manager.expect("joined agv-2/12", STEP)?, manager);
    let after = epoch(&stage.command(manager, "units", "1 is agv-2/12, epoch")?)?;
    ensure!(before != after, "agv-2 restarted and has the same epoch {after}");
    stage.until(manager, "pos_info 1", "= position [0, 0]")?;
    Ok(())
}

/// The epoch of the s_unit at index 1.
fn epoch(units: &str) -> Result<String> {
    let epoch = units.split_once("1 is agv-2/12, epoch ").and_then(|(_, rest)| rest.split(';').next());
    Ok(epoch.with_context(|| format!("no epoch in `{units}`"))?.to_owned())
}

/// The manager hangs while an AGV drives. No connection ends, so it is the lease that stops the AGV; and it stays where
/// it is when the manager goes on.
fn hang_manager(stage: &Stage, manager: &mut Process, agv: &mut Process) -> Result<()> {
    stage.title("The manager hangs while agv-1 drives");
    let before = drive(stage, manager, agv, [500, 2])?;
    let told = manager.lines().len();
    let place = stops(stage, agv, || {
        let frozen = manager.freeze()?;
        stage.show("the manager is held up (SIGSTOP); its connections stay open");
        Ok(frozen)
    })?;
    // Printed by another thread than the place: either comes first.
    stage.heard(&agv.seen_behind(before, EXPIRED, STEP)?, agv);
    manager.thaw()?;
    stage.show("the manager goes on (SIGCONT)");
    // Which of the two comes first: the vehicle's word, or the manager's look how long no renewal was answered.
    let end = manager.seen_behind(told, "lease of go_to at agv-1/11 ", STEP)?;
    let is_reported = ["expired", "unanswered"].iter().any(|word| end.text.contains(word));
    ensure!(is_reported, "the lease of a frozen manager ended otherwise: {}", end.text);
    stage.heard(&end, manager);
    stands(stage, agv, &place)?;
    // It may have lost some of them meanwhile.
    stage.until(manager, "units", "= 3 s_units")?;
    Ok(())
}

/// The manager loses power while an AGV drives: the AGV stops, soon, and stays where it is. Where that is.
fn lose_manager(stage: &Stage, mut manager: Process, agv: &mut Process) -> Result<String> {
    stage.title("The manager loses power while agv-1 drives");
    drive(stage, &mut manager, agv, [900, 2])?;
    let place = stops(stage, agv, || {
        let killed = manager.kill()?;
        stage.show("the manager is killed (SIGKILL)");
        Ok(killed)
    })?;
    stands(stage, agv, &place)?;
    Ok(place)
}

/// Sends agv-1 somewhere far, and waits until it is on its way and its lease has not ended. How many lines it had printed before.
fn drive(stage: &Stage, manager: &mut Process, agv: &mut Process, [x, y]: [i64; 2]) -> Result<usize> {
    let before = std::cell::Cell::new(0);
    stage.sends(manager, agv, &format!("go_to 0 {x} {y}"), |stage, agv| {
        let Ok(line) = agv.expect(&format!("driving to [{x}.000, {y}.000]"), TRY) else { return Ok(false) };
        stage.heard(&line, agv);
        before.set(agv.lines().iter().rposition(|known| *known == line).unwrap_or_default());
        for _ in 0..2 {
            let line = agv.expect_any(&["passed", "stopped at"], STEP)?;
            stage.heard(&line, agv);
            if line.text.starts_with("stopped at") {
                return Ok(false);
            }
        }
        Ok(!agv.lines()[before.get()..].iter().any(|line| line.text.contains(EXPIRED)))
    })?;
    Ok(before.get())
}

/// The AGV stops within the time that it may drive on after `lose`, on its way. Where.
fn stops(stage: &Stage, agv: &mut Process, lose: impl FnOnce() -> Result<Instant>) -> Result<String> {
    let ticker = Ticker::start();
    let lost = lose()?;
    let stopped = agv.expect("stopped at", STEP)?;
    let held_up = ticker.together();
    stage.heard(&stopped, agv);
    let after = stopped.at.saturating_duration_since(lost);
    let most = DRIVES_ON + held_up;
    ensure!(
        after <= most,
        "agv-1 drove on for {after:?}, more than {most:?}, of which the machine was held up {held_up:?}"
    );
    let place = place(&stopped.text)?;
    stage.show(&format!("agv-1 stopped {} ms after that, at {place}", after.as_millis()));
    Ok(place)
}

/// The place in one of an AGV's lines.
fn place(line: &str) -> Result<String> {
    let start = line.find('[').with_context(|| format!("no place in `{line}`"))?;
    let end = line.rfind(']').with_context(|| format!("no place in `{line}`"))?;
    Ok(line[start..=end].to_owned())
}

/// The AGV's next reports say that it stands there, and nothing between them says otherwise.
fn stands(stage: &Stage, agv: &mut Process, there: &str) -> Result<()> {
    let before = agv.lines().len();
    for _ in 0..REPORTS {
        let report = agv.expect("position", STEP)?;
        let now = place(&report.text)?;
        ensure!(now == there, "agv-1 stood at {there} and is now at {now}");
    }
    if let Some(line) = agv.lines()[before..].iter().find(|line| moves(&line.text)) {
        bail!("agv-1 moves again: {}", line.text);
    }
    stage.show(&format!("agv-1 reported {REPORTS} times that it stands at {there}"));
    Ok(())
}

fn moves(line: &str) -> bool {
    ["driving", "passed", "arrived"].iter().any(|word| line.starts_with(word))
}

/// The manager comes back; the order from before its loss does not.
fn return_of_manager(stage: &Stage, agv: &mut Process, place: &str) -> Result<()> {
    stage.title("The manager comes back, the old order does not");
    let mut manager = stage.manager()?;
    for _ in 1..=3 {
        manager.expect("line ", STEP)?;
        manager.send("")?;
    }
    stage.heard(&manager.seen("joined agv-1/11", STEP)?, &manager);
    stage.heard(&agv.expect("joined AGV_manager/1", STEP)?, agv);
    stands(stage, agv, place)?;
    manager.terminate(STEP)?;
    let ended = agv.terminate(STEP)?;
    ensure!(ended.success(), "agv-1 ended with {ended}");
    let line = agv.expect("ended at", STEP)?;
    stage.heard(&line, agv);
    ensure!(line.text.contains(place), "agv-1 did not end where it stopped, {place}");
    Ok(())
}

/// Every AGV ends in an orderly way; the first one has ended already.
fn end(stage: &Stage, agvs: [Process; 3]) -> Result<()> {
    stage.title("The end");
    for mut agv in agvs {
        agv.end_input();
        let status = agv.wait(STEP)?;
        ensure!(status.success(), "{} ended with {status}", agv.name());
    }
    stage.show("all processes have ended");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{epoch, moves, place};

    #[test]
    fn lines_are_understood() {
        assert_eq!(place("stopped at [3.480, 2.000]: the lease").unwrap(), "[3.480, 2.000]");
        assert!(place("stopped").is_err());
        assert_eq!(epoch("= 2 s_units; 0 is a/1, away; 1 is agv-2/12, epoch 0f; 2 is b/3, away").unwrap(), "0f");
        assert!(epoch("= 1 s_units; 1 is agv-2/12, away").is_err());
        assert!(moves("passed [1.000, 0.000]") && !moves("position [1.000, 0.000]"));
    }
}
