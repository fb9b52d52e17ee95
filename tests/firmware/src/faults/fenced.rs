//! Two managers of one identity: what the one says that was frozen meanwhile moves nothing.

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use cara_processes::Process;
use cara_std::{CallError, Error, Renew, StartError};

use super::Stop;
use super::inject::{EmulatedBoard, OFF, ON, RENEWED, STANDS, pause, tries};
use crate::board::LONG;
use crate::manager::{self, ANNOUNCE, INSIST, Manager, sends};

impl EmulatedBoard {
    /// A manager drives and is frozen, another one of another host takes over. The first goes on, and wants the vehicle to drive.
    pub(super) fn manager_is_fenced(&self, dice: &mut fastrand::Rng) -> Result<Stop> {
        let [folder, other] = ["state", "other"].map(|name| self.keys.folder().join(name));
        let line = self.board.line();
        let mut first =
            Process::start("manager", &std::env::current_exe()?, manager::command(&self.keys, Some(&folder)))?;
        first.expect("driving", LONG)?;
        let line = self.board.logs_behind(line, ON)?;
        // Where no datagram has come through, a silent link counts as live for 8 s.
        std::thread::sleep(2 * RENEWED);
        pause(dice);
        first.send(ANNOUNCE)?;
        first.expect("announced", LONG)?;
        first.freeze()?;
        let second = self.takes_over(&other)?;
        let (behind, stop) = self.stopped(line)?;
        let agv = second.meet(&self.who)?;
        self.lost_once(line)?;
        self.stands(&agv, line, behind)?;
        let behind = self.commands(&second)?;
        first.send(INSIST)?;
        first.thaw()?;
        let ended = first.wait(LONG).with_context(|| format!("the board logged{}", self.log(line)))?;
        let code = ended.code().and_then(|code| u8::try_from(code).ok());
        ensure!(code == Some(StartError::FENCED_EXIT), "the first manager ended with {ended}");
        std::thread::sleep(STANDS);
        let moves = self.has_logged(behind, ON);
        ensure!(!moves, "a manager that was fenced moves it; the board logged{}", self.log(line));
        drop(second);
        Ok(stop)
    }

    fn takes_over(&self, folder: &Path) -> Result<Manager> {
        Manager::of(self.keys.give(Manager::builder()?.state_folder(folder).take_over(true))?)
    }

    /// It moves the vehicle, and stops it; the line behind that.
    fn commands(&self, manager: &Manager) -> Result<usize> {
        let line = self.board.line();
        for () in tries() {
            let agv = manager.meet(&self.who)?;
            match sends(&agv, [-9_000, 0], Renew::Process) {
                Ok(true) => {
                    self.board.logs_behind(line, ON)?;
                    agv.release("go_to")?;
                    return self.board.logs_behind(line, OFF);
                }
                Ok(false) => {}
                // A board that gets no processor for seconds loses its link, and with it what moved.
                Err(error) if is_of_an_ended_link(&error) => {}
                Err(error) => return Err(error),
            }
        }
        bail!("the second manager does not move it; the board logged{}", self.log(line))
    }
}

fn is_of_an_ended_link(error: &anyhow::Error) -> bool {
    error.downcast_ref::<CallError>().is_some_and(|error| matches!(error.error, Error::Interrupted))
}
