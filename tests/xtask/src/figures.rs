//! Figures that are committed as a table in a document, together with the compiler that made them: written there, read
//! from there, and compared with what is measured now.

use std::path::PathBuf;

use anyhow::{Context, Result, ensure};

use crate::command::Run;
use crate::workspace;

/// A line of a table.
pub(crate) trait Row: Sized {
    /// The table's first line.
    const COLUMNS: &'static str;

    /// The line in the document.
    fn line(&self) -> String;
    /// The inverse of [`Self::line`]; `None` for a line that is none of the table.
    fn parse(line: &str) -> Option<Self>;
    /// What tells it from other rows.
    fn name(&self) -> String;
    /// What has grown since `before` by more than may be.
    fn growth(&self, before: &Self) -> Vec<String>;
}

/// A document with a table, and with lines `Date: …`, `Commit: …` and `Compiler: …`.
pub(crate) struct Document {
    /// From the project's root.
    pub(crate) file: &'static str,
    /// What writes it.
    pub(crate) command: &'static str,
}

impl Document {
    /// Puts other rows into the document, with the compiler, the date and the commit of now.
    pub(crate) fn write<R: Row>(&self, rows: &[R]) -> Result<()> {
        let head = [("Compiler", compiler()?), ("Date", date()?), ("Commit", commit()?)];
        let replaced = self.replaced(&self.read()?, rows, &head)?;
        std::fs::write(self.path(), replaced).with_context(|| format!("cannot write {}", self.file))
    }

    /// Puts some rows in the place of those that they are measured for, or behind all others. What the document says of its
    /// date and commit stays: the other rows are of then.
    pub(crate) fn write_some<R: Row>(&self, rows: Vec<R>, is_measured: impl Fn(&R) -> bool) -> Result<()> {
        let text = self.read()?;
        let compiler = compiler()?;
        ensure!(
            compiler_in(&text) == Some(&*compiler),
            "{} was made by another compiler than {compiler}: write all of it",
            self.file
        );
        let all = merged(rows_in(&text), rows, is_measured);
        let replaced = self.replaced(&text, &all, &[])?;
        std::fs::write(self.path(), replaced).with_context(|| format!("cannot write {}", self.file))
    }

    /// Fails when a figure exceeds the document's, or is missing there. Another compiler makes other code, which is not
    /// the change's fault: then it warns.
    pub(crate) fn check<R: Row>(&self, rows: &[R]) -> Result<()> {
        let text = self.read()?;
        let found = self.compared(rows, &rows_in(&text));
        let compiler = compiler()?;
        if compiler_in(&text) == Some(&*compiler) {
            return found;
        }
        println!("warning: {} was made by another compiler than {compiler}", self.file);
        if let Err(error) = found {
            println!("warning: {error:#}");
        }
        Ok(())
    }

    fn path(&self) -> PathBuf {
        workspace::root().join(self.file)
    }

    fn read(&self) -> Result<String> {
        std::fs::read_to_string(self.path()).with_context(|| format!("{} is absent", self.file))
    }

    /// A document with another table and other lines of its head.
    fn replaced<R: Row>(&self, document: &str, rows: &[R], head: &[(&str, String)]) -> Result<String> {
        let file = self.file;
        let (before, behind) = document.split_once(R::COLUMNS).with_context(|| format!("{file} has no table"))?;
        let behind = behind.split_once("\n\n").map_or("", |(_, behind)| behind);
        let mut text = format!("{before}{}\n{behind}", table(rows));
        for (word, value) in head {
            let start = format!("{word}: ");
            let line = text.lines().find(|line| line.starts_with(&start)).map(str::to_owned);
            let line = line.with_context(|| format!("{file} has no line `{word}: …`"))?;
            text = text.replacen(&line, &format!("{start}{value}"), 1);
        }
        Ok(text)
    }

    /// An error that names everything that has grown too much and every row that the document does not have.
    fn compared<R: Row>(&self, rows: &[R], document: &[R]) -> Result<()> {
        let Self { file, command } = self;
        let mut wrong = Vec::new();
        for row in rows {
            match document.iter().find(|before| before.name() == row.name()) {
                Some(before) => wrong.extend(row.growth(before).iter().map(|grown| format!("{grown} in {file}"))),
                None => wrong.push(format!("{} is not in {file}", row.name())),
            }
        }
        ensure!(wrong.is_empty(), "{}; if that must be: {command}", wrong.join("; "));
        Ok(())
    }
}

