#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::panic, clippy::arithmetic_side_effects)]
use std::boxed::Box;
use std::format;
use std::string::{String, ToString};
use std::vec;
use std::vec::Vec;

use proptest::prelude::*;

use crate::config::{DEPTH, SIGNATURE_BYTES};
use crate::distribution::block::{self, SliceWriter};
use crate::distribution::function::{Definition, Signature};
use crate::distribution::parameters::{ListWriter, Parameters, ParametersView, RecordWriter, Slot, Type, Value};
use crate::distribution::text::{Expected, ParseError};
use crate::error::{Error, Limit};

const ORDER: &str = "order(nodes: {id: string[32], x: float, actions: {kind: int, marks: bool[3]}[..4]}[..8])";

fn definition(text: &str) -> Definition {
    Definition::parse(text).unwrap_or_else(|error| panic!("{text}: {error}"))
}

fn laid_out(definition: &Definition) -> Box<Parameters<8192>> {
    let mut parameters = Box::new(Parameters::sized());
    parameters.lay_out(definition.signature()).unwrap();
    parameters
}

fn node(node: &mut RecordWriter<'_>, id: &str, kinds: &[i64]) -> Result<(), Error> {
    node.set("id", id)?;
    node.set("x", 0.5)?;
    node.set_list("actions", |actions| {
        kinds.iter().try_for_each(|kind| {
            actions.push_record(|action| {
                action.set("kind", *kind)?;
                action.set("marks", [true, false, true])
            })
        })
    })
}

fn order() -> Box<Parameters<8192>> {
    let mut order = laid_out(&definition(ORDER));
    order
        .set_list("nodes", |nodes| {
            nodes.push_record(|first| node(first, "first", &[1, 2]))?;
            nodes.push_record(|second| node(second, "", &[]))
        })
        .unwrap();
    order
}

fn encoded(definition: &Definition, parameters: &ParametersView) -> Vec<u8> {
    let specs = definition.signature().arguments();
    let mut bytes = vec![0; block::measure(specs, parameters).unwrap()];
    let mut writer = SliceWriter::new(&mut bytes);
    block::write(specs, parameters, &mut writer);
    assert_eq!(writer.written(), bytes.len());
    bytes
}

#[test]
fn the_text_form_is_read_and_shown() {
    for text in [
        ORDER,
        "f(a: int[..8])",
        "f(a: int[2][..8])",
        "f(a: string[32][..8][..4], b: bool) -> (a: string[32][..8][..4], c: {d: bytes[4]})",
        "f(a: {b: {c: {d: {e: {f: {g: {h: {i: int}}}}}}}})",
        "f(a: int?[..2][..3][..4][..5][..6][..7][..8])",
        "f(a: int?, b: string[8]?[..2]?, c: {d: bool[2]?, e: int??}?)",
        "f(a: {b: int[..0], c: float}[..4294967295])",
    ] {
        assert_eq!(definition(text).to_string(), text);
    }
    assert_eq!(
        definition("f(a: int[..1], b: { c: string[2] ? } [..2])").to_string(),
        "f(a: int?, b: {c: string[2]?}[..2])"
    );
    assert_eq!(definition("f(a:{b:int , c : float [ 2 ] } [..3])").to_string(), "f(a: {b: int, c: float[2]}[..3])");
}

#[test]
fn what_is_no_type_is_pointed_at() {
    let mistake = |text| Definition::parse(text).unwrap_err();
    let at = |position, expected| ParseError { position, expected };
    assert_eq!(mistake("f(a: {})"), at(6, Expected::Name));
    assert_eq!(mistake("f(a: {b: int)"), at(12, Expected::CommaOrBrace));
    assert_eq!(mistake("f(a: {b: int, b: int})"), at(2, Expected::NewName));
    assert_eq!(mistake("f(a: {b: {c: {d: {e: {f: {g: {h: {i: {j: int}}}}}}}}})"), at(38, Expected::ShallowerType));
    assert_eq!(mistake("f(a: int[..1][..2][..3][..4][..5][..6][..7][..8][..9])"), at(2, Expected::ShallowerType));
    assert_eq!(mistake("f(a: {b: {c: {d: {e: {f: {g: {h: int[..1]}[..2]}}}}}})"), at(2, Expected::ShallowerType));
    assert_eq!(mistake("f(a: string[..8])"), at(12, Expected::Size));
    assert_eq!(mistake("f(a: list[8])"), at(5, Expected::Type));
    // A peer could claim any number of elements that take no bytes.
    assert!(Definition::parse("f(a: int[0][..8])").is_err());
    assert!(Definition::parse("f(a: {b: bool[0]}[..8])").is_err());
    let long = format!("f(a: {{{}}})", (0..90).map(|n| format!("field{n:03}: int")).collect::<Vec<_>>().join(", "));
    assert_eq!(mistake(&long).expected, Expected::ShorterSignature);
}

