//! Texts that people and programs write: access tables, key files, files of claims, lists of a fleet's members, lines of the control
//! socket, and values in JSON.

use std::fs::File;
use std::io::{Seek as _, Write as _};

use cara_core::distribution::function::Definition;
use cara_core::distribution::parameters::Parameters;
use cara_core::services::access::{Principal, Verb};
use cara_std::access::AccessTable;
use cara_std::control::json;
use cara_std::control::protocol::{Answer, Question};
use cara_std::keys::{self, KeyError, KeyRing};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value as Json;
use tempfile::NamedTempFile;

use crate::script::{Script, text};
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
/// Pieces of a file of claims, and of a list of members.
const KEPT: &[&str] = &[
    "cara-claims 2\n",
    "cara-claims 1\n",
    "own 3 4\n",
    "own 18446744073709551615 ",
    "obeyed 3 4 ",
    "000102030405060708090a0b0c0d0e0f ",
    "010203040506 ",
    "home ",
    "present ",
    "#!",
    "cara-fleet 2\n",
    "cara-fleet 1\n",
    "fleet 7\n",
    "generations 1 2\n",
    "generations 1\n",
    "node 1 ",
    "manager ",
    "revoked 2 ",
    "m_unit 1 depot\n",
    "s_unit 17 agv\n",
    "m_unit 1 ",
    "sum 00000000\n",
    "# for people\n",
    "\n",
    " ",
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
    "{\"answer\":",
    "\"called\",\"node\":\"agv\",\"id\":7,\"results\":[",
    "],\"took_us\":1",
    "\"failed\"",
    "\"done\"",
    "\"event\",\"at_ms\":1,\"event\":\"joined\",\"text\":\"\"",
    "\"command\",\"unix_ms\":1,\"by\":",
    "\"value\",\"node\":\"agv/7\",\"stream\":\"s()\",\"unix_ms\":1,\"values\":[",
    "\"function\",\"name\":\"go\",\"signature\":\"go()\",\"priority\":\"high\",\"lease_us\":1000000",
    ",\"stop\":true",
    ",\"error\":",
    "{\"cause\":\"peer\",\"error\":\"Busy\",\"text\":\"\"",
    "\"node\",\"name\":\"agv\",\"id\":7,\"role\":\"s_unit\",\"connected\":true,\"functions\":1",
];
/// What values in JSON are read as.
const VARIABLES: [&str; 5] =
    ["f(x: int)", "f(x: float[2])", "f(x: bytes[4])", "f(x: {a: int, s: string[3]}[..2])", "f(x: bool[3])"];

pub(crate) fn run(data: &[u8]) {
    let mut script = Script::new(data);
    match script.below(6) {
        0 => access(&text(script, ACCESS)),
        1 => ring(&text(script, KEYS)),
        2 => again(&text(script, KEPT), keys::claims_again),
        3 => again(&text(script, KEPT), keys::members_again),
        4 => line(&text(script, QUESTIONS)),
        _ => {
            let variable = VARIABLES[usize::from(script.below(VARIABLES.len() as u8))];
            values(variable, &text(script, QUESTIONS));
        }
    }
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

fn ring(text: &str) {
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

/// What is read of a file is written as a file that reads the same.
fn again(text: &str, read: fn(&str) -> Result<[String; 2], KeyError>) {
    match read(text) {
        Ok([said, written]) => match read(&written) {
            Ok(again) => assert_eq!(again, [said, written], "{text}"),
            Err(error) => panic!("what is written cannot be read: {error}: {written}"),
        },
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

/// A line of the control socket.
fn line(text: &str) {
    line_of::<Question>(text);
    line_of::<Answer>(text);
}

fn line_of<T: Serialize + DeserializeOwned>(text: &str) {
    if let Ok(read) = serde_json::from_str::<T>(text) {
        let line = serde_json::to_string(&read).expect("it is JSON");
        assert!(!line.contains('\n'), "it is more than a line");
        let again = serde_json::from_str::<T>(&line).unwrap_or_else(|error| panic!("{line}: {error}"));
        assert_eq!(serde_json::to_string(&again).expect("it is JSON"), line);
    }
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
