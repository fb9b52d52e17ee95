//! Commands whose work comes later: each says what is missing and where it is planned, and exits with 2.

use std::process::ExitCode;

/// A command that later work brings.
pub(crate) struct Later {
    what: &'static str,
    topic: &'static str,
}

pub(crate) const SIZES: Later =
    Later { what: "the sizes of firmware images", topic: "s_unit firmware: the embassy port" };
pub(crate) const FIRMWARE: Later =
    Later { what: "firmware images and their run in QEMU", topic: "s_unit firmware: the embassy port" };

impl Later {
    /// Says so on standard error; the exit code tells it from success and from failure.
    pub(crate) fn refuse(&self) -> ExitCode {
        eprintln!("not built yet: {} (topic: {})", self.what, self.topic);
        ExitCode::from(2)
    }
}
