//! Calls that are seconds apart: whatever waits, waits side by side.

use std::time::Duration;

use anyhow::{Context, Result};
use cara_bench_ends::Order;

use super::plan::Group;
use super::response::{Cells, rows};
use crate::lanes::side_by_side;
use crate::pair::{Pair, Setting};
use crate::peers::Contender;
use crate::progress::{Progress, is_stopped};
use crate::results::Response;
use crate::statistics::Cell;

/// Pairs that start at the same time.
const AT_A_TIME: usize = 8;
/// The furthest that two calls of one turn are apart at its beginning.
const APART: Duration = Duration::from_millis(50);

/// A pair, and the cell of each of its clients.
struct Seat {
    pair: Pair,
    places: Vec<Place>,
    orders: Vec<Order>,
}

/// Of a cell.
#[derive(Clone, Copy)]
struct Place {
    group: usize,
    order: usize,
    peer: usize,
}

/// All cells of a distribution wait together. In distribution 1 every cell of every place has a pair of its own; in
/// distribution 2 the pair of one peer has a client per size, so that there are five further nodes for each peer only.
pub(super) fn measure(groups: &[Group], results: &mut Vec<Response>) -> Result<()> {
    let (alone, among): (Vec<_>, Vec<_>) = groups.iter().partition(|group| group.setting.distribution == 1);
    let outcome = if alone.is_empty() { Ok(()) } else { together(&alone, false, results) };
    among.into_iter().fold(outcome, |outcome, group| outcome.and(together(&[group], true, results)))
}

/// The groups' cells, all at once; what there is has rows even where something fails.
fn together(groups: &[&Group], shares_pair: bool, results: &mut Vec<Response>) -> Result<()> {
    if is_stopped() {
        return Ok(());
    }
    let mut cells: Vec<Cells> = groups.iter().map(|group| empty(group)).collect();
    let outcome = turns(groups, shares_pair, &mut cells);
    groups.iter().zip(&cells).for_each(|(group, cells)| results.extend(rows(group, cells)));
    outcome
}

fn empty(group: &Group) -> Cells {
    group.orders.iter().map(|_| group.peers.iter().map(|_| Cell::default()).collect()).collect()
}

fn turns(groups: &[&Group], shares_pair: bool, cells: &mut [Cells]) -> Result<()> {
    let mut seats = seats(groups, shares_pair)?;
    let rounds = groups.iter().map(|group| group.rounds).max().unwrap_or(0);
    let what = format!("echoes: seconds apart, distribution {}", if shares_pair { 2 } else { 1 });
    let bar = Progress::new(&what, rounds as usize);
    for _ in 0..rounds {
        if is_stopped() {
            return Ok(());
        }
        turn(&mut seats, cells).context("calls that are seconds apart")?;
        bar.step();
    }
    Ok(())
}

fn seats(groups: &[&Group], shares_pair: bool) -> Result<Vec<Seat>> {
    let mut wanted: Vec<(&Contender, Setting, Vec<Place>)> = Vec::new();
    for (number, group) in groups.iter().enumerate() {
        for (peer, contender) in group.peers.iter().enumerate() {
            let places = (0..group.orders.len()).map(|order| Place { group: number, order, peer });
            match shares_pair {
                true => wanted.push((contender, group.setting, places.collect())),
                false => wanted.extend(places.map(|place| (contender, group.setting, vec![place]))),
            }
        }
    }
    // Cells that are compared call one after the other.
    wanted.sort_by_key(|(.., places)| places.first().map(|place| (place.group, place.order)));
    let order = |place: &Place| Some(groups.get(place.group)?.orders.get(place.order)?.clone());
    let start = |(contender, setting, places): (&Contender, Setting, Vec<Place>)| {
        let pair = Pair::with_clients(places.len(), contender, setting)?;
        Ok(Seat { pair, orders: places.iter().filter_map(order).collect(), places })
    };
    side_by_side(wanted, AT_A_TIME, start).into_iter().collect()
}

/// One turn of these seats at the same time: every client calls while the others wait.
fn turn(seats: &mut [Seat], cells: &mut [Cells]) -> Result<()> {
    let clients: usize = seats.iter().map(|seat| seat.orders.len()).sum();
    let pause_ms = seats.iter().flat_map(|seat| &seat.orders).map(|order| order.pause_ms).max().unwrap_or(0);
    let apart = (Duration::from_millis(pause_ms) / clients.max(1) as u32).min(APART).as_micros() as u64;
    let mut delays = (0..).map(|client: u64| client * apart);
    let begin = |seat: &mut Seat| {
        let delayed = seat.orders.iter().zip(&mut delays).map(|(order, delay_us)| Order { delay_us, ..order.clone() });
        let orders: Vec<Order> = delayed.collect();
        seat.pair.begin_blocks(&orders)
    };
    let started = seats.iter_mut().map(begin).collect::<Result<Vec<_>>>()?;
    for (seat, used) in seats.iter_mut().zip(started) {
        for (place, turn) in seat.places.iter().zip(seat.pair.end_blocks(used)?) {
            let cells = cells.get_mut(place.group).and_then(|cells| cells.get_mut(place.order));
            cells.and_then(|cells| cells.get_mut(place.peer)).context("a cell for each place")?.turns.push(turn);
        }
    }
    Ok(())
}
