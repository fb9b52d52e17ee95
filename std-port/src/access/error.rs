//! What is wrong with a table's file, and where.

use std::fmt;
use std::ops::Range;

/// Why a file is no access table. `Display` has a line for each mistake: `FILE:LINE:COLUMN: what is wrong: what to do`.
#[derive(Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum AccessError {
    /// It cannot be read.
    Unreadable {
        /// The file.
        file: String,
        /// The system's reason.
        reason: String,
    },
    /// It has mistakes.
    Mistakes(Vec<AccessMistake>),
}

/// A mistake in a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AccessMistake {
    /// The file.
    pub file: String,
    /// From 1.
    pub line: usize,
    /// From 1, in characters.
    pub column: usize,
    /// What is wrong.
    pub what: String,
    /// What to do.
    pub help: String,
}

impl AccessMistake {
    /// A mistake at some bytes of a text.
    #[cfg_attr(not(feature = "access"), expect(dead_code, reason = "tables come from files only with the feature"))]
    pub(super) fn at(file: &str, text: &str, span: &Range<usize>, what: impl Into<String>, help: &str) -> Self {
        let before = text.get(..text.floor_char_boundary(span.start)).unwrap_or_default();
        let line_start = before.rfind('\n').map_or(0, |end| end + 1);
        Self {
            file: file.to_owned(),
            line: before.matches('\n').count() + 1,
            column: before.get(line_start..).unwrap_or_default().chars().count() + 1,
            what: what.into(),
            help: help.to_owned(),
        }
    }
}

impl fmt::Display for AccessMistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { file, line, column, what, help } = self;
        write!(f, "{file}:{line}:{column}: {what}: {help}")
    }
}

impl fmt::Display for AccessError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unreadable { file, reason } => write!(f, "{file}: the access table cannot be read: {reason}"),
            Self::Mistakes(mistakes) => {
                let lines: Vec<String> = mistakes.iter().map(AccessMistake::to_string).collect();
                f.write_str(&lines.join("\n"))
            }
        }
    }
}

impl std::error::Error for AccessError {}
