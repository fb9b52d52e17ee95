//! How many instructions a board executes for a request, from the wake-up by its first frame until it sleeps again
//! after its last one, including the acknowledgement of the reply; and which code they belong to.
//!
//! Each request is measured alone: the next one follows when the connection is idle. Wake-ups by timers are left out.
//! The figure is the bound that one in eight requests does not exceed: frames of other hosts and timers only add to the
//! rest.

use std::collections::BTreeMap;
use std::io::{Read, Write};
use std::net::SocketAddr;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use cara_std::{Parameters, Peer};
use clap::ValueEnum;

use crate::board::{self, Bench, LONG, Who};
use crate::load::{ECHO_PORT, connected};
use crate::manager::Manager;
use crate::places::{Owner, Places};
use crate::trace::Trace;

/// An image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Image {
    /// An s_unit with the services `pos_info` and `echo`.
    Served,
    /// The bare TCP echo, which is sent as many bytes as requests have.
    Echo,
}

const REQUESTS: usize = 32;
/// Functions of a profile.
const SHOWN: usize = 60;
const CHARACTERS: u32 = 512;
/// Longer than a delayed acknowledgement of Linux, which takes 40 ms.
const REST: Duration = Duration::from_millis(90);
/// Bytes of a request in the stream, its frame included.
const INTS_BYTES: usize = 56;
const TEXT_BYTES: usize = 560;

/// Counts and prints.
pub(crate) fn run(bench: &Bench, image: &Path, of: Image, profile: bool) -> Result<()> {
    let cable = bench.cable()?;
    let who = Who::agv(17);
    let (_board, trace) = bench.traced_board(&cable, &who)?;
    let places = Places::of(image)?;
    match of {
        Image::Served => {
            let manager = Manager::start(&bench.keys)?;
            let peer = meet(&manager, &who)?;
            let (mut ints, mut text) = parameters()?;
            let asked = exchanges(&trace, || Ok(peer.block_request("pos_info", &mut ints)?))?;
            print(&places, &asked, "served request", "2 ints", profile);
            let asked = exchanges(&trace, || Ok(peer.block_request("echo", &mut text)?))?;
            print(&places, &asked, "served request", &format!("{CHARACTERS} characters"), profile);
        }
        Image::Echo => {
            let mut stream = connected(SocketAddr::new(board::address(&cable).into(), ECHO_PORT))?;
            stream.set_read_timeout(Some(LONG))?;
            stream.set_nodelay(true)?;
            for bytes in [INTS_BYTES, TEXT_BYTES] {
                let mut message = vec![7; bytes];
                let asked = exchanges(&trace, || {
                    stream.write_all(&message)?;
                    Ok(stream.read_exact(&mut message)?)
                })?;
                print(&places, &asked, "bare TCP echo", &format!("{bytes} bytes"), profile);
            }
        }
    }
    Ok(())
}

