//! Values with units, as people write them: `50ms`, `2s`, `32KiB`, `64`.

use std::time::Duration;

const SPANS: [(&str, f64); 7] =
    [("ns", 1e-3), ("us", 1.0), ("µs", 1.0), ("ms", 1e3), ("s", 1e6), ("min", 60e6), ("h", 3600e6)];
const SIZES: [(&str, f64); 8] = [
    ("B", 1.0),
    ("kB", 1e3),
    ("KiB", 1024.0),
    ("MB", 1e6),
    ("MiB", 1024.0 * 1024.0),
    ("GB", 1e9),
    ("GiB", 1024.0 * 1024.0 * 1024.0),
    ("bytes", 1.0),
];

/// A span of time in whole microseconds: `50ms`, `2s`, `1.5s`, `0`.
pub fn parse_micros(text: &str) -> Result<u64, String> {
    if text.trim() == "0" {
        return Ok(0);
    }
    scaled(text, &SPANS).ok_or_else(|| format!("write a time with its unit, as 50ms, 2s or 250us, not `{text}`"))
}

/// As [`parse_micros`].
pub fn parse_time(text: &str) -> Result<Duration, String> {
    parse_micros(text).map(Duration::from_micros)
}

/// A number of bytes: `32KiB`, `20kB`, `1024`.
pub fn parse_bytes(text: &str) -> Result<u64, String> {
    let plain = text.trim().parse().ok();
    plain.or_else(|| scaled(text, &SIZES)).ok_or_else(|| format!("write a size, as 32KiB, 20kB or 1024, not `{text}`"))
}

fn scaled(text: &str, units: &[(&str, f64)]) -> Option<u64> {
    let text = text.trim();
    let split = text.find(|c: char| !c.is_ascii_digit() && c != '.')?;
    let (number, unit) = text.split_at_checked(split)?;
    let (_, factor) = units.iter().find(|(name, _)| *name == unit.trim())?;
    let value = (number.parse::<f64>().ok()? * factor).round();
    (value < u64::MAX as f64).then_some(value as u64)
}

/// A span of time as people read it: `3 h`, `1.5 min`, `2 s`, `50 ms`, `12.3 us`.
pub fn show_micros(micros: f64) -> String {
    let (value, unit) = match micros {
        micros if micros >= 3600e6 => (micros / 3600e6, "h"),
        micros if micros >= 60e6 => (micros / 60e6, "min"),
        micros if micros >= 1e6 => (micros / 1e6, "s"),
        micros if micros >= 1e3 => (micros / 1e3, "ms"),
        micros => (micros, "us"),
    };
    let text = if value >= 100.0 { format!("{value:.0}") } else { format!("{value:.2}") };
    let text = if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { &text };
    format!("{text} {unit}")
}

/// A time with its date (UTC), as logs have it: `2026-11-27 14:03:59.123Z`.
pub fn show_time(unix_ms: u64) -> String {
    let (seconds, millis) = (unix_ms / 1000, unix_ms % 1000);
    // Years of 365.2425 days on average that begin in March, so that a leap day is the last of its year.
    let days = seconds / 86_400 + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let of_year = day - (365 * year + year / 4 - year / 100);
    let from_march = (5 * of_year + 2) / 153;
    let of_month = of_year - (153 * from_march + 2) / 5 + 1;
    let (month, next) = if from_march < 10 { (from_march + 3, 0) } else { (from_march - 9, 1) };
    let (year, hour, minute, second) = (era * 400 + year + next, seconds / 3600 % 24, seconds / 60 % 60, seconds % 60);
    format!("{year:04}-{month:02}-{of_month:02} {hour:02}:{minute:02}:{second:02}.{millis:03}Z")
}

/// A number of bytes as people read it: `32 KiB`, `1000 B`.
pub fn show_bytes(bytes: u64) -> String {
    match bytes {
        bytes if bytes > 0 && bytes % (1024 * 1024) == 0 => format!("{} MiB", bytes / (1024 * 1024)),
        bytes if bytes > 0 && bytes % 1024 == 0 => format!("{} KiB", bytes / 1024),
        bytes => format!("{bytes} B"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_have_units() {
        let micros = |text| parse_micros(text).unwrap();
        assert_eq!(
            ["50ms", "2s", "1.5 s", "250us", "0", "0ms", "1min"].map(micros),
            [50_000, 2_000_000, 1_500_000, 250, 0, 0, 60_000_000]
        );
        for wrong in ["", "5", "ms", "-1s", "1 lightyear", "1e400s", "NaNs", "infs", "99999999999999999999h", "1.1.1s"]
        {
            assert!(parse_micros(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_time_has_its_date() {
        let shown = |seconds: u64| show_time(seconds * 1000 + 7);
        assert_eq!(shown(0), "1970-01-01 00:00:00.007Z");
        assert_eq!(shown(951_782_399), "2000-02-28 23:59:59.007Z");
        assert_eq!(shown(951_868_799), "2000-02-29 23:59:59.007Z");
        assert_eq!(shown(4_107_542_400), "2100-03-01 00:00:00.007Z");
        assert_eq!(shown(1_795_816_458), "2026-11-27 21:54:18.007Z");
        assert_eq!(shown(1_798_761_599), "2026-12-31 23:59:59.007Z");
    }

    #[test]
    fn sizes_may_have_units() {
        let bytes = |text| parse_bytes(text).unwrap();
        assert_eq!(["32KiB", "20kB", "1024", "1 MiB", "7B"].map(bytes), [32_768, 20_000, 1024, 1_048_576, 7]);
        for wrong in ["", "-1", "1.5.5kB", "KiB", "3 dozen", "1s"] {
            assert!(parse_bytes(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn times_and_sizes_are_shown_short() {
        assert_eq!(
            [2e6, 5e4, 1500.0, 12.34, 0.0, 123_456.0, 100.0, 90e6, 7200e6].map(show_micros),
            ["2 s", "50 ms", "1.5 ms", "12.34 us", "0 us", "123 ms", "100 us", "1.5 min", "2 h"]
        );
        assert_eq!([0, 1000, 32_768, 1_048_576].map(show_bytes), ["0 B", "1000 B", "32 KiB", "1 MiB"]);
    }
}
