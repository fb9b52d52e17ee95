//! Faults of a loop of the manager's program: it hangs, and its process and another loop live on; or it drops the guard of what it
//! holds.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{SyncSender, sync_channel};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use cara_std::{Heart, LeaseEnd, Peer, Renew, RequestOptions, UnitEvent};

use super::Stop;
use super::inject::{BUSY, EmulatedBoard, LEFT, OFF, ON, PHASES, STANDS, UNHEARD, pause, tries};
use super::kind::POLL;
use super::orders::{CREEP, arguments};
use crate::board::LONG;
use crate::manager::{Manager, announce, at, is_of_a_busy_host, sends};

/// At most so long between two beats of a loop.
const PERIOD: Duration = Duration::from_millis(100);
/// How often a loop comes round.
const ROUND: Duration = Duration::from_millis(20);

impl EmulatedBoard {
    /// Of two loops the one that drives the vehicle hangs. What the other one holds on the same board goes on, though it does not
    /// turn the motors: the board has one pin for them.
    pub(super) fn loop_hangs(&self, dice: &mut fastrand::Rng) -> Result<Stop> {
        let manager = Manager::start(&self.keys)?;
        for () in tries() {
            let (agv, ends) = (manager.meet(&self.who)?, AtomicBool::new(false));
            let (held, is_held) = sync_channel(1);
            let line = self.board.line();
            let (stop, continues) = std::thread::scope(|scope| {
                let other = scope.spawn(|| continues(&manager, &agv, &held, &ends));
                let held = is_held.recv_timeout(LONG).context("the other loop holds nothing");
                let stop = held.and_then(|()| self.hangs(&manager, &agv, line, dice));
                ends.store(true, Ordering::Release);
                let continues = other.join().ok().context("the other loop panicked")??;
                Ok::<_, anyhow::Error>((stop?, continues))
            })?;
            let lost = self.has_logged(line, LEFT);
            ensure!(!lost, "the link was lost with the loop; the board logged{}", self.log(line));
            // A busy host may let the other lease end as well.
            let Some((behind, stop)) = stop.filter(|_| continues) else { continue };
            self.stands(&agv, line, behind)?;
            return Ok(stop);
        }
        bail!("for {BUSY:?} no lease was renewed in time")
    }

    /// Drives, beats once more behind the answer to the announcement, and comes round no more. `None` where this machine was too busy.
    fn hangs(
        &self,
        manager: &Manager,
        agv: &Peer,
        line: usize,
        dice: &mut fastrand::Rng,
    ) -> Result<Option<(usize, Stop)>> {
        manager.forget_events();
        let mut heart = manager.system.heart(PERIOD);
        heart.beat();
        if !sends(agv, [9_000, 0], heart.renew())? {
            return Ok(None);
        }
        let line = self.board.logs_behind(line, ON)?;
        comes_round(&mut heart, Duration::from_millis(dice.u64(..PHASES)));
        // The board counts from the announcement, and the beat came before it: however busy this machine is, the beat's lease
        // ends within a lease of that. Where the announcement takes long, too little is shown.
        heart.beat();
        let began = Instant::now();
        announce(agv)?;
        if began.elapsed() > Duration::from(POLL) || self.has_logged(line, OFF) {
            return Ok(None);
        }
        let stopped = self.stopped(line)?;
        let ends = |event: &UnitEvent| matches!(event, UnitEvent::LeaseEnded { function, .. } if function == "go_to");
        let reported = manager.event("end of the lease", ends)?;
        let expired = matches!(reported, UnitEvent::LeaseEnded { why: LeaseEnd::Expired, .. });
        ensure!(expired, "the manager was told {reported:?}; the board logged{}", self.log(line));
        // In which the other call would have ended as well.
        std::thread::sleep(STANDS);
        Ok(Some(stopped))
    }

    /// The manager drops the guard of a call that its process would renew.
    pub(super) fn guard_is_dropped(&self, dice: &mut fastrand::Rng) -> Result<Stop> {
        let manager = Manager::start(&self.keys)?;
        let mut unheard = 0;
        for () in tries() {
            let agv = manager.meet(&self.who)?;
            let line = self.board.line();
            let wanted = RequestOptions::renewing(Renew::Process);
            let held = match agv.call("go_to", &mut at([9_000, 0])?).with(wanted).hold().wait() {
                Err(error) if is_of_a_busy_host(&error.error) => continue,
                held => held?,
            };
            let line = self.board.logs_behind(line, ON)?;
            pause(dice);
            announce(&agv)?;
            if self.has_logged(line, OFF) {
                continue;
            }
            drop(held);
            let (behind, stop) = self.stopped(line)?;
            self.stands(&agv, line, behind)?;
            if stop.heard > 0 {
                return Ok(stop);
            }
            unheard += 1;
            ensure!(unheard < UNHEARD, "{UNHEARD} times no datagram that releases came first");
        }
        bail!("for {BUSY:?} no lease was renewed in time")
    }
}

/// A loop that holds another call of the board until it is told to end, and whether the board holds it still.
fn continues(manager: &Manager, agv: &Peer, is_held: &SyncSender<()>, ends: &AtomicBool) -> Result<bool> {
    let (mut heart, deadline) = (manager.system.heart(PERIOD), Instant::now() + LONG);
    let held = loop {
        heart.beat();
        match agv.call(CREEP, &mut arguments(0, 0)?).renewing(heart.renew()).hold().wait() {
            Err(error) if is_of_a_busy_host(&error.error) && Instant::now() < deadline => {}
            held => break held.context(CREEP)?,
        }
    };
    is_held.send(())?;
    while !ends.load(Ordering::Acquire) {
        comes_round(&mut heart, ROUND);
    }
    Ok(held.is_held())
}

fn comes_round(heart: &mut Heart, span: Duration) {
    let until = Instant::now() + span;
    while let Some(left) = until.checked_duration_since(Instant::now()) {
        heart.beat();
        std::thread::sleep(left.min(ROUND));
    }
}
