//! The faults by name, and how often each was injected.

use std::fmt;
use std::ops::AddAssign;

macro_rules! faults {
    ($($(#[$doc:meta])* $variant:ident = $name:literal,)*) => {
        /// A fault that the network injects.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
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

faults! {
    /// A datagram was lost.
    Loss = "loss",
    /// A segment of a stream or a connection request was lost or led nowhere, and is sent again later.
    Retransmission = "retransmission",
    /// Something travelled on a path slower than the calm one.
    Delay = "delay",
    /// Something was late by jitter.
    Jitter = "jitter",
    /// A datagram was kept back so that others overtake it.
    Reorder = "reorder",
    /// A datagram arrived twice.
    Duplicate = "duplicate",
    /// Something waited for limited bandwidth.
    Bandwidth = "bandwidth",
    /// A reader was lent only a part of what had arrived.
    SplitRead = "split-read",
    /// Sets of hosts were cut from each other.
    Partition = "partition",
    /// A stream or link was frozen.
    Freeze = "freeze",
    /// A broadcast was dropped by its segment.
    BroadcastDropped = "broadcast-dropped",
    /// A host lost power.
    PowerCut = "power-cut",
    /// A process was killed while its host stayed up.
    ProcessKilled = "process-killed",
    /// A host or process came back.
    Restart = "restart",
    /// A host was suspended.
    Suspend = "suspend",
    /// A host got another address.
    AddressChange = "address-change",
    /// A stream was reset.
    Reset = "reset",
}

/// How often each [`Fault`] was injected.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FaultCounts([u64; Fault::ALL.len()]);

impl FaultCounts {
    /// How often `fault` was injected.
    pub fn of(&self, fault: Fault) -> u64 {
        self.0[fault as usize]
    }

    /// Each fault's name and count.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        Fault::ALL.iter().map(|fault| (fault.name(), self.of(*fault)))
    }

    /// The faults that were never injected: a run that meant to inject them tested nothing.
    pub fn missing(&self) -> impl Iterator<Item = Fault> + '_ {
        Fault::ALL.iter().copied().filter(|fault| self.of(*fault) == 0)
    }

    pub(crate) fn count(&mut self, fault: Fault) {
        self.0[fault as usize] += 1;
    }
}

impl AddAssign for FaultCounts {
    fn add_assign(&mut self, other: Self) {
        self.0.iter_mut().zip(other.0).for_each(|(sum, more)| *sum += more);
    }
}

impl fmt::Display for FaultCounts {
    /// `loss 3, retransmission 0, …`: every name, zeros included.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, (name, count)) in self.iter().enumerate() {
            let separator = if index == 0 { "" } else { ", " };
            write!(f, "{separator}{name} {count}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_add_up_and_show_what_is_missing() {
        let mut counts = FaultCounts::default();
        counts.count(Fault::Loss);
        let mut sum = counts;
        sum += counts;
        assert_eq!(sum.of(Fault::Loss), 2);
        assert_eq!(sum.missing().count(), Fault::ALL.len() - 1);
        assert!(sum.to_string().starts_with("loss 2, retransmission 0"));
    }
}
