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
    // A result with the name of an argument is the same variable.
    let (arguments, results) = (names(0, most.min(16)), names(0, most.saturating_sub(16)));
    let full = Definition::parse(&format!("f({arguments}) -> ({results})")).unwrap();
    assert_eq!(full.help(&"a".repeat(HELP_BYTES)), Err(Error::Full(Limit::SignatureBytes)));
}

/// All help is dropped rather than one function skipped.
#[test]
fn help_keeps_no_function_away() {
    let named = |name: &str| Definition::parse(&format!("{name}(height: float)")).unwrap().help("Lifts.").unwrap();
    let length = named("a").as_bytes().len();
    let mut list = TheirFunctionList::<Boxed>::new([].into(), [].into());
    list.let_grow(3, 3 * length - 1);
    for (slot, (name, kept)) in [("a", "Lifts."), ("b", "Lifts."), ("c", "")].into_iter().enumerate() {
        list.insert(Slot(slot as u16), Generation(0), Attributes::default(), named(name).as_bytes()).unwrap();
        let shown: Vec<_> = list.iter().map(|function| (function.name(), function.signature.help())).collect();
        let wanted = ["a", "b", "c"].into_iter().take(slot + 1).map(|name| (name, kept)).collect::<Vec<_>>();
        assert_eq!(shown, wanted);
    }
    assert_eq!((list.named("c").unwrap().signature.arguments().count(), list.skipped()), (1, 0));
    // A list of fixed size, as on a board, stores no help.
    let mut fixed = TheirFunctionList::<Boxed>::new([Entry::empty()].into(), std::vec![0; 4 * length].into());
    fixed.insert(Slot(0), Generation(0), Attributes::default(), named("a").as_bytes()).unwrap();
    assert_eq!(fixed.named("a").unwrap().signature.help(), "");
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
    // Sections of later versions are dropped, so that help can be added behind the rest.
    let later =
        Signature::decode(&[plain.as_bytes(), &[4, 1, 0, 1, 1, 0, 0, 0, b'x']].concat()).unwrap().to_definition();
    assert_eq!(later.help("Lifts.").unwrap().signature().help(), "Lifts.");
    let long = [plain.as_bytes(), &[3, 1, 2, 200, 0, 0, 0, 0], &[b'a'; 200]].concat();
    assert_eq!(Signature::decode(&long).unwrap().help().len(), HELP_BYTES);
    assert_eq!(with(&[3, 0]), Err(Error::Malformed));
    assert_eq!(with(&[3, 1, 2, 2, 0, 0, 0, 0, b'm']), Err(Error::Malformed));
    assert_eq!(with(&[3, 1, 2, 1, 0, 0, 0, 0, 0xff]), Err(Error::Malformed));
}
