//! Vectors of signatures, attributes and blocks of parameters. The values are written twice on purpose: once for the
//! encoder, once as what a reader must find.

use cara_core::config::Priority;
use cara_core::distribution::block::{self, SliceWriter};
use cara_core::distribution::function::Attributes;
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::Error;
use cara_core::time::Duration;
use serde_json::{Value, json};

use crate::vector::{Context, Kind, Vector, definition};

/// Every vector of this file.
pub(crate) fn all() -> Vec<Vector> {
    [signatures(), nested_signatures(), attributes(), blocks(), nested_blocks()].concat()
}

pub(crate) const GO_TO: &str = "go_to(position: int[2], speed: float) -> (position: int[2], arrived: bool)";
const REPORT: &str = "report(text: string[40], data: bytes[5], flags: bool[3], level: float[2])";
const ORDER: &str = "order(nodes: {id: string[8], x: float}[..4], path: int[..3][..2])";
const MOVE: &str = "move() progress (left: float) fails (at: int[2])";
const HI: &str = "hi(name: string[8])";

fn signatures() -> Vec<Vector> {
    let plain = definition("stop()");
    let both = definition(GO_TO);
    let every = definition(REPORT);
    vec![
        Vector::new(
            ("signature_stop", "a function without arguments and results"),
            Kind::Signature,
            Context::default(),
            plain.as_bytes(),
            &json!({ "name": "stop", "arguments": [], "results": [], "text": "stop()" }),
        ),
        Vector::new(
            ("signature_go_to", "arguments and results, one variable in both"),
            Kind::Signature,
            Context::default(),
            both.as_bytes(),
            &json!({
                "name": "go_to",
                "arguments": [
                    { "name": "position", "type": "int", "size": 2 }, { "name": "speed", "type": "float", "size": 1 },
                ],
                "results": [
                    { "name": "position", "type": "int", "size": 2 }, { "name": "arrived", "type": "bool", "size": 1 },
                ],
                "text": GO_TO,
            }),
        ),
        Vector::new(
            ("signature_move", "what a call tells while it runs, and the values of its failures"),
            Kind::Signature,
            Context::default(),
            definition(MOVE).as_bytes(),
            &json!({
                "name": "move", "arguments": [], "results": [],
                "progress": [{ "name": "left", "type": "float", "size": 1 }],
                "failure": [{ "name": "at", "type": "int", "size": 2 }],
                "text": MOVE,
            }),
        ),
        Vector::new(
            ("signature_lift", "a line of help, and the units of variables"),
            Kind::Signature,
            Context::default(),
            definition("lift(height: float)")
                .help("Lifts the fork.")
                .and_then(|lift| lift.unit("height", "m"))
                .expect("it fits")
                .as_bytes(),
            &json!({
                "name": "lift",
                "arguments": [{ "name": "height", "type": "float", "size": 1 }],
                "results": [],
                "help": "Lifts the fork.",
                "units": [["height", "m"]],
                "text": "lift(height: float)",
            }),
        ),
        Vector::new(
            ("signature_empty_section", "refused: a section without variables"),
            Kind::Signature,
            Context::default(),
            &[definition("stop()").as_bytes(), &[1, 0]].concat(),
            &Value::Null,
        ),
        Vector::new(
            ("signature_report", "the other types"),
            Kind::Signature,
            Context::default(),
            every.as_bytes(),
            &json!({
                "name": "report",
                "arguments": [
                    { "name": "text", "type": "string", "size": 40 }, { "name": "data", "type": "bytes", "size": 5 },
                    { "name": "flags", "type": "bool", "size": 3 }, { "name": "level", "type": "float", "size": 2 },
                ],
                "results": [],
                "text": REPORT,
            }),
        ),
        Vector::new(
            ("signature_name_taken", "refused: two arguments of one name"),
            Kind::Signature,
            Context::default(),
            &[1, b'f', 2, 0, 1, 1, 0, 0, 0, b'a', 0, 1, 1, 0, 0, 0, b'a', 0],
            &Value::Null,
        ),
        Vector::new(
            ("signature_other_result", "refused: a result has the name of an argument and another size"),
            Kind::Signature,
            Context::default(),
            &[1, b'f', 1, 0, 1, 1, 0, 0, 0, b'a', 1, 0, 1, 2, 0, 0, 0, b'a'],
            &Value::Null,
        ),
    ]
}

