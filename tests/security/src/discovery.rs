//! Attacks on discovery: datagrams that are forged, from elsewhere, or said once more.

use std::net::{Ipv4Addr, SocketAddr, TcpListener};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use cara_core::distribution::authenticator::CODE_BYTES;
use cara_core::distribution::datagram::{Announce, Datagram, Header, SEARCH_BYTES, WhoHas};
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::host::secure::Plain;
use cara_secure::keyring::{Codes, Keyring};
use cara_secure::keys::{DiscoveryKey, PairKey};
use cara_std::Interfaces;
use cara_std::keys::KeyRing;
use cara_std::sys::datagram::{Datagrams, Socket};

use crate::ground::{Ground, agv, depot};
use crate::kept_away;
use crate::links::Extent;
use crate::linux::{Linux, LinuxManager, accept, named};
use crate::speaker::{HANDSHAKE, PATIENCE, Speaker};
use crate::tally::{Counters, Report, Row};
use crate::target::Target;
use crate::trial::risen;

/// Datagrams in a row, before a unit is given time to read them: its kernel drops what it has no room for.
const BURST: usize = 40;
/// Counters that rise when a unit accepts a `WhoHas` or an `Announce`.
const BELIEVED: [&str; 5] = ["WhoHasHeard", "AnnounceHeard", "AnnounceSent", "AnnounceBroadcast", "Dialled"];

/// Keys that are lent.
pub(crate) struct Lent<'r>(pub(crate) &'r KeyRing);

impl Keyring for Lent<'_> {
    fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
        Keyring::discovery(self.0)
    }

    fn pair(&self, peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
        Keyring::pair(self.0, peer)
    }
}

/// The keys in the flash of a stolen vehicle: the fleet's, and one pair key, which is used for every destination.
struct Thief<'r>(&'r KeyRing);

impl Keyring for Thief<'_> {
    fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
        Keyring::discovery(self.0)
    }

    fn pair(&self, _peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
        Keyring::pair(self.0, &depot())
    }
}

/// All identities that can be announced.
fn identities(count: u32) -> Vec<Identity> {
    let others = (2..2 + count / 4).map(|id| Identity::m_unit("depot", id).expect("a short name"));
    std::iter::once(depot()).chain(others).chain((1..=count).map(agv)).collect()
}

fn who_has(who: &Identity, wanted_depot: bool) -> WhoHas {
    WhoHas {
        identity: who.clone(),
        epoch: Epoch(fastrand::u64(..)),
        sequence: u32::MAX,
        nonce: fastrand::u64(1..),
        wanted: wanted_depot.then(|| cara_std::Manager::new("depot", 1).expect("a short name")),
        tcp_port: 666,
        expected: 1,
        known: Default::default(),
        standby: false,
        skipped: 0,
    }
}

fn announce(who: &Identity, nonce: u64, tcp_port: u16) -> Announce {
    let epoch = Epoch(fastrand::u64(..));
    Announce {
        identity: who.clone(),
        epoch,
        claim: None,
        obeyed: None,
        sequence: u32::MAX,
        nonce,
        tcp_port,
        room: 100,
        expected: 1,
        skipped: 0,
    }
}

/// Datagrams without a valid code, made from one with another sender's codes.
fn forgeries(bytes: &[u8], fleet: Fleet) -> Vec<Vec<u8>> {
    let signed = bytes.get(..bytes.len() - CODE_BYTES).unwrap_or_default();
    let mut flipped = bytes.to_vec();
    let at = fastrand::usize(12..bytes.len());
    if let Some(byte) = flipped.get_mut(at) {
        *byte ^= 1 << fastrand::u8(0..8);
    }
    let mut plain = bytes.to_vec();
    plain.iter_mut().zip(cara_core::config::PLAIN_MAGIC).for_each(|(to, from)| *to = from);
    let mut elsewhere = bytes.to_vec();
    let number = fleet.0.wrapping_add(1).to_le_bytes();
    elsewhere.iter_mut().skip(8).zip(number).for_each(|(to, from)| *to = from);
    vec![bytes.to_vec(), [signed, &[0; CODE_BYTES]].concat(), signed.to_vec(), flipped, plain, elsewhere]
}

