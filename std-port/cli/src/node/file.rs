//! A configuration file as it is written: every table and key that there is, each value with its place. What the values
//! mean together is checked by [`settings`](super::settings).

use std::collections::BTreeMap;
use std::ops::Range;

use cara_std::Attributes;
use serde::Deserialize;
use toml::Spanned;

use super::mistake::{Mistake, Source};
use super::values::{Size, Time};
use cara_tools::close_names::close;

/// A value that may be absent, with its place.
pub(super) type Maybe<T> = Option<Spanned<T>>;

/// The whole file.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct File {
    pub(super) name: Maybe<String>,
    pub(super) id: Maybe<u32>,
    pub(super) role: Maybe<Role>,
    pub(super) fleet: Option<u32>,
    pub(super) interfaces: Option<Interfaces>,
    pub(super) keys: Option<String>,
    pub(super) insecure: Maybe<bool>,
    pub(super) discovery_port: Maybe<u16>,
    pub(super) tcp_port: Maybe<u16>,
    pub(super) spin: Maybe<Time>,
    pub(super) clock: Option<bool>,
    pub(super) manager: Maybe<Manager>,
    pub(super) m_units: Maybe<Vec<Spanned<String>>>,
    pub(super) access: Maybe<String>,
    #[serde(default)]
    pub(super) constraints: Constraints,
    #[serde(default)]
    pub(super) capacities: Capacities,
    #[serde(default)]
    pub(super) control: Control,
    #[serde(default)]
    pub(super) metrics: Metrics,
    #[serde(default)]
    pub(super) log: Log,
    #[serde(default)]
    pub(super) black_box: BlackBox,
    #[serde(default)]
    pub(super) functions: Vec<Spanned<Function>>,
}

/// What the node is.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "snake_case")]
pub(super) enum Role {
    #[default]
    MUnit,
    SUnit,
}

/// Where it looks for others.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "snake_case")]
pub(super) enum Interfaces {
    All,
    Lo,
}

/// `[manager]`
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Manager {
    pub(super) name: Maybe<String>,
    pub(super) id: Maybe<u32>,
    pub(super) address: Maybe<String>,
}

/// `[constraints]`
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Constraints {
    pub(super) request_timeout: Maybe<Time>,
    pub(super) minimum_interval: Maybe<Time>,
    pub(super) maximum_nodes: Maybe<Size>,
    pub(super) message_size: Maybe<Size>,
    pub(super) chunk_size: Maybe<Size>,
    pub(super) keep_alive: Maybe<Time>,
    pub(super) calls_per_peer: Maybe<Size>,
    pub(super) scheduling: Maybe<Scheduling>,
}

/// `constraints.scheduling`
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Scheduling {
    Deadline,
    Fifo,
    Admission,
}

/// `[capacities]`
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Capacities {
    pub(super) functions: Maybe<Size>,
    pub(super) signature_bytes: Maybe<Size>,
    pub(super) published_to_one: Maybe<Size>,
    pub(super) their_functions: Maybe<Size>,
    pub(super) their_signature_bytes: Maybe<Size>,
    pub(super) calls_in_flight: Maybe<Size>,
    pub(super) calls_running: Maybe<Size>,
    pub(super) pending_links: Maybe<Size>,
    pub(super) message_buffers: Maybe<Size>,
}

/// `[control]`
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Control {
    pub(super) off: Maybe<bool>,
    pub(super) path: Maybe<String>,
    pub(super) operators: Maybe<BTreeMap<String, Spanned<cara_std::control::Role>>>,
    pub(super) audit: Maybe<String>,
}

/// `[metrics]`
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Metrics {
    pub(super) listen: Maybe<String>,
}

/// `[log]`
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Log {
    pub(super) level: Maybe<String>,
    pub(super) stream: Maybe<bool>,
}

/// `[black_box]`
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BlackBox {
    pub(super) keep: Maybe<Size>,
    pub(super) size: Maybe<Size>,
    pub(super) streams: Maybe<Vec<String>>,
}

