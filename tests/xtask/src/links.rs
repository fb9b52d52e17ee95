//! What the Markdown documents point at exists: files, headings of documents, and tests.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};

use anyhow::{Result, bail};

use crate::workspace;

/// Documents that name tests without their files.
const NAME_TESTS: [&str; 4] =
    ["docs/reliability.md", "docs/testing.md", "docs/notes/safe-stop.md", "docs/notes/what-a-stop-waits-for.md"];

/// Reads every Markdown file and fails with all that leads nowhere.
pub(crate) fn check() -> Result<()> {
    let mut texts = BTreeMap::new();
    for file in workspace::files_with("md")? {
        texts.insert(file.clone(), workspace::read(&file)?);
    }
    let (mut count, mut broken) = (0, Vec::new());
    for (file, text) in &texts {
        for target in targets(text) {
            count += 1;
            let exists = |path: &Path| workspace::root().join(path).exists();
            if !leads_somewhere(file, target, &texts, exists) {
                broken.push(format!("{}: {target} does not exist", file.display()));
            }
        }
    }
    let mut functions = BTreeSet::new();
    for file in workspace::files_with("rs")? {
        functions.extend(defined(&workspace::read(&file)?).map(str::to_owned));
    }
    for document in NAME_TESTS {
        let text = workspace::read(Path::new(document))?;
        let missing = sentences(&text).filter(|name| !functions.contains(*name));
        broken.extend(missing.map(|name| format!("{document}: no test is called {name}")));
    }
    if broken.is_empty() {
        println!("{count} relative links in {} documents", texts.len());
        return Ok(());
    }
    broken.iter().for_each(|line| eprintln!("{line}"));
    bail!("{} links and names lead nowhere", broken.len())
}

/// What `](…)` names; addresses on the net are not looked up.
fn targets(text: &str) -> impl Iterator<Item = &str> {
    text.split("](").skip(1).filter_map(|rest| {
        let target = rest.split(')').next()?.trim();
        (!target.is_empty() && !target.contains("://") && !target.starts_with("mailto:")).then_some(target)
    })
}

/// Whether the file that `target` names in the document `from` exists, and has its heading if it is a document.
fn leads_somewhere(
    from: &Path,
    target: &str,
    texts: &BTreeMap<PathBuf, String>,
    exists: impl Fn(&Path) -> bool,
) -> bool {
    let (path, heading) = target.split_once('#').map_or((target, None), |(path, heading)| (path, Some(heading)));
    let mut file = from.to_owned();
    if !path.is_empty() {
        file.pop();
        for part in Path::new(path).components() {
            match part {
                Component::ParentDir => {
                    file.pop();
                }
                part => file.push(part),
            }
        }
    }
    match (heading, texts.get(&file)) {
        (Some(heading), Some(text)) => headings(text).any(|known| known == heading),
        _ => exists(&file),
    }
}

/// As addresses name them; a heading that stands there again has a number behind it.
fn headings(text: &str) -> impl Iterator<Item = String> {
    let mut seen = BTreeMap::<String, usize>::new();
    let prose = text.split("```").step_by(2).flat_map(str::lines);
    prose.filter(|line| line.starts_with('#')).map(move |line| {
        // Of a link only its text.
        let shown = line.split("](").enumerate().map(|(place, part)| match place {
            0 => part,
            _ => part.split_once(')').map_or("", |(_, rest)| rest),
        });
        let title = shown.collect::<String>().trim_start_matches('#').trim().to_lowercase();
        let kept = title.chars().filter(|letter| letter.is_alphanumeric() || " -_".contains(*letter));
        let heading: String = kept.map(|letter| if letter == ' ' { '-' } else { letter }).collect();
        let times = seen.entry(heading.clone()).or_default();
        *times += 1;
        if *times == 1 { heading } else { format!("{heading}-{}", *times - 1) }
    })
}

fn defined(source: &str) -> impl Iterator<Item = &str> {
    source.split("fn ").skip(1).filter_map(|rest| rest.split(|c: char| !c.is_alphanumeric() && c != '_').next())
}

/// Names in backquotes that read like those of tests: four words or more.
fn sentences(text: &str) -> impl Iterator<Item = &str> {
    let is_word = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_';
    let quoted = text.split('`').skip(1).step_by(2);
    quoted.filter(move |name| name.chars().all(is_word) && name.matches('_').count() >= 3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relative_targets_are_found() {
        let text = "[a](docs/wire.md#frames) [b](https://example.org) [c](#here) ![d](e.svg)";
        assert_eq!(targets(text).collect::<Vec<_>>(), ["docs/wire.md#frames", "#here", "e.svg"]);
    }

    #[test]
    fn a_heading_that_is_not_there_is_noticed() {
        let text = "# A *page*\n```\n# no heading\n```\n## What [`it`](b.md) does, twice\n## A page\n";
        let texts = BTreeMap::from([(PathBuf::from("docs/a.md"), text.to_owned())]);
        let leads = |from: &str, target| {
            leads_somewhere(Path::new(from), target, &texts, |path| path == "docs/a.md" || path == "e.svg")
        };
        for well in ["#a-page", "#a-page-1", "a.md#what-it-does-twice", "../e.svg", "a.md"] {
            assert!(leads("docs/a.md", well), "{well}");
        }
        for broken in ["#no-heading", "a.md#a-page-2", "e.svg", "b.md#a-page", "../a.md"] {
            assert!(!leads("docs/a.md", broken), "{broken}");
        }
        assert!(leads("README.md", "docs/a.md#a-page"));
    }

    #[test]
    fn names_of_tests_are_found() {
        let text = "`a_call_runs_once`, `cargo xtask test`, `two_words`, `Has_a_big_letter`, `it_is_well_so`";
        assert_eq!(sentences(text).collect::<Vec<_>>(), ["a_call_runs_once", "it_is_well_so"]);
        assert_eq!(defined("fn a() {}\npub(crate) async fn b_c<T>()").collect::<Vec<_>>(), ["a", "b_c"]);
    }
}
