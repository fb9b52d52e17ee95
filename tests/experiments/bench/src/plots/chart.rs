//! Charts of lines in rows and columns, with one legend and a font that is part of the program.
//!
//! A line is told from the others by colour, marker and dashes, so that print in grey will do; lines that share an axis are
//! a few pixels apart, so that none hides another.

use std::path::Path;

use anyhow::{Context, Result, anyhow};
use plotters::coord::Shift;
use plotters::element::DashedPathElement;
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};

use super::axis::{Axis, Marked};

/// Width and height of one chart, in pixels.
const SIZE: (u32, u32) = (520, 400);
/// Width of the legend, on the right of all charts.
const LEGEND: u32 = 400;
/// From one line of the legend to the next.
const SPACING: i32 = 24;
/// From one line to the next along the axis.
const OFFSET: i32 = 2;
/// Under this name the font is known to the drawing library.
const FONT: &str = "sans-serif";

/// A chart of lines with points.
#[derive(Clone)]
pub(super) struct Chart {
    pub(super) title: String,
    pub(super) x: Axis,
    pub(super) y: Axis,
    pub(super) lines: Vec<Line>,
    /// Vertical lines with a text: where something is expected.
    pub(super) knees: Vec<(f64, String)>,
}

/// One line of a chart; lines of one name look alike in all charts of a figure.
#[derive(Clone)]
pub(super) struct Line {
    pub(super) name: String,
    pub(super) kind: Kind,
    pub(super) points: Vec<Point>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Measured,
    /// Reckoned, not measured: thin and without markers.
    Reckoned,
    /// What the paper's text tells: a broad grey line.
    Paper,
}

#[derive(Clone, Copy)]
pub(super) struct Point {
    pub(super) x: f64,
    pub(super) y: f64,
    /// Drawn as a bar.
    pub(super) spread: Option<(f64, f64)>,
    /// With a ring around it.
    pub(super) is_knee: bool,
}

impl Point {
    pub(super) fn new(x: f64, y: f64) -> Self {
        Self { x, y, spread: None, is_knee: false }
    }

    pub(super) fn with_spread(self, low: f64, high: f64) -> Self {
        Self { spread: Some((low, high)), ..self }
    }
}

impl Line {
    pub(super) fn measured(name: impl Into<String>, points: Vec<Point>) -> Self {
        Self { name: name.into(), kind: Kind::Measured, points }
    }

    pub(super) fn of(kind: Kind, name: impl Into<String>, points: &[(f64, f64)]) -> Self {
        Self { name: name.into(), kind, points: points.iter().map(|&(x, y)| Point::new(x, y)).collect() }
    }
}

impl Chart {
    pub(super) fn new(title: impl Into<String>, x: Axis, y: Axis, lines: Vec<Line>) -> Self {
        Self { title: title.into(), x, y, lines, knees: Vec::new() }
    }

    /// Whether nothing in it was measured.
    pub(super) fn is_empty(&self) -> bool {
        !self.lines.iter().any(|line| line.kind == Kind::Measured && !line.points.is_empty())
    }

