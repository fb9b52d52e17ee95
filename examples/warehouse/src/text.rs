//! Lines of the warehouse's files, and mistakes in them with their line, column and what to do.

use std::fmt;

use crate::map::{Cell, Map};

/// What is wrong in a file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub struct Mistake {
    /// The file's name.
    pub file: String,
    /// The line, from 1.
    pub line: usize,
    /// The column, from 1, in characters.
    pub column: usize,
    /// What is wrong, and what to write.
    pub what: String,
    /// The line's text.
    pub text: String,
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { file, line, column, what, text } = self;
        let number = line.to_string();
        let margin = " ".repeat(number.len());
        writeln!(f, "{file}:{line}:{column}: {what}")?;
        writeln!(f, "{margin} |\n{number} | {}", shortened(text))?;
        write!(f, "{margin} | {}^", " ".repeat(column.saturating_sub(1).min(WIDEST)))
    }
}

/// Characters of a line that a message shows.
const WIDEST: usize = 160;

fn shortened(text: &str) -> String {
    // A tab would move the mark below it.
    text.chars().take(WIDEST).map(|shown| if shown.is_control() { ' ' } else { shown }).collect()
}

/// A line of a file.
#[derive(Clone, Copy, Debug)]
pub struct Line<'t> {
    /// The file's name.
    pub file: &'t str,
    /// From 1.
    pub number: usize,
    /// Without its end.
    pub text: &'t str,
}

impl<'t> Line<'t> {
    /// The lines of a file.
    pub fn all(file: &'t str, text: &'t str) -> impl Iterator<Item = Self> {
        text.lines().enumerate().map(move |(index, text)| Self { file, number: index + 1, text })
    }

    /// A mistake at a column, from 1.
    pub fn mistake(&self, column: usize, what: impl Into<String>) -> Mistake {
        Mistake { file: self.file.to_owned(), line: self.number, column, what: what.into(), text: self.text.to_owned() }
    }

    /// Its words before a `#`, each with its column.
    pub fn words(&self) -> Vec<Word<'t>> {
        let text = self.text.split('#').next().unwrap_or_default();
        let mut words = Vec::new();
        let mut rest = 0;
        for word in text.split_whitespace() {
            // The words come in their order, so each is behind the last one.
            let Some(at) = text[rest..].find(word).map(|at| at + rest) else { continue };
            words.push(Word { column: text[..at].chars().count() + 1, text: word });
            rest = at + word.len();
        }
        words
    }

    /// A word as a cell on which a vehicle can stand and which the others can reach.
    pub fn cell(&self, word: Word<'_>, map: &Map) -> Result<Cell, Mistake> {
        let wrong = |what: String| self.mistake(word.column, what);
        let number = |text: &str| text.parse::<u16>().ok();
        let pair = word.text.split_once(',').and_then(|(x, y)| Some(Cell { x: number(x)?, y: number(y)? }));
        let cell = pair.ok_or_else(|| wrong(format!("`{}` is no cell: write x,y, as 3,4", word.text)))?;
        let (width, height) = (map.width(), map.height());
        if cell.x >= width || cell.y >= height {
            return Err(wrong(format!(
                "{cell} is outside of the map: write x from 0 to {} and y from 0 to {}",
                width - 1,
                height - 1
            )));
        }
        if !map.is_free(cell) {
            return Err(wrong(format!("no vehicle can stand on {cell}: name a cell that is `.` on the map")));
        }
        if !map.is_reachable(cell) {
            return Err(wrong(format!("no way leads to {cell}: name a cell of the largest connected part of the map")));
        }
        Ok(cell)
    }
}

/// A word of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Word<'t> {
    /// Where it begins, from 1, in characters.
    pub column: usize,
    /// The word.
    pub text: &'t str,
}

#[cfg(test)]
mod tests {
    use super::{Line, Word};

    #[test]
    fn words_have_columns_in_characters() {
        let line = Line { file: "f", number: 3, text: "é 3,4  3,4 # rest" };
        let at = |column, text| Word { column, text };
        assert_eq!(line.words(), [at(1, "é"), at(3, "3,4"), at(8, "3,4")]);
    }

    #[test]
    fn a_mistake_shows_its_line() {
        let shown = Line { file: "f", number: 12, text: "3,4 x" }.mistake(5, "write y").to_string();
        assert_eq!(shown, "f:12:5: write y\n   |\n12 | 3,4 x\n   |     ^");
    }
}
