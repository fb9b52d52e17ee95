//! The motor of a vehicle: on while an order lives, slowing down otherwise. It measures each stop itself.

use core::fmt;
use core::time::Duration;

use cara_core::services::lease::Stage;

use super::{Body, LEASE_MS, RAMP};

/// How often the loop of the motors comes round.
pub const TICK: Duration = Duration::from_millis(20);

/// What ended a motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// A service, or a fault.
    Report,
    /// The unit was switched off.
    Off,
    /// Nobody wanted it any more: the manager or the link has gone.
    Lease,
}

impl Cause {
    const fn word(self) -> &'static str {
        match self {
            Self::Report => "told",
            Self::Off => "off",
            Self::Lease => "lease",
        }
    }

    /// Within what time it is to stand: from the moment of the cause, which for a lease is the last sign that the manager wanted
    /// the motion.
    const fn bound(self) -> Duration {
        match self {
            Self::Report | Self::Off => RAMP.saturating_add(TICK),
            Self::Lease => Duration::from_millis(LEASE_MS).saturating_add(RAMP).saturating_add(TICK),
        }
    }
}

#[derive(Clone, Copy, Debug)]
struct Stopping {
    cause: Cause,
    since: Duration,
    /// How much later than due the loop has come round meanwhile.
    held_up: Duration,
}

/// A stop, from its cause to standing still.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stop {
    /// What ended the motion.
    pub cause: Cause,
    /// From the cause until it stood.
    pub took: Duration,
    /// How long the machine has held the loop up meanwhile, which no vehicle with a real motor's loop would see.
    pub held_up: Duration,
}

impl fmt::Display for Stop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let micros = |span: Duration| span.as_micros();
        let Self { cause, took, held_up } = self;
        write!(f, "stop {} {} {} {}", cause.word(), micros(*took), micros(cause.bound()), micros(*held_up))
    }
}

/// A motor. Times are since any moment that stays the same.
#[derive(Clone, Debug)]
pub struct Motor {
    on: bool,
    /// The last sign that the motion is wanted.
    wanted: Duration,
    /// When a service had it stop, until it is driven again.
    reported: Option<Duration>,
    stopping: Option<Stopping>,
}

/// What a turn of the loop led to.
#[derive(Debug, Default)]
pub struct Turned {
    /// It is in the middle of its cell.
    pub arrived: bool,
    /// It has been stopped on its way.
    pub stopped: Option<Stop>,
}

impl Motor {
    /// One that is off.
    pub const fn new() -> Self {
        Self { on: false, wanted: Duration::ZERO, reported: None, stopping: None }
    }

    /// A service, or a fault, has it stop.
    pub const fn stop(&mut self, now: Duration) {
        self.reported = Some(now);
    }

    /// A turn of the loop, `elapsed` behind the last one. `left` is of the lease; `off` is when the unit was switched off.
    pub fn turn(
        &mut self,
        now: Duration,
        elapsed: Duration,
        (stage, left): (Stage, Option<Duration>),
        off: Option<Duration>,
        station: bool,
        body: &mut Body,
    ) -> Turned {
        // What was decided at the last turn has lasted until now.
        let arrived = body.step(elapsed, self.on, station);
        if let Some(stopping) = &mut self.stopping {
            stopping.held_up += elapsed.saturating_sub(TICK);
        }
        self.on = stage == Stage::Live;
        if self.on {
            let lease = Duration::from_millis(LEASE_MS);
            self.wanted = now.saturating_sub(lease.saturating_sub(left.unwrap_or(lease)));
            self.reported = None;
        } else if self.stopping.is_none() && !body.stands() {
            let (cause, since) = match (off, self.reported.take()) {
                (Some(off), _) => (Cause::Off, off),
                (None, Some(reported)) => (Cause::Report, reported),
                (None, None) => (Cause::Lease, self.wanted),
            };
            self.stopping = Some(Stopping { cause, since, held_up: elapsed.saturating_sub(TICK) });
        }
        // One that is driven on before it stands is judged by the time until then.
        let is_on = self.on;
        let ended = self.stopping.take_if(|_| is_on || body.stands());
        let stopped =
            ended.map(|Stopping { cause, since, held_up }| Stop { cause, took: now.saturating_sub(since), held_up });
        Turned { arrived, stopped }
    }
}

impl Default for Motor {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::{Cause, Motor, Stop, TICK};
    use crate::warehouse::{Body, Cell, LEASE_MS, RAMP};
    use cara_core::services::lease::Stage;
    use core::time::Duration;

    const START: Cell = Cell { x: 1, y: 1 };

    /// Drives for some turns, then turns with another stage until it stands. What it measured.
    fn stopped(reported: bool, off: bool, tick: Duration) -> Stop {
        let mut body = Body::new(START, 100.0);
        body.enter(Cell { x: 2, y: 1 });
        let mut now = Duration::from_secs(7);
        let mut motor = Motor::new();
        let left = Duration::from_millis(LEASE_MS) - TICK;
        for _ in 0..25 {
            now += TICK;
            let turned = motor.turn(now, TICK, (Stage::Live, Some(left)), None, false, &mut body);
            assert!(!turned.arrived && turned.stopped.is_none());
        }
        let off = off.then_some(now);
        if reported {
            motor.stop(now);
        }
        for _ in 0..100 {
            now += tick;
            let turned = motor.turn(now, tick, (Stage::Stopping, None), off, false, &mut body);
            if let Some(stop) = turned.stopped {
                assert!(body.stands() && body.at() == START);
                return stop;
            }
        }
        panic!("it does not stand");
    }

    #[test]
    fn a_stop_is_measured_from_its_cause() {
        let reported = stopped(true, false, TICK);
        assert_eq!((reported.cause, reported.held_up), (Cause::Report, Duration::ZERO));
        assert!(reported.took > Duration::from_millis(400) && reported.took <= RAMP, "{reported:?}");
        assert_eq!(stopped(true, true, TICK).cause, Cause::Off);
        // From the last sign, a tick before the last turn that was on.
        let lease = stopped(false, false, TICK);
        assert_eq!((lease.cause, lease.took), (Cause::Lease, reported.took + TICK));
    }

    #[test]
    fn what_holds_the_loop_up_is_told_apart() {
        let late = stopped(true, false, 3 * TICK);
        assert!(late.held_up >= 16 * TICK, "{late:?}");
        assert!(late.took <= late.cause.bound() + late.held_up);
    }

    #[test]
    fn one_that_stands_has_no_stop() {
        let mut body = Body::new(START, 100.0);
        let turned = Motor::new().turn(Duration::ZERO, TICK, (Stage::Dead, None), None, false, &mut body);
        assert!(turned.stopped.is_none() && !turned.arrived);
    }
}