    fn draw<D: DrawingBackend>(&self, root: &Area<D>, area: &Area<D>, names: &[(String, Kind)]) -> Result<()> {
        let points = || self.lines.iter().flat_map(|line| &line.points);
        let spreads = || points().filter_map(|point| point.spread).flat_map(|(low, high)| [low, high]);
        let x = Marked::new(&self.x, points().map(|point| point.x).chain(self.knees.iter().map(|(x, _)| *x)));
        let y = Marked::new(&self.y, points().map(|point| point.y).chain(spreads()));
        let mut builder = ChartBuilder::on(area);
        builder.caption(&self.title, (FONT, 16)).margin(10).x_label_area_size(42).y_label_area_size(62);
        let mut chart = builder.build_cartesian_2d(x, y).map_err(reported)?;
        let mut mesh = chart.configure_mesh();
        let (x_text, y_text) = (|place: &f64| self.x.text(*place), |place: &f64| self.y.text(*place));
        mesh.x_desc(self.x.label).y_desc(self.y.label).x_label_formatter(&x_text).y_label_formatter(&y_text);
        mesh.label_style((FONT, 13)).bold_line_style(BLACK.mix(0.12)).draw().map_err(reported)?;
        let place = |x: f64, y: f64| chart.backend_coord(&(self.x.place(x), self.y.place(y)));
        let (_, tops) = chart.plotting_area().get_pixel_range();
        for (index, (x, text)) in self.knees.iter().enumerate() {
            let at = chart.backend_coord(&(self.x.place(*x), 0.0)).0;
            let ends = [(at, tops.start), (at, tops.end)];
            root.draw(&DashedPathElement::new(ends, 2, 3, BLACK.mix(0.6))).map_err(reported)?;
            let height = tops.end - 16 - 14 * (index as i32 % 4);
            // On the side where there is room.
            let (columns, _) = chart.plotting_area().get_pixel_range();
            let is_right = at > (columns.start + columns.end) / 2;
            let left = if is_right { at - 6 * text.chars().count() as i32 - 4 } else { at + 3 };
            root.draw(&Text::new(text.as_str(), (left, height), (FONT, 11))).map_err(reported)?;
        }
        let style = |line: &Line| names.iter().position(|(name, _)| *name == line.name).map(Style::of);
        for line in &self.lines {
            let style = style(line).context("every line has a name in the legend")?;
            let shift = if line.kind == Kind::Measured { style.shift() } else { 0 };
            let shifted = |(x, y): (i32, i32)| (x + shift, y);
            let path: Vec<_> = line.points.iter().map(|point| shifted(place(point.x, point.y))).collect();
            style.path(root, line.kind, &path)?;
            for (point, &at) in line.points.iter().zip(&path).filter(|_| line.kind == Kind::Measured) {
                if let Some((low, high)) = point.spread {
                    let ends = [low, high].map(|y| shifted(place(point.x, y)));
                    root.draw(&PathElement::new(ends, style.color.stroke_width(1))).map_err(reported)?;
                }
                style.marker(root, at)?;
                if point.is_knee {
                    root.draw(&Circle::new(at, 9, style.color.stroke_width(2))).map_err(reported)?;
                }
            }
        }
        Ok(())
    }
}

type Area<D> = DrawingArea<D, Shift>;

/// How a line looks.
struct Style {
    index: usize,
    color: RGBColor,
}

/// From dark to light, so that they differ in grey as well.
const COLORS: [RGBColor; 6] = [
    RGBColor(0, 0, 0),
    RGBColor(0, 80, 160),
    RGBColor(200, 60, 0),
    RGBColor(0, 150, 110),
    RGBColor(150, 110, 200),
    RGBColor(205, 160, 0),
];
const PAPER: RGBColor = RGBColor(170, 170, 170);

impl Style {
    fn of(index: usize) -> Self {
        Self { index, color: COLORS[index % COLORS.len()] }
    }

    /// Along the axis, in pixels.
    fn shift(&self) -> i32 {
        (self.index as i32 % 5 - 2) * OFFSET
    }

    fn path<D: DrawingBackend>(&self, root: &Area<D>, kind: Kind, path: &[(i32, i32)]) -> Result<()> {
        let color = self.color.stroke_width(2);
        let dashes = [(1, 0), (8, 4), (3, 3)][self.index % 3];
        match (kind, dashes) {
            (Kind::Paper, _) => root.draw(&PathElement::new(path.to_vec(), PAPER.stroke_width(7))),
            (Kind::Reckoned, _) => root.draw(&DashedPathElement::new(path.to_vec(), 2, 4, BLACK.stroke_width(1))),
            (Kind::Measured, (_, 0)) => root.draw(&PathElement::new(path.to_vec(), color)),
            (Kind::Measured, (dash, gap)) => root.draw(&DashedPathElement::new(path.to_vec(), dash, gap, color)),
        }
        .map_err(reported)
    }

