//! A standby: what keeps it waiting, what starts it, and that nobody takes it for a manager.

use super::claims::{Keyed, answer, claim, forged, hear, report, tagged};
use super::*;
use crate::distribution::claim::Claim;
use crate::distribution::hello::ClaimReport;

/// A standby whose port has polled it up to `now`.
struct Standby {
    node: Node<InMemory>,
    now: u64,
    asked: Vec<WhoHas>,
    leads: Vec<Claim>,
    led_at: u64,
}

impl Standby {
    fn new() -> Self {
        let mut node = depot();
        node.stand_by(at(0));
        Self { node, now: 0, asked: Vec::new(), leads: Vec::new(), led_at: 0 }
    }

    /// Polls at each deadline until `end`; who is asked answers as `reply` says.
    fn run(&mut self, end: u64, mut reply: impl FnMut(&mut Node<InMemory>, u64, &WhoHas)) {
        while self.now < end {
            let mut outbox = Outbox::default();
            assert_eq!(self.node.poll(at(self.now), &mut outbox, &Keyed), None, "it opens no links");
            assert!(outbox.sent.is_empty(), "it answers nobody");
            assert!(self.node.next_deadline() > at(self.now), "nothing due remains after a poll");
            for bytes in outbox.broadcasts {
                let Ok(Datagram::WhoHas(who_has)) = Datagram::decode(&bytes, FLEET, &Keyed) else {
                    panic!("{bytes:?}")
                };
                reply(&mut self.node, self.now, &who_has);
                self.asked.push(who_has);
            }
            while let Some(event) = self.node.take_claim_event() {
                let ClaimEvent::Lead(above) = event else { panic!("{event:?}") };
                self.leads.push(above);
                self.led_at = self.now;
            }
            self.now = self.node.next_deadline().as_micros().div_ceil(1_000).max(self.now + 1);
        }
    }

    /// Until it wants to lead.
    fn until_it_leads(&mut self, limit: u64, reply: impl Fn(&mut Node<InMemory>, u64, &WhoHas)) -> u64 {
        let (start, leads) = (self.now, self.leads.len());
        while self.leads.len() == leads {
            assert!(self.now < start + limit, "{:?}", self.asked);
            self.run(self.now + 1, &reply);
        }
        self.led_at - start
    }
}

fn nobody(_: &mut Node<InMemory>, _: u64, _: &WhoHas) {}

/// The answer of a manager that commands.
fn manages(claim: Option<ClaimReport>) -> impl Fn(&mut Node<InMemory>, u64, &WhoHas) {
    move |node, now, who_has| hear(node, at(now), &answer(who_has.nonce, claim))
}

/// The answer of a vehicle that heard its manager last at `heard`.
fn vehicle(heard: u64, claim: Claim) -> impl Fn(&mut Node<InMemory>, u64, &WhoHas) {
    move |node, now, who_has| {
        if who_has.wanted.is_none() {
            let obeyed = report(claim, now.saturating_sub(heard) as u32);
            hear(node, at(now), &Announce { obeyed, ..announce_of(&s_unit("agv", 2), 1, who_has.nonce) });
        }
    }
}

#[test]
fn it_asks_for_its_own_identity_once_a_second_and_says_that_it_stands_by() {
    let mut standby = Standby::new();
    standby.run(20_000, manages(report(claim(5), 0)));
    assert!((19..=20).contains(&standby.asked.len()), "{}", standby.asked.len());
    for who_has in &standby.asked {
        let marks = (who_has.standby, who_has.tcp_port, who_has.expected, who_has.wanted.clone());
        assert_eq!(marks, (true, 0, 0, Some(manager())), "vehicles are not asked while the manager answers");
    }
    assert_eq!(standby.leads, []);
    assert_eq!(standby.node.hello(at(20_000), LinkId(0), 1).claim, None, "it has no claim");
}

#[test]
fn it_starts_when_three_questions_have_no_answer_and_nobody_has_heard_the_manager_for_three_keep_alives() {
    // Nobody was ever heard.
    let mut standby = Standby::new();
    let took = standby.until_it_leads(4_000, nobody);
    assert!((2_300..=3_300).contains(&took) && standby.asked.len() == 3, "{took}: {}", standby.asked.len());
    assert_eq!(standby.leads, [Claim::NONE]);
    // The manager was there, and a vehicle heard it 500 ms longer.
    let mut standby = Standby::new();
    standby.run(10_000, manages(report(claim(5), 0)));
    let lost = standby.now + 500;
    let took = standby.until_it_leads(5_000, vehicle(lost, claim(6)));
    assert!((3_800..=3_850).contains(&took), "{took}");
    assert_eq!(standby.leads, [claim(6)], "the highest that it has heard");
    let last = standby.asked.last().unwrap();
    assert_eq!((last.wanted.clone(), last.standby), (None, true), "vehicles are asked too");
}

