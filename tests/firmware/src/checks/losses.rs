//! Cable, processor and manager fail while the vehicle drives.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Result, ensure};
use cara_processes::Process;
use cara_std::{Error, Peer, RequestOptions};

use crate::board::{Bench, Board, LONG, Who};
use crate::manager::{Manager, at, position, sets_out};

pub(super) fn hung(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let board = bench.board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    board.freeze()?;
    let soon = RequestOptions { timeout: Some(Duration::from_millis(300).into()), ..RequestOptions::default() };
    let ended = agv.call("pos_info", &mut at([0, 0])?).with(soon).wait();
    ensure!(ended == Err(Error::TimedOut.into()), "{ended:?}");
    board.thaw()?;
    let agv = manager.meet(&Who::agv(17))?;
    position(&agv)?;
    Ok("TimedOut; it answers again".into())
}

pub(super) fn idle_cable(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let who = Who::agv(17);
    let board = bench.board(&cable, &who)?;
    manager.meet(&who)?;
    for _ in 0..2 {
        let line = board.line();
        cable.pull()?;
        manager.left(&who)?;
        board.logs_behind(line, "depot has left")?;
        cable.plug_in()?;
        board.logs_behind(line, "depot has joined")?;
        position(&manager.meet(&who)?)?;
    }
    Ok("twice".into())
}

pub(super) fn cable(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let who = Who::agv(17);
    let board = bench.board(&cable, &who)?;
    loses_its_cable(&manager, &board, &who, || cable.pull(), || cable.plug_in())
}

/// The cable of a vehicle that drives is pulled and plugged in again.
pub(crate) fn loses_its_cable(
    manager: &Manager,
    board: &Board,
    who: &Who,
    pull: impl FnOnce() -> Result<()>,
    plug_in: impl FnOnce() -> Result<()>,
) -> Result<String> {
    let agv = manager.meet(who)?;
    sets_out(&agv, [1_000, 0])?;
    manager.forget_events();
    let line = board.line();
    let pulled = Instant::now();
    pull()?;
    // Of the two the lease is the shorter: the vehicle stands before it misses its manager.
    let line = board.logs_behind(line, "stopped at")?;
    let stopped = pulled.elapsed();
    manager.left(who)?;
    board.logs_behind(line, "depot has left")?;
    let plugged_in = Instant::now();
    plug_in()?;
    let agv = manager.meet(who)?;
    stays(&agv, stopped, plugged_in.elapsed())
}

pub(super) fn manager(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let who = Who::agv(17);
    let board = bench.board(&cable, &who)?;
    loses_its_manager(bench, &board, &who)
}

/// The manager of a vehicle is killed while that drives, and another one comes.
pub(crate) fn loses_its_manager(bench: &Bench, board: &Board, who: &Who) -> Result<String> {
    let line = board.line();
    let program = std::env::current_exe()?;
    let arguments = crate::manager::command(&bench.keys, None);
    let mut process = Process::start("manager", Path::new(&program), arguments)?;
    process.expect("driving", LONG)?;
    let line = board.logs_behind(line, "driving")?;
    let killed = process.kill()?;
    let line = board.logs_behind(line, "stopped at")?;
    let stopped = killed.elapsed();
    board.logs_behind(line, "depot has left")?;
    let started = Instant::now();
    let manager = Manager::start(&bench.keys)?;
    let agv = manager.meet(who)?;
    stays(&agv, stopped, started.elapsed())
}

/// A vehicle that has stopped and come back does not drive on by itself.
fn stays(agv: &Peer, stopped: Duration, back: Duration) -> Result<String> {
    let [x, y] = position(agv)?;
    std::thread::sleep(Duration::from_secs(1));
    ensure!(position(agv)? == [x, y], "it drives again, and nobody told it to");
    let (stopped, back) = (stopped.as_millis(), back.as_millis());
    Ok(format!("it stood at {x} after {stopped} ms and stayed, and was back after {back} ms"))
}
