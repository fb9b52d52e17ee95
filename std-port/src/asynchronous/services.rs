//! Services whose handlers are futures.

use std::fmt;
use std::future::Future;
use std::marker::PhantomData;
use std::pin::Pin;
use std::sync::{Arc, Weak};
use std::task::{Context, Poll};

use cara_core::distribution::function::{Attributes, Signature};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::{Error, ServiceError};
use cara_core::typed::{AsyncFunctions, AsyncState};

use crate::actuator::Actuator;
use crate::engine::served::GivenUp;
use crate::engine::{Engine, Spawned};
use crate::growing::HandlerParameters;
use crate::handle::Handle;
use crate::handler::{IntoHandler, Run, RunOf, Served, ServiceOptions};
use crate::my_function_list::MyFunctionList;

impl<T: Send + 'static, R> Handle<T, R> {
    /// Has handlers that are futures run by an executor of the application, from here on. `spawn` is called by threads of the
    /// unit, outside of that executor, and must not wait. A task that it drops is answered with
    /// [`ServiceError::NotReady`].
    ///
    /// Without it a thread of the unit runs them, one at a time between their `await`s: enough for what only calls other
    /// nodes and waits for state or leases; timers and sockets of tokio need its own runtime.
    ///
    /// ```no_run
    /// # async fn serve(agv: cara_std::Unit) {
    /// let runtime = tokio::runtime::Handle::current();
    /// agv.run_services_on(move |task| drop(runtime.spawn(task)));
    /// # }
    /// ```
    pub fn run_services_on(&self, spawn: impl Fn(Spawned) + Send + Sync + 'static) {
        self.engine().services.runner.run_on(Arc::new(spawn));
    }

    /// As [`with_state`](Self::with_state): runs `act` with the application's state when its turn comes. `act` itself must not
    /// wait. [`Error::WouldDeadlock`] when this thread has the state already. Dropped before its turn, it gives the turn up.
    pub async fn with_state_async<A>(&self, act: impl FnOnce(&mut T) -> A) -> Result<A, Error> {
        self.engine().services.with_state_awaited(act).await
    }
}

impl<T> ServiceOptions<T> {
    /// A handler that is a future is not dropped when its call is given up, but told by [`Served::given_up`]: for one that has to
    /// end in order. What it returns then has no caller.
    pub const fn runs_to_its_end(mut self) -> Self {
        self.to_its_end = true;
        self
    }
}

impl Served {
    /// Ends when nothing wants the call any more: its caller waits no longer, its link has ended, or its order has. For a
    /// handler that is a future and [runs to its end](ServiceOptions::runs_to_its_end); any other such handler is dropped
    /// then. Of a call whose handler is no future it never ends. Dropping it loses nothing.
    pub fn given_up(&self) -> CallGivenUp {
        CallGivenUp(self.given_up.clone())
    }
}

/// The end of what a call is wanted for; see [`Served::given_up`].
#[derive(Clone, Debug)]
#[must_use = "it is awaited"]
pub struct CallGivenUp(Option<Arc<GivenUp>>);

impl Future for CallGivenUp {
    type Output = ();

    fn poll(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        self.0.as_ref().map_or(Poll::Pending, |given_up| given_up.poll(cx))
    }
}

/// Lends an `async fn` of an interface the unit's state. It does not keep the unit running.
pub struct StateOfTasks<T: Send + 'static> {
    engine: Weak<Engine<T>>,
    call: Served,
}

impl<T: Send + 'static> fmt::Debug for StateOfTasks<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StateOfTasks").field("call", &self.call).finish_non_exhaustive()
    }
}

impl<T: Send + 'static> AsyncState<T> for StateOfTasks<T> {
    async fn with<R: Send>(&self, act: impl FnOnce(&mut T) -> R + Send) -> Result<R, ServiceError> {
        let engine = self.engine.upgrade().ok_or(ServiceError::NotReady)?;
        Ok(engine.services.with_state_awaited(act).await?)
    }

    async fn commit<R: Send>(&self, change: impl FnOnce(&mut T) -> R + Send) -> Result<R, ServiceError> {
        Ok(self.with(|state| self.call.commit(|| change(state))).await??)
    }
}

impl<T: Send + 'static> AsyncFunctions<T> for MyFunctionList<'_, T> {
    type State = StateOfTasks<T>;
    type Room = Box<ParametersView>;

    fn add_task<W>(
        &self,
        signature: Signature<'static>,
        attributes: Attributes,
        actuator: Option<&Actuator>,
        run: fn(Served, StateOfTasks<T>, Box<ParametersView>) -> W,
    ) -> Result<(), Error>
    where
        W: Future<Output = Result<Box<ParametersView>, ServiceError>> + Send + 'static,
    {
        let engine = Arc::downgrade(self.engine);
        let run = move |call: Served, room: Box<ParametersView>| {
            let state = StateOfTasks { engine: engine.clone(), call: call.clone() };
            run(call, state, room)
        };
        self.add(signature, attributes, actuator, run)
    }
}

/// The form of a handler that is a future.
#[doc(hidden)]
pub struct Awaited<Form>(PhantomData<Form>);

impl<Form> fmt::Debug for Awaited<Form> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Awaited")
    }
}

impl<T, F, W, P: HandlerParameters> IntoHandler<T, Awaited<fn(P) -> W>> for F
where
    F: Fn(P) -> W + Send + Sync + 'static,
    W: Future<Output = P> + Send + 'static,
{
    fn into_run(self) -> RunOf<T> {
        by_value(move |_, arguments| {
            let work = self(arguments);
            async move { Ok(work.await) }
        })
    }
}

impl<T, F, W, P: HandlerParameters> IntoHandler<T, Awaited<fn(Served, P) -> W>> for F
where
    F: Fn(Served, P) -> W + Send + Sync + 'static,
    W: Future<Output = Result<P, ServiceError>> + Send + 'static,
{
    fn into_run(self) -> RunOf<T> {
        by_value(self)
    }
}

impl<T, F, W> IntoHandler<T, Awaited<fn(Served, Box<ParametersView>) -> W>> for F
where
    F: Fn(Served, Box<ParametersView>) -> W + Send + Sync + 'static,
    W: Future<Output = Result<Box<ParametersView>, ServiceError>> + Send + 'static,
{
    fn into_run(self) -> RunOf<T> {
        RunOf(Run::Task(Arc::new(move |call, arguments| Box::pin(self(call, arguments)))))
    }
}

fn by_value<T, W, P: HandlerParameters>(service: impl Fn(Served, P) -> W + Send + Sync + 'static) -> RunOf<T>
where
    W: Future<Output = Result<P, ServiceError>> + Send + 'static,
{
    RunOf(Run::Task(Arc::new(move |call, mut view| {
        let mut arguments = P::empty();
        let filled = arguments.fill(&view);
        let work = filled.map(|()| service(call, arguments));
        Box::pin(async move {
            let mut results = work.map_err(|_| ServiceError::BadResults)?.await?;
            view.copy_from(results.view_mut()).map_err(|_| ServiceError::BadResults)?;
            Ok(view)
        })
    })))
}
