//! Runs groups of checks one after the other, and reports what each showed and what it cost.

use std::process::ExitCode;
use std::time::Instant;

use anyhow::{Result, bail};

use crate::groups::{Extent, GROUPS, Group, Outcome};

/// A group that has run.
struct Report {
    group: &'static Group,
    outcome: Outcome,
    seconds: f64,
    budget: u64,
}

/// Prints the table of groups.
pub(crate) fn list() -> Result<ExitCode> {
    println!("{:<14}{:>8}{:>8}  {:<12}checks that", "group", "full s", "quick s", "by default");
    for group in &GROUPS {
        let quick = group.quick.map_or("-".to_owned(), |seconds| seconds.to_string());
        let default = if group.by_default { "yes" } else { "when named" };
        println!("{:<14}{:>8}{:>8}  {:<12}{}", group.name, group.budget, quick, default, group.what);
    }
    Ok(ExitCode::SUCCESS)
}

/// Runs the groups named, or those of the default run.
pub(crate) fn run(names: &[String], quick: bool) -> Result<ExitCode> {
    let chosen = chosen(names, quick)?;
    let reports: Vec<Report> = chosen.into_iter().map(|group| run_group(group, quick)).collect();
    summarise(&reports);
    let strict = is_strict(std::env::var("CI").ok().as_deref());
    let (line, success) = verdict(&reports, strict);
    if strict && !success && !reports.iter().any(|report| matches!(report.outcome, Outcome::Failed(_))) {
        println!("CI is set: what is skipped fails");
    }
    println!("{line}");
    Ok(if success { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn chosen(names: &[String], quick: bool) -> Result<Vec<&'static Group>> {
    if names.is_empty() {
        return Ok(GROUPS.iter().filter(|group| group.by_default && (!quick || group.quick.is_some())).collect());
    }
    let mut chosen = Vec::new();
    for name in names {
        match GROUPS.iter().find(|group| group.name == name) {
            Some(group) => chosen.push(group),
            None => bail!("no group is called `{name}`: see cargo xtask test --list"),
        }
    }
    Ok(chosen)
}

fn run_group(group: &'static Group, quick: bool) -> Report {
    println!("== {}: {}", group.name, group.what);
    let (extent, budget) = match group.quick {
        Some(seconds) if quick => (Extent::Quick, seconds),
        _ => (Extent::Full, group.budget),
    };
    let start = Instant::now();
    let outcome = (group.run)(extent);
    let report = Report { group, outcome, seconds: start.elapsed().as_secs_f64(), budget };
    println!("-- {}", report.line());
    if report.seconds > budget as f64 {
        println!("warning: {} took {:.0} s, its budget is {budget} s", group.name, report.seconds);
    }
    report
}

fn summarise(reports: &[Report]) {
    println!("\n{:<14}{:>10}{:>10}  result", "group", "time s", "budget s");
    for report in reports {
        println!("{}", report.line());
    }
}

impl Report {
    fn line(&self) -> String {
        let result = match &self.outcome {
            Outcome::Passed => "passed".to_owned(),
            Outcome::Failed(why) => format!("FAILED: {why}"),
            Outcome::Skipped(why) => format!("skipped: {why}"),
        };
        format!("{:<14}{:>10.1}{:>10}  {result}", self.group.name, self.seconds, self.budget)
    }
}

/// The last line, and whether the whole run counts as a success.
fn verdict(reports: &[Report], strict: bool) -> (String, bool) {
    let count = |wanted: fn(&Outcome) -> bool| reports.iter().filter(|report| wanted(&report.outcome)).count();
    let passed = count(|outcome| matches!(outcome, Outcome::Passed));
    let failed = count(|outcome| matches!(outcome, Outcome::Failed(_)));
    let skipped = count(|outcome| matches!(outcome, Outcome::Skipped(_)));
    (format!("{passed} passed, {failed} failed, {skipped} skipped"), failed == 0 && (skipped == 0 || !strict))
}

/// Whether the environment's `CI` asks that everything is shown.
fn is_strict(ci: Option<&str>) -> bool {
    ci.is_some_and(|value| !matches!(value, "" | "0" | "false"))
}

#[cfg(test)]
mod tests {
    use super::{Report, chosen, is_strict, verdict};
    use crate::groups::{GROUPS, Outcome};

    fn reports(outcomes: Vec<Outcome>) -> Vec<Report> {
        outcomes.into_iter().map(|outcome| Report { group: &GROUPS[0], outcome, seconds: 0.0, budget: 1 }).collect()
    }

    #[test]
    fn the_last_line_counts() {
        let reports = reports(vec![Outcome::Passed, Outcome::Failed("a".into()), Outcome::Skipped("b".into())]);
        assert_eq!(verdict(&reports, false), ("1 passed, 1 failed, 1 skipped".into(), false));
    }

    #[test]
    fn skipped_fails_where_everything_must_be_shown() {
        let reports = reports(vec![Outcome::Passed, Outcome::Skipped("b".into())]);
        assert!(verdict(&reports, false).1);
        assert!(!verdict(&reports, true).1);
        assert!(is_strict(Some("true")) && is_strict(Some("1")));
        assert!(!is_strict(None) && !is_strict(Some("false")) && !is_strict(Some("")));
    }

    #[test]
    fn groups_are_chosen_by_name() {
        assert_eq!(chosen(&["layers".into()], false).unwrap().len(), 1);
        assert!(chosen(&["nothing".into()], false).is_err());
        assert!(chosen(&[], true).unwrap().iter().all(|group| group.quick.is_some()));
    }
}
