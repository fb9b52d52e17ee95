//! Changed, spoofed and repeated datagrams of discovery, against nodes alone.

use std::net::SocketAddr;

use cara_core::config::Constraints;
use cara_core::distribution::authenticator::{Authenticator, CODE_BYTES};
use cara_core::distribution::connection_handler::{Command, Node, NodeConfig, NodeCounter, NodeStorage, Target};
use cara_core::distribution::datagram::{ANSWER_BYTES, Announce, SEARCH_BYTES};
use cara_core::distribution::hello::{ClaimReport, Manager};
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::distribution::presence::{Heard, Presence};
use cara_core::error::CloseReason;
use cara_core::host::mailman::{LinkId, Mailman};
use cara_core::time::{Duration, Instant};
use cara_secure::keyring::{Codes, Keyring};
use cara_secure::keys::{DiscoveryKey, PairKey, RootKey};
use cara_sim::Boxed;

use super::Tally;
use super::ends::Attacked;

pub(super) const FLEET: Fleet = Fleet(7);

/// An answer in the manager's name, that it is elsewhere.
pub(super) fn made_up(epoch: Epoch, claim: Option<ClaimReport>, nonce: u64) -> Announce {
    let (identity, obeyed) = (depot(), None);
    Announce { identity, epoch, claim, obeyed, sequence: 9, nonce, tcp_port: 666, room: 1, expected: 1, skipped: 0 }
}

pub(super) struct Ring {
    root: RootKey,
    discovery: DiscoveryKey,
    own: Identity,
}

impl Keyring for Ring {
    fn discovery(&self) -> (&DiscoveryKey, Option<&DiscoveryKey>) {
        (&self.discovery, None)
    }

    fn pair(&self, peer: &Identity) -> Option<(PairKey, Option<PairKey>)> {
        Some((self.root.pair(FLEET, 1, &self.own, peer), None))
    }
}

pub(super) fn codes(root: u8, own: &Identity) -> Codes<Ring> {
    let root = RootKey::new([root; 32]);
    Codes::Keyed(Ring { discovery: root.discovery(FLEET, 1), root, own: own.clone() })
}

#[derive(Default)]
pub(super) struct Outbox {
    pub(super) broadcasts: Vec<Vec<u8>>,
    pub(super) sent: Vec<(SocketAddr, Vec<u8>)>,
}

impl Mailman<SocketAddr> for Outbox {
    fn write(&mut self, _: LinkId, _: &[&[u8]]) -> Result<usize, CloseReason> {
        Ok(0)
    }

    fn send_to(&mut self, to: SocketAddr, datagram: &[u8]) -> bool {
        self.sent.push((to, datagram.to_vec()));
        true
    }

    fn broadcast(&mut self, datagram: &[u8]) -> bool {
        self.broadcasts.push(datagram.to_vec());
        true
    }
}

/// A node with its keys, and what it did.
pub(super) struct Unit {
    pub(super) node: Node<Attacked>,
    pub(super) codes: Codes<Ring>,
    pub(super) outbox: Outbox,
    pub(super) dials: Vec<SocketAddr>,
}

pub(super) fn depot() -> Identity {
    Identity::m_unit("depot", 1).expect("a name")
}

pub(super) fn agv(id: u32) -> Identity {
    Identity::s_unit("agv", id).expect("a name")
}

pub(super) fn at(millis: u64) -> Instant {
    Instant::START + Duration::from_secs(100) + Duration::from_millis(millis)
}

pub(super) fn host(number: u8) -> SocketAddr {
    SocketAddr::from(([10, 0, 0, number], 7_001))
}

impl Unit {
    fn new(identity: &Identity, target: Target<SocketAddr>) -> Self {
        Self::of_life(identity, target, at(0), u64::from(identity.id()) + 40)
    }

    /// A life of a unit that begins at `now`, with delays of its own.
    pub(super) fn of_life(identity: &Identity, target: Target<SocketAddr>, now: Instant, life: u64) -> Self {
        let config = NodeConfig {
            identity: identity.clone(),
            fleet: FLEET,
            epoch: Epoch(life),
            target,
            tcp_port: 7_000,
            udp_port: 7_001,
            constraints: Constraints::M_UNIT,
            seed: life.wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ u64::from(identity.id()),
        };
        let storage = NodeStorage {
            nodes: Boxed::slice(8),
            order: Boxed::slice(8),
            links: Boxed::slice(8),
            findings: Boxed::slice(4),
        };
        let node = Node::new(now, config, storage);
        Self { node, codes: codes(1, identity), outbox: Outbox::default(), dials: Vec::new() }
    }

