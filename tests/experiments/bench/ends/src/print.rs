//! The paper's print command, into a pipe that another thread reads.

use std::io::{LineWriter, Stderr, Write, stderr};
use std::sync::{Mutex, OnceLock, PoisonError};

/// Prints as a service does, or not at all. A child's standard output carries answers, so this takes standard error,
/// buffered by lines as standard output would be.
#[derive(Clone, Copy)]
pub struct Printer(pub(crate) bool);

impl Printer {
    /// One line.
    pub fn print(self, text: &str) {
        static OUT: OnceLock<Mutex<LineWriter<Stderr>>> = OnceLock::new();
        if !self.0 {
            return;
        }
        let out = OUT.get_or_init(|| Mutex::new(LineWriter::new(stderr())));
        // The reader may have ended; the service goes on.
        let _ = writeln!(out.lock().unwrap_or_else(PoisonError::into_inner), "{text}");
    }
}
