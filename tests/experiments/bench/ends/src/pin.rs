//! Where the two ends of a measurement run. It matters more than most of what is measured.

use std::fmt;

use anyhow::{Result, ensure};
use clap::ValueEnum;
use rustix::process::Pid;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use serde::{Deserialize, Serialize};

/// Which CPUs client and server stay on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pin {
    /// Both on one CPU: the time is the total work of both.
    Same,
    /// One CPU each: the time includes waking the other CPU.
    Split,
    /// Where the scheduler puts them; jumps between the other two.
    None,
}

impl fmt::Display for Pin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Same => "same",
            Self::Split => "split",
            Self::None => "none",
        })
    }
}

/// The CPUs of client and server; an error where the machine has too few.
pub fn cpus(pin: Pin) -> Result<[Option<usize>; 2]> {
    let allowed = sched_getaffinity(None)?;
    let mut allowed = (0..CpuSet::MAX_CPU).filter(|cpu| allowed.is_set(*cpu));
    let (first, second) = (allowed.next(), allowed.next());
    match pin {
        Pin::Same => Ok([first, first]),
        Pin::None => Ok([None, None]),
        Pin::Split => {
            ensure!(second.is_some(), "pin split needs two CPUs");
            Ok([first, second])
        }
    }
}

/// Keeps this thread, and those that it starts from now on, on `cpu`.
pub fn stay_on(cpu: Option<usize>) -> Result<()> {
    cpu.map_or(Ok(()), |cpu| keep(None, cpu))
}

/// Moves all threads of another process to `cpu`.
pub fn move_to(process: u32, cpu: Option<usize>) -> Result<()> {
    let Some(cpu) = cpu else { return Ok(()) };
    for thread in std::fs::read_dir(format!("/proc/{process}/task"))? {
        let thread = thread?.file_name().to_string_lossy().parse()?;
        keep(Pid::from_raw(thread), cpu)?;
    }
    Ok(())
}

fn keep(thread: Option<Pid>, cpu: usize) -> Result<()> {
    ensure!(cpu < CpuSet::MAX_CPU, "there is no CPU {cpu}");
    let mut set = CpuSet::new();
    set.set(cpu);
    Ok(sched_setaffinity(thread, &set)?)
}
