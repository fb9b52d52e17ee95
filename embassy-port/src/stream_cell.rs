//! Room for the newest value of a stream of this unit.

use core::cell::RefCell;
use core::fmt;

use cara_core::distribution::function::Signature;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::stream::{Newest, Source, Value};
use cara_core::time::Duration;

use crate::time::now;

/// Room for the newest value of a stream of `BYTES` bytes: 8 for each int and float, and for each 8 truth values; a string or
/// bytes take 8, and their size rounded up to a multiple of 8.
pub struct StreamCell<const BYTES: usize>(RefCell<Newest<[u8; BYTES]>>);

impl<const BYTES: usize> fmt::Debug for StreamCell<BYTES> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StreamCell").field("bytes", &BYTES).finish_non_exhaustive()
    }
}

impl<const BYTES: usize> StreamCell<BYTES> {
    /// Without a value.
    pub const fn new() -> Self {
        Self(RefCell::new(Newest::new([0; BYTES])))
    }
}

impl<const BYTES: usize> Default for StreamCell<BYTES> {
    fn default() -> Self {
        Self::new()
    }
}

/// A stream's cell, whatever its size.
pub(crate) trait Cell: Source {
    fn publish(&self, signature: Signature<'_>, values: &ParametersView) -> Result<(), Error>;
}

impl<const BYTES: usize> Source for StreamCell<BYTES> {
    fn version(&self) -> u32 {
        self.0.borrow().version()
    }

    fn newest(&self, look: &mut dyn FnMut(&Value<'_>)) {
        if let Some(value) = self.0.borrow().value() {
            look(&value);
        }
    }
}

impl<const BYTES: usize> Cell for StreamCell<BYTES> {
    fn publish(&self, signature: Signature<'_>, values: &ParametersView) -> Result<(), Error> {
        self.0.borrow_mut().publish(now(), Duration::ZERO, signature, values)
    }
}
