//! The form of all key files: lines of a word and its values. A name, which may hold anything but control characters,
//! stands last in its line. A line that begins with `#` says something to people.

use std::fmt::Write;

use cara_core::distribution::identity::{Identity, Role};
use cara_secure::keys::KEY_BYTES;
use zeroize::Zeroizing;

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
}

impl<'t> Lines<'t> {
    pub(super) fn of(text: &'t str) -> Self {
        Self { text: text.lines(), number: 0 }
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
    fn value(self) -> (&'t str, Self) {
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
    let role = match identity.role() {
        Role::MUnit => "m_unit",
        Role::SUnit => "s_unit",
    };
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
