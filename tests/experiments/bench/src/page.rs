//! The tables of `docs/performance.md`, made of the rows of a run: each stands between `<!-- bench NAME -->` and
//! `<!-- end -->`.

use std::fmt::Write as _;
use std::path::Path;
use std::process::Command;

use anyhow::{Context, Result, bail};
use cara_bench_ends::Pin;

use crate::experiments::goals;
use crate::peers::SPINNING;
use crate::results::{Goal, Kind, Mode, Response, Results, Throughput};

const BEGIN: &str = "<!-- bench ";
const END: &str = "<!-- end -->";

/// Who has a row, as the rows of a run and as the page name them.
const NAMES: [(&str, Mode, &str); 6] = [
    ("floor", Mode::Plain, "plain sockets"),
    ("floor_again", Mode::Plain, "plain sockets again"),
    ("cara", Mode::Plain, "**CARA**"),
    ("cara", Mode::Secured, "CARA secured"),
    (SPINNING, Mode::Plain, "CARA, both ends spin"),
    (SPINNING, Mode::Secured, "CARA secured, both ends spin"),
];
const CHARS: [u32; 4] = [100, 1_000, 20_000, 100_000];

/// Makes the tables of the page anew.
pub(crate) fn write(results: &Results, path: &Path) -> Result<()> {
    let page = std::fs::read_to_string(path).with_context(|| format!("reading {}", path.display()))?;
    let page = filled(results, &page).with_context(|| format!("the tables of {}", path.display()))?;
    std::fs::write(path, page).with_context(|| format!("writing {}", path.display()))
}

fn filled(results: &Results, mut page: &str) -> Result<String> {
    let mut filled = String::new();
    while let Some((before, rest)) = page.split_once(BEGIN) {
        let (name, rest) = rest.split_once(" -->").context("a mark has no end")?;
        let (_, rest) = rest.split_once(END).with_context(|| format!("{name} has no end"))?;
        let table = table(name, results)?;
        if table.is_empty() {
            bail!("the run has no rows for {name}");
        }
        write!(filled, "{before}{BEGIN}{name} -->\n{table}{END}")?;
        page = rest;
    }
    Ok(filled + page)
}

fn table(name: &str, results: &Results) -> Result<String> {
    Ok(match name {
        "run" => run(results),
        "one CPU" => round_trips(results, Pin::Same),
        "two CPUs" => round_trips(results, Pin::Split),
        "spinning" => spinning(results),
        "a second" => a_second(results),
        "missed" => missed(&goals::of(results)),
        _ => bail!("there is no table {name}"),
    })
}

fn run(results: &Results) -> String {
    let run = &results.run;
    let date = Command::new("date").args(["-u", "+%F, %R UTC", "-d", &format!("@{}", run.started_unix_s)]).output();
    let date = date.map(|date| String::from_utf8_lossy(&date.stdout).trim().to_owned()).unwrap_or_default();
    format!(
        "Commit {}, {date}, {} minutes, {} CPUs ({}), load {} before it; the {} run.\n",
        run.commit,
        (run.seconds / 60.0).ceil(),
        run.cpus,
        run.processor,
        run.load_before,
        run.extent
    )
}

/// Back to back, silent, of distribution 1.
fn response<'r>(results: &'r Results, (peer, mode): (&str, Mode), pin: Pin, chars: u32) -> Option<&'r Response> {
    let cell = |row: &Response| (row.mode, row.pin, row.chars, row.distribution, row.pause_ms, row.print);
    results.response.iter().find(|row| row.peer == peer && cell(row) == (mode, pin, chars, 1, 0, false))
}

fn round_trips(results: &Results, pin: Pin) -> String {
    let header = CHARS.map(|chars| grouped(f64::from(chars))).join(" | ");
    let rows = NAMES.iter().map(|&(peer, mode, name)| {
        let cells = CHARS.map(|chars| {
            let row = response(results, (peer, mode), pin, chars)?;
            Some(format!("{:.0} ({}) · {:.2}", row.p50_us, grouped(row.p99_us), row.ratio))
        });
        (name, cells.to_vec())
    });
    markdown(&format!("characters | {header}"), rows)
}

fn spinning(results: &Results) -> String {
    let chars = [100, 1_000, 20_000];
    let header = chars.map(|chars| format!("{}: round trip, µs | CPU, µs", grouped(f64::from(chars)))).join(" | ");
    let rows = NAMES.iter().map(|&(peer, mode, name)| {
        let cells = chars.iter().flat_map(|chars| {
            let row = response(results, (peer, mode), Pin::Split, *chars);
            let figures = row.map(|row| [(row.p50_us, row.ratio), (row.cpu_us_per_call, row.cpu_ratio)]);
            [0, 1].map(|which| figures.map(|of| format!("{:.0} · {:.2}", of[which].0, of[which].1)))
        });
        (name, cells.collect())
    });
    markdown(&format!("a CPU for each end | {header}"), rows)
}

