//! Which names functions and variables may have.

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

pub(crate) const fn is_name_byte(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || matches!(byte, b'_' | b'-' | b'.' | b'/')
}
