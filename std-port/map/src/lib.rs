//! Maps of cells in the `.map` format of the MovingAI benchmarks (Sturtevant, "Benchmarks for Grid-Based Pathfinding", 2012), and
//! as others write it: the league of robot runners, editors, Windows.
//!
//! `type octile` or `tile`; `height` and `width` in either order; `map`; the rows. Lines that are blank, that begin with `#` before
//! `map`, a byte order mark, CR LF, tabs, and blanks behind a line are taken. A map in metres has `metres_per_cell 0.05` as well, and
//! may have `origin X Y`, where its lower left corner is: then y points up.

/// A cell on which vehicles can be; E and S are places of the robot runners.
pub const FREE: &str = ".GSE";
const BLOCKED: &str = "@OTW";

/// A map.
#[derive(Clone, Debug, PartialEq)]
pub struct Grid {
    /// Cells in a row.
    pub width: usize,
    /// The topmost first, each of `width` signs.
    pub rows: Vec<String>,
    /// From cell to cell; none where vehicles count in cells.
    pub metres_per_cell: Option<f64>,
    /// Where the lower left corner of a map in metres is.
    pub origin: [f64; 2],
}

/// What is wrong, and where, both from 1.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wrong {
    /// The line.
    pub line: usize,
    /// The column, in characters.
    pub column: usize,
    /// What is wrong, and what to write.
    pub what: String,
}

impl std::fmt::Display for Wrong {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "line {}, column {}: {}", self.line, self.column, self.what)
    }
}

fn wrong<T>(line: usize, column: usize, what: impl Into<String>) -> Result<T, Wrong> {
    Err(Wrong { line, column, what: what.into() })
}

impl Grid {
    /// Reads a map of at most so many cells along a side, and in all.
    pub fn parse(text: &str, longest: usize, most: usize) -> Result<Self, Wrong> {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let end = text.lines().count() + 1;
        let mut lines = text.lines().map(str::trim_end).zip(1..).filter(|(line, _)| !line.trim().is_empty());
        let mut header = lines.by_ref().filter(|(line, _)| !line.starts_with('#'));
        let Some((first, number)) = header.next() else { return wrong(end, 1, "the file ends: write `type octile`") };
        match first.split_whitespace().collect::<Vec<_>>()[..] {
            ["type", "octile" | "tile"] => {}
            ["type", ..] => return wrong(number, 6, "only the types `octile` and `tile` can be read"),
            _ => return wrong(number, 1, "a map begins with `type octile`"),
        }
        let (mut width, mut height, mut metres_per_cell, mut origin) = (None, None, None, None);
        let map = loop {
            let Some((line, number)) = header.next() else {
                return wrong(end, 1, "the file ends: write `map`, and the rows");
            };
            let words: Vec<&str> = line.split_whitespace().collect();
            let column = line.find(words.get(1).copied().unwrap_or_default()).unwrap_or(0) + 1;
            let is_new = match words[..] {
                ["map"] => break number,
                ["width", size] => width.replace(side(size, longest, number, column)?).is_none(),
                ["height", size] => height.replace(side(size, longest, number, column)?).is_none(),
                ["metres_per_cell", metres] => match place(metres) {
                    Some(metres) if metres > 0.0 => metres_per_cell.replace(metres).is_none(),
                    _ => return wrong(number, column, "write a length above 0 in metres, as 0.05"),
                },
                ["origin", x, y] => match (place(x), place(y)) {
                    (Some(x), Some(y)) => origin.replace([x, y]).is_none(),
                    _ => return wrong(number, column, "write x and y in metres, as -3.5 12"),
                },
                _ => {
                    return wrong(
                        number,
                        1,
                        "write `map` before the rows, and before it `height` and `width` with a number",
                    );
                }
            };
            if !is_new {
                return wrong(number, 1, format!("`{}` is there twice: write it once", words[0]));
            }
        };
        let (Some(width), Some(height)) = (width, height) else {
            return wrong(map, 1, "write `height` once and `width` once above this line");
        };
        if origin.is_some() && metres_per_cell.is_none() {
            return wrong(map, 1, "`origin` is in metres: write `metres_per_cell` above this line as well");
        }
        if width * height > most {
            return wrong(map, 1, format!("{width} x {height} cells are more than {most}: cut the map"));
        }
        let rows = rows(lines, end, width, height)?;
        Ok(Self { width, rows, metres_per_cell, origin: origin.unwrap_or_default() })
    }
}

fn place(text: &str) -> Option<f64> {
    text.parse().ok().filter(|place: &f64| place.is_finite())
}