#[test]
fn signatures_are_checked_before_they_are_kept() {
    let list_of = |inner: &[u8]| {
        let mut bytes = vec![1, b'f', 1, 5, 1, 8, 0, 0, 0, b'a'];
        bytes.extend_from_slice(inner);
        bytes.push(0);
        Signature::decode(&bytes).map(|signature| signature.to_string())
    };
    assert_eq!(list_of(&[0, 1, 0, 0, 0]), Ok("f(a: int[..8])".to_string()));
    for wrong in [
        &[][..],
        &[7, 1, 0, 0, 0],
        &[0, 0, 0, 0, 0],
        &[6, 0, 0, 0, 0],
        &[6, 0, 1, 0, 0],
        &[6, 255, 255, 255, 255],
        &[6, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, b' '],
        &[6, 2, 0, 0, 0, 0, 1, 1, 0, 0, 0, b'b', 0, 1, 1, 0, 0, 0, b'b'],
        &[&[5, 1, 0, 0, 0].repeat(DEPTH)[..], &[0, 1, 0, 0, 0]].concat(),
    ] {
        assert_eq!(list_of(wrong), Err(Error::Malformed), "{wrong:?}");
    }
}

/// A type of `depth` lists and records in each other: a list where the bit of that level is set. Its text, and how it is encoded
/// behind `f`, with one argument `a`.
fn tower(depth: usize, lists: usize) -> (String, Vec<u8>) {
    let (mut text, mut head, mut inner) = ("int".to_string(), (0_u8, 1_u8), vec![]);
    for level in 0..depth {
        let (kind, size) = head;
        if lists >> level & 1 == 1 {
            text += "[..2]";
            inner = [&[kind, size, 0, 0, 0][..], &inner].concat();
            head = (5, 2);
        } else {
            text = format!("{{b: {text}}}");
            inner = [&[kind, 1, size, 0, 0, 0, b'b'][..], &inner].concat();
            head = (6, 1);
        }
    }
    let bytes = [&[1, b'f', 1, head.0, 1, head.1, 0, 0, 0, b'a'][..], &inner, &[0]].concat();
    (format!("f(a: {text})"), bytes)
}

/// Two elements in each list of a [`tower`], the innermost of which count up.
fn fill(slot: Slot<'_>, depth: usize, lists: usize, next: &mut i64) -> Result<(), Error> {
    let Some(depth) = depth.checked_sub(1) else {
        *next += 1;
        return slot.set(*next);
    };
    if lists >> depth & 1 == 0 {
        return slot.record(|record| record.set_with("b", |slot| fill(slot, depth, lists, next)));
    }
    slot.list(|list| (0..2).try_for_each(|_| list.push_with(|slot| fill(slot, depth, lists, next))))
}

fn sum(value: Value<'_>) -> i64 {
    match value.kind() {
        Type::List => value.elements().map(sum).sum(),
        Type::Record => value.fields().map(|field| sum(field.value)).sum(),
        _ => value.ints().sum(),
    }
}

