//! Charts of lines, beside each other, with a font that is part of the program.

use std::ops::Range;
use std::path::Path;

use anyhow::{Result, anyhow};
use plotters::coord::Shift;
use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};

/// Width of one chart and height of all, in pixels.
const SIZE: (u32, u32) = (1_010, 540);
/// Width of what tells the lines apart, beside them.
const LEGEND: u32 = 300;
/// From one line of that to the next.
const SPACING: i32 = 22;
/// How many marks an axis has at most.
const MARKS: usize = 9;
/// Under this name the font is known to the drawing library.
const FONT: &str = "sans-serif";

/// A chart of lines with points.
pub(super) struct Chart {
    pub(super) title: String,
    pub(super) x: Axis,
    pub(super) y: Axis,
    pub(super) lines: Vec<Line>,
}

/// One line of a chart.
pub(super) struct Line {
    pub(super) name: String,
    pub(super) points: Vec<(f64, f64)>,
}

/// What an axis shows.
pub(super) struct Axis {
    label: &'static str,
    scale: Scale,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Scale {
    Linear,
    /// From 0 to a little above 1.
    Share,
    Log,
}

impl Axis {
    pub(super) fn linear(label: &'static str) -> Self {
        Self { label, scale: Scale::Linear }
    }

    pub(super) fn share(label: &'static str) -> Self {
        Self { label, scale: Scale::Share }
    }

    pub(super) fn log(label: &'static str) -> Self {
        Self { label, scale: Scale::Log }
    }

    /// A value's place on the axis.
    fn place(&self, value: f64) -> f64 {
        if self.scale == Scale::Log { value.max(1e-3).log10() } else { value }
    }

    /// The text of a place.
    fn text(&self, place: f64) -> String {
        let value = if self.scale == Scale::Log { 10_f64.powf(place) } else { place };
        ((value * 1e3).round() / 1e3).to_string()
    }

    /// Places of round values.
    fn marks(&self, range: &Range<f64>) -> Vec<f64> {
        if self.scale == Scale::Log {
            let decades = range.start.floor() as i32..=range.end.ceil() as i32;
            let marks = |steps: &[f64]| {
                let values =
                    decades.clone().flat_map(|decade| steps.iter().map(move |step| step * 10_f64.powi(decade)));
                values.map(f64::log10).filter(|place| range.contains(place)).collect::<Vec<_>>()
            };
            let [fine, middle, coarse] = [&[1.0, 1.5, 2.0, 3.0, 5.0, 7.0][..], &[1.0, 2.0, 5.0], &[1.0]].map(marks);
            return [fine, middle].into_iter().find(|marks| marks.len() <= MARKS).unwrap_or(coarse);
        }
        let steps = (-3..6).flat_map(|decade| [1.0, 2.0, 5.0].map(|step| step * 10_f64.powi(decade)));
        let step = steps.into_iter().find(|step| (range.end - range.start) / step <= MARKS as f64).unwrap_or(1e6);
        (0..=MARKS).map(|mark| mark as f64 * step).filter(|place| range.contains(place)).collect()
    }

    /// From where to where, so that all places and a margin fit.
    fn range(&self, places: impl Iterator<Item = f64>) -> Range<f64> {
        let (low, high) = places.fold((f64::MAX, f64::MIN), |(low, high), place| (low.min(place), high.max(place)));
        match self.scale {
            Scale::Share => 0.0..1.05,
            Scale::Linear => 0.0..(high * 1.1).max(1e-9),
            Scale::Log => (low - 0.1)..(high + 0.1),
        }
    }
}

/// An axis with lines and labels at these places only.
struct Marked {
    range: Range<f64>,
    marks: Vec<f64>,
}

impl Ranged for Marked {
    type FormatOption = DefaultFormatting;
    type ValueType = f64;

    fn map(&self, place: &f64, (first, last): (i32, i32)) -> i32 {
        let part = (place - self.range.start) / (self.range.end - self.range.start);
        first + (part * f64::from(last - first)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, hint: Hint) -> Vec<f64> {
        if hint.weight().allow_light_points() { Vec::new() } else { self.marks.clone() }
    }

    fn range(&self) -> Range<f64> {
        self.range.clone()
    }
}

impl Chart {
    pub(super) fn is_empty(&self) -> bool {
        self.lines.iter().all(|line| line.points.is_empty())
    }

    fn draw<D: DrawingBackend>(&self, area: &DrawingArea<D, Shift>) -> Result<()> {
        let points = || self.lines.iter().flat_map(|line| &line.points);
        let x = self.x.range(points().map(|point| self.x.place(point.0)));
        let y = self.y.range(points().map(|point| self.y.place(point.1)));
        let (area, legend) = area.split_horizontally(SIZE.0 - LEGEND);
        let (x_marks, y_marks) = (self.x.marks(&x), self.y.marks(&y));
        let (x, y) = (Marked { range: x, marks: x_marks }, Marked { range: y, marks: y_marks });
        let mut builder = ChartBuilder::on(&area);
        builder.caption(&self.title, (FONT, 20)).margin(12).x_label_area_size(44).y_label_area_size(64);
        let mut chart = builder.build_cartesian_2d(x, y).map_err(told)?;
        let mut mesh = chart.configure_mesh();
        let (x_text, y_text) = (|place: &f64| self.x.text(*place), |place: &f64| self.y.text(*place));
        mesh.x_desc(self.x.label).y_desc(self.y.label).x_label_formatter(&x_text).y_label_formatter(&y_text);
        mesh.label_style((FONT, 14)).x_labels(7).y_labels(8).draw().map_err(told)?;
        for (index, line) in self.lines.iter().enumerate() {
            let color = Palette99::pick(index).to_rgba();
            let places = line.points.iter().map(|point| (self.x.place(point.0), self.y.place(point.1)));
            let series = LineSeries::new(places, color.stroke_width(2)).point_size(3);
            chart.draw_series(series).map_err(told)?;
            let middle = 50 + index as i32 * SPACING;
            legend.draw(&PathElement::new([(0, middle), (18, middle)], color.stroke_width(2))).map_err(told)?;
            legend.draw(&Text::new(line.name.as_str(), (26, middle - 7), (FONT, 13))).map_err(told)?;
        }
        Ok(())
    }
}

/// Draws charts side by side, as `path` with `.svg` and with `.png`.
pub(super) fn draw(charts: &[Chart], path: &Path) -> Result<()> {
    register_font(FONT, FontStyle::Normal, dejavu::sans::regular()).map_err(|_| anyhow!("the font cannot be read"))?;
    let size = (SIZE.0 * charts.len() as u32, SIZE.1);
    all(charts, SVGBackend::new(&path.with_extension("svg"), size).into_drawing_area())?;
    all(charts, BitMapBackend::new(&path.with_extension("png"), size).into_drawing_area())
}

fn all<D: DrawingBackend>(charts: &[Chart], area: DrawingArea<D, Shift>) -> Result<()> {
    area.fill(&WHITE).map_err(told)?;
    let parts = area.split_evenly((1, charts.len()));
    charts.iter().zip(&parts).try_for_each(|(chart, part)| chart.draw(part))?;
    area.present().map_err(told)
}

/// The drawing library's errors borrow from what they are about.
fn told(error: impl std::fmt::Display) -> anyhow::Error {
    anyhow!("{error}")
}
