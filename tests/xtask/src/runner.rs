//! Runs groups of checks, and reports what each showed and what it cost.
//!
//! Each group is a process of its own. Groups that fill the processors run one after the other. Groups that mostly wait (for an
//! emulator, for a time-out, for a linker with one thread) run three at a time behind them, and what one printed is printed at its
//! end. What failed runs once more, alone, after all others, and is flaky if it passes then. The last lines of what failed are
//! repeated behind the table: a log that was cut has them.

use std::collections::VecDeque;
use std::process::ExitCode;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use anyhow::{Result, bail};

use crate::again;
use crate::command::Run;
use crate::groups::{Extent, GROUPS, Group, Outcome};

/// A group that has run.
struct Report {
    group: &'static Group,
    outcome: Outcome,
    seconds: f64,
    /// Of the processors, by all processes that it waited for. None outside Linux.
    cpu: f64,
    budget: u64,
    /// What it printed, where that was seen.
    output: String,
    /// The tests that failed in its first run, if it passed in its second.
    flaky: Vec<String>,
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

/// Runs the groups named, or those of the default run; several times, or beside threads that keep processors busy, if asked for.
pub(crate) fn run(names: &[String], quick: bool, times: u16, busy: u16) -> Result<ExitCode> {
    let chosen = chosen(names, quick)?.repeat(times.into());
    (0..busy).for_each(|_| drop(std::thread::spawn(keep_busy)));
    let (start, before) = (Instant::now(), cpu_of_children());
    let (mut waiting, busy): (Vec<&Group>, Vec<&Group>) =
        chosen.into_iter().partition(|group| group.waits && names.is_empty());
    // The longest first: what is left for the end is short. `unit` is built already, and waits for no other group's build.
    waiting.sort_by_key(|group| std::cmp::Reverse(extent_of(group, quick).1));
    // One group is run here; of several, each is a process of its own.
    let alone = busy.len() == 1 && waiting.is_empty();
    let here = |group| if alone { run_group(group, quick) } else { run_apart(group, quick, true) };
    let mut reports: Vec<Report> = busy.into_iter().map(here).collect();
    reports.extend(run_side_by_side(waiting, quick));
    // Who runs a group several times asks how often it fails.
    if times == 1 {
        reports = reports.into_iter().map(|report| run_again(report, |group| run_apart(group, quick, true))).collect();
    }
    summarise(&reports);
    let (seconds, cpu) = (start.elapsed().as_secs_f64(), cpu_of_children() - before);
    println!("{:<14}{seconds:>10.1}{cpu:>10.1}", "all of it");
    let strict = is_strict(std::env::var("CI").ok().as_deref());
    let (line, success) = verdict(&reports, strict);
    if strict && !success && !reports.iter().any(|report| matches!(report.outcome, Outcome::Failed(_))) {
        println!("CI is set: what is skipped fails");
    }
    println!("{line}");
    Ok(if success { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn keep_busy() {
    loop {
        std::hint::spin_loop();
    }
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
    let (extent, budget) = extent_of(group, quick);
    let (start, before) = (Instant::now(), cpu_of_children());
    let outcome = (group.run)(extent);
    let (seconds, cpu) = (start.elapsed().as_secs_f64(), cpu_of_children() - before);
    let report = Report { group, outcome, seconds, cpu, budget, output: String::new(), flaky: Vec::new() };
    println!("{REPORT}{}", report.line());
    report.warn();
    report
}

fn extent_of(group: &Group, quick: bool) -> (Extent, u64) {
    match group.quick {
        Some(seconds) if quick => (Extent::Quick, seconds),
        _ => (Extent::Full, group.budget),
    }
}

/// Begins the line with which a group ends.
const REPORT: &str = "-- ";

/// How many groups that mostly wait run at a time.
pub(crate) const SIDE_BY_SIDE: usize = 3;

fn run_side_by_side(groups: Vec<&'static Group>, quick: bool) -> Vec<Report> {
    let names: Vec<&str> = groups.iter().map(|group| group.name).collect();
    if !names.is_empty() {
        println!("== {SIDE_BY_SIDE} at a time, each printed when it has ended: {}", names.join(", "));
    }
    let (queue, reports) = (Mutex::new(VecDeque::from(groups)), Mutex::new(Vec::new()));
    let work = || {
        loop {
            let next = queue.lock().unwrap_or_else(PoisonError::into_inner).pop_front();
            let Some(group) = next else { return };
            let report = run_apart(group, quick, false);
            reports.lock().unwrap_or_else(PoisonError::into_inner).push(report);
        }
    };
    std::thread::scope(|scope| (0..SIDE_BY_SIDE).for_each(|_| drop(scope.spawn(work))));
    reports.into_inner().unwrap_or_else(PoisonError::into_inner)
}

/// Of what a group printed that failed, so many lines are repeated at the end.
const TAIL: usize = 40;

/// Runs a group as a process of its own, and prints what it printed: each line `at_once`, or all at its end.
fn run_apart(group: &'static Group, quick: bool, at_once: bool) -> Report {
    let (_, budget) = extent_of(group, quick);
    let start = Instant::now();
    let output = apart(group.name, quick, at_once).unwrap_or_else(|error| format!("{error:#}\n"));
    if !at_once {
        println!("{output}");
    }
    Report {
        group,
        outcome: outcome_in(group.name, &output),
        seconds: start.elapsed().as_secs_f64(),
        cpu: cpu_in(group.name, &output),
        budget,
        output,
        flaky: Vec::new(),
    }
}

/// Runs a group that failed once more, unless what failed must not fail even once.
fn run_again(first: Report, run: impl FnOnce(&'static Group) -> Report) -> Report {
    // One that ran here has shown its failure to a person who waits for it.
    if first.output.is_empty() || !again::may_run(first.group, &first.outcome, &first.output) {
        return first;
    }
    let Outcome::Failed(reason) = &first.outcome else { return first };
    println!("== {} failed and runs once more: {reason}", first.group.name);
    let second = run(first.group);
    let (seconds, cpu) = (first.seconds + second.seconds, first.cpu + second.cpu);
    match second.outcome {
        Outcome::Passed => Report { flaky: again::failed_tests(&first.output, reason), seconds, cpu, ..second },
        _ => Report { seconds, cpu, ..first },
    }
}

/// What a group printed in a process of its own.
fn apart(name: &str, quick: bool, at_once: bool) -> Result<String> {
    let this = std::env::current_exe()?;
    let run = Run::new(&this.to_string_lossy()).args(["test", name]);
    let run = if quick { run.args(["--quick"]) } else { run };
    run.merged(|line| {
        if at_once {
            print!("{line}")
        }
    })
}

/// The line with which a group's own process reports it, or an empty one.
fn report_in<'a>(name: &str, output: &'a str) -> &'a str {
    let mut lines = output.lines().rev().filter_map(|line| line.strip_prefix(REPORT));
    lines.find(|line| line.split_whitespace().next() == Some(name)).unwrap_or_default()
}

/// The third word of a group's report.
fn cpu_in(name: &str, output: &str) -> f64 {
    report_in(name, output).split_whitespace().nth(2).and_then(|word| word.parse().ok()).unwrap_or_default()
}

/// Seconds that processes which this one started and waited for took of the processors; zero where no `/proc` tells it.
fn cpu_of_children() -> f64 {
    /// The kernel tells hundredths on every system, whatever it counts in.
    const PER_SECOND: f64 = 100.0;
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // The second word is the program's name in brackets, which may have blanks.
    let behind_name = stat.rsplit(')').next().unwrap_or_default();
    let ticks = behind_name.split_whitespace().skip(13).take(2).filter_map(|word| word.parse::<f64>().ok());
    ticks.sum::<f64>() / PER_SECOND
}

/// What the output of a group's own process says of it; nothing said is a failure.
fn outcome_in(name: &str, output: &str) -> Outcome {
    let ended = report_in(name, output);
    if ended.ends_with(PASSED) {
        return Outcome::Passed;
    }
    let reason = |mark: &str| ended.split_once(mark).map(|(_, why)| why.to_owned());
    match (reason(SKIPPED), reason(FAILED)) {
        (Some(why), None) => Outcome::Skipped(why),
        (_, Some(why)) => Outcome::Failed(why),
        (None, None) => Outcome::Failed("its process ended without a result".to_owned()),
    }
}

fn summarise(reports: &[Report]) {
    println!("\n{:<14}{:>10}{:>10}{:>10}  result", "group", "time s", "CPU s", "budget s");
    for report in reports {
        println!("{}", report.line());
    }
    let failed =
        reports.iter().filter(|report| matches!(report.outcome, Outcome::Failed(_)) && !report.output.is_empty());
    for Report { group, output, .. } in failed {
        let lines: Vec<&str> = output.lines().collect();
        let tail = &lines[lines.len().saturating_sub(TAIL)..];
        println!("\n== the last lines of {}:\n{}\n", group.name, tail.join("\n"));
    }
    reports.iter().flat_map(Report::flaky_lines).for_each(|line| println!("{line}"));
}

const PASSED: &str = "  passed";
const FAILED: &str = "  FAILED: ";
const SKIPPED: &str = "  skipped: ";

impl Report {
    fn warn(&self) {
        let Self { group, seconds, budget, .. } = self;
        if *seconds > *budget as f64 {
            println!("warning: {} took {seconds:.0} s, its budget is {budget} s", group.name);
        }
    }

    /// One for each test that failed before its group passed.
    fn flaky_lines(&self) -> impl Iterator<Item = String> {
        self.flaky.iter().map(|test| format!("FLAKY {}: {test}", self.group.name))
    }

    fn line(&self) -> String {
        let result = match &self.outcome {
            Outcome::Passed => PASSED.to_owned(),
            // A result is one line, also where a reason is several.
            Outcome::Failed(why) => format!("{FAILED}{}", why.replace('\n', " ")),
            Outcome::Skipped(why) => format!("{SKIPPED}{}", why.replace('\n', " ")),
        };
        let Self { group, seconds, cpu, budget, .. } = self;
        format!("{:<14}{seconds:>10.1}{cpu:>10.1}{budget:>10}{result}", group.name)
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
    use super::{REPORT, Report, chosen, cpu_in, is_strict, outcome_in, run_again, verdict};
    use crate::groups::{GROUPS, Outcome};

    fn report(name: &str, outcome: Outcome, output: &str) -> Report {
        let group = GROUPS.iter().find(|group| group.name == name).unwrap();
        let (output, flaky) = (output.to_owned(), Vec::new());
        Report { group, outcome, seconds: 1.0, cpu: 2.5, budget: 1, output, flaky }
    }

    fn reports(outcomes: Vec<Outcome>) -> Vec<Report> {
        outcomes.into_iter().map(|outcome| report(GROUPS[0].name, outcome, "")).collect()
    }

    fn failed() -> Outcome {
        Outcome::Failed("exit code 101".into())
    }

    const FAILING: &str = "test access::a_file ... FAILED\n";

    #[test]
    fn a_group_that_passes_when_run_again_is_flaky() {
        let again = run_again(report("unit", failed(), FAILING), |group| report(group.name, Outcome::Passed, "x"));
        assert_eq!(again.flaky_lines().collect::<Vec<_>>(), ["FLAKY unit: access::a_file"]);
        assert_eq!((again.seconds, again.cpu), (2.0, 5.0));
        assert_eq!(verdict(&[again], true), ("1 passed, 0 failed, 0 skipped".into(), true));
    }

    #[test]
    fn a_group_that_passes_neither_time_fails() {
        for second in [failed(), Outcome::Skipped("no root".into())] {
            let again = run_again(report("unit", failed(), FAILING), |group| report(group.name, second, ""));
            assert_eq!(again.flaky, [""; 0]);
            assert_eq!(verdict(&[again], false), ("0 passed, 1 failed, 0 skipped".into(), false));
        }
    }

    #[test]
    fn nothing_else_runs_again() {
        let never = |_| -> Report { unreachable!("it must not run again") };
        let of_the_core = format!("{FAILING}error: 1 target failed:\n    `-p cara-core --lib`\n");
        for first in [
            report("unit", Outcome::Passed, FAILING),
            report("unit", Outcome::Skipped("no root".into()), FAILING),
            report("unit", failed(), &of_the_core),
            report("firmware", failed(), FAILING),
            report("unit", failed(), ""),
        ] {
            let line = first.line();
            let again = run_again(first, never);
            assert_eq!((again.line(), again.flaky), (line, vec![]));
        }
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
    fn what_a_process_says_of_its_group_is_read_as_it_was_meant() {
        let name = GROUPS[0].name;
        let ends =
            reports(vec![Outcome::Passed, Outcome::Failed("a\nb: c".into()), Outcome::Skipped("no root".into())]);
        let read = ends.iter().map(|report| {
            let output = format!("x\n{REPORT}{}\ny", report.line());
            (outcome_in(name, &output), cpu_in(name, &output))
        });
        let said = [Outcome::Passed, Outcome::Failed("a b: c".into()), Outcome::Skipped("no root".into())];
        assert_eq!(read.collect::<Vec<_>>(), said.map(|outcome| (outcome, 2.5)));
        for nothing in ["", "-- other   1.0   2.5   1  passed"] {
            assert!(matches!(outcome_in(name, nothing), Outcome::Failed(_)), "{nothing}");
        }
    }

    #[test]
    fn groups_are_chosen_by_name() {
        assert_eq!(chosen(&["layers".into()], false).unwrap().len(), 1);
        assert!(chosen(&["nothing".into()], false).is_err());
        assert!(chosen(&[], true).unwrap().iter().all(|group| group.quick.is_some()));
    }
}