/// The datagrams that an attacker without the fleet's key can send in the name of an identity; `asked` is the nonce of
/// the target's own question.
fn said_of(ground: &Ground, who: &Identity, asked: u64, port: u16) -> Vec<Vec<u8>> {
    let (fleet, mut out) = (ground.fleet, [0; SEARCH_BYTES]);
    let mut said = Vec::new();
    for ring in [ground.elsewhere(), ground.earlier()] {
        let codes = Codes::Keyed(Lent(ring));
        let search = who_has(who, who.role() == Role::SUnit).encode(fleet, &codes, &mut out).map(<[u8]>::to_vec);
        let broadcast = announce(who, 0, port).encode(fleet, &codes, None, &mut out).map(<[u8]>::to_vec);
        let answer = announce(who, asked, port).encode(fleet, &codes, Some(&agv(1)), &mut out).map(<[u8]>::to_vec);
        for bytes in [search, broadcast, answer].into_iter().flatten() {
            said.extend(forgeries(&bytes, fleet));
        }
    }
    let plain = who_has(who, true).encode(fleet, &Plain, &mut out).map(<[u8]>::to_vec);
    said.extend(plain);
    said.extend(announce(who, asked, port).encode(fleet, &Plain, None, &mut out).map(<[u8]>::to_vec));
    said
}

fn sum(counters: &Counters, names: &[&str]) -> u64 {
    names.iter().filter_map(|name| counters.get(*name)).sum()
}

/// A forger at the discovery port of a fleet.
struct Forger {
    socket: Datagrams,
    listener: TcpListener,
}

impl Forger {
    fn new(linux: &Linux) -> Result<Self> {
        let socket = Datagrams::open(Interfaces::Loopback, linux.port)?;
        Ok(Self { socket, listener: TcpListener::bind((Ipv4Addr::LOCALHOST, 0))? })
    }

    fn port(&self) -> Result<u16> {
        Ok(self.listener.local_addr()?.port())
    }

    /// The next `WhoHas` of a vehicle: its nonce and its source address.
    fn question(&self) -> Result<(u64, SocketAddr)> {
        let end = Instant::now() + PATIENCE;
        let mut buffer = [0; 2_048];
        while Instant::now() < end {
            let Some((count, from)) = self.socket.receive(Socket::Shared, &mut buffer) else {
                std::thread::sleep(Duration::from_millis(1));
                continue;
            };
            let Ok((header, body)) = Header::decode(buffer.get(..count).unwrap_or_default()) else { continue };
            if let Ok(Datagram::WhoHas(search)) = header.read(body)
                && search.identity.role() == Role::SUnit
            {
                return Ok((search.nonce, from));
            }
        }
        bail!("no vehicle asks for its manager")
    }