    pub(super) fn manager() -> Self {
        Self::new(&depot(), Target::Everybody)
    }

    fn vehicle(id: u32) -> Self {
        Self::new(&agv(id), Target::Manager(Manager::new("depot", 1).expect("a name")))
    }

    pub(super) fn hear(&mut self, now: Instant, from: SocketAddr, bytes: &[u8]) {
        self.node.datagram(now, from, bytes, &self.codes);
    }

    pub(super) fn run(&mut self, until: Instant) {
        while self.node.next_deadline() <= until {
            let now = self.node.next_deadline();
            while let Some(action) = self.node.poll(now, &mut self.outbox, &self.codes) {
                if let Command::Dial { to, .. } = action {
                    self.dials.push(to);
                }
            }
        }
    }

    fn counted(&self, counter: NodeCounter) -> u64 {
        self.node.counters.value(counter)
    }
}

/// A vehicle that has asked, the manager's answer to it, and the manager.
fn asked() -> (Unit, Vec<u8>, Vec<u8>, Unit) {
    let (mut vehicle, mut manager) = (Unit::vehicle(17), Unit::manager());
    vehicle.run(at(2_000));
    let question = vehicle.outbox.broadcasts.last().expect("it has asked").clone();
    manager.hear(at(2_000), host(17), &question);
    manager.run(at(2_100));
    let answer = manager.outbox.sent.last().expect("it has answered").1.clone();
    (vehicle, question, answer, manager)
}

#[test]
fn a_manager_is_found_and_answers_with_no_more_than_it_was_asked_with() {
    let (mut vehicle, question, answer, _) = asked();
    assert!(question.len() >= ANSWER_BYTES && answer.len() <= ANSWER_BYTES && question.len() <= SEARCH_BYTES);
    vehicle.hear(at(2_100), host(1), &answer);
    vehicle.run(at(2_101));
    assert_eq!(vehicle.dials, [SocketAddr::from(([10, 0, 0, 1], 7_000))]);
}

#[test]
fn every_flipped_bit_of_a_question_or_answer_is_noticed() {
    let mut tally = Tally::new("bits of discovery flipped");
    let (mut vehicle, question, answer, mut manager) = asked();
    let heard = [manager.counted(NodeCounter::WhoHasHeard), vehicle.counted(NodeCounter::AnnounceHeard)];
    for (unit, bytes) in [(&mut manager, &question), (&mut vehicle, &answer)] {
        for bit in 0..bytes.len() * 8 {
            let mut changed = bytes.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            unit.hear(at(2_100), host(9), &changed);
        }
        for cut in 0..bytes.len() {
            unit.hear(at(2_100), host(9), &bytes[..cut]);
        }
        for _ in 0..bytes.len() * 9 {
            tally.note(false);
        }
    }
    assert_eq!([manager.counted(NodeCounter::WhoHasHeard), vehicle.counted(NodeCounter::AnnounceHeard)], heard);
    assert!(manager.counted(NodeCounter::DatagramForged) as usize > question.len() * 7);
    assert!(vehicle.dials.is_empty());
    tally.close();
}

/// An attacker announces every manager, with keys of another fleet and with none, with the nonce of the question.
#[test]
fn spoofed_announces_lead_nowhere() {
    let mut tally = Tally::new("spoofed announces");
    let (mut vehicle, _, answer, _) = asked();
    let nonce_of_question = {
        let (header, body) = cara_core::distribution::datagram::Header::decode(&answer).expect("a datagram");
        match header.read(body) {
            Ok(cara_core::distribution::datagram::Datagram::Announce(announce)) => announce.nonce,
            other => panic!("no announce: {other:?}"),
        }
    };
    for id in 0..500_u32 {
        for nonce in [0, nonce_of_question] {
            let name = if id == 0 { depot() } else { Identity::m_unit("depot", id).expect("a name") };
            let announce = Announce {
                identity: name.clone(),
                epoch: Epoch(u64::from(id)),
                claim: None,
                obeyed: None,
                sequence: u32::MAX,
                nonce,
                tcp_port: 666,
                room: 100,
                expected: 1,
                skipped: 0,
            };
            let mut bytes = [0; SEARCH_BYTES];
            let forged = codes(9, &name);
            let bytes = announce.encode(FLEET, &forged, Some(&agv(17)), &mut bytes).expect("it fits").to_vec();
            vehicle.hear(at(2_100), host(66), &bytes);
            let zero = [&bytes[..bytes.len() - CODE_BYTES], &[0; CODE_BYTES]].concat();
            vehicle.hear(at(2_100), host(66), &zero);
            vehicle.run(at(2_101));
            tally.note(!vehicle.dials.is_empty());
        }
    }
    assert_eq!(vehicle.counted(NodeCounter::DatagramForged), 2_000);
    tally.close();
}

