//! One line of help on a function and the units of its variables, for people, at the end of a signature.
//!
//! They are section 3 of a signature. A line is encoded like a variable, so that units which do not know it skip it: type u8 of a
//! text, length u8, kind u32 little-endian, text. Kind 0 is the help; kind 1 is a unit, after the name of its variable and a
//! blank, as in `position m`.

use super::function::{Definition, HELP_SECTION, Signature, VariableSpec, VariableSpecs};
use super::value::Type;
use crate::config::{HELP_BYTES, UNIT_BYTES};
use crate::error::{Error, Limit};

/// The kinds of lines.
const HELP: u32 = 0;
const UNIT: u32 = 1;

/// The head of a line before its text.
pub(super) const fn head(is_unit: bool, length: usize) -> [u8; 6] {
    let [a, b, c, d] = if is_unit { UNIT } else { HELP }.to_le_bytes();
    [Type::String as u8, length as u8, a, b, c, d]
}

impl Definition {
    /// The same function with one line of help: what it does. A text of more than [`HELP_BYTES`] is cut.
    ///
    /// Set it last: changing arguments, results, progress or failures removes help and units.
    ///
    /// ```
    /// # use cara_core::Definition;
    /// let lift = Definition::parse("lift_to(height: float)").unwrap();
    /// let lift = lift.help("Lifts the fork.")?.unit("height", "m")?;
    /// assert_eq!((lift.signature().help(), lift.signature().unit_of("height")), ("Lifts the fork.", Some("m")));
    /// // It is none of what a caller has to know.
    /// assert_eq!(lift.to_string(), "lift_to(height: float)");
    /// # Ok::<(), cara_core::error::Error>(())
    /// ```
    ///
    /// [`Error::Full`] if the signature would be too long, [`Error::NameTaken`] if it has help already.
    pub fn help(self, text: &str) -> Result<Self, Error> {
        if !self.signature().help().is_empty() {
            return Err(Error::NameTaken);
        }
        self.with_line(false, &[cut(text, HELP_BYTES)])
    }

    /// The same function with the unit of a variable, wherever that is declared. A text of more than [`UNIT_BYTES`] is cut.
    ///
    /// [`Error::UnknownVariable`], [`Error::Full`] if the signature would be too long, [`Error::NameTaken`] if the variable has a
    /// unit already.
    pub fn unit(self, variable: &str, unit: &str) -> Result<Self, Error> {
        let signature = self.signature();
        let has = |specs: VariableSpecs<'_>| specs.named(variable).is_some();
        let is_reported = has(signature.progress()) || has(signature.failure());
        if !is_reported && !has(signature.arguments()) && !has(signature.results()) {
            return Err(Error::UnknownVariable);
        }
        if signature.unit_of(variable).is_some() {
            return Err(Error::NameTaken);
        }
        self.with_line(true, &[variable, " ", cut(unit, UNIT_BYTES)])
    }

    fn with_line(mut self, is_unit: bool, parts: &[&str]) -> Result<Self, Error> {
        let section_at = self.signature().without_help().as_bytes().len();
        let length = parts.iter().fold(0_usize, |length, part| length.saturating_add(part.len()));
        let begin: &[u8] = if self.bytes.len() == section_at { &[HELP_SECTION, 0] } else { &[] };
        let head = head(is_unit, length);
        let pieces = [begin, &head].into_iter().chain(parts.iter().map(|part| part.as_bytes()));
        for piece in pieces {
            self.bytes.extend_from_slice(piece).map_err(|_| Error::Full(Limit::SignatureBytes))?;
        }
        if let Some(count) = self.bytes.get_mut(section_at.saturating_add(1)) {
            *count = count.saturating_add(1);
        }
        Ok(self)
    }
}

/// At most `most` bytes of a text, cut at a character boundary.
fn cut(text: &str, most: usize) -> &str {
    text.get(..text.floor_char_boundary(most)).unwrap_or(text)
}

impl<'a> Signature<'a> {
    /// One line of help; empty if there is none.
    pub fn help(&self) -> &'a str {
        self.lines().find(|line| line.size == HELP).map_or("", |line| cut(line.name, HELP_BYTES))
    }

    /// The unit of a variable, such as `m`.
    pub fn unit_of(&self, variable: &str) -> Option<&'a str> {
        self.units().find(|(name, _)| *name == variable).map(|(_, unit)| unit)
    }

    /// Variables with their units.
    pub fn units(&self) -> impl Iterator<Item = (&'a str, &'a str)> + use<'a> {
        let units = self.lines().filter(|line| line.size == UNIT).filter_map(|line| line.name.split_once(' '));
        units.map(|(variable, unit)| (variable, cut(unit, UNIT_BYTES)))
    }

    /// The lines, as variables whose names are the texts.
    fn lines(&self) -> impl Iterator<Item = VariableSpec<'a>> + use<'a> {
        self.section(HELP_SECTION)
    }
}

#[cfg(test)]
mod tests;
