#![allow(clippy::unwrap_used)]

use cara_std::Definition;
use cara_std::control::protocol::{Argument, ArgumentValue, Number};
use proptest::prelude::*;

use super::{Mistake, bind, read, show_call};

const ALL: &str = "all(i: int, is: int[2], f: float, b: bool[3], s: string[5], y: bytes[2])";

fn parse(text: &str, signature: &str) -> Result<Vec<Argument>, Mistake> {
    let definition = Definition::parse(signature).unwrap();
    read(text).and_then(|written| bind(&written, &definition.signature()))
}

/// The text under the carets, and the whole message.
fn mistake(text: &str, signature: &str) -> (String, String) {
    let mistake = parse(text, signature).expect_err(text);
    (text[mistake.at.clone()].to_owned(), mistake.show(text, Some(signature)))
}

#[test]
fn every_type_is_read() {
    let arguments = parse(r#"all(y: 0xFF, i: -7, is: [0x10, +2], f: 5, b: [true, false, true,], s: "ä\n\"")"#, ALL);
    let value = |index: usize| arguments.as_ref().unwrap().get(index).unwrap().value.clone();
    assert_eq!(value(0), ArgumentValue::Int(vec![-7]));
    assert_eq!(value(1), ArgumentValue::Int(vec![16, 2]));
    assert_eq!(value(2), ArgumentValue::Float(vec![Number::Finite(5.0)]));
    assert_eq!(value(3), ArgumentValue::Bool(vec![true, false, true]));
    assert_eq!(value(4), ArgumentValue::String("ä\n\"".into()));
    assert_eq!(value(5), ArgumentValue::Bytes("ff".into()));
    assert_eq!(arguments.unwrap().first().unwrap().size, 1);
}

const ORDER: &str = "order(nodes: {id: string[4], x: float, marks: bool[2], data: bytes[2][..2]}[..4], last: {n: int})";

#[test]
fn lists_and_records_are_read_in_either_form() {
    let written = r#"order(nodes: [{id: "a", x: 1, marks: [true, false], data: [0x01FF, "00"]}], last: {n: 0x10})"#;
    let json = r#"order {"last": {"n": 16}, "nodes": [{"x": 1.0, "id": "a", "marks": [true, false], "data": ["01ff", "00"]}]}"#;
    let arguments = parse(written, ORDER).unwrap();
    assert_eq!(parse(json, ORDER).unwrap(), arguments);
    let node = serde_json::json!({ "id": "a", "x": 1.0, "marks": [true, false], "data": ["01ff", "00"] });
    assert_eq!(arguments[0].value, ArgumentValue::List(serde_json::json!([node])));
    assert_eq!(arguments[1].value, ArgumentValue::Record(serde_json::json!({ "n": 16 })));
    let shown = show_call("order", &arguments);
    assert_eq!(parse(&shown, ORDER).unwrap(), arguments, "{shown}");
}

#[test]
fn whole_numbers_are_exact_and_members_in_their_order_at_every_depth() {
    let signature = "load(l: {id: int, at: {x: int, n: int[2]}[..2], kg: float})";
    let typed = "load(l: {kg: 1, at: [{n: [9007199254740993, -1], x: -9223372036854775808}], id: 1460549358372198212})";
    let shown =
        "load(l: {id: 1460549358372198212, at: [{x: -9223372036854775808, n: [9007199254740993, -1]}], kg: 1.0})";
    let arguments = parse(typed, signature).unwrap();
    // As on the control socket.
    let sent: Vec<Argument> = serde_json::from_str(&serde_json::to_string(&arguments).unwrap()).unwrap();
    assert_eq!(show_call("load", &sent), shown);
}

#[test]
fn a_mistake_in_a_list_is_told_with_its_path() {
    let node = r#"{id: "a", x: 1, marks: [true, true], data: []}"#;
    let reported = |last: &str, at: &str, what: &str| {
        let text = format!("order(nodes: [{node}, {node}, {node}, {last}], last: {{n: 1}})");
        let (found, shown) = mistake(&text, ORDER);
        assert!(found == at && shown.starts_with(what), "{found}: {shown}");
    };
    let with = |field: &str, value: &str| {
        let fields = [("id", "\"a\""), ("x", "1"), ("marks", "[true, true]"), ("data", "[]")];
        let fields = fields.map(|(name, usual)| format!("{name}: {}", if name == field { value } else { usual }));
        format!("{{{}}}", fields.join(", "))
    };
    reported(&with("x", "\"one\""), "\"one\"", "`nodes[3].x` is a float, and this is not");
    reported(&with("id", "\"12345\""), "\"12345\"", "`nodes[3].id` takes at most 4 bytes, and this has 5");
    reported(&with("marks", "true"), "true", "`nodes[3].marks` has 2 elements, and this has 1");
    reported(&with("data", "[0x00, 7]"), "7", "`nodes[3].data[1]` is of the type bytes, and this is not");
    reported(&with("data", "[0x00, 0x00, 0x00]"), "[0x00, 0x00, 0x00]", "`nodes[3].data` takes at most 2 elements");
    reported("7", "7", "`nodes[3]` is a record, and this is not");
    reported("{id: \"a\", x: 1, data: []}", "}", "`nodes[3].marks` is missing");
    reported("{id: \"a\", y: 1}", "y", "`nodes[3]` has no field `y`");
    reported("{id: \"a\", id: \"b\"}", "id", "`nodes[3].id` is there twice");
    let deep = format!("order(nodes: {})", "[".repeat(100_000));
    assert_eq!(mistake(&deep, ORDER).0, "[");
}

#[test]
fn an_optional_value_is_the_value_or_null_or_nothing() {
    let signature = "f(a: int?, b: {c: string[4]?, d: int[2]?}, e: int[..3]?)";
    for (text, shown) in [
        ("f(b: {})", "f(a: null, b: {}, e: null)"),
        ("f(a: 7, b: {c: \"x\", d: [1, 2]}, e: [3])", "f(a: 7, b: {c: \"x\", d: [1, 2]}, e: [3])"),
        ("f(a: [7], b: {c: [\"x\"], d: [[1, 2]]}, e: [])", "f(a: 7, b: {c: \"x\", d: [1, 2]}, e: [])"),
        (r#"f {"a": null, "b": {"c": null}, "e": [[]]}"#, "f(a: null, b: {c: null}, e: [])"),
    ] {
        let arguments = parse(text, signature).unwrap();
        assert_eq!(show_call("f", &arguments), shown);
        let sent: Vec<Argument> = serde_json::from_str(&serde_json::to_string(&arguments).unwrap()).unwrap();
        assert_eq!(sent, arguments);
    }
    assert!(mistake("f(a: true, b: {})", signature).1.starts_with("`a` is an int, and this is not"));
    assert!(mistake("f(a: 7, b: null)", signature).1.starts_with("`b` is a record, and this is not"));
}

#[test]
fn floats_may_be_no_numbers() {
    let read = |text: &str| parse(&format!("f(x: {text})"), "f(x: float)").unwrap().remove(0).value;
    for (text, word) in [("NaN", "NaN"), ("inf", "inf"), ("-inf", "-inf")] {
        assert_eq!(read(text), ArgumentValue::Float(vec![Number::Other(word.into())]));
    }
    assert_eq!(read("1e-3"), ArgumentValue::Float(vec![Number::Finite(0.001)]));
}

#[test]
fn a_call_without_arguments_needs_no_parentheses() {
    for text in ["stop", "stop()", " stop ( ) "] {
        assert_eq!(parse(text, "stop()"), Ok(vec![]));
    }
    assert_eq!(parse("f(x: [7])", "f(x: int)"), parse("f(x: 7)", "f(x: int)"));
}

#[test]
fn a_mistake_points_at_its_place_and_shows_the_signature() {
    let signature = "go_to(position: int[2])";
    let shown = mistake("go_to(position: [1, 2, 3])", signature).1;
    assert_eq!(
        shown,
        "`position` has 2 elements, and this has 3\n  go_to(position: [1, 2, 3])\n                  ^^^^^^^^^\n  \
         expected: 2 whole numbers, as in position: [1, 1]\n  signature: go_to(position: int[2])"
    );
}

#[test]
fn every_kind_of_mistake_is_placed() {
    let places = [
        ("go_to", "", "is missing"),
        ("go_to()", "", "is missing"),
        ("go_to(positon: [1, 2])", "positon", "`position`"),
        ("go_to(position: [1, 2], position: [1, 2])", "position", "twice"),
        ("go_to(position: [1, 2.5])", "2.5", "an int"),
        ("go_to(position: \"x\")", "\"x\"", "an int"),
        ("go_to(position: 1)", "1", "has 2 elements, and this has 1"),
        ("go_to(position: [])", "[]", "has 2 elements, and this has 0"),
        ("go_to(position: [1, 9223372036854775808])", "9223372036854775808", "does not fit"),
        ("go_to(position: [0x, 1])", "0x", "an int"),
        ("go_to(position: north)", "north", "double quotes"),
        ("go_to(position: )", ")", "a value is missing"),
        ("go_to(position: [[1], [2]])", "[1]", "`position` is an int, and this is not"),
        ("go_to(position [1, 2])", "[", "colon"),
        ("go_to(position: [1 2])", "2", "comma"),
        ("go_to(position: [1, 2]", "", "ends too early"),
        ("go_to(position: [1, 2]) now", "now", "has ended before this"),
        ("go_to(: 1)", ":", "begins with its name"),
        ("(position: 1)", "(", "name is missing"),
        ("", "", "name is missing"),
    ];
    for (text, place, what) in places {
        let (found, shown) = mistake(text, "go_to(position: int[2])");
        assert!(found == place && shown.contains(what), "{text}: {found}\n{shown}");
    }
}

#[test]
fn texts_and_bytes_are_checked() {
    let places = [
        ("say(text: \"abcdef\")", "\"abcdef\"", "at most 5 bytes, and this has 6"),
        ("say(text: \"äöü\")", "\"äöü\"", "this has 6"),
        ("say(text: \"a\\q\")", "\\q", "not one of JSON"),
        ("say(text: \"\\u00e4\\ud800\")", "\\ud800", "not one of JSON"),
        ("say(text: \"a\tb\")", "\t", "control characters"),
        ("say(text: \"abc)", "\"abc)", "closing quote"),
        ("say(text: 5)", "5", "a string"),
    ];
    for (text, place, what) in places {
        let (found, shown) = mistake(text, "say(text: string[5])");
        assert!(found == place && shown.contains(what), "{text}: {found}\n{shown}");
    }
    for (text, what) in
        [("0x010203", "at most 2 bytes"), ("0x123", "two hexadecimal"), ("0xzz", "two hex"), ("12", "bytes")]
    {
        let (found, shown) = mistake(&format!("put(data: {text})"), "put(data: bytes[2])");
        assert!(found == text && shown.contains(what), "{shown}");
    }
    assert!(mistake("f(x: 1e999)", "f(x: float)").1.contains("does not fit"));
    assert_eq!(parse("say(text: \"\\ud83d\\ude00\")", "say(text: string[5])").unwrap().len(), 1);
}

#[test]
fn a_long_text_is_shown_around_its_mistake() {
    let text = format!("say(text: \"{}\", nonsense: 1, more: \"{}\")", "x".repeat(20_000), "y".repeat(20_000));
    let shown = mistake(&text, "say(text: string[20000])").1;
    assert!(shown.len() < 1_000, "{shown}");
    let mut lines = shown.lines().skip(1);
    let (line, carets) = (lines.next().unwrap(), lines.next().unwrap());
    let caret = carets.find('^').unwrap();
    let under: String = line.chars().skip(caret).take(carets.trim().len()).collect();
    assert_eq!(under, "nonsense");
}

fn argument() -> impl Strategy<Value = ArgumentValue> {
    let float = any::<f64>().prop_map(super::print::number);
    prop_oneof![
        prop::collection::vec(any::<i64>(), 0..4).prop_map(ArgumentValue::Int),
        prop::collection::vec(float, 0..4).prop_map(ArgumentValue::Float),
        prop::collection::vec(any::<bool>(), 0..4).prop_map(ArgumentValue::Bool),
        any::<String>().prop_map(ArgumentValue::String),
        "([0-9a-f]{2}){0,9}".prop_map(ArgumentValue::Bytes),
    ]
}

/// A signature that takes the values.
fn signature(values: &[ArgumentValue]) -> String {
    let specs = values.iter().enumerate().map(|(index, value)| {
        let (kind, size) = kind_and_size(value);
        format!("a{index}: {kind}[{size}]")
    });
    format!("f({})", specs.collect::<Vec<_>>().join(", "))
}

fn kind_and_size(value: &ArgumentValue) -> (&'static str, usize) {
    match value {
        ArgumentValue::Int(all) => ("int", all.len()),
        ArgumentValue::Float(all) => ("float", all.len()),
        ArgumentValue::Bool(all) => ("bool", all.len()),
        ArgumentValue::String(text) => ("string", text.len()),
        ArgumentValue::Bytes(digits) => ("bytes", digits.len() / 2),
        ArgumentValue::List(_) | ArgumentValue::Record(_) => unreachable!("lists and records have a test of their own"),
    }
}

proptest! {
    #[test]
    fn what_is_printed_is_read_as_the_same(values in prop::collection::vec(argument(), 0..8)) {
        let name = |index| format!("a{index}");
        let arguments: Vec<_> = values.iter().enumerate().map(|(index, value)| {
            Argument { name: name(index), size: kind_and_size(value).1 as u32, value: value.clone() }
        }).collect();
        let text = show_call("f", &arguments);
        prop_assert_eq!(parse(&text, &signature(&values)), Ok(arguments), "{}", text);
    }

    #[test]
    fn no_text_panics(text in any::<String>()) {
        let _ = parse(&text, ALL).map_err(|mistake| mistake.show(&text, Some(ALL)));
    }

    #[test]
    fn no_text_that_is_almost_a_call_panics(text in r#"(all|f|)\(((i|is|s|y|f|b|ä):? ?(\[|\]|"|\\u?|[0-9a-fx.-]{0,9}|true|[ -ÿ]|,){0,6},?){0,4}\)?"#) {
        if let Err(mistake) = parse(&text, ALL) {
            prop_assert!(text.get(mistake.at.clone()).is_some(), "{mistake:?}");
            prop_assert!(mistake.show(&text, Some(ALL)).contains('^'));
        }
    }
}
