//! Charts of lines, beside each other, with a font that is part of the program.

use std::path::Path;

use anyhow::{Result, anyhow};
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::{FontStyle, register_font};

/// Width of one chart and height of all, in pixels.
const SIZE: (u32, u32) = (760, 540);
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
        if value.fract().abs() < 1e-9 || value >= 100.0 { format!("{value:.0}") } else { format!("{value:.2}") }
    }

    /// From where to where, so that all places and a margin fit.
    fn range(&self, places: impl Iterator<Item = f64>) -> std::ops::Range<f64> {
        let (low, high) = places.fold((f64::MAX, f64::MIN), |(low, high), place| (low.min(place), high.max(place)));
        match self.scale {
            Scale::Share => 0.0..1.05,
            Scale::Linear => 0.0..(high * 1.1).max(1e-9),
            Scale::Log => (low - 0.1)..(high + 0.1),
        }
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
        // The legend stands below the lines.
        let y = if self.y.scale == Scale::Log { (y.start - (y.end - y.start) * 0.4)..y.end } else { y };
        let mut builder = ChartBuilder::on(area);
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
            let series = chart.draw_series(series).map_err(told)?;
            series.label(&line.name).legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], color));
        }
        let mut legend = chart.configure_series_labels();
        legend.position(SeriesLabelPosition::LowerRight).background_style(WHITE.mix(0.8)).border_style(BLACK.mix(0.3));
        legend.label_font((FONT, 13)).draw().map_err(told)
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
