//! Calls of typed clients that another thread gives up.

use std::ops::{ControlFlow, DerefMut};

use cara_core::distribution::failure::Failure;
use cara_core::distribution::function::Signature;
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::requests::CallId;
use cara_core::services::session::RequestOptions;
use cara_core::typed::{BlockingCaller, Caller, WatchingCaller};

use crate::engine::details::{Canceller, Watch};
use crate::heart::Hold;
use crate::interfaces::parted;
use crate::peer::Peer;

/// A peer for typed clients whose calls another thread may give up: [`Peer::cancelled_by`] makes it.
///
/// ```no_run
/// use cara_std::{Canceller, ServiceError, interface};
///
/// #[interface]
/// trait Door {
///     fn open(&mut self) -> Result<(), ServiceError>;
/// }
///
/// # let depot = cara_std::CommunicationSystem::new("depot", 1)?;
/// let canceller = Canceller::new();
/// let button = canceller.clone();
/// std::thread::spawn(move || button.cancel());
/// let door = depot.s_unit("door")?.cancelled_by(&canceller);
/// if let Err(error) = DoorClient::at(&door).open() {
///     println!("{error}");
/// }
/// # Ok::<(), cara_std::BuildError>(())
/// ```
///
/// A call that waits, that is watched or that is held ends with [`Error::Cancelled`] within 20 ms: what it moves stops, and its
/// service is told. What was held before stays so, and a request that does not wait goes out.
#[derive(Clone, Debug)]
pub struct Cancellable<T: Send + 'static = ()> {
    pub(crate) peer: Peer<T>,
    pub(crate) canceller: Canceller,
}

impl<T: Send + 'static> Caller for Cancellable<T> {
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

impl<T: Send + 'static> BlockingCaller for Cancellable<T> {
    type Hold = Hold<T>;

    fn block(&self, function: &str, parameters: &mut ParametersView, options: &RequestOptions) -> Result<(), Error> {
        let outcome = self.peer.block_request_watched(function, parameters, options, &self.canceller, None);
        outcome.map_err(|failed| failed.error)
    }

    fn block_and_hold(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
    ) -> Result<Hold<T>, Error> {
        let mut watch = Watch { on_progress: None, canceller: &self.canceller, failure: None };
        let held = self.peer.engine.hold(self.peer.link()?, function, parameters, options, Some(&mut watch));
        held.map(Hold::new)
    }
}

impl<T: Send + 'static> WatchingCaller for Cancellable<T> {
    fn block_watched(
        &self,
        function: &str,
        parameters: &mut ParametersView,
        options: &RequestOptions,
        mut on_progress: impl FnMut(&ParametersView) -> ControlFlow<()>,
        why: &mut Option<Failure>,
    ) -> Result<(), Error> {
        let Self { peer, canceller } = self;
        let outcome = peer.block_request_watched(function, parameters, options, canceller, Some(&mut on_progress));
        outcome.map_err(|failed| parted(failed, why))
    }
}
