//! What the manager knows of a vehicle, and how that changes with what it hears.

use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use cara_std::{Error, Peer, Subscription};

use super::Desk;
use super::driver::Command;
use crate::map::Cell;
use cara_apps::warehouse::{FAULT, Place};

/// A vehicle that answered badly or moves on its own is asked again after so long.
const AGAIN: Duration = Duration::from_millis(150);
/// Poses are asked for so far apart.
const POSE_EVERY: Duration = Duration::from_millis(50);
const CHARGE_EVERY: Duration = Duration::from_secs(1);
/// A moving vehicle that says nothing for so long is asked.
const SILENT: Duration = Duration::from_secs(2);

/// What can be done with a vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    /// It is where it is, and is to be asked from then on, if it is there.
    Lost(Instant),
    /// It is asked where it is.
    Asked,
    /// It stands in the middle of a cell.
    Ready,
    /// It is told to drive.
    Sent,
    /// It drives, by the move of this number.
    Moves(i64, Instant),
    /// It takes or puts down a parcel.
    Handles,
    /// It is stopped; who by, and why.
    Stopped { by: u32, reason: u16 },
}

/// What a vehicle has to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Job {
    Idle,
    /// Drive to the parcel of an order.
    Fetch(usize),
    /// Carry it.
    Carry(usize),
    /// Charge at this station.
    Charge(Cell),
}

/// A vehicle.
pub(super) struct Known {
    pub(super) name: String,
    pub(super) peer: Peer<Desk>,
    pub(super) state: State,
    /// The cells that it may be in: where it is, and where it drives to. `None` where nothing is known of it.
    pub(super) cells: Option<[Cell; 2]>,
    pub(super) job: Job,
    /// Since when it has its job's goal.
    pub(super) since: Instant,
    /// It is to be reset, and whether that has been mended.
    pub(super) reset: Option<bool>,
    /// When the mechanic was called.
    pub(super) mechanic: Option<Instant>,
    /// Its thread asks it where it is, or is going to.
    is_asked: bool,
    commands: Sender<Command>,
    pose: Option<Subscription<Desk>>,
    charge: Option<Subscription<Desk>>,
}

impl std::fmt::Display for Known {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { name, state, job, cells, reset, .. } = self;
        let (charge, connected) = (self.charge(), if self.peer.is_connected() { "" } else { ", away" });
        write!(f, "{name} {state:?} {job:?} {cells:?}, charge {charge:?}, to be reset {reset:?}{connected}")
    }
}

impl Known {
    pub(super) fn new(name: String, peer: Peer<Desk>, cells: Option<[Cell; 2]>, commands: Sender<Command>) -> Self {
        let now = Instant::now();
        Self {
            name,
            peer,
            state: State::Lost(now),
            cells,
            job: Job::Idle,
            since: now,
            reset: None,
            mechanic: None,
            is_asked: false,
            commands,
            pose: None,
            charge: None,
        }
    }

    /// Has its thread do something.
    pub(super) fn command(&self, command: Command) {
        // The thread lives as long as this.
        let _ = self.commands.send(command);
    }

    pub(super) fn do_job(&mut self, job: Job) {
        (self.job, self.since) = (job, Instant::now());
    }

    pub(super) fn lost(&mut self) {
        self.state = State::Lost(Instant::now() + AGAIN);
    }

    /// Percent.
    pub(super) fn charge(&self) -> Option<f64> {
        self.charge.as_ref()?.latest()?.value("percent").ok()
    }

    /// Looks what has changed by itself: whether it is there, and what its pose says.
    pub(super) fn look(&mut self, now: Instant) {
        if !self.peer.is_connected() {
            if !matches!(self.state, State::Asked | State::Sent | State::Handles) {
                self.state = State::Lost(now);
            }
            return;
        }
        match self.state {
            // One question at a time: the answer to an earlier one may be older than the last command to drive.
            State::Lost(again) if again <= now && !self.is_asked => self.ask(),
            State::Moves(moves, began) => self.look_at_pose(moves, began),
            _ => {}
        }
    }

    fn ask(&mut self) {
        if self.pose.is_none() {
            let subscribe = |name, every| self.peer.stream(name).map(|stream| stream.subscribe(every)).ok();
            (self.pose, self.charge) = (subscribe("pose", POSE_EVERY), subscribe("charge", CHARGE_EVERY));
        }
        // Without its list it cannot be asked yet.
        if self.pose.is_some() {
            (self.state, self.is_asked) = (State::Asked, true);
            self.command(Command::Place);
        }
    }

    /// The question where it is has ended. Returns whether the answer counts: nothing else has been heard of it or begun since.
    pub(super) fn was_asked(&mut self) -> bool {
        self.is_asked = false;
        self.state == State::Asked
    }

    fn look_at_pose(&mut self, moves: i64, began: Instant) {
        let Some(sample) = self.pose.as_ref().and_then(Subscription::latest) else { return };
        if began.elapsed() > SILENT && std::time::Duration::from(sample.age()) > SILENT {
            self.lost();
        }
        let values = sample.values();
        let read = || -> Result<_, Error> {
            let is_news = values.variable::<i64>("moves")? >= moves && values.variable("stands")?;
            let cells: ([i64; 2], [i64; 2]) = (values.variable("at")?, values.variable("next")?);
            Ok(is_news.then_some(cells))
        };
        match read() {
            Ok(None) => {}
            Ok(Some((at, next))) if at == next && Cell::of_numbers(at) == self.cells.map(|[_, next]| next) => {
                self.cells = Cell::of_numbers(at).map(|at| [at, at]);
                self.state = State::Ready;
            }
            // It stands on its way, or somebody else has driven it.
            Ok(Some(_)) | Err(_) => self.lost(),
        }
    }

    /// It has told where it is. Where it stands between cells it is to drive on into the one that it was entering, whose number
    /// is returned.
    pub(super) fn is_at(&mut self, place: Place) -> Option<Cell> {
        let cells = Cell::of_numbers(place.at).zip(Cell::of_numbers(place.next));
        let Some((at, next)) = cells else {
            self.lost();
            return None;
        };
        self.cells = Some([at, next]);
        if !place.stands {
            self.lost();
            return None;
        }
        if at == next {
            self.state = State::Ready;
            return None;
        }
        self.state = State::Sent;
        Some(next)
    }

    /// It is stopped until it is reset.
    pub(super) fn stopped(&mut self, by: u32, reason: u16) {
        self.state = State::Stopped { by, reason };
        if by != 0 {
            println!("stopped {}", self.name);
        }
    }

    /// Whether it stands at its station.
    pub(super) fn is_charging(&self) -> bool {
        matches!(self.job, Job::Charge(station) if self.cells == Some([station, station]))
    }

    /// Whether it waits for the mechanic.
    pub(super) fn is_faulty(&self) -> bool {
        self.state == State::Stopped { by: 0, reason: FAULT }
    }
}
