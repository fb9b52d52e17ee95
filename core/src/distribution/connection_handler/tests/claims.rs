//! Claims: which of two managers of one identity commands; and that nothing a peer says ends more than its own link.

use std::{println, vec};

use super::*;
use crate::distribution::authenticator::{Authenticator, CODE_BYTES};
use crate::distribution::claim::{Claim, TaggedClaim};
use crate::distribution::hello::ClaimReport;

/// A code that only holders of a key can make. All units here have the key; tags are made by hand.
const GENUINE: [u8; CODE_BYTES] = [7; CODE_BYTES];

pub(super) struct Keyed;

impl Authenticator for Keyed {
    fn mode(&self) -> Mode {
        Mode::Secured
    }

    fn sign_for_fleet(&self, _: &[u8]) -> [u8; CODE_BYTES] {
        GENUINE
    }

    fn is_of_fleet(&self, _: &[u8], code: &[u8; CODE_BYTES]) -> bool {
        *code == GENUINE
    }

    fn sign_for(&self, _: &Identity, _: &[u8]) -> Option<[u8; CODE_BYTES]> {
        Some(GENUINE)
    }

    fn is_of(&self, _: &Identity, _: &[u8], code: &[u8; CODE_BYTES]) -> bool {
        *code == GENUINE
    }
}

pub(super) fn claim(term: u64) -> Claim {
    Claim { term, claimant: 4 }
}

pub(super) fn tagged(claim: Claim) -> TaggedClaim {
    TaggedClaim { claim, tag: GENUINE }
}

pub(super) fn report(claim: Claim, since: u32) -> Option<ClaimReport> {
    Some(ClaimReport { tagged: tagged(claim), since })
}

pub(super) fn forged(claim: Claim) -> Option<ClaimReport> {
    Some(ClaimReport { tagged: TaggedClaim { claim, tag: [8; CODE_BYTES] }, since: ClaimReport::NEVER })
}

/// The hello of the manager with this claim.
fn of_claim(claim: Claim) -> Hello {
    Hello { claim: report(claim, ClaimReport::NEVER), ..hello_of(&m_unit(MANAGER, MANAGER_ID)) }
}

/// A vehicle that has obeyed this claim in an earlier boot.
fn vehicle(obeyed: Claim) -> Node<InMemory> {
    let mut node = node(s_unit("agv", 1));
    let depot = Identity::m_unit(MANAGER, MANAGER_ID).unwrap();
    node.keep_obeyed(at(0), &depot, tagged(obeyed));
    node.store_claims();
    node
}

fn managed(term: u64) -> Node<InMemory> {
    let mut node = depot();
    node.set_claim(tagged(claim(term)));
    node
}

fn admit(node: &mut Node<InMemory>, link: u16, hello: &Hello) -> Admission {
    admit_at(node, at(1_000), link, hello)
}

fn admit_at(node: &mut Node<InMemory>, now: Instant, link: u16, hello: &Hello) -> Admission {
    node.admit(now, LinkId(link), address(1, 7_000), hello)
}

const SOON: u64 = 400;

const FENCED: Admission = Admission::Refuse(Refusal::Fenced);

/// The hello of a vehicle.
fn agv(id: u32, obeyed: Option<ClaimReport>) -> Hello {
    Hello { obeyed, ..hello_of(&s_unit("agv", id)) }
}

/// Polls as a port does until `end`; returns the claim events, and how often the node asked for its own identity.
fn watch(node: &mut Node<InMemory>, from: Instant, end: Instant) -> (Vec<ClaimEvent>, usize) {
    let (mut events, mut outbox, mut now) = (Vec::new(), Outbox::default(), from);
    while now <= end {
        while node.poll(now, &mut outbox, &Keyed).is_some() {}
        events.extend(core::iter::from_fn(|| node.take_claim_event()));
        now = node.next_deadline().max(now + Duration::from_millis(1)).min(now + Duration::from_millis(100));
    }
    let is_own = |bytes: &&Vec<u8>| match Datagram::decode(bytes, FLEET, &Keyed) {
        Ok(Datagram::WhoHas(who_has)) => who_has.wanted.is_some(),
        _ => false,
    };
    let asked = outbox.broadcasts.iter().filter(is_own).count();
    (events, asked)
}