fn side(text: &str, longest: usize, line: usize, column: usize) -> Result<usize, Wrong> {
    match text.parse() {
        Ok(side) if (1..=longest).contains(&side) => Ok(side),
        _ => wrong(line, column, format!("write a number from 1 to {longest}")),
    }
}

fn rows<'t>(
    lines: impl Iterator<Item = (&'t str, usize)>,
    end: usize,
    width: usize,
    height: usize,
) -> Result<Vec<String>, Wrong> {
    let mut rows = Vec::with_capacity(height);
    for (line, number) in lines {
        if rows.len() == height {
            return wrong(number, 1, format!("{height} rows have come: remove this one, or change `height`"));
        }
        rows.push(row(line, number, width)?);
    }
    match rows.len() {
        count if count < height => {
            wrong(end, 1, format!("{count} rows are there: write {height} of them, or change `height`"))
        }
        _ => Ok(rows),
    }
}

fn row(line: &str, number: usize, width: usize) -> Result<String, Wrong> {
    if let Some((at, cell)) =
        line.chars().enumerate().find(|(_, cell)| !FREE.contains(*cell) && !BLOCKED.contains(*cell))
    {
        let what = format!("`{}` is no cell: write `.` where vehicles can be and `@` elsewhere", cell.escape_default());
        return wrong(number, at + 1, what);
    }
    match line.len() {
        cells if cells > width => {
            wrong(number, width + 1, format!("this row is longer than {width}: cut it, or change `width`"))
        }
        cells if cells < width => {
            wrong(number, cells + 1, format!("this row has {cells} cells: write {width}, or change `width`"))
        }
        _ => Ok(line.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::Grid;

    fn parse(text: &str) -> Result<Grid, String> {
        Grid::parse(text, 100, 1_000).map_err(|wrong| wrong.to_string())
    }

    #[test]
    fn maps_of_others_are_read() {
        let plain = parse("type octile\nheight 2\nwidth 4\nmap\n...@\n....\n").unwrap();
        assert_eq!((plain.width, plain.rows.join("/"), plain.metres_per_cell), (4, "...@/....".to_owned(), None));
        for text in [
            "type octile\r\nheight 2\r\nwidth 4\r\nmap\r\n...@\r\n....\r\n",
            "type octile\nwidth 4\nheight 2\nmap\n...@\n....",
            "type octile\nheight\t2\nwidth\t4\nmap\n...@\n....\n",
            "type octile \nheight 2 \nwidth 4 \nmap \n...@ \n.... \n",
            "\u{feff}type octile\nheight 2\nwidth 4\nmap\n...@\n....\n",
            "type tile\nheight 2\nwidth 4\nmap\n...@\n\n....\n\n",
            "# a comment\ntype octile\nheight 2\nwidth 4\nmap\n...@\n....\n",
        ] {
            assert_eq!(parse(text).as_ref(), Ok(&plain), "{text:?}");
        }
        assert!(parse("type octile\nheight 1\nwidth 4\nmap\n.E@S\n").is_ok(), "of the robot runners");
        let metric = parse("type octile\nmetres_per_cell 0.05\norigin -3.5 12\nheight 1\nwidth 1\nmap\n.\n").unwrap();
        assert_eq!((metric.metres_per_cell, metric.origin), (Some(0.05), [-3.5, 12.0]));
    }

    #[test]
    fn what_is_wrong_is_told_with_its_place() {
        for (text, expected) in [
            ("", "line 1, column 1: the file ends"),
            ("type hex\n", "line 1, column 6: only the types"),
            ("typo octile", "line 1, column 1: a map begins"),
            ("type octile\nheight 101\n", "line 2, column 8: write a number from 1 to 100"),
            ("type octile\nheight 0\n", "line 2, column 8"),
            ("type octile\nmetres_per_cell 0\n", "line 2, column 17: write a length"),
            ("type octile\norigin 1 x\n", "line 2, column 8: write x and y"),
            ("type octile\nheight 1\nwidth 1\norigin 1 2\nmap\n", "line 5, column 1: `origin` is in metres"),
            ("type octile\nheight 1\nmap\n", "line 3, column 1: write `height` once"),
            ("type octile\nheight 60\nwidth 60\nmap\n", "line 4, column 1: 60 x 60 cells"),
            ("type octile\nheight 1\nwidth 4\nmap\n..%.\n", "line 5, column 3: `%` is no cell"),
            ("type octile\nheight 1\nwidth 4\nmap\n....\n....\n", "line 6, column 1: 1 rows have come"),
        ] {
            let reported = parse(text).unwrap_err();
            assert!(reported.starts_with(expected), "{text:?}: {reported}");
        }
    }
}
