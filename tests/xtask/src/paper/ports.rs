//! The column of ports: where the tests of a row run. It follows from their paths, and for scenarios from the ticks of
//! `docs/scenarios.md`.

use crate::bad_input::references;

use super::RULES;

/// Where tests below a folder run; of several, the first one that fits.
const FOLDERS: [(&str, &str); 14] = [
    ("core/", "core"),
    ("std-port/", "Linux"),
    ("examples/linux/", "Linux"),
    ("examples/warehouse/", "Linux"),
    ("examples/smoltcp/", "smoltcp"),
    ("tests/experiments/bench/src/deadlines.rs", "simulator"),
    ("tests/experiments/bench/src/experiments/simulated.rs", "simulator"),
    ("tests/experiments/bench/", "Linux"),
    ("tests/embassy/", "embassy"),
    ("tests/firmware/", "QEMU"),
    ("tests/sim/", "simulator"),
    ("tests/vectors/src/", "core"),
    ("tests/vectors/tests/", "Linux"),
    ("tests/xtask/", "sources"),
];

/// Columns of the table of scenarios.
const COLUMNS: [&str; 5] = ["simulator", "with keys", "Linux", "embassy", "line"];

/// All of them, in the order in which they are told.
const ORDER: [&str; 9] = ["core", "simulator", "with keys", "Linux", "embassy", "line", "smoltcp", "QEMU", "sources"];

/// The ports on which the tests run that a row names.
pub(super) fn of(place: &str, scenarios: &str) -> String {
    let mut found: Vec<&str> = Vec::new();
    for (file, name) in references(place).into_iter().filter_map(|reference| reference.split_once("::")) {
        match FOLDERS.iter().find(|(folder, _)| file.starts_with(folder)) {
            _ if file.starts_with(RULES) => found.extend(ticked(scenarios, name)),
            Some((_, port)) => found.push(port),
            None => {}
        }
    }
    ORDER.into_iter().filter(|port| found.contains(port)).collect::<Vec<_>>().join(", ")
}

/// The ports that have a tick in a scenario's line.
pub(super) fn ticked<'s>(scenarios: &'s str, name: &'s str) -> impl Iterator<Item = &'static str> + 's {
    let cells = |line: &'s str| line.split('|').map(str::trim).collect::<Vec<_>>();
    let heads = scenarios.lines().map(cells).find(|cells| cells.contains(&"scenario")).unwrap_or_default();
    let wanted = format!("`{name}`");
    let line = scenarios.lines().map(cells).find(|cells| cells.get(1) == Some(&wanted.as_str())).unwrap_or_default();
    let is_ticked = move |head: &str| heads.iter().zip(&line).any(|(found, cell)| *found == head && *cell == "✓");
    COLUMNS.into_iter().filter(move |head| is_ticked(head))
}

#[cfg(test)]
mod tests {
    use super::of;

    const SCENARIOS: &str = "| scenario | rule | simulator | with keys | Linux | embassy |\n\
                             | `a` | 1 | ✓ | ✓ | b | ✓ |\n| `b` | 2 | ✓ | h | ✓ | ✓ |";

    #[test]
    fn ports_follow_from_the_table_of_scenarios_and_from_folders() {
        let scenario = |name: &str| format!("`tests/scenarios/src/rules/x.rs::{name}`");
        assert_eq!(of(&scenario("a"), SCENARIOS), "simulator, with keys, embassy");
        assert_eq!(
            of(&format!("{}, {}", scenario("a"), scenario("b")), SCENARIOS),
            "simulator, with keys, Linux, embassy"
        );
        assert_eq!(of(&scenario("unknown"), SCENARIOS), "");
        assert_eq!(of("`std-port/src/a.rs::b`, `core/src/a.rs::b`, `core/src/c.rs`", SCENARIOS), "core, Linux");
        assert_eq!(of("`docs/wire.md`", SCENARIOS), "");
    }
}
