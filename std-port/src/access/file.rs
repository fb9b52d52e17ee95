//! The file of a table: TOML, read whole and validated before any of it takes effect.

use std::fs::File as OpenFile;
use std::io::Read;
use std::ops::Range;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use cara_core::distribution::function::Definition;
use cara_core::services::access::{Functions, Rate, Verb, Verbs};
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::words::{self, ANY};
use super::{AccessError, AccessMistake, AccessTable, OwnedRule};

/// Longest file in bytes.
pub const LONGEST_FILE: u64 = 1024 * 1024;
/// Permission of all users to write.
const OTHERS_WRITE: u32 = 0o002;

/// A rule as it is written.
#[derive(Default)]
struct Row<'t> {
    who: Given<'t>,
    functions: Given<'t>,
    verbs: Given<'t>,
    rate: Option<Spanned<&'t str>>,
}

/// What stands behind a key.
#[derive(Default)]
enum Given<'t> {
    #[default]
    Nothing,
    /// No words, which has been told.
    Wrong,
    /// One word, or several in an array.
    Words(Spanned<Vec<&'t str>>),
}

impl AccessTable {
    /// Reads a file. One that all users can write is refused: any of them could grant any permission.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, AccessError> {
        let path = path.as_ref();
        let file = path.display().to_string();
        let unreadable = |reason: String| AccessError::Unreadable { file: file.clone(), reason };
        let found = path.metadata().map_err(|error| unreadable(error.to_string()))?;
        // A pipe would keep us waiting for its other end.
        if !found.is_file() {
            return Err(unreadable("it is no file".to_owned()));
        }
        let mut open = OpenFile::open(path).map_err(|error| unreadable(error.to_string()))?;
        if found.mode() & OTHERS_WRITE != 0 {
            return Err(unreadable(format!("every user can write it: chmod o-w {file}")));
        }
        let mut text = String::new();
        let read = (&mut open).take(LONGEST_FILE + 1).read_to_string(&mut text);
        read.map_err(|error| unreadable(error.to_string()))?;
        if text.len() as u64 > LONGEST_FILE {
            return Err(unreadable(format!("it has more than {LONGEST_FILE} bytes: is it an access table?")));
        }
        Self::parse(&file, &text)
    }

    /// Reads the text of a file; all of its mistakes are told at once, in the order of their places.
    pub fn parse(file: &str, text: &str) -> Result<Self, AccessError> {
        let (document, broken) = DeTable::parse_recoverable(text);
        let mut checker = Checker { file, text, is_whole: broken.is_empty(), mistakes: Vec::new() };
        for error in &broken {
            let what = error.message().trim_end().replace('\n', " ");
            checker.wrong(&error.span().unwrap_or(0..0), what, "docs/access.md shows every key");
        }
        let table = checker.table(document.get_ref());
        let mut mistakes = checker.mistakes;
        let of_meaning = mistakes.split_off(broken.len());
        let unread: Vec<usize> = mistakes.iter().map(|mistake| mistake.line).collect();
        // The rest of a line that cannot be parsed is not reported as a second mistake.
        mistakes.extend(of_meaning.into_iter().filter(|mistake| !unread.contains(&mistake.line)));
        mistakes.sort_by_key(|mistake| (mistake.line, mistake.column));
        if mistakes.is_empty() { Ok(table) } else { Err(AccessError::Mistakes(mistakes)) }
    }
}

struct Checker<'t> {
    file: &'t str,
    text: &'t str,
    /// All of it could be read: what is not there is missing.
    is_whole: bool,
    mistakes: Vec<AccessMistake>,
}

