//! What was tried, and what came of it: one row for each attack on each target.

use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

use anyhow::{Context, Result};

use comfy_table::presets::ASCII_MARKDOWN;
use comfy_table::{CellAlignment, Table};
use serde::{Deserialize, Serialize};

/// Counters of a target by name.
pub type Counters = BTreeMap<String, u64>;

/// One attack on one target.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Row {
    /// What was tried.
    pub attack: String,
    /// Against what.
    pub target: String,
    /// How often.
    pub attempts: u64,
    /// How often the application saw anything that the attacker caused.
    pub successes: u64,
    /// Counters of the target that tell its operator of the attack.
    pub noticed: Vec<String>,
    /// The attacker has the key: each attempt must succeed, or the others have shown nothing.
    pub control: bool,
}

impl Row {
    /// What is wrong with the figures.
    pub fn fault(&self) -> Option<String> {
        let Self { attack, target, attempts, successes, .. } = self;
        let why = match self.control {
            _ if *attempts == 0 => "nothing was tried".to_owned(),
            true if successes < attempts => format!("{successes} of {attempts}: an attempt with the key must succeed"),
            false if *successes > 0 => format!("{successes} of {attempts} succeeded"),
            false if self.noticed.is_empty() && ![SIMULATOR, BOARD].contains(&self.target.as_str()) => {
                "no counter tells of it".to_owned()
            }
            _ => return None,
        };
        Some(format!("{attack}, {target}: {why}"))
    }
}

/// The target whose attacks are tests of their own, which count their attempts and check the counters themselves.
pub const SIMULATOR: &str = "simulator";

/// A target whose counters can be read only by its own program.
pub const BOARD: &str = "board in QEMU";

/// The figures in what the simulator's attackers print: `WHAT: N attempts, N successes`.
pub fn simulated(text: &str) -> Vec<Row> {
    text.lines().filter_map(simulated_row).collect()
}

fn simulated_row(line: &str) -> Option<Row> {
    let (attack, figures) = line.rsplit_once(": ")?;
    let (attempts, successes) = figures.strip_suffix(" successes")?.split_once(" attempts, ")?;
    let (attempts, successes) = (attempts.parse().ok()?, successes.parse().ok()?);
    // The first test's line stands behind a dot of the harness.
    let attack = attack.trim_start_matches('.').to_owned();
    Some(Row { attack, target: SIMULATOR.to_owned(), attempts, successes, noticed: Vec::new(), control: false })
}

/// All rows.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Report {
    /// In the order in which they were made.
    pub rows: Vec<Row>,
}

impl Report {
    /// Reads rows that another program has written.
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        Ok(serde_json::from_str(&text)?)
    }

    /// Writes them as JSON.
    pub fn write(&self, path: &Path) -> Result<()> {
        std::fs::write(path, serde_json::to_string_pretty(self)?)
            .with_context(|| format!("cannot write {}", path.display()))
    }

    /// Adds a row, and says so.
    pub fn add(&mut self, row: Row) {
        println!("{:56} {:16} {:7} attempts {:5} successes", row.attack, row.target, row.attempts, row.successes);
        self.rows.push(row);
    }

    /// What is wrong with any of them.
    pub fn faults(&self) -> Vec<String> {
        self.rows.iter().filter_map(Row::fault).collect()
    }

    /// Attempts and successes of all attacks whose attacker has no key.
    pub fn sums(&self) -> (u64, u64) {
        let attacks = self.rows.iter().filter(|row| !row.control);
        attacks.fold((0, 0), |(tried, came), row| (tried + row.attempts, came + row.successes))
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut table = Table::new();
        table.load_style(ASCII_MARKDOWN).set_header(["attack", "target", "attempts", "successes", "counted by"]);
        for column in [2, 3] {
            if let Some(column) = table.column_mut(column) {
                column.set_cell_alignment(CellAlignment::Right);
            }
        }
        for Row { attack, target, attempts, successes, noticed, control } in &self.rows {
            let attack = if *control { format!("({attack})") } else { attack.clone() };
            let noticed: Vec<_> = noticed.iter().map(|name| format!("`{name}`")).collect();
            table.add_row([attack, target.clone(), attempts.to_string(), successes.to_string(), noticed.join(", ")]);
        }
        let (attempts, successes) = self.sums();
        table.add_row(["**all**", "", &attempts.to_string(), &successes.to_string(), ""]);
        write!(f, "{table}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(attempts: u64, successes: u64, control: bool) -> Row {
        let noticed = vec!["ProofsFailed".to_owned()];
        Row { attack: "keys".into(), target: "manager".into(), attempts, successes, noticed, control }
    }

    #[test]
    fn figures_that_show_nothing_are_faults() {
        assert!(row(5, 0, false).fault().is_none() && row(5, 5, true).fault().is_none());
        for wrong in [row(0, 0, false), row(5, 1, false), row(5, 4, true), row(0, 0, true)] {
            assert!(wrong.fault().is_some(), "{wrong:?}");
        }
        assert!(Row { noticed: Vec::new(), ..row(5, 0, false) }.fault().is_some());
    }

    #[test]
    fn the_simulator_s_lines_are_read() {
        let rows = simulated("running 2 tests\n.bits: all of them: 12 attempts, 0 successes\n..\nok: nothing\n");
        let [row] = &rows[..] else { panic!("{rows:?}") };
        assert_eq!((row.attack.as_str(), row.attempts, row.successes), ("bits: all of them", 12, 0));
        assert!(row.fault().is_none());
    }

    #[test]
    fn who_has_the_key_is_not_in_the_sum() {
        let report = Report { rows: vec![row(5, 0, false), row(3, 3, true), row(2, 1, false)] };
        assert_eq!((report.sums(), report.faults().len()), ((7, 1), 1));
        assert!(report.to_string().contains("**all**"));
    }
}
