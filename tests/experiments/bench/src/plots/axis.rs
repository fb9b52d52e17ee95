//! What an axis shows: its range, its round values and their texts.

use std::ops::Range;

use plotters::coord::ranged1d::{DefaultFormatting, KeyPointHint, Ranged};

/// How many marks an axis has at most.
const MARKS: usize = 9;

#[derive(Clone)]
pub(super) struct Axis {
    pub(super) label: &'static str,
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
    pub(super) fn place(&self, value: f64) -> f64 {
        if self.scale == Scale::Log { value.max(1e-3).log10() } else { value }
    }

    /// The text of a place.
    pub(super) fn text(&self, place: f64) -> String {
        let value = if self.scale == Scale::Log { 10_f64.powf(place) } else { place };
        let value = (value * 1e3).round() / 1e3;
        if value >= 1e4 { format!("{}k", value / 1e3) } else { value.to_string() }
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
            Scale::Linear => -(high * 0.03)..(high * 1.1).max(1e-9),
            Scale::Log => (low - 0.1)..(high + 0.1),
        }
    }
}

/// An axis with lines and labels at round values only.
pub(super) struct Marked {
    range: Range<f64>,
    marks: Vec<f64>,
}

impl Marked {
    /// So that these values fit.
    pub(super) fn new(axis: &Axis, values: impl Iterator<Item = f64>) -> Self {
        let range = axis.range(values.map(|value| axis.place(value)));
        Self { marks: axis.marks(&range), range }
    }
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