fn nested_signatures() -> Vec<Vector> {
    let order = json!({
        "name": "order",
        "arguments": [
            { "name": "nodes", "type": "list", "size": 4, "element": { "type": "record", "size": 2, "fields": [
                { "name": "id", "type": "string", "size": 8 }, { "name": "x", "type": "float", "size": 1 },
            ] } },
            { "name": "path", "type": "list", "size": 2, "element": { "type": "list", "size": 3, "element": {
                "type": "int", "size": 1,
            } } },
        ],
        "results": [],
        "text": ORDER,
    });
    let optional = json!({
        "name": "f",
        "arguments": [{ "name": "a", "type": "list", "size": 1, "element": { "type": "int", "size": 1 } }],
        "results": [],
        "text": "f(a: int?)",
    });
    let made =
        |names, bytes: &[u8], value: &Value| Vector::new(names, Kind::Signature, Context::default(), bytes, value);
    let list_of = |inner: &[u8]| [&[1, b'f', 1, 5, 1, 8, 0, 0, 0, b'a'][..], inner, &[0]].concat();
    let lists = |depth| [&[5, 8, 0, 0, 0].repeat(depth)[..], &[0, 1, 0, 0, 0]].concat();
    let mut deepest = json!({ "type": "int", "size": 1 });
    for _ in 0..8 {
        deepest = json!({ "type": "list", "size": 8, "element": deepest });
    }
    deepest["name"] = "a".into();
    let deepest = json!({
        "name": "f", "arguments": [deepest], "results": [], "text": "f(a: int[..8][..8][..8][..8][..8][..8][..8][..8])",
    });
    vec![
        made(("signature_order", "a list of records, and a list of lists"), definition(ORDER).as_bytes(), &order),
        made(
            ("signature_optional", "a value that may be absent"),
            &[1, b'f', 1, 5, 1, 1, 0, 0, 0, b'a', 0, 1, 0, 0, 0, 0],
            &optional,
        ),
        made(("signature_deepest", "eight lists in each other"), &list_of(&lists(7)), &deepest),
        made(("signature_too_deep", "refused: nine lists in each other"), &list_of(&lists(8)), &Value::Null),
        made(("signature_no_element", "refused: a list of nothing"), &list_of(&[]), &Value::Null),
        made(("signature_empty_element", "refused: elements take no bytes"), &list_of(&[0, 0, 0, 0, 0]), &Value::Null),
        made(("signature_empty_record", "refused: a record without fields"), &list_of(&[6, 0, 0, 0, 0]), &Value::Null),
        made(
            ("signature_field_taken", "refused: two fields of one name"),
            &list_of(&[6, 2, 0, 0, 0, 0, 1, 1, 0, 0, 0, b'b', 1, 1, 1, 0, 0, 0, b'b']),
            &Value::Null,
        ),
        made(
            ("signature_field_missing", "refused: a record with fewer fields than it says"),
            &list_of(&[6, 2, 0, 0, 0, 0, 1, 1, 0, 0, 0, b'b']),
            &Value::Null,
        ),
    ]
}

