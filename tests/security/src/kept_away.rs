//! Recorded and forged discovery while a vehicle starts beside its running manager: it joins nevertheless.

use std::net::{Ipv4Addr, TcpListener};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use cara_core::distribution::datagram::{Announce, Datagram, Header, SEARCH_BYTES, WhoHas};
use cara_core::distribution::identity::{Epoch, Role};
use cara_secure::keyring::Codes;
use cara_std::keys::KeyRing;
use cara_std::sys::datagram::{Datagrams, Socket};
use cara_std::{Fleet, Interfaces};

use crate::discovery::Lent;
use crate::ground::{agv, depot};
use crate::linux::{Linux, Weakness, named, wait_for};
use crate::speaker::PATIENCE;
use crate::tally::{Report, Row};

/// The vehicle whose question is recorded, and whose keys are stolen.
const OTHER: u32 = 1;
/// Before a vehicle starts, the attack has gone on for so long.
const BEFORE: Duration = Duration::from_millis(200);
/// Counters of a vehicle that rise with each broadcast that leads to nothing.
const TELLING: [&str; 2] = ["HintsIgnored", "WhoHasUnheeded"];

/// What an attacker broadcasts, again and again.
pub struct Attack {
    /// What it is.
    pub name: &'static str,
    said: Vec<Vec<u8>>,
    /// Listeners at the addresses that the datagrams name: they accept connections and stay silent.
    _silent: Vec<TcpListener>,
}

/// Each attack at each rate, so many times a second, against vehicles that start one after the other.
pub fn run(report: &mut Report, weakness: Weakness, starts: u32, rates: &[u64]) -> Result<()> {
    // The vehicles of all attacks, and the one that is recorded.
    let vehicles = OTHER + starts * 3 * rates.len() as u32;
    let linux = Linux::new(vehicles, weakness)?;
    let socket = Datagrams::open(Interfaces::Loopback, linux.port)?;
    let at = Ipv4Addr::LOCALHOST;
    let attacks = [
        Attack::earlier_lives(&socket, at, || live(&linux))?,
        another_vehicle(&linux, &socket)?,
        Attack::forged(&linux.ground.ring(&agv(OTHER)), linux.ground.fleet, at)?,
    ];
    let _manager = linux.manager()?;
    let mut vehicle = OTHER;
    for attack in &attacks {
        for a_second in rates {
            let (mut took, mut noticed) = (Vec::new(), Vec::new());
            let (sent, mut out) = (AtomicU64::new(0), 0);
            for _ in 0..starts {
                vehicle += 1;
                let (joined, counted) = start(&linux, &socket, attack, *a_second, vehicle, &sent)?;
                took.push(joined.unwrap_or(PATIENCE).as_millis());
                out += u64::from(joined.is_none());
                noticed.extend(counted);
            }
            noticed.sort();
            noticed.dedup();
            let (median, worst) = median_and_worst(&mut took);
            let joined = u64::from(starts) - out;
            println!("{}, {a_second} a second: {joined} of {starts} joined, ms: {median} / {worst}", attack.name);
            let (attack, target) = (format!("{}, {a_second} a second", attack.name), "Linux s_unit".to_owned());
            let attempts = sent.into_inner();
            report.add(Row { attack, target, attempts, successes: out, noticed, control: false });
        }
    }
    Ok(())
}

/// How long a vehicle takes to join while the attack goes on, and the telling counters that have risen.
fn start(
    linux: &Linux,
    socket: &Datagrams,
    attack: &Attack,
    a_second: u64,
    vehicle: u32,
    sent: &AtomicU64,
) -> Result<(Option<Duration>, Vec<String>)> {
    attack.beside(socket, a_second, sent, || {
        let (unit, log) = linux.vehicle(vehicle, None)?;
        let since = Instant::now();
        let joined = wait_for(|| log.all().joins > 0).then(|| since.elapsed());
        let counted = named(unit.counters());
        unit.stop();
        let risen = TELLING.iter().filter(|name| counted.get(**name).is_some_and(|count| *count > 0));
        Ok((joined, risen.map(|name| (*name).to_owned()).collect()))
    })
}

