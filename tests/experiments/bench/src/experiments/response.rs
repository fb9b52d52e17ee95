//! Response time: echo calls of each peer in each cell, turn by turn.

use anyhow::{Context, Result};

use super::plan::{Group, Plan};
use crate::lanes::side_by_side;
use crate::pair::{Pair, Setting};
use crate::peers::Contender;
use crate::progress::{Progress, is_stopped, was_stopped};
use crate::results::{Mode, Response, micros, ratio};
use crate::statistics::Cell;
use cara_bench_ends::Order;

/// Cells by order, then by peer; the first peer is the floor.
pub(super) type Cells = Vec<Vec<Cell>>;

/// All groups, also after one that fails; the rows of what there is.
pub(super) fn measure(plan: &Plan, rows: &mut Vec<Response>) -> Result<()> {
    let mut outcome = Ok(());
    for (index, group) in plan.response.iter().enumerate() {
        if is_stopped() {
            break;
        }
        let Setting { pin, distribution, .. } = group.setting;
        let of = format!("{} of {}", index + 1, plan.response.len());
        let mut cells = Cells::new();
        let ended = turns(group, &mut cells, &format!("response {of}: {pin}, distribution {distribution}"));
        rows.extend(self::rows(group, &cells));
        outcome = outcome.and(unless_stopped(ended));
    }
    outcome
}

/// A failure that a run need not end with; one that comes from its being stopped is noticed before anything else begins.
fn unless_stopped(outcome: Result<()>) -> Result<()> {
    if outcome.is_err() {
        was_stopped();
    }
    outcome
}

/// Every peer in every cell, once per turn.
pub(super) fn turns(group: &Group, cells: &mut Cells, what: &str) -> Result<()> {
    let bar = Progress::new(what, group.rounds as usize * group.orders.len());
    let mut pairs = start(&group.peers, group.setting)?;
    connect(group, &mut pairs)?;
    *cells = group.orders.iter().map(|_| pairs.iter().map(|_| Cell::default()).collect()).collect();
    let mut outcome = Ok(());
    for round in 0..group.rounds as usize {
        for (order, cells) in group.orders.iter().zip(cells.iter_mut()) {
            if is_stopped() {
                return Ok(());
            }
            let shared = order.pause_ms > 0 && group.setting.distribution == 1;
            let turn = match shared {
                true => spaced_turn(&group.peers, &mut pairs, order, round, cells),
                false => turn(&group.peers, &mut pairs, order, round, cells),
            };
            outcome = outcome.and(unless_stopped(turn));
            bar.step();
        }
    }
    outcome
}

/// The processes of all contenders, started at the same time; none for another system that does not start.
pub(super) fn start(contenders: &[Contender], setting: Setting) -> Result<Vec<Option<Pair>>> {
    let start = |contender: &Contender| match contender.works() {
        true => contender.tolerate(Pair::start(contender, setting)),
        false => Ok(None),
    };
    side_by_side(contenders.iter().collect(), contenders.len(), start).into_iter().collect()
}

/// All pairs connect and warm up at the same time, before anything counts: none does while another is measured.
fn connect(group: &Group, pairs: &mut [Option<Pair>]) -> Result<()> {
    let callers = group.orders.iter().map(|order| order.callers).max().unwrap_or(1);
    let chars = group.orders.iter().map(|order| order.chars).min().unwrap_or(1);
    let order = Order { chars, callers, calls_per_caller: 1, pause_ms: 0, delay_us: 0 };
    let connect = |(contender, pair): (&Contender, &mut Option<Pair>)| {
        let Some(running) = pair else { return Ok(()) };
        contender.tolerate(running.block(&order).with_context(|| reported(&order)))?;
        pair.take_if(|_| !contender.works());
        Ok(())
    };
    side_by_side(group.peers.iter().zip(pairs).collect(), group.peers.len(), connect).into_iter().collect()
}

