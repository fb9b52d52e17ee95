//! The bill in `docs/sizes.md`: written there, read from there, and compared with what is built now.

use anyhow::{Context, Result, ensure};

/// A line of the bill, in bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Row {
    pub(crate) board: String,
    pub(crate) image: String,
    pub(crate) flash: u64,
    pub(crate) static_ram: u64,
    /// Where it was measured.
    pub(crate) stack: Option<u64>,
    /// The difference to the bare echo on the same board.
    pub(crate) cara_flash: u64,
    pub(crate) cara_ram: u64,
}

/// Columns of the table.
const COLUMNS: &str = "| board | image | flash | static RAM | stack | CARA flash | CARA RAM |";
/// What a stack may differ by beside: an interrupt comes at its deepest place or does not.
const INTERRUPT: u64 = 256;

impl Row {
    fn line(&self) -> String {
        let Self { board, image, flash, static_ram, stack, cara_flash, cara_ram } = self;
        let stack = stack.map_or("not measured".to_owned(), |stack| stack.to_string());
        format!("| {board} | {image} | {flash} | {static_ram} | {stack} | {cara_flash} | {cara_ram} |")
    }

    fn parse(line: &str) -> Option<Self> {
        let cells: Vec<&str> = line.trim().trim_matches('|').split('|').map(str::trim).collect();
        let [board, image, flash, static_ram, stack, cara_flash, cara_ram] = cells[..] else { return None };
        Some(Self {
            board: board.to_owned(),
            image: image.to_owned(),
            flash: flash.parse().ok()?,
            static_ram: static_ram.parse().ok()?,
            stack: stack.parse().ok(),
            cara_flash: cara_flash.parse().ok()?,
            cara_ram: cara_ram.parse().ok()?,
        })
    }

    fn is_of(&self, other: &Self) -> bool {
        self.board == other.board && self.image == other.image
    }

    /// What has grown since `before` by more than may be.
    fn growth(&self, before: &Self) -> Vec<String> {
        let mut grown = Vec::new();
        let mut compare = |what: &str, now: u64, before: u64, beside: u64| {
            if now > before + before / 50 + beside {
                grown.push(format!("{what} of {} {}: {now}, and {before} in docs/sizes.md", self.board, self.image));
            }
        };
        compare("flash", self.flash, before.flash, 0);
        compare("static RAM", self.static_ram, before.static_ram, 0);
        if let (Some(now), Some(before)) = (self.stack, before.stack) {
            compare("stack", now, before, INTERRUPT);
        }
        compare("CARA's flash", self.cara_flash, before.cara_flash, 0);
        compare("CARA's RAM", self.cara_ram, before.cara_ram, 0);
        grown
    }
}

/// The table for the document.
pub(crate) fn table(rows: &[Row]) -> String {
    let mut text = format!("{COLUMNS}\n|---|---|---|---|---|---|---|\n");
    for row in rows {
        text += &row.line();
        text.push('\n');
    }
    text
}

/// The rows in a document.
pub(crate) fn rows_in(document: &str) -> Vec<Row> {
    document.lines().filter_map(Row::parse).collect()
}

/// The compiler that a document names.
pub(crate) fn compiler_in(document: &str) -> Option<&str> {
    document.lines().find_map(|line| line.strip_prefix("Compiler: "))
}

/// A document with another table, compiler, date and commit.
pub(crate) fn replaced(document: &str, rows: &[Row], head: &[(&str, String)]) -> Result<String> {
    let (before, behind) = document.split_once(COLUMNS).context("docs/sizes.md has no table")?;
    let behind = behind.split_once("\n\n").map_or("", |(_, behind)| behind);
    let mut text = format!("{before}{}\n{behind}", table(rows));
    for (word, value) in head {
        let start = format!("{word}: ");
        let line = text.lines().find(|line| line.starts_with(&start)).map(str::to_owned);
        let line = line.with_context(|| format!("docs/sizes.md has no line `{word}: …`"))?;
        text = text.replacen(&line, &format!("{start}{value}"), 1);
    }
    Ok(text)
}

/// An error that names everything that has grown by more than 2 % and every image that the document does not have.
pub(crate) fn compared(rows: &[Row], document: &[Row]) -> Result<()> {
    let mut wrong = Vec::new();
    for row in rows {
        match document.iter().find(|before| before.is_of(row)) {
            Some(before) => wrong.extend(row.growth(before)),
            None => wrong.push(format!("{} {} is not in docs/sizes.md", row.board, row.image)),
        }
    }
    ensure!(wrong.is_empty(), "{}; if that must be: cargo xtask sizes --write", wrong.join("; "));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::{Row, compared, compiler_in, replaced, rows_in, table};

    fn row(flash: u64, stack: Option<u64>) -> Row {
        let (board, image) = ("board".to_owned(), "agv".to_owned());
        Row { board, image, flash, static_ram: 100, stack, cara_flash: 50, cara_ram: 10 }
    }

    #[test]
    fn a_table_is_read_as_it_was_written() {
        let rows = [row(1000, Some(7)), row(2000, None)];
        assert_eq!(rows_in(&table(&rows)), rows);
    }

    #[test]
    fn two_per_cent_pass_and_more_does_not() {
        let before = [row(1000, Some(1000))];
        compared(&[row(1020, Some(1276))], &before).unwrap();
        let error = compared(&[row(1021, Some(1277))], &before).unwrap_err().to_string();
        assert!(error.contains("flash of board agv: 1021, and 1000") && error.contains("stack of"), "{error}");
        assert!(compared(&[row(1, None)], &[]).is_err());
        compared(&[row(1, None)], &before).unwrap();
    }

    #[test]
    fn a_document_keeps_what_is_around_its_table() {
        let document = format!("Compiler: old\n\n{}\nBelow.\n", table(&[row(1, None)]));
        let replaced = replaced(&document, &[row(2, None)], &[("Compiler", "new".into())]).unwrap();
        assert_eq!(replaced, format!("Compiler: new\n\n{}\nBelow.\n", table(&[row(2, None)])));
        assert_eq!(compiler_in(&replaced), Some("new"));
    }
}
