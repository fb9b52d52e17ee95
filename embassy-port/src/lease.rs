//! What a motor's interrupt looks at: may this motion go on?

use core::fmt;

use cara_core::services::lease::{Ended, Lease, Order, Stage};
use cara_core::services::session::Incoming;

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
    pub(crate) lease: &'static Lease,
    pub(crate) order: Order,
}

impl LeaseWatch {
    /// A call's hold of the lease of its service.
    pub(crate) fn new(lease: Option<&'static Lease>, call: &Incoming) -> Option<Self> {
        lease.zip(call.order).map(|(lease, order)| Self { lease, order })
    }

    /// Runs `change` while the order lives, and nothing once it has ended.
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

impl fmt::Debug for LeaseWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "LeaseWatch(live: {})", self.is_live())
    }
}