/// A vehicle says that it hears its manager until it misses a keep-alive, after 1.5 s.
#[test]
fn what_a_vehicle_knows_better_a_question_later_takes_the_place_of_what_it_has_said() {
    for late in (0..1_000).step_by(90) {
        let mut standby = Standby::new();
        standby.run(10_000, manages(report(claim(5), 0)));
        let lost = standby.now + late;
        let took = standby.until_it_leads(5_000, |node, now, who_has| {
            let heard = if now < lost + 1_500 { now } else { lost };
            vehicle(heard, claim(5))(node, now, who_has);
        });
        assert!((3_300..=3_350).contains(&(took - late)), "{took} {late}");
    }
}

/// One of two vehicles hears the manager, and every other answer of it is lost.
#[test]
fn a_lost_answer_of_a_vehicle_that_hears_its_manager_does_not_start_a_standby() {
    let mut standby = Standby::new();
    standby.run(10_000, manages(report(claim(5), 0)));
    let asked = core::cell::Cell::new(0);
    standby.run(60_000, |node, now, who_has| {
        vehicle(0, claim(5))(node, now, who_has);
        asked.set(asked.get() + 1);
        if asked.get() % 2 == 0 {
            vehicle(now, claim(5))(node, now, who_has);
        }
    });
    assert_eq!(standby.leads, []);
}

#[test]
fn a_vehicle_that_hears_its_manager_keeps_a_standby_waiting() {
    let mut standby = Standby::new();
    standby.run(60_000, |node, now, who_has| vehicle(now - now % 2_900, claim(5))(node, now, who_has));
    assert_eq!(standby.leads, []);
}

#[test]
fn only_a_proven_answer_to_its_last_question_keeps_it_waiting() {
    type Says = fn(&WhoHas) -> Announce;
    let says: [(&str, Says); 5] = [
        ("another question's answer", |asked| answer(asked.nonce ^ 2, report(claim(5), 0))),
        ("a broadcast", |_| answer(0, report(claim(5), 0))),
        ("its own words", |asked| Announce { epoch: Epoch(100), ..answer(asked.nonce, report(claim(5), 0)) }),
        ("a vehicle without a genuine tag", |asked| Announce {
            obeyed: forged(claim(5)).map(|report| ClaimReport { since: 0, ..report }),
            ..announce_of(&s_unit("agv", 2), 1, asked.nonce)
        }),
        ("a vehicle that has obeyed nobody", |asked| announce_of(&s_unit("agv", 2), 1, asked.nonce)),
    ];
    for (why, says) in says {
        let mut standby = Standby::new();
        standby.until_it_leads(4_000, |node, now, who_has| hear(node, at(now), &says(who_has)));
        assert_eq!(standby.leads, [Claim::NONE], "{why}");
    }
    // Its own question comes back, as from a switch with a loop, and that of another standby.
    let mut standby = Standby::new();
    let echo = |node: &mut Node<InMemory>, now, who_has: &WhoHas| {
        for epoch in [who_has.epoch, Epoch(7)] {
            let question = WhoHas { epoch, ..who_has.clone() };
            let mut out = [0; SEARCH_BYTES];
            node.datagram(at(now), address(9, 7_000), question.encode(FLEET, &Keyed, &mut out).unwrap(), &Keyed);
        }
    };
    standby.until_it_leads(4_000, echo);
    // A manager that does not say its claim lives all the same.
    let mut standby = Standby::new();
    standby.run(60_000, manages(None));
    assert_eq!(standby.leads, []);
}

#[test]
fn a_pause_unread_sockets_and_questions_that_were_not_sent_count_as_nothing() {
    let mut suspended = Standby::new();
    suspended.run(2_200, nobody);
    suspended.now += 3_600_000;
    let took = suspended.until_it_leads(4_000, nobody);
    assert!(took >= 2_300, "{took}");
    let mut flooded = Standby::new();
    for _ in 0..100 {
        flooded.node.left_unread();
        flooded.run(flooded.now + 900, nobody);
    }
    assert_eq!(flooded.leads, []);
    struct Unplugged;
    impl Mailman<SocketAddr> for Unplugged {
        fn write(&mut self, _: LinkId, _: &[&[u8]]) -> Result<usize, CloseReason> {
            panic!("a node never writes to links")
        }
        fn send_to(&mut self, _: SocketAddr, _: &[u8]) -> bool {
            panic!("it answers nobody")
        }
        fn broadcast(&mut self, _: &[u8]) -> bool {
            false
        }
    }
    let mut node = depot();
    node.stand_by(at(0));
    for now in (0..60_000).step_by(50) {
        assert_eq!(node.poll(at(now), &mut Unplugged, &Keyed), None);
        assert_eq!(node.take_claim_event(), None);
    }
}

