//! `docs/security.md`: every claim of the threat model names its tests, and those exist.

use std::path::Path;

use anyhow::Result;

use crate::bad_input::references;
use crate::{paper, workspace};

const TABLE: &str = "docs/security.md";

/// What the table must make a claim about, once each.
const SUBJECTS: [&str; 30] = [
    "wrong key",
    "no key",
    "key of another fleet",
    "revoked key",
    "key of another unit",
    "replay",
    "orders",
    "flipped bits",
    "in the middle",
    "lengths",
    "downgrade",
    "interoperation",
    "repeated random numbers",
    "key and number pairs",
    "boards' random numbers",
    "rekeying",
    "discovery",
    "recorded and forged discovery",
    "relayed answers",
    "amplification",
    "flood of links",
    "flood of datagrams",
    "access",
    "operator",
    "key files",
    "keys on a board",
    "keys in logs",
    "keys of a fleet in change",
    "revocation",
    "refusals",
];

/// Reads the table and fails with everything that is missing in it.
pub(crate) fn check() -> Result<()> {
    let read = |path: &str| workspace::read(Path::new(path)).unwrap_or_default();
    let exists = |path: &str| workspace::root().join(path).exists();
    let wrong = problems(&read(TABLE), exists, read);
    paper::verdict(TABLE, &wrong, &format!("{} claims about security, each with its tests", SUBJECTS.len()))
}

fn problems(table: &str, exists: impl Fn(&str) -> bool, read: impl Fn(&str) -> String) -> Vec<String> {
    let rows: Vec<(&str, &str)> = table.lines().filter_map(row).collect();
    let mut wrong = Vec::new();
    for subject in SUBJECTS {
        match rows.iter().filter(|(found, _)| *found == subject).count() {
            1 => {}
            count => wrong.push(format!("{subject} stands there {count} times")),
        }
    }
    for (subject, tests) in rows {
        let named = references(tests);
        if !SUBJECTS.contains(&subject) {
            wrong.push(format!("{subject}: this claim is not in the list of claims, so its loss would not be noticed"));
        }
        if named.is_empty() {
            wrong.push(format!("{subject}: names no test"));
        }
        let broken = named.into_iter().filter_map(|name| paper::broken(name, &exists, &read));
        wrong.extend(broken.map(|why| format!("{subject}: {why}")));
    }
    wrong
}

/// Subject and tests of a line of the table; `None` for any other line. Its first line names the columns.
fn row(line: &str) -> Option<(&str, &str)> {
    let cells: Vec<&str> = line.trim().strip_prefix("| **")?.strip_suffix('|')?.split('|').map(str::trim).collect();
    let [subject, _claim, tests] = cells[..] else { return None };
    Some((subject.strip_suffix("**")?, tests))
}

#[cfg(test)]
mod tests {
    use super::{SUBJECTS, problems};

    /// A table in which all is well but for one claim.
    fn wrong(subject: &str, tests: &str) -> Vec<String> {
        let line = |(number, known): (usize, &&str)| {
            let (known, tests) = if number == 0 { (subject, tests) } else { (*known, "`a.rs::a_test`") };
            format!("| **{known}** | it does not matter | {tests} |\n")
        };
        faults(&SUBJECTS.iter().enumerate().map(line).collect::<String>())
    }

    fn faults(table: &str) -> Vec<String> {
        problems(table, |path| path == "a.rs", |_| "fn a_test() {}".to_owned())
    }

    #[test]
    fn a_full_table_passes() {
        assert_eq!(wrong(SUBJECTS[0], "`a.rs::a_test`, `a.rs`"), [""; 0]);
    }

    #[test]
    fn what_is_missing_is_told() {
        for tests in ["", "a.rs", "`b.rs::a_test`", "`a.rs::another`"] {
            assert_eq!(wrong(SUBJECTS[0], tests).len(), 1, "{tests}");
        }
        assert_eq!(wrong("magic", "`a.rs::a_test`").len(), 2);
        assert_eq!(faults("").len(), SUBJECTS.len());
    }
}
