//! One fault after the other, and what has to be so behind each: the motors stand, the hook for a lost manager has run once
//! and first, no old command moves the vehicle, and a new one does.

use std::path::Path;
use std::rc::Rc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use cara_apps::agv::GO_TO_LEASE;
use cara_processes::Process;
use cara_std::{CloseReason, Error, Peer, Renew, UnitEvent};

use super::kind::{Bound, Failing, Kind, OVERFLOW};
use super::{Stop, Target};
use crate::board::{Bench, Board, Cable, LONG, Way, Who};
use crate::keys::Keys;
use crate::manager::{self, ANNOUNCE, Manager, announce, at, fault, position, sends};

/// Longer than the pause between two renewals: faults come in every phase of it.
pub(super) const PHASES: u64 = 250;
/// In which a vehicle that drives would be seen to.
pub(super) const STANDS: Duration = Duration::from_millis(300);
/// How often a manager renews that has its turns.
pub(super) const RENEWED: Duration = Duration::from_millis(100);
/// For so long a drive is started again because this machine was too busy to renew a lease in time.
pub(super) const BUSY: Duration = LONG.saturating_mul(2);
/// How often a stop may come in the stream although its datagram has left first.
pub(super) const UNHEARD: u32 = 5;
/// What the board logs.
pub(super) const ON: &str = "motors on";
pub(super) const OFF: &str = "motors off:";
pub(super) const LEFT: &str = "depot has left";
const HOOK: &str = "hook for the lost manager";

/// A board with its cable.
pub(super) struct EmulatedBoard {
    pub(super) board: Board,
    pub(super) cable: Cable,
    pub(super) keys: Rc<Keys>,
    pub(super) who: Who,
    /// The constants that the image has logged.
    constants: String,
}

/// A try after the other, as long as the machine may be too busy.
pub(super) fn tries() -> impl Iterator<Item = ()> {
    let end = Instant::now() + BUSY;
    std::iter::from_fn(move || (Instant::now() < end).then_some(()))
}

/// A vehicle that drives, and whose fault has been announced.
pub(super) struct Drive {
    pub(super) agv: Peer,
    /// Where the log of its motors begins.
    pub(super) line: usize,
}

impl Target for EmulatedBoard {
    fn name(&self) -> &'static str {
        "emulated board"
    }

    fn has_own_clock(&self) -> bool {
        true
    }

    fn bound(&self, kind: &Kind) -> Result<Bound> {
        Bound::of(kind, &self.constants)
    }

    fn fail(&self, kind: &Kind, number: u32, dice: &mut fastrand::Rng) -> Result<Stop> {
        let stop = match kind.failing {
            Failing::Manager { frozen } => self.manager_fails(frozen, dice),
            Failing::Turns => self.manager_is_held_up(dice),
            Failing::Wire(Way::FromBoard) => self.manager_hears_nothing(dice),
            Failing::Wire(Way::ToBoard) | Failing::Cable => self.link_cut(kind.failing, number, dice),
            Failing::Looks => self.task_looks_rarely(dice),
            Failing::Replaced => self.order_replaced(dice),
            Failing::Caller { killed: true } => self.caller_is_killed(dice),
            Failing::Caller { killed: false } => self.caller_times_out(number, dice),
            Failing::Board { asked, reason } => self.board_fails(in_turn(asked, number), reason, dice),
            Failing::Flooded => self.is_stopped(dice),
            Failing::Bumper => self.stops_itself(dice),
            Failing::Loop => self.loop_hangs(dice),
            Failing::Guard => self.guard_is_dropped(dice),
            Failing::Fenced => self.manager_is_fenced(dice),
            Failing::StateHeld | Failing::SecondManager | Failing::Held | Failing::NoRight => {
                bail!("only processes of Linux fail so")
            }
        };
        let which = || format!("{}, number {number}", kind.name);
        let stop = stop.with_context(which)?;
        stop.check(&self.constants, kind).with_context(which)?;
        Ok(stop)
    }
}

impl EmulatedBoard {
    pub(super) fn new(bench: &Bench) -> Result<Self> {
        let cable = bench.cable()?;
        let who = Who::agv(17);
        let board = bench.board(&cable, &who)?;
        let (_, constants) = board.finds(0, "bound:")?;
        Ok(Self { board, cable, keys: Rc::clone(&bench.keys), who, constants })
    }

