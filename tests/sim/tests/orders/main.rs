//! Orders, stops and terms in fleets drawn from seeds: whatever fails, nothing moves that is not wanted. `watch` says what must
//! hold, `fleet` what happens. A seed that fails says how to replay it.
//!
//! `cargo xtask orders` runs it for many more seeds, and with bugs that are planted on purpose.

mod fleet;
mod watch;

use cara_core::time::Duration;
use cara_sim::{FaultCounts, for_each_seed};
use fleet::Size;

/// From so many seeds on what comes seldom must have come.
const MANY: usize = 100;

/// Runs each seed, with two or three managers, and asks for what must have happened.
fn runs(seeds: u64, vehicles: usize, lasts: Duration) {
    let size = |seed| Size { vehicles, managers: 2 + seed % 2, lasts };
    let ends = for_each_seed(seeds, |seed| fleet::run(seed, size(seed)));
    let (mut reached, mut faults) = (watch::Reached::new(), FaultCounts::default());
    let count = ends.len();
    for (run, injected) in ends {
        faults += injected;
        run.into_iter().for_each(|(what, times)| *reached.entry(what).or_default() += times);
    }
    let list = |(what, times): (&&str, &u64)| format!("{what} {times}");
    let list = reached.iter().map(list).collect::<Vec<_>>().join(", ");
    println!("{count} seeds with {vehicles} vehicles: {list}; faults: {faults}");
    if count > 1 {
        let seldom: &[&str] = if count < MANY { &[] } else { &watch::SELDOM };
        let wanted = watch::MUST_REACH.iter().chain(seldom);
        let missing: Vec<_> = wanted.filter(|what| !reached.contains_key(**what)).collect();
        assert!(missing.is_empty(), "never reached: {missing:?}");
    }
}

#[test]
fn five_vehicles_move_only_as_they_are_wanted() {
    runs(300, 5, Duration::from_secs(20));
}

#[test]
fn many_vehicles_move_only_as_they_are_wanted() {
    runs(2, 200, Duration::from_secs(20));
}
