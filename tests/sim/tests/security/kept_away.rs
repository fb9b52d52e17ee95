//! Recorded and forged discovery while a vehicle starts: how long it takes to join.

use std::net::SocketAddr;

use cara_core::config::HELLO_TIMEOUT;
use cara_core::distribution::connection_handler::{Command, Target};
use cara_core::distribution::datagram::{Announce, SEARCH_BYTES};
use cara_core::distribution::hello::Manager;
use cara_core::distribution::identity::Epoch;
use cara_core::error::CloseReason;
use cara_core::host::mailman::LinkId;
use cara_core::time::{Duration, Instant};

use super::discovery::{FLEET, Outbox, Unit, agv, at, codes, depot, host};

/// A datagram takes so long.
const LATENCY: Duration = Duration::from_millis(1);
/// Where the attacker is, with a listener that says nothing.
const LIAR: u8 = 66;
/// Starts of a vehicle for each attack and rate.
const STARTS: u64 = 50;
const LIMIT: Duration = Duration::from_secs(2);

/// What an attacker sends, over and over.
#[derive(Clone, Copy, Debug)]
enum Attack {
    Calm,
    /// A `WhoHas` of each of two earlier boots of the manager, in turn.
    EarlierLives,
    /// Announces of the manager, each of another boot, with the discovery key of a stolen vehicle.
    Forged,
    /// One `WhoHas` of another vehicle.
    Vehicle,
}

/// What the first broadcast of a unit says.
fn recorded(mut unit: Unit) -> Vec<u8> {
    unit.run(at(2_000));
    unit.outbox.broadcasts.remove(0)
}

fn wanted() -> Target<SocketAddr> {
    Target::Manager(Manager::new("depot", 1).expect("a name"))
}

fn recordings(attack: Attack) -> Vec<Vec<u8>> {
    match attack {
        Attack::Calm => Vec::new(),
        Attack::EarlierLives => {
            [900, 7_000].map(|life| recorded(Unit::of_life(&depot(), Target::Everybody, at(0), life))).to_vec()
        }
        Attack::Vehicle => vec![recorded(Unit::of_life(&agv(18), wanted(), at(0), 800))],
        Attack::Forged => (0..200)
            .map(|life| {
                let announce = Announce {
                    identity: depot(),
                    epoch: Epoch(10_000 - life),
                    claim: None,
                    obeyed: None,
                    sequence: u32::MAX,
                    nonce: 0,
                    tcp_port: 666,
                    room: 100,
                    expected: u16::MAX,
                    skipped: 0,
                };
                let mut bytes = [0; SEARCH_BYTES];
                announce.encode(FLEET, &codes(1, &agv(18)), None, &mut bytes).expect("it fits").to_vec()
            })
            .collect(),
    }
}

/// What is on its way, and what a dial comes to.
enum Coming {
    ToVehicle(SocketAddr, Vec<u8>),
    ToManager(SocketAddr, Vec<u8>),
    Silence(LinkId),
}

struct Ground {
    vehicle: Unit,
    manager: Unit,
    coming: Vec<(Instant, Coming)>,
    links: u16,
    joined: Option<Instant>,
}

impl Ground {
    fn new(start: Instant, life: u64) -> Self {
        let mut manager = Unit::of_life(&depot(), Target::Everybody, at(0), 5_000 + life);
        manager.run(start);
        manager.outbox = Outbox::default();
        let vehicle = Unit::of_life(&agv(17), wanted(), start, 100 + life);
        Self { vehicle, manager, coming: Vec::new(), links: 0, joined: None }
    }

    fn deliver(&mut self, now: Instant) {
        let (due, later) = std::mem::take(&mut self.coming).into_iter().partition(|(at, _)| *at <= now);
        self.coming = later;
        let due: Vec<(Instant, Coming)> = due;
        for (_, coming) in due {
            match coming {
                Coming::ToVehicle(from, bytes) => self.vehicle.hear(now, from, &bytes),
                Coming::ToManager(from, bytes) => self.manager.hear(now, from, &bytes),
                Coming::Silence(link) => self.vehicle.node.left(now, link, CloseReason::HelloTimeout),
            }
        }
    }

