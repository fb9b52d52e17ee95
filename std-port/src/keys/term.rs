//! The file of a unit's term, in the form of key files: nothing in it is secret, but it is written and checked as they are.

use std::fmt::Write;
use std::path::Path;

use super::text::{FORM, FormError, Lines, push_sum};
use super::{KeyError, file};

/// The first line's word.
const HEAD: &str = "cara-term";

/// The term in a file; `None` where there is none.
pub(crate) fn read_term(path: &Path) -> Result<Option<u32>, KeyError> {
    if !file::is_there(path)? {
        return Ok(None);
    }
    let (text, _) = file::read(path)?;
    parse(&text).map(Some).map_err(|error| file::form(path, error))
}

fn parse(text: &str) -> Result<u32, FormError> {
    let mut lines = Lines::of(text);
    lines.head(HEAD, "a file with a term begins with `cara-term`")?;
    let term = lines.expect("term", "here the term is expected")?.number()?;
    match lines.next() {
        Some(line) => Err(line.wrong("here the file should end")),
        None => Ok(term),
    }
}

/// Writes it, whole, and with its folder on the disk before this returns.
pub(crate) fn write_term(path: &Path, term: u32) -> Result<(), KeyError> {
    let mut text = String::new();
    let _ = writeln!(text, "{HEAD} {FORM}\nterm {term}");
    push_sum(&mut text);
    if let Some(folder) = path.parent() {
        file::make_folder(folder)?;
    }
    file::write_private(path, text.as_bytes())
}
