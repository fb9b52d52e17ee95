//! Power is taken in each state of the protocol, and comes back at once or after the board has been missed.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use cara_std::Peer;

use crate::board::{Bench, Board, Who};
use crate::manager::{Manager, at, drives, position, sets_out};

/// Where the protocol stands when power goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum State {
    /// The board has just started, and has no address.
    Starting,
    /// It has an address, and looks for its manager.
    Searching,
    /// The link is open, the list of functions has not been read.
    Joined,
    /// All is read; nothing happens.
    Idle,
    /// A call is on its way.
    Calling,
    /// It drives, and its lease is renewed.
    Driving,
}

const STATES: [State; 6] =
    [State::Starting, State::Searching, State::Joined, State::Idle, State::Calling, State::Driving];
/// Longer than three keep-alives: the manager has noticed.
const MISSED: Duration = Duration::from_secs(5);

/// How long a board is without power.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Absence {
    /// It is back before its loss was detected: the manager challenges the old link.
    Short,
    /// The manager has given it up.
    Missed,
}

/// One loss of power.
struct Loss {
    state: State,
    absence: Absence,
    /// Both lives draw the same numbers, and all such lives do: boards without a source of noise are like that.
    seed: Option<u64>,
}

impl Loss {
    /// Every 24 of them have each state with each absence, with and without a seed.
    fn of(number: u32) -> Self {
        let round = number / STATES.len() as u32;
        let seeded = (number + round + round / 2).is_multiple_of(2);
        Self {
            state: STATES[number as usize % STATES.len()],
            absence: if round.is_multiple_of(2) { Absence::Short } else { Absence::Missed },
            seed: seeded.then_some(7),
        }
    }
}

pub(super) fn run(bench: &Bench, restarts: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let mut counted: BTreeMap<(Absence, State), u32> = BTreeMap::new();
    let mut seeded = 0;
    for number in 0..restarts {
        let Loss { state, absence, seed } = Loss::of(number);
        let seed = seed.filter(|_| bench.takes_seeds());
        let who = Who { seed, ..Who::agv(17) };
        let at = || format!("restart {number}, {state:?}, {absence:?}, seed {seed:?}");
        manager.forget_events();
        let board = bench.board(&cable, &who)?;
        reach(state, &manager, &board, &who).with_context(at)?;
        board.cut_power()?;
        if absence == Absence::Missed {
            // The manager detects the loss of a board that has joined; for one that has not, wait as long.
            if state >= State::Joined { manager.missed(&who).with_context(at)? } else { std::thread::sleep(MISSED) }
        }
        let board = bench.board(&cable, &who)?;
        works(&manager, &board, &who).with_context(at)?;
        *counted.entry((absence, state)).or_default() += 1;
        seeded += u32::from(seed.is_some());
    }
    let links = manager.system.number_of_s_units();
    ensure!(links == 1, "{links} s_units are connected");
    let short: u32 =
        counted.iter().filter(|((absence, _), _)| *absence == Absence::Short).map(|(_, count)| count).sum();
    let missed = restarts - short;
    Ok(format!("{restarts} restarts, {short} not missed, {missed} missed, {seeded} with one seed: {counted:?}"))
}

fn reach(state: State, manager: &Manager, board: &Board, who: &Who) -> Result<()> {
    board.logs("started because of")?;
    if state == State::Starting {
        return Ok(());
    }
    board.logs("the address is now")?;
    if state == State::Searching {
        return Ok(());
    }
    manager.joined(who)?;
    if state == State::Joined {
        return Ok(());
    }
    let agv = manager.meet(who)?;
    match state {
        State::Calling => drop(agv.request("pos_info", &at([0, 0])?)?),
        State::Driving => {
            sets_out(&agv, [1_000, 0])?;
            board.logs("driving")?;
        }
        _ => {}
    }
    Ok(())
}

/// The board serves as if nothing had been: a fresh one, which stands where it began.
pub(crate) fn works(manager: &Manager, board: &Board, who: &Who) -> Result<()> {
    board.logs("has joined")?;
    let agv: Peer = manager.meet(who)?;
    let found = retried(|| position(&agv))?;
    ensure!(found == [0, 0], "a fresh board is at {found:?}");
    drives(board, [1, 0], || sets_out(&agv, [1, 0]))
}

/// A call may meet the old link's end: it says so, and the next one is for the new link.
fn retried<R>(mut call: impl FnMut() -> Result<R>) -> Result<R> {
    let first = call();
    if first.is_ok() {
        return first;
    }
    std::thread::sleep(Duration::from_millis(500));
    call()
}
