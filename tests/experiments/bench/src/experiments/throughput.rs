//! Throughput: requests per second with several callers, and one-way messages per second over one connection.

use anyhow::{Context, Result};

use super::plan::{Group, Plan};
use super::response::{Cells, start, turns};
use crate::pair::Setting;
use crate::progress::{Progress, is_stopped};
use crate::results::{Kind, Mode, Throughput, ratio};
use crate::statistics::quartile;
use cara_bench_ends::Burst;
use cara_bench_ends::Delivery;
use cara_bench_ends::Pin;

/// Characters of a one-way message.
const CHARS: u32 = 100;

pub(super) fn measure(plan: &Plan, rows: &mut Vec<Throughput>) -> Result<()> {
    for &pin in &plan.throughput_pins {
        if is_stopped() {
            break;
        }
        let setting = Setting { pin, ..plan.throughput.setting };
        let group = Group { setting, ..plan.throughput.clone() };
        let mut cells = Cells::new();
        let outcome = turns(&group, &mut cells, &format!("throughput: {pin}"));
        rows.extend(requests(&group, &cells));
        outcome?;
        one_way(plan, setting, rows)?;
    }
    Ok(())
}

fn requests(group: &Group, cells: &Cells) -> Vec<Throughput> {
    let mut rows = Vec::new();
    for (order, cells) in group.orders.iter().zip(cells) {
        let Some(floor) = cells.first() else { continue };
        let measured = group.peers.iter().zip(cells).filter(|(_, cell)| !cell.turns.is_empty());
        rows.extend(measured.map(|(peer, cell)| {
            let figures = cell.figures();
            let found = Found { n: figures.calls, per_second: figures.per_second, refused: 0, lost: 0 };
            row(
                Kind::Request,
                peer.name_and_mode(),
                order.callers,
                group.setting.pin,
                found,
                cell.throughput_ratio(floor),
            )
        }));
    }
    rows
}

struct Found {
    n: usize,
    per_second: f64,
    refused: u64,
    lost: u64,
}

fn row(
    kind: Kind,
    (peer, mode): (&str, Mode),
    callers: u32,
    pin: Pin,
    found: Found,
    ratio_to_floor: f64,
) -> Throughput {
    Throughput {
        kind,
        peer: peer.to_owned(),
        callers,
        chars: CHARS,
        pin,
        mode,
        n: found.n,
        requests_per_s: found.per_second.round(),
        ratio: ratio(ratio_to_floor),
        refused: found.refused,
        lost: found.lost,
    }
}

fn one_way(plan: &Plan, setting: Setting, rows: &mut Vec<Throughput>) -> Result<()> {
    let contenders = &plan.one_way_peers;
    let mut pairs = start(contenders, setting)?;
    let count = plan.one_way;
    let burst = Burst { chars: CHARS, count, period_ms: 0, delivery: Delivery::Reliable, insist: true };
    let bar = Progress::new(&format!("one-way messages: {}", setting.pin), plan.throughput.rounds as usize);
    let mut speeds: Vec<Vec<f64>> = vec![Vec::new(); pairs.len()];
    let mut missing = vec![(0, 0); pairs.len()];
    for _ in 0..plan.throughput.rounds {
        if is_stopped() {
            break;
        }
        for (((contender, pair), speeds), (refused, lost)) in
            contenders.iter().zip(&mut pairs).zip(&mut speeds).zip(&mut missing)
        {
            let Some(running) = pair else { continue };
            let Some(delivered) = contender.tolerate(running.burst(&burst).context("one-way messages"))? else {
                *pair = None;
                continue;
            };
            speeds.push(delivered.executed as f64 * 1e9 / delivered.elapsed.max(1) as f64);
            *refused += delivered.offered.refused + delivered.failed;
            *lost += delivered.lost();
        }
        bar.step();
    }
    let floor = speeds.first().cloned().unwrap_or_default();
    for ((peer, own), (refused, lost)) in
        contenders.iter().zip(speeds).zip(missing).filter(|((_, own), _)| !own.is_empty())
    {
        let ratios = own.iter().zip(&floor).map(|(own, floor)| own / floor.max(1e-9)).collect();
        let found = Found { n: own.len() * count as usize, per_second: quartile(own, 2), refused, lost };
        rows.push(row(Kind::OneWay, peer.name_and_mode(), 1, setting.pin, found, quartile(ratios, 2)));
    }
    Ok(())
}
