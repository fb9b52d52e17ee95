//! Lines on standard error, which hold no vehicle's loop up: a thread of their own writes them.

use std::fmt::Display;
use std::io::{Write, stderr};
use std::panic;
use std::sync::OnceLock;
use std::time::Duration;

use cara_std::LineQueue;

/// The last lines wait so long for whoever reads them.
const LAST_LINES: Duration = Duration::from_secs(1);

static LINES: OnceLock<LineQueue> = OnceLock::new();

/// What waits is written when this goes, if anybody reads it.
#[derive(Debug)]
pub struct Log(());

/// Starts the thread. Panics go the same way.
pub fn start() -> std::io::Result<Log> {
    let lines = LineQueue::new("log", |line, _| stderr().write_all(line))?;
    // Started twice, the first one goes on.
    let _ = LINES.set(lines);
    panic::set_hook(Box::new(|info| {
        let thread = std::thread::current();
        line(format_args!("thread {}: {info}", thread.name().unwrap_or("without a name")));
    }));
    Ok(Log(()))
}

/// Writes a line, and never waits: one that finds no place is [counted](lost). Before [`start`] nobody needs it, and it is dropped.
pub fn line(text: impl Display) {
    if let Some(lines) = LINES.get() {
        lines.write(format!("{text}\n").as_bytes());
    }
}

/// Lines that found no place, or that nobody read.
pub fn lost() -> u64 {
    LINES.get().map_or(0, LineQueue::lost)
}

impl Drop for Log {
    fn drop(&mut self) {
        if let Some(lines) = LINES.get() {
            lines.flush(LAST_LINES);
        }
    }
}