impl Attack {
    /// A recorded `WhoHas` of each of two ended boots of the manager. `live` starts one, and returns what stops it.
    pub fn earlier_lives<'l>(
        socket: &Datagrams,
        at: Ipv4Addr,
        live: impl Fn() -> Result<Box<dyn FnOnce() + 'l>>,
    ) -> Result<Self> {
        let (mut said, mut silent) = (Vec::new(), Vec::new());
        for _ in 0..2 {
            let end = live()?;
            let (bytes, who_has) = recorded(socket, Role::MUnit)?;
            end();
            silent.extend(TcpListener::bind((at, who_has.tcp_port)));
            said.push(bytes);
        }
        Ok(Self { name: "recorded who-has of two earlier lives of the manager", said, _silent: silent })
    }

    /// The `WhoHas` of another vehicle that is searching now.
    pub fn another_vehicle(socket: &Datagrams) -> Result<Self> {
        let (bytes, _) = recorded(socket, Role::SUnit)?;
        Ok(Self { name: "recorded who-has of another vehicle", said: vec![bytes], _silent: Vec::new() })
    }

    /// Announces of the manager, each of another boot, with the discovery key of a stolen vehicle.
    pub fn forged(ring: &KeyRing, fleet: Fleet, at: Ipv4Addr) -> Result<Self> {
        let listener = TcpListener::bind((at, 0))?;
        let codes = Codes::Keyed(Lent(ring));
        let tcp_port = listener.local_addr()?.port();
        let announce = |_| {
            let epoch = Epoch(fastrand::u64(..));
            let (sequence, room, expected) = (u32::MAX, 100, u16::MAX);
            let announce = Announce {
                identity: depot(),
                epoch,
                claim: None,
                obeyed: None,
                sequence,
                nonce: 0,
                tcp_port,
                room,
                expected,
                skipped: 0,
            };
            let mut out = [0; SEARCH_BYTES];
            announce.encode(fleet, &codes, None, &mut out).map(<[u8]>::to_vec).context("it fits")
        };
        let said = (0..200).map(announce).collect::<Result<_>>()?;
        Ok(Self { name: "announces forged with a stolen discovery key", said, _silent: vec![listener] })
    }

    /// Runs `what` while the attack's datagrams are broadcast `a_second` times a second, after they have been for
    /// `BEFORE`; counts them in `sent`.
    pub fn beside<T>(&self, socket: &Datagrams, a_second: u64, sent: &AtomicU64, what: impl FnOnce() -> T) -> T {
        let over = AtomicBool::new(false);
        let pause = Duration::from_micros(1_000_000 / a_second);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for bytes in self.said.iter().cycle().take_while(|_| !over.load(Ordering::Relaxed)) {
                    socket.broadcast(bytes);
                    sent.fetch_add(1, Ordering::Relaxed);
                    std::thread::sleep(pause);
                }
            });
            std::thread::sleep(BEFORE);
            let outcome = what();
            over.store(true, Ordering::Relaxed);
            outcome
        })
    }
}

/// The median and the longest of what several took, in milliseconds.
pub fn median_and_worst(took: &mut [u128]) -> (u128, u128) {
    took.sort_unstable();
    let at = |index: usize| took.get(index).copied().unwrap_or_default();
    (at(took.len() / 2), at(took.len().saturating_sub(1)))
}

/// A running manager, and what stops it.
fn live(linux: &Linux) -> Result<Box<dyn FnOnce() + '_>> {
    let manager = linux.manager()?;
    Ok(Box::new(move || manager.system.stop()))
}

/// A `WhoHas` of another vehicle.
fn another_vehicle(linux: &Linux, socket: &Datagrams) -> Result<Attack> {
    let (unit, _) = linux.vehicle(OTHER, None)?;
    let attack = Attack::another_vehicle(socket);
    unit.stop();
    attack
}

/// The next broadcast `WhoHas` of a unit of this role.
fn recorded(socket: &Datagrams, role: Role) -> Result<(Vec<u8>, WhoHas)> {
    let end = Instant::now() + PATIENCE;
    let mut buffer = [0; 2_048];
    while Instant::now() < end {
        let Some((count, _)) = socket.receive(Socket::Shared, &mut buffer) else {
            std::thread::sleep(Duration::from_millis(1));
            continue;
        };
        let bytes = buffer.get(..count).unwrap_or_default();
        let Ok((header, body)) = Header::decode(bytes) else { continue };
        if let Ok(Datagram::WhoHas(who_has)) = header.read(body)
            && who_has.identity.role() == role
        {
            return Ok((bytes.to_vec(), who_has));
        }
    }
    bail!("no unit of this role asks")
}