#[test]
fn an_answer_while_its_claim_is_stored_keeps_it_a_standby() {
    let stored = || tagged(claim(6).raised(9));
    let starts = || {
        let mut standby = Standby::new();
        standby.run(3_000, manages(report(claim(6), 0)));
        standby.until_it_leads(5_000, nobody);
        assert_eq!(standby.node.take_claim_event(), None, "asked once");
        standby
    };
    let mut alone = starts();
    alone.run(alone.now + 5_000, nobody);
    assert!(alone.node.lead(at(alone.now), stored()) && !alone.node.is_standby());
    assert_eq!(alone.node.claim(), claim(6).raised(9));
    let mut late = starts();
    late.run(late.now + 2_000, manages(report(claim(6), 0)));
    assert!(!late.node.lead(at(late.now), stored()) && late.node.is_standby());
    late.until_it_leads(5_000, nobody);
    let mut heard = starts();
    heard.run(heard.now + 2_000, vehicle(heard.now, claim(6)));
    assert!(!heard.node.lead(at(heard.now), stored()));
    // A vehicle has obeyed a higher one, whose manager is silent too.
    let mut higher = starts();
    higher.run(higher.now + 2_000, vehicle(0, claim(9)));
    assert!(!higher.node.lead(at(higher.now), stored()));
    higher.until_it_leads(5_000, nobody);
    assert_eq!(higher.leads, [claim(6), claim(9)], "it claims above that one next");
    // Where storing fails it begins anew.
    let mut failed = starts();
    failed.node.stand_by(at(failed.now));
    assert!(failed.until_it_leads(5_000, nobody) >= 2_300);
    assert_eq!(failed.leads, [claim(6); 2], "it remembers what it has heard");
    // Also how long ago that was.
    let mut failed = Standby::new();
    failed.run(3_000, manages(report(claim(6), 0)));
    failed.until_it_leads(5_000, vehicle(3_000, claim(6)));
    failed.node.stand_by(at(failed.now));
    failed.until_it_leads(4_000, nobody);
}

#[test]
fn a_standby_says_above_what_it_starts_until_somebody_answers() {
    let mut standby = Standby::new();
    standby.run(3_000, manages(report(claim(6), 0)));
    assert_eq!(standby.node.starts_above(), None);
    standby.until_it_leads(5_000, nobody);
    assert_eq!(standby.node.starts_above(), Some(claim(6)));
    standby.run(standby.now + 2_000, vehicle(0, claim(9)));
    assert_eq!(standby.node.starts_above(), Some(claim(9)));
    standby.run(standby.now + 2_000, manages(report(claim(9), 0)));
    assert_eq!(standby.node.starts_above(), None);
}

/// Somebody may have answered meanwhile. The port may say first that the claim is stored, or poll first.
#[test]
fn a_claim_that_is_stored_during_a_pause_or_beside_unread_sockets_starts_nothing() {
    for (pause, polls, is_flooded) in [(3_600_000, false, false), (3_600_000, true, false), (1, false, true)] {
        let mut standby = Standby::new();
        standby.run(3_000, manages(report(claim(6), 0)));
        standby.until_it_leads(5_000, nobody);
        standby.now += pause;
        if polls {
            standby.run(standby.now + 1, nobody);
        }
        if is_flooded {
            standby.node.left_unread();
        }
        assert!(!standby.node.lead(at(standby.now), tagged(claim(6).raised(9))) && standby.node.is_standby());
        standby.until_it_leads(5_000, nobody);
    }
}

#[test]
fn it_takes_no_links_and_one_that_leads_searches_for_its_vehicles() {
    let mut standby = Standby::new();
    let agv = hello_of(&s_unit("agv", 2));
    let admitted = standby.node.admit(at(0), LinkId(0), address(2, 7_000), &agv);
    assert_eq!(admitted, Admission::Refuse(Refusal::Standby));
    standby.until_it_leads(4_000, nobody);
    assert!(standby.node.lead(at(standby.now), tagged(claim(1))));
    let mut outbox = Outbox::default();
    run(&mut standby.node, at(standby.now + 100), &mut outbox);
    let searched = as_who_has(&outbox.broadcasts[0]);
    assert_eq!((searched.standby, searched.wanted, searched.tcp_port), (false, None, 7_000));
    assert_eq!(standby.node.admit(at(standby.now), LinkId(0), address(2, 7_000), &agv), Admission::Accept);
}

