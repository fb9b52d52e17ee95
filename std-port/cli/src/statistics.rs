//! What is said about measured times: median, p99 and the longest. None is discarded.

use serde::Serialize;

/// Times of one kind, in microseconds.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(crate) struct Times {
    /// How many were tried.
    pub(crate) tried: usize,
    /// How many of them failed, and so have no time.
    pub(crate) failed: usize,
    /// Half of the others took less.
    pub(crate) median_us: Option<f64>,
    /// One in a hundred took longer.
    pub(crate) p99_us: Option<f64>,
    /// The longest.
    pub(crate) max_us: Option<f64>,
    /// All of them in the order in which they were measured.
    pub(crate) samples_us: Vec<Option<f64>>,
}

impl Times {
    pub(crate) fn of(samples: Vec<Option<f64>>) -> Self {
        let mut sorted: Vec<f64> = samples.iter().flatten().copied().collect();
        sorted.sort_by(f64::total_cmp);
        Self {
            tried: samples.len(),
            failed: samples.len() - sorted.len(),
            median_us: percentile(&sorted, 50),
            p99_us: percentile(&sorted, 99),
            max_us: sorted.last().copied(),
            samples_us: samples,
        }
    }

    /// Median, p99 and the longest for people; a dash for none.
    pub(crate) fn shown(&self) -> [String; 3] {
        let show = |micros: Option<f64>| micros.map_or("-".to_owned(), cara_tools::units::show_micros);
        [show(self.median_us), show(self.p99_us), show(self.max_us)]
    }
}

/// The least value that at least `percent` of `sorted` do not exceed.
fn percentile(sorted: &[f64], percent: usize) -> Option<f64> {
    let rank = (sorted.len() * percent).div_ceil(100);
    sorted.get(rank.checked_sub(1)?).copied()
}

#[cfg(test)]
mod tests {
    use super::Times;

    #[test]
    fn nothing_is_discarded() {
        let mut samples: Vec<_> = (1..=99).map(|n| Some(f64::from(n))).collect();
        samples.extend([Some(1e6), None]);
        let times = Times::of(samples);
        assert_eq!((times.tried, times.failed), (101, 1));
        assert_eq!((times.median_us, times.p99_us, times.max_us), (Some(50.0), Some(99.0), Some(1e6)));
    }

    #[test]
    fn few_and_none() {
        assert_eq!(Times::of(vec![Some(7.0)]).shown(), ["7 us", "7 us", "7 us"]);
        assert_eq!(Times::of(vec![None]).shown(), ["-", "-", "-"]);
        assert_eq!(Times::of(vec![]).max_us, None);
    }
}