    fn send(&mut self, at: Instant) {
        for bytes in self.vehicle.outbox.broadcasts.drain(..) {
            self.coming.push((at, Coming::ToManager(host(17), bytes)));
        }
        for bytes in self.manager.outbox.broadcasts.drain(..) {
            self.coming.push((at, Coming::ToVehicle(host(1), bytes)));
        }
        for (to, bytes) in self.vehicle.outbox.sent.drain(..).filter(|(to, _)| *to == host(1)) {
            debug_assert_eq!(to, host(1));
            self.coming.push((at, Coming::ToManager(host(17), bytes)));
        }
        for (_, bytes) in self.manager.outbox.sent.drain(..).filter(|(to, _)| *to == host(17)) {
            self.coming.push((at, Coming::ToVehicle(host(1), bytes)));
        }
    }

    fn work(&mut self, now: Instant) {
        while let Some(action) = self.vehicle.node.poll(now, &mut self.vehicle.outbox, &self.vehicle.codes) {
            let Command::Dial { to, identity } = action else { panic!("{action:?}") };
            let link = LinkId(self.links % 8);
            self.links += 1;
            self.vehicle.node.dialing(identity.as_ref(), link);
            if to.ip() != host(1).ip() {
                self.coming.push((now + HELLO_TIMEOUT, Coming::Silence(link)));
                continue;
            }
            self.joined = Some(now);
        }
        assert!(self.manager.node.poll(now, &mut self.manager.outbox, &self.manager.codes).is_none());
        self.send(now + LATENCY);
    }
}

/// How long a vehicle takes to join while `said` goes out so often a second, to all; and to it alone where `quietly`.
fn join(said: &[Vec<u8>], a_second: u64, quietly: bool, life: u64) -> Option<Duration> {
    let start = at(20_000 + life * 37);
    let mut ground = Ground::new(start, life);
    let pause = Duration::from_micros(1_000_000 / a_second);
    let mut next = start + pause.divided_by(1 + life % 7);
    let mut words = said.iter().cycle();
    let mut now = start;
    while ground.joined.is_none() && now < start + Duration::from_secs(120) {
        if now >= next {
            next = next + pause;
            if let Some(bytes) = words.next() {
                ground.vehicle.hear(now, host(LIAR), bytes);
                if !quietly {
                    ground.manager.hear(now, host(LIAR), bytes);
                }
            }
        }
        ground.deliver(now);
        ground.work(now);
        now = now + LATENCY;
    }
    ground.joined.map(|joined| joined.since(start))
}

/// Nothing of what an attacker without the pair's key repeats or makes up keeps a vehicle from its manager.
#[test]
fn a_starting_vehicle_joins_whatever_is_recorded_or_forged() {
    println!("| attack | a second | median | worst of {STARTS} |\n|---|---|---|---|");
    for attack in [Attack::Calm, Attack::EarlierLives, Attack::Forged, Attack::Vehicle] {
        let said = recordings(attack);
        for a_second in [1, 4, 20, 100] {
            for quietly in [false, true] {
                let joins = (0..STARTS).map(|life| join(&said, a_second, quietly, life));
                let mut joins: Vec<_> = joins.map(|join| join.unwrap_or(Duration::from_secs(120))).collect();
                joins.sort();
                let (median, worst) = (joins[joins.len() / 2], joins[joins.len() - 1]);
                let to = if quietly { ", to the vehicle alone" } else { "" };
                println!("| {attack:?}{to} | {a_second} | {} ms | {} ms |", median.as_millis(), worst.as_millis());
                assert!(worst <= LIMIT, "{attack:?} {a_second} a second{to}: {worst:?}");
            }
        }
    }
}
