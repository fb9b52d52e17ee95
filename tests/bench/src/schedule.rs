//! Who makes a block when: every peer in every cell, turn by turn.

use anyhow::{Context, Result, ensure};

use crate::block::{Order, Outcome};
use crate::child::Handle;
use crate::pin::{self, Pin};
use crate::report::Row;
use crate::statistics::{Cell, Turn};
use crate::{Child, Skeleton, peers};

/// Fewest calls per caller and block: fewer measure how threads start.
const FEWEST_CALLS: u32 = 25;

/// The two processes of one peer at one pin.
struct Pair {
    server: Handle,
    client: Handle,
}

impl Pair {
    fn start(peer: &str, pin: Pin, run: u32) -> Result<Self> {
        let [client_cpu, server_cpu] = pin::cpus(pin)?;
        let mut child = Child { peer: peer.to_owned(), cpu: server_cpu, run, address: String::new() };
        let mut server = Handle::start("serve", &child)?;
        child.address = server.answer().with_context(|| format!("starting the server of {peer}"))?;
        child.cpu = client_cpu;
        let client = Handle::start("call", &child)?;
        Ok(Self { server, client })
    }

    /// One block, and the CPU time of the server during it in nanoseconds.
    fn block(&mut self, order: &Order) -> Result<(Outcome, u64)> {
        let used: u64 = self.server_cpu()?;
        let outcome = self.client.order(order)?;
        Ok((outcome, self.server_cpu()?.saturating_sub(used)))
    }

    fn server_cpu(&mut self) -> Result<u64> {
        self.server.ask(&())?;
        self.server.answer()
    }
}

/// Measures all cells; the rows in the order of the table.
pub(crate) fn run(wanted: &Skeleton) -> Result<Vec<Row>> {
    let peers = in_order(&wanted.peers)?;
    let mut rows = Vec::new();
    for &pin in &wanted.pins {
        let mut pairs = Vec::new();
        for (place, peer) in peers.iter().enumerate() {
            // Processes of two runs at the same time differ as well.
            let run = std::process::id().wrapping_mul(64).wrapping_add(place as u32);
            pairs.push(Pair::start(peer, pin, run)?);
        }
        rows.extend(measure(wanted, pin, &peers, &mut pairs)?);
    }
    Ok(rows)
}

/// The peers asked for, in their fixed order; the first of all is always among them.
fn in_order(wanted: &[String]) -> Result<Vec<String>> {
    let all = peers::names();
    for name in wanted {
        ensure!(all.contains(name), "no peer is called {name}; there are {all:?}");
    }
    let first = all.first().cloned();
    Ok(all.into_iter().filter(|name| wanted.contains(name) || first.as_ref() == Some(name)).collect())
}

fn measure(wanted: &Skeleton, pin: Pin, peers: &[String], pairs: &mut [Pair]) -> Result<Vec<Row>> {
    let orders = orders(wanted);
    let mut cells: Vec<Vec<Cell>> = orders.iter().map(|_| peers.iter().map(|_| Cell::default()).collect()).collect();
    for round in 0..wanted.rounds {
        for (order, cells) in orders.iter().zip(&mut cells) {
            for ((pair, cell), peer) in pairs.iter_mut().zip(cells).zip(peers) {
                let (outcome, server_cpu) = pair
                    .block(order)
                    .with_context(|| format!("{peer}, {} chars, {} callers", order.chars, order.callers))?;
                cell.turns.push(Turn::new(outcome, server_cpu));
            }
        }
        eprint!("\rpin {pin}: turn {} of {}", round + 1, wanted.rounds);
    }
    eprintln!();
    let rows = orders.iter().zip(&cells).flat_map(|(order, cells)| {
        let floor = cells.first();
        peers.iter().zip(cells).map(move |(peer, cell)| Row::new(peer, pin, order, cell, floor.unwrap_or(cell)))
    });
    Ok(rows.collect())
}

fn orders(wanted: &Skeleton) -> Vec<Order> {
    let mut orders = Vec::new();
    for &pause_ms in &wanted.pause_ms {
        for &callers in &wanted.callers {
            for &chars in &wanted.chars {
                let calls_per_caller = match pause_ms {
                    0 if callers == 1 => wanted.calls,
                    0 => (wanted.calls / callers).max(FEWEST_CALLS),
                    _ => wanted.paused_calls,
                };
                orders.push(Order { chars, callers, calls_per_caller, pause_ms });
            }
        }
    }
    orders
}