/// Managers with no claim, a lower one, the next lower, the same and a higher one.
#[test]
fn a_vehicle_obeys_the_highest_claim_and_refuses_lower_ones() {
    let obeyed = Claim { term: 5, claimant: 4 };
    let lower = [Claim::NONE, claim(1), claim(4), Claim { term: 5, claimant: 3 }];
    for refused in lower {
        let mut node = vehicle(obeyed);
        assert_eq!(admit(&mut node, 0, &of_claim(refused)), FENCED, "{refused:?}");
        assert_eq!((node.claim(), node.counters.value(NodeCounter::RefusedFenced)), (obeyed, 1));
        let hello = node.hello(at(9_000), LinkId(0), 1);
        assert_eq!(hello.obeyed, report(obeyed, 9_000), "a manager hears what fences it, and how old it is");
    }
    let without = Hello { claim: None, ..of_claim(obeyed) };
    assert_eq!(admit(&mut vehicle(obeyed), 0, &without), FENCED);
    for taken in [obeyed, Claim { term: 5, claimant: 5 }, claim(6), claim(u64::MAX)] {
        let mut node = vehicle(obeyed);
        assert_eq!(admit(&mut node, 0, &of_claim(taken)), Admission::Accept, "{taken:?}");
        assert_eq!(node.claim(), taken);
        node.left(at(3_000), LinkId(0), CloseReason::Silent);
        assert_eq!(admit_at(&mut node, at(3_001), 0, &of_claim(claim(4))), FENCED);
    }
}

#[test]
fn a_connected_manager_raises_its_claim_and_cannot_lower_it() {
    let manager = Identity::m_unit(MANAGER, MANAGER_ID).unwrap();
    let mut node = vehicle(claim(5));
    assert_eq!(admit(&mut node, 0, &of_claim(claim(6))), Admission::Accept);
    for said in [claim(8), claim(7), Claim::NONE, claim(8)] {
        node.claim_raised(&manager, &report(said, 0).unwrap());
        assert_eq!(node.claim(), claim(8), "{said:?}");
    }
}

/// Two managers of one identity have answered, and the link of one was faster.
#[test]
fn a_vehicle_asks_again_who_has_offered_a_higher_claim_than_it_obeys() {
    for (offered, expected) in [(claim(6), vec![address(9, 7_001)]), (claim(4), vec![])] {
        let mut node = node(s_unit("agv", 1));
        let announce = announce_of(&m_unit(MANAGER, MANAGER_ID), 1, 0);
        node.answered(at(900), address(9, 7_001), &Announce { claim: report(offered, 0), ..announce });
        assert_eq!(admit(&mut node, 0, &of_claim(claim(5))), Admission::Accept);
        let mut outbox = Outbox::default();
        run(&mut node, at(2_000), &mut outbox);
        assert_eq!(outbox.sent.iter().map(|(to, _)| *to).collect::<Vec<_>>(), expected, "{offered:?}");
    }
}

