//! The decoder in Python reads what fuzzing has found as the core does: it accepts and refuses the same bytes.

use std::collections::BTreeSet;
use std::fs;
use std::io::{ErrorKind, Write as _};
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;

use cara_fuzz::Wire;
use serde_json::json;

use crate::decoded;
use crate::vector::{Context, Kind};

/// What each input of the committed corpora gives to decoders.
fn seen() -> BTreeSet<Wire> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../fuzz/corpus");
    let inputs = cara_fuzz::TARGETS.iter().flat_map(|target| {
        let file = fs::read(folder.join(target.name).with_extension("inputs")).unwrap();
        cara_fuzz::inputs(&file).flat_map(|input| cara_fuzz::wire(target, input)).collect::<Vec<_>>()
    });
    inputs.collect()
}

/// As a vector without a name.
fn line(Wire { kind, function, bytes }: &Wire) -> String {
    let (of, context) = match *kind {
        "hello" => (Kind::Hello, Context::default()),
        "message" => (Kind::Message, Context::default()),
        "signature" => (Kind::Signature, Context::default()),
        "attributes" => (Kind::Attributes, Context::default()),
        "session_body" => (Kind::SessionBody, Context::default()),
        "block" => (Kind::Block, Context::block(function, "arguments")),
        "datagram" => (Kind::Datagram, Context::fleet(7)),
        "stream" => (Kind::Stream, Context::limits(4_096, 32_800)),
        other => panic!("{other} is no kind"),
    };
    let value = decoded::decode(of, &context, bytes);
    json!({ "kind": kind, "context": context, "hex": decoded::hex(bytes), "value": value }).to_string() + "\n"
}

#[test]
fn python_accepts_and_refuses_what_the_core_does() {
    let seen = seen();
    let kinds: BTreeSet<_> = seen.iter().map(|wire| wire.kind).collect();
    assert_eq!(kinds.len(), 8, "{kinds:?}");
    let lines: String = seen.iter().map(line).collect();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/decode.py");
    let python = Command::new("python3").args([script, "--lines"]).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn();
    let mut python = match python {
        Err(error) if error.kind() == ErrorKind::NotFound => return cara_processes::skip("python3 is not installed"),
        python => python.unwrap(),
    };
    let mut input = python.stdin.take().unwrap();
    // It may end early, and says why.
    let writer = thread::spawn(move || drop(input.write_all(lines.as_bytes())));
    let output = python.wait_with_output().unwrap();
    writer.join().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}");
    print!("{said}");
}
