//! Which access point a board on Wi-Fi joins.

use core::fmt;

use heapless::String;
use serde::{Deserialize, Serialize};

/// An access point.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Wifi {
    name: String<32>,
    password: String<63>,
}

/// Why there is no such access point.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WifiError {
    /// The name's length.
    #[error("the name of an access point has 1 to 32 bytes")]
    Name,
    /// The password's length.
    #[error("the password of an access point has 8 to 63 bytes (WPA2), or none at all where it is open")]
    Password,
}

impl Wifi {
    /// An access point with WPA2; an open one where the password is empty.
    ///
    /// ```
    /// use cara_settings::{Wifi, WifiError};
    ///
    /// assert_eq!(Wifi::new("hall", "short"), Err(WifiError::Password));
    /// assert_eq!(Wifi::new("hall", "long enough").map(|wifi| wifi.password().len()), Ok(11));
    /// ```
    pub fn new(name: &str, password: &str) -> Result<Self, WifiError> {
        let name = String::try_from(name).map_err(|_| WifiError::Name)?;
        let wifi = Self { name, password: String::try_from(password).map_err(|_| WifiError::Password)? };
        wifi.checked().map(|()| wifi)
    }

    /// Its name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Its password, empty where it is open.
    pub fn password(&self) -> &str {
        &self.password
    }

    pub(crate) fn is_sound(&self) -> bool {
        self.checked().is_ok()
    }

    fn checked(&self) -> Result<(), WifiError> {
        match (self.name.len(), self.password.len()) {
            (0, _) => Err(WifiError::Name),
            (_, 0 | 8..) => Ok(()),
            _ => Err(WifiError::Password),
        }
    }
}

/// Without the password, which has no business in a log.
impl fmt::Debug for Wifi {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Wifi({})", self.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::format;

    #[test]
    fn what_no_access_point_has_is_refused() {
        assert_eq!(Wifi::new("", "12345678"), Err(WifiError::Name));
        assert_eq!(Wifi::new(&"n".repeat(33), ""), Err(WifiError::Name));
        assert_eq!(Wifi::new("hall", "1234567"), Err(WifiError::Password));
        assert_eq!(Wifi::new("hall", &"p".repeat(64)), Err(WifiError::Password));
        assert!(Wifi::new("hall", "").is_ok());
    }

    #[test]
    fn the_password_is_not_shown() {
        assert_eq!(format!("{:?}", Wifi::new("hall", "a secret").unwrap()), "Wifi(hall)");
    }
}
