//! The file of a table: TOML, read whole and checked before anything of it counts.

use std::fmt;
use std::fs::File as OpenFile;
use std::io::Read;
use std::ops::Range;
use std::os::unix::fs::MetadataExt;
use std::path::Path;

use cara_core::distribution::function::Definition;
use cara_core::services::access::{Functions, Rate, Verb, Verbs};
use serde::de::{SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use toml::Spanned;

use super::words::{self, ANY};
use super::{AccessError, AccessMistake, AccessTable, OwnedRule};

/// Longest file in bytes.
pub const LONGEST_FILE: u64 = 1024 * 1024;
/// Permission of everybody to write.
const OTHERS_WRITE: u32 = 0o002;

/// The file as it is written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    allow: Option<Vec<Spanned<Row>>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    who: Option<Spanned<Words>>,
    functions: Option<Spanned<Words>>,
    verbs: Option<Spanned<Words>>,
    rate: Option<Spanned<String>>,
}

/// One word, or several in an array.
struct Words(Vec<String>);

impl<'de> Deserialize<'de> for Words {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct OneOrMany;
        impl<'de> Visitor<'de> for OneOrMany {
            type Value = Words;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("text, or texts in an array")
            }
            fn visit_str<E>(self, word: &str) -> Result<Words, E> {
                Ok(Words(vec![word.to_owned()]))
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut array: A) -> Result<Words, A::Error> {
                let mut words = Vec::new();
                while let Some(word) = array.next_element()? {
                    words.push(word);
                }
                Ok(Words(words))
            }
        }
        from.deserialize_any(OneOrMany)
    }
}

impl AccessTable {
    /// Reads a file. One that everybody can write is refused: whoever writes it grants what they like.
    pub fn read(path: impl AsRef<Path>) -> Result<Self, AccessError> {
        let path = path.as_ref();
        let file = path.display().to_string();
        let unreadable = |reason: String| AccessError::Unreadable { file: file.clone(), reason };
        let found = path.metadata().map_err(|error| unreadable(error.to_string()))?;
        // A pipe would keep us waiting for somebody to write.
        if !found.is_file() {
            return Err(unreadable("it is no file".to_owned()));
        }
        let mut open = OpenFile::open(path).map_err(|error| unreadable(error.to_string()))?;
        if found.mode() & OTHERS_WRITE != 0 {
            return Err(unreadable(format!("everybody can write it: chmod o-w {file}")));
        }
        let mut text = String::new();
        let read = (&mut open).take(LONGEST_FILE + 1).read_to_string(&mut text);
        read.map_err(|error| unreadable(error.to_string()))?;
        if text.len() as u64 > LONGEST_FILE {
            return Err(unreadable(format!("it has more than {LONGEST_FILE} bytes: is it an access table?")));
        }
        Self::parse(&file, &text)
    }

    /// Reads the text of a file; all mistakes of meaning are told at once.
    pub fn parse(file: &str, text: &str) -> Result<Self, AccessError> {
        let mut checker = Checker { file, text, mistakes: Vec::new() };
        let table = checker.table();
        if checker.mistakes.is_empty() { Ok(table) } else { Err(AccessError::Mistakes(checker.mistakes)) }
    }
}

struct Checker<'t> {
    file: &'t str,
    text: &'t str,
    mistakes: Vec<AccessMistake>,
}

