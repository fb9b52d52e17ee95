//! What a caller waits on: the reply of one call, or a point in time or event that has come.

use std::cell::RefCell;
use std::future::Future;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll, Waker};

use cara_core::error::Error;
use cara_core::services::session::ReplyBlock;

use super::service::BoxedParameters;

/// A value that is set once, which wakes its waiter.
pub(super) struct Promise<T>(Rc<RefCell<State<T>>>);

struct State<T> {
    value: Option<T>,
    waker: Option<Waker>,
}

impl<T> Clone for Promise<T> {
    fn clone(&self) -> Self {
        Self(Rc::clone(&self.0))
    }
}

impl<T> Promise<T> {
    pub(super) fn new() -> Self {
        Self(Rc::new(RefCell::new(State { value: None, waker: None })))
    }

    /// Makes it known; only the first value counts.
    pub(super) fn keep(&self, value: T) {
        let mut state = self.0.borrow_mut();
        if state.value.is_none() {
            state.value = Some(value);
            if let Some(waker) = state.waker.take() {
                waker.wake();
            }
        }
    }
}

impl<T> Future for Promise<T> {
    type Output = T;

    fn poll(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<T> {
        let mut state = self.0.borrow_mut();
        match state.value.take() {
            Some(value) => Poll::Ready(value),
            None => {
                state.waker = Some(context.waker().clone());
                Poll::Pending
            }
        }
    }
}

/// A call in flight: a copy of the caller's parameters that the results are put into.
pub(super) struct Waiting {
    pub(super) parameters: BoxedParameters,
    pub(super) promise: Promise<Result<BoxedParameters, Error>>,
}

impl Waiting {
    pub(super) fn finish(mut self, result: Result<ReplyBlock<'_>, Error>) {
        let result = result.and_then(|block| block.read_into(&mut self.parameters));
        self.promise.keep(result.map(|()| self.parameters));
    }
}
