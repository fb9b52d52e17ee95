//! Faults of the caller, and of a task that looks at its lease too rarely: what one call has started goes on for no other
//! call, and for no caller that has given up, or is there no more.

use std::process::Stdio;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use cara_std::{CallError, Error, Parameters, Peer, Renew, RequestOptions};

use super::Stop;
use super::inject::{EmulatedBoard, ON, STANDS, pause};
use super::kind::TIMEOUT;
use crate::board::{FLEET, LONG, Way};
use crate::keys::MANAGER;
use crate::manager::{Manager, announce, is_of_a_busy_host, patiently};

/// The service of the image whose calls tasks take.
pub(super) const CREEP: &str = "creep";
/// Longer than all waiting of the caller.
const NEVER: i64 = 600_000;
/// Of the image's tasks that look at their leases.
const LOOKS: Duration = Duration::from_secs(1);

impl EmulatedBoard {
    /// A call ends, and the next one comes before the first one's task has looked again.
    pub(super) fn task_looks_rarely(&self, dice: &mut fastrand::Rng) -> Result<Stop> {
        let manager = Manager::start(&self.keys)?;
        let (agv, line) = self.creeps(&manager, dice)?;
        announce(&agv)?;
        agv.release(CREEP)?;
        let (behind, stop) = self.stopped(line)?;
        creep(&agv, 0)?;
        self.stays_dead(line, behind)?;
        agv.release(CREEP)?;
        self.stands(&agv, line, behind)?;
        Ok(stop)
    }

    /// A call takes the place of one that moves, and wants no motion.
    pub(super) fn order_replaced(&self, dice: &mut fastrand::Rng) -> Result<Stop> {
        let manager = Manager::start(&self.keys)?;
        let (agv, line) = self.creeps(&manager, dice)?;
        creep(&agv, 0)?;
        let (behind, mut stop) = self.stopped(line)?;
        let second = self.board.logs_behind(line, BEGINS)?;
        // The motors' interrupt may have looked before the second call's task had its turn.
        if behind < second {
            stop.announced = 0;
        }
        self.stays_dead(line, behind)?;
        agv.release(CREEP)?;
        self.stands(&agv, line, behind)?;
        Ok(stop)
    }

    /// The caller waits in vain; in every second fault because it hears nothing any more.
    pub(super) fn caller_times_out(&self, number: u32, dice: &mut fastrand::Rng) -> Result<Stop> {
        let manager = Manager::start(&self.keys)?;
        let is_deaf = !number.is_multiple_of(2);
        let deadline = Instant::now() + LONG;
        loop {
            let agv = manager.meet(&self.who)?;
            if let Some(stop) = self.waits_in_vain(&manager, &agv, is_deaf, dice)? {
                return Ok(stop);
            }
            ensure!(Instant::now() < deadline, "each call that began failed before its time-out");
        }
    }

    /// `None` if the call began and failed early, as where this host was held up: its end is not that of a time-out.
    fn waits_in_vain(
        &self,
        manager: &Manager,
        agv: &Peer,
        is_deaf: bool,
        dice: &mut fastrand::Rng,
    ) -> Result<Option<Stop>> {
        let (board, line) = (&self.board, self.board.line());
        let (outcome, ends) = std::thread::scope(|scope| {
            let call = scope.spawn(|| {
                let has_begun = || board.lines(line).iter().any(|line| line.contains(BEGINS));
                let timeout = Some(TIMEOUT);
                let options = RequestOptions { timeout, ..RequestOptions::renewing(Renew::Process) };
                loop {
                    match agv.call(CREEP, &mut arguments(1, NEVER)?).with(options).wait() {
                        // It did not begin: the clock of this board runs ahead while it computes a proof.
                        Err(error) if error != Error::TimedOut && is_of_a_busy_host(&error.error) && !has_begun() => {}
                        outcome => break outcome,
                    }
                }
            });
            let cut = self.board.logs_behind(line, ON).and_then(|line| {
                pause(dice);
                if is_deaf { self.cable.cut(Way::FromBoard) } else { Ok(()) }.map(|()| line)
            });
            (call.join(), cut)
        });
        let line = ends?;
        let outcome = outcome.ok().context("the call panicked")?;
        let stopped = self.stopped(line);
        if is_deaf {
            self.cable.join()?;
        }
        let (behind, stop) = stopped?;
        match outcome {
            Err(CallError { error: Error::TimedOut, .. }) => {}
            Err(error) if is_of_a_busy_host(&error.error) => return Ok(None),
            other => bail!("the call came to {other:?}"),
        }
        let agv = manager.meet(&self.who)?;
        self.stands(&agv, line, behind)?;
        Ok(Some(stop))
    }

