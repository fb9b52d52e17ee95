#![allow(
    clippy::indexing_slicing,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::arithmetic_side_effects
)]

use std::boxed::Box;
use std::collections::BTreeMap;
use std::string::String;
use std::vec::Vec;
use std::{format, vec};

use proptest::prelude::*;

use super::*;

#[test]
fn the_listing_of_the_paper() {
    let mut pos = Parameters::new();
    assert!(pos.is_empty() && pos.iter().next().is_none());
    pos.add_int("position", 2).unwrap();
    let mut coordinates = [9; 2];
    pos.variable_into("position", &mut coordinates).unwrap();
    assert_eq!(coordinates, [0, 0]);
    coordinates[0] = 1;
    coordinates[1] = 2;
    pos.set_value("position", coordinates).unwrap();
    pos.set_value("position", &coordinates[..]).unwrap();
    assert_eq!(pos.variable("position"), Ok([1_i64, 2]));
}

#[test]
fn literals_need_no_type() {
    let mut all = Parameters::new();
    all.add_int("int", 1).unwrap();
    all.add_int("ints", 3).unwrap();
    all.add_float("float", 1).unwrap();
    all.add_float("floats", 2).unwrap();
    all.add_bool("bool", 1).unwrap();
    all.add_string("string", 10).unwrap();
    all.add_bytes("bytes", 4).unwrap();
    all.set_value("int", -1).unwrap();
    all.set_value("ints", [1, 2, 3]).unwrap();
    all.set_value("float", 0.5).unwrap();
    all.set_value("floats", [0.5, -2.0]).unwrap();
    all.set_value("bool", true).unwrap();
    all.set_value("string", "grün").unwrap();
    all.set_value("bytes", b"\xFF\x00").unwrap();
    assert_eq!(all.variable::<i8>("int"), Ok(-1));
    assert_eq!(all.variable::<[u8; 3]>("ints"), Ok([1, 2, 3]));
    assert_eq!(all.variable::<f32>("float"), Ok(0.5));
    assert_eq!(all.variable::<[f64; 2]>("floats"), Ok([0.5, -2.0]));
    assert_eq!(all.variable::<bool>("bool"), Ok(true));
    assert_eq!(all.variable::<&str>("string"), Ok("grün"));
    assert_eq!(all.variable::<&[u8]>("bytes"), Ok(&[0xFF, 0][..]));
    assert_eq!(all.variable::<[u8; 2]>("bytes"), Ok([0xFF, 0]));
    assert_eq!(all.len(), 7);
}

#[test]
fn a_variable_can_be_set_from_itself() -> Result<(), Error> {
    let mut p = Parameters::new();
    p.add_int("n", 1)?;
    p.set_value("n", p.variable::<i64>("n")? + 1)?;
    let view: &mut ParametersView = &mut p;
    view.set_value("n", view.variable::<i64>("n")? + 1)?;
    assert_eq!(p.variable("n"), Ok(2));
    Ok(())
}

#[test]
fn a_number_out_of_range_changes_nothing() {
    let mut p = Parameters::new();
    p.add_int("n", 2).unwrap();
    p.set_value("n", [7, 300]).unwrap();
    assert_eq!(p.variable::<[u8; 2]>("n"), Err(Error::OutOfRange));
    assert_eq!(p.set_value("n", [1, u64::MAX]), Err(Error::OutOfRange));
    let mut narrow = [9_u8; 2];
    assert_eq!(p.variable_into("n", &mut narrow), Err(Error::OutOfRange));
    assert_eq!(narrow, [9, 9]);
    assert_eq!(p.variable("n"), Ok([7_i64, 300]));
}

#[test]
fn a_float_that_would_become_infinite_is_out_of_range() {
    let mut p = Parameters::new();
    p.add_float("x", 1).unwrap();
    for (value, narrow) in [(1e300, None), (f64::INFINITY, Some(f32::INFINITY)), (0.1, Some(0.1_f32))] {
        p.set_value("x", value).unwrap();
        assert_eq!(p.variable::<f32>("x").ok(), narrow, "{value}");
    }
    p.set_value("x", f64::NAN).unwrap();
    assert!(p.variable::<f32>("x").unwrap().is_nan());
}

#[test]
fn types_and_sizes_must_match() {
    let mut p = Parameters::new();
    p.add_bool("first", 1).unwrap();
    p.add_int("n", 2).unwrap();
    p.add_string("s", 3).unwrap();
    assert_eq!(p.set_value("n", 1.0), Err(Error::WrongType { index: 1 }));
    assert_eq!(p.set_value("n", "1"), Err(Error::WrongType { index: 1 }));
    assert_eq!(p.set_value("n", 1), Err(Error::WrongSize { index: 1, expected: 2, found: 1 }));
    assert_eq!(p.set_value("s", "four"), Err(Error::WrongSize { index: 2, expected: 3, found: 4 }));
    assert_eq!(p.set_value("s", &b"abc"[..]), Err(Error::WrongType { index: 2 }));
    assert_eq!(p.variable::<&[u8]>("s"), Err(Error::WrongType { index: 2 }));
    assert_eq!(p.variable::<[i64; 3]>("n"), Err(Error::WrongSize { index: 1, expected: 2, found: 3 }));
    assert_eq!(p.variable::<[f64; 2]>("n"), Err(Error::WrongType { index: 1 }));
    assert_eq!(p.variable::<i64>("m"), Err(Error::UnknownVariable));
    assert_eq!(p.set_value("m", 1), Err(Error::UnknownVariable));
    assert_eq!(p.variable("n"), Ok([0, 0]));
    assert_eq!(p.variable("s"), Ok(""));
}

