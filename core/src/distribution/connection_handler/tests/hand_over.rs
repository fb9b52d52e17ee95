//! Hand-over of a vehicle to another manager: it belongs to one of the two at each step, whatever dies.

use super::super::claims::{MayMove, STORING};
use super::claims::{Keyed, claim, report, tagged};
use super::*;
use crate::config::HAND_OVER_TIMEOUT;
use crate::distribution::message::HandOverRefusal;

const OLD: LinkId = LinkId(0);
const NEW: LinkId = LinkId(1);
const ASKED: u64 = 1_000;

fn other() -> Manager {
    Manager::new("yard", 9).unwrap()
}

fn identity(manager: &Manager) -> Identity {
    manager.identity().unwrap()
}

fn hello(manager: &Manager, term: u64) -> Hello {
    Hello { claim: report(claim(term), 0), ..hello_of(&m_unit(&manager.name, manager.id)) }
}

/// A vehicle of the depot that stores claims.
fn vehicle() -> Node<InMemory> {
    let mut node = node(s_unit("agv", 1));
    node.store_claims();
    assert_eq!(node.admit(at(0), OLD, address(1, 7_000), &hello(&manager(), 3)), Admission::Accept);
    node
}

/// The same, on its way to the other manager.
fn leaving() -> Node<InMemory> {
    let mut node = vehicle();
    assert_eq!(node.hand_over(at(ASKED), OLD, other()), Ok(()));
    node.left(at(ASKED), OLD, CloseReason::StoppedHere);
    node
}

/// The same, joined there; returns what is to be stored.
fn arrived() -> (Node<InMemory>, Option<ClaimEvent>) {
    let mut node = leaving();
    assert_eq!(node.admit(at(2_000), NEW, address(2, 7_000), &hello(&other(), 5)), Admission::Accept);
    let event = poll(&mut node, 2_000).1;
    (node, event)
}

fn poll(node: &mut Node<InMemory>, millis: u64) -> (Option<Command<SocketAddr>>, Option<ClaimEvent>) {
    let command = node.poll(at(millis), &mut Outbox::default(), &Keyed);
    (command, node.take_claim_event())
}

fn belongs_to(node: &Node<InMemory>, manager: &Manager) -> bool {
    node.manager() == Some(manager) && node.target == manager.identity()
}

#[test]
fn what_is_stored_on_joining_is_the_commit() {
    let (mut node, event) = arrived();
    assert_eq!(event, Some(ClaimEvent::Keep(identity(&other()), tagged(claim(5)))));
    let both = Some((identity(&manager()), identity(&other())));
    assert_eq!(node.handed_over(&identity(&other())), both, "stored with the claim");
    assert_eq!(node.handed_over(&identity(&manager())), None, "a late claim of the old manager is no commit");
    assert_eq!(node.may_move(at(2_100), &identity(&other())), MayMove::Waits, "nothing moves before");
    assert_eq!(node.take_hand_over(), Some((identity(&other()), HandOverStage::Leaves)));
    assert_eq!(node.take_hand_over(), None);
    node.claim_kept(&identity(&other()), claim(5), true);
    assert_eq!(node.take_hand_over(), Some((identity(&other()), HandOverStage::Moved)));
    assert_eq!(node.take_hand_over(), None);
    assert_eq!(node.may_move(at(2_200), &identity(&other())), MayMove::Yes);
    assert_eq!(node.handed_over(&identity(&manager())), both);
    node.left(at(31_000), NEW, CloseReason::Silent);
    poll(&mut node, 60_000);
    assert!(belongs_to(&node, &other()), "it waits for its new manager");
}

/// Moving calls are refused then, so that what is behind them in the queue goes on.
#[test]
fn a_disk_that_hangs_keeps_it_still_and_is_reported_once() {
    let (mut node, _) = arrived();
    let late_from = 2_000 + STORING.as_millis();
    assert!(node.next_deadline() <= at(late_from));
    let reported = |node: &mut Node<InMemory>, millis| {
        let event = poll(node, millis).1;
        (event, node.may_move(at(millis), &identity(&other())), node.counters.value(NodeCounter::ClaimsNotKept))
    };
    assert_eq!(reported(&mut node, late_from - 1), (None, MayMove::Waits, 0));
    let unkept = Some(ClaimEvent::Unkept(identity(&other()), claim(5)));
    assert_eq!(reported(&mut node, late_from), (unkept, MayMove::No, 1));
    // A link that is lost and opened again changes nothing.
    node.left(at(5_000), NEW, CloseReason::Silent);
    assert_eq!(node.admit(at(6_000), LinkId(2), address(2, 7_000), &hello(&other(), 5)), Admission::Accept);
    assert_eq!(reported(&mut node, 60_000), (None, MayMove::No, 1));
    node.claim_kept(&identity(&other()), claim(5), true);
    assert_eq!(reported(&mut node, 60_100), (None, MayMove::Yes, 1));
    assert!(belongs_to(&node, &other()));
}

