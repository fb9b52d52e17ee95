//! What the kernel tells of a process: threads, resident memory, CPU time.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use anyhow::{Context, Result};
use rustix::process::Pid;
use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};
use serde::Serialize;

/// How often the number of threads is looked at.
const LOOK: Duration = Duration::from_millis(20);

/// Resident memory of a process.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct Memory {
    /// `VmRSS`: everything that is resident, code included.
    pub(crate) resident_kib: u64,
    /// `RssAnon`: of that, what the process has written itself.
    pub(crate) anonymous_kib: u64,
}

/// The resident memory of a process, from `/proc/PID/status`.
pub(crate) fn memory(pid: u32) -> Result<Memory> {
    Ok(Memory { resident_kib: status(pid, "VmRSS:")?, anonymous_kib: status(pid, "RssAnon:")? })
}

/// The threads that a process has now.
pub(crate) fn threads(pid: u32) -> Result<usize> {
    Ok(status(pid, "Threads:")? as usize)
}

fn status(pid: u32, field: &str) -> Result<u64> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/status"))?;
    let line = text.lines().find_map(|line| line.strip_prefix(field));
    let number = line.and_then(|line| line.split_whitespace().next());
    number.and_then(|number| number.parse().ok()).with_context(|| format!("no {field} for process {pid}"))
}

/// Keeps all threads of a process, and those that they start, on the CPU `cpu`, or on whichever they like.
pub(crate) fn pin(pid: u32, cpu: Option<usize>) -> Result<()> {
    let mut set = CpuSet::new();
    (0..CpuSet::MAX_CPU).filter(|any| cpu.is_none_or(|cpu| cpu == *any)).for_each(|cpu| set.set(cpu));
    for task in std::fs::read_dir(format!("/proc/{pid}/task"))? {
        let task = task?.file_name().to_string_lossy().parse().ok().and_then(Pid::from_raw);
        // A thread that has ended meanwhile stays nowhere.
        let _ = sched_setaffinity(task, &set);
    }
    Ok(())
}

/// The first two CPUs that this process may use; twice the same where there is one only.
pub(crate) fn two_cpus() -> Result<[usize; 2]> {
    let allowed = sched_getaffinity(None)?;
    let mut allowed = (0..CpuSet::MAX_CPU).filter(|cpu| allowed.is_set(*cpu));
    let first = allowed.next().context("no CPU is allowed")?;
    Ok([first, allowed.next().unwrap_or(first)])
}

/// CPU time of a process, all threads that it has now, from `/proc/PID/schedstat` of each of them.
pub(crate) fn cpu_time(pid: u32) -> Result<Duration> {
    let mut nanos = 0;
    for task in std::fs::read_dir(format!("/proc/{pid}/task"))? {
        // A thread that has ended meanwhile has no file any more.
        let Ok(text) = std::fs::read_to_string(task?.path().join("schedstat")) else { continue };
        nanos += text.split_whitespace().next().and_then(|nanos| nanos.parse().ok()).unwrap_or(0);
    }
    Ok(Duration::from_nanos(nanos))
}

/// CPU time of this process.
pub(crate) fn own_cpu_time() -> Result<Duration> {
    cpu_time(std::process::id())
}

/// The most threads that a process has had while it was watched.
pub(crate) struct ThreadWatch {
    most: Arc<AtomicUsize>,
    over: Arc<AtomicBool>,
    watch: Option<JoinHandle<()>>,
}

impl ThreadWatch {
    pub(crate) fn new(pid: u32) -> Self {
        let (most, over) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicBool::new(false)));
        let (recorded, ended) = (most.clone(), over.clone());
        let watch = std::thread::spawn(move || {
            while let (false, Ok(count)) = (ended.load(Ordering::Relaxed), threads(pid)) {
                recorded.fetch_max(count, Ordering::Relaxed);
                std::thread::sleep(LOOK);
            }
        });
        Self { most, over, watch: Some(watch) }
    }

    pub(crate) fn most(&self) -> usize {
        self.most.load(Ordering::Relaxed)
    }
}

impl Drop for ThreadWatch {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        drop(self.watch.take().map(JoinHandle::join));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernel_tells_of_this_process() {
        let pid = std::process::id();
        let before = memory(pid).unwrap();
        let block = vec![1_u8; 8 << 20];
        let after = memory(pid).unwrap();
        assert!(std::hint::black_box(&block).iter().all(|byte| *byte == 1));
        let grown = after.resident_kib.saturating_sub(before.resident_kib);
        assert!((7 << 10..16 << 10).contains(&grown), "{grown} KiB for 8 MiB");
        assert!(threads(pid).unwrap() >= 1);
        assert!(own_cpu_time().unwrap() > Duration::ZERO);
        assert!(memory(u32::MAX).is_err());
    }

    #[test]
    fn the_most_threads_are_remembered() {
        let watch = ThreadWatch::new(std::process::id());
        let wait = std::time::Instant::now() + Duration::from_secs(20);
        let more: Vec<_> = (0..8).map(|_| std::thread::spawn(std::thread::park)).collect();
        while watch.most() < 9 {
            assert!(std::time::Instant::now() < wait, "{}", watch.most());
            std::thread::sleep(Duration::from_millis(1));
        }
        more.into_iter().for_each(|thread| {
            thread.thread().unpark();
            thread.join().unwrap();
        });
        assert!(watch.most() >= 9);
    }
}
