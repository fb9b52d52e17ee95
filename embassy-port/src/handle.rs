//! What tasks do with a unit, in the words of the Linux port.

use core::fmt;
use core::future::poll_fn;
use core::net::SocketAddrV4;
use core::task::Poll;

use cara_core::config::Constraints;
use cara_core::counters::Counter;
use cara_core::distribution::claim::Claim;
use cara_core::distribution::connection_handler::{Finding, NodeCounter};
use cara_core::distribution::identity::Identity;
use cara_core::error::Error;
use cara_core::host::connections::LinkCounter;
use cara_core::services::Port;
use cara_core::services::access::Access;
use cara_core::time::Duration;

use crate::config::Table;
use crate::event::UnitEvent;
use crate::handler::Hook;
use crate::lease::LeaseWatch;
use crate::machine::{Machine, Shared};
use crate::port::Board;

/// A unit, for any task of the executor that its runner runs on. Copies are the same unit.
pub struct Handle<T: 'static = ()> {
    pub(crate) shared: &'static Shared<T>,
}

impl<T> Clone for Handle<T> {
    fn clone(&self) -> Self {
        *self
    }
}

impl<T> Copy for Handle<T> {}

impl<T> fmt::Debug for Handle<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.identity())
    }
}

impl<T> Handle<T> {
    /// Changes the unit, and has the runner look again.
    pub(crate) fn act<R>(&self, act: impl FnOnce(&mut Machine<T>) -> R) -> R {
        let mut machine = self.shared.machine.borrow_mut();
        let result = act(&mut machine);
        machine.wake_runner();
        result
    }

    /// Lends the unit to a task that waits. The runner looks again only for what is dropped meanwhile, with a waker that gives way.
    pub(crate) fn lend<R>(&self, act: impl FnOnce(&mut Machine<T>) -> R) -> R {
        let mut machine = self.shared.machine.borrow_mut();
        let result = act(&mut machine);
        if self.shared.unwanted.is_due() {
            machine.wake_runner();
        }
        result
    }

    pub(crate) fn look<R>(&self, look: impl FnOnce(&Machine<T>) -> R) -> R {
        look(&self.shared.machine.borrow())
    }

    /// This unit's identity.
    pub fn identity(&self) -> Identity {
        self.look(|machine| machine.hub.node.identity().clone())
    }

    /// Searches for nodes, or for the manager, now (paper, listing line 6).
    pub fn broadcast(&self) {
        self.act(|machine| machine.hub.node.broadcast(crate::now()));
    }

    /// Ends every link in an orderly way, and stops searching. The unit starts again only with a restart of the board.
    pub fn stop(&self) {
        self.act(Machine::stop);
    }

    /// The claim of an m_unit, or the highest that an s_unit has obeyed.
    pub fn claim(&self) -> Claim {
        self.look(|machine| machine.hub.node.claim())
    }

    /// How many links the unit has room for.
    pub fn links(&self) -> u16 {
        self.look(|machine| machine.indices().end)
    }

    /// Waits until `done` holds of the unit, looking whenever a peer comes, goes or changes its list. Cancelling loses
    /// nothing.
    pub async fn wait_until(&self, mut done: impl FnMut(&Self) -> bool) {
        poll_fn(|cx| {
            if done(self) {
                return Poll::Ready(());
            }
            self.lend(|machine| machine.wakers.news.register(cx));
            Poll::Pending
        })
        .await;
    }

    /// Runs `act` with the application's state. [`Error::WouldDeadlock`] inside of a service that has it already.
    pub fn with_state<R>(&self, act: impl FnOnce(&mut T) -> R) -> Result<R, Error> {
        let mut state = self.shared.state.try_borrow_mut().map_err(|_| Error::WouldDeadlock)?;
        Ok(act(&mut state))
    }

    /// Runs `hook` each time a peer, such as the manager, is lost, once, before anything else is done about it. It must
    /// be short.
    pub fn on_manager_lost(&self, hook: &'static Hook<T>) {
        self.act(|machine| machine.lost_hook = Some(hook));
    }