/// It is stored before the first moving call under it, not when the manager joins.
#[test]
fn a_claim_is_stored_before_the_first_moving_call() {
    let manager = Identity::m_unit(MANAGER, MANAGER_ID).unwrap();
    let joined = || {
        let mut node = vehicle(claim(5));
        assert_eq!(admit(&mut node, 0, &of_claim(claim(6))), Admission::Accept);
        assert_eq!(node.take_claim_event(), None, "it has only joined");
        assert_eq!([2_000, 2_010].map(|millis| node.may_move(at(millis), &manager)), [MayMove::Waits; 2]);
        let keep = ClaimEvent::Keep(manager.clone(), tagged(claim(6)));
        assert_eq!((node.take_claim_event(), node.take_claim_event()), (Some(keep), None), "asked once");
        node
    };
    let mut stored = joined();
    stored.claim_kept(&manager, claim(6), true);
    assert_eq!((stored.may_move(at(2_020), &manager), stored.take_claim_event()), (MayMove::Yes, None));
    let unkept = Some(ClaimEvent::Unkept(manager.clone(), claim(6)));
    let mut failed = joined();
    failed.claim_kept(&manager, claim(6), false);
    assert_eq!(failed.may_move(at(2_020), &manager), MayMove::Yes);
    assert_eq!((failed.take_claim_event(), failed.take_claim_event()), (unkept.clone(), None));
    let mut late = joined();
    assert_eq!([3_999, 4_000].map(|millis| late.may_move(at(millis), &manager)), [MayMove::Waits, MayMove::Yes]);
    assert_eq!((late.take_claim_event(), late.counters.value(NodeCounter::ClaimsNotKept)), (unkept, 1));
    // A claim stored in an earlier boot need not be stored again, and a unit that stores none does not wait.
    let mut kept = vehicle(claim(5));
    assert_eq!(admit(&mut kept, 0, &of_claim(claim(5))), Admission::Accept);
    // Its port checks whether the pair key has changed: now, and whenever the peer has authenticated itself again.
    let keep = || Some(ClaimEvent::Keep(manager.clone(), tagged(claim(5))));
    assert_eq!(kept.may_move(at(2_000), &manager), MayMove::Yes);
    assert_eq!((kept.take_claim_event(), kept.take_claim_event()), (keep(), None));
    kept.proven_anew(&manager);
    assert_eq!(kept.may_move(at(2_000), &manager), MayMove::Yes);
    assert_eq!((kept.take_claim_event(), kept.take_claim_event()), (keep(), None));
    let mut forgetful = node(s_unit("agv", 1));
    assert_eq!(admit(&mut forgetful, 0, &of_claim(claim(5))), Admission::Accept);
    assert_eq!(forgetful.may_move(at(2_000), &manager), MayMove::Yes);
}

/// With a vehicle's key, or by mistake: whatever claim it says it has obeyed, the manager loses only that vehicle.
#[test]
fn a_fence_costs_a_manager_that_vehicle_and_nothing_else() {
    for obeyed in [forged(claim(100)), forged(claim(u64::MAX)), report(claim(6), 0), report(claim(5).raised(5), 100)] {
        let mut node = managed(5);
        assert_eq!(admit(&mut node, 0, &agv(1, None)), Admission::Accept);
        assert_eq!(admit(&mut node, 1, &agv(2, obeyed)), FENCED);
        let fenced = Identity::s_unit("agv", 2).unwrap();
        let under = node.node(&fenced).and_then(Known::under);
        assert_eq!(under, obeyed.map(|report| report.claim()));
        assert_eq!(node.s_units().count(), 2, "it stays on the roster");
        let (events, _) = watch(&mut node, at(1_001), at(1_900));
        assert_eq!((events, node.claim(), node.number_of_s_units()), (vec![], claim(5), 1));
    }
    for obeyed in [None, report(Claim::NONE, 0), report(claim(4), 0), report(claim(5), 0)] {
        assert_eq!(admit(&mut managed(5), 1, &agv(2, obeyed)), Admission::Accept);
    }
}

#[test]
fn a_manager_takes_no_claim_below_its_own_and_has_a_rival_until_it_has_none_above() {
    let mut node = managed(5);
    // Its keys are other ones.
    let renewed = TaggedClaim { tag: [9; CODE_BYTES], ..tagged(claim(5)) };
    for (set, has) in [(renewed, renewed), (tagged(claim(4)), renewed)] {
        node.set_claim(set);
        assert_eq!(node.hello(at(1_000), LinkId(9), 1).claim.map(|report| report.tagged), Some(has));
    }
    assert_eq!(admit(&mut node, 0, &agv(2, report(claim(7), 0))), FENCED);
    watch(&mut node, at(1_000), at(1_100));
    for (set, has_rival) in [(claim(6), true), (claim(7), false)] {
        node.set_claim(tagged(set));
        assert_eq!((node.claim(), node.has_rival()), (set, has_rival));
    }
}

