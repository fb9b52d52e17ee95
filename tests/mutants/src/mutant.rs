//! Mutants as cargo-mutants lists them, and what has become of each.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result};
use serde_json::Value;

/// What a mutant changes.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Genre {
    Value,
    Binary,
    Unary,
    Arm,
    Guard,
    Other,
}

/// What has become of a mutant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum State {
    Wanted,
    Killed,
    Survived,
    /// It survives, and the file of equivalent ones says why it may.
    Equivalent,
    /// It does not compile.
    Unviable,
    /// It cannot be chosen while the program runs: it is in a constant, in a condition with `let` or in a literal of a struct.
    Untried,
}

impl State {
    pub(crate) const ALL: [Self; 5] = [Self::Killed, Self::Survived, Self::Equivalent, Self::Unviable, Self::Untried];

    pub(crate) fn name(self) -> String {
        format!("{self:?}").to_lowercase()
    }
}

pub(crate) struct Mutant {
    pub(crate) file: String,
    /// Without lines, which move: `FILE: WHAT (n)`, the n-th of those that read the same.
    pub(crate) name: String,
    pub(crate) line: usize,
    pub(crate) genre: Genre,
    pub(crate) replacement: String,
    /// Line and column, from 1.
    pub(crate) start: (usize, usize),
    pub(crate) end: (usize, usize),
    pub(crate) state: State,
}

/// Reads the list of `cargo mutants --list --json`.
pub(crate) fn list(file: &Path) -> Result<Vec<Mutant>> {
    let list: Vec<Value> = serde_json::from_slice(&std::fs::read(file)?)?;
    let mut seen = BTreeMap::<String, u32>::new();
    let mut mutant = |value: &Value| {
        let text = |value: &Value| value.as_str().map(str::to_owned);
        let place = |place: &Value| Some((place["line"].as_u64()? as usize, place["column"].as_u64()? as usize));
        let (file, name) = (text(&value["file"])?, text(&value["name"])?);
        let what = name.splitn(4, ':').last()?.trim().to_owned();
        let times = seen.entry(format!("{file}: {what}")).or_default();
        *times += 1;
        let start = place(&value["span"]["start"])?;
        Some(Mutant {
            name: if *times == 1 { format!("{file}: {what}") } else { format!("{file}: {what} ({times})") },
            line: start.0,
            genre: match value["genre"].as_str()? {
                "FnValue" => Genre::Value,
                "BinaryOperator" => Genre::Binary,
                "UnaryOperator" => Genre::Unary,
                "MatchArm" => Genre::Arm,
                "MatchArmGuard" => Genre::Guard,
                _ => Genre::Other,
            },
            replacement: text(&value["replacement"])?,
            start,
            end: place(&value["span"]["end"])?,
            state: State::Wanted,
            file,
        })
    };
    list.iter().map(|value| mutant(value).with_context(|| format!("no mutant: {value}"))).collect()
}