/// As a program without claims answers: there is nothing to store the hand-over with.
#[test]
fn a_new_manager_without_a_claim_is_left_again_in_time() {
    let mut node = leaving();
    let unclaimed = Hello { claim: None, ..hello(&other(), 5) };
    assert_eq!(node.admit(at(2_000), NEW, address(2, 7_000), &unclaimed), Admission::Accept);
    assert_eq!(node.may_move(at(2_000), &identity(&other())), MayMove::No);
    let close = Command::Notify(NEW, Directive::Close(CloseReason::StoppedHere));
    assert_eq!(poll(&mut node, 11_000).0, Some(close));
    assert!(belongs_to(&node, &manager()));
}

#[test]
fn without_the_new_manager_it_goes_back_in_time() {
    let mut node = leaving();
    let until = at(ASKED) + HAND_OVER_TIMEOUT;
    assert!(node.next_deadline() <= until);
    (1_100..10_950).step_by(50).for_each(|millis| drop(poll(&mut node, millis)));
    poll(&mut node, 10_999);
    assert!(belongs_to(&node, &other()));
    assert_eq!(node.handed_over(&identity(&other())), None, "it has not joined there");
    assert_eq!(
        node.admit(at(10_999), OLD, address(1, 7_000), &hello(&manager(), 3)),
        Admission::Refuse(Refusal::WrongManager)
    );
    assert_eq!(node.take_hand_over(), Some((identity(&other()), HandOverStage::Leaves)));
    poll(&mut node, 11_000);
    assert_eq!(node.take_hand_over(), Some((identity(&manager()), HandOverStage::Returns)));
    assert!(belongs_to(&node, &manager()) && node.handed_over(&identity(&manager())).is_none());
    assert!(node.searches_at() <= at(11_400), "soon, however long it searched for the other one");
    assert_eq!(
        node.admit(at(11_100), NEW, address(2, 7_000), &hello(&other(), 5)),
        Admission::Refuse(Refusal::WrongManager)
    );
    assert_eq!(node.admit(at(11_200), OLD, address(1, 7_000), &hello(&manager(), 3)), Admission::Accept);
    assert_eq!(node.may_move(at(11_300), &identity(&manager())), MayMove::Waits, "its claim is stored first, as ever");
    node.claim_kept(&identity(&manager()), claim(3), true);
    assert_eq!(node.may_move(at(11_400), &identity(&manager())), MayMove::Yes);
}

/// A link that is being opened when it goes back is closed.
#[test]
fn a_dial_that_is_under_way_does_not_outlive_the_hand_over() {
    let mut node = leaving();
    let config = m_unit(&other().name, other().id);
    let announce = Announce { claim: report(claim(5), 0), ..announce_of(&config, 1, node.search.nonce) };
    let mut bytes = [0; SEARCH_BYTES];
    let answer = announce.encode(FLEET, &Keyed, Some(&s_unit("agv", 1).identity), &mut bytes).unwrap();
    node.datagram(at(10_900), address(2, 7_001), answer, &Keyed);
    let dialled = poll(&mut node, 10_900).0;
    assert!(matches!(dialled, Some(Command::Dial { .. })), "{dialled:?}");
    node.dialing(Some(&identity(&other())), NEW);
    let close = Command::Notify(NEW, Directive::Close(CloseReason::StoppedHere));
    assert_eq!(poll(&mut node, 11_000).0, Some(close));
    assert!(belongs_to(&node, &manager()));
}

#[test]
fn a_hand_over_that_cannot_be_stored_leads_back() {
    let (mut node, _) = arrived();
    node.claim_kept(&identity(&other()), claim(5), false);
    let close = Command::Notify(NEW, Directive::Close(CloseReason::StoppedHere));
    let keep = ClaimEvent::Keep(identity(&manager()), tagged(claim(3)));
    assert_eq!(poll(&mut node, 2_200), (Some(close), Some(keep)), "whatever the disk says by now");
    assert_eq!(node.may_move(at(2_200), &identity(&other())), MayMove::No, "though its link has not ended yet");
    assert!(belongs_to(&node, &manager()) && node.handed_over(&identity(&manager())).is_none());
    node.left(at(2_200), NEW, CloseReason::StoppedHere);
    assert_eq!(node.admit(at(2_300), OLD, address(1, 7_000), &hello(&manager(), 3)), Admission::Accept);
}

