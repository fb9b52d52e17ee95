//! Mistakes in a configuration file: where each is, what is wrong and what to do.

use std::fmt;
use std::ops::Range;

/// One mistake.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Mistake {
    /// Bytes of the file that are wrong.
    pub(super) span: Range<usize>,
    /// What is wrong.
    pub(super) what: String,
    /// What to do.
    pub(super) help: String,
}

impl Mistake {
    pub(super) fn new(span: Range<usize>, what: impl Into<String>, help: impl Into<String>) -> Self {
        Self { span, what: what.into(), help: help.into() }
    }
}

/// A configuration's text, and what it is called.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Source {
    pub(super) name: String,
    pub(super) text: String,
}

/// All mistakes of a file, in its order. `Display` shows each with its line and a mark below the place.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Mistakes {
    source: Source,
    list: Vec<Mistake>,
}

impl Mistakes {
    pub(super) fn new(source: &Source, mut list: Vec<Mistake>) -> Self {
        list.sort_by_key(|mistake| mistake.span.start);
        Self { source: source.clone(), list }
    }

    /// Line and column of each, both from 1; columns count characters.
    #[cfg(test)]
    pub(super) fn places(&self) -> Vec<(usize, usize)> {
        self.list.iter().map(|mistake| self.source.location(mistake.span.start).line_and_column()).collect()
    }
}

/// A place in a text.
struct Location<'a> {
    /// From 1.
    line: usize,
    /// What stands before the place in its line.
    before: &'a str,
    /// The whole line.
    text: &'a str,
}

impl Location<'_> {
    fn line_and_column(&self) -> (usize, usize) {
        (self.line, self.before.chars().count() + 1)
    }
}

impl Source {
    fn location(&self, byte: usize) -> Location<'_> {
        let byte = self.text.floor_char_boundary(byte);
        let (head, tail) = self.text.split_at(byte);
        let start = head.rfind('\n').map_or(0, |end| end + 1);
        let before = head.get(start..).unwrap_or_default();
        let rest = tail.lines().next().unwrap_or_default();
        let end = byte + if tail.starts_with('\n') { 0 } else { rest.len() };
        let text = self.text.get(start..end).unwrap_or_default();
        Location { line: head.matches('\n').count() + 1, before, text }
    }
}

impl fmt::Display for Mistakes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, mistake) in self.list.iter().enumerate() {
            if index > 0 {
                f.write_str("\n\n")?;
            }
            self.show(f, mistake)?;
        }
        Ok(())
    }
}

impl Mistakes {
    fn show(&self, f: &mut fmt::Formatter<'_>, mistake: &Mistake) -> fmt::Result {
        let location = self.source.location(mistake.span.start);
        let (line, column) = location.line_and_column();
        let number = line.to_string();
        let margin = " ".repeat(number.len());
        // Tabs stay tabs, so that the mark stands below its place whatever their width.
        let indent: String = location.before.chars().map(|c| if c == '\t' { '\t' } else { ' ' }).collect();
        let marked = self.source.text.get(mistake.span.clone()).unwrap_or_default();
        let in_line = marked.lines().next().unwrap_or_default().chars().count();
        writeln!(f, "{}:{line}:{column}: {}", self.source.name, mistake.what)?;
        writeln!(f, "{margin} |")?;
        writeln!(f, "{number} | {}", location.text)?;
        writeln!(f, "{margin} | {indent}{}", "^".repeat(in_line.max(1)))?;
        write!(f, "{margin} = {}", mistake.help)
    }
}

impl std::error::Error for Mistakes {}

#[cfg(test)]
mod tests {
    use super::*;

    fn mistakes(text: &str, span: Range<usize>) -> Mistakes {
        let source = Source { name: "a.toml".into(), text: text.into() };
        Mistakes::new(&source, vec![Mistake::new(span, "wrong", "do better")])
    }

    #[test]
    fn the_mark_stands_below_the_place() {
        let shown = mistakes("one = 1\n\tzwölf = drölf # no\nthree = 3\n", 18..24).to_string();
        assert_eq!(shown, "a.toml:2:10: wrong\n  |\n2 | \tzwölf = drölf # no\n  | \t        ^^^^^\n  = do better");
    }

    #[test]
    fn any_span_can_be_shown() {
        for text in ["", "\n", "a", "ä\n\nb", "a\r\nb"] {
            for start in 0..text.len() + 3 {
                for end in start..text.len() + 3 {
                    assert!(mistakes(text, start..end).to_string().starts_with("a.toml:"), "{text:?} {start}..{end}");
                }
            }
        }
        assert_eq!(mistakes("a\nb\n", 4..4).places(), [(3, 1)]);
    }

    #[test]
    fn they_come_in_the_order_of_the_file() {
        let source = Source { name: "a.toml".into(), text: "a\nb\n".into() };
        let list = vec![Mistake::new(2..3, "second", ""), Mistake::new(0..1, "first", "")];
        assert_eq!(Mistakes::new(&source, list).places(), [(1, 1), (2, 1)]);
    }
}
