//! Terms: what an attacker without the keys says of them fences no manager and moves no vehicle.

use cara_core::distribution::connection_handler::{NewerTerm, Target};
use cara_core::distribution::datagram::{Announce, Datagram, SEARCH_BYTES};
use cara_core::distribution::identity::Epoch;
use cara_core::term::Term;
use cara_core::time::Duration;
use cara_sim::World;

use super::Tally;
use super::discovery::{FLEET, Unit, agv, at, codes, depot, host, made_up};

/// The question of a running manager to another one of its identity, and the manager.
fn asked() -> (Unit, u64) {
    let mut running = Unit::manager();
    running.node.set_term(Term(5));
    let mut other = Unit::of_life(&depot(), Target::Everybody, at(0), 99);
    other.run(at(2_000));
    let search = other.outbox.broadcasts.last().expect("it searches").clone();
    running.hear(at(2_000), host(2), &search);
    running.run(at(2_001));
    let own = codes(1, &depot());
    let nonce = running.outbox.sent.iter().find_map(|(_, bytes)| match Datagram::decode(bytes, FLEET, &own) {
        Ok(Datagram::WhoHas(who_has)) => Some(who_has.nonce),
        _ => None,
    });
    (running, nonce.expect("it asks in turn"))
}

fn answer(nonce: u64) -> Announce {
    made_up(Epoch(99), Term(6), nonce)
}

/// With no key, with those of a stolen vehicle, and with an answer to another question.
#[test]
fn nobody_without_its_keys_fences_a_manager() {
    let mut tally = Tally::new("forged and repeated answers that a newer manager runs");
    let (mut running, nonce) = asked();
    let mut out = [0; SEARCH_BYTES];
    for thief in [codes(9, &depot()), codes(1, &agv(18)), codes(9, &agv(18))] {
        for nonce in [0, nonce, nonce ^ 2] {
            for to in [None, Some(depot()), Some(agv(18))] {
                let Some(bytes) = answer(nonce).encode(FLEET, &thief, to.as_ref(), &mut out) else { continue };
                running.hear(at(2_010), host(66), bytes);
                tally.note(running.node.take_newer_term().is_some() || running.node.another_proven_at().is_some());
            }
        }
    }
    let own = codes(1, &depot());
    let right = answer(nonce).encode(FLEET, &own, Some(&depot()), &mut out).expect("it fits").to_vec();
    for (place, _) in right.iter().enumerate() {
        let mut changed = right.clone();
        changed[place] ^= 1;
        running.hear(at(2_020), host(66), &changed);
        tally.note(running.node.take_newer_term().is_some());
    }
    tally.close();
    running.hear(at(2_030), host(2), &right);
    assert_eq!(running.node.take_newer_term(), Some(NewerTerm::OfManager(Term(6))), "the right one does");
}

/// Units with keys of another fleet that claim high terms, as manager and as vehicle.
#[test]
fn a_hello_without_the_keys_moves_no_term() {
    let mut tally = Tally::new("hellos with a high term of units without the keys");
    for seed in 0..8 {
        let mut world = World::secured(seed);
        let manager = world.m_unit("depot", 1).start();
        let vehicle = world.s_unit("agv", 7).joins("depot", 1).start();
        assert!(world.run_until(|_| vehicle.is_connected("depot"), Duration::from_secs(20)));
        let mut to = manager.address();
        to.set_port(7_000);
        let _posing = world.s_unit("agv", 8).joins_at("depot", 1, to).keys_of_root(3).kept_term(1_000).start();
        let rival = world.m_unit("depot", 1).keys_of_root(3).kept_term(1_000).start();
        let mut at = rival.address();
        at.set_port(7_000);
        let misled = world.s_unit("agv", 9).joins_at("depot", 1, at).start();
        world.run_for(Duration::from_secs(60));
        tally.note(vehicle.term() != Term(1) || misled.term() != Term::NONE || !manager.is_running());
        assert!(vehicle.is_connected("depot"));
    }
    tally.close();
}
