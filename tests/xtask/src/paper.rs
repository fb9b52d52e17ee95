//! `docs/paper.md`: every promise of the paper is shown by a test or an example, and what it names exists.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::{Result, bail};

use self::programs::Program;
use crate::bad_input::references;
use crate::command::Run;
use crate::workspace;

pub(crate) mod broken;
mod ports;
mod programs;

const TABLE: &str = "docs/paper.md";
const SCENARIOS: &str = "docs/scenarios.md";
/// Where scenarios are.
const RULES: &str = "tests/scenarios/src/rules/";
/// Checks that are no tests, and run in a group of `cargo xtask test`.
const CHECKS: [&str; 1] = ["tests/firmware/src/checks/"];

/// Reads the table and fails with everything that is missing in it, and with every patch that cannot be tried.
pub(crate) fn check() -> Result<()> {
    let text = workspace::read(Path::new(TABLE))?;
    let exists = |path: &str| workspace::root().join(path).exists();
    let read = |path: &str| workspace::read(Path::new(path)).unwrap_or_default();
    let mut wrong = problems(&text, exists, read);
    let broken = broken::problems(&text, &mut wrong)?;
    verdict(TABLE, &wrong, &format!("{} promises, each with its place; {broken} with a patch", numbers().count()))
}

/// Fails unless each test that the table names is one that `cargo test` with these arguments runs. To be called when that
/// has passed.
pub(crate) fn check_ran(arguments: &[&str]) -> Result<()> {
    let text = workspace::read(Path::new(TABLE))?;
    let programs = Program::build(Run::cargo(), workspace::root(), arguments)?;
    let named: BTreeSet<&str> = text.lines().filter_map(row).flat_map(|row| row.tests()).collect();
    let ran = |name: &&&str| programs.iter().any(|program| program.test(name).is_some());
    let wrong: Vec<String> =
        named.iter().filter(|name| !ran(name)).map(|name| format!("{name} is no test that ran")).collect();
    verdict(TABLE, &wrong, &format!("{} tests that {TABLE} names have run", named.len()))
}

/// Writes the column of ports.
pub(crate) fn write_ports() -> Result<()> {
    let scenarios = workspace::read(Path::new(SCENARIOS))?;
    let text = workspace::read(Path::new(TABLE))?;
    let line = |line: &str| match row(line) {
        Some(Row { number, promise, place, .. }) => {
            format!("| {number} | {promise} | {place} | {} |\n", ports::of(place, &scenarios))
        }
        None => format!("{line}\n"),
    };
    let text: String = text.lines().map(line).collect();
    Ok(std::fs::write(workspace::root().join(TABLE), text)?)
}

/// Prints what is `wrong` in a table and fails, or says that all is `well`.
pub(crate) fn verdict(table: &str, wrong: &[String], well: &str) -> Result<()> {
    if wrong.is_empty() {
        println!("{well}");
        return Ok(());
    }
    wrong.iter().for_each(|line| eprintln!("{table}: {line}"));
    bail!("{} faults in {table}", wrong.len())
}

/// 1 to 77 with 13b, 13c and 45b.
fn numbers() -> impl Iterator<Item = String> {
    (1..=77).flat_map(|number: u8| {
        let extra: &[&str] = match number {
            13 => &["", "b", "c"],
            45 => &["", "b"],
            _ => &[""],
        };
        extra.iter().map(move |letter| format!("{number}{letter}"))
    })
}

fn problems(text: &str, exists: impl Fn(&str) -> bool, read: impl Fn(&str) -> String) -> Vec<String> {
    let mut shown: BTreeMap<&str, Vec<Row<'_>>> = BTreeMap::new();
    for row in text.lines().filter_map(row) {
        shown.entry(row.number).or_default().push(row);
    }
    let mut wrong = Vec::new();
    for number in numbers() {
        match shown.remove(number.as_str()).as_deref() {
            None => wrong.push(format!("{number} is missing")),
            Some([row]) => {
                wrong.extend(objection(row, &exists, &read).map(|why| format!("{number}: {why}")));
            }
            Some(_) => wrong.push(format!("{number} stands there more than once")),
        }
    }
    wrong.extend(shown.keys().map(|number| format!("{number} is not a number of the checklist")));
    wrong
}

