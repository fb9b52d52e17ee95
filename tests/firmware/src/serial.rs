//! A board on a serial line, for an image with SLIP or with a line without IP: it is found, called and driven there, and loses line and manager.
//! What is printed of times and bytes is measured, and judges nothing.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow};
use cara_std::{Parameters, Peer};
use clap::Args;

use crate::board::{Bench, LONG, Who};
use crate::checks::losses;
use crate::line::Line;
use crate::manager::{Manager, arrives, drives, patiently, position, reset, sets_out};

/// What is measured.
#[derive(Args)]
pub(crate) struct Serial {
    /// The line has no IP. The image is for one rate.
    #[arg(long, conflicts_with = "baud")]
    native: bool,
    /// Bits a second, each way.
    #[arg(long, default_value_t = 115_200, value_parser = clap::value_parser!(u32).range(1_200..=3_000_000))]
    baud: u32,
    /// Seconds without calls, in which bytes are counted.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..))]
    idle: u64,
    /// One byte in so many is changed while calls are made; 0: none.
    #[arg(long, default_value_t = 2_000)]
    noise: u32,
}

/// Pings and calls, each as often.
const TIMES: usize = 20;
/// Calls go on until so many bytes have been changed.
const CHANGED: u32 = 5;

/// Runs it and prints what was found.
pub(crate) fn run(bench: &Bench, Serial { native, baud, idle, noise }: &Serial) -> Result<()> {
    let open = if *native { Line::native } else { Line::slip };
    let line = open(&bench.keys, *baud)?;
    let who = Who::agv(17);
    let manager = Manager::start(&bench.keys)?;
    let start = Instant::now();
    let board = bench.board_on_line(&line, &who)?;
    manager.joined(&who)?;
    let joined = start.elapsed();
    let agv = manager.meet(&who)?;
    println!("{baud} baud: joined {} ms from power on", joined.as_millis());
    let ping = || agv.ping(cara_std::Duration::from(LONG)).map(drop).context("ping");
    println!("ping {}; call of pos_info {}", each(ping)?, each(|| position(&agv).map(drop))?);

    if *native {
        println!("stop beside messages of 400 characters {}", stops(&agv)?);
    }

    let [to, from] = line.bytes();
    std::thread::sleep(Duration::from_secs(*idle));
    let [to_later, from_later] = line.bytes();
    println!("idle: {} bytes/s to the board, {} from it", (to_later - to) / idle, (from_later - from) / idle);

    line.disturb(*noise);
    let mut calls = 0;
    while *noise > 0 && line.changed() < CHANGED {
        position(&agv)?;
        calls += 1;
    }
    line.disturb(0);
    println!("noise: {calls} calls were answered while {} bytes were changed", line.changed());

    drives(&board, [1, 2], || sets_out(&agv, [1, 2]))?;
    arrives(&agv, [1, 2])?;
    println!("it drives where it is sent, and arrives");
    let plugged = |is_plugged| {
        line.plug(is_plugged);
        Ok(())
    };
    let pulled = losses::loses_its_cable(&manager, &board, &who, || plugged(false), || plugged(true));
    println!("the line is pulled: {}", pulled.context("the line is pulled")?);
    drop((agv, manager));
    println!(
        "the manager is killed: {}",
        losses::loses_its_manager(bench, &board, &who).context("the manager is killed")?
    );
    Ok(())
}

/// Stops a vehicle a few times while others call it.
fn stops(agv: &Peer) -> Result<String> {
    let mut bulk = Parameters::<512>::sized();
    bulk.add_string("text", 400)?;
    bulk.set_value("text", "x".repeat(400).as_str())?;
    let is_over = AtomicBool::new(false);
    let took = std::thread::scope(|scope| {
        let others = scope.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                patiently(|| agv.block_request("echo", &mut bulk))?;
            }
            Ok::<_, anyhow::Error>(())
        });
        let took = each(|| patiently(|| agv.block_request("stop", &mut Parameters::<512>::sized())));
        is_over.store(true, Ordering::Relaxed);
        others.join().map_err(|_| anyhow!("the calls of others"))??;
        took
    })?;
    reset(agv)?;
    Ok(took)
}

/// Does something a few times; median and worst.
fn each(mut act: impl FnMut() -> Result<()>) -> Result<String> {
    let mut took = Vec::new();
    for _ in 0..TIMES {
        let start = Instant::now();
        act()?;
        took.push(start.elapsed());
    }
    took.sort_unstable();
    let (median, worst) = (took[TIMES / 2], took[TIMES - 1]);
    Ok(format!("{:.1} ms, at most {:.1} ms", 1e3 * median.as_secs_f64(), 1e3 * worst.as_secs_f64()))
}
