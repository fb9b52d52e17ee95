//! What a caller waits on: the reply of one call, or a point in time or event that has come.

use std::cell::RefCell;
use std::future::Future;
use std::pin::Pin;
use std::rc::Rc;
use std::task::{Context, Poll, Waker};

use cara_core::services::call::{self, Detail};
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

    /// Whether it is known; if not, the task of `context` is woken when it is.
    pub(super) fn is_kept(&self, context: &Context<'_>) -> bool {
        let mut state = self.0.borrow_mut();
        if state.value.is_none() {
            state.waker = Some(context.waker().clone());
        }
        state.value.is_some()
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

/// Why a call in the simulator has no results.
pub type CallError = call::CallError<(), Option<Detail>>;

/// A call in flight: a copy of the caller's parameters that the results are put into.
pub(super) struct Waiting {
    pub(super) parameters: BoxedParameters,
    pub(super) promise: Promise<Result<BoxedParameters, Box<CallError>>>,
    /// The newest that it has told, until it is looked at.
    pub(super) progress: Newest,
}

/// What a call has told last, and what waits for it.
#[derive(Clone, Default)]
pub(super) struct Newest(Rc<RefCell<(Option<BoxedParameters>, Option<Waker>)>>);

impl Newest {
    pub(super) fn put(&self, values: BoxedParameters) {
        let mut state = self.0.borrow_mut();
        state.0 = Some(values);
        state.1.take().into_iter().for_each(Waker::wake);
    }

    /// Takes it; without one, the task of `context` is woken by the next.
    pub(super) fn take(&self, context: &Context<'_>) -> Option<BoxedParameters> {
        let mut state = self.0.borrow_mut();
        let values = state.0.take();
        if values.is_none() {
            state.1 = Some(context.waker().clone());
        }
        values
    }
}

impl Waiting {
    pub(super) fn finish(mut self, result: Result<ReplyBlock<'_>, CallError>) {
        let result = match result.map(|block| block.read_into(&mut self.parameters)) {
            Ok(Ok(())) => Ok(self.parameters),
            Ok(Err(error)) => Err(Box::new(error.into())),
            Err(failure) => Err(Box::new(failure)),
        };
        self.promise.keep(result);
    }
}
