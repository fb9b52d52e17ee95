//! What fails, and within which time the motors must stand then.

use anyhow::{Context, Result, ensure};
use cara_apps::agv::GO_TO_LEASE;
use cara_std::Duration;

use super::inject::EmulatedBoard;
use super::processes::Processes;
use super::{Stop, Target};
use crate::board::{Bench, Way};

/// What fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Failing {
    /// The manager's process.
    Manager {
        /// It gets no turn any more, and its connections stay open; otherwise it is killed.
        frozen: bool,
    },
    /// The manager's process gets no turn for about as long as its lease lasts, again and again.
    Turns,
    /// A loop of the manager's program, beside another one that goes on.
    Loop,
    /// The manager's program drops the guard of its call.
    Guard,
    /// The manager's process gets no turn until another one of its identity has taken over.
    Fenced,
    /// One wire of the cable is cut.
    Wire(Way),
    /// The cable is pulled.
    Cable,
    /// A task looks at its call's lease once a second, and the next call comes in between.
    Looks,
    /// A call that wants no motion takes the place of one that does.
    Replaced,
    /// A caller that waits for its answer.
    Caller {
        /// Its process is killed; otherwise it has waited for as long as it wants to.
        killed: bool,
    },
    /// The manager stops the vehicle while its other calls keep it busy.
    Flooded,
    /// The vehicle stops itself, in an interrupt.
    Bumper,
    /// Another caller wants to move the vehicle, on Linux, and then the first one wants no more.
    Held,
    /// A caller stops the vehicle, on Linux, and may not reset it.
    NoRight,
    /// Nothing gives the application's state back, on Linux.
    StateHeld,
    /// A second manager of the first one's name starts, on Linux.
    SecondManager,
    /// The board itself, by what its service does.
    Board {
        /// What the service is asked for, in turns.
        asked: &'static [i64],
        /// Why the board says that it started again.
        reason: &'static str,
    },
}

/// A kind of fault.
pub(super) struct Kind {
    pub(super) name: &'static str,
    pub(super) failing: Failing,
}

/// All of them.
pub(super) const KINDS: [Kind; 23] = [
    Kind { name: "manager killed", failing: Failing::Manager { frozen: false } },
    Kind { name: "manager frozen", failing: Failing::Manager { frozen: true } },
    Kind { name: "manager held up", failing: Failing::Turns },
    Kind { name: "loop hung", failing: Failing::Loop },
    Kind { name: "guard dropped", failing: Failing::Guard },
    Kind { name: "manager fenced", failing: Failing::Fenced },
    Kind { name: "link cut towards the board", failing: Failing::Wire(Way::ToBoard) },
    Kind { name: "link cut towards the manager", failing: Failing::Wire(Way::FromBoard) },
    Kind { name: "link cut in both directions", failing: Failing::Cable },
    Kind { name: "handler in an endless loop", failing: Failing::Board { asked: &[1], reason: "Watchdog" } },
    Kind { name: "runner starved", failing: Failing::Board { asked: &[2], reason: "Watchdog" } },
    Kind { name: "handler panics", failing: Failing::Board { asked: &[3], reason: "Panic" } },
    // By many small frames, and by a single large one.
    Kind { name: "stack overflow", failing: Failing::Board { asked: &[4, 5], reason: OVERFLOW } },
    Kind { name: "task that looks once a second", failing: Failing::Looks },
    Kind { name: "order replaced", failing: Failing::Replaced },
    Kind { name: "caller timed out", failing: Failing::Caller { killed: false } },
    Kind { name: "caller killed", failing: Failing::Caller { killed: true } },
    Kind { name: "stopped while calls flood it", failing: Failing::Flooded },
    Kind { name: "stopped by its bumper", failing: Failing::Bumper },
    Kind { name: "another holder's call, then released", failing: Failing::Held },
    Kind { name: "stopped, and reset without right", failing: Failing::NoRight },
    Kind { name: "state held for ever", failing: Failing::StateHeld },
    Kind { name: "second manager", failing: Failing::SecondManager },
];

/// What a board says behind a stack overflow.
pub(super) const OVERFLOW: &str = "StackOverflow";

impl Kind {
    /// Where it happens.
    pub(super) fn target(&self, bench: &Bench) -> Result<Box<dyn Target>> {
        Ok(match self.failing {
            Failing::StateHeld | Failing::SecondManager | Failing::Held | Failing::NoRight => Box::new(Processes),
            _ => Box::new(EmulatedBoard::new(bench)?),
        })
    }