fn attributes() -> Vec<Vector> {
    let leased = Attributes {
        priority: Priority::High,
        lease: Some(Duration::from_millis(500)),
        idempotent: true,
        ..Attributes::default()
    };
    let drive = Attributes { actuator: 3, idempotent: false, ..leased };
    let stop = Attributes { priority: Priority::Emergency, idempotent: true, stop: true, ..Attributes::default() };
    let reset = Attributes { reset: true, actuator: 3, ..Attributes::default() };
    // The bits that mean nothing yet.
    let later = Attributes::FLAGS.iter().fold(0b1101_1100, |bits, flag| {
        let mut attributes = Attributes { priority: Priority::Emergency, ..Attributes::NORMAL };
        flag.set(&mut attributes, true);
        bits & !attributes.encode()[0]
    });
    let json = |priority: &str, flags: &[&str], lease: Option<u32>, actuator: u8, stream: Option<u16>| {
        let mut shown = json!({ "priority": priority, "lease": lease, "actuator": actuator, "stream": stream });
        for flag in Attributes::FLAGS {
            shown[flag.word()] = flags.contains(&flag.word()).into();
        }
        shown
    };
    let made = |names, attributes: &Attributes, value: &Value| {
        Vector::new(names, Kind::Attributes, Context::default(), &attributes.encode(), value)
    };
    vec![
        Vector::new(
            ("attributes_default", "normal priority, no lease"),
            Kind::Attributes,
            Context::default(),
            &Attributes::default().encode(),
            &json("normal", &[], None, 0, None),
        ),
        Vector::new(
            ("attributes_leased", "high priority, idempotent, a lease of half a second"),
            Kind::Attributes,
            Context::default(),
            &leased.encode(),
            &json("high", &["idempotent"], Some(500), 0, None),
        ),
        made(("attributes_actuator", "it moves actuator 3"), &drive, &json("high", &[], Some(500), 3, None)),
        made(("attributes_stop", "it stops all"), &stop, &json("emergency", &["idempotent", "stop"], None, 0, None)),
        made(("attributes_reset", "it resets actuator 3"), &reset, &json("normal", &["reset"], None, 3, None)),
        made(
            ("attributes_stream", "a stream, whose values come at least 20 ms apart"),
            &Attributes { priority: Priority::Low, stream: Some(20), ..Attributes::default() },
            &json("low", &[], None, 0, Some(20)),
        ),
        Vector::new(
            ("attributes_of_a_later_version", "other bits, and what follows, are passed over"),
            Kind::Attributes,
            Context::default(),
            &[leased.encode()[0] | later, 0, 9, 9, 0xF4, 1, 0, 0, 7, 7],
            &json("high", &["idempotent"], Some(500), 0, None),
        )
        .lossy(),
        Vector::new(
            ("attributes_cut", "refused: a byte is missing"),
            Kind::Attributes,
            Context::default(),
            &leased.encode()[..7],
            &Value::Null,
        ),
    ]
}

/// The block of `parameters` as arguments of a function.
pub(crate) fn arguments(text: &str, parameters: &ParametersView) -> Vec<u8> {
    let definition = definition(text);
    let specs = definition.signature().arguments();
    let length = block::measure(specs, parameters).unwrap_or_else(|error| panic!("{text}: {error}"));
    let mut bytes = vec![0; length];
    block::write(specs, parameters, &mut SliceWriter::new(&mut bytes));
    bytes
}

pub(crate) fn motion() -> Result<Parameters, Error> {
    let mut parameters = Parameters::new();
    parameters.add_float("speed", 1)?;
    parameters.set_value("speed", 1.5)?;
    parameters.add_int("position", 2)?;
    parameters.set_value("position", [1, -2])?;
    Ok(parameters)
}

fn report() -> Result<Parameters, Error> {
    let mut parameters = Parameters::new();
    parameters.add_string("text", 40)?;
    parameters.set_value("text", "größer")?;
    parameters.add_bytes("data", 5)?;
    parameters.set_value("data", &[1_u8, 2, 3, 4, 5][..])?;
    parameters.add_bool("flags", 3)?;
    parameters.set_value("flags", [true, false, true])?;
    parameters.add_float("level", 2)?;
    parameters.set_value("level", [0.25, f64::NEG_INFINITY])?;
    Ok(parameters)
}

fn order() -> Result<Parameters, Error> {
    let mut parameters = Parameters::new();
    for argument in definition(ORDER).signature().arguments() {
        parameters.add_spec(argument)?;
    }
    parameters.set_list("nodes", |nodes| {
        for (id, x) in [("dock", 1.5), ("", -2.0)] {
            nodes.push_record(|node| {
                node.set("id", id)?;
                node.set("x", x)
            })?;
        }
        Ok(())
    })?;
    parameters.set_list("path", |path| {
        path.push_list(|part| {
            part.push(1)?;
            part.push(2)
        })?;
        path.push_list(|_| Ok(()))
    })?;
    Ok(parameters)
}

