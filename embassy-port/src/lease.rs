//! What a motor's interrupt looks at: may this motion go on?

use core::fmt;

use cara_core::services::lease::Lease;

use crate::time::now;

/// A service's lease, to be read from any task and any interrupt: two atomic loads and the clock.
///
/// An interrupt that has no `LeaseWatch` at hand reads the static itself:
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
}

impl LeaseWatch {
    /// Whether the caller still wants what it started.
    pub fn is_live(&self) -> bool {
        self.lease.is_live(now())
    }
}

impl fmt::Debug for LeaseWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "LeaseWatch(live: {})", self.is_live())
    }
}