/// A contender that missed a turn of this cell gets no further one, so that its turns pair with the baseline's first
/// ones.
fn turn(
    contenders: &[Contender],
    pairs: &mut [Option<Pair>],
    order: &Order,
    round: usize,
    cells: &mut [Cell],
) -> Result<()> {
    let mut failure = Ok(());
    for ((contender, pair), cell) in contenders.iter().zip(pairs).zip(cells) {
        let Some(running) = pair.as_mut().filter(|_| cell.turns.len() == round) else { continue };
        let outcome = running.block(order).with_context(|| reported(order));
        match contender.tolerate(outcome) {
            Ok(turn) => cell.turns.extend(turn),
            // The others go on, and the experiment fails when all is done.
            Err(error) => failure = failure.and(Err(error)),
        }
        pair.take_if(|_| !contender.works());
    }
    failure
}

fn reported(order: &Order) -> String {
    format!("{} characters, {} callers, {} ms apart", order.chars, order.callers, order.pause_ms)
}

/// Peers that pause are under way together: each calls while the others pause.
fn spaced_turn(
    contenders: &[Contender],
    pairs: &mut [Option<Pair>],
    order: &Order,
    round: usize,
    cells: &mut [Cell],
) -> Result<()> {
    let offset = order.pause_ms * 1_000 / pairs.iter().flatten().count().max(1) as u64;
    let begin = |(pair, place): (&mut Option<Pair>, u64)| {
        let delayed = Order { delay_us: offset * place, ..order.clone() };
        Some(pair.as_mut()?.begin_blocks(&[delayed]))
    };
    let started: Vec<Option<Result<u64>>> = pairs.iter_mut().zip(0..).map(begin).collect();
    let mut failure = Ok(());
    for (((contender, pair), started), cell) in contenders.iter().zip(pairs).zip(started).zip(cells) {
        let (Some(running), Some(started)) = (pair.as_mut(), started) else { continue };
        let turns = started.and_then(|used| running.end_blocks(used)).with_context(|| reported(order));
        match contender.tolerate(turns) {
            Ok(turns) if cell.turns.len() == round => cell.turns.extend(turns.into_iter().flatten()),
            Ok(_) => {}
            Err(error) => failure = failure.and(Err(error)),
        }
        pair.take_if(|_| !contender.works());
    }
    failure
}

/// Cells without any complete turn have no row.
pub(super) fn rows(group: &Group, cells: &Cells) -> Vec<Response> {
    let mut rows = Vec::new();
    for (order, cells) in group.orders.iter().zip(cells) {
        let Some(floor) = cells.first() else { continue };
        let named = || group.peers.iter().map(Contender::name_and_mode).zip(cells);
        let plain = |name: &str| named().find(|(known, _)| *known == (name, Mode::Plain)).map(|(_, cell)| cell);
        for ((peer, mode), cell) in named().filter(|(_, cell)| !cell.turns.is_empty()) {
            let row = row(peer, group.setting, order, cell, floor);
            let plain = plain(peer).filter(|_| mode == Mode::Secured);
            let plain_ratio = plain.map(|plain| ratio(cell.ratios(plain)[1]));
            rows.push(Response { mode, plain_ratio, ..row });
        }
    }
    rows
}

/// The row of a peer in plain mode.
fn row(peer: &str, setting: Setting, order: &Order, cell: &Cell, floor: &Cell) -> Response {
    let figures = cell.figures();
    let [lower, middle, upper] = cell.ratios(floor).map(ratio);
    Response {
        peer: peer.to_owned(),
        distribution: setting.distribution,
        chars: order.chars,
        pin: setting.pin,
        mode: Mode::Plain,
        print: setting.print,
        pause_ms: order.pause_ms,
        n: figures.calls,
        mean_us: micros(figures.mean),
        lower_quartile_us: micros(figures.lower_quartile),
        p50_us: micros(figures.median),
        upper_quartile_us: micros(figures.upper_quartile),
        p99_us: micros(figures.p99),
        p999_us: micros(figures.p999),
        max_us: micros(figures.longest),
        ratio: middle,
        ratio_lower_quartile: lower,
        ratio_upper_quartile: upper,
        p99_ratio: ratio(figures.p99 as f64 / floor.figures().p99.max(1) as f64),
        plain_ratio: None,
        cpu_us_per_call: micros(figures.cpu_per_call as u64),
        cpu_ratio: ratio(cell.cpu_ratio(floor)),
    }
}