fn nested_blocks() -> Vec<Vector> {
    let order = arguments(ORDER, &order().unwrap_or_default());
    let refused =
        |names, bytes: &[u8]| Vector::new(names, Kind::Block, Context::block(ORDER, "arguments"), bytes, &Value::Null);
    // `nodes` begins at byte 0 and has a body of 40 bytes; `path` begins at 48.
    let with = |at: usize, byte: u8| {
        let mut bytes = order.clone();
        bytes[at] = byte;
        bytes
    };
    vec![
        Vector::new(
            ("block_order", "a list of two records, and a list of two lists, one of them empty"),
            Kind::Block,
            Context::block(ORDER, "arguments"),
            &order,
            &json!({
                "nodes": [{ "id": "dock", "x": ["3ff8000000000000"] }, { "id": "", "x": ["c000000000000000"] }],
                "path": [[[1], [2]], []],
            }),
        ),
        Vector::new(
            ("block_empty_lists", "empty lists take 8 bytes each"),
            Kind::Block,
            Context::block(ORDER, "arguments"),
            &[0; 16],
            &json!({ "nodes": [], "path": [] }),
        ),
        refused(("block_list_more", "refused: the list has fewer elements than it says"), &with(0, 3)),
        refused(("block_list_fewer", "refused: the body has more elements than the list says"), &with(0, 1)),
        refused(
            ("block_list_long", "refused: more elements than the list may have"),
            &[&[5, 0, 0, 0, 16, 0, 0, 0][..], &[0; 16], &[0; 8]].concat(),
        ),
        refused(
            ("block_list_lies", "refused: a count that the body cannot hold"),
            &[&[0xFF, 0xFF, 0xFF, 0xFF, 0, 0, 0, 0][..], &[0; 8]].concat(),
        ),
        refused(("block_list_body_short", "refused: the body is shorter than its elements"), &with(4, 32)),
        refused(("block_list_body_odd", "refused: the body is no multiple of 8"), &with(4, 39)),
        refused(("block_list_body_long", "refused: the body ends behind the block"), &with(4, 200)),
        refused(("block_inner_text", "refused: a text in a list is no UTF-8"), &with(16, 0xFF)),
        refused(("block_inner_padding", "refused: the padding in a list is not zero"), &with(21, 1)),
        refused(("block_inner_list", "refused: an inner list has more elements than it may"), &with(56, 4)),
    ]
}

fn blocks() -> Vec<Vector> {
    let motion = motion().unwrap_or_default();
    let report = report().unwrap_or_default();
    let refused = |names, text, bytes: &[u8]| {
        Vector::new(names, Kind::Block, Context::block(text, "arguments"), bytes, &Value::Null)
    };
    let hi = |length: u8, text: &[u8; 8]| [&[length, 0, 0, 0, 0, 0, 0, 0], &text[..]].concat();
    vec![
        Vector::new(
            ("block_go_to", "two integers and a float, in the signature's order"),
            Kind::Block,
            Context::block(GO_TO, "arguments"),
            &arguments(GO_TO, &motion),
            &json!({ "position": [1, -2], "speed": ["3ff8000000000000"] }),
        ),
        Vector::new(
            ("block_go_to_results", "two integers and a truth value"),
            Kind::Block,
            Context::block(GO_TO, "results"),
            &[3, 0, 0, 0, 0, 0, 0, 0, 4, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0],
            &json!({ "position": [3, 4], "arrived": [true] }),
        ),
        Vector::new(
            ("block_report", "text and bytes with their lengths, truth values, two floats"),
            Kind::Block,
            Context::block(REPORT, "arguments"),
            &arguments(REPORT, &report),
            &json!({
                "text": "größer", "data": "0102030405", "flags": [true, false, true],
                "level": ["3fd0000000000000", "fff0000000000000"],
            }),
        ),
        Vector::new(
            ("block_empty_text", "a text of no bytes has no padding"),
            Kind::Block,
            Context::block(HI, "arguments"),
            &[0; 8],
            &json!({ "name": "" }),
        ),
        Vector::new(
            ("block_nothing", "no variables, no bytes"),
            Kind::Block,
            Context::block("stop()", "arguments"),
            &[],
            &json!({}),
        ),
        refused(("block_bad_text", "refused: the text is no UTF-8"), HI, &hi(2, b"\xC3\x28\0\0\0\0\0\0")),
        refused(("block_padding", "refused: the padding is not zero"), HI, &hi(2, b"ab\0\0\0\0\0\x01")),
        refused(("block_long_text", "refused: longer than declared"), HI, &hi(9, b"abcdefgh")),
        refused(("block_cut", "refused: a byte is missing"), HI, &hi(2, b"ab\0\0\0\0\0\0")[..15]),
        refused(("block_behind", "refused: bytes follow"), "stop()", &[0; 8]),
    ]
}
