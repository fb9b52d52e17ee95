#![allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::arithmetic_side_effects
)]

use std::string::String;
use std::vec::Vec;
use std::{format, vec};

use proptest::prelude::*;

use super::super::value::Type;
use super::*;
use crate::distribution::parameters::Parameters;

/// Any valid definition of a few variables, some of them both argument and result.
pub(crate) fn definition() -> impl Strategy<Value = Definition> {
    let size = prop_oneof![0..4_u32, any::<u32>()];
    let variable = ("[a-z0-9_./-]{1,8}", prop::sample::select(&Type::FLAT[..]), size, 0..3_u8);
    ("[A-Za-z0-9_./-]{1,32}", prop::collection::vec(variable, 0..8)).prop_map(|(name, variables)| {
        let mut builder = Builder::new(&name).unwrap();
        let spec = |at: usize| {
            let (name, kind, size, _) = &variables[at];
            VariableSpec::flat(name, *kind, *size)
        };
        for at in (0..variables.len()).filter(|&at| variables[at].3 != 1) {
            let _ = builder.argument(spec(at));
        }
        for at in (0..variables.len()).filter(|&at| variables[at].3 != 0) {
            let _ = builder.result(spec(at));
        }
        builder.finish()
    })
}

fn definition_of(
    name: &str,
    arguments: &[(&str, Type, u32)],
    results: &[(&str, Type, u32)],
) -> Result<Definition, Error> {
    let specs = |list: &'_ [_]| -> Vec<_> {
        list.iter().map(|&(name, kind, size)| VariableSpec::flat(name, kind, size)).collect()
    };
    Builder::of(name, specs(arguments).into_iter(), specs(results).into_iter()).map(Builder::finish)
}

#[test]
fn the_encoding_is_as_documented() {
    let definition = definition_of("go", &[("x", Type::Float, 2)], &[("ok", Type::Bool, 0x0102)]).unwrap();
    let bytes = [2, b'g', b'o', 1, 1, 1, 2, 0, 0, 0, b'x', 1, 3, 2, 2, 1, 0, 0, b'o', b'k'];
    assert_eq!(definition.as_bytes(), bytes);
    let signature = Signature::decode(&bytes).unwrap();
    assert_eq!(signature.name(), "go");
    assert_eq!(signature.arguments().collect::<Vec<_>>(), [VariableSpec::flat("x", Type::Float, 2)]);
    assert_eq!(format!("{signature}"), "go(x: float[2]) -> (ok: bool[258])");
}

#[test]
fn arguments_and_results_come_in_any_order() {
    let mut arguments = Parameters::new();
    arguments.add_int("a", 1).unwrap();
    let mut results = Parameters::new();
    results.add_string("b", 9).unwrap();
    let forth = Definition::new("f").unwrap().arguments(&arguments).unwrap().results(&results).unwrap();
    let back = Definition::new("f").unwrap().results(&results).unwrap().arguments(&arguments).unwrap();
    assert_eq!(forth, back);
    assert_eq!(format!("{forth}"), "f(a: int) -> (b: string[9])");
    assert_eq!(format!("{}", Definition::new("f").unwrap()), "f()");
}

#[test]
fn a_name_stands_for_one_variable() {
    let same = definition_of("f", &[("a", Type::Int, 1)], &[("a", Type::Int, 1)]);
    assert_eq!(same.unwrap().signature().parameters_bytes(), 9);
    let twice = definition_of("f", &[("a", Type::Int, 1), ("a", Type::Int, 1)], &[]);
    assert_eq!(twice, Err(Error::NameTaken));
    let other_type = definition_of("f", &[("a", Type::Int, 1)], &[("a", Type::Float, 1)]);
    assert_eq!(other_type, Err(Error::WrongType { index: 0 }));
    let other_size = definition_of("f", &[("a", Type::Int, 1)], &[("b", Type::Int, 2), ("a", Type::Int, 2)]);
    assert_eq!(other_size, Err(Error::WrongSize { index: 1, expected: 1, found: 2 }));
}

#[test]
fn arguments_and_results_fit_one_parameters() {
    let names: Vec<String> = (0..=VARIABLES).map(|index| format!("v{index}")).collect();
    let variables: Vec<_> = names.iter().map(|name| (name.as_str(), Type::Bool, 1)).collect();
    assert!(definition_of("f", &variables[..VARIABLES], &variables[..VARIABLES]).is_ok());
    let full = Err(Error::Full(Limit::Variables));
    assert_eq!(definition_of("f", &variables, &[]), full);
    assert_eq!(definition_of("f", &[], &variables), full);
    assert_eq!(definition_of("f", &variables[..VARIABLES], &variables[VARIABLES..]), full);
}

