//! Terms: which of two managers of one identity commands, and that no counter locks a manager out.

use super::*;
use crate::config::CHALLENGE_TIMEOUT;
use crate::term::Term;

fn of_term(term: u32) -> Hello {
    Hello { term: Term(term), ..hello_of(&m_unit(MANAGER, MANAGER_ID)) }
}

/// A vehicle that has obeyed this term.
fn vehicle(obeyed: u32) -> Node<InMemory> {
    let mut node = node(s_unit("agv", 1));
    node.set_term(Term(obeyed));
    node
}

fn admit(node: &mut Node<InMemory>, link: u16, hello: &Hello) -> Admission {
    node.admit(at(1_000), LinkId(link), address(1, 7_000), hello)
}

const FENCED: Admission = Admission::Refuse(Refusal::Fenced);

#[test]
fn a_vehicle_takes_a_newer_term_and_refuses_an_older_one() {
    let mut node = vehicle(5);
    assert_eq!(admit(&mut node, 0, &of_term(4)), FENCED);
    assert_eq!((node.take_newer_term(), node.counters.value(NodeCounter::RefusedFenced)), (None, 1));
    assert_eq!(admit(&mut node, 0, &of_term(0)), FENCED, "one that says none");
    assert_eq!(admit(&mut node, 0, &of_term(5)), Admission::Accept);
    assert_eq!(node.take_newer_term(), None, "nothing to be kept");
    node.left(at(3_000), LinkId(0), CloseReason::Silent);
    assert_eq!(admit(&mut node, 0, &of_term(6)), Admission::Accept);
    assert_eq!((node.take_newer_term(), node.take_newer_term()), (Some(NewerTerm::Obeyed(Term(6))), None));
    node.left(at(6_000), LinkId(0), CloseReason::Silent);
    assert_eq!(admit(&mut node, 0, &of_term(5)), FENCED);
    assert_eq!(node.hello(at(6_000), LinkId(0)).term, Term(6), "a manager hears what fences it");
}

#[test]
fn no_counter_locks_a_manager_out() {
    for obeyed in [0, 1, 5, (1 << 31) - 1, 1 << 31, u32::MAX - 1, u32::MAX] {
        for lost in [0, 1, 5, 1 << 31, u32::MAX] {
            let (mut node, mut claims) = (vehicle(obeyed), Term(lost).next());
            let first = admit(&mut node, 0, &of_term(claims.0));
            if first == FENCED {
                claims = node.term().next();
                assert_eq!(admit(&mut node, 0, &of_term(claims.0)), Admission::Accept, "{obeyed}, {lost}");
            }
        }
    }
}

#[test]
fn a_newer_manager_takes_the_place_of_one_that_is_alive() {
    let mut node = vehicle(0);
    assert_eq!(admit(&mut node, 0, &of_term(5)), Admission::Accept);
    let newer = Hello { epoch: Epoch(7), ..of_term(6) };
    assert_eq!(admit(&mut node, 1, &newer), Admission::Wait);
    assert_eq!(node.term(), Term(5), "as long as an order may be live");
    let commands = run(&mut node, at(1_000), &mut Outbox::default());
    let told: Vec<_> = commands.into_iter().map(|(_, command)| command).collect();
    assert_eq!(told, [tell(0, Directive::Challenge), tell(0, Directive::Close(CloseReason::PeerRestarted))]);
    node.challenge_answered(at(1_001), LinkId(0));
    node.left(at(1_001), LinkId(0), CloseReason::PeerRestarted);
    assert_eq!(due(&mut node, at(1_001)), [tell(1, Directive::Admit)]);
    assert_eq!((node.term(), node.take_newer_term()), (Term(6), Some(NewerTerm::Obeyed(Term(6)))));
}

/// As before there were terms: the older one shows whether it is alive.
#[test]
fn an_equal_term_of_another_boot_is_challenged() {
    let mut node = vehicle(0);
    assert_eq!(admit(&mut node, 0, &of_term(5)), Admission::Accept);
    let double = Hello { epoch: Epoch(7), ..of_term(5) };
    assert_eq!(admit(&mut node, 1, &double), Admission::Wait);
    assert_eq!(due(&mut node, at(1_000)), [tell(0, Directive::Challenge)]);
    node.challenge_answered(at(1_000) + CHALLENGE_TIMEOUT.divided_by(2), LinkId(0));
    let refused = tell(1, Directive::Refuse(Refusal::DuplicateIdentity));
    assert_eq!(due(&mut node, at(1_200)), [refused]);
}