#[test]
fn a_claim_without_a_genuine_tag_is_never_raised_above() {
    let mut node = managed(5);
    for link in 0..10 {
        assert_eq!(admit(&mut node, link, &agv(2, forged(claim(100)))), FENCED);
    }
    let (events, asked) = watch(&mut node, at(1_001), at(60_000));
    assert_eq!((events, asked), (vec![], 0));
}

#[test]
fn a_manager_raises_its_claim_when_nobody_has_heard_the_other_one() {
    // The other manager was heard just now, and nobody reports anything of it later.
    let mut node = managed(5);
    assert_eq!(admit(&mut node, 0, &agv(2, report(claim(7), 0))), FENCED);
    assert_eq!(watch(&mut node, at(1_000), at(20_000)).0, vec![]);
    // A vehicle reports that it was not heard for 3 s: the vehicles are asked once more, for a second.
    assert_eq!(admit_at(&mut node, at(20_000), 0, &agv(2, report(claim(7), 19_000))), FENCED);
    let (events, asked) = watch(&mut node, at(20_001), at(23_000));
    assert_eq!(events, vec![ClaimEvent::Raise(claim(7))]);
    assert!(asked >= 2);
    node.set_claim(tagged(claim(7).raised(1)));
    assert_eq!(admit_at(&mut node, at(23_100), 0, &agv(2, report(claim(7), 0))), Admission::Accept);
    // Not again within 30 s, and then after twice as long each time.
    assert_eq!(admit_at(&mut node, at(23_200), 1, &agv(3, report(claim(9), 60_000))), FENCED);
    assert_eq!(watch(&mut node, at(23_200), at(50_000)).0, vec![]);
    assert_eq!(watch(&mut node, at(50_100), at(56_000)).0, vec![ClaimEvent::Raise(claim(9))]);
    assert_eq!(watch(&mut node, at(56_100), at(110_000)).0, vec![], "storing failed, and a minute is not over");
}

#[test]
fn questions_before_a_raise_do_not_count_for_the_next() {
    let mut node = managed(5);
    assert_eq!(admit(&mut node, 0, &agv(2, report(claim(7), 60_000))), FENCED);
    assert_eq!(watch(&mut node, at(1_000), at(5_900)).0, vec![ClaimEvent::Raise(claim(7))]);
    node.set_claim(tagged(claim(8)));
    assert_eq!(watch(&mut node, at(5_900), at(60_000)).0, vec![]);
    assert_eq!(admit_at(&mut node, at(60_000), 0, &agv(2, report(claim(9), 60_000))), FENCED);
    assert_eq!(watch(&mut node, at(60_000), at(63_900)).0, vec![]);
    assert_eq!(watch(&mut node, at(63_950), at(66_000)).0, vec![ClaimEvent::Raise(claim(9))]);
}

