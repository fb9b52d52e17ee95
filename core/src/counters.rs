//! Counters: one for every reason to drop, refuse or defer, so that nothing is lost silently.

use core::fmt;
use core::marker::PhantomData;

/// An enum whose variants each name a counter; made by the `counters!` macro.
pub trait Counter: Copy + 'static {
    /// All of them, in order.
    const ALL: &'static [Self];
    /// Position in [`ALL`](Self::ALL).
    fn index(self) -> usize;
    /// The name, in words joined by `_`, as the command line and metrics show it.
    fn name(self) -> &'static str;
    /// What is counted, in a sentence.
    fn help(self) -> &'static str;
}

/// A counter in memory. On a microcontroller it has half the bytes, and stops at 4 billion.
#[cfg(not(target_os = "none"))]
type Value = u64;
#[cfg(target_os = "none")]
type Value = u32;

/// A set of counters, all zero at first. `N` is the enum's `COUNT`.
#[derive(Clone)]
pub struct Counters<C, const N: usize> {
    values: [Value; N],
    kind: PhantomData<C>,
}

impl<C: Counter, const N: usize> Counters<C, N> {
    /// All zero.
    pub const fn new() -> Self {
        Self { values: [0; N], kind: PhantomData }
    }

    /// Adds `count`; saturates.
    #[allow(clippy::unnecessary_fallible_conversions, reason = "on a microcontroller it can fail")]
    #[cfg_attr(target_os = "none", inline(never))]
    pub fn add(&mut self, counter: C, count: u64) {
        if let Some(value) = self.values.get_mut(counter.index()) {
            *value = value.saturating_add(Value::try_from(count).unwrap_or(Value::MAX));
        }
    }

    /// Adds one; saturates.
    #[cfg_attr(target_os = "none", inline(never))]
    pub fn count(&mut self, counter: C) {
        if let Some(value) = self.values.get_mut(counter.index()) {
            *value = value.saturating_add(1);
        }
    }

    /// The value of one counter.
    #[allow(clippy::useless_conversion, reason = "it is one on a microcontroller")]
    pub fn value(&self, counter: C) -> u64 {
        self.values.get(counter.index()).map_or(0, |value| u64::from(*value))
    }

    /// All names and values, zeros included.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        C::ALL.iter().take(N).map(|&counter| (counter.name(), self.value(counter)))
    }

    /// Adds the values of `other`, to sum up links.
    pub fn merge(&mut self, other: &Self) {
        for (value, more) in self.values.iter_mut().zip(&other.values) {
            *value = value.saturating_add(*more);
        }
    }
}

impl<C: Counter, const N: usize> Default for Counters<C, N> {
    fn default() -> Self {
        Self::new()
    }
}

impl<C: Counter, const N: usize> fmt::Debug for Counters<C, N> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_map().entries(self.iter().filter(|(_, value)| *value > 0)).finish()
    }
}

/// Declares an enum of counters and their number: `counters! { /// doc  pub enum Name[COUNT] { /// doc  Variant, … } }`.
macro_rules! counters {
    ($(#[$meta:meta])* pub enum $name:ident[$count:expr] {
        $(#[doc = $help:literal] $variant:ident,)+
    }) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub enum $name { $(#[doc = $help] $variant,)+ }

        impl $name {
            /// How many of them this build has: the first ones.
            pub const COUNT: usize = $count;
        }

        impl $crate::counters::Counter for $name {
            const ALL: &'static [Self] = &[$(Self::$variant,)+];
            fn index(self) -> usize {
                self as usize
            }
            fn name(self) -> &'static str {
                match self { $(Self::$variant => stringify!($variant),)+ }
            }
            fn help(self) -> &'static str {
                match self { $(Self::$variant => $help.trim_ascii(),)+ }
            }
        }
    };
}

pub(crate) use counters;

#[cfg(test)]
mod tests {
    use super::{Counters, Value};
    use crate::host::connections::LinkCounter;

    #[test]
    fn a_counter_stops_at_its_end() {
        let mut counters = Counters::<LinkCounter, { LinkCounter::COUNT }>::new();
        counters.add(LinkCounter::BytesReceived, u64::MAX);
        counters.count(LinkCounter::BytesReceived);
        counters.merge(&counters.clone());
        assert_eq!(counters.value(LinkCounter::BytesReceived), Value::MAX);
    }
}