#[test]
fn a_manager_that_dies_while_its_claim_is_stored_has_the_vehicle() {
    let (mut node, _) = arrived();
    node.left(at(2_100), NEW, CloseReason::Silent);
    poll(&mut node, 20_000);
    assert!(belongs_to(&node, &other()), "what is on the disk is not known");
    node.claim_kept(&identity(&other()), claim(5), true);
    poll(&mut node, 20_100);
    assert!(belongs_to(&node, &other()) && !node.moving.is_underway());
}

#[test]
fn a_claim_that_is_raised_meanwhile_is_the_one_that_commits() {
    let (mut node, _) = arrived();
    node.claim_raised(&identity(&other()), &report(claim(6), 0).unwrap());
    assert_eq!(node.next_deadline(), Instant::START, "it is polled at once");
    assert_eq!(poll(&mut node, 2_100).1, Some(ClaimEvent::Keep(identity(&other()), tagged(claim(6)))));
    node.claim_kept(&identity(&other()), claim(5), true);
    assert!(node.moving.is_underway());
    node.claim_kept(&identity(&other()), claim(6), true);
    assert!(!node.moving.is_underway());
}

#[test]
fn after_a_restart_it_belongs_to_whom_it_has_stored() {
    let home = identity(&manager());
    for (stored_at, owner) in [(&home, other()), (&identity(&Manager::new("hall", 8).unwrap()), manager())] {
        let mut node = node(s_unit("agv", 1));
        node.belong_to(stored_at, &identity(&other()));
        assert!(belongs_to(&node, &owner));
        assert_eq!(node.admit(at(100), OLD, address(1, 7_000), &hello(&owner, 3)), Admission::Accept);
    }
}

#[test]
fn it_goes_on_to_a_third_manager_and_home_again() {
    let (mut node, _) = arrived();
    assert_eq!(node.hand_over(at(2_100), NEW, manager()), Err(HandOverRefusal::Underway), "it is not stored yet");
    node.claim_kept(&identity(&other()), claim(5), true);
    assert_eq!(node.hand_over(at(2_200), NEW, manager()), Ok(()));
    node.left(at(2_200), NEW, CloseReason::StoppedHere);
    assert_eq!(node.admit(at(2_300), OLD, address(1, 7_000), &hello(&manager(), 3)), Admission::Accept);
    node.claim_kept(&identity(&manager()), claim(3), true);
    assert!(node.handed_over(&identity(&manager())).is_none() && belongs_to(&node, &manager()));
}

#[test]
fn what_stands_against_a_hand_over() {
    let asked = |node: &mut Node<InMemory>, link, to| node.hand_over(at(ASKED), link, to);
    assert_eq!(asked(&mut vehicle(), NEW, other()), Err(HandOverRefusal::Other), "another link than its manager's");
    assert_eq!(asked(&mut vehicle(), OLD, manager()), Err(HandOverRefusal::Other));
    assert_eq!(asked(&mut depot(), OLD, other()), Err(HandOverRefusal::Other), "a manager");
    let fixed = NodeConfig { target: Target::Fixed(manager(), address(1, 7_000)), ..s_unit("agv", 1) };
    assert_eq!(asked(&mut node(fixed), OLD, other()), Err(HandOverRefusal::Fixed));
    let mut forgetful = node(s_unit("agv", 1));
    assert_eq!(forgetful.admit(at(0), OLD, address(1, 7_000), &hello(&manager(), 3)), Admission::Accept);
    assert_eq!(asked(&mut forgetful, OLD, other()), Err(HandOverRefusal::NotStored));
    let mut followed = vehicle();
    let again = followed.admit(at(ASKED), NEW, address(1, 41_000), &hello(&manager(), 3));
    assert_eq!(again, Admission::Wait, "it would take the place of the link that ends");
    assert_eq!(asked(&mut followed, OLD, other()), Err(HandOverRefusal::Underway));
    let mut full = vehicle();
    (20..23).for_each(|id| full.keep_obeyed(at(0), &Identity::m_unit("old", id).unwrap(), tagged(claim(1))));
    assert_eq!(asked(&mut full, OLD, other()), Err(HandOverRefusal::NotStored), "no place for one more claim");
}