    /// From the last sign before the fault until the motors stood.
    pub(super) fn took(&self, stop: &Stop) -> u64 {
        match self.failing {
            // The manager goes on renewing for one lease, by its own clock: where that took longer, or seems to, its
            // machine was busy.
            Failing::Wire(Way::FromBoard) => stop.announced.min(GO_TO_LEASE.as_micros() + stop.renewed),
            // Likewise, for as long as the caller waits, or until the manager asks for it: by the manager's clock.
            Failing::Caller { killed } => stop.announced.min(waits(killed) + stop.renewed),
            // From when the new call's task had its turn, by the board's clock.
            Failing::Replaced => stop.announced,
            // The lease goes on, and is not what ends the motion.
            Failing::Bumper => stop.announced,
            // The other loop's renewals go on. The beat from which the last one of this loop counts came behind the announcement.
            Failing::Loop => stop.announced,
            // From when the board took the datagram of the stop or release: the manager's machine may be late to send it.
            Failing::Flooded | Failing::Guard => stop.heard,
            _ => stop.announced.min(stop.renewed),
        }
    }
}

/// How long a caller waits for its answer.
pub(super) const TIMEOUT: Duration = Duration::from_millis(1_500);
/// How often a manager asks whether the process of a caller is there: `cara_std`'s control socket.
const ASKED: Duration = Duration::from_millis(100);

/// The longest turn of the executor while calls come faster than the board answers them.
const FLOODED: Duration = Duration::from_millis(40);

/// As the image's: in which a manager whose machine has time for it has its answer.
pub(super) const POLL: Duration = Duration::from_millis(20);

/// For so long at most the image masks interrupts, as while it logs: a tick may be late by that.
const MASKED: Duration = Duration::from_micros(500);

/// How long a manager goes on for a caller that fails, in microseconds.
fn waits(killed: bool) -> u64 {
    if killed { ASKED.as_micros() } else { TIMEOUT.as_micros() }
}

/// Within which time the motors must stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Bound {
    pub(super) micros: u64,
    /// What it is the sum of.
    pub(super) of: &'static str,
}

impl Bound {
    /// From the constants that the image has logged.
    pub(super) fn of(kind: &Kind, said: &str) -> Result<Self> {
        let lease = value(said, "lease=")?;
        let [poll, tick] = [value(said, "poll=")?, value(said, "tick=")?];
        Ok(match kind.failing {
            Failing::Board { reason: "Panic", .. } => Self { micros: tick, of: "tick" },
            // The image takes up to a tick to fill its stack.
            Failing::Board { reason: OVERFLOW, .. } => Self { micros: 2 * tick, of: "filling + tick" },
            Failing::Replaced => Self { micros: tick, of: "tick" },
            Failing::Bumper => Self { micros: MASKED.as_micros() + tick, of: "masked + tick" },
            Failing::Guard => Self { micros: poll + tick, of: "poll + tick" },
            Failing::Flooded => Self { micros: FLOODED.as_micros() + tick, of: "turn of a flood + tick" },
            Failing::Caller { killed } => {
                let of = if killed { "question + lease + poll + tick" } else { "time-out + lease + poll + tick" };
                Self { micros: waits(killed) + lease + poll + tick, of }
            }
            // The last answer, and the last renewal behind it.
            Failing::Wire(Way::FromBoard) => Self { micros: 2 * lease + poll + tick, of: "2 leases + poll + tick" },
            _ => Self { micros: lease + poll + tick, of: "lease + poll + tick" },
        })
    }
}

impl Stop {
    /// What the image has logged about one.
    pub(super) fn read(said: &str) -> Result<Self> {
        let late = value(said, "late=")?;
        let since = |name| value(said, name).map(|micros| micros.saturating_sub(late));
        Ok(Self {
            announced: since("announced=")?,
            renewed: since("renewed=")?,
            heard: since("heard=")?,
            turn: value(said, "turn=")?,
        })
    }

    /// No turn of the executor may be longer than the bound takes it to be, and no lease may last longer than it does.
    pub(super) fn check(&self, said: &str, kind: &Kind) -> Result<()> {
        let [lease, poll, tick] = ["lease=", "poll=", "tick="].map(|name| value(said, name));
        let (poll, tick) = (poll?, tick?);
        let allowed = lease? + poll + tick;
        let poll = if kind.failing == Failing::Flooded { FLOODED.as_micros() } else { poll };
        let Self { renewed, turn, .. } = self;
        ensure!(*turn <= poll, "a turn of the executor took {turn} µs, and the bound has {poll} of them");
        ensure!(*renewed <= allowed, "motors off {renewed} µs behind the last renewal, and {allowed} are allowed");
        Ok(())
    }
}

/// The number behind a name in a log line.
fn value(said: &str, name: &str) -> Result<u64> {
    let word = said.split_whitespace().find_map(|word| word.strip_prefix(name));
    word.and_then(|word| word.parse().ok()).with_context(|| format!("no `{name}` in `{said}`"))
}
