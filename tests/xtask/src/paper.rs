//! `docs/paper.md`: every promise of the paper is shown by a test or an example, and what it names exists.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Result, bail};

use crate::workspace;

const TABLE: &str = "docs/paper.md";

/// Promises that later work may still owe.
const LATER: [&str; 3] = ["74", "75", "76"];

/// Reads the table and fails with everything that is missing in it.
pub(crate) fn check() -> Result<()> {
    let text = workspace::read(Path::new(TABLE))?;
    let exists = |path: &str| workspace::root().join(path).exists();
    let read = |path: &str| workspace::read(Path::new(path)).unwrap_or_default();
    let wrong = problems(&text, exists, read);
    verdict(TABLE, &wrong, &format!("{} promises, each with its place", numbers().count()))
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

/// 1 to 77 with 13b and 13c.
fn numbers() -> impl Iterator<Item = String> {
    (1..=77).flat_map(|number: u8| {
        let extra: &[&str] = if number == 13 { &["", "b", "c"] } else { &[""] };
        extra.iter().map(move |letter| format!("{number}{letter}"))
    })
}

fn problems(text: &str, exists: impl Fn(&str) -> bool, read: impl Fn(&str) -> String) -> Vec<String> {
    let mut shown: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    for (number, place) in text.lines().filter_map(row) {
        shown.entry(number).or_default().push(place);
    }
    let mut wrong = Vec::new();
    for number in numbers() {
        match shown.remove(number.as_str()).as_deref() {
            None => wrong.push(format!("{number} is missing")),
            Some([place]) => {
                wrong.extend(objection(&number, place, &exists, &read).map(|why| format!("{number}: {why}")));
            }
            Some(_) => wrong.push(format!("{number} stands there more than once")),
        }
    }
    wrong.extend(shown.keys().map(|number| format!("{number} is not a number of the checklist")));
    wrong
}

/// Number and place of a line of the table; `None` for any other line.
fn row(line: &str) -> Option<(&str, &str)> {
    let cells: Vec<&str> = line.trim().strip_prefix('|')?.strip_suffix('|')?.split('|').map(str::trim).collect();
    let [number, _promise, place] = cells[..] else { return None };
    number.starts_with(|c: char| c.is_ascii_digit()).then_some((number, place))
}

fn objection(
    number: &str,
    place: &str,
    exists: impl Fn(&str) -> bool,
    read: impl Fn(&str) -> String,
) -> Option<String> {
    if place.contains("pending") {
        return Some("pending".into());
    }
    let references: Vec<&str> = place.split('`').skip(1).step_by(2).collect();
    let later = place.contains("later:");
    if later && !LATER.contains(&number) {
        return Some("may not be left for later".into());
    }
    if references.is_empty() && !later {
        return Some("names no test and no example".into());
    }
    references.into_iter().find_map(|reference| broken(reference, &exists, &read))
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
    use super::{numbers, problems};

    const SOURCE: &str = "// fn commented() {}\n#[test]\nfn a_test() {}\nmod inner { }";

    /// A table in which every promise is shown, but for `number`, whose place is `place`.
    fn wrong(number: &str, place: &str) -> Vec<String> {
        let line = |found: String| {
            let place = if found == number { place } else { "`a.rs::a_test`" };
            format!("| {found} | promise | {place} |\n")
        };
        let table: String = numbers().map(line).collect();
        problems(
            &format!("| number | promise | shown by |\n|---|---|---|\n{table}"),
            |path| path == "a.rs",
            |_| SOURCE.to_owned(),
        )
    }

    #[test]
    fn a_full_table_passes() {
        assert!(wrong("1", "`a.rs::a_test`, `a.rs::inner`, `a.rs::inner::a_test` and `a.rs`").is_empty());
        assert!(wrong("74", "later: the experiments").is_empty());
        assert!(wrong("74", "`a.rs::a_test`; later: the experiments").is_empty());
    }

    #[test]
    fn what_is_not_shown_is_told() {
        for place in ["pending", "", "see the code", "later: never", "`b.rs`", "`a.rs::other`", "`a.rs::commented`"] {
            assert_eq!(wrong("1", place).len(), 1, "{place}");
        }
        assert_eq!(wrong("60", "`a.rs::a_test`; later: tasks under embassy").len(), 1);
        assert_eq!(wrong("13c", "pending").len(), 1);
    }

    #[test]
    fn missing_doubled_and_unknown_numbers_are_told() {
        let places = |table: &str| problems(table, |_| true, |_| String::new());
        let all: String = numbers().map(|number| format!("| {number} | promise | `a.rs` |\n")).collect();
        assert!(places(&all).is_empty());
        assert_eq!(places(&format!("{all}| 5 | again | `a.rs` |")).len(), 1);
        assert_eq!(places(&format!("{all}| 78 | more | `a.rs` |")).len(), 1);
        assert_eq!(places(all.trim_start_matches("| 1 | promise | `a.rs` |\n")).len(), 1);
    }
}
