#![allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::arithmetic_side_effects
)]

use std::boxed::Box;
use std::string::String;
use std::vec::Vec;
use std::{format, vec};

use proptest::prelude::*;

use super::*;
use crate::distribution::function::Definition;
use crate::distribution::parameters::Parameters;

type Large = Parameters<4096>;

fn parse(list: &str) -> Definition {
    Definition::parse(&format!("f({list})")).unwrap()
}

fn encode(definition: &Definition, parameters: &ParametersView) -> Vec<u8> {
    let arguments = definition.signature().arguments();
    let length = measure(arguments, parameters).unwrap();
    let mut block = vec![0xAA; length];
    let mut writer = SliceWriter::new(&mut block);
    write(arguments, parameters, &mut writer);
    assert_eq!(writer.written(), length);
    block
}

/// The value of an arbitrary variable.
#[derive(Clone, Debug)]
enum Content {
    Ints(Vec<i64>),
    Floats(Vec<u64>),
    Bools(Vec<bool>),
    Text(u32, String),
    Bytes(u32, Vec<u8>),
}

fn content() -> impl Strategy<Value = Content> {
    prop_oneof![
        prop::collection::vec(any::<i64>(), 0..4).prop_map(Content::Ints),
        prop::collection::vec(any::<u64>(), 0..4).prop_map(Content::Floats),
        prop::collection::vec(any::<bool>(), 0..12).prop_map(Content::Bools),
        (0..8_u32, ".{0,6}").prop_map(|(spare, text)| Content::Text(text.len() as u32 + spare, text)),
        (0..8_u32, prop::collection::vec(any::<u8>(), 0..20))
            .prop_map(|(spare, bytes)| Content::Bytes(bytes.len() as u32 + spare, bytes)),
    ]
}

/// Arbitrary parameters, and a function that takes all of them.
fn parameters() -> impl Strategy<Value = (Box<Large>, Definition)> {
    prop::collection::vec(content(), 0..7).prop_map(|contents| {
        let mut p = Box::new(Large::sized());
        for (index, content) in contents.iter().enumerate() {
            let name = &format!("v{index}");
            match content {
                Content::Ints(values) => {
                    p.add_int(name, values.len() as u32).unwrap();
                    p.set_value(name, &values[..]).unwrap();
                }
                Content::Floats(bits) => {
                    p.add_float(name, bits.len() as u32).unwrap();
                    let values: Vec<_> = bits.iter().map(|&bits| f64::from_bits(bits)).collect();
                    p.set_value(name, &values[..]).unwrap();
                }
                Content::Bools(values) => {
                    p.add_bool(name, values.len() as u32).unwrap();
                    p.set_value(name, &values[..]).unwrap();
                }
                Content::Text(maximum, text) => {
                    p.add_string(name, *maximum).unwrap();
                    p.set_value(name, text.as_str()).unwrap();
                }
                Content::Bytes(maximum, bytes) => {
                    p.add_bytes(name, *maximum).unwrap();
                    p.set_value(name, &bytes[..]).unwrap();
                }
            }
        }
        let definition = Definition::new("f").unwrap().arguments(&p).unwrap();
        (p, definition)
    })
}

#[test]
fn the_layout_is_as_documented() {
    let definition = parse("n: int[2], ok: bool[3], text: string[9], x: float, raw: bytes[8]");
    let mut p = Parameters::new();
    p.add_float("x", 1).unwrap();
    p.add_bytes("raw", 8).unwrap();
    p.add_bool("ok", 3).unwrap();
    p.add_int("n", 2).unwrap();
    p.add_int("unused", 2).unwrap();
    p.add_string("text", 200).unwrap();
    p.set_value("n", [1, -2]).unwrap();
    p.set_value("ok", [true, false, true]).unwrap();
    p.set_value("text", "über").unwrap();
    p.set_value("x", 1.0).unwrap();
    p.set_value("raw", [9, 8, 7, 6, 5, 4, 3, 2_u8]).unwrap();
    #[rustfmt::skip]
    let expected = [
        1, 0, 0, 0, 0, 0, 0, 0, 0xFE, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF,
        1, 0, 1, 0, 0, 0, 0, 0,
        5, 0, 0, 0, 0, 0, 0, 0, 0xC3, 0xBC, b'b', b'e', b'r', 0, 0, 0,
        0, 0, 0, 0, 0, 0, 0xF0, 0x3F,
        8, 0, 0, 0, 0, 0, 0, 0, 9, 8, 7, 6, 5, 4, 3, 2,
    ];
    assert_eq!(encode(&definition, &p), expected);
    assert_eq!(longest(definition.signature().arguments()), Some(16 + 8 + 8 + 16 + 8 + 16));
}

