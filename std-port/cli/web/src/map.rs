//! The background: a map in the format of MovingAI's benchmarks (`type octile`, `height`, `width`, `map`, then rows).

use serde_json::{Value, json};

use crate::limits::CELLS;

/// Longest file that is read.
pub(crate) const LONGEST: u64 = CELLS as u64 * 2;

/// What the cells are: `.`, `G` and `S` can be driven on, all others cannot.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Map {
    width: usize,
    rows: Vec<String>,
}

impl Map {
    /// Reads a map; an error says in which line what is wrong, and what should stand there.
    pub(crate) fn parse(text: &str) -> Result<Self, String> {
        let mut lines = text.lines().map(|line| line.trim_end_matches('\r')).zip(1..);
        let mut header = |name: &str| {
            let (line, number) = lines.next().ok_or_else(|| format!("it ends before `{name}`"))?;
            let value = line.strip_prefix(name).filter(|rest| rest.is_empty() || rest.starts_with(' '));
            value
                .map(|value| (value.trim().to_owned(), number))
                .ok_or_else(|| format!("line {number}: `{name}` should stand here"))
        };
        let (kind, number) = header("type")?;
        if kind != "octile" {
            return Err(format!("line {number}: the type is `{kind}`: only `octile` can be read"));
        }
        let height = size(header("height")?)?;
        let width = size(header("width")?)?;
        header("map")?;
        if height.checked_mul(width).is_none_or(|cells| cells > CELLS) {
            return Err(format!("{width} x {height} cells are more than the {CELLS} that can be shown: cut the map"));
        }
        let mut rows = Vec::with_capacity(height);
        for (line, number) in lines.filter(|(line, _)| !line.is_empty()).take(height) {
            let count = line.chars().count();
            if count != width {
                return Err(format!("line {number}: the row has {count} cells, and `width` says {width}"));
            }
            if let Some((column, cell)) = line.chars().enumerate().find(|(_, cell)| !".G@OTSW".contains(*cell)) {
                return Err(format!(
                    "line {number}, column {}: `{cell}` is no cell: write one of . G @ O T S W",
                    column + 1
                ));
            }
            rows.push(line.to_owned());
        }
        if rows.len() < height {
            return Err(format!("it has {} rows, and `height` says {height}", rows.len()));
        }
        Ok(Self { width, rows })
    }

    pub(crate) fn json(&self) -> Value {
        json!({ "width": self.width, "height": self.rows.len(), "rows": self.rows })
    }
}

fn size((text, line): (String, usize)) -> Result<usize, String> {
    let size = text.parse().ok().filter(|size| *size > 0);
    size.ok_or_else(|| format!("line {line}: `{text}` is no number of cells"))
}

#[cfg(test)]
mod tests {
    use super::Map;

    #[test]
    fn a_map_is_read_row_by_row() {
        let map = Map::parse("type octile\nheight 2\nwidth 3\nmap\n..@\n.T.\n").unwrap();
        assert_eq!(map.json(), serde_json::json!({ "width": 3, "height": 2, "rows": ["..@", ".T."] }));
        assert!(Map::parse("type octile\r\nheight 1\r\nwidth 1\r\nmap\r\n.\r\n").is_ok(), "as written on Windows");
    }

    #[test]
    fn what_is_wrong_is_told_with_its_line() {
        let reported = |text: &str| Map::parse(text).unwrap_err();
        assert!(reported("").contains("before `type`"));
        assert!(reported("typo octile").starts_with("line 1: `type`"));
        assert!(reported("type tile").contains("`octile`"));
        assert!(reported("type octile\nheight x\n").starts_with("line 2"));
        assert!(reported("type octile\nheight 0\n").starts_with("line 2"));
        assert!(reported("type octile\nheight 1\nwidth 2\nmap\n.\n").starts_with("line 5: the row has 1 cells"));
        assert!(reported("type octile\nheight 1\nwidth 2\nmap\n.x\n").starts_with("line 5, column 2"));
        assert!(reported("type octile\nheight 2\nwidth 1\nmap\n.\n").contains("has 1 rows"));
        assert!(reported("type octile\nheight 99999999\nwidth 99999999\nmap\n").contains("cut the map"));
    }
}
