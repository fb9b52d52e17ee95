//! How a command ends: its exit code, and an error as text or JSON.

use std::fmt;
use std::io::Write;
use std::process::ExitCode;

use cara_std::{Claim, StartError, is_hidden};
use serde_json::json;

use crate::global::Global;
use crate::output::{BAD, json as escaped};

/// What `cara --help` says about exit codes.
pub const EXIT_CODES: &str = "\
Exit codes:
  0  done
  1  a node or the network failed it
  2  wrong usage, a mistake in a call's arguments included
  3  no unit to talk to: no m_unit that lets this user in runs on this host, and --as is not given
  4  the doctor found something
  5  a live m_unit has this one's name and ID: `cara node` does not start
  6  another m_unit of this name and ID has taken over from `cara node`
  130  Ctrl-C ended it (143: SIGTERM)";

/// The exit codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// What was asked for is done.
    Done = 0,
    /// A node or the network failed it.
    Failed = 1,
    /// The command line, or a call's arguments, must change.
    Usage = 2,
    /// No unit to talk to.
    NoUnit = 3,
    /// The doctor found something.
    Findings = 4,
    /// Ctrl-C ended it.
    Interrupted = 130,
    /// SIGTERM ended it.
    Terminated = 143,
    /// A live m_unit has the identity of the one that was to start.
    AlreadyRunning = StartError::ALREADY_RUNNING_EXIT as isize,
    /// A manager with a newer term has taken over.
    Fenced = StartError::FENCED_EXIT as isize,
}

impl From<Exit> for ExitCode {
    fn from(exit: Exit) -> Self {
        Self::from(exit as u8)
    }
}

/// An error that knows its exit code. All other errors end with [`Exit::Failed`].
#[derive(Debug)]
pub struct Ended {
    /// With which code the command ends.
    pub exit: Exit,
    /// What happened and what to do.
    pub text: String,
    /// The error's name for programs, as `TimedOut` or `NoUnit`.
    pub name: String,
}

impl Ended {
    /// The command line must change.
    pub fn usage(text: impl Into<String>) -> anyhow::Error {
        Self { exit: Exit::Usage, text: text.into(), name: "Usage".into() }.into()
    }

    /// A node or the network failed it.
    pub fn failed(name: impl Into<String>, text: impl Into<String>) -> anyhow::Error {
        Self { exit: Exit::Failed, text: text.into(), name: name.into() }.into()
    }

    /// A unit does not start.
    pub fn not_started(error: StartError) -> anyhow::Error {
        let exit = if error.is_running_already() { Exit::AlreadyRunning } else { Exit::Failed };
        Self { exit, text: error.to_string(), name: error.code() }.into()
    }

    /// A live manager with a higher claim commands in place of a node.
    pub fn fenced(claim: Claim) -> anyhow::Error {
        let text = format!(
            "another m_unit of this name and ID commands with the claim {claim}: find out which of the two is to \
             command, and stop the other one before this one starts again"
        );
        Self { exit: Exit::Fenced, text, name: "Fenced".into() }.into()
    }

    /// No unit to talk to.
    pub fn no_unit(text: impl Into<String>) -> anyhow::Error {
        Self { exit: Exit::NoUnit, text: text.into(), name: "NoUnit".into() }.into()
    }
}

impl fmt::Display for Ended {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl std::error::Error for Ended {}

/// Prints an error, if there is one, and tells the exit code. A reader that has closed its pipe is no error.
pub fn code_of(outcome: anyhow::Result<ExitCode>, global: &Global) -> ExitCode {
    match outcome {
        Ok(code) => code,
        Err(error) if is_closed_pipe(&error) => Exit::Done.into(),
        Err(error) => report(&error, global.json),
    }
}

/// Prints an error and tells its exit code.
pub fn report(error: &anyhow::Error, json: bool) -> ExitCode {
    let (exit, name) = match error.downcast_ref::<Ended>() {
        Some(ended) => (ended.exit, ended.name.as_str()),
        None => (Exit::Failed, "Failed"),
    };
    // Where not even standard error can be written to, the exit code has to do.
    let _ = if json {
        let text = format!("{error:#}");
        let text = text.strip_prefix("error: ").unwrap_or(&text);
        let reported = json!({ "error": { "name": name, "exit": exit as u8, "text": text } });
        writeln!(std::io::stderr(), "{}", escaped(&reported).unwrap_or_default())
    } else {
        writeln!(anstream::stderr(), "{BAD}error:{BAD:#} {}", harmless(&format!("{error:#}")))
    };
    exit.into()
}

/// A terminal would obey hidden characters, which an argument or a text of another node may hold.
fn harmless(text: &str) -> String {
    let is_harmful = |character: char| is_hidden(character) && !matches!(character, '\n' | '\t');
    let pieces = text.chars().map(|character| match is_harmful(character) {
        true => character.escape_unicode().to_string(),
        false => character.to_string(),
    });
    pieces.collect()
}

fn is_closed_pipe(error: &anyhow::Error) -> bool {
    error.chain().any(|cause| {
        cause.downcast_ref::<std::io::Error>().is_some_and(|io| io.kind() == std::io::ErrorKind::BrokenPipe)
    })
}

#[cfg(test)]
mod tests {
    use super::harmless;

    #[test]
    fn control_characters_are_written_out() {
        assert_eq!(harmless("a\u{1b}[2Jb\n  c\u{9b}\u{202e}"), "a\\u{1b}[2Jb\n  c\\u{9b}\\u{202e}");
    }
}
