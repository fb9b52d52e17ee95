//! A board whose manager has a standby: the manager is killed, or frozen while the board drives, and the board obeys the standby.

use std::path::Path;
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use cara_processes::Process;
use cara_std::{Duration, StartError, UnitEvent};
use clap::Args;

use crate::board::{Bench, LONG, Who};
use crate::manager::{self, Manager, sets_out};

/// How often.
#[derive(Args)]
pub(crate) struct Standby {
    /// Rounds of each fault.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    Killed,
    Frozen,
}

/// Runs it, and prints the times from the fault to the first command that the board obeys.
pub(crate) fn run(bench: &Bench, Standby { rounds }: &Standby) -> Result<()> {
    for fault in [Fault::Killed, Fault::Frozen] {
        let took = (0..*rounds).map(|_| round(bench, fault)).collect::<Result<Vec<_>>>();
        let mut took = took.with_context(|| format!("manager {fault:?}"))?;
        took.sort_unstable();
        let [median, worst] = [took.len() / 2, took.len() - 1].map(|at| took[at]);
        println!("manager {fault:?}: the board obeys its standby after {median} ms, worst {worst}, {rounds} rounds");
    }
    Ok(())
}

/// With a board and claims of its own.
fn round(bench: &Bench, fault: Fault) -> Result<u128> {
    let bench = &bench.with(bench.keys.others()?);
    let (cable, who, folder) = (bench.cable()?, Who::agv(17), tempfile::tempdir()?);
    let [at_manager, at_standby] = ["manager", "standby"].map(|name| folder.path().join(name));
    let board = bench.board(&cable, &who)?;
    let arguments = manager::command(&bench.keys, Some(&at_manager));
    let mut manager = Process::start("manager", Path::new(&std::env::current_exe()?), arguments)?;
    manager.expect("driving", LONG)?;
    let line = board.logs_behind(0, "driving")?;
    let standby = Manager::builder()?.standby().state_folder(&at_standby);
    let standby = Manager::of(bench.keys.give(standby)?)?;
    standby.event("standing by", |event| matches!(event, UnitEvent::StandsBy { .. }))?;
    ensure!(standby.system.number_of_s_units() == 0, "it has the board beside a live manager");

    let since = match fault {
        Fault::Killed => manager.kill()?,
        Fault::Frozen => manager.freeze()?,
    };
    board.logs_behind(line, "stopped at")?;
    let agv = standby.meet(&who)?;
    sets_out(&agv, [0, 1_000])?;
    let took = since.elapsed().as_millis();
    let line = board.logs_behind(line, "driving")?;
    if fault == Fault::Frozen {
        let thawed = Instant::now();
        manager.thaw()?;
        let ended = manager.wait(LONG)?;
        let code = ended.code().and_then(|code| u8::try_from(code).ok());
        ensure!(code == Some(StartError::FENCED_EXIT), "thawed, the first manager ended with {ended}");
        ensure!(agv.is_connected(), "the thawed manager has taken the board within {:?}", thawed.elapsed());
    }
    agv.ping(Duration::from(LONG))?;
    agv.release("go_to")?;
    board.logs_behind(line, "stopped at")?;
    Ok(took)
}