fn a_second(results: &Results) -> String {
    let columns = [(Kind::Request, 1), (Kind::Request, 8), (Kind::Request, 64), (Kind::OneWay, 1)];
    let columns =
        [Pin::Same, Pin::Split].into_iter().flat_map(|pin| columns.map(|(kind, callers)| (pin, kind, callers)));
    let columns = columns.collect::<Vec<_>>();
    let header =
        "a second, 100 characters | one CPU: 1 caller | 8 | 64 | one-way | two CPUs: 1 caller | 8 | 64 | one-way";
    let rows = NAMES.iter().map(|&(peer, mode, name)| {
        let cells = columns.iter().map(|column| {
            let is_wanted =
                |row: &&Throughput| row.peer == peer && row.mode == mode && (row.pin, row.kind, row.callers) == *column;
            let row = results.throughput.iter().find(is_wanted)?;
            Some(format!("{} · {:.2}", grouped(row.requests_per_s), row.ratio))
        });
        (name, cells.collect())
    });
    markdown(header, rows)
}

/// A row for each quantity and limit.
fn missed(goals: &[Goal]) -> String {
    let mut rows: Vec<(String, Vec<Option<String>>)> = Vec::new();
    for goal in goals.iter().filter(|goal| goal.is_reached == Some(false)) {
        let figure = format!("{}: {:.2}", goal.cell, goal.figure.unwrap_or_default());
        let quantity = format!("{} {}", goal.quantity, goal.goal);
        match rows.iter_mut().find(|(known, _)| *known == quantity) {
            Some((_, cells)) => cells.iter_mut().flatten().for_each(|cell| *cell = format!("{cell}. {figure}")),
            None => rows.push((quantity, vec![Some(figure)])),
        }
    }
    markdown("goal | missed by", rows.iter().map(|(quantity, cells)| (quantity.as_str(), cells.clone())))
}

/// Rows of which nothing was measured are left out; no table without rows.
fn markdown<'n>(header: &str, rows: impl Iterator<Item = (&'n str, Vec<Option<String>>)>) -> String {
    let rows = rows.filter(|(_, cells)| cells.iter().any(Option::is_some)).map(|(name, cells)| {
        let cells = cells.into_iter().map(|cell| cell.unwrap_or_else(|| "–".into())).collect::<Vec<_>>();
        format!("| {name} | {} |\n", cells.join(" | "))
    });
    let rows = rows.collect::<String>();
    let rule = "|---".repeat(header.split('|').count());
    if rows.is_empty() { rows } else { format!("| {header} |\n{rule}|\n{rows}") }
}

/// Three digits that count, in groups of three.
fn grouped(figure: f64) -> String {
    let step = 10f64.powf((figure.max(1.0).log10().floor() - 2.0).max(0.0));
    let digits = format!("{:.0}", (figure / step).round() * step);
    let groups = digits.as_bytes().rchunks(3).rev().map(String::from_utf8_lossy).collect::<Vec<_>>();
    groups.join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    const ROOT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../..");

    #[test]
    fn what_stands_between_marks_is_of_the_run() {
        let results = Results::read(&Path::new(ROOT).join("tests/experiments/plots/full.json")).unwrap();
        let page = "before\n<!-- bench one CPU -->\nold\n<!-- end -->\nafter\n";
        let filled = |page: &str| super::filled(&results, page);
        let fresh = filled(page).unwrap();
        assert!(fresh.starts_with("before\n<!-- bench one CPU -->\n| characters | 100 |"), "{fresh}");
        assert!(fresh.ends_with(" |\n<!-- end -->\nafter\n") && !fresh.contains("old"), "{fresh}");
        assert!(fresh.contains("| **CARA** | 16 (85) · 1."), "{fresh}");
        assert_eq!(filled(&fresh).unwrap(), fresh);
        assert!(filled(&page.replace("one CPU", "spinning")).unwrap().contains("plain sockets again"));
        assert!(filled(&page.replace("one CPU", "no CPU")).is_err());
        let error = super::filled(&Results::default(), page).unwrap_err();
        assert!(error.to_string().contains("no rows for one CPU"), "{error}");
    }

    #[test]
    fn the_page_has_marks_of_tables_that_there_are() {
        let page = std::fs::read_to_string(Path::new(ROOT).join("docs/performance.md")).unwrap();
        let names = page.split(BEGIN).skip(1).map(|rest| rest.split_once(" -->").unwrap().0).collect::<Vec<_>>();
        assert_eq!(names, ["run", "one CPU", "two CPUs", "spinning", "a second", "missed"]);
        assert_eq!(page.matches(END).count(), names.len());
        names.iter().for_each(|name| drop(table(name, &Results::default()).unwrap()));
        let results = Results::read(&Path::new(ROOT).join("tests/experiments/plots/full.json")).unwrap();
        assert_eq!(filled(&results, &page).unwrap(), page, "the page and the rows are of two runs");
    }

    #[test]
    fn three_digits_count() {
        let written = [0.0, 9.6, 142.4, 1_916.0, 52_345.0, 1_615_200.0].map(grouped);
        assert_eq!(written, ["0", "10", "142", "1,920", "52,300", "1,620,000"]);
    }
}
