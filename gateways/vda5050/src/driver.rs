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
/// While a write takes longer, nothing is renewed: the vehicle stops.
const STUCK: Duration = Duration::from_secs(1);
/// After a write has failed, the next one begins so much later.
const WRITTEN_AGAIN: Duration = Duration::from_millis(200);

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
    /// How often the record has changed, and how many of these changes are on disk.
    changes: u64,
    kept: u64,
    /// The changes that are being written, and since when.
    writing: Option<(u64, Duration)>,
    /// The last write failed, and the next one begins then.
    failed_until: Option<Duration>,
    /// A command that is told once so many changes are on disk.
    held: Option<(Command, u64)>,
    asked: Option<Duration>,
    answered: Duration,
    is_silent: bool,
    failed: Option<String>,
}

impl<V: Vehicle, K: Keep> Driver<V, K> {
    /// Nothing is asked or told yet.
    pub const fn new(machine: Machine, vehicle: V, record: K) -> Self {
        let (asked, answered, is_silent, failed) = (None, Duration::ZERO, false, None);
        let (changes, kept, writing, failed_until, held) = (0, 0, None, None, None);
        Self {
            machine,
            vehicle,
            record,
            changes,
            kept,
            writing,
            failed_until,
            held,
            asked,
            answered,
            is_silent,
            failed,
        }
    }

    /// The side to the vehicle.
    pub const fn vehicle_mut(&mut self) -> &mut V {
        &mut self.vehicle
    }

    /// Asks the vehicle if that is due, and tells it what follows, once that is on disk. A stop waits for no disk. No state may be
    /// published unless [`is_kept`](Self::is_kept) afterwards.
    pub fn turn(&mut self, now: Duration) -> io::Result<()> {
        self.tell_stops(now);
        self.ask(now);
        self.tell_stops(now);
        self.machine.reserve_header_ids();
        loop {
            let is_kept = self.keep(now)?;
            if self.held.as_ref().is_some_and(|(_, changes)| *changes > self.kept) {
                return Ok(());
            }
            // What was heard while the disk was slow may have changed what the vehicle is to do.
            let held = self.held.take().map(|(command, _)| command).filter(|command| self.machine.is_wanted(command));
            let command = match held {
                Some(command) => command,
                None if !is_kept => return Ok(()),
                None => match self.machine.next(now) {
                    Some(command) => command,
                    None => break,
                },
            };
            self.note_changes();
            if !command.is_stop() && self.changes > self.kept && is_kept {
                self.held = Some((command, self.changes));
                continue;
            }
            if !self.tell(&command, now) {
                break;
            }
        }
        self.keep(now).map(drop)
    }

    fn tell_stops(&mut self, now: Duration) {
        while let Some(stop) = self.machine.next_stop(now)
            && self.tell(&stop, now)
        {}
    }

    /// Whether the vehicle has done it.
    fn tell(&mut self, command: &Command, now: Duration) -> bool {
        let answer = self.vehicle.tell(command);
        let is_done = answer.is_ok();
        match &answer {
            Err(failure) => self.failed = Some(format!("{}: {failure}", command.word())),
            // A drive that is refused is given up each time, and refused again for the same reason.
            Ok(()) if command.is_stop() => {}
            Ok(()) => self.failed = None,
        }
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

    /// Whether all that has changed is on disk.
    pub const fn is_kept(&self) -> bool {
        self.changes == self.kept
    }

    /// Whether the disk takes too long, or refuses: nothing may be renewed whose end could not be kept.
    pub fn is_stuck(&self, now: Duration) -> bool {
        let is_late = |(_, since): (u64, Duration)| now.saturating_sub(since) >= STUCK;
        self.failed_until.is_some() || self.writing.is_some_and(is_late)
    }

    /// Writes the record if it has changed, and waits for the disk a little. Whether all changes are written.
    pub fn keep(&mut self, now: Duration) -> io::Result<bool> {
        self.note_changes();
        if self.writing.is_none() && !self.is_kept() && self.failed_until.is_none_or(|until| now >= until) {
            let started = self.record.start(self.machine.record());
            self.noted(started, now)?;
            self.writing = Some((self.changes, now));
        }
        if let Some((changes, _)) = self.writing
            && let Some(result) = self.record.ended()
        {
            self.writing = None;
            self.noted(result, now)?;
            (self.kept, self.failed_until) = (changes, None);
        }
        self.vehicle.beat();
        Ok(self.is_kept())
    }

    fn note_changes(&mut self) {
        self.changes += u64::from(self.machine.take_changed());
    }

    fn noted(&mut self, result: io::Result<()>, now: Duration) -> io::Result<()> {
        if result.is_err() {
            self.failed_until = Some(now + WRITTEN_AGAIN);
        }
        result
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
