//! Values of a configuration file that TOML has no type for: times and sizes with their units.

use std::fmt;

use cara_std::Duration;
use serde::de::{Deserialize, Deserializer, Error, Unexpected, Visitor};

use cara_tools::units::{parse_bytes, parse_micros};

/// A span of time: `"50ms"`, `"2s"`, or 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Time(pub(super) Duration);

/// A number, of bytes perhaps: `1024` or `"32KiB"`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Size(pub(super) u64);

struct TimeVisitor;

impl Visitor<'_> for TimeVisitor {
    type Value = Time;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a time in quotes with its unit, as \"50ms\" or \"2s\"")
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Time, E> {
        parse_micros(text).map(|micros| Time(Duration::from_micros(micros))).map_err(E::custom)
    }

    fn visit_i64<E: Error>(self, number: i64) -> Result<Time, E> {
        match number {
            0 => Ok(Time(Duration::ZERO)),
            number => Err(E::invalid_type(Unexpected::Signed(number), &self)),
        }
    }
}

impl<'de> Deserialize<'de> for Time {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(TimeVisitor)
    }
}

struct SizeVisitor;

impl Visitor<'_> for SizeVisitor {
    type Value = Size;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number, as 1024, or a size in quotes, as \"32KiB\"")
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Size, E> {
        parse_bytes(text).map(Size).map_err(E::custom)
    }

    fn visit_i64<E: Error>(self, number: i64) -> Result<Size, E> {
        u64::try_from(number).map(Size).map_err(|_| E::invalid_value(Unexpected::Signed(number), &self))
    }
}

impl<'de> Deserialize<'de> for Size {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(SizeVisitor)
    }
}