/// What vehicles said before the port found that it may not claim, they may say no longer: they are asked again first.
#[test]
fn a_claim_that_could_not_be_raised_is_raised_on_new_evidence_only() {
    let mut node = managed(5);
    assert_eq!(admit(&mut node, 0, &agv(2, report(claim(7), 60_000))), FENCED);
    let raised = |node: &mut Node<InMemory>, start: u64| {
        let mut outbox = Outbox::default();
        let mut asked = (0, 0);
        for now in (start..start + 10_000).step_by(50) {
            while node.poll(at(now), &mut outbox, &Keyed).is_some() {}
            for bytes in core::mem::take(&mut outbox.broadcasts) {
                match Datagram::decode(&bytes, FLEET, &Keyed) {
                    Ok(Datagram::WhoHas(WhoHas { wanted: Some(_), .. })) => asked.0 += 1,
                    Ok(Datagram::WhoHas(_)) => asked.1 += 1,
                    _ => {}
                }
            }
            if let Some(event) = node.take_claim_event() {
                assert_eq!(event, ClaimEvent::Raise(claim(7)));
                return (now, asked);
            }
        }
        panic!("it raises no claim");
    };
    let (mut now, _) = raised(&mut node, 1_000);
    for _ in 0..5 {
        node.not_raised(at(now));
        let (next, (own, vehicles)) = raised(&mut node, now);
        assert!((3_000..=6_000).contains(&(next - now)) && own >= 3 && vehicles > 0, "{now} {next} {own} {vehicles}");
        now = next;
    }
    // A vehicle has heard the other manager meanwhile.
    node.not_raised(at(now));
    for second in now / 1_000..now / 1_000 + 20 {
        assert_eq!(admit_at(&mut node, at(second * 1_000), 0, &agv(2, report(claim(7), 200))), FENCED);
        assert_eq!(watch(&mut node, at(second * 1_000), at(second * 1_000 + 990)).0, vec![]);
    }
}

/// The vehicle that heard the other manager is switched off before it has not heard it for 3 s.
#[test]
fn a_manager_with_an_authority_raises_its_claim_although_no_vehicle_speaks_any_more() {
    let fenced = |since| {
        let mut node = managed(5);
        node.claims_by_key();
        assert_eq!(admit(&mut node, 0, &agv(2, report(claim(7), since))), FENCED);
        node
    };
    let mut node = fenced(500);
    // Three questions, and one to the vehicles.
    assert_eq!(watch(&mut node, at(1_000), at(4_900)).0, vec![]);
    assert_eq!(watch(&mut node, at(4_950), at(5_200)).0, vec![ClaimEvent::Raise(claim(7))]);
    // Without the key it may not, and asks anew.
    node.not_raised(at(5_200));
    assert_eq!(watch(&mut node, at(5_200), at(9_000)).0, vec![]);
    assert_eq!(watch(&mut node, at(9_050), at(11_000)).0, vec![ClaimEvent::Raise(claim(7))]);
    // A vehicle that is there says that it hears the other one.
    let mut node = fenced(500);
    for now in (1_000..60_000).step_by(2_000) {
        assert_eq!(admit_at(&mut node, at(now), 0, &agv(2, report(claim(7), 200))), FENCED);
        assert_eq!(watch(&mut node, at(now), at(now + 1_990)).0, vec![]);
    }
    // As does the other one itself.
    let mut node = fenced(500);
    for now in (1_000..60_000).step_by(2_000) {
        let mut outbox = Outbox::default();
        while node.poll(at(now), &mut outbox, &Keyed).is_some() {}
        let nonce = node.claims.questions.nonce;
        hear(&mut node, at(now), &answer(nonce, None));
        assert_eq!(watch(&mut node, at(now), at(now + 1_990)).0, vec![]);
    }
}

