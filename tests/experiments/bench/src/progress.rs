//! Progress of the run, and whether it was interrupted.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Result;
use indicatif::{ProgressBar, ProgressStyle};

/// Set by Ctrl-C or SIGTERM.
static STOP: AtomicBool = AtomicBool::new(false);
/// How long after a failure Ctrl-C may still be its reason: the children get it as well, and end sooner.
const TOGETHER: Duration = Duration::from_millis(300);

/// Ctrl-C ends the run with what there is; a second one ends it at once.
pub(crate) fn stop_at_interrupt() -> Result<()> {
    Ok(ctrlc::set_handler(|| {
        if STOP.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
        eprintln!("\nstopping; what was measured so far is kept");
    })?)
}

/// Whether the run is to end.
pub(crate) fn is_stopped() -> bool {
    STOP.load(Ordering::Relaxed)
}

/// Whether a failure comes from the run being stopped.
pub(crate) fn was_stopped() -> bool {
    let end = Instant::now() + TOGETHER;
    while !is_stopped() && Instant::now() < end {
        std::thread::sleep(Duration::from_millis(5));
    }
    is_stopped()
}

/// Where there is no terminal, a line says at most so often how far the run is.
const EVERY: Duration = Duration::from_secs(15);

/// A bar of steps; without a terminal, lines.
pub(crate) struct Progress {
    bar: ProgressBar,
    what: String,
    steps: usize,
    began: Instant,
    done: Mutex<(usize, Instant)>,
}

impl Progress {
    /// Begins with none of `steps` done.
    pub(crate) fn new(what: &str, steps: usize) -> Self {
        let bar = ProgressBar::new(steps as u64).with_message(what.to_owned());
        let style = ProgressStyle::with_template("{msg:40} {bar:30} {pos}/{len} {elapsed} (left: {eta})");
        let bar = style.map_or_else(|_| bar.clone(), |style| bar.clone().with_style(style));
        if bar.is_hidden() {
            eprintln!("{what}");
        } else {
            bar.tick();
        }
        let now = Instant::now();
        Self { bar, what: what.to_owned(), steps, began: now, done: Mutex::new((0, now)) }
    }

    /// One more step is done.
    pub(crate) fn step(&self) {
        self.bar.inc(1);
        let mut done = self.done.lock().unwrap_or_else(PoisonError::into_inner);
        done.0 += 1;
        if self.bar.is_hidden() && done.1.elapsed() >= EVERY {
            done.1 = Instant::now();
            eprintln!("{}: {} of {}, {} s", self.what, done.0, self.steps, self.began.elapsed().as_secs());
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}
