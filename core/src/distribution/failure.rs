//! Why a service failed: its code, a text for people, and values for programs.

use core::fmt;

use super::parameters::{Parameters, ParametersView};
use crate::config::{FAILURE_TEXT_BYTES, FAILURE_VALUES_BYTES};
use crate::error::ServiceError;

/// Why a service failed: made by its handler, read by its caller.
///
/// ```
/// use cara_core::distribution::failure::Failure;
///
/// let mut blocked = Failure::new(7, "the way is blocked");
/// blocked.values_mut().add_int("at", 2)?;
/// blocked.values_mut().set_value("at", [3, 4])?;
/// assert_eq!((blocked.code(), blocked.text()), (7, "the way is blocked"));
/// assert_eq!(blocked.values().variable("at"), Ok([3_i64, 4]));
/// assert_eq!(blocked.to_string(), "the way is blocked (code 7)");
/// # Ok::<(), cara_core::error::Error>(())
/// ```
#[derive(Clone)]
pub struct Failure {
    code: u16,
    text: heapless::String<FAILURE_TEXT_BYTES>,
    is_cut: bool,
    values: Parameters<FAILURE_VALUES_BYTES>,
}

impl Failure {
    /// A failure with a code and a text. What exceeds [`FAILURE_TEXT_BYTES`] is cut at a character boundary.
    pub fn new(code: u16, text: &str) -> Self {
        let length = text.floor_char_boundary(FAILURE_TEXT_BYTES);
        let text_kept = heapless::String::try_from(text.get(..length).unwrap_or_default()).unwrap_or_default();
        Self { code, is_cut: length < text.len(), text: text_kept, values: Parameters::sized() }
    }

    /// The service's own code.
    pub const fn code(&self) -> u16 {
        self.code
    }

    /// The reason in words; empty if there is none.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// The values that the signature declares; none if the callee sent none.
    pub fn values(&self) -> &ParametersView {
        &self.values
    }

    /// For setting values. They reach the caller only if names, types and sizes are those that the signature declares, as with
    /// `fails (at: int[2])`; otherwise they are dropped and counted.
    pub fn values_mut(&mut self) -> &mut ParametersView {
        &mut self.values
    }

    /// Whether the text was too long.
    pub const fn is_cut(&self) -> bool {
        self.is_cut
    }

    /// The error without text and values.
    pub const fn error(&self) -> ServiceError {
        ServiceError::Failed(self.code)
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.text() {
            "" => fmt::Display::fmt(&self.error(), f),
            text => write!(f, "{text} (code {})", self.code),
        }
    }
}

impl fmt::Debug for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Failure").field("code", &self.code).field("text", &self.text).finish_non_exhaustive()
    }
}