#[test]
fn every_order_of_lists_and_records_goes_as_deep_as_the_limit_and_no_deeper() {
    for lists in 0..1 << DEPTH {
        let (text, bytes) = tower(DEPTH, lists);
        let definition = definition(&text);
        assert_eq!((definition.to_string(), definition.as_bytes()), (text, &bytes[..]));
        assert_eq!(Signature::decode(&bytes), Ok(definition.signature()));
        let (mut parameters, mut last) = (laid_out(&definition), 0);
        parameters.slot_of(0).and_then(|slot| fill(slot, DEPTH, lists, &mut last)).unwrap();
        assert_eq!(last, 1 << lists.count_ones());
        let block = encoded(&definition, &parameters);
        let mut read = laid_out(&definition);
        assert_eq!(block::read_arguments(definition.signature().arguments(), &block, &mut *read), Ok(()));
        assert_eq!((&*read, sum(read.value("a").unwrap())), (&*parameters, last * (last + 1) / 2));
    }
    for lists in 0..2 << DEPTH {
        let (text, bytes) = tower(DEPTH + 1, lists);
        assert_eq!(Definition::parse(&text).unwrap_err().expected, Expected::ShallowerType, "{text}");
        assert_eq!(Signature::decode(&bytes), Err(Error::Malformed), "{text}");
    }
}

#[test]
fn a_list_of_records_is_written_and_read_back() {
    let order = order();
    let shown = r#"nodes: [{id: "first", x: 0.5, actions: [{kind: 1, marks: [true, false, true]}, {kind: 2, marks: [true, false, true]}]}, {id: "", x: 0.5, actions: []}]"#;
    assert_eq!(order.to_string(), shown);
    let mut nodes = order.list("nodes").unwrap();
    assert_eq!(nodes.len(), 2);
    let first = nodes.next().unwrap();
    let kinds: Vec<i64> = first
        .field("actions")
        .unwrap()
        .elements()
        .map(|action| action.field("kind").unwrap().read().unwrap())
        .collect();
    assert_eq!(kinds, [1, 2]);
    assert_eq!(first.field("none"), Err(Error::UnknownVariable));
    assert_eq!(order.list("none").err(), Some(Error::UnknownVariable));
    assert_eq!(order.record("nodes").err(), Some(Error::WrongType { index: 0 }));

    let definition = definition(ORDER);
    let bytes = encoded(&definition, &order);
    assert_eq!(bytes.len() % 8, 0);
    let mut read = Box::new(Parameters::<8192>::sized());
    block::read_arguments(definition.signature().arguments(), &bytes, &mut *read).unwrap();
    assert_eq!(*read, *order);
}

#[test]
fn setting_a_list_moves_what_follows_it() {
    let mut all = laid_out(&definition("f(a: int, b: int[..4], c: string[8], d: {e: int[..2], g: bool}, h: float)"));
    let ints = |list: &mut ListWriter<'_>, count: i64| (0..count).try_for_each(|number| list.push(number));
    all.set_value("a", 7).unwrap();
    all.set_value("c", "text").unwrap();
    all.set_value("h", 2.5).unwrap();
    let before = all.remaining();
    for count in [4, 1, 3, 0, 2] {
        all.set_list("b", |list| ints(list, count)).unwrap();
        all.set_record("d", |record| {
            record.set_list("e", |list| ints(list, count.min(2)))?;
            record.set("g", true)
        })
        .unwrap();
        assert_eq!(all.variable("a"), Ok(7));
        assert_eq!(all.variable("c"), Ok("text"));
        assert_eq!(all.variable("h"), Ok(2.5));
        let numbers: Vec<i64> = all.list("b").unwrap().map(|number| number.read().unwrap()).collect();
        assert_eq!(numbers, (0..count).collect::<Vec<_>>());
        assert_eq!(all.record("d").unwrap().count(), 2);
        assert_eq!(before - all.remaining(), 8 * (count + count.min(2)) as usize);
    }
}