    /// Says all of it, no faster than it is read.
    fn say(&self, said: &[Vec<u8>], to: Option<SocketAddr>) {
        for burst in said.chunks(BURST) {
            for bytes in burst {
                match to {
                    Some(to) => drop(self.socket.send_to(to, bytes)),
                    None => drop(self.socket.broadcast(bytes)),
                }
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Says all of it until half of that was looked at, what the unit has counted then: a kernel drops what it has no room for until
    /// its unit has had a turn.
    fn say_heard(
        &self,
        said: &[Vec<u8>],
        to: Option<SocketAddr>,
        counters: impl Fn() -> Result<Counters>,
    ) -> Result<Counters> {
        let end = Instant::now() + PATIENCE;
        loop {
            let before = counters()?;
            self.say(said, to);
            std::thread::sleep(Duration::from_millis(300));
            let after = counters()?;
            let dropped = dropped(&before, &after);
            if dropped >= said.len() as u64 / 2 {
                return Ok(after);
            }
            ensure!(Instant::now() < end, "of {} datagrams only {dropped} were looked at", said.len());
        }
    }
}

/// All attacks on discovery.
pub fn run(report: &mut Report, linux: &Linux, manager: &LinuxManager<'_>, extent: Extent) -> Result<()> {
    spoof(report, linux, manager, extent)?;
    relayed(report, &alone(linux)?, extent)?;
    let starts = if extent == Extent::Full { 6 } else { 1 };
    kept_away::run(report, linux.weakness, starts, &[20, 100])
}

/// A fleet whose manager is not there, so that its vehicles ask.
fn alone(linux: &Linux) -> Result<Linux> {
    Linux::new(64, linux.weakness)
}

/// Datagrams in the name of every identity, to a manager and to a vehicle that searches.
pub fn spoof(report: &mut Report, linux: &Linux, manager: &LinuxManager<'_>, extent: Extent) -> Result<()> {
    let identities = extent.some(identities(128), 8);
    spoof_manager(report, linux, manager, &identities)?;
    spoof_vehicle(report, &alone(linux)?, &identities)
}

/// Sends a manager datagrams in the name of every identity: it dials none and answers none.
fn spoof_manager(report: &mut Report, linux: &Linux, manager: &LinuxManager<'_>, who: &[Identity]) -> Result<()> {
    let forger = Forger::new(linux)?;
    let said: Vec<_> =
        who.iter().map(|who| Ok(said_of(&linux.ground, who, 1, forger.port()?))).collect::<Result<Vec<_>>>()?.concat();
    let before = manager.counters()?;
    let after = forger.say_heard(&said, None, || manager.counters())?;
    report.add(spoofed(manager.name(), &said, &before, &after));
    Ok(())
}

/// How many datagrams a unit has looked at and dropped.
fn dropped(before: &Counters, after: &Counters) -> u64 {
    const DROPPED: [&str; 5] =
        ["DatagramForged", "DatagramMagic", "DatagramFleet", "DatagramMalformed", "DatagramNotForUs"];
    sum(after, &DROPPED) - sum(before, &DROPPED)
}

fn spoofed(target: &str, said: &[Vec<u8>], before: &Counters, after: &Counters) -> Row {
    Row {
        attack: "spoofed who-has and announces of every identity".to_owned(),
        target: target.to_owned(),
        attempts: dropped(before, after).min(said.len() as u64),
        successes: sum(after, &BELIEVED) - sum(before, &BELIEVED),
        noticed: risen(before, after),
        control: false,
    }
}

/// A vehicle searches, and every identity except its manager answers: it dials none of them.
fn spoof_vehicle(report: &mut Report, linux: &Linux, who: &[Identity]) -> Result<()> {
    let forger = Forger::new(linux)?;
    let (unit, log) = linux.vehicle(1, None)?;
    let (nonce, from) = forger.question()?;
    let thief = Codes::Keyed(Thief(&linux.ground.ring(&agv(2))));
    let mut said = Vec::new();
    for who in who {
        said.extend(said_of(&linux.ground, who, nonce, forger.port()?));
        let mut out = [0; SEARCH_BYTES];
        let stolen = announce(who, nonce, forger.port()?);
        said.extend(stolen.encode(linux.ground.fleet, &thief, Some(&agv(1)), &mut out).map(<[u8]>::to_vec));
    }
    let before = named(unit.counters());
    let after = forger.say_heard(&said, Some(from), || Ok(named(unit.counters())))?;
    let mut row = spoofed("Linux s_unit", &said, &before, &after);
    forger.listener.set_nonblocking(true)?;
    row.successes += u64::from(forger.listener.accept().is_ok()) + log.all().joins as u64;
    report.add(row);
    unit.stop();
    Ok(())
}

/// The manager's own answer, from another address and again and again: a vehicle dials in vain, and no more.
fn relayed(report: &mut Report, linux: &Linux, extent: Extent) -> Result<()> {
    let forger = Forger::new(linux)?;
    let genuine = Codes::Keyed(Lent(&linux.ground.ring(&depot())));
    let times = if extent == Extent::Full { 24 } else { 4 };
    let (mut successes, mut noticed) = (0, Vec::new());
    for id in 1..=times {
        let (unit, log) = linux.vehicle(id, None)?;
        let (nonce, from) = forger.question()?;
        let mut out = [0; SEARCH_BYTES];
        let answer = announce(&depot(), nonce, forger.port()?);
        let answer = answer.encode(linux.ground.fleet, &genuine, Some(&agv(id)), &mut out).context("it fits")?;
        let before = named(unit.counters());
        for _ in 0..8 {
            forger.socket.send_to(from, answer);
        }
        let stream = accept(&forger.listener).context("a vehicle dials the source address of its manager's answer")?;
        let claim = linux.claim_of_manager();
        let keys = linux.ground.keys(id);
        let mut speaker = Speaker::new(stream, false, cara_core::config::Mode::Secured, claim, keys.wrong)?;
        let _ = speaker.converse(HANDSHAKE);
        speaker.finish();
        forger.socket.send_to(from, answer);
        std::thread::sleep(Duration::from_millis(20));
        noticed.extend(risen(&before, &named(unit.counters())));
        unit.stop();
        successes += u64::from(log.all().joins > 0 || speaker.reported);
    }
    noticed.sort();
    noticed.dedup();
    let attack = "the manager's announce from elsewhere, and again".to_owned();
    let target = "Linux s_unit".to_owned();
    report.add(Row { attack, target, attempts: u64::from(times), successes, noticed, control: false });
    Ok(())
}
