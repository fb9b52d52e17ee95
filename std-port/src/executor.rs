//! Threads of their own for what must not wait for anything else of the application: started when a service is added, so
//! that starting them cannot fail when they are needed.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::error::system_refused;
use crate::locks::lock;
use cara_core::error::Error;

/// How long the end of a service waits for a thread that is inside one of its handlers.
const PATIENCE: Duration = Duration::from_secs(1);

type Job = Box<dyn FnOnce() + Send>;

/// One thread that runs what it is given, in order.
pub(crate) struct Executor {
    jobs: Mutex<Option<Sender<Job>>>,
    thread: OwnThread,
}

impl Executor {
    /// Starts the thread. [`Error::Network`] when the system refuses it.
    pub(crate) fn start(name: &str) -> Result<Self, Error> {
        let (sender, receiver): (Sender<Job>, Receiver<Job>) = channel();
        let thread = OwnThread::start(name, move || receiver.into_iter().for_each(|job| job()))?;
        Ok(Self { jobs: Mutex::new(Some(sender)), thread })
    }

    /// Leaves `job` to the thread; the caller bounds how many wait. It must not panic.
    pub(crate) fn run(&self, job: impl FnOnce() + Send + 'static) {
        if let Some(jobs) = lock(&self.jobs).as_ref() {
            // The thread ends only when there is no sender any more.
            let _ = jobs.send(Box::new(job));
        }
    }

    /// Ends the thread when what was left to it is done.
    pub(crate) fn end(&self) {
        drop(lock(&self.jobs).take());
        self.thread.join(PATIENCE);
    }
}

// Dropped without `end`, as when a service is replaced under a lock, its thread ends by itself.

/// A thread that is joined, unless it is stuck or ends itself.
pub(crate) struct OwnThread(Mutex<Option<JoinHandle<()>>>);

impl OwnThread {
    pub(crate) fn start(name: &str, run: impl FnOnce() + Send + 'static) -> Result<Self, Error> {
        Ok(std::thread::Builder::new().name(name.into()).spawn(run).map_err(system_refused)?.into())
    }

    #[cfg(feature = "control")]
    pub(crate) fn is_finished(&self) -> bool {
        lock(&self.0).as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Waits for the end of the thread; for one that is stuck in the application only so long.
    pub(crate) fn join(&self, patience: Duration) {
        let Some(thread) = self.0.lock().unwrap_or_else(PoisonError::into_inner).take() else { return };
        if thread.thread().id() == std::thread::current().id() {
            return;
        }
        let end = Instant::now() + patience;
        while !thread.is_finished() && Instant::now() < end {
            std::thread::sleep(Duration::from_millis(1));
        }
        match thread.is_finished() {
            true => drop(thread.join()),
            false => {
                tracing::error!(name = thread.thread().name(), "what runs on it does not return: the thread is left")
            }
        }
    }
}

impl From<JoinHandle<()>> for OwnThread {
    fn from(thread: JoinHandle<()>) -> Self {
        Self(Mutex::new(Some(thread)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lane_runs_what_it_was_given_in_order_and_before_it_ends() {
        let executor = Executor::start("test").unwrap();
        let (sender, receiver) = channel();
        for number in 0..100 {
            let sender = sender.clone();
            executor.run(move || sender.send(number).unwrap());
        }
        executor.end();
        drop(sender);
        assert_eq!(receiver.into_iter().collect::<Vec<_>>(), (0..100).collect::<Vec<_>>());
        executor.run(|| panic!("it has ended"));
    }

    #[test]
    fn a_lane_that_is_stuck_holds_no_stop_up_for_ever() {
        let (executor, (open, gate)) = (Executor::start("test").unwrap(), channel::<()>());
        executor.run(move || {
            let _ = gate.recv();
        });
        let began = Instant::now();
        executor.end();
        assert!(began.elapsed() >= PATIENCE);
        drop(open);
    }
}