#[test]
fn every_argument_is_needed_by_name_type_and_size() {
    let definition = parse("a: int[2], b: string[3]");
    let arguments = definition.signature().arguments();
    let mut p = Parameters::new();
    assert_eq!(measure(arguments, &p), Err(Error::MissingArgument { index: 0 }));
    p.add_int("a", 2).unwrap();
    assert_eq!(measure(arguments, &p), Err(Error::MissingArgument { index: 1 }));
    p.add_string("b", 10).unwrap();
    assert_eq!(measure(arguments, &p), Ok(24));
    p.set_value("b", "four").unwrap();
    assert_eq!(measure(arguments, &p), Err(Error::WrongSize { index: 1, expected: 3, found: 4 }));
    p.clear();
    p.add_int("a", 3).unwrap();
    assert_eq!(measure(arguments, &p), Err(Error::WrongSize { index: 0, expected: 2, found: 3 }));
    p.clear();
    p.add_float("a", 2).unwrap();
    assert_eq!(measure(arguments, &p), Err(Error::WrongType { index: 0 }));
}

#[test]
fn a_foreign_block_is_refused_whole() {
    let refused = |list: &str, block: &[u8]| {
        assert_eq!(check(parse(list).signature().arguments(), block), Err(Error::Malformed), "{list} {block:?}");
    };
    refused("", &[0]);
    refused("a: int", &[0; 7]);
    refused("a: int", &[0; 16]);
    refused("a: bool", &[2, 0, 0, 0, 0, 0, 0, 0]);
    refused("a: bool", &[1, 0, 0, 0, 0, 0, 0, 1]);
    refused("a: string[8]", &[1, 0, 0, 0, 0, 0, 0, 0, 0xFF, 0, 0, 0, 0, 0, 0, 0]);
    refused("a: string[8]", &[1, 0, 0, 0, 1, 0, 0, 0, b'a', 0, 0, 0, 0, 0, 0, 0]);
    refused("a: string[8]", &[9, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    refused("a: bytes[4294967295]", &[0xFF; 24]);
    refused("a: int[4294967295], b: int[4294967295]", &[0; 24]);
}

#[test]
fn results_update_and_join_the_callers_parameters() {
    let definition = parse("a: int, text: string[20], new: bool");
    let results = definition.signature().arguments();
    let mut theirs = Parameters::new();
    prepare_results(results, &mut theirs).unwrap();
    theirs.set_value("a", 7).unwrap();
    theirs.set_value("text", "longer").unwrap();
    theirs.set_value("new", true).unwrap();
    let block = encode(&definition, &theirs);

    let mut mine = Parameters::new();
    mine.add_string("text", 6).unwrap();
    mine.add_float("other", 1).unwrap();
    mine.set_value("other", 0.5).unwrap();
    read(results, &block, &mut mine).unwrap();
    assert_eq!(mine.variable("text"), Ok("longer"));
    assert_eq!(mine.variable("other"), Ok(0.5));
    assert_eq!(mine.variable("a"), Ok(7));
    assert_eq!(mine.variable("new"), Ok(true));
    // A shorter text replaces a longer one.
    theirs.set_value("text", "ok").unwrap();
    read(results, &encode(&definition, &theirs), &mut mine).unwrap();
    assert_eq!(mine.variable("text"), Ok("ok"));
}

/// `read` must fail with `error` and change nothing; `check_results_fit` predicts `foreseen` from the signature.
#[track_caller]
fn does_not_fit(results: &str, value: &str, mine: &ParametersView, error: Error, foreseen: Error) {
    let definition = parse(results);
    let results = definition.signature().arguments();
    let mut theirs = Large::sized();
    prepare_results(results, &mut theirs).unwrap();
    let _ = theirs.set_value("text", value);
    let block = encode(&definition, &theirs);
    let mut changed = Box::new(Large::sized());
    changed.copy_from(mine).unwrap();
    // Leave as little capacity as `mine` has.
    changed.add_bytes("filler", (changed.remaining() - mine.remaining() - 6) as u32).unwrap();
    let before = changed.clone();
    assert_eq!(read(results, &block, &mut changed), Err(error));
    assert_eq!(changed, before);
    assert_eq!(check_results_fit(results, &changed), Err(foreseen));
}

#[test]
fn a_result_that_does_not_fit_changes_nothing() {
    let mut mine = Parameters::<64>::sized();
    mine.add_int("a", 1).unwrap();
    mine.add_string("text", 4).unwrap();
    assert_eq!(mine.remaining(), 64 - 9 - 8);
    let short = Error::ResultWouldNotFit { need: 5, have: 4 };
    does_not_fit("a: int, text: string[5]", "12345", &mine, short, short);
    does_not_fit("text: string[9]", "12345", &mine, short, Error::ResultWouldNotFit { need: 9, have: 4 });
    let ints = Error::ResultWouldNotFit { need: 16, have: 8 };
    does_not_fit("text: string[4], a: int[2]", "1", &mine, ints, ints);
    let fewer = Error::WrongSize { index: 0, expected: 1, found: 0 };
    does_not_fit("a: int[0]", "", &mine, fewer, fewer);
    let kind = Error::WrongType { index: 1 };
    does_not_fit("new: int, text: bytes[3]", "", &mine, kind, kind);
    let room = Error::ResultWouldNotFit { need: 48, have: 47 };
    does_not_fit("x: int[2], y: bytes[30]", "", &mine, room, room);
}

#[test]
fn what_is_told_to_fit_fits() {
    let definition = parse("text: string[5], x: int[2], y: bytes[29]");
    let results = definition.signature().arguments();
    let mut mine = Parameters::<64>::sized();
    mine.add_int("a", 1).unwrap();
    mine.add_string("text", 4).unwrap();
    let mut theirs = Parameters::new();
    prepare_results(results, &mut theirs).unwrap();
    theirs.set_value("text", "1234").unwrap();
    // The signature allows a longer text than this one.
    assert!(check_results_fit(results, &mine).is_err());
    read(results, &encode(&definition, &theirs), &mut mine).unwrap();
    assert_eq!(mine.remaining(), 0);
}

#[test]
fn a_full_table_is_told() {
    let mut mine = Parameters::new();
    for index in 0..VARIABLES {
        mine.add_bool(&format!("v{index}"), 1).unwrap();
    }
    let definition = parse("new: bool");
    let results = definition.signature().arguments();
    let full = Err(Error::Full(Limit::Variables));
    assert_eq!(check_results_fit(results, &mine), full);
    assert_eq!(read(results, &[0; 8], &mut mine), full);
    assert_eq!(prepare_results(results, &mut mine), full);
}

#[test]
fn a_malformed_block_is_the_peers_fault_even_if_it_would_not_fit() {
    let definition = parse("a: float, b: bool");
    let results = definition.signature().arguments();
    let mut mine = Parameters::new();
    mine.add_int("a", 1).unwrap();
    let mut block = [0; 16];
    assert_eq!(read(results, &block, &mut mine), Err(Error::WrongType { index: 0 }));
    block[8] = 2;
    assert_eq!(read(results, &block, &mut mine), Err(Error::ResultLost));
}

#[test]
fn a_service_sees_its_arguments_and_its_results_to_be() {
    let definition = Definition::parse("f(text: string[9]) -> (text: string[9], n: int)").unwrap();
    let signature = definition.signature();
    let mut p = Parameters::<64>::sized();
    p.add_int("left_over", 3).unwrap();
    let block = [2, 0, 0, 0, 0, 0, 0, 0, b'h', b'i', 0, 0, 0, 0, 0, 0];
    read_arguments(signature.arguments(), &block, &mut p).unwrap();
    assert_eq!(p.len(), 1);
    prepare_results(signature.results(), &mut p).unwrap();
    assert_eq!(64 - p.remaining(), signature.parameters_bytes() as usize);
    assert_eq!(p.variable("text"), Ok("hi"));
    // It may become as long as declared.
    p.set_value("text", "123456789").unwrap();
    assert_eq!(read_arguments(signature.arguments(), &block[..8], &mut p), Err(Error::Malformed));
    assert!(p.is_empty());
    read_arguments(signature.arguments(), &block, &mut p).unwrap();
    let mut small = Parameters::<12>::sized();
    let full = Err(Error::Full(Limit::ParametersBytes));
    assert_eq!(read_arguments(signature.arguments(), &block, &mut small), full);
    assert!(small.is_empty());
    let conflict = parse("text: bytes[9]");
    assert_eq!(prepare_results(conflict.signature().arguments(), &mut p), Err(Error::WrongType { index: 0 }));
}

#[test]
fn twenty_thousand_characters_pass() {
    let definition = parse("text: string[20000]");
    let mut p = Box::new(Parameters::<20_100>::sized());
    p.add_string("text", 20_000).unwrap();
    let text = "0123456789".repeat(2_000);
    p.set_value("text", text.as_str()).unwrap();
    let block = encode(&definition, &p);
    assert_eq!(block.len(), 20_008);
    p.set_value("text", "").unwrap();
    read(definition.signature().arguments(), &block, &mut p).unwrap();
    assert_eq!(p.variable("text"), Ok(text.as_str()));
}

/// If a block is valid, its values must encode to the same bytes.
fn is_canonical_or_refused(definition: &Definition, block: &[u8]) -> Result<bool, TestCaseError> {
    let mut found = Box::new(Large::sized());
    let arguments = definition.signature().arguments();
    let read = read_arguments(arguments, block, &mut found);
    prop_assert_eq!(check(arguments, block), read);
    if read.is_ok() {
        prop_assert_eq!(encode(definition, &found), block);
    }
    Ok(read.is_ok())
}

proptest! {
    #[test]
    fn blocks_round_trip((p, definition) in parameters()) {
        let arguments = definition.signature().arguments();
        let block = encode(&definition, &p);
        prop_assert_eq!(block.len() % 8, 0);
        prop_assert!(block.len() <= longest(arguments).unwrap());
        prop_assert_eq!(check(arguments, &block), Ok(()));

        let mut arrived = Box::new(Large::sized());
        arrived.add_int("left_over", 2).unwrap();
        read_arguments(arguments, &block, &mut arrived).unwrap();
        prop_assert_eq!(&arrived, &p);

        let mut fresh = Box::new(Large::sized());
        read(arguments, &block, &mut fresh).unwrap();
        prop_assert_eq!(&fresh, &p);

        // Into variables with other values.
        let mut emptied = Box::new(Large::sized());
        prepare_results(arguments, &mut emptied).unwrap();
        check_results_fit(arguments, &emptied).unwrap();
        read(arguments, &block, &mut emptied).unwrap();
        prop_assert_eq!(&emptied, &p);
    }

    #[test]
    fn truncated_blocks_are_refused((p, definition) in parameters()) {
        let block = encode(&definition, &p);
        for length in 0..block.len() {
            prop_assert!(!is_canonical_or_refused(&definition, &block[..length])?);
        }
    }

    #[test]
    fn changed_blocks_are_refused_or_canonical((p, definition) in parameters(), change in 1..=255_u8) {
        let mut block = encode(&definition, &p);
        for at in 0..block.len() {
            block[at] ^= change;
            is_canonical_or_refused(&definition, &block)?;
            block[at] ^= change;
        }
    }

    #[test]
    fn arbitrary_blocks_are_refused_or_canonical(
        (_, definition) in parameters(),
        block in prop::collection::vec(prop_oneof![3 => Just(0), 1 => any::<u8>()], 0..64),
    ) {
        is_canonical_or_refused(&definition, &block)?;
    }

    #[test]
    fn a_refused_result_changes_nothing((p, definition) in parameters(), (mine, _) in parameters(), cut in any::<bool>()) {
        let mut block = encode(&definition, &p);
        if cut {
            block.pop();
        }
        let mut changed = mine.clone();
        if read(definition.signature().arguments(), &block, &mut changed).is_err() {
            prop_assert_eq!(changed, mine);
        } else {
            prop_assert_eq!(encode(&definition, &changed), block);
        }
    }

    #[test]
    fn what_fits_by_signature_fits((p, definition) in parameters(), (mut mine, _) in parameters()) {
        let results = definition.signature().arguments();
        if check_results_fit(results, &mine).is_ok() {
            prop_assert_eq!(read(results, &encode(&definition, &p), &mut mine), Ok(()));
        }
    }
}