/// Rows of a document, with others for those that were measured again.
fn merged<R>(mut rows: Vec<R>, measured: Vec<R>, is_measured: impl Fn(&R) -> bool) -> Vec<R> {
    let place = rows.iter().position(&is_measured).unwrap_or(rows.len());
    rows.retain(|row| !is_measured(row));
    rows.splice(place..place, measured);
    rows
}

/// The table for a document.
pub(crate) fn table<R: Row>(rows: &[R]) -> String {
    let columns = R::COLUMNS.matches('|').count().saturating_sub(1);
    let lines: String = rows.iter().map(|row| row.line() + "\n").collect();
    format!("{}\n|{}\n{lines}", R::COLUMNS, "---|".repeat(columns))
}

/// The cells of a line of a table.
pub(crate) fn cells(line: &str) -> Vec<&str> {
    line.trim().trim_matches('|').split('|').map(str::trim).collect()
}

/// The rows in a document.
fn rows_in<R: Row>(document: &str) -> Vec<R> {
    document.lines().filter_map(R::parse).collect()
}

/// The compiler that a document names.
fn compiler_in(document: &str) -> Option<&str> {
    document.lines().find_map(|line| line.strip_prefix("Compiler: "))
}

fn compiler() -> Result<String> {
    Ok(Run::new("rustc").args(["--version"]).text()?.trim().to_owned())
}

fn date() -> Result<String> {
    Ok(Run::new("date").args(["-u", "+%Y-%m-%d"]).text()?.trim().to_owned())
}

fn commit() -> Result<String> {
    Ok(Run::new("git").args(["rev-parse", "--short", "HEAD"]).text()?.trim().to_owned())
}

#[cfg(test)]
mod tests {
    use super::{Document, Row, cells, compiler_in, rows_in, table};

    const DOCUMENT: Document = Document { file: "docs/pears.md", command: "cargo xtask pears --write" };

    #[derive(Debug, PartialEq)]
    struct Pears(String, u64);

    impl Row for Pears {
        const COLUMNS: &'static str = "| basket | pears |";

        fn line(&self) -> String {
            format!("| {} | {} |", self.0, self.1)
        }

        fn parse(line: &str) -> Option<Self> {
            let [basket, pears] = cells(line)[..] else { return None };
            Some(Self(basket.to_owned(), pears.parse().ok()?))
        }

        fn name(&self) -> String {
            self.0.clone()
        }

        fn growth(&self, before: &Self) -> Vec<String> {
            (self.1 > before.1).then(|| format!("{}: {}, and {}", self.0, self.1, before.1)).into_iter().collect()
        }
    }

    fn rows(first: u64, second: u64) -> [Pears; 2] {
        [Pears("red".into(), first), Pears("blue".into(), second)]
    }

    #[test]
    fn a_table_is_read_as_it_was_written() {
        assert_eq!(rows_in::<Pears>(&table(&rows(1, 2))), rows(1, 2));
    }

    #[test]
    fn some_rows_are_written_in_their_place() {
        let merged =
            |name: &'static str| super::merged(rows(1, 2).into(), vec![Pears(name.into(), 9)], |row| row.0 == name);
        assert_eq!(merged("red"), rows(9, 2));
        assert_eq!(merged("blue"), rows(1, 9));
        assert_eq!(merged("green").last(), Some(&Pears("green".into(), 9)));
    }

    #[test]
    fn what_grows_and_what_is_new_is_named() {
        DOCUMENT.compared(&rows(1, 2), &rows(1, 3)).unwrap();
        let error = DOCUMENT.compared(&rows(2, 2), &rows(1, 2)).unwrap_err().to_string();
        assert_eq!(error, "red: 2, and 1 in docs/pears.md; if that must be: cargo xtask pears --write");
        assert!(DOCUMENT.compared(&rows(1, 2), &rows(1, 2)[..1]).is_err());
    }

    #[test]
    fn a_document_keeps_what_is_around_its_table() {
        let document = format!("Compiler: old\n\n{}\nBelow.\n", table(&rows(1, 2)));
        let replaced = DOCUMENT.replaced(&document, &rows(3, 4), &[("Compiler", "new".into())]).unwrap();
        assert_eq!(replaced, format!("Compiler: new\n\n{}\nBelow.\n", table(&rows(3, 4))));
        assert_eq!(compiler_in(&replaced), Some("new"));
    }
}
