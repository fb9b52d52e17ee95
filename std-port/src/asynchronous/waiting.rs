//! Waiting for nodes, for what they offer, for readers, and for events.

use cara_core::distribution::identity::Identity;
use cara_core::error::Error;
use cara_core::time::Duration;

use super::events::{EventQueue, EventStream};
use super::looking::{LinkWait, look_until};
use crate::communication_system::CommunicationSystem;
use crate::handle::Handle;
use crate::peer::Peer;
use crate::unit::Unit;

impl<T: Send + 'static, R> Handle<T, R> {
    /// Subscribes to events, as [`events`](Self::events) does, with the same room.
    ///
    /// ```no_run
    /// # async fn watch(depot: cara_std::CommunicationSystem) {
    /// use cara_std::UnitEvent;
    ///
    /// let mut events = depot.events_async();
    /// while let Some(event) = events.next().await {
    ///     match event {
    ///         Ok(UnitEvent::Left { peer, reason }) => eprintln!("{peer}: {reason}"),
    ///         Ok(_) => {}
    ///         Err(lost) => eprintln!("{lost}"),
    ///     }
    /// }
    /// # }
    /// ```
    pub fn events_async(&self) -> EventStream {
        let queue = EventQueue::new(self.events_waiting());
        let engine = self.engine();
        engine.events.subscribe_queue(&queue);
        if engine.is_stopping() {
            engine.events.end_queues();
        }
        EventStream::new(queue)
    }

    /// Ends when `condition` holds: it is looked at now and after each event of the unit, and must not wait.
    /// [`Error::NotRunning`] when the unit is stopped. Dropping the future loses nothing.
    ///
    /// ```no_run
    /// # async fn gather(depot: cara_std::CommunicationSystem) -> Result<(), cara_std::Error> {
    /// depot.wait_until_async(|| depot.number_of_s_units() >= 3).await
    /// # }
    /// ```
    pub async fn wait_until_async(&self, mut condition: impl FnMut() -> bool) -> Result<(), Error> {
        look_until(self.engine(), || condition().then_some(())).await
    }
}

impl<T: Send + 'static> CommunicationSystem<T> {
    /// The s_unit of a name, once it is connected and has told what it offers. [`Error::Ambiguous`] where several have that
    /// name, [`Error::NotRunning`] when this unit is stopped. It has no deadline of its own; dropping the future loses
    /// nothing.
    ///
    /// ```no_run
    /// # async fn meet(depot: cara_std::CommunicationSystem) -> Result<(), cara_std::Error> {
    /// let agv = depot.wait_for_s_unit_async("agv-07").await?;
    /// agv.wait_for_function_async("go_to").await?;
    /// # Ok(())
    /// # }
    /// ```
    pub async fn wait_for_s_unit_async(&self, name: &str) -> Result<Peer<T>, Error> {
        look_until(self.engine(), || self.s_unit_here(name)).await?
    }

    /// As [`publish_and_wait`](Self::publish_and_wait): ends when every connected node has read the list, or after `timeout`
    /// with the nodes that have not. Dropped before it has ended, the list is published all the same.
    pub async fn publish_and_wait_async(&self, timeout: impl Into<Duration>) -> Result<Vec<Identity>, Error> {
        let reported = self.engine().publish(None)?;
        let missing = LinkWait::new(self.engine(), timeout.into()).acknowledgements(reported).await;
        Ok(missing.iter().filter_map(|link| link.peer.get()).map(|peer| peer.identity.clone()).collect())
    }
}

impl<T: Send + 'static> Unit<T> {
    /// The manager, once it is connected and has told what it offers. [`Error::NotRunning`] when this unit is stopped.
    /// Dropping the future loses nothing.
    pub async fn wait_for_manager_async(&self) -> Result<Peer<T>, Error> {
        let here = || self.manager().filter(|manager| manager.cell.is_introduced());
        look_until(self.engine(), here).await
    }
}

impl<T: Send + 'static> Peer<T> {
    /// Ends when the node has published `function`, or has come with it. [`Error::NotRunning`] when this unit is stopped.
    /// Dropping the future loses nothing.
    pub async fn wait_for_function_async(&self, function: &str) -> Result<(), Error> {
        look_until(&self.engine, || self.offers(function).then_some(())).await
    }
}
