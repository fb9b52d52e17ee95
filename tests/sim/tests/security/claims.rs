//! Claims: what an attacker without the keys of the manager says of them fences no manager and moves no vehicle.

use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::distribution::connection_handler::{ClaimEvent, Target};
use cara_core::distribution::datagram::{Announce, Datagram, SEARCH_BYTES};
use cara_core::distribution::hello::ClaimReport;
use cara_core::distribution::identity::Epoch;
use cara_core::time::Duration;
use cara_sim::{UnitEvent, World};

use super::Tally;
use super::discovery::{FLEET, Unit, agv, at, codes, depot, host, made_up};

fn genuine(term: u64) -> TaggedClaim {
    let claim = Claim { term, claimant: 1 };
    claim.tagged(&depot(), &codes(1, &depot())).expect("it has the key")
}

/// The question of a running manager to another one of its identity, and the manager.
fn asked() -> (Unit, u64) {
    let mut running = Unit::manager();
    running.node.set_claim(genuine(5));
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

fn answer(nonce: u64, tagged: TaggedClaim) -> Announce {
    made_up(Epoch(99), Some(ClaimReport { tagged, since: 0 }), nonce)
}

/// With no key, with those of a stolen vehicle, and with an answer to another question.
#[test]
fn nobody_without_its_keys_fences_a_manager() {
    let mut tally = Tally::new("forged and repeated answers that a manager of a higher claim runs");
    let (mut running, nonce) = asked();
    let mut out = [0; SEARCH_BYTES];
    for thief in [codes(9, &depot()), codes(1, &agv(18)), codes(9, &agv(18))] {
        for nonce in [0, nonce, nonce ^ 2] {
            for to in [None, Some(depot()), Some(agv(18))] {
                for tagged in [genuine(6), TaggedClaim { tag: [1; 16], ..genuine(6) }] {
                    let Some(bytes) = answer(nonce, tagged).encode(FLEET, &thief, to.as_ref(), &mut out) else {
                        continue;
                    };
                    running.hear(at(2_010), host(66), bytes);
                    tally.note(running.node.take_claim_event().is_some());
                }
            }
        }
    }
    let own = codes(1, &depot());
    let right = answer(nonce, genuine(6)).encode(FLEET, &own, Some(&depot()), &mut out).expect("it fits").to_vec();
    for (place, _) in right.iter().enumerate() {
        let mut changed = right.clone();
        changed[place] ^= 1;
        running.hear(at(2_020), host(66), &changed);
        tally.note(running.node.take_claim_event().is_some());
    }
    let forged = TaggedClaim { claim: Claim { term: 7, claimant: 1 }, ..genuine(6) };
    let forged = answer(nonce, forged).encode(FLEET, &own, Some(&depot()), &mut out).expect("it fits").to_vec();
    running.hear(at(2_025), host(2), &forged);
    tally.note(running.node.take_claim_event().is_some());
    tally.close();
    running.hear(at(2_030), host(2), &right);
    assert_eq!(running.node.take_claim_event(), Some(ClaimEvent::StepDown(genuine(6))), "the right one does");
}

/// Units with keys of another fleet that claim high terms, as manager and as vehicle.
#[test]
fn a_hello_without_the_keys_moves_no_claim() {
    let mut tally = Tally::new("hellos with a high claim of units without the keys");
    for seed in 0..8 {
        let mut world = World::secured(seed);
        let manager = world.m_unit("depot", 1).start();
        let vehicle = world.s_unit("agv", 7).joins("depot", 1).start();
        assert!(world.run_until(|_| vehicle.is_connected("depot"), Duration::from_secs(20)));
        let claim = manager.claim();
        let mut to = manager.address();
        to.set_port(7_000);
        let posing = world.s_unit("agv", 8).joins_at("depot", 1, to).keys_of_root(3);
        let _posing = posing.has_obeyed("depot", 1, genuine(1_000)).start();
        let rival = world.m_unit("depot", 1).keys_of_root(3).kept_term(1_000).start();
        let mut at = rival.address();
        at.set_port(7_000);
        let misled = world.s_unit("agv", 9).joins_at("depot", 1, at).start();
        world.run_for(Duration::from_secs(60));
        let moved = vehicle.claim() != claim || manager.claim() != claim || misled.claim() != Claim::NONE;
        tally.note(moved || !manager.is_running());
        assert!(vehicle.is_connected("depot"));
    }
    tally.close();
}

/// A thief has the key of one vehicle. What it says of its claims costs the manager that vehicle.
#[test]
fn the_key_of_a_vehicle_ends_no_manager_and_raises_no_claim() {
    let mut tally = Tally::new("claims that a holder of a vehicle's key says it has obeyed");
    for seed in 0..8 {
        let mut world = World::secured(seed);
        let manager = world.m_unit("depot", 1).start();
        let vehicle = world.s_unit("agv", 7).joins("depot", 1).start();
        assert!(world.run_until(|_| vehicle.is_connected("depot"), Duration::from_secs(20)));
        let claim = manager.claim();
        let replayed = TaggedClaim { claim: Claim { term: 100, claimant: 1 }, tag: manager.tagged_claim().tag };
        for (id, tagged) in
            [(8, TaggedClaim { tag: [9; 16], ..genuine(100) }), (9, replayed), (10, manager.tagged_claim())]
        {
            let _thief = world.s_unit("agv", id).joins("depot", 1).has_obeyed("depot", 1, tagged).start();
        }
        world.run_for(Duration::from_secs(90));
        tally.note(manager.claim() != claim || !manager.is_running() || !vehicle.is_connected("depot"));
    }
    tally.close();
}

/// Genuine claims, of earlier starts of this manager and of one on another host, that the thief of one or of ten vehicles' keys replays:
/// it is raised above a higher one, once, and neither the manager nor another vehicle ends anything.
#[test]
fn a_claim_of_long_ago_that_stolen_keys_replay_ends_nothing() {
    let mut tally = Tally::new("true claims of earlier starts that a holder of one or of ten vehicles' keys replays");
    for (seed, kept) in (0..3).flat_map(|seed| [0, 3, 4, 5, 40].map(|kept| (seed, kept))) {
        for thieves in [1, 10] {
            let mut earlier = World::secured(100 + seed);
            let before = earlier.m_unit("depot", 1).kept_term(kept).start();
            earlier.run_for(Duration::from_secs(10));
            let old = before.tagged_claim();
            assert_eq!(old.claim.term, kept + 1);
            let mut world = World::secured(seed);
            let manager = world.m_unit("depot", 1).kept_term(4).start();
            let vehicle = world.s_unit("agv", 7).joins("depot", 1).start();
            assert!(world.run_until(|_| vehicle.is_connected("depot"), Duration::from_secs(20)));
            for id in 20..20 + thieves {
                let _thief = world.s_unit("agv", id).joins("depot", 1).has_obeyed("depot", 1, old).start();
            }
            world.run_for(Duration::from_secs(90));
            let left = vehicle.count(|event| matches!(event, UnitEvent::Left { .. }));
            let highest = (old.claim.term + 1).max(5);
            tally.note(!manager.is_running() || left > 0 || manager.claim().term > highest);
            assert_eq!((vehicle.is_connected("depot"), vehicle.claim()), (true, manager.claim()));
        }
    }
    tally.close();
}
