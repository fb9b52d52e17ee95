//! Drives a [`Machine`]: writes its record, then tells its vehicle.

use std::io;
use std::time::Duration;

use crate::machine::Machine;
use crate::record::Keep;
use crate::state::{Command, Failure, Status};

/// While it moves or handles something, the vehicle is asked so often.
const ASKED_BUSY: Duration = Duration::from_millis(100);
/// And while it is idle.
const ASKED_IDLE: Duration = Duration::from_millis(500);
/// A vehicle that has not said for so long how it is counts as lost, though its link lives.
const SILENT: Duration = Duration::from_secs(2);

/// The side to the vehicle.
pub trait Vehicle {
    /// How it is; `Ok(None)` without a link.
    fn status(&mut self) -> Result<Option<Status>, Failure>;
    /// Tells it something, and waits for its answer.
    fn tell(&mut self, command: &Command) -> Result<(), Failure>;
    /// The loop waits for a disk, and lives.
    fn beat(&mut self) {}
}

/// A machine with its record and its vehicle.
#[derive(Debug)]
pub struct Driver<V, K> {
    /// Decides.
    pub machine: Machine,
    vehicle: V,
    record: K,
    is_kept: bool,
    asked: Option<Duration>,
    answered: Duration,
    is_silent: bool,
    failed: Option<String>,
}

impl<V: Vehicle, K: Keep> Driver<V, K> {
    /// Nothing is asked or told yet.
    pub const fn new(machine: Machine, vehicle: V, record: K) -> Self {
        let (asked, answered, is_silent, failed) = (None, Duration::ZERO, false, None);
        Self { machine, vehicle, record, is_kept: true, asked, answered, is_silent, failed }
    }

    /// The side to the vehicle.
    pub const fn vehicle_mut(&mut self) -> &mut V {
        &mut self.vehicle
    }

    /// Asks the vehicle if that is due, and tells it what follows. After an error nothing was told that is not on disk, and no
    /// state may be published.
    pub fn turn(&mut self, now: Duration) -> io::Result<()> {
        if self.machine.must_halt(now) {
            self.tell(&Command::Halt, now);
        }
        self.ask(now);
        self.keep()?;
        while let Some(command) = self.machine.next(now) {
            if command != Command::Halt {
                self.keep()?;
            }
            if !self.tell(&command, now) {
                break;
            }
        }
        self.keep()
    }

    /// Whether the vehicle has done it.
    fn tell(&mut self, command: &Command, now: Duration) -> bool {
        let answer = self.vehicle.tell(command);
        let is_done = answer.is_ok();
        self.failed = answer.as_ref().err().map(|failure| format!("{}: {failure}", command.word()));
        self.machine.answered(command, answer, now);
        // What it does now is asked at once.
        self.asked = None;
        is_done
    }

    /// Whether the vehicle does not say how it is, though its link lives: nothing may be renewed that nobody watches.
    pub const fn is_silent(&self) -> bool {
        self.is_silent
    }

    /// Why the vehicle did not do what it was told last, if so.
    pub fn failed(&self) -> Option<&str> {
        self.failed.as_deref()
    }

    /// Writes the record if it has changed.
    pub fn keep(&mut self) -> io::Result<()> {
        self.is_kept &= !self.machine.take_changed();
        if !self.is_kept {
            self.record.keep(self.machine.record(), &mut || self.vehicle.beat())?;
            self.is_kept = true;
        }
        Ok(())
    }

    fn ask(&mut self, now: Duration) {
        let every = if self.machine.is_busy() { ASKED_BUSY } else { ASKED_IDLE };
        if self.asked.is_some_and(|asked| now.saturating_sub(asked) < every) {
            return;
        }
        self.asked = Some(now);
        match self.vehicle.status() {
            Ok(Some(status)) => {
                (self.answered, self.is_silent) = (now, false);
                self.machine.status(status);
            }
            Ok(None) => {
                (self.answered, self.is_silent) = (now, false);
                self.machine.vehicle_lost();
            }
            // It is asked again.
            Err(_) if now.saturating_sub(self.answered) < SILENT => {}
            Err(_) => {
                self.is_silent = true;
                self.machine.vehicle_lost();
            }
        }
    }
}
