//! How good the way from one host to another is.

use cara_core::random::Random;
use cara_core::time::Duration;

/// A probability, exact to a millionth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Chance(u32);

impl Chance {
    const WHOLE: u32 = 1_000_000;
    /// Never hits, and draws no random number.
    pub const NEVER: Self = Self(0);
    /// Always hits.
    pub const ALWAYS: Self = Self(Self::WHOLE);

    /// `percent` of a hundred; clamped to 0 to 100.
    pub const fn percent(percent: f64) -> Self {
        Self::parts_per_million((percent.clamp(0.0, 100.0) * 10_000.0) as u32)
    }

    /// `parts` of a million; what is above counts as always.
    pub const fn parts_per_million(parts: u32) -> Self {
        Self(if parts > Self::WHOLE { Self::WHOLE } else { parts })
    }

    /// Draws: whether it hits this time.
    pub fn hits(self, random: &mut Random) -> bool {
        self.0 != 0 && random.below(Self::WHOLE.into()) < self.0.into()
    }
}

/// Quality of the way from one host to another, in that direction only.
///
/// ```
/// use cara_core::time::Duration;
/// use cara_sim::Path;
/// let radio = Path::LAN.delay(Duration::from_millis(3)).loss_percent(2.0).bits_per_second(1_000_000);
/// assert_eq!(radio.bytes_per_second, 125_000);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Path {
    /// Least time from the end of sending to arrival.
    pub delay: Duration,
    /// Up to this much is added to `delay` at random; datagrams overtake each other by it, streams keep their order.
    pub jitter: Duration,
    /// Loss of a datagram, or of a stream's segment, which the stream sends again.
    pub loss: Chance,
    /// A datagram arrives twice.
    pub duplicate: Chance,
    /// A datagram is kept back so that later ones overtake it.
    pub reorder: Chance,
    /// Bytes that leave per second, datagrams and all streams of this direction together; 0 is without limit.
    pub bytes_per_second: u64,
}

impl Path {
    /// A switched network: 200 µs, nothing lost, no limit.
    pub const LAN: Self = Self {
        delay: Duration::from_micros(200),
        jitter: Duration::ZERO,
        loss: Chance::NEVER,
        duplicate: Chance::NEVER,
        reorder: Chance::NEVER,
        bytes_per_second: 0,
    };
    /// A busy warehouse radio: 2 to 8 ms, 1 % loss, a few doubled or late datagrams, 20 Mbit/s.
    pub const WIFI: Self = Self {
        delay: Duration::from_millis(2),
        jitter: Duration::from_millis(6),
        loss: Chance::percent(1.0),
        duplicate: Chance::percent(0.2),
        reorder: Chance::percent(0.5),
        bytes_per_second: 2_500_000,
    };

    /// The same path with another delay.
    pub const fn delay(self, delay: Duration) -> Self {
        Self { delay, ..self }
    }

    /// The same path with another jitter.
    pub const fn jitter(self, jitter: Duration) -> Self {
        Self { jitter, ..self }
    }

    /// The same path with another loss.
    pub const fn loss_percent(self, percent: f64) -> Self {
        Self { loss: Chance::percent(percent), ..self }
    }

    /// The same path with another share of doubled datagrams.
    pub const fn duplicate_percent(self, percent: f64) -> Self {
        Self { duplicate: Chance::percent(percent), ..self }
    }

    /// The same path with another share of datagrams that are overtaken.
    pub const fn reorder_percent(self, percent: f64) -> Self {
        Self { reorder: Chance::percent(percent), ..self }
    }

    /// The same path with another bandwidth; 0 is without limit.
    pub const fn bits_per_second(self, bits: u64) -> Self {
        Self { bytes_per_second: bits / 8, ..self }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chance_hits_about_as_often_as_it_says() {
        let mut random = Random::new(1);
        let hits = (0..100_000).filter(|_| Chance::percent(10.0).hits(&mut random)).count();
        assert!((9_500..10_500).contains(&hits), "{hits}");
        assert!(Chance::ALWAYS.hits(&mut random) && !Chance::NEVER.hits(&mut random));
    }
}