/// A unit of the fleet that has been taken over can make the fleet's code, and not that of the pair.
#[test]
fn another_unit_of_the_fleet_cannot_answer_for_the_manager() {
    let (mut vehicle, _, answer, _) = asked();
    let thief = codes(1, &agv(18));
    let signed = &answer[..answer.len() - 2 * CODE_BYTES];
    let pair = thief.sign_for(&agv(17), signed).expect("it has keys");
    let whole = [signed, &pair].concat();
    let fleet = thief.sign_for_fleet(&whole);
    vehicle.hear(at(2_100), host(66), &[&whole[..], &fleet].concat());
    vehicle.run(at(2_101));
    assert!(vehicle.dials.is_empty());
    assert_eq!(vehicle.counted(NodeCounter::DatagramNotForUs), 1);
}

/// A manager asks for its own identity: only holders of its keys answer, and only to this very question. What was said
/// before, by it or by another life of it, and what a stolen vehicle's keys can make, keeps it from starting no more than
/// its own words do.
#[test]
fn nobody_without_a_manager_s_own_key_keeps_it_from_starting() {
    let mut tally = Tally::new("answers that a manager runs already");
    let mut out = [0; SEARCH_BYTES];
    let own = codes(1, &depot());
    let mut asking = Presence::new(depot(), FLEET, Epoch(500), 77);
    let question = asking.question(&own, &mut out).expect("it fits").to_vec();
    // A live one answers, with what it has.
    let mut running = Unit::manager();
    running.hear(at(2_000), host(1), &question);
    running.run(at(2_001));
    let answer = running.outbox.sent.last().expect("it answers").1.clone();
    let reported = asking.hear(host(1), &answer, &own, &mut out);
    assert_eq!(reported, Heard::Running { at: SocketAddr::from(([10, 0, 0, 1], 7_000)), claim: None });
    assert!(answer.len() <= question.len());
    // The next start has another nonce, and that answer is an old one.
    let next = Presence::new(depot(), FLEET, Epoch(600), 78);
    for bytes in [&answer, &question] {
        for codes in [&own, &codes(9, &depot())] {
            tally.note(matches!(next.hear(host(66), bytes, codes, &mut out), Heard::Running { .. }));
        }
    }
    // With the fleet's key and another pair's.
    let thief = codes(1, &agv(18));
    for epoch in [1, 599, 600, 601, u64::MAX] {
        for nonce in [0, 1, 78 | 1] {
            let announce = made_up(Epoch(epoch), None, nonce);
            let mut bytes = [0; SEARCH_BYTES];
            for to in [None, Some(depot()), Some(agv(18))] {
                let Some(bytes) = announce.encode(FLEET, &thief, to.as_ref(), &mut bytes) else { continue };
                tally.note(matches!(next.hear(host(66), bytes, &own, &mut out), Heard::Running { .. }));
            }
        }
    }
    // Its own answer to a made-up question with its own nonce, sent back.
    let mut bytes = [0; SEARCH_BYTES];
    let mut made_up = Presence::new(depot(), FLEET, Epoch(1), 78);
    let made_up = made_up.question(&thief, &mut bytes).expect("it fits").to_vec();
    let mut out = [0; SEARCH_BYTES];
    let Heard::Answer(mirrored) = next.hear(host(66), &made_up, &own, &mut out) else { panic!("an earlier one asks") };
    let mirrored = mirrored.to_vec();
    tally.note(next.hear(host(66), &mirrored, &own, &mut [0; SEARCH_BYTES]) != Heard::Nothing);
    tally.close();
}

/// A replayed answer of a manager changes nothing, at any time and from any address.
#[test]
fn an_announce_that_was_recorded_changes_nothing() {
    let mut tally = Tally::new("recorded announces once more");
    let (mut vehicle, _, answer, _) = asked();
    vehicle.hear(at(2_100), host(1), &answer);
    vehicle.run(at(2_101));
    assert_eq!(vehicle.dials.len(), 1);
    for later in 1..200_u64 {
        let now = at(2_101 + later * 37);
        vehicle.hear(now, host(66), &answer);
        vehicle.run(now);
        let elsewhere = vehicle.dials.iter().any(|to| to.ip() == host(66).ip());
        tally.note(elsewhere);
    }
    assert!(vehicle.counted(NodeCounter::Outdated) > 0);
    tally.close();
}