impl Checker<'_> {
    fn wrong(&mut self, span: &Range<usize>, what: impl Into<String>, help: &str) {
        self.mistakes.push(AccessMistake::at(self.file, self.text, span, what, help));
    }

    fn missing(&mut self, span: &Range<usize>, what: impl Into<String>, help: &str) {
        if self.is_whole {
            self.wrong(span, what, help);
        }
    }

    fn table(&mut self, document: &DeTable<'_>) -> AccessTable {
        let mut table = AccessTable { source: self.file.to_owned(), ..AccessTable::default() };
        for key in document.keys().filter(|key| key.get_ref() != "allow") {
            self.wrong(&key.span(), format!("unknown key `{}`", key.get_ref()), "a table is made of [[allow]] alone");
        }
        let Some(rows) = document.get("allow") else {
            // A file that is being written may be seen empty.
            self.missing(&(0..0), "there is no rule", "write [[allow]], or allow = [] if nothing is to be allowed");
            return table;
        };
        let DeValue::Array(list) = rows.get_ref() else {
            self.wrong(&rows.span(), "`allow` is no array of rules", "write [[allow]] before each rule");
            return table;
        };
        for row in list.iter() {
            let DeValue::Table(keys) = row.get_ref() else {
                self.wrong(&row.span(), "this is no rule", "write [[allow]] before each rule");
                continue;
            };
            let line = AccessMistake::at(self.file, self.text, &row.span(), "", "").line;
            let written = self.row(keys);
            for rule in self.rules(&written, &row.span()) {
                table.rules.push(rule);
                table.lines.push(line);
            }
        }
        table
    }

    fn row<'r>(&mut self, keys: &'r DeTable<'_>) -> Row<'r> {
        let mut row = Row::default();
        for (key, value) in keys {
            match key.get_ref().as_ref() {
                "who" => row.who = self.words(value),
                "functions" => row.functions = self.words(value),
                "verbs" => row.verbs = self.words(value),
                "rate" => row.rate = self.text(value).map(|rate| Spanned::new(value.span(), rate)),
                other => {
                    let help = "a rule has `who`, `functions`, `verbs` and, where calls are limited, `rate`";
                    self.wrong(&key.span(), format!("unknown key `{other}`"), help);
                }
            }
        }
        row
    }

    fn words<'r>(&mut self, value: &'r Spanned<DeValue<'_>>) -> Given<'r> {
        let words = match value.get_ref() {
            DeValue::Array(list) => list.iter().map(|word| self.text(word)).collect(),
            _ => self.text(value).map(|word| vec![word]),
        };
        words.map_or(Given::Wrong, |words| Given::Words(Spanned::new(value.span(), words)))
    }

    fn text<'r>(&mut self, value: &'r Spanned<DeValue<'_>>) -> Option<&'r str> {
        let text = value.get_ref().as_str();
        if text.is_none() {
            let what = format!("this is no text, but {}", value.get_ref().type_str());
            self.wrong(&value.span(), what, "write it in double quotes");
        }
        text
    }

    /// The rules of a row: one for each of those that it names.
    fn rules(&mut self, written: &Row<'_>, row: &Range<usize>) -> Vec<OwnedRule> {
        let verbs = self.verbs(&written.verbs, row);
        let functions = self.functions(&written.functions, row);
        let rate = written.rate.as_ref().and_then(|rate| self.rate(rate, verbs));
        let Some(who) = self.given(&written.who, row, "who", "write who = \"AGV_manager/1\", for instance") else {
            return Vec::new();
        };
        let mut rules = Vec::new();
        for words in who.get_ref() {
            match words::who(words) {
                Ok(who) => {
                    let verbs = verbs.unwrap_or(Verbs::NONE);
                    rules.push(OwnedRule { who, functions: functions.clone(), verbs, rate });
                }
                Err(error) => {
                    let text = error.to_string();
                    let (what, help) = text.split_once(": ").unwrap_or((&text, ""));
                    self.wrong(&who.span(), what, help);
                }
            }
        }
        rules
    }

    /// A key that must be there, with at least one word.
    fn given<'g, 't>(
        &mut self,
        words: &'g Given<'t>,
        row: &Range<usize>,
        key: &str,
        help: &str,
    ) -> Option<&'g Spanned<Vec<&'t str>>> {
        match words {
            Given::Nothing => self.missing(row, format!("the rule has no `{key}`"), help),
            Given::Wrong => {}
            Given::Words(words) if words.get_ref().is_empty() => {
                self.wrong(&words.span(), format!("`{key}` is empty"), help);
            }
            Given::Words(words) => return Some(words),
        }
        None
    }

    /// `None` where there are none to be judged.
    fn verbs(&mut self, words: &Given<'_>, row: &Range<usize>) -> Option<Verbs> {
        const HELP: &str = "write \"list\", \"call\", \"take_over\" or \"publish\", or several of them in an array";
        let words = self.given(words, row, "verbs", HELP)?;
        let mut verbs = Verbs::NONE;
        for word in words.get_ref() {
            match words::verb(word) {
                Some(verb) => verbs = verbs.and(verb.into()),
                None => self.wrong(&words.span(), format!("'{word}' is no verb"), HELP),
            }
        }
        (verbs != Verbs::NONE).then_some(verbs)
    }

    fn functions(&mut self, words: &Given<'_>, row: &Range<usize>) -> Functions<Vec<String>> {
        const HELP: &str = "write the names of functions, as [\"go_to\", \"stop\"], or \"*\" alone for all of them";
        let Some(words) = self.given(words, row, "functions", HELP) else { return Functions::All };
        let names = words.get_ref();
        if names.as_slice() == [ANY] {
            return Functions::All;
        }
        for name in names {
            // The name alone, as the signature of a function without arguments.
            if Definition::parse(&format!("{name}()")).map_or(true, |known| known.name() != *name) {
                self.wrong(&words.span(), format!("'{name}' is no function's name"), HELP);
            }
        }
        Functions::Named(names.iter().map(|name| (*name).to_owned()).collect())
    }

    fn rate(&mut self, written: &Spanned<&str>, verbs: Option<Verbs>) -> Option<Rate> {
        let rate = words::rate(written.get_ref());
        if rate.is_none() {
            let what = format!("'{}' is no rate", written.get_ref());
            self.wrong(&written.span(), what, "write calls in a span of time: \"10/s\", \"5/min\" or \"1/h\"");
        } else if verbs.is_some_and(|verbs| !verbs.contains(Verb::Call)) {
            let help = "add \"call\" to the verbs, or take the rate out";
            self.wrong(&written.span(), "a rate is about calls, and this rule allows none", help);
        }
        rate
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cara_core::distribution::identity::Identity;
    use cara_core::services::access::Principal;

    fn places(text: &str) -> Vec<(usize, usize, String)> {
        match AccessTable::parse("a.toml", text) {
            Err(AccessError::Mistakes(list)) => {
                list.into_iter().map(|mistake| (mistake.line, mistake.column, mistake.what)).collect()
            }
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_row_is_a_rule_for_each_of_those_whom_it_names() {
        let text = "# who\n[[allow]]\nwho = [\"a/1\", \"m_units\"]\nfunctions = \"*\"\nverbs = [\"list\", \"call\"]\nrate = \"2/s\"\n\n\
                    [[allow]]\nwho = \"operator\"\nfunctions = [\"stop\"]\nverbs = \"call\"\n";
        let table = AccessTable::parse("a.toml", text).unwrap();
        assert_eq!(table.rules().len(), 3);
        assert_eq!([0, 1, 2, 3].map(|rule| table.line(rule)), [Some(2), Some(2), Some(8), None]);
        let other = Identity::m_unit("b", 2).unwrap();
        let decision = table.decide(Principal::Node(&other), "go_to", Verb::Call);
        assert_eq!(decision, super::super::Decision::Allowed { rule: 1, rate: Some(Rate::per_second(2)) });
        assert_eq!(
            table.to_string(),
            "a/1 may list and call every function, 2/s\nevery m_unit may list and call every function, 2/s\n\
             operator may call stop\n"
        );
    }

    #[test]
    fn every_mistake_of_meaning_is_told_with_its_place() {
        let text = "[[allow]]\nwho = \"agv\"\nfunctions = [\"go to\", \"*\"]\nverbs = [\"cal\"]\nrate = \"fast\"\n\
                    [[allow]]\nwho = []\n";
        let found = places(text);
        let found: Vec<(usize, usize, &str)> = found.iter().map(|(l, c, what)| (*l, *c, what.as_str())).collect();
        assert_eq!(
            found,
            [
                (2, 7, "'agv' names no node"),
                (3, 13, "'go to' is no function's name"),
                (3, 13, "'*' is no function's name"),
                (4, 9, "'cal' is no verb"),
                (5, 8, "'fast' is no rate"),
                (6, 1, "the rule has no `verbs`"),
                (6, 1, "the rule has no `functions`"),
                (7, 7, "`who` is empty"),
            ]
        );
    }

    #[test]
    fn a_mistake_of_form_is_told_with_its_place() {
        for (text, expected) in [
            ("[[allow]]\nwho = 7\nfunctions = \"*\"\nverbs = \"call\"\n", &[(2, 7)][..]),
            ("[[allow]]\nwhom = \"a/1\"\nfunctions = \"*\"\nverbs = \"call\"\n", &[(1, 1), (2, 1)]),
            ("allow = 1\n", &[(1, 9)]),
            ("allow = [1]\n", &[(1, 10)]),
            ("[[allow]\n", &[(1, 9)]),
            ("deny = []\n", &[(1, 1), (1, 1)]),
            ("", &[(1, 1)]),
        ] {
            let found = places(text);
            let found: Vec<(usize, usize)> = found.iter().map(|(line, column, _)| (*line, *column)).collect();
            assert_eq!(found, expected, "{text:?}");
        }
    }

    /// Unknown keys, wrong types, words without a meaning and lines that cannot be read, in one file.
    #[test]
    fn all_mistakes_of_a_file_are_told_at_once() {
        let text = "deny = []\n[[allow]]\nwho = 7\nfunctions = [\"stop\", true]\nverbs = [\"cal\"]\n\
                    [[allow]]\nwhom = \"a/1\"\nfunctions = \"*\"\nverbs = \"call\"\nrate = 5\n";
        let found = places(text);
        let found: Vec<(usize, usize, &str)> = found.iter().map(|(l, c, what)| (*l, *c, what.as_str())).collect();
        assert_eq!(
            found,
            [
                (1, 1, "unknown key `deny`"),
                (3, 7, "this is no text, but integer"),
                (4, 22, "this is no text, but boolean"),
                (5, 9, "'cal' is no verb"),
                (6, 1, "the rule has no `who`"),
                (7, 1, "unknown key `whom`"),
                (10, 8, "this is no text, but integer"),
            ]
        );
        let text = "[[allow]]\nwho = \"a/1\nfunctions = \"*\"\nverbs = \"cal\"\nrate = \n";
        let found: Vec<(usize, String)> = places(text).into_iter().map(|(line, _, what)| (line, what)).collect();
        let lines: Vec<usize> = found.iter().map(|(line, _)| *line).collect();
        assert_eq!(lines, [2, 4, 5], "{found:?}");
    }

    #[test]
    fn a_rate_without_calls_is_a_mistake_and_no_rule_must_be_written_out() {
        let text = "[[allow]]\nwho = \"*\"\nfunctions = \"*\"\nverbs = \"list\"\nrate = \"1/s\"\n";
        assert_eq!(places(text), [(5, 8, "a rate is about calls, and this rule allows none".to_owned())]);
        assert!(AccessTable::parse("a.toml", "allow = []\n").unwrap().rules().is_empty());
    }

    #[test]
    fn a_file_that_everybody_can_write_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("access.toml");
        assert!(matches!(AccessTable::read(&path), Err(AccessError::Unreadable { .. })));
        std::fs::write(&path, "allow = []\n").unwrap();
        for (mode, refused) in [(0o644, false), (0o600, false), (0o666, true)] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            assert_eq!(AccessTable::read(&path).is_err(), refused, "{mode:o}");
        }
    }
}
