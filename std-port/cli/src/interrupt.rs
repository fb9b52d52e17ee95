//! Ctrl-C, for commands that have something to say before they go.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use signal_hook::consts::SIGINT;
use signal_hook::flag;

/// How often is looked whether it came.
const LOOK: Duration = Duration::from_millis(20);
/// The exit code when it comes a second time: that of a shell for a process that a signal ended.
const ENDED: i32 = 130;

/// Whether Ctrl-C came. A second one ends the process at once.
pub(crate) struct Interrupt {
    came: Arc<AtomicBool>,
}

impl Interrupt {
    pub(crate) fn catch() -> io::Result<Self> {
        let came = Arc::new(AtomicBool::new(false));
        flag::register_conditional_shutdown(SIGINT, ENDED, came.clone())?;
        flag::register(SIGINT, came.clone())?;
        Ok(Self { came })
    }

    pub(crate) fn came(&self) -> bool {
        self.came.load(Ordering::SeqCst)
    }

    /// Waits, and not longer than until it comes.
    pub(crate) fn pause(&self, span: Duration) {
        let start = Instant::now();
        while !self.came() && start.elapsed() < span {
            std::thread::sleep(LOOK.min(span.saturating_sub(start.elapsed())));
        }
    }
}
