//! Ctrl-C, for commands that have something to say or to give up before they go.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag;
use signal_hook::iterator::Signals;

use crate::exit::Exit;

/// How often is looked whether it came.
const LOOK: Duration = Duration::from_millis(20);
/// The exit code when it comes a second time: that of a shell for a process that a signal ended.
const ENDED: i32 = SHELL + SIGINT;
/// A shell adds the number of the signal to it.
const SHELL: i32 = 128;

/// Ends the process at Ctrl-C and at SIGTERM, even if its parent has them ignored, as a shell does for background jobs.
pub fn end_at_signals() -> io::Result<()> {
    let mut signals = Signals::new([SIGINT, SIGTERM])?;
    std::thread::Builder::new().name("signals".into()).spawn(move || {
        if let Some(signal) = signals.forever().next() {
            std::process::exit(SHELL.saturating_add(signal));
        }
    })?;
    Ok(())
}

/// Whether Ctrl-C came. A second one ends the process at once.
pub struct Interrupt {
    came: Arc<AtomicBool>,
}

impl Interrupt {
    /// From here on Ctrl-C is noted.
    pub fn catch() -> io::Result<Self> {
        let came = Arc::new(AtomicBool::new(false));
        flag::register_conditional_shutdown(SIGINT, ENDED, came.clone())?;
        flag::register(SIGINT, came.clone())?;
        Ok(Self { came })
    }

    /// Whether it came.
    pub fn came(&self) -> bool {
        self.came.load(Ordering::SeqCst)
    }

    /// Waits, and not longer than until it comes.
    pub fn pause(&self, span: Duration) {
        let start = Instant::now();
        while !self.came() && start.elapsed() < span {
            std::thread::sleep(LOOK.min(span.saturating_sub(start.elapsed())));
        }
    }
}

/// Which signal came that asks the process to end, for commands that end by themselves at the next place where nothing is
/// half done.
pub struct Asked(Arc<AtomicUsize>);

impl Asked {
    /// From here on the signals are noted.
    pub fn catch() -> io::Result<Self> {
        let came = Arc::new(AtomicUsize::new(0));
        for signal in [SIGINT, SIGTERM, SIGHUP] {
            flag::register_usize(signal, came.clone(), signal as usize)?;
        }
        Ok(Self(came))
    }

    /// Whether one came.
    pub fn came(&self) -> bool {
        self.0.load(Ordering::SeqCst) != 0
    }

    /// How the command ends because of it.
    pub fn exit(&self) -> Exit {
        if self.0.load(Ordering::SeqCst) == SIGINT as usize { Exit::Interrupted } else { Exit::Terminated }
    }
}
