//! Faults that are injected while calls go on: how long they last, which calls are lost, and the table of what came of them.

use std::collections::HashMap;
use std::fmt::Write;
use std::time::Duration;

/// How long a call waits for its answer.
pub const TIMEOUT: Duration = Duration::from_millis(500);
/// A call that goes on for so much longer has no outcome.
pub const LATE: Duration = Duration::from_secs(2);
/// From the end of a fault until calls are answered.
pub const PATIENCE: Duration = Duration::from_secs(90);
/// Answered calls before the next fault.
pub const CALM: usize = 20;

/// How often each fault is injected, and what the names of those that are contain: `CARA_EACH` and `CARA_KIND`.
pub fn options() -> (usize, String) {
    let each = std::env::var("CARA_EACH").ok().and_then(|each| each.parse().ok());
    (each.unwrap_or(3), std::env::var("CARA_KIND").unwrap_or_default())
}

/// How long one of `each` faults lasts, from 0.5 to 12 s.
pub fn lasts(number: usize, each: usize) -> Duration {
    Duration::from_millis(500 + 11_500 * number as u64 / each.max(2) as u64)
}

/// What became of calls, which have numbers.
#[derive(Default)]
pub struct Calls {
    answered: HashMap<i64, bool>,
    runs: HashMap<i64, usize>,
    /// Answers that were another call's, calls that ran elsewhere, and those without an outcome.
    wrong: usize,
}

impl Calls {
    /// The callee runs one.
    pub fn ran(&mut self, number: i64) {
        *self.runs.entry(number).or_default() += 1;
    }

    /// Another node than the callee runs one.
    pub fn strayed(&mut self, _number: i64) {
        self.wrong += 1;
    }

    /// One has ended after this time, with an answer or an error. `more` is how long its caller stood still meanwhile.
    pub fn ended(&mut self, number: i64, answer: Option<i64>, took: Duration, more: Duration) {
        self.wrong += usize::from(took > TIMEOUT + LATE + more);
        self.wrong += usize::from(answer.is_some_and(|answer| answer != number));
        self.answered.insert(number, answer.is_some());
    }

    /// Calls that ran twice or were answered and never ran, and what else went wrong.
    pub fn lost(&self) -> usize {
        let of = |number: &i64| self.runs.get(number).copied().unwrap_or(0);
        let twice = self.runs.values().filter(|runs| **runs > 1).count();
        let never = self.answered.iter().filter(|(number, is_answered)| **is_answered && of(number) == 0).count();
        self.wrong + twice + never
    }

    /// How many have ended, and how many of them without an answer.
    pub fn counts(&self) -> (usize, usize) {
        (self.answered.len(), self.answered.values().filter(|is_answered| !**is_answered).count())
    }
}

/// A row for each kind of fault, in Markdown.
pub struct Table(String);

impl Table {
    /// With further columns of these names.
    pub fn new(more: &[&str]) -> Self {
        let names = ["fault", "injections", "calls; not answered", "lost", "recovery: median", "99 %", "worst"];
        let names = [&names, more].concat();
        Self(format!("| {} |\n|{}\n", names.join(" | "), "---|".repeat(names.len())))
    }

    /// What came of one kind, whose recoveries took so long.
    pub fn row(&mut self, name: &str, took: &mut [Duration], calls: (usize, usize), lost: usize, more: &[String]) {
        took.sort_unstable();
        let at = |percent: usize| took[(took.len() * percent).div_ceil(100) - 1].as_secs_f64();
        let spans = [50, 99, 100].map(|percent| format!("{:.2} s", at(percent)));
        let ((count, failed), spans) = (calls, [&spans, more].concat().join(" | "));
        writeln!(self.0, "| {name} | {} | {count}; {failed} | {lost} | {spans} |", took.len()).expect("into a string");
    }
}

impl std::fmt::Display for Table {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_of_lost_call_is_counted() {
        let mut calls = Calls::default();
        let (soon, none) = (Duration::ZERO, Duration::ZERO);
        (0..4).for_each(|number| calls.ran(number));
        calls.ended(0, Some(0), soon, none);
        calls.ended(1, None, soon, none);
        assert_eq!((calls.lost(), calls.counts()), (0, (2, 1)));
        calls.ran(1);
        assert_eq!(calls.lost(), 1, "it ran twice");
        calls.ended(9, Some(9), soon, none);
        assert_eq!(calls.lost(), 2, "it was answered and never ran");
        calls.ended(2, Some(3), soon, none);
        assert_eq!(calls.lost(), 3, "it has another call's answer");
        calls.ended(3, None, TIMEOUT + LATE * 2, none);
        assert_eq!(calls.lost(), 4, "it has no outcome in time");
        calls.ended(3, None, TIMEOUT + LATE * 2, LATE);
        assert_eq!(calls.lost(), 4, "its caller stood still");
        calls.strayed(0);
        assert_eq!(calls.lost(), 5, "it ran elsewhere");
    }

    #[test]
    fn a_row_has_its_median_and_worst() {
        let mut table = Table::new(&["stood after"]);
        table.row("cut", &mut [3, 1, 2].map(Duration::from_secs), (7, 2), 0, &["1.0 s".to_owned()]);
        assert!(table.to_string().ends_with("| cut | 3 | 7; 2 | 0 | 2.00 s | 3.00 s | 3.00 s | 1.0 s |\n"), "{table}");
    }
}
