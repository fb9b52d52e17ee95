#![allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::arithmetic_side_effects
)]

use std::format;
use std::string::String;

use proptest::prelude::*;

use super::*;
use crate::config::{NAME_BYTES, VARIABLES};
use crate::distribution::function::tests::definition;

#[track_caller]
fn reads_as(text: &str, shown: &str) {
    assert_eq!(format!("{}", parse(text).unwrap()), shown);
}

#[track_caller]
fn fails(text: &str, position: usize, expected: Expected) {
    assert_eq!(parse(text), Err(ParseError { position, expected }));
}

#[test]
fn spaces_are_free_and_one_is_implied() {
    reads_as("pos_info(position:int[2])->(position:int[2])", "pos_info(position: int[2]) -> (position: int[2])");
    reads_as(" f ( a : int , b:string [ 200 ] ) ", "f(a: int, b: string[200])");
    reads_as("f(a: int[1], b: float[01], c: bool, d: bytes[0])\n", "f(a: int, b: float, c: bool, d: bytes[0])");
    reads_as("f()->()", "f()");
    reads_as("camera/front.start-2()", "camera/front.start-2()");
}

#[test]
fn an_error_says_where_and_what() {
    fails("", 0, Expected::Name);
    fails("  (", 2, Expected::Name);
    fails("f", 1, Expected::Character('('));
    fails("f(", 2, Expected::Name);
    fails("f(a)", 3, Expected::Character(':'));
    fails("f(a: word)", 5, Expected::Type);
    fails("f(a: int[x])", 9, Expected::Size);
    fails("f(a: int[4294967296])", 9, Expected::Size);
    fails("f(a: int[2)", 10, Expected::Character(']'));
    fails("f(a: string)", 11, Expected::Character('['));
    fails("f(a: int b: int)", 9, Expected::CommaOrParenthesis);
    fails("f(a: int,)", 9, Expected::Name);
    fails("f() g", 4, Expected::ArrowOrEnd);
    fails("f() -> (a: int) g", 16, Expected::End);
    fails("f(a: int, a: int)", 10, Expected::NewName);
    fails("f(a: int) -> (a: bool)", 14, Expected::SameAsArgument);
    fails("fü()", 1, Expected::Character('('));
    fails(&"f".repeat(NAME_BYTES + 1), 0, Expected::ShorterName);
}

#[test]
fn limits_are_named_at_the_variable_that_exceeds_them() {
    let list = |count: usize, length: usize| -> String {
        let names: std::vec::Vec<_> = (0..count).map(|index| format!("{index:0>length$}: bool")).collect();
        format!("f({})", names.join(","))
    };
    assert!(parse(&list(VARIABLES, 2)).is_ok());
    fails(&list(VARIABLES + 1, 2), 2 + VARIABLES * 9, Expected::FewerVariables);
    // The results are the same variables; one of them no longer fits.
    let (long, each) = (list(16, 32), NAME_BYTES + 6);
    let both = format!("{long} -> {}", &long[1..]);
    let fitting = (SIGNATURE_BYTES - 4) / each;
    let at = 2 + fitting * (each + 1) + if fitting < 16 { 0 } else { " -> (".len() };
    fails(&both, at, Expected::ShorterSignature);
}

#[test]
fn errors_read_as_sentences() {
    let error = format!("{}", parse("f(a: word)").unwrap_err());
    assert!(error.starts_with("expected a type: int, float, string, bool") && error.ends_with(" at byte 5"), "{error}");
    let error = parse("f").unwrap_err();
    assert_eq!(format!("{error}"), "expected '(' at byte 1");
}

proptest! {
    #[test]
    fn what_is_shown_parses_back(definition in definition()) {
        let text = format!("{definition}");
        prop_assert_eq!(parse(&text), Ok(definition));
    }

    #[test]
    fn any_text_is_read_or_refused_inside_it(text in ".*") {
        if let Err(error) = parse(&text) {
            prop_assert!(text.is_char_boundary(error.position), "{}", error);
        }
    }

    #[test]
    fn almost_signatures_are_read_or_refused(
        words in prop::collection::vec(
            prop::sample::select(&["f", "(", ")", "->", ":", ",", "int", "string", "bytes", "[", "]", "2", " ", "ü"][..]),
            0..24,
        )
    ) {
        let text = words.concat();
        match parse(&text) {
            Ok(definition) => prop_assert_eq!(parse(&format!("{definition}")), Ok(definition)),
            Err(error) => prop_assert!(text.is_char_boundary(error.position)),
        }
    }
}

#[cfg(feature = "details")]
#[test]
fn progress_and_failures_are_declared_behind_the_results() {
    let texts = [
        "f() progress (left: float)",
        "f() fails (at: int[2])",
        "f(a: int) -> (b: int) progress (left: float) fails (at: int[2], why: string[20])",
    ];
    for text in texts {
        let definition = parse(text).unwrap();
        assert_eq!(format!("{definition}"), text);
        assert_eq!(
            crate::distribution::function::Signature::decode(definition.as_bytes()).unwrap(),
            definition.signature()
        );
    }
    assert_eq!(parse("f() progress () fails ()").unwrap(), parse("f()").unwrap());
    assert_eq!(parse("f(a: int)->(a: int)progress(a: float)").unwrap().signature().progress().count(), 1);
    for (text, expected) in [
        ("f() fails (at: int) progress (left: float)", Expected::End),
        ("f() progress (left: float, left: int)", Expected::NewName),
        ("f() progressing", Expected::Character('(')),
        ("f() fail", Expected::ArrowOrEnd),
    ] {
        assert_eq!(parse(text).unwrap_err().expected, expected, "{text}");
    }
}
