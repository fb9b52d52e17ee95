//! Whether a command printed what the guide shows. `…` stands for anything within a line, and alone for any lines;
//! spaces count as one, since tables are as wide as their contents.

/// Whether the lines are as shown.
pub(crate) fn matches(shown: &[String], printed: &[&str]) -> bool {
    match shown.split_first() {
        None => printed.iter().all(|line| line.trim().is_empty()),
        Some((first, rest)) if first.trim() == "…" => (0..=printed.len()).any(|skip| matches(rest, &printed[skip..])),
        Some((first, rest)) => {
            printed.split_first().is_some_and(|(line, others)| line_matches(first, line) && matches(rest, others))
        }
    }
}

/// Whether one line is as shown.
pub(crate) fn line_matches(shown: &str, printed: &str) -> bool {
    let (shown, printed) = (single_spaced(shown), single_spaced(printed));
    let mut pieces = shown.split('…');
    let first = pieces.next().unwrap_or_default();
    let Some(mut rest) = printed.strip_prefix(first) else { return false };
    let mut pieces: Vec<&str> = pieces.collect();
    let Some(last) = pieces.pop() else { return rest.is_empty() };
    for piece in pieces {
        match rest.find(piece) {
            Some(at) => rest = &rest[at + piece.len()..],
            None => return false,
        }
    }
    rest.ends_with(last)
}

fn single_spaced(line: &str) -> String {
    line.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_ellipsis_within_a_line_is_anything() {
        assert!(line_matches("agv-1  at … after … ms", "agv-1 at 127.0.0.1:40 after 12.3 ms"));
        assert!(line_matches("a…", "a"), "nothing is anything too");
        assert!(!line_matches("agv-1 at … ms", "agv-2 at 3 ms"));
        assert!(!line_matches("exact", "exact not"));
    }

    #[test]
    fn an_ellipsis_alone_is_any_lines() {
        let shown = ["one", "…", "four"].map(String::from);
        assert!(matches(&shown, &["one", "two", "three", "four", ""]));
        assert!(matches(&shown, &["one", "four"]));
        assert!(!matches(&shown, &["one", "two", "three"]));
        assert!(!matches(&shown[..1], &["one", "two"]));
    }
}