    fn manager_fails(&self, frozen: bool, dice: &mut fastrand::Rng) -> Result<Stop> {
        let line = self.board.line();
        let mut process = self.manager_process()?;
        let line = self.board.logs_behind(line, ON)?;
        pause(dice);
        process.send(ANNOUNCE)?;
        process.expect("announced", LONG)?;
        if frozen {
            process.freeze()?
        } else {
            process.kill()?
        };
        let (behind, stop) = self.stopped(line)?;
        if frozen {
            // It goes on where it was, which must not move the vehicle; then it ends too.
            process.thaw()?;
            process.send(ANNOUNCE)?;
            process.expect("announced", LONG)?;
            let moves = self.has_logged(behind, ON);
            ensure!(!moves, "a manager that was frozen moves it; the board logged{}", self.log(line));
        }
        self.another_finds_it_standing(process, line, behind)?;
        Ok(stop)
    }

    /// A manager that renews at the last moment, on a busy machine: either in time, or in vain.
    fn manager_is_held_up(&self, dice: &mut fastrand::Rng) -> Result<Stop> {
        let line = self.board.line();
        let mut process = self.manager_process()?;
        let line = self.board.logs_behind(line, ON)?;
        while !self.has_logged(line, OFF) {
            process.send(ANNOUNCE)?;
            process.expect("announced", LONG)?;
            process.freeze()?;
            std::thread::sleep(Duration::from(GO_TO_LEASE) - RENEWED.mul_f64(dice.f64()));
            process.thaw()?;
        }
        let (behind, stop) = self.stopped(line)?;
        // It wants to go on, and says so.
        process.send(ANNOUNCE)?;
        process.expect("announced", LONG)?;
        std::thread::sleep(STANDS);
        let moves = self.has_logged(behind, ON);
        ensure!(!moves, "a renewal that came too late moves it; the board logged{}", self.log(line));
        self.another_finds_it_standing(process, line, behind)?;
        Ok(stop)
    }

    fn manager_process(&self) -> Result<Process> {
        let program = std::env::current_exe()?;
        let mut process = Process::start("manager", Path::new(&program), manager::command(&self.keys, None))?;
        process.expect("driving", LONG)?;
        Ok(process)
    }

    /// Ends a manager; the next one finds the vehicle where it was.
    fn another_finds_it_standing(&self, process: Process, line: usize, behind: usize) -> Result<()> {
        drop(process);
        self.lost_once(line)?;
        let manager = Manager::start(&self.keys)?;
        let agv = manager.meet(&self.who)?;
        self.stands(&agv, line, behind)
    }

    fn link_cut(&self, failing: Failing, number: u32, dice: &mut fastrand::Rng) -> Result<Stop> {
        let manager = Manager::start(&self.keys)?;
        let Drive { agv, line } = self.drive(&manager, dice)?;
        self.cut(failing)?;
        agv.request("go_to", &at([-9_000, 0])?)?;
        let (behind, stop) = self.stopped(line)?;
        if number.is_multiple_of(2) {
            // The link is back before its loss was detected, and the command arrives, too late.
            std::thread::sleep(GO_TO_LEASE.into());
            self.mend(failing)?;
            let ends = |event: &UnitEvent| matches!(event, UnitEvent::RequestFailed { .. } | UnitEvent::Left { .. });
            let ended = manager.event("end of the old command", ends)?;
            let refused = matches!(ended, UnitEvent::RequestFailed { error: Error::Expired, .. });
            let left = matches!(ended, UnitEvent::Left { .. });
            ensure!(refused || left, "the old command came to {ended:?}; the board logged{}", self.log(line));
        } else {
            manager.left(&self.who)?;
            self.lost_once(line)?;
            self.mend(failing)?;
        }
        let agv = manager.meet(&self.who)?;
        self.stands(&agv, line, behind)?;
        self.hooks_follow_losses(line)?;
        Ok(stop)
    }

    /// The manager hears nothing any more, and wants the vehicle to drive until it notices.
    fn manager_hears_nothing(&self, dice: &mut fastrand::Rng) -> Result<Stop> {
        let failing = Failing::Wire(Way::FromBoard);
        let manager = Manager::start(&self.keys)?;
        let Drive { line, .. } = self.drive(&manager, dice)?;
        self.cut(failing)?;
        manager.left(&self.who)?;
        let (behind, stop) = self.stopped(line)?;
        self.lost_once(line)?;
        self.mend(failing)?;
        let agv = manager.meet(&self.who)?;
        self.stands(&agv, line, behind)?;
        Ok(stop)
    }

