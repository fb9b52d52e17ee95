//! Formats: signatures in text and bytes, blocks of values, hellos, datagrams and messages. What is read can be written, and then
//! reads the same.

use cara_core::config::Mode;
use cara_core::distribution::block::{self, SliceWriter};
use cara_core::distribution::datagram::Datagram;
use cara_core::distribution::function::{Attributes, Definition, Signature, VariableSpecs};
use cara_core::distribution::hello::Hello;
use cara_core::distribution::items::Items;
use cara_core::distribution::message::{Control, FailureDetails, Message, SessionBody};
use cara_core::distribution::parameters::Parameters;
use cara_core::host::frame::Frame;
use cara_core::host::secure::Plain;

use crate::saw;
use crate::script::Script;
use crate::unit::FLEET;

/// Signatures whose blocks are read.
const SIGNATURES: [&str; 7] = [
    "f(x: int[3], b: bool)",
    "f(s: string[7], b: bytes[5], f: float)",
    "f(l: int[..4])",
    "f(r: {a: int, s: string[3]})",
    "f(l: {a: int, l: float[..2]}[..3], b: bool[9])",
    "f(l: {a: {b: {c: int[..2]}[..2]}[..2], d: bool[..1]}[..2], e: int[..1][..2][..1][..2][..1][..2][..1][..2])",
    "f()",
];

pub(crate) fn run(data: &[u8]) {
    let mut script = Script::new(data);
    match script.below(8) {
        0 => text(script.rest()),
        1 => drop(signature(script.rest())),
        2 | 3 => {
            let signature = SIGNATURES[usize::from(script.below(SIGNATURES.len() as u8))];
            if let Ok(definition) = Definition::parse(signature) {
                saw("block", signature, script.rest());
                values(definition.signature().arguments(), script.rest());
            }
        }
        4 => {
            let bytes = script.bytes();
            if let Some(definition) = signature(bytes) {
                values(definition.signature().arguments(), script.rest());
            }
        }
        5 => hello(if script.flag() { Mode::Plain } else { Mode::Secured }, script.rest()),
        6 => datagram(script.rest()),
        _ => message(script.rest()),
    }
}

/// A signature as text: what is shown of it is the same signature.
fn text(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    for parse in [Definition::parse, Definition::stream] {
        if let Ok(definition) = parse(text) {
            let decoded = Signature::decode(definition.as_bytes()).expect("what is parsed is valid");
            assert_eq!(decoded.as_bytes(), definition.as_bytes());
        }
    }
    if let Ok(definition) = Definition::parse(text) {
        let shown = definition.to_string();
        let again = Definition::parse(&shown).unwrap_or_else(|error| panic!("{shown}: {error:?}"));
        assert_eq!(again.to_string(), shown);
    }
}

/// A signature in bytes.
fn signature(bytes: &[u8]) -> Option<Definition> {
    saw("signature", "", bytes);
    let signature = Signature::decode(bytes).ok()?;
    let definition = signature.to_definition();
    assert_eq!(definition.as_bytes(), signature.as_bytes());
    let again = Signature::decode(signature.as_bytes()).expect("it was valid");
    assert_eq!(again.as_bytes(), signature.as_bytes());
    let _ = (signature.to_string(), signature.parameters_bytes());
    Some(definition)
}

/// A block of these variables: what checks is read, and what is read can be written and read again.
fn values(specs: VariableSpecs<'_>, bytes: &[u8]) {
    let mut parameters = Box::new(Parameters::<8_192>::sized());
    let is_valid = block::check(specs, bytes).is_ok();
    let is_read = block::read_arguments(specs, bytes, &mut parameters).is_ok();
    assert!(is_valid || !is_read, "what does not check is read");
    if !is_read {
        return;
    }
    let written = write(specs, &parameters);
    let mut again = Box::new(Parameters::<8_192>::sized());
    block::read_arguments(specs, &written, &mut again).expect("what is written can be read");
    assert_eq!(write(specs, &again), written);
    assert_eq!(written.len(), bytes.len(), "the block has another length");
}

fn write(specs: VariableSpecs<'_>, parameters: &Parameters<8_192>) -> Vec<u8> {
    let length = block::measure(specs, parameters).expect("they are its variables");
    let mut bytes = vec![0; length];
    block::write(specs, parameters, &mut SliceWriter::new(&mut bytes));
    bytes
}

fn hello(mode: Mode, bytes: &[u8]) {
    // The first bytes would hardly be found.
    let bytes = &[&mode.magic()[..], &[2, 2, 1, 0], bytes].concat();
    saw("hello", "", bytes);
    let Ok(hello) = Hello::decode(bytes, mode) else { return };
    let mut out = [0; 600];
    let length = hello.encode(mode, &mut out).expect("it is short");
    assert_eq!(Hello::decode(&out[..length], mode), Ok(Hello { skipped: 0, ..hello }));
}

fn datagram(bytes: &[u8]) {
    let Some((&kind, rest)) = bytes.split_first() else { return };
    let head = [&Mode::Plain.magic()[..], &[2, 1 + kind % 3, 2, 0], &FLEET.0.to_le_bytes()].concat();
    let bytes = [&head[..], rest].concat();
    saw("datagram", "", &bytes);
    let mut out = [0; 1_000];
    match Datagram::decode(&bytes, FLEET, &Plain) {
        Ok(Datagram::WhoHas(mut search)) => {
            let again = search.encode(FLEET, &Plain, &mut out).expect("it fits");
            search.skipped = 0;
            assert_eq!(Datagram::decode(again, FLEET, &Plain), Ok(Datagram::WhoHas(search)));
        }
        Ok(Datagram::Announce(mut answer)) => {
            let again = answer.encode(FLEET, &Plain, None, &mut out).expect("it fits");
            answer.skipped = 0;
            assert_eq!(Datagram::decode(again, FLEET, &Plain), Ok(Datagram::Announce(answer)));
        }
        Ok(Datagram::Session { .. }) | Err(_) => {}
    }
}

fn message(bytes: &[u8]) {
    ["message", "session_body", "attributes"].into_iter().for_each(|kind| saw(kind, "", bytes));
    let _ = (Frame::parse(bytes), SessionBody::decode(bytes), FailureDetails::of(bytes));
    if let Ok(attributes) = Attributes::decode(bytes) {
        assert_eq!(Attributes::decode(&attributes.encode()), Ok(attributes));
    }
    if let Some(Message::Control(items)) = Message::decode(bytes) {
        for item in Items::new(items).flatten() {
            if let Ok(Some(control)) = Control::take(&item) {
                let mut out = vec![0; 4_096];
                let encoded = control.encode(&mut out).expect("it fits");
                let again = Items::new(&encoded[4..]).flatten().next().expect("there is one");
                assert_eq!(Control::take(&again), Ok(Some(control)));
            }
        }
    }
}
