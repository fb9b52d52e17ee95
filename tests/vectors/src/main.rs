//! Golden vectors of the wire format.
//!
//! `cargo run -p cara-vectors` compares the committed `tests/vectors/vectors.json` with what the core makes now, as the
//! test of this crate does; with `-- --write` it writes the file. `tests/vectors/decode.py`, written from
//! `docs/wire.md`, reads the same file.

mod answers;
#[cfg(test)]
mod corpora;
mod decoded;
mod introductions;
mod membership;
mod messages;
mod side;
mod stream;
mod streams;
mod talk;
mod values;
mod vector;

use std::path::PathBuf;

use anyhow::{Context as _, Result, bail};
use serde::Serialize;
use serde_json::Value;

use crate::answers::Answer;
use crate::vector::Vector;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>().as_slice() {
        [] => check(),
        ["--write"] => write(),
        _ => bail!("usage: cara-vectors [--write]"),
    }
}

fn file() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("vectors.json")
}

/// All that the committed file holds.
#[derive(Serialize)]
struct Document {
    version: u8,
    vectors: Vec<Vector>,
    answers: Vec<Answer>,
}

impl Document {
    fn new() -> Self {
        let vectors = [values::all(), introductions::all(), messages::all(), streams::all(), talk::all()].concat();
        Self { version: cara_core::config::VERSIONS.last, vectors, answers: answers::all() }
    }
}

fn write() -> Result<()> {
    let mut text = serde_json::to_string_pretty(&Document::new())?;
    text.push('\n');
    std::fs::write(file(), text).with_context(|| format!("cannot write {}", file().display()))
}

/// Fails with the first difference between the committed file and what the core makes now.
fn check() -> Result<()> {
    let text = std::fs::read_to_string(file()).with_context(|| format!("cannot read {}", file().display()))?;
    let committed: Value = serde_json::from_str(&text)?;
    let current = serde_json::to_value(Document::new())?;
    match difference(&committed, &current, "") {
        None => Ok(()),
        Some(place) => bail!("the wire format differs from the committed vectors at {place}"),
    }
}

/// Where two values differ first.
fn difference(committed: &Value, current: &Value, place: &str) -> Option<String> {
    match (committed, current) {
        (Value::Object(a), Value::Object(b)) if a.len() == b.len() => a
            .iter()
            .find_map(|(key, value)| difference(value, b.get(key).unwrap_or(&Value::Null), &format!("{place}/{key}"))),
        (Value::Array(a), Value::Array(b)) if a.len() == b.len() => a.iter().zip(b).find_map(|(a, b)| {
            let name = b.get("name").and_then(Value::as_str).unwrap_or("*");
            difference(a, b, &format!("{place}/{name}"))
        }),
        (a, b) if a == b => None,
        (a, b) => Some(format!("{place}: {a} is committed, {b} is made")),
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_committed_vectors_are_what_the_core_makes() {
        super::check().unwrap();
    }
}
