//! Tasks of boards, polled in the order of waking.

use std::collections::{BTreeMap, VecDeque};
use std::future::Future;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, Wake, Waker};

/// What a board runs.
pub(crate) type Job = Pin<Box<dyn Future<Output = ()>>>;
type Woken = Arc<Mutex<VecDeque<u64>>>;

/// Tasks that are not over.
#[derive(Default)]
pub(crate) struct Tasks {
    tasks: BTreeMap<u64, Task>,
    woken: Woken,
    spawned: u64,
}

/// A task, taken out while it is polled.
pub(crate) struct Task {
    number: u64,
    board: usize,
    job: Job,
    waker: Waker,
}

struct Waking {
    number: u64,
    woken: Woken,
}

impl Wake for Waking {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        let mut woken = self.woken.lock().unwrap_or_else(PoisonError::into_inner);
        if !woken.contains(&self.number) {
            woken.push_back(self.number);
        }
    }
}

impl Task {
    pub(crate) fn board(&self) -> usize {
        self.board
    }

    pub(crate) fn wake(&self) {
        self.waker.wake_by_ref();
    }

    /// Polls it; gives it back unless it is over.
    pub(crate) fn poll(mut self) -> Option<Self> {
        match self.job.as_mut().poll(&mut Context::from_waker(&self.waker)) {
            Poll::Ready(()) => None,
            Poll::Pending => Some(self),
        }
    }
}

impl Tasks {
    pub(crate) fn spawn(&mut self, board: usize, job: impl Future<Output = ()> + 'static) {
        self.spawned += 1;
        let number = self.spawned;
        let waker = Waker::from(Arc::new(Waking { number, woken: Arc::clone(&self.woken) }));
        waker.wake_by_ref();
        self.tasks.insert(number, Task { number, board, job: Box::pin(job), waker });
    }

    /// The task that was woken first.
    pub(crate) fn next(&mut self) -> Option<Task> {
        loop {
            let number = self.woken.lock().unwrap_or_else(PoisonError::into_inner).pop_front()?;
            if let Some(task) = self.tasks.remove(&number) {
                return Some(task);
            }
        }
    }

    pub(crate) fn keep(&mut self, task: Task) {
        self.tasks.insert(task.number, task);
    }

    /// Takes out the tasks of a board, to be dropped where nothing is borrowed.
    pub(crate) fn take_all_of(&mut self, board: usize) -> Vec<Task> {
        let numbers: Vec<u64> =
            self.tasks.values().filter(|task| task.board == board).map(|task| task.number).collect();
        numbers.iter().filter_map(|number| self.tasks.remove(number)).collect()
    }
}