fn meet(manager: &Manager, who: &Who) -> Result<Peer> {
    let deadline = Instant::now() + LONG;
    while Instant::now() < deadline {
        let peer = manager.system.s_unit(&who.name).ok().filter(Peer::is_connected);
        if let Some(peer) = peer.filter(|peer| peer.their_function_list().contains("echo")) {
            return Ok(peer);
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    bail!("{} has not joined", who.name)
}

fn parameters() -> Result<(Parameters, Parameters<1024>)> {
    let ints = crate::manager::at([3, 4])?;
    let mut text = Parameters::<1024>::sized();
    text.add_string("text", CHARACTERS)?;
    text.set_value("text", "a".repeat(CHARACTERS as usize).as_str())?;
    Ok((ints, text))
}

/// What the board executes from just before each exchange until it rests.
fn exchanges(trace: &Trace, mut exchange: impl FnMut() -> Result<()>) -> Result<Vec<Vec<u32>>> {
    std::thread::sleep(REST);
    let mut executed = Vec::new();
    for _ in 0..REQUESTS {
        let start = trace.length();
        exchange()?;
        std::thread::sleep(REST);
        executed.push(trace.part(start..trace.length()));
    }
    Ok(executed)
}

/// Prints what is least of what each owner has, or the functions that have most.
fn print(places: &Places, exchanges: &[Vec<u32>], what: &str, of: &str, profile: bool) {
    let exchanges: Vec<Vec<(u32, Owner)>> = exchanges.iter().map(|executed| of_network(places, executed)).collect();
    if profile {
        println!("{what}, {of}:");
        if let Some(typical) = least(exchanges, Vec::len) {
            functions(places, &typical);
        }
        return;
    }
    for (owner, name) in [(Owner::Cara, "CARA"), (Owner::Network, "TCP/IP"), (Owner::Board, "driver, clock, executor")]
    {
        let has = |executed: &[(u32, Owner)]| executed.iter().filter(|(_, of)| *of == owner).count();
        let counts = exchanges.iter().map(|executed| has(executed)).collect();
        match least(counts, |count| *count) {
            None | Some(0) => {}
            Some(count) => println!("{what}, {name}\t{of}\t{count}"),
        }
    }
}

/// Of wake-ups with a frame, each instruction with its owner.
fn of_network(places: &Places, executed: &[u32]) -> Vec<(u32, Owner)> {
    let mut kept = Vec::new();
    for awake in executed.split_inclusive(|address| places.place(*address).waits) {
        if !awake.iter().any(|address| places.place(*address).receives) {
            continue;
        }
        let mut owner = Owner::Board;
        for address in awake {
            owner = places.place(*address).owner.unwrap_or(owner);
            kept.push((*address, owner));
        }
    }
    kept
}

/// The functions of CARA with the most instructions: as they are written, and as they are linked.
fn functions(places: &Places, executed: &[(u32, Owner)]) {
    let (mut written, mut linked) = (BTreeMap::new(), BTreeMap::new());
    let mut last = String::new();
    for (address, _) in executed.iter().filter(|(_, owner)| *owner == Owner::Cara) {
        let place = places.place(*address);
        // Copying and comparing count for their caller, and are named.
        if place.owner.is_some() {
            last.clone_from(&place.function);
        }
        let name = if place.owner.is_some() { last.clone() } else { format!("{last} > {}", place.innermost) };
        written.entry(name).or_insert_with(Vec::new).push(*address);
        linked.entry(place.symbol.clone()).or_insert_with(Vec::new).push(*address);
    }
    for (title, functions) in [("as written", written), ("as linked", linked)] {
        println!("  {title}: instructions, calls, function");
        let mut functions: Vec<(String, Vec<u32>)> = functions.into_iter().collect();
        functions.sort_by_key(|(_, addresses)| std::cmp::Reverse(addresses.len()));
        for (name, addresses) in functions.iter().take(SHOWN) {
            println!("    {:6} {:4} {name}", addresses.len(), calls(addresses));
        }
    }
}

/// How often a function's first instruction was executed.
fn calls(addresses: &[u32]) -> usize {
    let first = addresses.iter().min();
    addresses.iter().filter(|address| Some(*address) == first).count()
}

/// The one that an eighth of them do not exceed: how a text lies in the socket's buffer makes its copies cheap for one
/// request of four, and that is the same in every run.
fn least<T>(mut all: Vec<T>, key: impl Fn(&T) -> usize) -> Option<T> {
    all.sort_by_key(key);
    let at = all.len() / 8;
    (at < all.len()).then(|| all.swap_remove(at))
}

#[cfg(test)]
mod tests {
    use super::least;

    #[test]
    fn one_that_is_disturbed_does_not_count() {
        assert_eq!(least(vec![900, 8, 950, 8, 8, 9, 9, 7], |count| *count), Some(8));
        assert_eq!(least(Vec::<usize>::new(), |count| *count), None);
    }
}