    fn board_fails(&self, asked: i64, reason: &str, dice: &mut fastrand::Rng) -> Result<Stop> {
        let manager = Manager::start(&self.keys)?;
        let Drive { agv, line } = self.drive(&manager, dice)?;
        manager.forget_events();
        agv.request("fault", &fault(asked)?)?;
        // Whatever becomes of it, the next life of the board does not run it.
        let _ = agv.request("go_to", &at([-9_000, 0])?);
        let (behind, stop) = self.stopped(line)?;
        if reason == OVERFLOW {
            self.board.logs_behind(behind, "the lease's words are as they were")?;
        }
        let reported = format!("started because of {reason}, with the motors off");
        let started = self.board.logs_behind(behind, &reported)?;
        let left = manager.event("loss", |event| matches!(event, UnitEvent::Left { .. }))?;
        let restarted = matches!(left, UnitEvent::Left { reason: CloseReason::PeerRestarted | CloseReason::Reset, .. });
        ensure!(restarted || reason == "Watchdog", "the manager was told {left:?}; the board logged{}", self.log(line));
        self.board.logs_behind(started, "has joined")?;
        let agv = manager.meet(&self.who)?;
        let place = position(&agv)?;
        ensure!(place == [0, 0], "a fresh board has moved to {place:?}; it logged{}", self.log(line));
        self.stands(&agv, line, behind)?;
        Ok(stop)
    }

    /// Sends the vehicle on its way, and announces a fault at some moment.
    pub(super) fn drive(&self, manager: &Manager, dice: &mut fastrand::Rng) -> Result<Drive> {
        for () in tries() {
            let agv = manager.meet(&self.who)?;
            let line = self.board.line();
            if !sends(&agv, [9_000, 0], Renew::Process)? {
                continue;
            }
            let line = self.board.logs_behind(line, ON)?;
            pause(dice);
            announce(&agv)?;
            if !self.has_logged(line, OFF) {
                return Ok(Drive { agv, line });
            }
        }
        anyhow::bail!("for {BUSY:?} no lease was renewed in time")
    }

    fn cut(&self, failing: Failing) -> Result<()> {
        match failing {
            Failing::Wire(way) => self.cable.cut(way),
            _ => self.cable.pull(),
        }
    }

    fn mend(&self, failing: Failing) -> Result<()> {
        match failing {
            Failing::Wire(_) => self.cable.join(),
            _ => self.cable.plug_in(),
        }
    }

    /// Waits until the motors stand; the line behind that, and how long it took.
    pub(super) fn stopped(&self, line: usize) -> Result<(usize, Stop)> {
        let (behind, said) = self.board.finds(line, OFF)?;
        Ok((behind, Stop::read(&said)?))
    }

    /// Waits until the hook for the lost manager has run, and looks that it ran once and before anything else.
    pub(super) fn lost_once(&self, line: usize) -> Result<()> {
        self.board.logs_behind(line, HOOK)?;
        let losses = self.hooks_follow_losses(line)?;
        ensure!(losses == 1, "{losses} losses of one manager; the board logged{}", self.log(line));
        Ok(())
    }

    /// Behind each loss of the manager comes its hook, once, and nothing in between; how many losses there were.
    fn hooks_follow_losses(&self, line: usize) -> Result<usize> {
        // Interrupts run whenever they like.
        let lines: Vec<String> = self.board.lines(line).into_iter().filter(|line| !line.contains(OFF)).collect();
        let has = |text: &'static str| move |line: &&String| line.contains(text);
        let [losses, hooks] = [LEFT, HOOK].map(|text| lines.iter().filter(has(text)).count());
        let in_order = lines.windows(2).filter(|pair| pair[0].contains(LEFT) && pair[1].contains(HOOK)).count();
        ensure!(
            losses == hooks && hooks == in_order,
            "losses and their hooks do not match; the board logged{}",
            self.log(line)
        );
        Ok(losses)
    }

    /// Nothing has moved the vehicle since, and nothing does while it is looked at.
    pub(super) fn stands(&self, agv: &Peer, line: usize, behind: usize) -> Result<()> {
        let before = position(agv)?;
        std::thread::sleep(STANDS);
        let after = position(agv)?;
        ensure!(
            before == after && !self.has_logged(behind, ON),
            "it drives again, and nobody told it to: from {before:?} to {after:?}; behind the motors' end in line {behind} \
             the board logged{}",
            self.log(line)
        );
        Ok(())
    }

    /// What the board has logged since, for an error message.
    pub(super) fn log(&self, line: usize) -> String {
        let number = |(at, said): (usize, String)| format!("\n    {:4} {said}", line + at + 1);
        self.board.lines(line).into_iter().enumerate().map(number).collect()
    }

    pub(super) fn has_logged(&self, line: usize, text: &str) -> bool {
        self.board.lines(line).iter().any(|line| line.contains(text))
    }
}

fn in_turn(asked: &[i64], number: u32) -> i64 {
    asked.get(number as usize % asked.len().max(1)).copied().unwrap_or_default()
}

pub(super) fn pause(dice: &mut fastrand::Rng) {
    std::thread::sleep(Duration::from_millis(dice.u64(..PHASES)));
}
