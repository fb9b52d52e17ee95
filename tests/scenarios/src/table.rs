//! The table scenario × port, as `docs/scenarios.md` holds it.

use std::fmt::Write;
use std::path::PathBuf;

use crate::{Need, Scenario, all};

/// Where the table is kept.
pub fn path() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/scenarios.md"))
}

const HEAD: &str = "# Scenarios
<!-- written by `cargo run --package cara-scenarios --bin table`; a test compares it -->

Each rule is a function in `tests/scenarios/src/rules`, run on every port that can. `cargo test --package
cara-scenarios` runs each once; `cargo run --release --package cara-scenarios --bin seeds` runs each for 1,000 seeds on
the simulator. A rule's numbers are those of [paper.md](paper.md). Weather is what the network does by itself in those
runs: rough is loss, delay, jitter, reordering, duplication, short partitions and split reads; light is the same without
loss and partitions; own is only what the scenario injects. A letter instead of a port's ✓ leads to the reason below.

| scenario | rule | weather | simulator | Linux |
|---|---|---|---|---|
";

/// The whole file.
pub fn text() -> String {
    let mut text = HEAD.to_owned();
    for scenario in all() {
        let Scenario { name, rule, weather, .. } = scenario;
        let weather = format!("{weather:?}").to_lowercase();
        let _ = writeln!(text, "| `{name}` | {rule} | {weather} | ✓ | {} |", on_linux(&scenario));
    }
    text.push_str("\nWhy a scenario does not run on Linux over loopback:\n\n");
    for (letter, need) in letters() {
        if let (true, Some(reason)) = (is_reason(need), need.missing_on_linux()) {
            let _ = writeln!(text, "- {letter}: {reason}.");
        }
    }
    text
}

/// The need that keeps a scenario from Linux.
fn blank(scenario: &Scenario) -> Option<Need> {
    scenario.needs.iter().copied().find(|need| need.missing_on_linux().is_some())
}

fn is_reason(need: Need) -> bool {
    all().iter().any(|scenario| blank(scenario) == Some(need))
}

fn letters() -> impl Iterator<Item = (char, Need)> {
    ('a'..).zip(Need::ALL.into_iter().filter(|need| is_reason(*need)))
}

fn on_linux(scenario: &Scenario) -> String {
    let Some(need) = blank(scenario) else { return "✓".to_owned() };
    let letter = letters().find(|(_, other)| *other == need).map(|(letter, _)| letter);
    letter.map_or_else(String::new, String::from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn the_committed_table_is_that_of_the_scenarios() {
        let committed = std::fs::read_to_string(path()).unwrap();
        assert!(committed == text(), "run: cargo run --package cara-scenarios --bin table");
    }

    #[test]
    fn names_are_unique_and_every_blank_has_a_reason() {
        let scenarios = all();
        let names: BTreeSet<&str> = scenarios.iter().map(|scenario| scenario.name).collect();
        assert_eq!(names.len(), scenarios.len());
        assert!(scenarios.iter().all(|scenario| !on_linux(scenario).is_empty()));
    }
}
