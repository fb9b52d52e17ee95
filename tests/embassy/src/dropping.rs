//! Tasks that end with their last waker, as executors on the heap have them.

use std::any::Any;
use std::cell::RefCell;
use std::sync::Arc;
use std::task::{Wake, Waker};

thread_local! {
    static HELD: RefCell<Vec<Box<dyn Any>>> = const { RefCell::new(Vec::new()) };
}

struct Dropping;

impl Wake for Dropping {
    fn wake(self: Arc<Self>) {}
}

impl Drop for Dropping {
    fn drop(&mut self) {
        HELD.take();
    }
}

/// The waker of a task with `held` in its frame: the last clone drops it, on this thread. One at a time.
pub fn dropping(held: impl Any) -> Waker {
    hold(held);
    Waker::from(Arc::new(Dropping))
}

/// Puts more into the frame of that task.
pub fn hold(held: impl Any) {
    HELD.with_borrow_mut(|all| all.push(Box::new(held)));
}

/// Whether what the task has in its frame is still there.
pub fn is_held() -> bool {
    HELD.with_borrow(|held| !held.is_empty())
}
