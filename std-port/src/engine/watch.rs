//! Whether the clock looks at what threads do, without its being told of each call.

use super::atomic::{AtomicBool, Ordering};

/// On as long as something happens that may need the clock.
#[derive(Debug, Default)]
pub(super) struct Watch {
    /// Something has happened since it last looked.
    used: AtomicBool,
    looking: AtomicBool,
}

impl Watch {
    /// Something happens. `true` where the clock must be told to look again.
    pub(super) fn begins(&self) -> bool {
        // Where it has been noted already, whoever noted it has told the clock or found it looking.
        !self.used.swap(true, Ordering::SeqCst) && !self.looking.swap(true, Ordering::SeqCst)
    }

    /// Whether anything has happened since the last look. If not, whatever happens next tells the clock anew.
    pub(super) fn look(&self) -> bool {
        self.looking.store(false, Ordering::SeqCst);
        let used = self.used.swap(false, Ordering::SeqCst);
        if used {
            self.go_on();
        }
        used
    }

    /// The clock comes back without being told.
    pub(super) fn go_on(&self) {
        self.looking.store(true, Ordering::SeqCst);
    }

    pub(super) fn is_on(&self) -> bool {
        self.looking.load(Ordering::SeqCst)
    }
}
