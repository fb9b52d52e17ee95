//! From turns to figures.

use cara_bench_ends::Outcome;

/// All turns of one peer in one cell.
#[derive(Debug, Default)]
pub(crate) struct Cell {
    pub(crate) turns: Vec<Turn>,
}

/// One block.
#[derive(Debug, Clone)]
pub(crate) struct Turn {
    round_trips: Vec<u64>,
    median: u64,
    per_second: f64,
    cpu_per_call: f64,
}

impl Turn {
    /// A block; the server used `server_cpu` nanoseconds meanwhile.
    pub(crate) fn new(outcome: Outcome, server_cpu: u64) -> Self {
        let mut round_trips = outcome.round_trips;
        round_trips.sort_unstable();
        let calls = round_trips.len().max(1) as f64;
        Self {
            median: percentile(&round_trips, 50.0),
            per_second: calls * 1e9 / outcome.elapsed.max(1) as f64,
            cpu_per_call: (outcome.cpu + server_cpu) as f64 / outcome.cpu_calls.max(1) as f64,
            round_trips,
        }
    }
}

/// The figures of one cell.
#[derive(Debug, PartialEq)]
pub(crate) struct Figures {
    pub(crate) calls: usize,
    /// Nanoseconds.
    pub(crate) mean: u64,
    /// Nanoseconds: a quarter, a half and three quarters took no longer.
    pub(crate) lower_quartile: u64,
    pub(crate) median: u64,
    pub(crate) upper_quartile: u64,
    /// Nanoseconds.
    pub(crate) p99: u64,
    /// Nanoseconds.
    pub(crate) p999: u64,
    /// Nanoseconds.
    pub(crate) longest: u64,
    /// Middle turn.
    pub(crate) per_second: f64,
    /// Nanoseconds of both processes, middle turn.
    pub(crate) cpu_per_call: f64,
}

impl Cell {
    pub(crate) fn figures(&self) -> Figures {
        let mut all: Vec<u64> = self.turns.iter().flat_map(|turn| turn.round_trips.iter().copied()).collect();
        all.sort_unstable();
        Figures {
            calls: all.len(),
            mean: all.iter().sum::<u64>() / all.len().max(1) as u64,
            lower_quartile: percentile(&all, 25.0),
            median: percentile(&all, 50.0),
            upper_quartile: percentile(&all, 75.0),
            p99: percentile(&all, 99.0),
            p999: percentile(&all, 99.9),
            longest: all.last().copied().unwrap_or(0),
            per_second: quartile(self.turns.iter().map(|turn| turn.per_second).collect(), 2),
            cpu_per_call: quartile(self.turns.iter().map(|turn| turn.cpu_per_call).collect(), 2),
        }
    }

    /// Medians of this cell's turns divided by those of `floor` in the same turn: lower quartile, median and upper.
    pub(crate) fn ratios(&self, floor: &Self) -> [f64; 3] {
        let ratios = || pairs(self, floor).map(|(own, floor)| own.median as f64 / floor.median.max(1) as f64).collect();
        [1, 2, 3].map(|which| quartile(ratios(), which))
    }

    /// CPU time per call of both processes, divided by that of `floor` in the same turn; the median.
    pub(crate) fn cpu_ratio(&self, floor: &Self) -> f64 {
        quartile(pairs(self, floor).map(|(own, floor)| own.cpu_per_call / floor.cpu_per_call.max(1e-9)).collect(), 2)
    }

    /// Requests per second divided by those of `floor` in the same turn; the median.
    pub(crate) fn throughput_ratio(&self, floor: &Self) -> f64 {
        quartile(pairs(self, floor).map(|(own, floor)| own.per_second / floor.per_second.max(1e-9)).collect(), 2)
    }
}

fn pairs<'a>(own: &'a Cell, floor: &'a Cell) -> impl Iterator<Item = (&'a Turn, &'a Turn)> {
    own.turns.iter().zip(&floor.turns)
}

/// The value below which `percent` of `sorted` lie; 0 for none.
pub(crate) fn percentile(sorted: &[u64], percent: f64) -> u64 {
    let place = (sorted.len().saturating_sub(1) as f64 * percent / 100.0).round() as usize;
    sorted.get(place).copied().unwrap_or(0)
}

/// Quartile 1, 2 (the median) or 3; 0 for no values.
pub(crate) fn quartile(mut values: Vec<f64>, which: usize) -> f64 {
    values.sort_by(f64::total_cmp);
    let place = (values.len().saturating_sub(1) * which).div_ceil(4);
    values.get(place).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cell(medians: &[u64]) -> Cell {
        let turn = |&median: &u64| {
            let round_trips = vec![1, median, 1_000];
            Turn::new(Outcome { round_trips, elapsed: 3 * median, cpu: 300, cpu_calls: 3 }, 600)
        };
        Cell { turns: medians.iter().map(turn).collect() }
    }

    #[test]
    fn figures_are_over_all_turns() {
        let figures = cell(&[10, 20, 30]).figures();
        assert_eq!((figures.calls, figures.median, figures.longest), (9, 20, 1_000));
        assert_eq!(figures.per_second, 1e9 / 20.0);
        assert_eq!(figures.cpu_per_call, 300.0);
    }

    #[test]
    fn ratios_compare_blocks_of_the_same_turn() {
        // The machine was ten times slower in the second turn: the ratio does not care.
        let [low, middle, high] = cell(&[20, 200, 24]).ratios(&cell(&[10, 100, 10]));
        assert_eq!((middle, high), (2.0, 2.4));
        assert!(low <= middle);
        assert_eq!(cell(&[10, 20]).cpu_ratio(&cell(&[10, 20])), 1.0);
        assert_eq!(cell(&[10, 20]).throughput_ratio(&cell(&[10, 20])), 1.0);
    }

    #[test]
    fn no_turns_are_zeros() {
        let figures = Cell::default().figures();
        assert_eq!((figures.calls, figures.median, figures.per_second), (0, 0, 0.0));
    }
}
