//! Downgrades: offers of cipher suites that a man in the middle changes, removes or answers with others.

use cara_core::error::{CloseReason, Refusal};
use cara_core::time::Duration;

use super::Tally;
use super::ends::Ends;

const OFFERS: [[bool; 2]; 4] = [[false, false], [false, true], [true, false], [true, true]];
/// Where a hello's frame has its suites: behind length, kind, magic and versions.
const SUITES: core::ops::Range<usize> = 9..11;

/// The offers of a hello of an end that offers AES, and of one that does not.
fn offer(aes: bool) -> u16 {
    if aes { 0b11 } else { 0b01 }
}

#[test]
fn all_that_offer_the_first_suite_talk_to_each_other() {
    for [manager, agv] in OFFERS {
        let mut ends = Ends::offering(1, manager, agv);
        ends.converse(|ends, number, carried| {
            if number < 2 {
                let offered = u16::from_le_bytes(carried.bytes[SUITES].try_into().expect("two bytes"));
                assert_eq!(offered, offer(if carried.to_manager { agv } else { manager }));
            }
            ends.deliver(&carried);
        });
        assert!(ends.manager.session.is_live() && ends.agv.session.is_live());
        assert_eq!(ends.agv.ran, 2, "a call and an emergency");
    }
}

/// The vehicle's hello is the first on its way, the manager's the second.
#[test]
fn whatever_becomes_of_an_offer_nobody_joins() {
    let mut tally = Tally::new("offers of suites changed");
    for ([manager, agv], hello) in OFFERS.into_iter().flat_map(|offers| [(offers, 0), (offers, 1)]) {
        let offered = offer(if hello == 0 { agv } else { manager });
        let flipped = (0..16).map(|bit| offered ^ 1 << bit);
        // Removed, all or that of AES, and others in their place.
        let instead = [0, 0b01, 0b10, 0b11, 0x8000, 0x8001].into_iter().filter(|suites| *suites != offered);
        for suites in flipped.chain(instead) {
            let mut ends = Ends::offering(1, manager, agv);
            ends.converse(|ends, number, mut carried| {
                if number == hello {
                    carried.bytes[SUITES].copy_from_slice(&suites.to_le_bytes());
                }
                ends.deliver(&carried);
            });
            [true, false].into_iter().for_each(|end| ends.end(end).wait(Duration::from_secs(3)));
            let named = match suites & 1 {
                // The one who reads it says why.
                0 => ends.end(hello == 0).closed == Some(CloseReason::Refused(Refusal::Suite)),
                // The dialler is the first to open something that covers both hellos.
                _ => ends.agv.closed == Some(CloseReason::BadProof),
            };
            assert!(named, "{suites:#b} for {offered:#b}: {:?}, {:?}", ends.manager.closed, ends.agv.closed);
            let live = ends.manager.session.is_live() || ends.agv.session.is_live();
            tally.note(live || ends.manager.greeted() || ends.agv.greeted() || ends.agv.ran + ends.manager.ran > 0);
        }
    }
    tally.close();
}