/// `[[functions]]`
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Function {
    pub(super) signature: Maybe<String>,
    pub(super) run: Maybe<Vec<String>>,
    pub(super) answer: Maybe<Answer>,
    pub(super) timeout: Maybe<Time>,
    pub(super) priority: Option<Priority>,
    #[serde(default)]
    pub(super) idempotent: bool,
    #[serde(default)]
    pub(super) stop: bool,
    #[serde(default)]
    pub(super) reset: bool,
    pub(super) lease: Maybe<Time>,
    pub(super) at_lease_end: Maybe<Vec<String>>,
}

impl Function {
    /// All but the lease, whose length is checked with its place.
    pub(super) fn attributes(&self) -> Attributes {
        let priority = self.priority.map(Into::into).unwrap_or_default();
        let Self { idempotent, stop, reset, .. } = *self;
        Attributes { priority, idempotent, stop, reset, lease: None, actuator: 0, stream: None }
    }
}

/// What a function does without a program.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "snake_case")]
pub(super) enum Answer {
    Echo,
    Log,
}

/// A function's class.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Priority {
    Emergency,
    High,
    Normal,
    Low,
}

impl From<Priority> for cara_std::Priority {
    fn from(priority: Priority) -> Self {
        match priority {
            Priority::Emergency => Self::Emergency,
            Priority::High => Self::High,
            Priority::Normal => Self::Normal,
            Priority::Low => Self::Low,
        }
    }
}

/// Most mistakes of form that are told at once.
const MOST: usize = 20;

/// Reads a file's text. What is no TOML is told alone, since nothing can be read behind it; of keys and values each mistake.
pub(super) fn read(source: &Source) -> Result<File, Vec<Mistake>> {
    let mut text = source.text.clone();
    let mut mistakes = Vec::new();
    loop {
        let error = match toml::from_str(&text) {
            Ok(file) if mistakes.is_empty() => return Ok(file),
            Ok(_) => return Err(mistakes),
            Err(error) => error,
        };
        let is_toml = toml::from_str::<toml::Table>(&text).is_ok();
        if is_toml || mistakes.is_empty() {
            mistakes.push(mistake(&error));
        }
        // Without the statement that is wrong, the next one is found; its bytes keep their places.
        let span = error.span().filter(|_| is_toml && mistakes.len() < MOST);
        if !span.is_some_and(|span| blank_statement(&mut text, span)) {
            return Err(mistakes);
        }
    }
}

fn mistake(error: &toml::de::Error) -> Mistake {
    let help = nearest_of(error.message()).unwrap_or_else(|| "`cara node --example` shows every key".into());
    Mistake::new(error.span().unwrap_or(0..0), error.message().trim_end(), help)
}

/// Makes blanks of the lines of a statement, and of a table's header with all of the table; `false` where nothing changes.
fn blank_statement(text: &mut String, span: Range<usize>) -> bool {
    let start = text.get(..span.start).and_then(|before| before.rfind('\n')).map_or(0, |end| end + 1);
    let Some(rest) = text.get(start..) else { return false };
    let is_table = rest.trim_start().starts_with('[');
    let from = span.end.max(span.start + 1) - start;
    let end = match is_table {
        true => rest.get(1..).and_then(|rest| rest.find("\n[")).map(|end| end + 1),
        false => rest.get(from.min(rest.len())..).and_then(|rest| rest.find('\n')).map(|end| end + from),
    };
    let end = start + end.unwrap_or(rest.len());
    let blanks: String = text.get(start..end).unwrap_or_default().chars().map(blank).collect();
    let changed = text.get(start..end) != Some(&blanks);
    text.replace_range(start..end, &blanks);
    changed
}

/// As long as it was, in bytes.
fn blank(character: char) -> String {
    if character == '\n' { "\n".to_owned() } else { " ".repeat(character.len_utf8()) }
}

/// The word that was meant, where a word is none of those expected.
fn nearest_of(message: &str) -> Option<String> {
    if !message.starts_with("unknown ") {
        return None;
    }
    let mut words = message.split('`').skip(1).step_by(2);
    let wrong = words.next()?;
    close(wrong, words).first().map(|nearest| format!("did you mean `{nearest}`?"))
}