/// A manager searches for them every 1 to 2 s.
#[test]
fn a_thousand_vehicles_do_not_say_at_the_same_moment_what_they_have_obeyed() {
    let search = WhoHas { expected: 1_000, ..search_of(&m_unit(MANAGER, MANAGER_ID), 1) };
    let depot = Identity::m_unit(MANAGER, MANAGER_ID).unwrap();
    let mut bytes = 0;
    let mut answered: Vec<_> = (1..=1_000)
        .map(|id| {
            let mut node = node(s_unit("agv", id));
            node.keep_obeyed(at(0), &depot, tagged(claim(5)));
            run(&mut node, at(SOON), &mut Outbox::default());
            node.hear(at(SOON), address(9, 7_001), &who_has_bytes(&search));
            let mut outbox = Outbox::default();
            while outbox.sent.is_empty() {
                let now = node.next_deadline();
                while node.poll(now, &mut outbox, &Plain).is_some() {}
                if !outbox.sent.is_empty() {
                    assert!(as_announce(&outbox.sent[0].1).obeyed.is_some());
                    bytes += outbox.sent[0].1.len();
                    return now;
                }
            }
            at(0)
        })
        .collect();
    answered.sort();
    let after =
        |from: Instant| answered.iter().filter(|at| (from..from + Duration::from_millis(10)).contains(at)).count();
    let most = answered.iter().map(|from| after(*from)).max().unwrap();
    println!("{bytes} bytes in {:?}, {most} answers within 10 ms", answered[999].since(at(SOON)));
    assert!(most < 100 && answered[999] <= at(SOON + 500), "{most} {:?}", answered[999]);
}

/// Its vehicles report that it lives, whenever they hear this manager's search.
#[test]
fn a_manager_that_is_heard_by_a_vehicle_is_not_raised_above() {
    let mut node = managed(5);
    for second in 1..60 {
        assert_eq!(admit_at(&mut node, at(second * 1_000), 0, &agv(2, report(claim(7), 200))), FENCED);
        assert_eq!(watch(&mut node, at(second * 1_000), at(second * 1_000 + 990)).0, vec![]);
    }
}

#[test]
fn a_pause_of_its_own_or_sockets_that_are_not_empty_start_the_count_again() {
    let fenced = || {
        let mut node = managed(5);
        assert_eq!(admit(&mut node, 0, &agv(2, report(claim(7), 60_000))), FENCED);
        assert_eq!(watch(&mut node, at(1_000), at(3_900)).0, vec![], "three questions, and one of vehicles");
        node
    };
    let mut suspended = fenced();
    assert_eq!(watch(&mut suspended, at(3_603_000), at(3_606_900)).0, vec![], "what came meanwhile is not read yet");
    assert_eq!(watch(&mut suspended, at(3_606_950), at(3_609_000)).0, vec![ClaimEvent::Raise(claim(7))]);
    let mut flooded = fenced();
    for second in 4..60 {
        flooded.left_unread();
        assert_eq!(watch(&mut flooded, at(second * 1_000), at(second * 1_000 + 950)).0, vec![]);
    }
}

/// The question of a running manager for its own identity.
fn question(node: &mut Node<InMemory>, now: Instant) -> WhoHas {
    let mut outbox = Outbox::default();
    while node.poll(now, &mut outbox, &Keyed).is_some() {}
    let asked = outbox.broadcasts.iter().find_map(|bytes| match Datagram::decode(bytes, FLEET, &Keyed) {
        Ok(Datagram::WhoHas(who_has)) if who_has.wanted.is_some() => Some(who_has),
        _ => None,
    });
    asked.expect("it asks for itself")
}

pub(super) fn answer(nonce: u64, claim: Option<ClaimReport>) -> Announce {
    let double = NodeConfig { epoch: Epoch(99), ..m_unit(MANAGER, MANAGER_ID) };
    Announce { claim, ..announce_of(&double, 1, nonce) }
}

pub(super) fn hear(node: &mut Node<InMemory>, now: Instant, announce: &Announce) {
    let depot = Identity::m_unit(MANAGER, MANAGER_ID).unwrap();
    let mut out = [0; SEARCH_BYTES];
    let bytes = announce.encode(FLEET, &Keyed, Some(&depot), &mut out).unwrap();
    node.datagram(now, address(9, 7_000), bytes, &Keyed);
}