#[test]
fn a_signature_is_bounded() {
    let names: Vec<String> = (0..16).map(|index| format!("{index:0>32}")).collect();
    let variables: Vec<_> = names.iter().map(|name| (name.as_str(), Type::Bool, 1)).collect();
    assert_eq!(definition_of("f", &variables, &variables), Err(Error::Full(Limit::SignatureBytes)));
    // 1 + name + 1 + variables of 38 bytes each + 1, and a last result that fills the rest, whose name differs.
    let fitting = (SIGNATURE_BYTES - 4 - 7) / 38;
    let (arguments, results) = (&variables[..fitting.min(15)], &variables[..fitting.saturating_sub(15)]);
    let name = "a".repeat(SIGNATURE_BYTES - 4 - 38 * fitting - 6);
    let results = [results, &[(&*name, Type::Bool, 1)]].concat();
    assert_eq!(definition_of("f", arguments, &results).unwrap().as_bytes().len(), SIGNATURE_BYTES);
    assert_eq!(definition_of("fg", arguments, &results), Err(Error::Full(Limit::SignatureBytes)));
}

#[test]
fn what_no_definition_holds_is_malformed() {
    let malformed: &[&[u8]] = &[
        &[],
        &[0, 0, 0],
        &[1, b'f', 0],
        &[1, b'f', 0, 0, 0],
        &[1, b' ', 0, 0],
        &[1, 0xFF, 0, 0],
        &[1, b'f', 1, 5, 1, 0, 0, 0, 0, b'a', 0],
        &[1, b'f', 1, 0, 0, 0, 0, 0, 0, 0],
        &[1, b'f', 2, 0, 1, 0, 0, 0, 0, b'a', 0, 1, 0, 0, 0, 0, b'a', 0],
        &[1, b'f', 1, 0, 1, 0, 0, 0, 0, b'a', 1, 1, 1, 0, 0, 0, 0, b'a'],
    ];
    for bytes in malformed {
        assert_eq!(Signature::decode(bytes), Err(Error::Malformed), "{bytes:?}");
    }
}

proptest! {
    #[test]
    fn decode_is_total(bytes in prop::collection::vec(any::<u8>(), 0..40)) {
        if let Ok(signature) = Signature::decode(&bytes) {
            prop_assert_eq!(signature.as_bytes(), &bytes[..]);
        }
    }

    #[test]
    fn decode_takes_what_definition_makes_and_nothing_shorter(definition in definition(), more in any::<u8>()) {
        let bytes = definition.as_bytes();
        prop_assert_eq!(Signature::decode(bytes), Ok(definition.signature()));
        for length in 0..bytes.len() {
            prop_assert_eq!(Signature::decode(&bytes[..length]), Err(Error::Malformed));
        }
        let mut longer = vec![];
        longer.extend_from_slice(bytes);
        longer.push(more);
        prop_assert_eq!(Signature::decode(&longer), Err(Error::Malformed));
    }

    #[test]
    fn a_changed_byte_never_panics(definition in definition(), at in any::<prop::sample::Index>(), change in 1..=255_u8) {
        let mut bytes = definition.as_bytes().to_vec();
        let at = at.index(bytes.len());
        bytes[at] ^= change;
        if let Ok(signature) = Signature::decode(&bytes) {
            let text = format!("{signature}");
            let parsed = Definition::parse(&text).unwrap();
            prop_assert_eq!(parsed.as_bytes(), &bytes[..]);
        }
    }
}

/// A unit without the feature skips them, too.
#[test]
fn what_follows_the_results_is_sections_whose_numbers_rise() {
    let plain = [1, b'f', 0, 0];
    let section = |number: u8| [number, 1, 0, 1, 1, 0, 0, 0, b'x'];
    let of = |sections: &[&[u8]]| Signature::decode(&[&plain[..], &sections.concat()].concat()).map(|_| ());
    assert_eq!(of(&[&section(1), &section(2), &section(9)]), Ok(()));
    let wrong: [&[&[u8]]; 6] = [
        &[&section(0)],
        &[&section(2), &section(1)],
        &[&section(1), &section(1)],
        &[&[1, 0]],
        &[&[1]],
        &[&section(1)[..8]],
    ];
    for sections in wrong {
        assert_eq!(of(sections), Err(Error::Malformed), "{sections:?}");
    }
    let many: std::vec::Vec<_> = (3..200).map(section).collect();
    let many: std::vec::Vec<&[u8]> = many.iter().map(|section| &section[..]).collect();
    assert_eq!(of(&many), Ok(()), "what is not known does not count");
    let long = |number: u8| {
        let variable = |at: u8| [&[0, 32, 1, 0, 0, 0][..], &[b'a' + at; 32]].concat();
        [&[number, 16][..], &(0..16).map(variable).collect::<std::vec::Vec<_>>().concat()].concat()
    };
    assert_eq!(of(&[&long(1)]).is_ok(), long(1).len() < SIGNATURE_BYTES);
    assert_eq!(of(&[&long(1), &long(2)]), Err(Error::Malformed), "longer than any definition");
}
