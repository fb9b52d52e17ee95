//! The subject of a comment is the thing it is about: pronouns for a person in its place are counted, and stay rare.

use anyhow::{Result, bail};

use crate::workspace;

/// The pronouns that are counted, also within a compound such as who-has.
const PRONOUNS: [&str; 5] = ["who", "whoever", "whom", "somebody", "nobody"];

/// Pronouns per 10,000 words of comments that are allowed. The codebases that this one learns from have 0 to 0.3.
const ALLOWED: usize = 5;

/// Files that are named when there are too many.
const WORST: usize = 10;

/// Words and pronouns of comments.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Count {
    words: usize,
    pronouns: usize,
}

/// Counts over all Rust files of the project.
pub(crate) fn check() -> Result<()> {
    let mut counted = Vec::new();
    for file in workspace::files_with("rs")? {
        counted.push((count(&workspace::read(&file)?), file));
    }
    let sum = |of: fn(&Count) -> usize| counted.iter().map(|(count, _)| of(count)).sum::<usize>();
    let (words, pronouns) = (sum(|count| count.words), sum(|count| count.pronouns));
    let found = format!("{pronouns} of {} in {words} words of comments", PRONOUNS.join(", "));
    if pronouns * 10_000 <= words * ALLOWED {
        println!("{found}");
        return Ok(());
    }
    counted.sort_by_key(|(count, _)| std::cmp::Reverse(count.pronouns));
    counted.iter().take(WORST).for_each(|(count, file)| eprintln!("{:4} {}", count.pronouns, file.display()));
    bail!("{found}: {ALLOWED} in 10,000 are allowed; name the thing instead")
}

fn count(text: &str) -> Count {
    text.lines().filter_map(comment).fold(Count::default(), |Count { words, pronouns }, comment| {
        let found = comment.split(|c: char| !c.is_alphanumeric() && c != '_');
        let found = found.filter(|word| PRONOUNS.iter().any(|pronoun| word.eq_ignore_ascii_case(pronoun)));
        Count { words: words + comment.split_whitespace().count(), pronouns: pronouns + found.count() }
    })
}

/// The comment of a line, at its start or behind code.
fn comment(line: &str) -> Option<&str> {
    let line = line.trim_start();
    match line.strip_prefix("//") {
        Some(rest) => Some(rest.trim_start_matches(['/', '!'])),
        None => line.split_once(" // ").map(|(_, comment)| comment),
    }
}

#[cfg(test)]
mod tests {
    use super::{Count, count};

    #[test]
    fn comments_of_every_form_are_counted() {
        let counted = |text| count(text);
        assert_eq!(counted("//! Nobody reads it."), Count { words: 3, pronouns: 1 });
        assert_eq!(counted("    /// A who-has, whoever sends it.\n"), Count { words: 5, pronouns: 2 });
        assert_eq!(counted("let a = 1; // for whom?"), Count { words: 2, pronouns: 1 });
    }

    #[test]
    fn code_is_not_counted() {
        assert_eq!(count("let who = \"nobody\"; whoever();\nlet url = \"http://who\";"), Count::default());
        assert_eq!(count("/// The whole."), Count { words: 2, pronouns: 0 });
    }
}
