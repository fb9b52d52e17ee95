//! Cable, processor and manager fail while the vehicle drives.

use std::path::Path;
use std::time::Duration;

use anyhow::{Result, ensure};
use cara_processes::Process;
use cara_std::{Error, RequestOptions};

use crate::board::{Bench, LONG, Who};
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
    let agv = manager.meet(&who)?;
    sets_out(&agv, [1_000, 0])?;
    cable.pull()?;
    let line = board.logs_behind(0, "stopped at")?;
    manager.left(&who)?;
    board.logs_behind(line, "depot has left")?;
    cable.plug_in()?;
    let agv = manager.meet(&who)?;
    let [x, _] = position(&agv)?;
    std::thread::sleep(Duration::from_secs(1));
    ensure!(position(&agv)? == [x, 0], "it drives again, and nobody told it to");
    Ok(format!("it stood at {x} and stayed"))
}

pub(super) fn manager(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let who = Who::agv(17);
    let board = bench.board(&cable, &who)?;
    let program = std::env::current_exe()?;
    let arguments = crate::manager::command(&bench.keys, None);
    let mut process = Process::start("manager", Path::new(&program), arguments)?;
    process.expect("driving", LONG)?;
    board.logs("driving")?;
    process.kill()?;
    let line = board.logs_behind(0, "stopped at")?;
    board.logs_behind(line, "depot has left")?;
    let manager = Manager::start(&bench.keys)?;
    let agv = manager.meet(&who)?;
    let [x, _] = position(&agv)?;
    std::thread::sleep(Duration::from_secs(1));
    ensure!(position(&agv)? == [x, 0], "it drives again, and nobody told it to");
    Ok(format!("it stood at {x} and stayed"))
}
