//! Stops on purpose: by a function that stops, and by the vehicle itself. What stands then moves by no call before a reset.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use anyhow::{Result, bail, ensure};
use cara_apps::agv::{BUMPER, BUMPER_IS_PRESSED};
use cara_std::{Error, Parameters, Peer, Priority, RequestOptions, ServiceError};

use super::Stop;
use super::inject::{BUSY, Drive, EmulatedBoard, OFF, UNHEARD, tries};
use crate::manager::{Manager, at, fault, outcome, patiently, reset};

/// Callers that keep the board busy.
const CALLERS: usize = 4;
/// Calls that have ended before the stop is sent.
const FLOOD: u64 = 8;
/// What [`fault`] asks the image for.
const PRESS: i64 = 6;
const FREE: i64 = 7;

impl EmulatedBoard {
    /// The manager's other calls fill the link and the board while it stops the vehicle.
    pub(super) fn is_stopped(&self, dice: &mut fastrand::Rng) -> Result<Stop> {
        let manager = Manager::start(&self.keys)?;
        let mut unheard = 0;
        for () in tries() {
            let Drive { agv, line } = self.drive(&manager, dice)?;
            let is_late = self.is_stopped_in_a_flood(&agv, line)?;
            let (behind, stop) = self.stopped(line)?;
            self.is_latched(&agv, Error::Inhibited { by: 1, reason: 0 })?;
            self.stands(&agv, line, behind)?;
            reset(&agv)?;
            self.stands(&agv, line, behind)?;
            if !is_late && stop.heard > 0 {
                return Ok(stop);
            }
            unheard += u32::from(!is_late);
            ensure!(unheard < UNHEARD, "{UNHEARD} times no datagram that stops came first");
        }
        bail!("for {BUSY:?} no lease was renewed in time")
    }

    /// Whether this machine was too busy to renew the lease until then.
    fn is_stopped_in_a_flood(&self, agv: &Peer, line: usize) -> Result<bool> {
        let (floods, calls) = (AtomicBool::new(true), AtomicU64::new(0));
        std::thread::scope(|scope| {
            for _ in 0..CALLERS {
                scope.spawn(|| flood(agv, &floods, &calls));
            }
            while calls.load(Ordering::Relaxed) < FLOOD {
                std::thread::yield_now();
            }
            // As an emergency too, or it would wait behind the flood.
            let urgent = RequestOptions { priority: Some(Priority::Emergency), ..RequestOptions::default() };
            let announced = patiently(|| agv.call("fault", &mut fault(0)?).with(urgent).wait().map_err(Error::from));
            let is_late = self.has_logged(line, OFF);
            let stopped = announced.and_then(|()| patiently(|| agv.block_request("stop", &mut Parameters::new())));
            floods.store(false, Ordering::Relaxed);
            stopped.map(|()| is_late)
        })
    }

    /// Its bumper is pressed, which an interrupt sees.
    pub(super) fn stops_itself(&self, dice: &mut fastrand::Rng) -> Result<Stop> {
        let manager = Manager::start(&self.keys)?;
        let Drive { agv, line } = self.drive(&manager, dice)?;
        patiently(|| agv.block_request("fault", &mut fault(PRESS)?))?;
        let (behind, stop) = self.stopped(line)?;
        let inhibited = Error::Inhibited { by: 0, reason: BUMPER };
        self.is_latched(&agv, inhibited)?;
        let refused = outcome(|| agv.block_request("reset", &mut Parameters::new()));
        let pressed = Err(Error::Service(ServiceError::Failed(BUMPER_IS_PRESSED)));
        ensure!(refused == pressed, "with its bumper pressed the reset came to {refused:?}");
        patiently(|| agv.block_request("fault", &mut fault(FREE)?))?;
        self.is_latched(&agv, inhibited)?;
        self.stands(&agv, line, behind)?;
        reset(&agv)?;
        self.stands(&agv, line, behind)?;
        Ok(stop)
    }

    /// A call that would move it is refused.
    fn is_latched(&self, agv: &Peer, latch: Error) -> Result<()> {
        let mut far = at([-9_000, 0])?;
        let moved = outcome(|| agv.block_request("go_to", &mut far));
        ensure!(moved == Err(latch), "a call behind the stop came to {moved:?}");
        Ok(())
    }
}

/// Calls without a pause, with arguments and results of several hundred bytes.
fn flood(agv: &Peer, floods: &AtomicBool, calls: &AtomicU64) {
    let text = "a".repeat(400);
    while floods.load(Ordering::Relaxed) {
        let mut echo = Parameters::<1024>::sized();
        let set = echo.add_string("text", 400).and_then(|()| echo.set_value("text", text.as_str()));
        // Refused ones flood it as well.
        let _ = set.and_then(|()| agv.block_request("echo", &mut echo));
        calls.fetch_add(1, Ordering::Relaxed);
    }
}
