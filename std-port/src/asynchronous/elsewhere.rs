//! What blocks and cannot be asked to wake a task is done by a thread of its own.

use std::future::poll_fn;
use std::sync::{Arc, Mutex};
use std::task::{Poll, Waker};

use cara_core::error::Error;

use crate::error::{StartError, system_refused};
use crate::handle::Handle;
use crate::locks::lock;

impl<T: Send + 'static, R: 'static> Handle<T, R> {
    /// As [`start`](Self::start), on a thread of its own: a manager waits 300 ms for an answer of one with its identity, and
    /// longer where it takes over. Dropped before it has ended, the unit starts all the same.
    pub async fn start_async(&self) -> Result<(), StartError> {
        let unit = self.clone();
        on_a_thread(move || unit.start()).await?
    }

    /// As [`stop`](Self::stop), on a thread of its own: it ends when all threads of the unit have. Dropped before, the unit
    /// stops all the same.
    pub async fn stop_async(&self) -> Result<(), Error> {
        let unit = self.clone();
        on_a_thread(move || unit.stop()).await
    }
}

/// What the thread and the task share.
struct Shared<A> {
    outcome: Option<Result<A, Error>>,
    task: Option<Waker>,
}

/// Tells the task, also where the thread panics.
struct Notifier<A>(Arc<Mutex<Shared<A>>>);

impl<A> Drop for Notifier<A> {
    fn drop(&mut self) {
        let mut shared = lock(&self.0);
        shared.outcome.get_or_insert(Err(Error::NotRunning));
        let task = shared.task.take();
        drop(shared);
        task.into_iter().for_each(Waker::wake);
    }
}

async fn on_a_thread<A: Send + 'static>(run: impl FnOnce() -> A + Send + 'static) -> Result<A, Error> {
    let shared = Arc::new(Mutex::new(Shared { outcome: None, task: None }));
    let teller = Notifier(shared.clone());
    let work = move || {
        let outcome = run();
        lock(&teller.0).outcome = Some(Ok(outcome));
    };
    std::thread::Builder::new().name("cara-once".into()).spawn(work).map_err(system_refused)?;
    poll_fn(|cx| {
        let mut shared = lock(&shared);
        match shared.outcome.take() {
            Some(outcome) => Poll::Ready(outcome),
            None => {
                let earlier = shared.task.replace(cx.waker().clone());
                drop(shared);
                drop(earlier);
                Poll::Pending
            }
        }
    })
    .await
}