#[test]
fn a_refused_variable_leaves_no_trace() {
    let mut p = Parameters::<32>::sized();
    p.add_int("a", 1).unwrap();
    let before = p.clone();
    assert_eq!(p.add_float("a", 1), Err(Error::NameTaken));
    assert_eq!(p.add_int("", 1), Err(Error::BadName));
    assert_eq!(p.add_int("a b", 1), Err(Error::BadName));
    assert_eq!(p.add_int("ü", 1), Err(Error::BadName));
    assert_eq!(p.add_int("a23456789012345678901234567890123", 0), Err(Error::Full(Limit::NameBytes)));
    assert_eq!(p.add_int("b", 3), Err(Error::Full(Limit::ParametersBytes)));
    assert_eq!(p.add_int("b", u32::MAX), Err(Error::Full(Limit::ParametersBytes)));
    assert_eq!(p.add_string("b", u32::MAX), Err(Error::Full(Limit::ParametersBytes)));
    assert_eq!(p, before);
    assert_eq!(p.remaining(), 32 - 9);
    p.add_bytes("b", 22).unwrap();
    assert_eq!(p.remaining(), 0);
}

#[test]
fn the_table_is_bounded() {
    let mut p = Parameters::new();
    for index in 0..VARIABLES {
        p.add_bool(&format!("v{index}"), 1).unwrap();
    }
    assert_eq!(p.add_bool("more", 1), Err(Error::Full(Limit::Variables)));
    p.clear();
    assert!(p.is_empty());
    p.add_bool("more", 1).unwrap();
}

#[test]
fn a_variable_costs_what_the_limit_says() {
    assert_eq!(size_of::<Entry>(), 16);
    assert!(size_of::<Parameters>() <= PARAMETERS_BYTES + 16 * VARIABLES + 8);
}

#[test]
fn old_values_do_not_show_in_new_variables() {
    let mut p = Parameters::new();
    p.add_int("n", 4).unwrap();
    p.set_value("n", [-1; 4]).unwrap();
    p.clear();
    p.add_float("m", 2).unwrap();
    p.add_bytes("b", 8).unwrap();
    assert_eq!(p.variable("m"), Ok([0.0, 0.0]));
    assert_eq!(p.variable::<&[u8]>("b"), Ok(&[][..]));
}