#[test]
fn what_does_not_fit_leaves_the_old_value() {
    let mut order = order();
    let old = order.clone();
    let mut wrong = |write: fn(&mut ListWriter<'_>) -> Result<(), Error>, error| {
        assert_eq!(order.set_list("nodes", write), Err(error));
        assert_eq!(order, old);
    };
    let index = 0;
    wrong(|nodes| nodes.push(1), Error::WrongType { index });
    wrong(|nodes| nodes.push_list(|_| Ok(())), Error::WrongType { index });
    wrong(|nodes| nodes.push_record(|_| Ok(())), Error::MissingArgument { index });
    wrong(|nodes| nodes.push_record(|node| node.set("x", 1.0)), Error::UnknownVariable);
    wrong(|nodes| nodes.push_record(|node| node.set("id", 1)), Error::WrongType { index });
    wrong(|nodes| nodes.push_record(|node| node.set_list("id", |_| Ok(()))), Error::WrongType { index });
    let long =
        |nodes: &mut ListWriter<'_>| nodes.push_record(|node| node.set("id", "123456789012345678901234567890123"));
    wrong(long, Error::WrongSize { index, expected: 32, found: 33 });
    let ninth = Error::WrongSize { index, expected: 8, found: 9 };
    wrong(|nodes| (0..9).try_for_each(|_| nodes.push_record(|next| node(next, "", &[]))), ninth);
    let behind = |nodes: &mut ListWriter<'_>| {
        nodes.push_record(|record| {
            node(record, "", &[])?;
            record.set("y", 1)
        })
    };
    wrong(behind, Error::UnknownVariable);

    assert_eq!(order.set_record("nodes", |_| Ok(())), Err(Error::WrongType { index }));
    assert_eq!(order.set_list("none", |_| Ok(())), Err(Error::UnknownVariable));
    assert_eq!(order.set_value("nodes", [1, 2]), Err(Error::WrongType { index }));
    // If a closure ignores the error of one element, the list has the others.
    let kept = order.set_list("nodes", |nodes| {
        let _ = nodes.push_record(|next| next.set("x", 1.0));
        nodes.push_record(|next| node(next, "only", &[]))
    });
    assert_eq!((kept, order.list("nodes").unwrap().count()), (Ok(()), 1));
}

#[test]
fn a_small_arena_says_that_it_is_full() {
    let definition = definition("f(a: string[400][..8])");
    let mut small = Parameters::<48>::sized();
    small.lay_out(definition.signature()).unwrap();
    let full = Err(Error::Full(Limit::ParametersBytes));
    assert_eq!(small.set_list("a", |list| list.push("12345678901234567890")), full);
    // A text that is shorter than declared needs capacity for its actual length only.
    assert_eq!(small.set_list("a", |list| list.push("12345678")), Ok(()));
    assert_eq!(small.set_list("a", |list| list.push("1234567890123456789012345678901234567890")), full);
    assert_eq!(small.to_string(), r#"a: ["12345678"]"#);
}

/// Checks `nodes` with one of its words changed.
fn changed(word: usize, value: u64) -> Result<(), Error> {
    let definition = definition(ORDER);
    let mut bytes = encoded(&definition, &order());
    bytes[word * 8..][..8].copy_from_slice(&value.to_le_bytes());
    block::check(definition.signature().arguments(), &bytes)
}

#[test]
fn counts_and_lengths_that_lie_are_malformed() {
    let bytes = encoded(&definition(ORDER), &order());
    let body = (bytes.len() - 8) as u64;
    let list = |count: u64, body: u64| changed(0, count | body << 32);
    assert_eq!(list(2, body), Ok(()));
    for (count, body) in
        [(1, body), (3, body), (9, body), (0, body), (2, body - 8), (2, body + 8), (2, body - 1), (0xFFFF_FFFF, body)]
    {
        assert_eq!(list(count, body), Err(Error::Malformed), "{count}, {body}");
    }
    // The text `first` begins at word 1, and the actions of that node at word 4.
    assert_eq!(changed(1, 33), Err(Error::Malformed));
    assert_eq!(changed(2, 0xFF), Err(Error::Malformed));
    assert_eq!(changed(4, 2 | 32 << 32), Ok(()));
    assert_eq!(changed(4, 2 | 24 << 32), Err(Error::Malformed));
    assert_eq!(changed(4, 1 | 32 << 32), Err(Error::Malformed));
    assert_eq!(changed(6, 2), Err(Error::Malformed));
}

#[test]
fn another_version_fits_as_long_as_its_values_do() {
    let specs = |text: &str| definition(text);
    let sent = |theirs: &str| {
        let mut own = laid_out(&specs("f(a: {b: string[8], c: int}[..4])"));
        let node = |record: &mut RecordWriter<'_>| {
            record.set("b", "four")?;
            record.set("c", 1)
        };
        own.set_list("a", |list| list.push_record(node).and_then(|()| list.push_record(node))).unwrap();
        block::measure(specs(theirs).signature().arguments(), &own)
    };
    assert_eq!(sent("f(a: {b: string[8], c: int}[..4])"), Ok(56));
    assert_eq!(sent("f(a: {b: string[4], c: int}[..2])"), Ok(56));
    let index = 0;
    assert_eq!(sent("f(a: {b: string[4], c: int}[..1])"), Err(Error::WrongSize { index, expected: 1, found: 2 }));
    assert_eq!(sent("f(a: {b: string[3], c: int}[..4])"), Err(Error::WrongSize { index, expected: 4, found: 4 }));
    assert_eq!(sent("f(a: {b: string[8], c: float}[..4])"), Err(Error::WrongType { index }));
    assert_eq!(sent("f(a: {b: string[8], d: int}[..4])"), Err(Error::WrongType { index }));
    assert_eq!(sent("f(a: {b: string[8]}[..4])"), Err(Error::WrongType { index }));
    assert_eq!(sent("f(a: int[..4])"), Err(Error::WrongType { index }));
}

