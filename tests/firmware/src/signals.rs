//! Ctrl-C and the like: what this program has started ends, and folders with keys go, as at its own end.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use anyhow::{Context, Result};
use rustix::process::{Pid, Signal, kill_process};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

/// What must not outlive this process.
static FOLDERS: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());
/// A shell adds the number of the signal to it.
const SHELL: i32 = 128;

/// The folder goes with this process, however a signal ends it.
pub(crate) fn remove_at_end(folder: &Path) {
    FOLDERS.lock().unwrap_or_else(PoisonError::into_inner).push(folder.to_owned());
}

/// Cleans up when a signal ends this process.
pub(crate) fn clean_up_at_signals() -> Result<()> {
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP]).context("signals cannot be waited for")?;
    std::thread::spawn(move || {
        let Some(signal) = signals.forever().next() else { return };
        // Children first: they write into the folders.
        for child in children() {
            let _ = kill_process(child, Signal::KILL);
        }
        for folder in FOLDERS.lock().unwrap_or_else(PoisonError::into_inner).iter() {
            let _ = std::fs::remove_dir_all(folder);
        }
        std::process::exit(SHELL.saturating_add(signal));
    });
    Ok(())
}

/// Of all threads.
fn children() -> Vec<Pid> {
    let threads = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let lists = threads.filter_map(|thread| std::fs::read_to_string(thread.path().join("children")).ok());
    let numbers =
        lists.flat_map(|list| list.split_whitespace().filter_map(|word| word.parse().ok()).collect::<Vec<_>>());
    numbers.filter_map(Pid::from_raw).collect()
}