#[test]
fn of_two_live_managers_the_lower_claim_steps_down() {
    let mut node = managed(5);
    assert_eq!(admit(&mut node, 0, &agv(2, report(claim(7), 60_000))), FENCED);
    let nonce = question(&mut node, at(1_001)).nonce;
    for (wrong, why) in [
        (answer(nonce ^ 2, report(claim(7), 0)), "another question's answer"),
        (answer(0, report(claim(7), 0)), "a broadcast"),
        (answer(nonce, forged(claim(7))), "a tag that is not genuine"),
        (answer(nonce, None), "no claim"),
        (answer(nonce, report(claim(5), 0)), "its own"),
        (answer(nonce, report(claim(4), 0)), "a lower one"),
    ] {
        hear(&mut node, at(1_002), &wrong);
        assert_eq!(node.take_claim_event(), None, "{why}");
    }
    hear(&mut node, at(1_003), &answer(nonce, report(claim(7), 0)));
    assert_eq!(node.take_claim_event(), Some(ClaimEvent::StepDown(tagged(claim(7)))));
}

#[test]
fn an_answer_starts_the_count_again() {
    let mut node = managed(5);
    assert_eq!(admit(&mut node, 0, &agv(2, report(claim(7), 60_000))), FENCED);
    let mut outbox = Outbox::default();
    for now in (1_000..60_000).step_by(100) {
        while node.poll(at(now), &mut outbox, &Keyed).is_some() {}
        for bytes in core::mem::take(&mut outbox.broadcasts) {
            // The other manager lives, but does not report its claim.
            let Ok(Datagram::WhoHas(who_has)) = Datagram::decode(&bytes, FLEET, &Keyed) else { continue };
            hear(&mut node, at(now), &answer(who_has.nonce, None));
        }
        assert_eq!(node.take_claim_event(), None);
    }
}

#[test]
fn a_manager_that_takes_over_raises_until_it_was_the_highest_once() {
    let mut node = managed(5);
    node.take_over(at(900));
    assert_eq!(node.hello(at(1_000), LinkId(9), 1).claim, report(claim(5), 100));
    assert_eq!(admit(&mut node, 0, &agv(2, forged(claim(80)))), FENCED);
    assert_eq!(watch(&mut node, at(1_000), at(1_100)).0, vec![]);
    assert_eq!(admit_at(&mut node, at(1_200), 0, &agv(3, report(claim(7), 0))), FENCED);
    assert_eq!(watch(&mut node, at(1_200), at(1_250)).0, vec![ClaimEvent::Raise(claim(7))]);
    node.set_claim(tagged(claim(8)));
    assert_eq!(admit_at(&mut node, at(1_300), 0, &agv(3, report(claim(7), 0))), Admission::Accept);
    assert_eq!(admit_at(&mut node, at(1_400), 1, &agv(4, report(claim(9), 0))), FENCED);
    assert_eq!(watch(&mut node, at(1_400), at(3_000)).0, vec![], "as any other manager");
}