    /// What no call returns: joined, left, failed. One task reads them; when it does not keep up, new ones are lost and
    /// counted in [`Self::events_lost`]. Cancelling loses nothing.
    pub async fn next_event(&self) -> UnitEvent {
        poll_fn(|cx| {
            self.lend(|machine| match machine.events.take() {
                Some(event) => Poll::Ready(event),
                None => {
                    machine.wakers.events.register(cx.waker());
                    Poll::Pending
                }
            })
        })
        .await
    }

    /// Events that were lost because they were not read in time.
    pub fn events_lost(&self) -> u32 {
        self.look(|machine| machine.events.lost)
    }

    /// What an order ([`Served::lease`](crate::Served::lease)) has started is finished: it ends, no hook runs, and its caller is told
    /// so. `false` for one that has ended before, as when a newer call has replaced it.
    pub fn end_order(&self, order: &LeaseWatch) -> bool {
        self.act(|machine| {
            let mut is_finished = false;
            machine.each_link(|session, cx| is_finished |= session.end_order(cx, order.lease, order.order));
            machine.wakers.leases.wake();
            is_finished
        })
    }

    /// Ends when a lease of one of this unit's calls is dead; never without one. Cancelling loses nothing.
    pub(crate) async fn lease_ended(&self, lease: Option<LeaseWatch>) {
        poll_fn(|cx| {
            let Some(lease) = lease else { return Poll::Pending };
            if !lease.is_live() {
                return Poll::Ready(());
            }
            self.lend(|machine| machine.wakers.leases.register(cx));
            Poll::Pending
        })
        .await;
    }

    /// The constraints in force.
    pub fn constraints(&self) -> Constraints {
        self.look(|machine| *machine.hub.node.constraints())
    }

    /// Changes the constraints; peers are told. [`Error::DoesNotFit`] for what the memory cannot hold.
    pub fn set_constraints(&self, constraints: Constraints) -> Result<(), Error> {
        self.act(|machine| {
            machine.limits.fit(&constraints)?;
            machine.hub.node.set_constraints(constraints);
            machine.each_link(|session, cx| session.set_constraints(cx, constraints));
            Ok(())
        })
    }

    /// Another access table, or none: in force when this returns.
    pub fn set_access(&self, table: Option<&'static dyn Access>) {
        const { assert!(Board::HAS_ACCESS, "an access table needs the feature `access` of cara-embassy") };
        self.act(|machine| {
            machine.access = Table(table);
            machine.each_link(|session, cx| {
                session.access_changed(cx);
            });
        });
    }

    /// The keys of links that this unit opens from here on are made anew this often, instead of every 12 h, so that a test
    /// need not wait for so long.
    #[doc(hidden)]
    pub fn renew_keys_every(&self, span: Duration) {
        self.act(|machine| machine.renews_every = span);
    }

    /// What happened on all links, also on those that have ended.
    pub fn counted(&self, counter: LinkCounter) -> u64 {
        self.look(|machine| machine.counted(counter))
    }

    /// What happened in discovery and membership.
    pub fn node_counted(&self, counter: NodeCounter) -> u64 {
        self.look(|machine| machine.hub.node.counters.value(counter))
    }

    /// Everything that is counted, in discovery and membership and on all links: (name, number), zeros included.
    pub fn counters(&self) -> impl Iterator<Item = (&'static str, u64)> + use<T> {
        let unit = *self;
        let node = NodeCounter::ALL.iter().map(move |counter| (counter.name(), unit.node_counted(*counter)));
        node.chain(LinkCounter::ALL.iter().map(move |counter| (counter.name(), unit.counted(*counter))))
    }

    /// The last refusals.
    pub fn findings(&self) -> impl Iterator<Item = Finding<SocketAddrV4>> + use<T> {
        let unit = *self;
        (0..).map_while(move |index| unit.look(|machine| machine.hub.node.findings().nth(index).cloned()))
    }
}