#[test]
fn results_update_lists_or_leave_all_as_it_was() {
    let service = definition("f() -> (a: int[..4], b: {c: string[8]}, d: int)");
    let results = service.signature().results();
    let mut theirs = laid_out(&service);
    theirs.set_list("a", |list| [1, 2, 3].into_iter().try_for_each(|number| list.push(number))).unwrap();
    theirs.set_record("b", |record| record.set("c", "text")).unwrap();
    theirs.set_value("d", 4).unwrap();
    let mut bytes = vec![0; block::measure(results, &*theirs).unwrap()];
    block::write(results, &*theirs, &mut SliceWriter::new(&mut bytes));

    let mut own = Parameters::new();
    assert_eq!(block::check_results_fit(results, &own), Ok(()));
    for _ in 0..2 {
        block::read(results, &bytes, &mut own).unwrap();
        assert_eq!(own.to_string(), r#"a: [1, 2, 3], b: {c: "text"}, d: 4"#);
    }
    let other = definition("f(d: int, a: int[..2])");
    let mut fewer = laid_out(&other);
    let old = fewer.clone();
    let refused = block::read(results, &bytes, &mut *fewer);
    assert_eq!((refused, &fewer), (Err(Error::WrongSize { index: 0, expected: 2, found: 3 }), &old));
    let mut small = Parameters::<64>::sized();
    let refused = block::read(results, &bytes, &mut small);
    assert!(matches!(refused, Err(Error::ResultWouldNotFit { .. })), "{refused:?}");
    assert!(small.is_empty());
    bytes[0] = 4;
    assert_eq!(block::read(results, &bytes, &mut own), Err(Error::ResultLost));
}

/// A type and a value of it.
#[derive(Clone, Debug)]
enum Data {
    Ints(Vec<i64>),
    Bools(Vec<bool>),
    Text(u32, String),
    Bytes(u32, Vec<u8>),
    /// The first entry is not an element; it determines the type of elements.
    List(u32, Vec<Data>),
    Record(Vec<Data>),
}

impl Data {
    fn text(&self) -> String {
        match self {
            Self::Ints(ints) => format!("int[{}]", ints.len()),
            Self::Bools(bools) => format!("bool[{}]", bools.len()),
            Self::Text(most, _) => format!("string[{most}]"),
            Self::Bytes(most, _) => format!("bytes[{most}]"),
            Self::List(1, elements) => format!("{}?", elements[0].text()),
            Self::List(most, elements) => format!("{}[..{most}]", elements[0].text()),
            Self::Record(fields) => {
                let fields = fields.iter().enumerate().map(|(index, field)| format!("f{index}: {}", field.text()));
                format!("{{{}}}", fields.collect::<Vec<_>>().join(", "))
            }
        }
    }

    fn push(&self, list: &mut ListWriter<'_>) -> Result<(), Error> {
        match self {
            Self::Ints(ints) => list.push(&ints[..]),
            Self::Bools(bools) => list.push(&bools[..]),
            Self::Text(_, text) => list.push(text.as_str()),
            Self::Bytes(_, bytes) => list.push(&bytes[..]),
            Self::List(_, elements) => {
                list.push_list(|list| elements[1..].iter().try_for_each(|element| element.push(list)))
            }
            Self::Record(fields) => list.push_record(|record| Self::fill(fields, record)),
        }
    }

    fn fill(fields: &[Self], record: &mut RecordWriter<'_>) -> Result<(), Error> {
        fields.iter().enumerate().try_for_each(|(index, field)| {
            let name = &*format!("f{index}");
            match field {
                Self::Ints(ints) => record.set(name, &ints[..]),
                Self::Bools(bools) => record.set(name, &bools[..]),
                Self::Text(_, text) => record.set(name, text.as_str()),
                Self::Bytes(_, bytes) => record.set(name, &bytes[..]),
                Self::List(_, elements) => {
                    record.set_list(name, |list| elements[1..].iter().try_for_each(|element| element.push(list)))
                }
                Self::Record(fields) => record.set_record(name, |record| Self::fill(fields, record)),
            }
        })
    }

    fn is(&self, value: Value<'_>) -> bool {
        match self {
            Self::Ints(ints) => value.kind() == Type::Int && value.ints().eq(ints.iter().copied()),
            Self::Bools(bools) => value.kind() == Type::Bool && value.bools().eq(bools.iter().copied()),
            Self::Text(_, text) => value.text() == Some(text),
            Self::Bytes(_, bytes) => value.kind() == Type::Bytes && value.raw() == bytes,
            Self::List(_, elements) => {
                value.elements().len() as usize == elements.len() - 1
                    && elements[1..].iter().zip(value.elements()).all(|(element, value)| element.is(value))
            }
            Self::Record(fields) => {
                value.fields().count() == fields.len()
                    && fields.iter().zip(value.fields()).all(|(field, variable)| field.is(variable.value))
            }
        }
    }
}

/// `count` values of the same type.
fn same(data: &Data, count: usize, seed: i64) -> Vec<Data> {
    let varied = |index: usize| match data {
        Data::Ints(ints) => Data::Ints(ints.iter().map(|int| int ^ (seed + index as i64)).collect()),
        Data::Bools(bools) => Data::Bools(bools.iter().map(|truth| *truth != (index.is_multiple_of(2))).collect()),
        Data::Text(most, text) => Data::Text(*most, text.chars().skip(index).collect()),
        Data::Bytes(most, bytes) => Data::Bytes(*most, bytes.iter().skip(index).copied().collect()),
        Data::List(most, elements) => {
            Data::List(*most, elements.iter().take(1 + elements.len().saturating_sub(1 + index)).cloned().collect())
        }
        other => other.clone(),
    };
    (0..count).map(varied).collect()
}

fn data() -> impl Strategy<Value = Data> {
    let leaf = prop_oneof![
        prop::collection::vec(any::<i64>(), 1..4).prop_map(Data::Ints),
        prop::collection::vec(any::<bool>(), 1..12).prop_map(Data::Bools),
        "[aäß€]{0,5}".prop_map(|text| Data::Text(15, text)),
        prop::collection::vec(any::<u8>(), 0..12).prop_map(|bytes| Data::Bytes(11, bytes)),
    ];
    leaf.prop_recursive(8, 24, 4, |inner| {
        prop_oneof![
            (inner.clone(), 0..4_usize, any::<i32>(), 0..3_u32).prop_map(|(element, count, seed, more)| {
                let mut elements = vec![element.clone()];
                elements.extend(same(&element, count, seed.into()));
                Data::List(count as u32 + more, elements)
            }),
            prop::collection::vec(inner, 1..4).prop_map(Data::Record),
        ]
    })
}

proptest! {
    #[test]
    fn whatever_is_written_is_read_back(top in prop::collection::vec(data(), 1..4), noise: u64) {
        let names: Vec<_> = (0..top.len()).map(|index| format!("v{index}")).collect();
        let variables = top.iter().zip(&names).map(|(data, name)| format!("{name}: {}", data.text()));
        let text = format!("f({})", variables.collect::<Vec<_>>().join(", "));
        let Ok(definition) = Definition::parse(&text) else {
            prop_assume!(false);
            return Ok(());
        };
        prop_assert_eq!(definition.to_string(), text.replace("int[1]", "int").replace("bool[1]", "bool"));
        prop_assert_eq!(Signature::decode(definition.as_bytes()), Ok(definition.signature()));
        prop_assert!(definition.as_bytes().len() <= SIGNATURE_BYTES);

        let mut parameters = Box::new(Parameters::<65_536>::sized());
        // Earlier contents of the arena must not show up as padding.
        parameters.lay_out(crate::distribution::function::Definition::parse("g(a: bytes[60000])").unwrap().signature()).unwrap();
        parameters.set_value("a", &*vec![noise as u8 | 1; 60_000]).unwrap();
        parameters.lay_out(definition.signature()).unwrap();
        for (data, name) in top.iter().zip(&names) {
            match data {
                Data::Ints(ints) => parameters.set_value(name, &ints[..]),
                Data::Bools(bools) => parameters.set_value(name, &bools[..]),
                Data::Text(_, text) => parameters.set_value(name, text.as_str()),
                Data::Bytes(_, bytes) => parameters.set_value(name, &bytes[..]),
                Data::List(_, elements) => {
                    parameters.set_list(name, |list| elements[1..].iter().try_for_each(|element| element.push(list)))
                }
                Data::Record(fields) => parameters.set_record(name, |record| Data::fill(fields, record)),
            }.unwrap();
        }
        let specs = definition.signature().arguments();
        let bytes = encoded(&definition, &parameters);
        prop_assert!(bytes.len() <= block::longest(specs).unwrap());
        prop_assert_eq!(block::check(specs, &bytes), Ok(()));
        let mut read = Box::new(Parameters::<65_536>::sized());
        prop_assert_eq!(block::read_arguments(specs, &bytes, &mut *read), Ok(()));
        prop_assert_eq!(&*read, &*parameters);
        for (data, name) in top.iter().zip(&names) {
            prop_assert!(data.is(read.value(name).unwrap()));
        }
        prop_assert_eq!(encoded(&definition, &read), bytes.clone());

        // A block that is cut off or too long is malformed. A changed bit is either refused or read as a value that encodes to
        // it.
        prop_assert_eq!(block::check(specs, &bytes[..bytes.len() - 8]), Err(Error::Malformed));
        let mut changed = bytes;
        let at = noise as usize % (changed.len() * 8);
        changed[at / 8] ^= 1 << (at % 8);
        if block::read_arguments(specs, &changed, &mut *read).is_ok() {
            prop_assert_eq!(encoded(&definition, &read), changed);
        }
    }

    #[test]
    fn arbitrary_signatures_and_blocks_never_panic(
        inner in prop::collection::vec(prop_oneof![0..8_u8, any::<u8>(), Just(b'a')], 0..80),
        kind in 5..7_u8,
        size in 0..4_u8,
        block in prop::collection::vec(prop_oneof![Just(0_u8), 0..4_u8, Just(8), any::<u8>()], 0..120),
    ) {
        let mut bytes = vec![1, b'f', 1, kind, 1, size, 0, 0, 0, b'v'];
        bytes.extend_from_slice(&inner);
        bytes.push(0);
        if let Ok(signature) = Signature::decode(&bytes) {
            let again = definition(&signature.to_string());
            prop_assert_eq!(again.as_bytes(), &bytes[..]);
            let mut read = Box::new(Parameters::<1024>::sized());
            if block::read_arguments(signature.arguments(), &block, &mut *read).is_ok() {
                prop_assert_eq!(encoded(&signature.to_definition(), &read), block);
            }
        }
    }
}
