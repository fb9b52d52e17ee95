//! What a motor's interrupt looks at: may this motion go on?

use core::fmt;
use core::future::poll_fn;
use core::task::Poll;

use cara_core::services::lease::{Ended, Lease, Order, Stage};
use cara_core::services::session::Incoming;

use crate::handle::Handle;
use crate::time::now;

/// The lease of one call, to be read from any task and any interrupt: a few atomic loads and the clock. Once dead it is
/// dead for ever, whatever call comes next.
///
/// An interrupt reads the static of the service, for whichever call holds it now:
///
/// ```
/// use cara_core::services::lease::Lease;
/// static GO_TO: Lease = Lease::new();
/// # let now = cara_core::time::Instant::START;
/// if !GO_TO.is_live(now) {
///     // Cut the motor's power.
/// }
/// ```
#[derive(Clone, Copy)]
pub struct LeaseWatch {
    lease: &'static Lease,
    order: Order,
}

impl LeaseWatch {
    /// A call's hold of the lease of its service.
    pub(crate) fn new(lease: Option<&'static Lease>, call: &Incoming) -> Option<Self> {
        lease.zip(call.order).map(|(lease, order)| Self { lease, order })
    }

    /// Does what the call wants to change, or nothing once its order has ended.
    pub fn commit<R>(&self, change: impl FnOnce() -> R) -> Result<R, Ended> {
        if self.is_live() { Ok(change()) } else { Err(Ended) }
    }

    /// Whether the caller still wants what this call started. Once it has said no, it says so for ever.
    pub fn is_live(&self) -> bool {
        self.lease.is_live_for(self.order, now())
    }

    /// What may be done for it: see [`Lease::stage`].
    pub fn stage(&self) -> Stage {
        self.lease.stage_for(self.order, now())
    }
}

impl<T> Handle<T> {
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
            self.shared.machine.borrow_mut().wakers.leases.register(cx.waker());
            Poll::Pending
        })
        .await;
    }
}

impl fmt::Debug for LeaseWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "LeaseWatch(live: {})", self.is_live())
    }
}
