//! The paper's `Unit`: an s_unit, which connects to one m_unit, its manager.

use std::sync::Arc;

use cara_core::distribution::identity::{Identity, Role};
use cara_core::distribution::parameters::ParametersView;
use cara_core::error::Error;
use cara_core::services::requests::CallId;

use crate::builder::{BuildError, Builder, manager};
use crate::growing::CallParameters;
use crate::handle::{Handle, SUnit, WeakHandle};
use crate::peer::Peer;

/// An s_unit, which connects to one m_unit, its manager.
pub type Unit<T = ()> = Handle<T, SUnit>;

/// A handle to an s_unit that does not keep it running.
pub type WeakUnit<T = ()> = WeakHandle<T, SUnit>;

impl Unit {
    /// An s_unit with defaults, which joins the manager of the given name and id and no other.
    ///
    /// ```no_run
    /// let agv = cara_std::Unit::new("agv", 7, "depot", 1)?;
    /// agv.start()?;
    /// # Ok::<(), cara_std::BuildError>(())
    /// ```
    pub fn new(name: &str, id: u32, manager_name: &str, manager_id: u32) -> Result<Self, BuildError> {
        Self::builder(name, id, manager_name, manager_id)?.build()
    }

    /// An s_unit with other than defaults.
    pub fn builder(name: &str, id: u32, manager_name: &str, manager_id: u32) -> Result<Builder<(), SUnit>, BuildError> {
        Ok(Builder::new(Identity::s_unit(name, id)?, manager(manager_name, manager_id)?))
    }
}

impl<T: Send + 'static> Unit<T> {
    /// The manager, once it has been met.
    pub fn manager(&self) -> Option<Peer<T>> {
        let peers = self.engine().nodes.read();
        let cell = peers.of_role(Role::MUnit).next().cloned();
        cell.map(|cell| Peer { engine: self.engine().clone(), cell })
    }

    /// Whether the manager is connected.
    pub fn is_connected(&self) -> bool {
        self.manager().is_some_and(|manager| manager.is_connected())
    }

    /// Calls a function of the manager and waits for its results.
    #[doc(alias = "block_request_their_function")]
    pub fn block_request(&self, function: &str, parameters: &mut (impl CallParameters + ?Sized)) -> Result<(), Error> {
        self.manager().ok_or(Error::NotConnected)?.block_request(function, parameters)
    }

    /// Calls a function of the manager without waiting.
    #[doc(alias = "request_their_function")]
    pub fn request(&self, function: &str, parameters: &ParametersView) -> Result<CallId, Error> {
        self.manager().ok_or(Error::NotConnected)?.request(function, parameters)
    }

    /// Makes the unit's functions visible to its manager, now or when it comes.
    pub fn publish_my_function_list(&self) -> Result<(), Error> {
        self.engine().publish(None).map(|_| ())
    }

    /// Runs `hook` each time the manager is lost, once, with the application's state, for which it may have to wait: what
    /// makes safe belongs into the hook of a [lease](crate::ServiceOptions::lease). [`Error::Network`] when the system
    /// refuses the thread that it runs on.
    pub fn on_manager_lost(&self, hook: impl Fn(&mut T) + Send + Sync + 'static) -> Result<(), Error> {
        self.engine().services.afterwards.on_lost(Arc::new(hook))
    }
}
