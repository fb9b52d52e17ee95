//! Rows of the size breakdown in `docs/sizes.md`, and by how much they may grow.

use crate::figures::{self, cells};

/// A row of the breakdown, in bytes.
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

/// What a stack may differ by beside: an interrupt comes at its deepest place or does not.
const INTERRUPT: u64 = 256;

impl figures::Row for Row {
    const COLUMNS: &'static str = "| board | image | flash | static RAM | stack | CARA flash | CARA RAM |";

    fn line(&self) -> String {
        let Self { board, image, flash, static_ram, stack, cara_flash, cara_ram } = self;
        let stack = stack.map_or("not measured".to_owned(), |stack| stack.to_string());
        format!("| {board} | {image} | {flash} | {static_ram} | {stack} | {cara_flash} | {cara_ram} |")
    }

    fn parse(line: &str) -> Option<Self> {
        let [board, image, flash, static_ram, stack, cara_flash, cara_ram] = cells(line)[..] else { return None };
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

    fn name(&self) -> String {
        format!("{} {}", self.board, self.image)
    }

    /// More than 2 %.
    fn growth(&self, before: &Self) -> Vec<String> {
        let mut grown = Vec::new();
        let mut compare = |what: &str, now: u64, before: u64, beside: u64| {
            if now > before + before / 50 + beside {
                grown.push(format!("{what} of {}: {now}, and {before}", self.name()));
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

#[cfg(test)]
mod tests {
    use super::Row;
    use crate::figures::Row as _;

    fn row(flash: u64, stack: Option<u64>) -> Row {
        let (board, image) = ("board".to_owned(), "agv".to_owned());
        Row { board, image, flash, static_ram: 100, stack, cara_flash: 50, cara_ram: 10 }
    }

    #[test]
    fn a_row_is_read_as_it_was_written() {
        for row in [row(1000, Some(7)), row(2000, None)] {
            assert_eq!(Row::parse(&row.line()), Some(row));
        }
        assert_eq!(Row::parse(Row::COLUMNS), None);
    }

    #[test]
    fn two_per_cent_pass_and_more_does_not() {
        let before = row(1000, Some(1000));
        assert!(row(1020, Some(1276)).growth(&before).is_empty());
        let grown = row(1021, Some(1277)).growth(&before).join("; ");
        assert!(grown.contains("flash of board agv: 1021, and 1000") && grown.contains("stack of"), "{grown}");
        assert!(row(1, None).growth(&before).is_empty());
    }
}
