//! Who reads a link: the pool through epoll, or one waiting caller, the leader, by itself.
//!
//! A caller that waits for a reply takes the lead if nobody has it: the link is taken out of the pool's hands
//! (disarmed), and the caller blocks in reading it. When it leaves, it passes the lead to another waiting caller, or
//! gives the link back to the pool (arms it). The decisions stand here, without any threads, so that they can be
//! checked by a model: at every moment somebody reads the link, or has been told to.

/// What the link's registration in the epoll set is to be, and who has the lead.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Reader {
    /// A caller blocks in reading the link.
    led: bool,
    /// A caller has been woken to take the lead and has not yet done so.
    passed: bool,
}

impl Reader {
    pub(crate) const fn new() -> Self {
        Self { led: false, passed: false }
    }

    /// A caller reads the link, or is about to: the pool keeps off.
    pub(crate) const fn is_led(self) -> bool {
        self.led
    }

    /// The pool is to be told when there is something to read.
    pub(crate) const fn pool_reads(self) -> bool {
        !self.led && !self.passed
    }

    /// A caller whose reply has not come asks for the lead.
    pub(crate) fn take_lead(&mut self) -> bool {
        if self.led {
            return false;
        }
        self.led = true;
        self.passed = false;
        true
    }

    /// A caller leaves. If it led, or if the lead was passed to it or another and not taken yet, `pass` wakes the next
    /// waiting caller and tells whether there is one; otherwise the pool reads.
    pub(crate) fn leave(&mut self, leading: bool, pass: impl FnOnce() -> bool) {
        if leading {
            self.led = false;
        }
        if leading || (!self.led && self.passed) {
            self.passed = pass() && !cfg!(cara_planted = "lost_wakeup");
        }
    }
}
