//! Floods of datagrams, and of links that never send a proof. Genuine units keep working meanwhile.

use std::net::TcpStream;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, anyhow, ensure};
use cara_core::config::Mode;
use cara_core::distribution::datagram::{HEADER_BYTES, SEARCH_BYTES, WhoHas};
use cara_core::distribution::identity::Epoch;
use cara_core::host::frame::Frame;
use cara_processes::ticker::Ticker;
use cara_secure::keyring::Codes;
use cara_std::sys::datagram::Datagrams;
use cara_std::{Error, Interfaces, Parameters, Peer, RequestOptions};

use crate::ground::agv;
use crate::links::Extent;
use crate::linux::{Linux, LinuxManager, named, wait_for};
use crate::speaker::{PATIENCE, framed, fresh_mark, hello};
use crate::tally::{Counters, Report, Row};
use crate::target::Target;
use crate::trial::risen;

/// How long a call may take during a flood, besides what the machine holds this process up.
const DEADLINE: Duration = Duration::from_secs(2);
/// Calls during each flood, at least.
const CALLS: usize = 60;
/// Connections that a flood holds open at a time, per thread: together they exceed a manager's capacity.
const HELD: usize = 100;
/// Pause of each of the two attackers between two links, so that they open a thousand a second at most. A link is
/// displaced once as many newer ones are open as the manager has capacity for; until then it has time to prove itself.
const BETWEEN_LINKS: Duration = Duration::from_millis(2);
/// Pause of each of the two attackers between two datagrams.
const BETWEEN_DATAGRAMS: Duration = Duration::from_micros(50);
/// Counters of a manager that rise when it accepts a datagram at its discovery port.
const BELIEVED: [&str; 3] = ["WhoHasHeard", "AnnounceHeard", "Dialled"];
/// Number of the first genuine vehicle.
const THERE: u32 = 201;

/// A flood.
struct Flood {
    name: &'static str,
    /// Attempts, at least.
    count: u64,
    /// The vehicle that joins during the flood.
    newcomer: u32,
    /// The counter of attempts that the manager processed; without one, every attempt counts.
    looked_at: Option<&'static str>,
}

/// Both floods against a manager.
pub fn run(report: &mut Report, linux: &Linux, manager: &LinuxManager<'_>, extent: Extent) -> Result<()> {
    let (there, _) = linux.vehicle(THERE, None)?;
    ensure!(wait_for(|| connected(manager, THERE).is_some()), "no vehicle joins before the flood");
    let count = if extent == Extent::Full { 6_000 } else { 800 };
    let handshakes = |over: &AtomicBool, made: &AtomicU64| open_links(linux, manager, over, made);
    let links = Flood { name: "flood of half-open links", count, newcomer: THERE + 1, looked_at: None };
    flood(report, linux, manager, &links, handshakes)?;
    let count = if extent == Extent::Full { 60_000 } else { 6_000 };
    let datagrams = |over: &AtomicBool, made: &AtomicU64| say_anything(linux, over, made);
    let forged = Some("DatagramForged");
    let discovery = Flood { name: "flood of discovery", count, newcomer: THERE + 2, looked_at: forged };
    flood(report, linux, manager, &discovery, datagrams)?;
    there.stop();
    Ok(())
}

fn connected(manager: &LinuxManager<'_>, id: u32) -> Option<Peer> {
    let mut peers = manager.system.s_units().into_iter().filter(Peer::is_connected);
    peers.find(|peer| peer.id() == id && peer.their_function_list().contains("mark"))
}

fn call(peer: &Peer) -> Result<(), Error> {
    let mut number = Parameters::<64>::sized();
    number.add_int("n", 1)?;
    number.set_value("n", fresh_mark())?;
    let options = RequestOptions { timeout: Some(PATIENCE.into()), ..RequestOptions::default() };
    peer.call("mark", &mut number).with(options).wait().map_err(Error::from)
}

