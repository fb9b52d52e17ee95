//! What a motor's loop looks at: may this motion go on?

use std::fmt;
use std::sync::Arc;

use cara_core::services::lease::Lease;

use crate::clock::Clock;

/// A service's lease, to be read from any thread at any time: two atomic loads and the clock.
#[derive(Clone)]
pub struct LeaseWatch {
    lease: Arc<Lease>,
    clock: Clock,
}

impl LeaseWatch {
    pub(crate) fn new(lease: Arc<Lease>, clock: Clock) -> Self {
        Self { lease, clock }
    }

    /// Whether the caller still wants what it started.
    pub fn is_live(&self) -> bool {
        self.lease.is_live(self.clock.now())
    }
}

impl fmt::Debug for LeaseWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "LeaseWatch(live: {})", self.is_live())
    }
}
