//! Calls of one vehicle, in a thread of its own: one that does not answer holds up no other one, and not the manager's loop.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use cara_std::{CallError, Peer, Renew, RequestOptions};

use super::Desk;
use crate::map::Cell;
use cara_apps::warehouse::{Place, TransportClient};

/// How long a call may take.
const PATIENCE: Duration = Duration::from_secs(1);

/// What a vehicle is to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Command {
    /// Tell where it is.
    Place,
    /// Drive into a cell.
    Advance(Cell),
    /// Take the parcel of an order.
    Load(usize),
    /// Put it down.
    Unload(usize),
    /// May drive again; a fault has been mended or was none.
    Reset { mended: bool },
}

impl Command {
    pub(super) const fn word(self) -> &'static str {
        match self {
            Self::Place => "place",
            Self::Advance(_) => "advance",
            Self::Load(_) => "load",
            Self::Unload(_) => "unload",
            Self::Reset { .. } => "reset",
        }
    }
}

/// What it has answered.
#[derive(Clone, Copy, Debug)]
pub(super) enum Answer {
    Place(Place),
    /// The number of the move that has begun.
    Moves(i64),
    Done,
}

/// What has become of a command.
#[derive(Debug)]
pub(super) struct Outcome {
    pub(super) vehicle: usize,
    pub(super) command: Command,
    pub(super) answer: Result<Answer, CallError>,
    pub(super) took: Duration,
}

/// Starts the thread; it ends when what is returned is dropped. What moves goes on while the loop beats that `renew` names.
pub(super) fn start(vehicle: usize, peer: Peer<Desk>, renew: Renew, outcomes: Sender<Outcome>) -> Sender<Command> {
    let (sender, commands) = channel();
    std::thread::spawn(move || drive(vehicle, &peer, renew, &commands, &outcomes));
    sender
}

fn drive(vehicle: usize, peer: &Peer<Desk>, renew: Renew, commands: &Receiver<Command>, outcomes: &Sender<Outcome>) {
    let options = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::new() };
    let asked = TransportClient::at(peer).with(options);
    let driven = TransportClient::at(peer).with(options).renewing(renew);
    for command in commands {
        let began = Instant::now();
        let answer = match command {
            Command::Place => asked.place().wait().map(Answer::Place),
            Command::Advance(cell) => driven.advance(cell.numbers()).wait().map(Answer::Moves),
            Command::Load(order) => asked.load(order as i64).wait().map(|()| Answer::Done),
            Command::Unload(order) => asked.unload(order as i64).wait().map(|()| Answer::Done),
            Command::Reset { mended } => asked.reset(mended).wait().map(|()| Answer::Done),
        };
        let outcome = Outcome { vehicle, command, answer, took: began.elapsed() };
        if outcomes.send(outcome).is_err() {
            return;
        }
    }
}
