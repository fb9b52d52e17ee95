//! How each fault begins and ends.

use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::Stdio;
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use cara_processes::network::run;

use crate::Kind;
use crate::disk::Way;
use crate::group::Group;
use crate::pair::{MANAGER, Pair, VEHICLE};

/// More than are served at a time.
const CONNECTIONS: usize = 12;
/// A group has so much left, and its process takes it.
const LEFT: u64 = 8 << 20;

pub(crate) fn begin(pair: &mut Pair, kind: Kind, number: usize) -> Result<()> {
    match kind {
        Kind::Descriptors(side) => {
            let id = pair.id(side)?;
            // The next one gets the lowest number that is free. The hard limit stays: what lowers that may not raise it everywhere.
            let free =
                (0..).find(|number| !Path::new(&format!("/proc/{id}/fd/{number}")).exists()).context("a number")?;
            run(&format!("prlimit --pid {id} --nofile={free}:"))?;
            press(pair, side)
        }
        Kind::Allocations(side) => {
            let id = pair.id(side)?;
            let status = std::fs::read_to_string(format!("/proc/{id}/status"))?;
            let size = status.lines().find_map(|line| line.strip_prefix("VmSize:"));
            let size: u64 = size.and_then(|size| size.trim().strip_suffix(" kB")?.parse().ok()).context("a size")?;
            run(&format!("prlimit --pid {id} --as={}:unlimited", size * 1024))?;
            press(pair, side)
        }
        Kind::Killed(side) => {
            Group::of(side)?.limit(LEFT)?;
            pair.tell(side, "leak")
        }
        Kind::State(_, way) => {
            // Something is to be stored: whoever starts has a claim, or hears one.
            let restarts = if number.is_multiple_of(2) { MANAGER } else { VEHICLE };
            fail_under(pair, way, restarts)
        }
        Kind::Records(way) => {
            let path = pair.disk.as_ref().context("a disk")?.path();
            let mut command = pair.command(Path::new(env!("CARGO_BIN_EXE_cara")), MANAGER);
            command.args(["record", "--every", "1s", "--unit", "manager/1"]).arg(path.join("record.mcap"));
            let recorder = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
            pair.others.push(recorder);
            // Its vehicle stops without it, which is to be in the black box.
            fail_under(pair, way, MANAGER)
        }
        Kind::Clock(seconds) => {
            pair.set_clock(seconds)?;
            if !number.is_multiple_of(2) {
                pair.kill(MANAGER)?;
                pair.launch(MANAGER)?;
            }
            Ok(())
        }
        Kind::Suspended(sides) => sides.iter().try_for_each(|side| pair.freeze(*side)),
        Kind::Uptime(days) => {
            let seconds = days * 24 * 3_600;
            pair.vehicle_on = format!("unshare --time --boottime {seconds} --fork --kill-child");
            pair.kill(VEHICLE)?;
            pair.launch(VEHICLE)
        }
    }
}

/// New links and control connections, which take descriptors and memory.
fn press(pair: &mut Pair, side: usize) -> Result<()> {
    if side == VEHICLE {
        pair.kill(MANAGER)?;
        return pair.launch(MANAGER);
    }
    pair.add_other()?;
    for _ in 0..CONNECTIONS {
        let socket = pair.socket();
        // It waits until the fault is over, where the socket's queue is full.
        std::thread::spawn(move || UnixStream::connect(socket).map(drop));
    }
    Ok(())
}

fn fail_under(pair: &mut Pair, way: Way, restarts: usize) -> Result<()> {
    pair.kill(restarts)?;
    pair.disk.as_mut().context("a disk")?.fail(way)?;
    pair.launch(restarts)
}

/// When it ended.
pub(crate) fn end(pair: &mut Pair, kind: Kind) -> Result<Instant> {
    match kind {
        // A process that has ended meanwhile takes its limit with it.
        Kind::Descriptors(side) => limit_again(pair, side, "--nofile=4096:")?,
        Kind::Allocations(side) => limit_again(pair, side, "--as=unlimited:unlimited")?,
        Kind::Killed(side) => Group::of(side)?.free()?,
        Kind::State(_, way) | Kind::Records(way) => pair.disk.as_mut().context("a disk")?.mend(way)?,
        Kind::Clock(seconds) => {
            let ahead = pair.clock_ahead;
            ensure!((ahead - seconds).abs() < 60, "the manager's clock is {ahead} s ahead, and not {seconds}");
            pair.set_clock(0)?;
        }
        Kind::Suspended(sides) => sides.iter().rev().try_for_each(|side| pair.thaw(*side))?,
        Kind::Uptime(_) => {
            pair.vehicle_on.clear();
            pair.kill(VEHICLE)?;
            pair.launch(VEHICLE)?;
        }
    }
    let now = Instant::now();
    pair.remove_others();
    Ok(now)
}

fn limit_again(pair: &Pair, side: usize, limit: &str) -> Result<()> {
    pair.id(side).map_or(Ok(()), |id| run(&format!("prlimit --pid {id} {limit}")))
}