/// A line of the table.
struct Row<'t> {
    number: &'t str,
    promise: &'t str,
    /// What shows it: names in backquotes.
    place: &'t str,
    ports: &'t str,
}

impl<'t> Row<'t> {
    /// The tests that it names, checks of other groups left out. The first one is that which fails when what the row says is
    /// broken.
    fn tests(&self) -> impl Iterator<Item = &'t str> + use<'t> {
        let is_check = |name: &str| CHECKS.iter().any(|folder| name.starts_with(folder));
        references(self.place).into_iter().filter(move |name| name.contains("::") && !is_check(name))
    }
}

fn row(line: &str) -> Option<Row<'_>> {
    let cells: Vec<&str> = line.trim().strip_prefix('|')?.strip_suffix('|')?.split('|').map(str::trim).collect();
    let [number, promise, place, ports] = cells[..] else { return None };
    number.starts_with(|c: char| c.is_ascii_digit()).then_some(Row { number, promise, place, ports })
}

/// Where a number stands in the order of the table.
fn order(number: &str) -> (u8, &str) {
    let digits = number.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    (digits.parse().unwrap_or_default(), &number[digits.len()..])
}

fn objection(row: &Row<'_>, exists: impl Fn(&str) -> bool, read: impl Fn(&str) -> String) -> Option<String> {
    let Row { place, ports, .. } = row;
    if place.contains("pending") {
        return Some("pending".into());
    }
    if place.contains("later:") {
        return Some("may not be left for later".into());
    }
    if row.tests().next().is_none() && !place.contains("figures:") {
        return Some("names neither a test nor figures".into());
    }
    let scenarios = read(SCENARIOS);
    if *ports != ports::of(place, &scenarios) {
        return Some("the ports are others: cargo xtask paper --write".into());
    }
    let mut references = references(place).into_iter();
    references.find_map(|reference| broken(reference, &exists, &read)).or_else(|| {
        let is_test = |name: &str| match name.split_once("::") {
            Some((file, name)) if file.starts_with(RULES) => ports::ticked(&scenarios, name).next().is_some(),
            Some((file, name)) => is_test(&read(file), name),
            None => true,
        };
        row.tests().find(|name| !is_test(name)).map(|name| format!("{name} is no test"))
    })
}

/// Whether a function of this name is a test, and one that is run without being asked for.
fn is_test(text: &str, name: &str) -> bool {
    let name = name.rsplit("::").next().unwrap_or(name);
    let lines: Vec<&str> = text.lines().map(str::trim).collect();
    let starts = [format!("fn {name}("), format!("async fn {name}(")];
    let heads = lines.iter().enumerate().filter(|(_, line)| starts.iter().any(|start| line.starts_with(start)));
    heads.map(|(at, _)| at).any(|at| {
        let above = lines.iter().take(at).rev().take_while(|line| line.starts_with("#[") || line.starts_with("//"));
        let above: Vec<&&str> = above.collect();
        above.iter().any(|line| **line == "#[test]") && !above.iter().any(|line| line.starts_with("#[ignore"))
    })
}

/// Why a reference `path` or `path::name` leads nowhere.
pub(crate) fn broken(reference: &str, exists: impl Fn(&str) -> bool, read: impl Fn(&str) -> String) -> Option<String> {
    let (path, name) = reference.split_once("::").map_or((reference, None), |(path, name)| (path, Some(name)));
    if !exists(path) {
        return Some(format!("{path} does not exist"));
    }
    let name = name?.rsplit("::").next()?;
    (!defines(&read(path), name)).then(|| format!("{path} has no `{name}`"))
}

/// Whether a function or module of this name stands in the text; `def` is Python's word for it.
fn defines(text: &str, name: &str) -> bool {
    text.lines().any(|line| {
        let words: Vec<&str> = line.split(|c: char| !c.is_alphanumeric() && c != '_').collect();
        !line.trim_start().starts_with("//")
            && words.windows(2).any(|pair| matches!(pair[0], "fn" | "mod" | "def") && pair[1] == name)
    })
}

