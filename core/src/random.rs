//! Seeded pseudo-random numbers for jitter and for plain mode's nonces. Not for keys.

use crate::time::Duration;

/// SplitMix64: eight bytes of state, full period, good enough to spread nodes in time.
#[derive(Clone, Debug)]
pub struct Random(u64);

impl Random {
    /// A generator that repeats itself for the same `seed`.
    pub const fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// A number below `bound`; zero for a bound of zero.
    pub fn below(&mut self, bound: u64) -> u64 {
        self.bits().checked_rem(bound).unwrap_or(0)
    }

    /// A span in `[0, limit)`.
    #[cfg_attr(target_os = "none", inline(never))]
    pub fn jitter(&mut self, limit: Duration) -> Duration {
        Duration::from_micros(self.below(limit.as_micros()))
    }
}