/// A connected s_unit asks another boot of its manager, and yields to a higher claim only.
#[test]
fn a_connected_vehicle_gives_way_to_a_higher_claim_that_is_proven() {
    let manager = Identity::m_unit(MANAGER, MANAGER_ID).unwrap();
    let cases = [
        (None, false, false),
        (report(claim(5), 0), false, false),
        (report(claim(6), 0), false, true),
        (report(claim(6), 0), true, false),
    ];
    for (heard, is_raised, gives_way) in cases {
        let mut node = node(s_unit("agv", 1));
        assert_eq!(admit(&mut node, 0, &of_claim(claim(5))), Admission::Accept);
        let newer = NodeConfig { epoch: Epoch(99), ..m_unit(MANAGER, MANAGER_ID) };
        node.hear(at(5_000), address(9, 7_001), &who_has_bytes(&search_of(&newer, 1)));
        let mut outbox = Outbox::default();
        assert_eq!(run(&mut node, at(5_200), &mut outbox), []);
        let asked = outbox.sent.iter().find_map(|(_, bytes)| match read(bytes) {
            Datagram::WhoHas(who_has) => Some(who_has),
            _ => None,
        });
        let reported = outbox.sent.iter().find_map(|(_, bytes)| match read(bytes) {
            Datagram::Announce(announce) => Some(announce),
            _ => None,
        });
        assert_eq!(reported.expect("it says whom it obeys").obeyed, report(claim(5), 0));
        let asked = asked.expect("it asks");
        let replayed = Announce { claim: report(claim(6), 0), ..announce_of(&newer, 1, asked.nonce ^ 2) };
        node.hear(at(5_201), address(9, 7_001), &announce_bytes(&replayed));
        assert_eq!(due(&mut node, at(5_202)), []);
        let announce = Announce { claim: heard, ..announce_of(&newer, 1, asked.nonce) };
        node.hear(at(5_203), address(9, 7_001), &announce_bytes(&announce));
        if is_raised {
            let raised = [Claim { claimant: 5, ..claim(5) }, claim(6), claim(6)];
            let stays = raised.map(|said| node.claim_raised(&manager, &report(said, 0).unwrap()));
            assert_eq!(stays, [false, true, false], "below the other one; not below; not raised");
        }
        let expected = if gives_way { vec![notify(0, Directive::Yield)] } else { vec![] };
        assert_eq!(due(&mut node, at(5_204)), expected);
        if gives_way {
            node.left(at(5_400), LinkId(0), CloseReason::PeerRestarted);
            let dialled = due(&mut node, at(5_401));
            assert!(matches!(&dialled[..], [Command::Dial { to, .. }] if *to == address(9, 7_000)), "{dialled:?}");
        }
    }
}

/// A door that a manager dials: the newcomer waits until the present link is silent, or is refused because the door moves.
#[test]
fn a_newcomer_with_a_higher_claim_waits_or_is_told_that_the_vehicle_drives() {
    let joined = || {
        let mut door = node(m_unit("door", 9));
        assert_eq!(admit(&mut door, 0, &of_claim(claim(5))), Admission::Accept);
        let newer = Hello { epoch: Epoch(7), ..of_claim(claim(6)) };
        assert_eq!(admit(&mut door, 1, &newer), Admission::Wait);
        assert_eq!(due(&mut door, at(1_000)), [notify(0, Directive::Yield)]);
        door
    };
    let mut silent = joined();
    assert_eq!(due(&mut silent, at(1_300)), [notify(0, Directive::Close(CloseReason::PeerRestarted))]);
    silent.left(at(1_301), LinkId(0), CloseReason::PeerRestarted);
    assert!(due(&mut silent, at(1_301)).contains(&notify(1, Directive::Admit)));
    let manager = Identity::m_unit(MANAGER, MANAGER_ID).unwrap();
    assert_eq!(silent.obeyed(&manager), claim(6));
    let mut alive = joined();
    alive.challenge_answered(at(1_100), LinkId(0));
    assert_eq!(due(&mut alive, at(1_100)), [notify(1, Directive::Refuse(Refusal::Driving))]);
    assert_eq!(alive.obeyed(&manager), claim(5));
    // The present manager raises its claim meanwhile, below the other one and then above it.
    let mut raised = joined();
    let stays = [Claim { claimant: 5, ..claim(5) }, claim(7)]
        .map(|said| raised.claim_raised(&manager, &report(said, 0).unwrap()));
    assert_eq!(stays, [false, true]);
    raised.challenge_answered(at(1_100), LinkId(0));
    assert_eq!(due(&mut raised, at(1_100)), [notify(1, Directive::Refuse(Refusal::Fenced))]);
    // Before it was asked: it is not to give way.
    let mut early = node(m_unit("door", 9));
    assert_eq!(admit(&mut early, 0, &of_claim(claim(5))), Admission::Accept);
    assert_eq!(admit(&mut early, 1, &Hello { epoch: Epoch(7), ..of_claim(claim(6)) }), Admission::Wait);
    assert!(early.claim_raised(&manager, &report(claim(7), 0).unwrap()));
    assert_eq!(due(&mut early, at(1_000)), [notify(0, Directive::Challenge)]);
}
