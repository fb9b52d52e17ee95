//! What holds for every file: no source file too long to read, no path of one machine, no unsafe in the Linux port, no
//! failing case of a property lost.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};

use crate::command::Run;
use crate::{source, workspace};

/// Lines that a source file may have, its tests included.
const LONGEST: usize = 800;

/// Folders of one machine; put together here so that this file does not name them.
const MACHINE_PATHS: [&str; 2] = [concat!("/", "work/"), concat!("/", "tmp/")];

/// Folders in which proptest keeps the cases that failed.
const REGRESSIONS: &str = "proptest-regressions";

/// Reads all files of the project and fails with every offence.
pub(crate) fn check() -> Result<()> {
    let mut wrong = Vec::new();
    let files = workspace::files()?;
    for file in &files {
        // Golden vectors and the like need not be text.
        if let Ok(text) = workspace::read(file) {
            wrong.extend(offences(file, &text));
            wrong.extend(loses_failing_cases(file, &text, &files));
        }
    }
    wrong.extend(cases_outside_of_the_repository()?);
    if wrong.is_empty() {
        println!("{} files, none too long, none with a path of one machine", files.len());
        return Ok(());
    }
    wrong.iter().for_each(|line| eprintln!("{line}"));
    bail!("{} offences", wrong.len())
}

fn offences(file: &Path, text: &str) -> Vec<String> {
    let name = file.display();
    let mut found = Vec::new();
    for (number, line) in text.lines().enumerate() {
        if let Some(path) = machine_path(line) {
            found.push(format!("{name}:{}: names {path}, a folder of one machine", number + 1));
        }
    }
    if file.extension().is_none_or(|extension| extension != "rs") {
        return found;
    }
    let lines = text.lines().count();
    if lines > LONGEST {
        found.push(format!("{name}: {lines} lines, {LONGEST} are allowed: it answers more than one question"));
    }
    if file.starts_with("std-port") {
        let tokens = source::tokens(text);
        found.extend(
            tokens.iter().filter(|token| token.text == "unsafe").map(|token| format!("{name}:{}: unsafe", token.line)),
        );
    }
    found
}

/// proptest keeps what failed beside the `lib.rs` or `main.rs` above a file, and nowhere if there is none.
fn loses_failing_cases(file: &Path, text: &str, files: &[PathBuf]) -> Option<String> {
    if file.extension().is_none_or(|extension| extension != "rs") {
        return None;
    }
    let tokens = source::tokens(text);
    let has_property = tokens.windows(2).any(|pair| pair[0].text == "proptest" && pair[1].text == "!");
    let has_root = |folder: &Path| ["lib.rs", "main.rs"].iter().any(|root| files.contains(&folder.join(root)));
    let loses = has_property && !file.ancestors().skip(1).any(has_root);
    loses.then(|| format!("{}: its failing cases are not kept: no lib.rs or main.rs is above it", file.display()))
}

/// Failing cases that git hides, or that are not committed.
fn cases_outside_of_the_repository() -> Result<Vec<String>> {
    let pattern = format!("*{REGRESSIONS}/*");
    let others = Run::new("git").args(["ls-files", "--others", "--", &pattern]).text()?;
    Ok(others.lines().map(|file| format!("{file}: a failing case that is not committed")).collect())
}

/// A machine's folder at the start of a path, not in the middle of one.
fn machine_path(line: &str) -> Option<&'static str> {
    let at_start = |path: &str| {
        line.match_indices(path).any(|(at, _)| {
            let before = line[..at].chars().next_back();
            before.is_none_or(|c| !c.is_alphanumeric() && !"._-/}*".contains(c))
        })
    };
    MACHINE_PATHS.into_iter().find(|path| at_start(path))
}

#[cfg(test)]
mod tests {
    use super::{LONGEST, MACHINE_PATHS, loses_failing_cases, offences};
    use std::path::{Path, PathBuf};

    #[test]
    fn a_long_file_is_told() {
        let file = Path::new("core/src/time.rs");
        assert!(offences(file, &"\n".repeat(LONGEST)).is_empty());
        assert_eq!(offences(file, &"\n".repeat(LONGEST + 1)).len(), 1);
        assert!(offences(Path::new("Cargo.lock"), &"\n".repeat(LONGEST + 1)).is_empty());
    }

    #[test]
    fn a_path_of_a_machine_is_told() {
        let [work, temporary] = MACHINE_PATHS;
        let reported = |text: String| offences(Path::new("README.md"), &text).len();
        assert_eq!(reported(format!("see `{work}main`")), 1);
        assert_eq!(reported(format!("(\"{temporary}x\")\n")), 1);
        assert_eq!(reported(format!("target{temporary}x and https://example.org{work}")), 0);
    }

    #[test]
    fn unsafe_in_the_linux_port_is_told() {
        assert_eq!(offences(Path::new("std-port/src/lib.rs"), "// unsafe\nunsafe {}").len(), 1);
        assert!(offences(Path::new("embassy-port/src/lib.rs"), "unsafe {}").is_empty());
    }

    #[test]
    fn a_property_whose_failing_cases_are_not_kept_is_told() {
        let files = ["core/src/lib.rs", "sim/tests/network/main.rs"].map(PathBuf::from);
        let reported = |file: &str, text: &str| loses_failing_cases(Path::new(file), text, &files).is_some();
        assert!(reported("core/tests/hostile.rs", "proptest! {}"));
        assert!(!reported("core/tests/hostile.rs", "use proptest::prelude::*; // proptest! {}"));
        assert!(!reported("core/src/services/session/tests.rs", "proptest! {}"));
        assert!(!reported("sim/tests/network/streams.rs", "proptest! {}"));
    }
}