#[test]
fn a_box_of_any_size_is_a_view() {
    let mut boxed: Box<ParametersView> = Box::<Parameters<2048>>::default();
    boxed.add_string("text", 2000).unwrap();
    boxed.set_value("text", "long").unwrap();
    let mut small = Parameters::<16>::sized();
    small.add_bool("kept", 1).unwrap();
    assert_eq!(small.copy_from(&boxed), Err(Error::Full(Limit::ParametersBytes)));
    assert_eq!(small.variable("kept"), Ok(false));
    let mut large = Parameters::<4096>::sized();
    large.copy_from(&boxed).unwrap();
    assert_eq!(large.variable("text"), Ok("long"));
    assert_eq!(format!("{large:?}"), r#"{"text": string[2000]}"#);
}

/// The expected value of a variable.
#[derive(Clone, Debug, PartialEq)]
enum Content {
    Ints(Vec<i64>),
    Floats(Vec<u64>),
    Bools(Vec<bool>),
    Text(u32, String),
    Bytes(u32, Vec<u8>),
}

impl Content {
    fn add_to(&self, p: &mut ParametersView, name: &str) -> Result<(), Error> {
        match self {
            Self::Ints(values) => p.add_int(name, values.len() as u32),
            Self::Floats(values) => p.add_float(name, values.len() as u32),
            Self::Bools(values) => p.add_bool(name, values.len() as u32),
            Self::Text(maximum, _) => p.add_string(name, *maximum),
            Self::Bytes(maximum, _) => p.add_bytes(name, *maximum),
        }
    }

    fn emptied(&self) -> Self {
        match self {
            Self::Ints(values) => Self::Ints(vec![0; values.len()]),
            Self::Floats(values) => Self::Floats(vec![0; values.len()]),
            Self::Bools(values) => Self::Bools(vec![false; values.len()]),
            Self::Text(maximum, _) => Self::Text(*maximum, String::new()),
            Self::Bytes(maximum, _) => Self::Bytes(*maximum, Vec::new()),
        }
    }

    fn set_in(&self, p: &mut ParametersView, name: &str) -> Result<(), Error> {
        match self {
            Self::Ints(values) => p.set_value(name, &values[..]),
            Self::Floats(bits) => p.set_value(name, &bits.iter().map(|&b| f64::from_bits(b)).collect::<Vec<_>>()[..]),
            Self::Bools(values) => p.set_value(name, &values[..]),
            Self::Text(_, text) => p.set_value(name, text.as_str()),
            Self::Bytes(_, bytes) => p.set_value(name, &bytes[..]),
        }
    }

    fn of(value: Value<'_>) -> Self {
        match value.kind() {
            Type::Int => Self::Ints(value.ints().collect()),
            Type::Float => Self::Floats(value.floats().map(f64::to_bits).collect()),
            Type::Bool => Self::Bools(value.bools().collect()),
            Type::String => Self::Text(value.size(), value.text().unwrap().into()),
            Type::Bytes => Self::Bytes(value.size(), value.raw().into()),
            Type::List | Type::Record => unreachable!("the tests of nested values have these"),
        }
    }

    /// The value after setting a variable with value `self` to `other`; `None` if that fails.
    fn accepts(&self, other: &Self) -> Option<Self> {
        match (self, other) {
            (Self::Ints(a), Self::Ints(b)) => (a.len() == b.len()).then(|| other.clone()),
            (Self::Floats(a), Self::Floats(b)) => (a.len() == b.len()).then(|| other.clone()),
            (Self::Bools(a), Self::Bools(b)) => (a.len() == b.len()).then(|| other.clone()),
            (Self::Text(max, _), Self::Text(_, b)) => (b.len() <= *max as usize).then(|| Self::Text(*max, b.clone())),
            (Self::Bytes(max, _), Self::Bytes(_, b)) => {
                (b.len() <= *max as usize).then(|| Self::Bytes(*max, b.clone()))
            }
            // Bytes are also integers.
            (Self::Ints(a), Self::Bytes(_, b)) => {
                (a.len() == b.len()).then(|| Self::Ints(b.iter().map(|&byte| byte.into()).collect()))
            }
            _ => None,
        }
    }
}

fn content() -> impl Strategy<Value = Content> {
    prop_oneof![
        prop::collection::vec(any::<i64>(), 0..4).prop_map(Content::Ints),
        prop::collection::vec(any::<u64>(), 0..4).prop_map(Content::Floats),
        prop::collection::vec(any::<bool>(), 0..12).prop_map(Content::Bools),
        (0..8_u32, ".{0,3}").prop_map(|(spare, text)| Content::Text(text.len() as u32 + spare, text)),
        (0..8_u32, prop::collection::vec(any::<u8>(), 0..12))
            .prop_map(|(spare, bytes)| Content::Bytes(bytes.len() as u32 + spare, bytes)),
    ]
}

#[derive(Clone, Debug)]
enum Step {
    Add(u8, Content),
    Set(u8, Content),
    Copy,
    Clear,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        8 => (0..20_u8, content()).prop_map(|(name, content)| Step::Add(name, content)),
        16 => (0..20_u8, content()).prop_map(|(name, content)| Step::Set(name, content)),
        1 => Just(Step::Copy),
        1 => Just(Step::Clear),
    ]
}

proptest! {
    #[test]
    fn no_variable_ever_changes_another(steps in prop::collection::vec(step(), 0..60)) {
        let mut p = Parameters::<300>::sized();
        let mut model = BTreeMap::<String, Content>::new();
        for step in steps {
            match step {
                Step::Add(name, content) => {
                    let name = format!("v{name}");
                    let room = p.remaining();
                    match content.add_to(&mut p, &name) {
                        Ok(()) => prop_assert!(model.insert(name, content.emptied()).is_none()),
                        Err(Error::NameTaken) => prop_assert!(model.contains_key(&name)),
                        Err(Error::Full(Limit::Variables)) => prop_assert_eq!(model.len(), VARIABLES),
                        Err(error) => {
                            prop_assert_eq!(error, Error::Full(Limit::ParametersBytes));
                            prop_assert!(room < 40);
                        }
                    }
                }
                Step::Set(name, content) => {
                    let name = format!("v{name}");
                    let expected = model.get(&name).and_then(|old| old.accepts(&content));
                    prop_assert_eq!(content.set_in(&mut p, &name).is_ok(), expected.is_some());
                    if let Some(content) = expected {
                        model.insert(name, content);
                    }
                }
                Step::Copy => {
                    let mut other = Parameters::<300>::sized();
                    other.add_int("old", 4).unwrap();
                    other.copy_from(&p).unwrap();
                    p = other;
                }
                Step::Clear => {
                    p.clear();
                    model.clear();
                }
            }
            let found: BTreeMap<_, _> = p.iter().map(|v| (String::from(v.name), Content::of(v.value))).collect();
            prop_assert_eq!(found.len(), p.len());
            prop_assert_eq!(&found, &model);
        }
    }
}
