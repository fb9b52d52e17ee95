//! Valid names of functions, variables and nodes, and safe display of a peer's texts.

use core::fmt::{self, Write};

use crate::config::NAME_BYTES;
use crate::error::{Error, Limit};

/// Names of functions and variables: letters, digits, `_`, `-`, `.`, `/` of ASCII, 1 to [`NAME_BYTES`] of them.
pub(crate) fn check_name(name: &str) -> Result<(), Error> {
    if name.is_empty() || !name.bytes().all(is_name_byte) {
        return Err(Error::BadName);
    }
    if name.len() > NAME_BYTES {
        return Err(Error::Full(Limit::NameBytes));
    }
    Ok(())
}

/// Whether a character affects the terminal or the layout instead of being visible: control characters (C0, DEL, C1), bidi marks,
/// line and paragraph separators, and zero-width characters including tags.
pub const fn is_hidden(character: char) -> bool {
    matches!(character,
        '\0'..='\u{1F}' | '\u{7F}'..='\u{9F}' | '\u{AD}' | '\u{061C}' | '\u{200B}'..='\u{200F}'
        | '\u{2028}'..='\u{202E}' | '\u{2060}'..='\u{2064}' | '\u{2066}'..='\u{206F}' | '\u{FEFF}'
        | '\u{E0000}'..='\u{E007F}')
}

/// A peer's text for terminals and logs, with each [hidden](is_hidden) character as `\u{…}`.
#[derive(Clone, Copy, Debug)]
pub struct Shown<'t>(pub &'t str);

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for character in self.0.chars() {
            if is_hidden(character) {
                write!(f, "{}", character.escape_unicode())?;
            } else {
                f.write_char(character)?;
            }
        }
        Ok(())
    }
}

pub(crate) const fn is_name_byte(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'-' | b'.' | b'/')
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::distribution::hello::Manager;
    use crate::distribution::identity::Identity;
    use std::string::ToString;

    #[test]
    fn no_name_holds_what_is_not_seen_and_no_text_shows_it() {
        let ranges = [
            0..=0x1F,
            0x7F..=0x9F,
            0xAD..=0xAD,
            0x061C..=0x061C,
            0x200B..=0x200F,
            0x2028..=0x202E,
            0x2060..=0x2064,
            0x2066..=0x206F,
            0xFEFF..=0xFEFF,
            0xE0000..=0xE007F,
        ];
        for code in ranges.into_iter().flatten() {
            let hidden = char::from_u32(code).unwrap();
            let name = std::format!("a{hidden}b");
            assert_eq!(Identity::s_unit(&name, 1), Err(Error::BadName), "U+{code:04X}");
            assert!(Manager::new(&name, 1).is_err() && check_name(&name).is_err(), "U+{code:04X}");
            assert_eq!(Shown(&name).to_string(), std::format!("a\\u{{{code:x}}}b"));
        }
        for seen in ["agv-1", "Gabelstapler ä", "叉车", "مركبة"] {
            assert!(Identity::s_unit(seen, 1).is_ok());
            assert_eq!(Shown(seen).to_string(), seen);
        }
    }
}
