//! The background of the page's map: what is sent of a [`Grid`].

use cara_map::{Grid, Wrong};
use serde_json::{Value, json};

use crate::limits::CELLS;

/// Longest file that is read.
pub(crate) const LONGEST: u64 = CELLS as u64 * 2;
/// Most cells along a side.
const LONGEST_SIDE: usize = 1 << 15;

pub(crate) fn read(text: &str) -> Result<Grid, Wrong> {
    Grid::parse(text, LONGEST_SIDE, CELLS)
}

pub(crate) fn json(Grid { width, rows, metres_per_cell, origin }: &Grid) -> Value {
    json!({ "width": width, "height": rows.len(), "rows": rows, "metres": metres_per_cell, "origin": origin })
}