#[cfg(test)]
mod tests {
    use super::{is_test, numbers, problems};

    const SOURCE: &str = "// fn commented() {}\n#[test]\n/// Why.\nfn a_test() {}\nmod inner {}\nfn helper() {}\n\
                          #[test]\n#[ignore]\nfn left_out() {}";
    const SCENARIOS: &str = "| scenario | simulator |\n| `a_rule` | ✓ |";
    const RULE: &str = "`tests/scenarios/src/rules/a.rs::a_rule`";

    /// A table in which every promise is shown, but for `number`, whose place is `place` and runs on `ports`.
    fn wrong(number: &str, place: &str, ports: &str) -> Vec<String> {
        let line = |found: String| {
            let (place, ports) = if found == number { (place, ports) } else { ("`core/a.rs::a_test`", "core") };
            format!("| {found} | promise | {place} | {ports} |\n")
        };
        let table: String = numbers().map(line).collect();
        faults(&format!("| number | promise | shown by | ports |\n|---|---|---|---|\n{table}"))
    }

    fn faults(table: &str) -> Vec<String> {
        let read = |path: &str| match path {
            "docs/scenarios.md" => SCENARIOS.to_owned(),
            "core/a.rs" => SOURCE.to_owned(),
            _ => "fn a_rule() {}\nfn unlisted() {}\nfn a_check() {}".to_owned(),
        };
        problems(table, |path| !path.contains("nowhere"), read)
    }

    #[test]
    fn a_full_table_passes() {
        assert_eq!(wrong("1", "`core/a.rs::a_test`, `core/a.rs::inner::a_test` and `docs/a.md`", "core"), [""; 0]);
        assert_eq!(
            wrong("1", &format!("{RULE}, `tests/firmware/src/checks/a.rs::a_check`"), "simulator, QEMU"),
            [""; 0]
        );
        assert_eq!(wrong("60", "figures: `docs/a.md`", ""), [""; 0]);
    }

    #[test]
    fn what_is_not_shown_is_told() {
        for place in ["pending", "", "see the code", "later: never", "`nowhere.rs`", "`a.rs`", "later: `a.rs`"] {
            assert_eq!(wrong("1", place, "").len(), 1, "{place}");
        }
        for name in ["other", "commented", "helper", "left_out", "inner"] {
            assert_eq!(wrong("1", &format!("`core/a.rs::{name}`"), "core").len(), 1, "{name}");
        }
        assert_eq!(wrong("1", "`tests/scenarios/src/rules/a.rs::unlisted`", "").len(), 1);
        assert_eq!(wrong("1", "`tests/firmware/src/checks/a.rs::a_check`", "QEMU").len(), 1, "no test of its own");
        assert_eq!(wrong("1", RULE, "").len(), 1);
        assert_eq!(wrong("1", RULE, "simulator, Linux").len(), 1);
        assert_eq!(wrong("60", "`core/a.rs::a_test`; later: tasks under embassy", "core").len(), 1);
        assert_eq!(wrong("13c", "pending", "").len(), 1);
    }

    #[test]
    fn missing_doubled_and_unknown_numbers_are_told() {
        let rest = "promise | `core/a.rs::a_test` | core |\n";
        let all: String = numbers().map(|number| format!("| {number} | {rest}")).collect();
        assert_eq!(faults(&all), [""; 0]);
        assert_eq!(faults(&format!("{all}| 5 | {rest}")).len(), 1);
        assert_eq!(faults(&format!("{all}| 78 | {rest}")).len(), 1);
        assert_eq!(faults(all.trim_start_matches(&format!("| 1 | {rest}"))).len(), 1);
    }

    #[test]
    fn a_test_is_told_from_a_helper() {
        assert!(is_test(SOURCE, "a_test") && is_test(SOURCE, "tests::a_test"));
        assert!(!is_test(SOURCE, "helper") && !is_test(SOURCE, "left_out") && !is_test(SOURCE, "commented"));
    }
}