/// Runs `attacker` until it has made enough attempts and the genuine units have done their part: calls within their
/// deadline, and a new vehicle that is found and joins. Successes of the attacker are: a late call, a new vehicle that
/// does not join, a join without a key, and a datagram that is accepted.
fn flood(
    report: &mut Report,
    linux: &Linux,
    manager: &LinuxManager<'_>,
    &Flood { name, count, newcomer, looked_at }: &Flood,
    attacker: impl Fn(&AtomicBool, &AtomicU64) -> Result<()> + Sync,
) -> Result<()> {
    let (over, made) = (AtomicBool::new(false), AtomicU64::new(0));
    let before = manager.counters()?;
    let joins = manager.log.joins_but_of(&[agv(THERE), agv(newcomer)]);
    let (mut late, mut calls, mut longest, mut new) = (0, 0, Duration::ZERO, None);
    std::thread::scope(|scope| -> Result<()> {
        let attackers = [(); 2].map(|()| scope.spawn(|| attacker(&over, &made)));
        let peer = connected(manager, THERE);
        while calls < CALLS || made.load(Ordering::Relaxed) < count {
            if attackers.iter().any(|attacker| attacker.is_finished()) {
                break;
            }
            let (began, ticker) = (Instant::now(), Ticker::start());
            let is_answered = peer.as_ref().is_some_and(|peer| call(peer).is_ok());
            let took = began.elapsed();
            late += u64::from(!is_answered || took > DEADLINE + ticker.together());
            longest = longest.max(took);
            calls += 1;
            if calls == 10 {
                new = Some(linux.vehicle(newcomer, None)?);
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        let out = !wait_for(|| connected(manager, newcomer).is_some());
        eprintln!("{name}: the longest of {calls} calls took {longest:.1?}");
        if late > 0 || out {
            eprintln!("{name}: {late} of {calls} calls came too late; the newcomer stayed out: {out}");
        }
        late += u64::from(out);
        over.store(true, Ordering::Relaxed);
        attackers.into_iter().try_for_each(|attacker| attacker.join().map_err(|_| anyhow!("an attacker panicked"))?)
    })?;
    let unexpected = manager.log.joins_but_of(&[agv(THERE), agv(newcomer)]) - joins;
    let after = manager.counters()?;
    let (unit, _) = new.ok_or_else(|| anyhow!("the flood was over before a newcomer came"))?;
    // The manager's counters are read first, so that they hold no datagram of the newcomer that its own counters lack.
    let believed = believed(&before, &after, unit.counters());
    unit.stop();
    report.add(Row {
        attack: name.to_owned(),
        target: manager.name().to_owned(),
        attempts: looked_at.map_or(made.into_inner(), |name| value(&after, name) - value(&before, name)),
        successes: late + unexpected as u64 + believed,
        noticed: risen(&before, &after),
        control: false,
    });
    Ok(())
}

fn value(counters: &Counters, name: &str) -> u64 {
    counters.get(name).copied().unwrap_or(0)
}

/// Datagrams that the manager accepted beyond the newcomer's own: its searches, and its question if it heard the manager search.
fn believed(before: &Counters, after: &Counters, newcomer: Vec<(&'static str, u64)>) -> u64 {
    let heard: u64 = BELIEVED.iter().map(|name| value(after, name) - value(before, name)).sum();
    let newcomer = named(newcomer);
    heard.saturating_sub(value(&newcomer, "WhoHasSent") + value(&newcomer, "HintsAsked"))
}

/// Opens link after link and says hello on each, every other time in the name of a vehicle that is connected.
fn open_links(linux: &Linux, manager: &LinuxManager<'_>, over: &AtomicBool, made: &AtomicU64) -> Result<()> {
    use std::io::Write;
    let mut held = std::collections::VecDeque::new();
    while !over.load(Ordering::Relaxed) {
        let number = made.fetch_add(1, Ordering::Relaxed);
        let claim = linux.claim_of(if number.is_multiple_of(2) { THERE } else { 100 });
        let mut stream = TcpStream::connect(manager.address())?;
        let says = framed(&Frame::Hello(&hello(&claim, Mode::Secured, 9)));
        // The write fails on a link that the manager has closed in favour of a newer one.
        let _ = stream.write_all(&says);
        held.push_back(stream);
        if held.len() > HELD {
            held.pop_front();
        }
        std::thread::sleep(BETWEEN_LINKS);
    }
    Ok(())
}

/// Sends datagrams without end: each second one a `WhoHas` with another fleet's codes, the others noise behind a valid
/// header.
fn say_anything(linux: &Linux, over: &AtomicBool, made: &AtomicU64) -> Result<()> {
    let socket = Datagrams::open(Interfaces::Loopback, linux.port)?;
    let mut out = [0; SEARCH_BYTES];
    while !over.load(Ordering::Relaxed) {
        let search = WhoHas {
            identity: agv(fastrand::u32(1..200)),
            epoch: Epoch(fastrand::u64(..)),
            sequence: fastrand::u32(..),
            nonce: fastrand::u64(1..),
            wanted: cara_std::Manager::new("depot", 1).ok(),
            tcp_port: 0,
            expected: 1,
            known: Default::default(),
            standby: false,
            skipped: 0,
        };
        let codes = Codes::Keyed(crate::discovery::Lent(linux.ground.elsewhere()));
        let mut bytes = search.encode(linux.ground.fleet, &codes, &mut out).context("it fits")?.to_vec();
        if made.fetch_add(1, Ordering::Relaxed).is_multiple_of(2) {
            bytes.iter_mut().skip(HEADER_BYTES).for_each(|byte| *byte = fastrand::u8(..));
        }
        socket.broadcast(&bytes);
        // Without a pause the kernel drops nearly all of them, and the unit is not what is tested.
        std::thread::sleep(BETWEEN_DATAGRAMS);
    }
    Ok(())
}
