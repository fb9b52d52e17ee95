//! Standard output: tables and lines for people, objects for programs. A closed pipe is an error, never a panic.

use std::io::{self, Write};

use anstyle::{AnsiColor, Style};
use cara_std::{Shown, is_hidden};
use comfy_table::{ContentArrangement, Table, presets};
use serde::Serialize;

/// Headings.
pub const HEADING: Style = Style::new().bold();
/// What is in order.
pub const GOOD: Style = AnsiColor::Green.on_default();
/// Something that needs action.
pub const BAD: Style = AnsiColor::Red.on_default().bold();
/// What is of less interest.
pub const FAINT: Style = Style::new().dimmed();
/// What is neither good nor bad.
pub const PLAIN: Style = Style::new();

/// Prints a line for people. Colours reach terminals only, and not with `NO_COLOR`.
pub fn line(text: impl std::fmt::Display) -> io::Result<()> {
    let mut out = anstream::stdout().lock();
    writeln!(out, "{}", visible(&text.to_string()))?;
    out.flush()
}

/// Prints what people should know and a command does not end with, on standard error.
pub fn warning(text: impl std::fmt::Display) {
    // A closed standard error does not end the command.
    let _ = writeln!(anstream::stderr().lock(), "{BAD}warning{BAD:#}: {}", visible(&text.to_string()));
}

/// A line with each hidden character written out, but for line breaks, tabs and ESC, with which this program's colours begin:
/// what comes from elsewhere is [`Shown`] before it is put into one.
fn visible(text: &str) -> String {
    let mut shown = String::with_capacity(text.len());
    for character in text.chars() {
        if is_hidden(character) && !matches!(character, '\n' | '\t' | '\u{1b}') {
            shown.extend(character.escape_unicode());
        } else {
            shown.push(character);
        }
    }
    shown
}

/// JSON with an escape for each hidden character, which JSON would leave alone but for C0.
pub fn json(value: &impl Serialize) -> serde_json::Result<String> {
    let text = serde_json::to_string(value)?;
    let mut shown = String::with_capacity(text.len());
    for character in text.chars() {
        if is_hidden(character) {
            // All of them are in the basic plane.
            shown.push_str(&format!("\\u{:04x}", u32::from(character)));
        } else {
            shown.push(character);
        }
    }
    Ok(shown)
}

/// Prints an object for programs, in one line.
pub fn object(value: &impl Serialize) -> io::Result<()> {
    let mut text = json(value)?;
    text.push('\n');
    let mut out = io::stdout().lock();
    out.write_all(text.as_bytes())?;
    out.flush()
}

/// Rows in columns, each with a style of its own.
pub struct Rows {
    table: Table,
    styles: Vec<Style>,
}

impl Rows {
    /// A table without rows yet.
    pub fn new<const COLUMNS: usize>(headings: [&str; COLUMNS]) -> Self {
        let mut table = Table::new();
        table.load_style(presets::NOTHING).set_content_arrangement(ContentArrangement::Disabled);
        table.set_header(headings);
        Self { table, styles: vec![HEADING] }
    }

    /// One row more.
    pub fn add(&mut self, style: Style, cells: impl IntoIterator<Item = String>) {
        // A line break in a cell would part the row from its style.
        self.table.add_row(cells.into_iter().map(|cell| Shown(&cell.replace(['\n', '\r'], " ")).to_string()));
        self.styles.push(style);
    }

    /// Prints headings and rows; nothing if there are no rows.
    pub fn print(&self) -> io::Result<()> {
        if self.styles.len() < 2 {
            return Ok(());
        }
        let text = self.table.to_string();
        let styles = self.styles.iter();
        // Each cell is padded on both sides, and the first one needs no distance from anything.
        let row = |row: &str| row.strip_prefix(' ').unwrap_or(row).trim_end().to_owned();
        text.lines().zip(styles).try_for_each(|(text, style)| line(format_args!("{style}{}{style:#}", row(text))))
    }
}

/// Prints bytes as they are.
pub fn bytes(bytes: &[u8]) -> io::Result<()> {
    let mut out = io::stdout().lock();
    out.write_all(bytes)?;
    out.flush()
}