    /// `cara call --hold` is killed while it waits for its answer.
    pub(super) fn caller_is_killed(&self, dice: &mut fastrand::Rng) -> Result<Stop> {
        let (name, id) = MANAGER.split_once('/').context("a manager is NAME/ID")?;
        let fleet = FLEET.to_string();
        let words = ["node", "--name", name, "--id", id, "--fleet", &fleet];
        let _manager = self.keys.process("manager", &words)?;
        let vehicle = self.who.name.as_str();
        self.is_known(vehicle)?;
        let line = self.board.line();
        let call = format!("{CREEP}(speed: 1, answers: {NEVER})");
        let mut caller = self.keys.process("caller", &["call", vehicle, "--hold", &call])?;
        let line = self.board.logs_behind(line, ON)?;
        pause(dice);
        let killed = caller.kill()?;
        let (behind, mut stop) = self.stopped(line)?;
        stop.announced = killed.elapsed().as_micros() as u64;
        std::thread::sleep(STANDS);
        ensure!(!self.has_logged(behind, ON), "it moves without a caller; the board logged{}", self.log(line));
        Ok(stop)
    }

    /// Waits until the manager's process shows the service.
    fn is_known(&self, vehicle: &str) -> Result<()> {
        let deadline = Instant::now() + LONG;
        loop {
            let shown = self.keys.command().args(["functions", vehicle]).stderr(Stdio::null()).output()?;
            if String::from_utf8_lossy(&shown.stdout).contains(CREEP) {
                return Ok(());
            }
            ensure!(Instant::now() < deadline, "{vehicle} offers no {CREEP}");
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    /// A call moves the vehicle, at some moment between two looks of its task.
    fn creeps(&self, manager: &Manager, dice: &mut fastrand::Rng) -> Result<(Peer, usize)> {
        let agv = manager.meet(&self.who)?;
        let line = self.board.line();
        creep(&agv, 1)?;
        let line = self.board.logs_behind(line, ON)?;
        pause(dice);
        Ok((agv, line))
    }

    /// The task of the first call has looked, and moved nothing since line `behind`, while the second call is wanted.
    fn stays_dead(&self, line: usize, behind: usize) -> Result<()> {
        std::thread::sleep(LOOKS);
        self.board.logs_behind(line, "has ended")?;
        let moves = self.has_logged(behind, MOVES) || self.has_logged(behind, ON);
        ensure!(!moves, "what an earlier call has started moves again; the board logged{}", self.log(line));
        Ok(())
    }
}

/// What the image logs of a call that a task has taken, and of its motion.
const BEGINS: &str = " begins";
const MOVES: &str = " moves";

/// Calls the service, which answers at once and goes on.
fn creep(agv: &Peer, speed: i64) -> Result<()> {
    let wanted = RequestOptions::renewing(Renew::Process);
    patiently(|| agv.call(CREEP, &mut arguments(speed, 0)?).with(wanted).wait().map_err(Error::from)).context(CREEP)
}

pub(super) fn arguments(speed: i64, answers: i64) -> Result<Parameters, Error> {
    let mut parameters = Parameters::new();
    for (name, value) in [("speed", speed), ("answers", answers)] {
        parameters.add_int(name, 1)?;
        parameters.set_value(name, value)?;
    }
    Ok(parameters)
}