    fn marker<D: DrawingBackend>(&self, root: &Area<D>, (x, y): (i32, i32)) -> Result<()> {
        let color = self.color;
        let shape = |corners: &[(i32, i32)]| corners.iter().map(|(dx, dy)| (x + dx, y + dy)).collect::<Vec<_>>();
        match self.index % 5 {
            0 => root
                .draw(&Circle::new((x, y), 4, WHITE.filled()))
                .and_then(|()| root.draw(&Circle::new((x, y), 4, color.stroke_width(2)))),
            1 => root.draw(&Circle::new((x, y), 4, color.filled())),
            2 => root.draw(&Polygon::new(shape(&[(-4, 4), (4, 4), (0, -5)]), color.filled())),
            3 => root.draw(&Rectangle::new([(x - 4, y - 4), (x + 4, y + 4)], color.filled())),
            _ => root.draw(&Cross::new((x, y), 4, color.stroke_width(2))),
        }
        .map_err(reported)
    }
}

/// Draws charts in rows, as an SVG file `path`, with `about` below the legend.
pub(super) fn draw(rows: &[Vec<Chart>], about: &[String], path: &Path) -> Result<()> {
    register_font(FONT, FontStyle::Normal, dejavu::sans::regular()).map_err(|_| anyhow!("the font cannot be read"))?;
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let size = (SIZE.0 * columns + LEGEND, SIZE.1 * rows.len() as u32);
    all(rows, about, &SVGBackend::new(&path.with_extension("svg"), size).into_drawing_area())
}

fn all<D: DrawingBackend>(rows: &[Vec<Chart>], about: &[String], root: &Area<D>) -> Result<()> {
    root.fill(&WHITE).map_err(reported)?;
    let (charts, _) = root.split_horizontally(root.dim_in_pixel().0 - LEGEND);
    let mut names: Vec<(String, Kind)> = Vec::new();
    for line in rows.iter().flatten().flat_map(|chart| &chart.lines).filter(|line| !line.points.is_empty()) {
        if !names.iter().any(|(name, _)| *name == line.name) {
            names.push((line.name.clone(), line.kind));
        }
    }
    // Markers and colours go to what was measured first.
    names.sort_by_key(|(_, kind)| *kind != Kind::Measured);
    for (row, area) in rows.iter().zip(charts.split_evenly((rows.len(), 1))) {
        let areas = area.split_evenly((1, row.len()));
        row.iter().zip(&areas).filter(|(chart, _)| !chart.is_empty()).try_for_each(|(chart, area)| {
            let mut chart = chart.clone();
            chart.lines.retain(|line| !line.points.is_empty());
            chart.draw(root, area, &names)
        })?;
    }
    legend(root, &names, about)?;
    root.present().map_err(reported)
}

fn legend<D: DrawingBackend>(root: &Area<D>, names: &[(String, Kind)], about: &[String]) -> Result<()> {
    let left = (root.dim_in_pixel().0 - LEGEND) as i32 + 8;
    for (index, (name, kind)) in names.iter().enumerate() {
        let (middle, style) = (30 + index as i32 * SPACING, Style::of(index));
        style.path(root, *kind, &[(left, middle), (left + 34, middle)])?;
        if *kind == Kind::Measured {
            style.marker(root, (left + 17, middle))?;
        }
        root.draw(&Text::new(name.as_str(), (left + 42, middle - 7), (FONT, 13))).map_err(reported)?;
    }
    for (index, text) in about.iter().enumerate() {
        let top = 30 + (names.len() as i32 + 1) * SPACING + index as i32 * 18;
        root.draw(&Text::new(text.as_str(), (left, top), (FONT, 12))).map_err(reported)?;
    }
    Ok(())
}

/// The drawing library's errors borrow from what they are about.
fn reported(error: impl std::fmt::Display) -> anyhow::Error {
    anyhow!("{error}")
}
