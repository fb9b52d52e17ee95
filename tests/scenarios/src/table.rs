//! The table scenario × port, as `docs/scenarios.md` holds it.

use std::fmt::Write;
use std::path::PathBuf;

use crate::{Need, Port, Scenario, all};

/// Where the table is kept.
pub fn path() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/scenarios.md"))
}

const HEAD: &str = "# Scenarios
<!-- written by `cargo run --package cara-scenarios --bin table`; a test compares it -->

Each rule is a function in `tests/scenarios/src/rules`, run on every port that can. `cargo test --package
cara-scenarios` runs each once; `cargo run --release --package cara-scenarios --bin seeds` runs each for 1,000 seeds on
the simulator. A rule's numbers are those of [paper.md](paper.md). The column *faults* names the fault profile of the
simulated network: rough is loss, delay, jitter, reordering, duplication, short partitions and split reads; light is the
same without loss and partitions; own is only what the scenario injects. On the line, of 1,000,000 baud, rough changes one
byte in 2,000 and loses one; light is nothing. On Linux, on boards and on the line units have keys, as is the default,
except in scenarios with unknown clients, which speak plain. On the simulator units are plain, and
`--test secured` runs the rules once more on the simulator with keys. A letter instead of a port's ✓ leads to the reason
below.

| scenario | rule | faults | simulator | with keys | Linux | embassy | line |
|---|---|---|---|---|---|---|---|
";

/// The ports that lack something, with what they are.
const PORTS: [(Port, &str); 5] = [
    (Port::Simulator, "the simulator"),
    (Port::Secured, "the simulator with keys"),
    (Port::Linux, "Linux over loopback"),
    (Port::Embassy, "boards with embassy on a switch in memory"),
    (Port::Line, "two boards on a serial line without IP"),
];

/// The whole file.
pub fn text() -> String {
    let mut text = HEAD.to_owned();
    for scenario in all() {
        let Scenario { name, rule, profile, .. } = scenario;
        let profile = format!("{profile:?}").to_lowercase();
        let cells: Vec<String> = PORTS.iter().map(|(port, _)| cell(&scenario, *port)).collect();
        let _ = writeln!(text, "| `{name}` | {rule} | {profile} | {} |", cells.join(" | "));
    }
    for (port, what) in PORTS {
        let _ = writeln!(text, "\nWhy a scenario does not run on {what}:\n");
        for (letter, need) in letters() {
            if let (true, Some(reason)) = (is_reason(need, port), need.missing_on(port)) {
                let _ = writeln!(text, "- {letter}: {reason}.");
            }
        }
    }
    text
}

/// The need that keeps a scenario from a port.
fn blank(scenario: &Scenario, port: Port) -> Option<Need> {
    scenario.needs.iter().copied().find(|need| need.missing_on(port).is_some())
}

fn is_reason(need: Need, port: Port) -> bool {
    all().iter().any(|scenario| blank(scenario, port) == Some(need))
}

fn letters() -> impl Iterator<Item = (char, Need)> {
    let reasons = |need: &Need| PORTS.iter().any(|(port, _)| is_reason(*need, *port));
    ('a'..).zip(Need::ALL.into_iter().filter(reasons))
}

fn cell(scenario: &Scenario, port: Port) -> String {
    let Some(need) = blank(scenario, port) else { return "✓".to_owned() };
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
        assert!(scenarios.iter().all(|scenario| PORTS.iter().all(|(port, _)| !cell(scenario, *port).is_empty())));
    }
}
