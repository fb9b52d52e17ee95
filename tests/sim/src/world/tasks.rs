//! The executor: futures of handlers and programs, polled at virtual instants on one thread, in the order of waking.

use std::collections::{BTreeMap, VecDeque};
use std::future::Future;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Wake, Waker};

use crate::event::HostId;

/// A future that a unit or the world runs.
pub(super) type Job = Pin<Box<dyn Future<Output = ()>>>;

/// Whose job it is: it ends with that life of that host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Owner {
    pub(super) host: HostId,
    pub(super) life: u32,
}

/// Jobs that are not over, and which of them are to be polled.
#[derive(Default)]
pub(super) struct Tasks {
    jobs: BTreeMap<u64, (Option<Owner>, Job)>,
    woken: Arc<Mutex<VecDeque<u64>>>,
    spawned: u64,
}

struct Waking {
    job: u64,
    woken: Arc<Mutex<VecDeque<u64>>>,
}

impl Wake for Waking {
    fn wake(self: Arc<Self>) {
        let mut woken = self.woken.lock().unwrap_or_else(PoisonError::into_inner);
        if !woken.contains(&self.job) {
            woken.push_back(self.job);
        }
    }
}

/// A job taken out to be polled, so that nothing is borrowed while it runs.
pub(super) struct Turn {
    number: u64,
    owner: Option<Owner>,
    job: Job,
    waker: Waker,
}

impl Turn {
    /// Polls it; gives it back unless it is over.
    pub(super) fn poll(mut self) -> Option<Self> {
        let polled = self.job.as_mut().poll(&mut Context::from_waker(&self.waker));
        match polled {
            Poll::Ready(()) => None,
            Poll::Pending => Some(self),
        }
    }

    pub(super) fn owner(&self) -> Option<Owner> {
        self.owner
    }
}

impl Tasks {
    /// Adds a job, which is polled for the first time in its turn.
    pub(super) fn spawn(&mut self, owner: Option<Owner>, job: Job) {
        self.spawned += 1;
        self.jobs.insert(self.spawned, (owner, job));
        self.wake(self.spawned);
    }

    /// The next job to poll.
    pub(super) fn next_turn(&mut self) -> Option<Turn> {
        loop {
            let number = self.woken.lock().unwrap_or_else(PoisonError::into_inner).pop_front()?;
            if let Some((owner, job)) = self.jobs.remove(&number) {
                let waker = Waker::from(Arc::new(Waking { job: number, woken: Arc::clone(&self.woken) }));
                return Some(Turn { number, owner, job, waker });
            }
        }
    }

    /// Keeps a job that waits for something.
    pub(super) fn keep(&mut self, turn: Turn) {
        self.jobs.insert(turn.number, (turn.owner, turn.job));
    }

    /// Takes out the jobs of a host, to be dropped where nothing is borrowed.
    pub(super) fn take_jobs_of(&mut self, host: HostId) -> Vec<Job> {
        let of_host = |owner: &Option<Owner>| owner.is_some_and(|owner| owner.host == host);
        let numbers: Vec<u64> = self.jobs.iter().filter(|(_, (owner, _))| of_host(owner)).map(|(n, _)| *n).collect();
        numbers.iter().filter_map(|number| self.jobs.remove(number)).map(|(_, job)| job).collect()
    }

    /// Takes out all jobs.
    pub(super) fn take_all(&mut self) -> Vec<Job> {
        std::mem::take(&mut self.jobs).into_values().map(|(_, job)| job).collect()
    }

    fn wake(&mut self, number: u64) {
        self.woken.lock().unwrap_or_else(PoisonError::into_inner).push_back(number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cell::RefCell;
    use std::rc::Rc;

    #[test]
    fn jobs_run_in_the_order_of_waking_and_end_with_their_host() {
        let order = Rc::new(RefCell::new(String::new()));
        let mut tasks = Tasks::default();
        for (name, host) in [("a", 0), ("b", 1), ("c", 0)] {
            let order = Rc::clone(&order);
            let owner = Owner { host: HostId(host), life: 0 };
            tasks.spawn(Some(owner), Box::pin(async move { order.borrow_mut().push_str(name) }));
        }
        drop(tasks.take_jobs_of(HostId(1)));
        while let Some(turn) = tasks.next_turn() {
            assert!(turn.poll().is_none());
        }
        assert_eq!(*order.borrow(), "ac");
    }

    #[test]
    fn a_job_that_wakes_itself_gets_another_turn() {
        let mut tasks = Tasks::default();
        let mut left = 3;
        tasks.spawn(
            None,
            Box::pin(std::future::poll_fn(move |context| {
                left -= 1;
                context.waker().wake_by_ref();
                if left == 0 { Poll::Ready(()) } else { Poll::Pending }
            })),
        );
        let mut turns = 0;
        while let Some(turn) = tasks.next_turn() {
            turns += 1;
            if let Some(turn) = turn.poll() {
                tasks.keep(turn);
            }
        }
        assert_eq!(turns, 3);
    }
}
