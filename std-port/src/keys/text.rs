//! The form of all key files: lines of a word and its values. A name, which may hold anything but control characters,
//! stands last in its line. A line that begins with `#` says something to people. The last line, `sum` and eight
//! hexadecimal digits, is the CRC-32 of all bytes before it; files of form 1 have none.

use std::fmt::Write;

use cara_core::distribution::identity::{Identity, Role};
use cara_secure::keys::KEY_BYTES;
use crc::{CRC_32_ISO_HDLC, Crc};
use zeroize::Zeroizing;

/// Which form this is.
pub(super) const FORM: u32 = 2;
/// The same without a checksum, which is still read.
const FORM_WITHOUT_SUM: u32 = 1;
/// The word of the last line.
const SUM: &str = "sum ";
/// The checksum that zlib, gzip and Ethernet have: any run of up to 32 changed bits is found.
const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// What the checksum of a file tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Checksum {
    Right,
    Wrong,
    /// There is none.
    Absent,
}

/// Compares the last line with what stands before it.
pub(super) fn checksum(text: &str) -> Checksum {
    match split_sum(text) {
        None => Checksum::Absent,
        Some((before, line)) if line == sum_line(before) => Checksum::Right,
        Some(_) => Checksum::Wrong,
    }
}

/// Adds the last line.
pub(super) fn push_sum(text: &mut String) {
    let line = sum_line(text);
    text.push_str(&line);
}

fn sum_line(before: &str) -> String {
    format!("{SUM}{:08x}\n", CRC.checksum(before.as_bytes()))
}

/// The text before the last line, and that line, if it is one with a checksum.
fn split_sum(text: &str) -> Option<(&str, &str)> {
    let end = text.strip_suffix('\n').unwrap_or(text);
    let (before, line) = text.split_at(end.rfind('\n').map_or(0, |at| at + 1));
    line.starts_with(SUM).then_some((before, line))
}

/// The line, and what is expected there. What stands there is not told: it may be a key.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct FormError {
    pub(super) line: usize,
    pub(super) what: &'static str,
}

/// One line.
#[derive(Clone, Copy)]
pub(super) struct Line<'t> {
    number: usize,
    pub(super) word: &'t str,
    rest: &'t str,
}

/// The lines that say something to programs.
#[derive(Clone)]
pub(super) struct Lines<'t> {
    text: std::str::Lines<'t>,
    number: usize,
    has_sum: bool,
}

impl<'t> Lines<'t> {
    pub(super) fn of(text: &'t str) -> Self {
        let split = split_sum(text);
        Self { text: split.map_or(text, |(before, _)| before).lines(), number: 0, has_sum: split.is_some() }
    }

    /// The first line: `word` and the number of a form that is known.
    pub(super) fn head(&mut self, word: &str, what: &'static str) -> Result<(), FormError> {
        let line = self.expect(word, what)?;
        match (line.number()?, self.has_sum) {
            (FORM, true) | (FORM_WITHOUT_SUM, false) => Ok(()),
            (FORM, false) => Err(line.wrong("the last line of this file, its checksum, is missing")),
            _ => Err(line.wrong("this file is written in a form that this version does not know")),
        }
    }

    /// The next line, which must begin with `word`.
    pub(super) fn expect(&mut self, word: &str, what: &'static str) -> Result<Line<'t>, FormError> {
        let line = self.next().ok_or(FormError { line: self.number, what })?;
        if line.word == word { Ok(line) } else { Err(line.wrong(what)) }
    }
}

impl<'t> Iterator for Lines<'t> {
    type Item = Line<'t>;

    fn next(&mut self) -> Option<Line<'t>> {
        loop {
            self.number += 1;
            let line = self.text.next()?;
            if !line.is_empty() && !line.starts_with('#') {
                let (word, rest) = line.split_once(' ').unwrap_or((line, ""));
                return Some(Line { number: self.number, word, rest });
            }
        }
    }
}

impl<'t> Line<'t> {
    pub(super) fn wrong(&self, what: &'static str) -> FormError {
        FormError { line: self.number, what }
    }

    /// Whether nothing is left of it.
    pub(super) fn is_empty(&self) -> bool {
        self.rest.is_empty()
    }

    /// The whole value as a number.
    pub(super) fn number(&self) -> Result<u32, FormError> {
        self.rest.parse().map_err(|_| self.wrong("here a number of 32 bits is expected"))
    }

    /// The next value, and the line behind it.
    pub(super) fn value(self) -> (&'t str, Self) {
        let (value, rest) = self.rest.split_once(' ').unwrap_or((self.rest, ""));
        (value, Self { rest, ..self })
    }

    /// A number, and the line behind it.
    pub(super) fn numbered(self) -> Result<(u32, Self), FormError> {
        let (value, rest) = self.value();
        let number = value.parse().map_err(|_| self.wrong("here a number of 32 bits is expected"))?;
        Ok((number, rest))
    }

    /// A key, and the line behind it.
    pub(super) fn key(self) -> Result<(Zeroizing<[u8; KEY_BYTES]>, Self), FormError> {
        let (value, rest) = self.value();
        let mut key = Zeroizing::new([0; KEY_BYTES]);
        hex::decode_to_slice(value, key.as_mut_slice())
            .map_err(|_| self.wrong("here a key of 64 hexadecimal digits is expected"))?;
        Ok((key, rest))
    }

    /// `ROLE ID NAME`, to the end of the line.
    pub(super) fn identity(self) -> Result<Identity, FormError> {
        let (role, line) = self.value();
        let role = match role {
            "m_unit" => Role::MUnit,
            "s_unit" => Role::SUnit,
            _ => return Err(self.wrong("here m_unit or s_unit is expected")),
        };
        let (id, line) = line.numbered()?;
        let named = Identity::new(line.rest, id, role);
        named.map_err(|_| self.wrong("here a name of 1 to 32 bytes is expected"))
    }
}

/// Adds `ROLE ID NAME`.
pub(super) fn push_identity(text: &mut String, identity: &Identity) {
    let role = identity.role().as_str();
    // Writing to text does not fail.
    let _ = write!(text, "{role} {} {}", identity.id(), identity.name());
}

/// Adds a key in hexadecimal.
pub(super) fn push_key(text: &mut String, key: &[u8; KEY_BYTES]) {
    let mut digits = Zeroizing::new([0; 2 * KEY_BYTES]);
    // There is room for each byte's two digits, and digits are text.
    let _ = hex::encode_to_slice(key, digits.as_mut_slice());
    text.push_str(std::str::from_utf8(digits.as_slice()).unwrap_or_default());
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_checksum_is_of_all_that_stands_before_it() {
        let mut text = String::from("cara-ring 2\nfleet 7\n");
        assert_eq!(checksum(&text), Checksum::Absent);
        push_sum(&mut text);
        // Computed with Python's `zlib.crc32`.
        assert_eq!(text, "cara-ring 2\nfleet 7\nsum b11da895\n");
        assert_eq!(checksum(&text), Checksum::Right);
        for wrong in [text.replace('7', "8"), text.replace("sum ", "sum 0"), text.trim_end().to_owned()] {
            assert_eq!(checksum(&wrong), Checksum::Wrong, "{wrong}");
        }
        assert_eq!(checksum(&format!("{text}\n")), Checksum::Absent, "it stands last");
        assert_eq!(checksum(""), Checksum::Absent);
    }
}
