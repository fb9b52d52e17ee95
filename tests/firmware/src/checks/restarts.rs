//! Power is taken in each state of the protocol, and comes back at once or after the board has been missed.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use cara_std::{Peer, UnitEvent};

use crate::board::{Bench, Board, Who};
use crate::manager::{Manager, at, position};

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

pub(super) fn run(bench: &Bench, restarts: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start()?;
    let mut counted: BTreeMap<State, u32> = BTreeMap::new();
    for number in 0..restarts {
        let state = STATES[number as usize % STATES.len()];
        // Every second life draws the same numbers as all of these: boards without a source of noise do.
        let seed = number.is_multiple_of(2).then_some(7);
        let who = Who { seed, ..Who::agv(17) };
        manager.forget_events();
        let board = bench.board(&cable, &who)?;
        let at = || format!("restart {number}, {state:?}, seed {seed:?}");
        reach(state, &manager, &board, &who).with_context(at)?;
        board.cut_power()?;
        let long = number / STATES.len() as u32 % 2 == 1;
        if long {
            std::thread::sleep(MISSED);
        }
        let board = bench.board(&cable, &who)?;
        works(&manager, &board, &who).with_context(at)?;
        *counted.entry(state).or_default() += 1;
    }
    let links = manager.system.number_of_s_units();
    ensure!(links == 1, "{links} s_units are connected");
    Ok(format!("{restarts} restarts: {counted:?}"))
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
    manager.event("joining", |event| matches!(event, UnitEvent::Joined { peer } if peer.name() == who.name))?;
    if state == State::Joined {
        return Ok(());
    }
    let agv = manager.meet(who)?;
    match state {
        State::Calling => drop(agv.request("pos_info", &*at([0, 0])?)?),
        State::Driving => {
            agv.block_request("go_to", &mut *at([1_000, 0])?)?;
            board.logs("driving")?;
        }
        _ => {}
    }
    Ok(())
}

/// The board serves as if nothing had been: a fresh one, which stands where it began.
fn works(manager: &Manager, board: &Board, who: &Who) -> Result<()> {
    board.logs("has joined")?;
    let agv: Peer = manager.meet(who)?;
    let found = retried(|| position(&agv))?;
    ensure!(found == [0, 0], "a fresh board is at {found:?}");
    agv.block_request("go_to", &mut *at([1, 0])?)?;
    board.logs("arrived at 1 0")
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