impl Checker<'_> {
    fn wrong(&mut self, span: &Range<usize>, what: impl Into<String>, help: &str) {
        self.mistakes.push(AccessMistake::at(self.file, self.text, span, what, help));
    }

    fn table(&mut self) -> AccessTable {
        let mut table = AccessTable { source: self.file.to_owned(), ..AccessTable::default() };
        let rows = match toml::from_str::<File>(self.text) {
            Ok(File { allow: Some(rows) }) => rows,
            Ok(File { allow: None }) => {
                // A file that is being written may be seen empty.
                self.wrong(&(0..0), "there is no rule", "write [[allow]], or allow = [] if nobody may do anything");
                return table;
            }
            Err(error) => {
                let help = "docs/access.md shows every key";
                self.wrong(&error.span().unwrap_or(0..0), error.message().trim_end().replace('\n', " "), help);
                return table;
            }
        };
        for row in &rows {
            let line = AccessMistake::at(self.file, self.text, &row.span(), "", "").line;
            for rule in self.rules(row) {
                table.rules.push(rule);
                table.lines.push(line);
            }
        }
        table
    }

    /// The rules of a row: one for each of those whom it names.
    fn rules(&mut self, row: &Spanned<Row>) -> Vec<OwnedRule> {
        let Row { who, functions, verbs, rate } = row.get_ref();
        let whole = row.span();
        let verbs = self.verbs(verbs.as_ref(), &whole);
        let functions = self.functions(functions.as_ref(), &whole);
        let rate = rate.as_ref().and_then(|rate| self.rate(rate, verbs));
        let Some(who) = self.given(who.as_ref(), &whole, "who", "write who = \"AGV_manager/1\", for instance") else {
            return Vec::new();
        };
        let mut rules = Vec::new();
        for words in &who.get_ref().0 {
            match words::who(words) {
                Ok(who) => rules.push(OwnedRule { who, functions: functions.clone(), verbs, rate }),
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
    fn given<'r>(
        &mut self,
        words: Option<&'r Spanned<Words>>,
        row: &Range<usize>,
        key: &str,
        help: &str,
    ) -> Option<&'r Spanned<Words>> {
        match words {
            None => self.wrong(row, format!("the rule has no `{key}`"), help),
            Some(words) if words.get_ref().0.is_empty() => self.wrong(&words.span(), format!("`{key}` is empty"), help),
            Some(words) => return Some(words),
        }
        None
    }

    fn verbs(&mut self, words: Option<&Spanned<Words>>, row: &Range<usize>) -> Verbs {
        const HELP: &str = "write \"list\", \"call\" or \"publish\", or several of them in an array";
        let Some(words) = self.given(words, row, "verbs", HELP) else { return Verbs::NONE };
        let mut verbs = Verbs::NONE;
        for word in &words.get_ref().0 {
            match words::verb(word) {
                Some(verb) => verbs = verbs.and(verb.into()),
                None => self.wrong(&words.span(), format!("'{word}' is no verb"), HELP),
            }
        }
        verbs
    }

    fn functions(&mut self, words: Option<&Spanned<Words>>, row: &Range<usize>) -> Functions<Vec<String>> {
        const HELP: &str = "write the names of functions, as [\"go_to\", \"stop\"], or \"*\" alone for all of them";
        let Some(words) = self.given(words, row, "functions", HELP) else { return Functions::All };
        let names = &words.get_ref().0;
        if names.len() == 1 && names.iter().all(|name| name == ANY) {
            return Functions::All;
        }
        for name in names {
            // The name alone, as the signature of a function without arguments.
            if Definition::parse(&format!("{name}()")).map_or(true, |known| known.name() != name) {
                self.wrong(&words.span(), format!("'{name}' is no function's name"), HELP);
            }
        }
        Functions::Named(names.clone())
    }

    fn rate(&mut self, written: &Spanned<String>, verbs: Verbs) -> Option<Rate> {
        let rate = words::rate(written.get_ref());
        if rate.is_none() {
            let what = format!("'{}' is no rate", written.get_ref());
            self.wrong(&written.span(), what, "write calls in a span of time: \"10/s\", \"5/min\" or \"1/h\"");
        } else if !verbs.contains(Verb::Call) {
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
                (4, 9, "'cal' is no verb"),
                (3, 13, "'go to' is no function's name"),
                (3, 13, "'*' is no function's name"),
                (5, 8, "'fast' is no rate"),
                (2, 7, "'agv' is nobody"),
                (6, 1, "the rule has no `verbs`"),
                (6, 1, "the rule has no `functions`"),
                (7, 7, "`who` is empty"),
            ]
        );
    }

    #[test]
    fn a_mistake_of_form_is_told_with_its_place() {
        for (text, place) in [
            ("[[allow]]\nwho = 7\n", (2, 7)),
            ("[[allow]]\nwhom = \"a/1\"\n", (2, 1)),
            ("[[allow]\n", (1, 9)),
            ("deny = []\n", (1, 1)),
            ("", (1, 1)),
        ] {
            let found = places(text);
            let found: Vec<(usize, usize)> = found.iter().map(|(line, column, _)| (*line, *column)).collect();
            assert_eq!(found, [place], "{text:?}");
        }
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