#[test]
fn a_manager_hears_of_a_newer_term_from_a_vehicle() {
    let mut node = depot();
    node.set_term(Term(5));
    let agv = |obeyed| Hello { term: Term(obeyed), ..hello_of(&s_unit("agv", 1)) };
    assert_eq!(admit(&mut node, 0, &agv(6)), FENCED);
    assert_eq!((node.take_newer_term(), node.take_newer_term()), (Some(NewerTerm::AtVehicle(Term(6))), None));
    for (link, obeyed) in [(0, 5), (1, 4), (2, 0)] {
        let other = Hello { identity: Identity::s_unit("agv", obeyed).unwrap(), ..agv(obeyed) };
        assert_eq!(admit(&mut node, link, &other), Admission::Accept);
    }
    // What another m_unit claims is no matter of this one.
    let hall = Hello { term: Term(9), ..hello_of(&m_unit("hall", 9)) };
    assert_eq!(admit(&mut node, 3, &hall), Admission::Accept);
    assert_eq!(node.take_newer_term(), None);
}

/// Two managers with one identity: the broadcast of the newer one makes the older one ask it, and its answer fences.
#[test]
fn of_two_managers_that_meet_the_older_one_hears_it() {
    let (mut older, mut newer) = (depot(), node(NodeConfig { epoch: Epoch(7), ..m_unit(MANAGER, MANAGER_ID) }));
    older.set_term(Term(5));
    newer.set_term(Term(6));
    let (here, there) = (address(1, 7_001), address(2, 7_001));
    let mut outbox = Outbox::default();
    run(&mut newer, at(100), &mut outbox);
    older.hear(at(100), there, &outbox.broadcasts[0]);
    assert_eq!(older.take_newer_term(), None, "a broadcast proves nothing");
    let mut outbox = Outbox::default();
    while older.poll(at(101), &mut outbox, &Plain).is_some() {}
    for (_, bytes) in &outbox.sent {
        newer.hear(at(102), here, bytes);
    }
    assert_eq!(
        (newer.take_newer_term(), newer.another_proven_at()),
        (None, Some(at(102))),
        "the older one has answered"
    );
    let mut outbox = Outbox::default();
    while newer.poll(at(103), &mut outbox, &Plain).is_some() {}
    let questions = |sent: &[(SocketAddr, Vec<u8>)]| {
        sent.iter().filter(|(to, bytes)| *to == here && matches!(read(bytes), Datagram::WhoHas(_))).count()
    };
    assert_eq!((outbox.sent.len(), questions(&outbox.sent)), (1, 0), "they do not ask each other without end");
    older.hear(at(104), there, &outbox.sent[0].1);
    assert_eq!(older.take_newer_term(), Some(NewerTerm::OfManager(Term(6))));
    assert_eq!((older.take_newer_term(), older.another_proven_at()), (None, Some(at(104))));
}

#[test]
fn an_answer_to_no_question_fences_no_manager() {
    let mut node = depot();
    node.set_term(Term(5));
    let double = NodeConfig { epoch: Epoch(7), ..m_unit(MANAGER, MANAGER_ID) };
    for nonce in [0, 77, node.search.nonce ^ 2] {
        let announce = Announce { term: Term(6), ..announce_of(&double, 1, nonce) };
        node.hear(at(10), address(2, 7_001), &announce_bytes(&announce));
    }
    let own = Announce { term: Term(6), ..announce_of(&m_unit(MANAGER, MANAGER_ID), 1, 0) };
    node.answered(at(10), address(2, 7_001), &own);
    assert_eq!((node.take_newer_term(), node.another_proven_at()), (None, None));
    node.answered(at(11), address(2, 7_001), &Announce { term: Term(5), ..announce_of(&double, 2, 0) });
    assert_eq!((node.take_newer_term(), node.another_proven_at()), (None, Some(at(11))), "equal terms: as it was");
}
