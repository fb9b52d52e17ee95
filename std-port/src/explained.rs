//! Why calls of typed clients fail.

use std::ops::{ControlFlow, DerefMut};
use std::sync::{Mutex, MutexGuard, PoisonError};

use cara_core::distribution::failure::Failure;
use cara_core::distribution::function::Signature;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::typed::{BlockingCaller, Caller, WatchingCaller};

use crate::heart::Hold;
use crate::peer::Peer;

/// A peer for typed clients that keeps why the last call failed: their errors have its code alone. A function that declares a
/// [`TypedCall`](crate::TypedCall) needs none: its `watch_…` fails with text and values.
///
/// ```no_run
/// use cara_std::{Explained, ServiceError, interface};
///
/// #[interface]
/// trait Door {
///     fn open(&mut self) -> Result<(), ServiceError>;
/// }
///
/// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
/// let door = Explained::new(depot.s_unit("door")?);
/// if let Err(error) = DoorClient::at(&door).open() {
///     println!("{error}: {:?}", door.take_failure());
/// }
/// # Ok::<(), cara_std::BuildError>(())
/// ```
///
/// It is for one call at a time. Of a call that is held it knows the code alone.
#[derive(Debug)]
pub struct Explained<T: Send + 'static = ()> {
    peer: Peer<T>,
    last: Mutex<Option<Failure>>,
}

impl<T: Send + 'static> Explained<T> {
    /// For the clients of this peer.
    pub const fn new(peer: Peer<T>) -> Self {
        Self { peer, last: Mutex::new(None) }
    }

    /// What the service has said of the failure of the last call, once; `None` where that has succeeded or it said nothing.
    pub fn take_failure(&self) -> Option<Failure> {
        self.last().take()
    }

    fn last(&self) -> MutexGuard<'_, Option<Failure>> {
        self.last.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T: Send + 'static> Caller for Explained<T> {
    fn published<R>(&self, function: &str, look: impl Fn(Option<Signature<'_>>) -> R) -> R {
        self.peer.published(function, look)
    }

    fn room(bytes: usize) -> Option<impl DerefMut<Target = ParametersView> + Send> {
        Peer::<T>::room(bytes)
    }

    fn send(&self, function: &str, parameters: &ParametersView, options: &RequestOptions) -> Result<CallId, Error> {
        self.peer.send(function, parameters, options)
    }
}

impl<T: Send + 'static> BlockingCaller for Explained<T> {
    type Hold = Hold<T>;

    fn block(&self, function: &str, parameters: &mut ParametersView, options: &RequestOptions) -> Result<(), Error> {
        *self.last() = None;
        let go_on = |_: &ParametersView| ControlFlow::Continue(());
        let mut why = None;
        let outcome = self.peer.block_watched(function, parameters, options, go_on, &mut why);
        *self.last() = why;
        outcome
    }

    fn block_and_hold(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<Hold<T>, Error> {
        *self.last() = None;
        self.peer.block_and_hold(function, parameters, options)
    }
}

#[cfg(feature = "async")]
impl<T: Send + 'static> cara_core::typed::AwaitedCaller for Explained<T> {
    async fn call(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<(), Error> {
        *self.last() = None;
        let options = RequestOptions { progress: true, ..*options };
        let mut call = self.peer.request_async(function, parameters, &options)?;
        let outcome = (&mut call).await;
        *self.last() = call.failure().map(|failure| *failure);
        outcome
    }
}