/// It knows neither all vehicles nor of another manager, both of which a partition can hide.
#[test]
fn one_that_has_stood_by_always_searches() {
    let mut standby = Standby::new();
    standby.until_it_leads(4_000, nobody);
    assert!(standby.node.lead(at(standby.now), tagged(claim(1))));
    join(&mut standby.node, at(standby.now), 0, &s_unit("agv", 2));
    for minute in 1..5 {
        let mut outbox = Outbox::default();
        run(&mut standby.node, at(standby.now + minute * 60_000), &mut outbox);
        assert!((30..=60).contains(&outbox.broadcasts.len()), "{}", outbox.broadcasts.len());
    }
}

/// One that steps down has heard the other one's claim.
#[test]
fn one_that_has_stepped_down_stands_by() {
    let mut standby = Standby::new();
    standby.until_it_leads(4_000, nobody);
    assert!(standby.node.lead(at(standby.now), tagged(claim(1))));
    let now = standby.now + 100;
    let mut outbox = Outbox::default();
    while standby.node.poll(at(now), &mut outbox, &Keyed).is_some() {}
    let nonce = standby.node.search.nonce;
    hear(&mut standby.node, at(now), &answer(nonce, report(claim(3), 0)));
    assert_eq!(standby.node.take_claim_event(), Some(ClaimEvent::StepDown(tagged(claim(3)))));
    standby.node.stand_by(at(now));
    standby.now = now;
    standby.until_it_leads(5_000, nobody);
    assert_eq!(standby.leads, [Claim::NONE, claim(3)]);
}

/// A manager answers the question of a standby at once, and takes it for nobody.
#[test]
fn a_manager_answers_a_standby_and_does_not_count_it() {
    let mut manager = depot();
    manager.set_claim(tagged(claim(5)));
    let mut outbox = Outbox::default();
    while manager.poll(at(1_000), &mut outbox, &Keyed).is_some() {}
    let question = |wanted| {
        let standby = NodeConfig { epoch: Epoch(7), tcp_port: 0, ..m_unit(MANAGER, MANAGER_ID) };
        WhoHas { wanted, standby: true, expected: 0, ..search_of(&standby, 1) }
    };
    for wanted in [None, Some(super::manager())] {
        let mut outbox = Outbox::default();
        let mut out = [0; SEARCH_BYTES];
        let bytes = question(wanted).encode(FLEET, &Keyed, &mut out).unwrap();
        manager.datagram(at(1_001), address(9, 7_001), bytes, &Keyed);
        assert_eq!(manager.poll(at(1_001), &mut outbox, &Keyed), None);
        let Ok(Datagram::Announce(announce)) = Datagram::decode(&outbox.sent[0].1, FLEET, &Keyed) else { panic!() };
        assert_eq!((outbox.sent.len(), announce.nonce, announce.claim), (1, 77, report(claim(5), ClaimReport::NEVER)));
        assert_eq!((manager.take_duplicate(), manager.counters.value(NodeCounter::OwnIdentity)), (None, 0));
    }
}

/// A vehicle says which claim it obeys and how long ago it heard that manager, and asks a standby nothing.
#[test]
fn a_vehicle_answers_a_standby_and_does_not_ask_it() {
    let mut agv = node(s_unit("agv", 1));
    let manager = Hello { claim: report(claim(5), 0), ..hello_of(&m_unit(MANAGER, MANAGER_ID)) };
    assert_eq!(agv.admit(at(1_000), LinkId(0), address(1, 7_000), &manager), Admission::Accept);
    let standby = NodeConfig { epoch: Epoch(7), tcp_port: 0, ..m_unit(MANAGER, MANAGER_ID) };
    let question = WhoHas { standby: true, expected: 0, ..search_of(&standby, 1) };
    for (now, left, since) in [(5_000, false, 0), (8_000, true, 1_000)] {
        if left {
            agv.left(at(7_000), LinkId(0), CloseReason::Reset);
        }
        let mut outbox = Outbox::default();
        agv.hear(at(now), address(9, 7_001), &who_has_bytes(&question));
        // Soon: a standby that hears nothing may start 300 ms later.
        run(&mut agv, at(now + 13), &mut outbox);
        let obeyed = as_announce(&outbox.sent[0].1).obeyed.expect("it has obeyed a claim");
        assert_eq!((outbox.sent.len(), obeyed.claim()), (1, claim(5)));
        assert!((since..=if left { since + 13 } else { 0 }).contains(&obeyed.since), "{obeyed:?}");
        assert_eq!(agv.hints.next(), Instant::FAR_FUTURE);
    }
}
