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
    [signatures(), attributes(), blocks()].concat()
}

pub(crate) const GO_TO: &str = "go_to(position: int[2], speed: float) -> (position: int[2], arrived: bool)";
const REPORT: &str = "report(text: string[40], data: bytes[5], flags: bool[3], level: float[2])";
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
    let json = |priority: &str, idempotent: bool, lease: Option<u32>, actuator: u8, stop: bool, reset: bool| {
        json!({
            "priority": priority, "idempotent": idempotent, "lease": lease,
            "actuator": actuator, "stop": stop, "reset": reset, "stream": null,
        })
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
            &json("normal", false, None, 0, false, false),
        ),
        Vector::new(
            ("attributes_leased", "high priority, idempotent, a lease of half a second"),
            Kind::Attributes,
            Context::default(),
            &leased.encode(),
            &json("high", true, Some(500), 0, false, false),
        ),
        made(("attributes_actuator", "it moves actuator 3"), &drive, &json("high", false, Some(500), 3, false, false)),
        made(("attributes_stop", "it stops all"), &stop, &json("emergency", true, None, 0, true, false)),
        made(("attributes_reset", "it resets actuator 3"), &reset, &json("normal", false, None, 3, false, true)),
        made(
            ("attributes_stream", "a stream, whose values come at least 20 ms apart"),
            &Attributes { priority: Priority::Low, stream: Some(20), ..Attributes::default() },
            &json!({
                "priority": "low", "idempotent": false, "lease": null, "actuator": 0, "stop": false, "reset": false,
                "stream": 20,
            }),
        ),
        Vector::new(
            ("attributes_of_a_later_version", "other bits, and what follows, are passed over"),
            Kind::Attributes,
            Context::default(),
            &[0xC0 | 5, 0, 9, 9, 0xF4, 1, 0, 0, 7, 7],
            &json("high", true, Some(500), 0, false, false),
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
