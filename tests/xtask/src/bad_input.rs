//! `docs/bad-input.md`: every item of bad input has its error, its text and its tests, and all that it names exists.

use std::path::Path;

use anyhow::Result;

use crate::{paper, workspace};

const TABLE: &str = "docs/bad-input.md";
const TEXTS: &str = "core/src/error.rs";
const SCENARIOS: &str = "docs/scenarios.md";
/// Where scenarios are, which run on more than one port.
const RULES: &str = "tests/scenarios/src/rules/";

/// What must stand in the table, once each.
const ITEMS: [&str; 25] = [
    "unknown function",
    "missing argument",
    "wrong type",
    "wrong size",
    "request too large",
    "result too large",
    "table of nodes full",
    "table of functions full",
    "table of calls full",
    "buffers full",
    "duplicate identity",
    "restart",
    "another version",
    "another fleet",
    "garbage on TCP",
    "garbage on UDP",
    "slow reader",
    "closed in mid-chunk",
    "half-open connections",
    "time-out",
    "stale command",
    "port in use",
    "no interface",
    "interface that goes and comes",
    "configuration file with a mistake",
];

/// A line of the table.
struct Row<'t> {
    item: &'t str,
    text: &'t str,
    simulator: &'t str,
    sockets: &'t str,
}

/// Reads the table and fails with everything that is missing in it.
pub(crate) fn check() -> Result<()> {
    let read = |path: &str| workspace::read(Path::new(path)).unwrap_or_default();
    let exists = |path: &str| workspace::root().join(path).exists();
    let wrong = problems(&read(TABLE), exists, read);
    paper::verdict(TABLE, &wrong, &format!("{} items of bad input, each with its tests", ITEMS.len()))
}

fn problems(table: &str, exists: impl Fn(&str) -> bool, read: impl Fn(&str) -> String) -> Vec<String> {
    let rows: Vec<Row> = table.lines().filter_map(row).collect();
    let mut wrong = Vec::new();
    for item in ITEMS {
        match rows.iter().filter(|row| row.item == item).count() {
            1 => {}
            count => wrong.push(format!("{item} stands there {count} times")),
        }
    }
    for row in &rows {
        let objections = objections(row, &exists, &read);
        wrong.extend(objections.into_iter().map(|why| format!("{}: {why}", row.item)));
    }
    wrong
}

fn row(line: &str) -> Option<Row<'_>> {
    let cells: Vec<&str> = line.trim().strip_prefix('|')?.strip_suffix('|')?.split('|').map(str::trim).collect();
    let [item, _error, text, simulator, sockets, _others] = cells[..] else { return None };
    (item != "item" && !item.starts_with('-')).then_some(Row { item, text, simulator, sockets })
}

fn objections(row: &Row<'_>, exists: impl Fn(&str) -> bool, read: impl Fn(&str) -> String) -> Vec<String> {
    let mut wrong = Vec::new();
    match row.text.strip_prefix('"').and_then(|text| text.strip_suffix('"')) {
        Some(text) if read(TEXTS).contains(&format!("\"{text}\"")) => {}
        Some(text) => wrong.push(format!("no error says {text:?}")),
        None if row.text == "none" => {}
        None => wrong.push("no text".to_owned()),
    }
    let simulated = references(row.simulator);
    let on_sockets = references(row.sockets);
    let same = row.sockets.starts_with("the same");
    if simulated.is_empty() && !row.simulator.starts_with("none: ") {
        wrong.push("no test on the simulator, and no reason".to_owned());
    }
    if on_sockets.is_empty() && !same {
        wrong.push("no test on real sockets".to_owned());
    }
    wrong.extend(simulated.iter().chain(&on_sockets).filter_map(|name| paper::broken(name, &exists, &read)));
    let on_linux = on_sockets.iter().chain(simulated.iter().filter(|_| same));
    let rules = on_linux.filter_map(|name| name.strip_prefix(RULES)?.split_once("::"));
    wrong.extend(
        rules
            .filter(|(_, name)| !runs_on_linux(&read(SCENARIOS), name))
            .map(|(_, name)| format!("{name}: not on Linux")),
    );
    wrong
}

/// What stands in backquotes.
pub(crate) fn references(cell: &str) -> Vec<&str> {
    cell.split('`').skip(1).step_by(2).collect()
}

/// Whether the table of scenarios has a tick for this one in the column of Linux.
fn runs_on_linux(scenarios: &str, name: &str) -> bool {
    let cells = |line: &'_ str| line.split('|').map(|cell| cell.trim().to_owned()).collect::<Vec<_>>();
    let head = scenarios.lines().map(cells).find(|cells| cells.iter().any(|cell| cell == "Linux"));
    let column = head.and_then(|cells| cells.iter().position(|cell| cell == "Linux"));
    let wanted = format!("`{name}`");
    let line = scenarios.lines().map(cells).find(|cells| cells.get(1) == Some(&wanted));
    column.zip(line).is_some_and(|(column, cells)| cells.get(column).is_some_and(|cell| cell == "✓"))
}

#[cfg(test)]
mod tests {
    use super::{ITEMS, problems};

    const SCENARIO: &str = "`tests/scenarios/src/rules/a.rs::a_rule`";

    /// A table in which all is well but for one item.
    fn wrong(text: &str, simulator: &str, sockets: &str) -> Vec<String> {
        let line = |(number, item): (usize, &&str)| {
            let (text, simulator, sockets) =
                if number == 0 { (text, simulator, sockets) } else { ("\"do this\"", SCENARIO, "the same") };
            format!("| {item} | error | {text} | {simulator} | {sockets} | nothing |\n")
        };
        let table: String = ITEMS.iter().enumerate().map(line).collect();
        faults(&table)
    }

    fn faults(table: &str) -> Vec<String> {
        let read = |path: &str| match path {
            "core/src/error.rs" => "#[error(\"do this\")]".to_owned(),
            "docs/scenarios.md" => {
                "| scenario | simulator | Linux |\n| `a_rule` | ✓ | ✓ |\n| `b_rule` | ✓ | a |".to_owned()
            }
            _ => "fn a_rule() {}\nfn b_rule() {}".to_owned(),
        };
        problems(table, |path| !path.contains("nowhere"), read)
    }

    #[test]
    fn a_full_table_passes() {
        assert_eq!(wrong("\"do this\"", SCENARIO, "the same"), [""; 0]);
        assert_eq!(wrong("none", "none: it has no files", "`b.rs::a_rule`"), [""; 0]);
        assert_eq!(wrong("none", "`tests/scenarios/src/rules/a.rs::b_rule`", "`b.rs::a_rule`"), [""; 0]);
    }

    #[test]
    fn what_is_missing_is_told() {
        for (text, simulator, sockets) in [
            ("\"do that\"", SCENARIO, "the same"),
            ("", SCENARIO, "the same"),
            ("none", "", "`b.rs::a_rule`"),
            ("none", SCENARIO, "none: too slow"),
            ("none", "`a.rs::nothing`", "the same"),
            ("none", SCENARIO, "`nowhere.rs::a_rule`"),
            ("none", "`tests/scenarios/src/rules/a.rs::b_rule`", "the same"),
        ] {
            assert_eq!(wrong(text, simulator, sockets).len(), 1, "{text} {simulator} {sockets}");
        }
        assert_eq!(faults("").len(), ITEMS.len());
    }
}
