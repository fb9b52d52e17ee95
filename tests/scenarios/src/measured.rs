//! Spans measured in many runs, in one line each.

use cara_core::time::Duration;

use crate::run::Report;

/// One line per measured name: how many, median, worst.
pub fn measurements(report: &Report) -> Vec<String> {
    report.measured.iter().map(|(what, spans)| line(what, spans)).collect()
}

fn line(what: &str, spans: &[Duration]) -> String {
    let mut sorted = spans.to_vec();
    sorted.sort_unstable();
    let of = |share: usize| sorted[(sorted.len() - 1) * share / 100].as_micros() as f64 / 1_000.0;
    let (median, late, worst) = (of(50), of(99), of(100));
    format!("{what}: {} runs, median {median:.1} ms, 99 % {late:.1} ms, worst {worst:.1} ms", sorted.len())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::millis;

    #[test]
    fn the_worst_is_the_largest() {
        let mut report = Report::default();
        report.measured.insert("stop", vec![millis(3), millis(1), millis(2)]);
        assert_eq!(measurements(&report), ["stop: 3 runs, median 2.0 ms, 99 % 2.0 ms, worst 3.0 ms"]);
    }
}
