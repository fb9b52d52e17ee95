//! A mistake in a call's text: what is wrong, where, and what would be right.

use std::fmt::Write;
use std::ops::Range;

use cara_std::is_hidden;

/// Characters of a long text that are shown on each side of the mistake.
const AROUND: usize = 60;

/// A mistake in a text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Mistake {
    /// Its place, in bytes of the text.
    pub(crate) at: Range<usize>,
    /// What is wrong.
    pub(crate) what: String,
    /// What is expected there.
    pub(crate) expected: String,
}

impl Mistake {
    pub(crate) fn new(at: Range<usize>, what: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { at, what: what.into(), expected: expected.into() }
    }

    /// The mistake with the text, a caret under its place, what is expected there, and the signature.
    pub(crate) fn show(&self, text: &str, signature: Option<&str>) -> String {
        let (line, carets) = self.point(text);
        let mut shown = format!("{}\n  {line}\n  {carets}\n  expected: {}", self.what, self.expected);
        if let Some(signature) = signature {
            // Writing to a string does not fail.
            let _ = write!(shown, "\n  signature: {signature}");
        }
        shown
    }

    /// The line of the mistake, cut to what surrounds it, and carets under its place.
    fn point(&self, text: &str) -> (String, String) {
        let start = floor(text, self.at.start);
        let end = floor(text, self.at.end).max(start);
        let before = text[..start].rsplit('\n').next().unwrap_or_default();
        let inside = text[start..end].split('\n').next().unwrap_or_default();
        let after = text[start + inside.len()..].split('\n').next().unwrap_or_default();
        let cut = before.chars().count().saturating_sub(AROUND);
        let mut line = String::from(if cut > 0 { "…" } else { "" });
        line.extend(before.chars().skip(cut).map(visible));
        let indent = line.chars().count();
        let width = inside.chars().count().clamp(1, AROUND);
        line.extend(inside.chars().take(width).map(visible));
        if inside.chars().count() > width {
            line.push('…');
        } else {
            line.extend(after.chars().take(AROUND).map(visible));
            line.push_str(if after.chars().count() > AROUND { "…" } else { "" });
        }
        (line, " ".repeat(indent) + &"^".repeat(width))
    }
}

/// What a control character would do to the terminal is not wanted here.
fn visible(c: char) -> char {
    if is_hidden(c) { '·' } else { c }
}

/// The nearest boundary of a character at or before `at`.
fn floor(text: &str, at: usize) -> usize {
    (0..=at.min(text.len())).rev().find(|&at| text.is_char_boundary(at)).unwrap_or(0)
}
