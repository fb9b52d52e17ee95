//! What can go wrong with a frame, and how often it did.

use std::fmt;

use cara_core::time::Duration;

/// What happens to the frames that a port sends. Each copy of a frame, one for each port that it goes to, is drawn for
/// by itself. Shares are from 0.0, never, to 1.0, always.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Faults {
    /// The share of frames that do not arrive.
    pub loss: f64,
    /// How long each frame travels.
    pub delay: Duration,
    /// A random span below this comes on top. By itself it lets no frame overtake another.
    pub jitter: Duration,
    /// The share of frames that arrive twice.
    pub duplication: f64,
    /// The share of frames that are kept back, so that later ones overtake them.
    pub reordering: f64,
    /// Those are kept back for a random span below this.
    pub kept_back: Duration,
    /// Bits per second that a port sends; 0 for no limit.
    pub bandwidth: u64,
}

impl Faults {
    /// A quiet cable: nothing is lost, and a frame takes 50 µs.
    pub const NONE: Self = Self {
        loss: 0.0,
        delay: Duration::from_micros(50),
        jitter: Duration::ZERO,
        duplication: 0.0,
        reordering: 0.0,
        kept_back: Duration::from_millis(5),
        bandwidth: 0,
    };

    /// A quiet cable that loses this share of the frames.
    pub const fn loss(share: f64) -> Self {
        Self { loss: share, ..Self::NONE }
    }
}

impl Default for Faults {
    fn default() -> Self {
        Self::NONE
    }
}

macro_rules! named {
    ($($(#[$doc:meta])* $variant:ident = $name:literal,)*) => {
        /// What happened to a frame.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Fault {
            $($(#[$doc])* $variant,)*
        }

        impl Fault {
            /// Every fault.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)*];

            /// The name under which runs report it.
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)*
                }
            }
        }
    };
}

named! {
    /// It was lost.
    Loss = "loss",
    /// It was late by jitter.
    Jitter = "jitter",
    /// It arrived twice.
    Duplicate = "duplicate",
    /// It was kept back so that others overtake it.
    Reorder = "reorder",
    /// It waited for limited bandwidth.
    Bandwidth = "bandwidth",
    /// The sender's or the receiver's cable was out.
    LinkDown = "link-down",
    /// The receiver's queue was full.
    QueueFull = "queue-full",
    /// It was shorter than two addresses and a type, or longer than Ethernet allows.
    BadLength = "bad-length",
}

/// How often each [`Fault`] happened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FaultCounts([u64; Fault::ALL.len()]);

impl FaultCounts {
    /// How often `fault` happened.
    pub fn of(&self, fault: Fault) -> u64 {
        self.0[fault as usize]
    }

    /// Each fault's name and count.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        Fault::ALL.iter().map(|fault| (fault.name(), self.of(*fault)))
    }

    pub(crate) fn count(&mut self, fault: Fault) {
        self.0[fault as usize] += 1;
    }
}

impl fmt::Display for FaultCounts {
    /// `loss 3, jitter 0, …`: every name, zeros included.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, (name, count)) in self.iter().enumerate() {
            let separator = if index == 0 { "" } else { ", " };
            write!(f, "{separator}{name} {count}")?;
        }
        Ok(())
    }
}
