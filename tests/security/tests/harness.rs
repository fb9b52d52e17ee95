//! The attackers must be able to succeed, or their zeros show nothing: against units with a deliberate weakness, and
//! with the key.

use cara_core::config::Mode;
use cara_secure::suite::Suite;
use cara_security::between::Middle;
use cara_security::links::{self, Extent};
use cara_security::linux::{Linux, LinuxVehicles, Weakness};
use cara_security::speaker::{End, HANDSHAKE};
use cara_security::tally::{Report, Row};
use cara_security::target::Target;
use cara_security::{discovery, permission};

/// A replay that the machine's load has spoiled is tried again.
const TRIES: usize = 5;

fn row<'r>(report: &'r Report, attack: &str, target: &dyn Target) -> &'r Row {
    let found = report.rows.iter().find(|row| row.attack.contains(attack) && row.target == target.name());
    found.unwrap_or_else(|| panic!("no row for {attack}, {}", target.name()))
}

/// A unit in plain mode on the port of secured ones accepts plain peers; the attack counts it.
#[test]
fn a_unit_in_plain_mode_is_found_out() {
    let linux = Linux::new(64, Weakness::Plain).unwrap();
    let (manager, vehicles) = (linux.manager().unwrap(), LinuxVehicles::new(&linux));
    for target in [&manager as &dyn Target, &vehicles] {
        let mut report = Report::default();
        links::plain(&mut report, target, Extent::Quick).unwrap();
        let row = row(&report, "downgrade", target);
        assert_eq!(row.successes, row.attempts, "{row:?}");
        assert!(!report.faults().is_empty());
    }
}

/// A unit that seals nothing accepts recorded frames, on the same link and later.
#[test]
fn a_unit_that_believes_recorded_words_is_found_out() {
    let linux = Linux::new(64, Weakness::Plain).unwrap();
    let (manager, vehicles) = (linux.manager().unwrap(), LinuxVehicles::new(&linux));
    for target in [&manager as &dyn Target, &vehicles] {
        let attacks = ["frames of another link", "frames of the same link", "whole recorded conversations"];
        // What is replayed in a datagram must be read before what follows it in the stream: on a busy machine it may not be.
        let is_found = || {
            let mut report = Report::default();
            links::replays(&mut report, target, Extent::Quick, Mode::Plain).unwrap();
            attacks.map(|attack| row(&report, attack, target).successes > 0)
        };
        let mut found = [false; 3];
        for _ in 0..TRIES {
            let now = is_found();
            found = std::array::from_fn(|index| found[index] || now[index]);
            if found == [true; 3] {
                break;
            }
        }
        assert_eq!(found, [true; 3], "{attacks:?} at {}", target.name());
    }
}

/// It does not detect tampering in the middle either.
#[test]
fn a_unit_that_believes_whoever_is_in_the_middle_is_found_out() {
    let linux = Linux::new(64, Weakness::Plain).unwrap();
    let (manager, vehicles) = (linux.manager().unwrap(), LinuxVehicles::new(&linux));
    let mut report = Report::default();
    Middle::new(&linux, &manager, &vehicles).meddle(&mut report, Extent::Quick).unwrap();
    assert!(report.rows.len() == 2 && report.rows.iter().all(|row| row.successes > 0), "{report}");
}

/// It accepts datagrams of other fleets as well.
#[test]
fn a_unit_that_believes_every_datagram_is_found_out() {
    let linux = Linux::new(64, Weakness::Plain).unwrap();
    let mut report = Report::default();
    discovery::spoof(&mut report, &linux, &linux.manager().unwrap(), Extent::Quick).unwrap();
    assert!(report.rows.len() == 2 && report.rows.iter().all(|row| row.successes > 0), "{report}");
}

/// An end by timeout is distinguished from an end by a wrong frame: a unit that only waits is found out.
#[test]
fn a_unit_that_only_waits_is_found_out() {
    let linux = Linux::new(64, Weakness::None).unwrap();
    let (manager, vehicles) = (linux.manager().unwrap(), LinuxVehicles::new(&linux));
    for target in [&manager as &dyn Target, &vehicles] {
        let visit = target.visit().unwrap();
        let mut speaker = visit.speaker(&visit.keys.genuine).unwrap();
        speaker.converse(1).unwrap();
        let end = speaker.hear_end();
        assert!(end == End::Closed(7) && !end.blames_what_came(), "{end:?}");
    }
}

/// A unit whose table allows everything runs what a random table would not have allowed.
#[test]
fn a_table_that_allows_everything_is_found_out() {
    let linux = Linux::new(64, Weakness::Open).unwrap();
    let mut report = Report::default();
    permission::run(&mut report, &linux, &linux.manager().unwrap(), Extent::Quick).unwrap();
    assert!(report.rows.len() == 2 && report.rows.iter().all(|row| row.successes > 0), "{report}");
}

/// The same attacker with the key joins and is served, which shows that successes are counted.
#[test]
fn who_has_the_key_gets_in() {
    let linux = Linux::new(64, Weakness::None).unwrap();
    let (manager, vehicles) = (linux.manager().unwrap(), LinuxVehicles::new(&linux));
    for target in [&manager as &dyn Target, &vehicles] {
        let mut report = Report::default();
        links::with_the_key(&mut report, target).unwrap();
        assert_eq!(report.faults(), [""; 0]);
        assert!(report.rows.iter().all(|row| row.control && row.successes > 0));
    }
}

/// Attackers speak both suites.
#[test]
fn speakers_have_both_suites() {
    let linux = Linux::new(64, Weakness::None).unwrap();
    let manager = linux.manager().unwrap();
    // Other tests' speakers take turns with these.
    let suites = [(); 16].map(|()| {
        let visit = manager.visit().unwrap();
        let mut speaker = visit.speaker(&visit.keys.genuine).unwrap();
        speaker.converse(HANDSHAKE + 1).unwrap();
        speaker.suite().unwrap()
    });
    assert!(suites.contains(&Suite::ChaChaPoly), "{suites:?}");
    // A host without instructions for AES does not offer it.
    #[cfg(target_arch = "x86_64")]
    assert_eq!(suites.contains(&Suite::AesGcm), is_x86_feature_detected!("aes"), "{suites:?}");
}
