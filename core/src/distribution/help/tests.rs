#![cfg(feature = "help")]
#![allow(clippy::unwrap_used, clippy::arithmetic_side_effects)]
use std::format;
use std::vec::Vec;

use super::*;
use crate::config::SIGNATURE_BYTES;
use crate::distribution::attributes::Attributes;
use crate::distribution::function_list::{Entry, Generation, Slot, TheirFunctionList};
use crate::storage::Boxed;

fn lift() -> Definition {
    Definition::parse("lift_to(height: float)").unwrap()
}

#[test]
fn each_is_said_once_and_of_what_there_is() {
    let lift = lift().unit("height", "m").unwrap().help("Lifts.").unwrap();
    assert_eq!((lift.signature().help(), lift.signature().unit_of("height")), ("Lifts.", Some("m")));
    assert_eq!(lift.clone().help("Sinks."), Err(Error::NameTaken));
    assert_eq!(lift.clone().unit("height", "cm"), Err(Error::NameTaken));
    assert_eq!(lift.unit("depth", "m"), Err(Error::UnknownVariable));
}

#[test]
fn what_is_too_long_is_cut_between_two_characters() {
    let lift = lift().help(&"ä".repeat(HELP_BYTES)).unwrap().unit("height", &"µ".repeat(9)).unwrap();
    assert_eq!(lift.signature().help(), "ä".repeat(HELP_BYTES / 2));
    assert_eq!(lift.signature().unit_of("height"), Some("µ".repeat(UNIT_BYTES / 2).as_str()));
}

#[test]
fn a_signature_without_room_stays_as_it_was() {
    let most = (SIGNATURE_BYTES - 40) / 38;
    let names = |from, to| (from..to).map(|at| format!("{at:0>32}: bool")).collect::<Vec<_>>().join(", ");
    let (arguments, progress) = (names(0, most.min(16)), names(16, most.max(16)));
    let progress = if progress.is_empty() { progress } else { format!(" progress ({progress})") };
    let full = Definition::parse(&format!("f({arguments}){progress}")).unwrap();
    assert_eq!(full.help(&"a".repeat(HELP_BYTES)), Err(Error::Full(Limit::SignatureBytes)));
}

/// A list with room for the function alone keeps it; one with more keeps the help as well.
#[test]
fn a_function_is_rather_kept_without_its_help_than_not() {
    let lift = lift().help("Lifts the fork.").unwrap();
    let bare = lift.signature().without_help();
    for (room, kept) in [(bare.as_bytes().len(), ""), (lift.as_bytes().len(), "Lifts the fork.")] {
        let mut list = TheirFunctionList::<Boxed>::new([Entry::empty()].into(), std::vec![0; room].into());
        list.insert(Slot(0), Generation(0), Attributes::default(), lift.as_bytes()).unwrap();
        assert_eq!((list.named("lift_to").unwrap().signature.help(), list.skipped()), (kept, 0));
    }
}

#[test]
fn what_arrives_in_another_form_is_refused_or_read() {
    let plain = lift();
    let with =
        |tail: &[u8]| Signature::decode(&[plain.as_bytes(), tail].concat()).map(|signature| signature.units().count());
    assert_eq!(with(&[3, 1, 2, 3, 1, 0, 0, 0, b'a', b' ', b'm']), Ok(1));
    // A unit without a name, and a line of a later version.
    assert_eq!(with(&[3, 1, 2, 1, 1, 0, 0, 0, b'm']), Ok(0));
    assert_eq!(with(&[3, 1, 2, 1, 9, 0, 0, 0, b'm']), Ok(0));
    assert_eq!(with(&[3, 0]), Err(Error::Malformed));
    assert_eq!(with(&[3, 1, 2, 2, 0, 0, 0, 0, b'm']), Err(Error::Malformed));
    assert_eq!(with(&[3, 1, 2, 1, 0, 0, 0, 0, 0xff]), Err(Error::Malformed));
}
