//! Texts that people and programs write: access tables, key files, questions on the control socket, and values in JSON.

use std::fs::File;
use std::io::{Seek as _, Write as _};

use cara_core::distribution::function::Definition;
use cara_core::distribution::parameters::Parameters;
use cara_core::services::access::{Principal, Verb};
use cara_std::access::AccessTable;
use cara_std::control::json;
use cara_std::control::protocol::{Answer, Question};
use cara_std::keys::KeyRing;
use serde_json::Value as Json;
use tempfile::NamedTempFile;

use crate::script::Script;
use crate::unit::identity;

/// Pieces of an access table, of a key file, and of lines on the control socket.
const ACCESS: &[&str] = &[
    "[[allow]]\n",
    "who = ",
    "functions = ",
    "verbs = ",
    "rate = ",
    "\"s_units\"",
    "\"m_units\"",
    "\"operator\"",
    "\"*\"",
    "\"agv/7@s_unit\"",
    "\"agv/7\"",
    "[\"go\", \"stop\"]",
    "\"publish\"",
    "\"call\"",
    "\"list\"",
    "\"take_over\"",
    "\"10/s\"",
    "\"5/min\"",
    "\n",
    "# a comment\n",
    "[",
    "]",
    "\"",
    "=",
    ",",
    "'''",
    "\\u0041",
    "{",
    "}",
];
const KEYS: &[&str] = &[
    "cara-ring 1\n",
    "cara-ring 2\n",
    "fleet 7\n",
    "node s_unit 7 agv\n",
    "node m_unit 1 depot\n",
    "generation 1\n",
    "generation 2\n",
    "discovery 000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f\n",
    "pair 000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f m_unit 1 depot\n",
    "pair 000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f s_unit 8 agv-2\n",
    "sum 00000000\n",
    "# for people\n",
    "\n",
    " ",
    "0",
    "ff",
];
const QUESTIONS: &[&str] = &[
    "{\"ask\":",
    "\"call\"",
    "\"hold\"",
    "\"stop\"",
    "\"nodes\"",
    "\"set\"",
    "\"ping\"",
    "\"as\"",
    ",\"function\":\"go\"",
    ",\"node\":\"agv\"",
    ",\"arguments\":[",
    "{\"name\":\"x\",\"size\":1,\"value\":",
    "{\"type\":\"int\",\"value\":",
    "{\"type\":\"float\",\"value\":",
    "{\"type\":\"list\",\"value\":",
    "[",
    "]",
    "{",
    "}",
    ",",
    "1",
    "-1",
    "1.5",
    "1e400",
    "\"NaN\"",
    "null",
    "true",
    ",\"timeout_ms\":",
    ",\"constraint\":\"message_size\"",
    ",\"value\":",
    ",\"count\":",
    ",\"pause_us\":",
    "\"a\":",
    "\"role\":\"stop\"",
    "\"\\ud800\"",
];
/// What values in JSON are read as.
const VARIABLES: [&str; 5] =
    ["f(x: int)", "f(x: float[2])", "f(x: bytes[4])", "f(x: {a: int, s: string[3]}[..2])", "f(x: bool[3])"];

pub(crate) fn run(data: &[u8]) {
    let mut script = Script::new(data);
    match script.below(4) {
        0 => access(&text(script, ACCESS)),
        1 => keys(&text(script, KEYS)),
        2 => question(&text(script, QUESTIONS)),
        _ => {
            let variable = VARIABLES[usize::from(script.below(VARIABLES.len() as u8))];
            values(variable, &text(script, QUESTIONS));
        }
    }
}

/// Pieces where they are meant, and other characters as they are.
fn text(mut script: Script<'_>, pieces: &[&str]) -> String {
    let mut text = String::new();
    while !script.is_over() {
        let byte = script.byte();
        match pieces.get(usize::from(byte.wrapping_sub(128))) {
            Some(piece) => text.push_str(piece),
            None => text.push(char::from(byte)),
        }
    }
    text
}

fn access(text: &str) {
    match AccessTable::parse("access.toml", text) {
        Ok(table) => {
            for verb in [Verb::Call, Verb::List, Verb::Publish, Verb::TakeOver] {
                let decided = table.decide(Principal::Node(&identity(0)), "go", verb);
                assert!(!table.rules().is_empty() || !decided.is_allowed(), "an empty table allows something");
                let _ = table.decide(Principal::Operator, "stop", verb);
            }
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

thread_local! {
    /// Key files are read from files that no other user can read.
    static FILE: NamedTempFile = NamedTempFile::new().expect("there is room");
}

fn keys(text: &str) {
    FILE.with(|named| {
        let mut file: &File = named.as_file();
        file.set_len(0).and_then(|()| file.rewind()).expect("it is ours");
        file.write_all(text.as_bytes()).expect("there is room");
        match KeyRing::load(named.path()) {
            Ok(ring) => assert!(!format!("{ring:?}").contains("0001020304"), "a key is shown"),
            Err(error) => assert!(!error.to_string().contains("0001020304"), "a key is shown"),
        }
    });
}

fn question(text: &str) {
    if let Ok(question) = serde_json::from_str::<Question>(text) {
        let again = serde_json::to_string(&question).expect("it is JSON");
        let read = serde_json::from_str::<Question>(&again).expect("what is written can be read");
        assert_eq!(serde_json::to_string(&read).expect("it is JSON"), again);
    }
    let _ = serde_json::from_str::<Answer>(text);
}

fn values(variable: &str, text: &str) {
    let Ok(value) = serde_json::from_str::<Json>(text) else { return };
    let definition = Definition::parse(variable).expect("it is a signature");
    let spec = definition.signature().arguments().next().expect("it has one");
    let mut parameters = Parameters::<512>::sized();
    parameters.add_spec(spec).expect("it fits");
    let is_valid = json::check(spec, &value).is_ok();
    let set = json::set(&mut parameters, spec, &value);
    assert_eq!(set.is_ok(), is_valid);
    if set == Ok(Ok(())) {
        let shown = json::to_json(&parameters.value("x").expect("it is there"));
        assert!(json::check(spec, &shown).is_ok(), "what is shown cannot be set: {shown}");
        let mut again = Parameters::<512>::sized();
        again.add_spec(spec).expect("it fits");
        json::set(&mut again, spec, &shown).expect("it checks").expect("it fits");
        assert_eq!(json::to_json(&again.value("x").expect("it is there")), shown);
    }
}
