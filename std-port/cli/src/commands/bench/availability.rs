//! Availability: which share of asynchronous requests, sent at a fixed period, was executed.
//!
//! A request that was not executed is either refused at once, or reported as failed later: by an event. A blocking call
//! behind the last request of a group returns after all of them, since calls of one peer and class stay in order; what has
//! not been reported as failed by then was executed.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use anyhow::Context;
use cara_std::control::protocol::{Answer, Question};
use serde::Serialize;

use super::subject::Subject;
use super::{Arguments, show};
use crate::nodes;
use crate::operator::Operator;
use cara_tools::exit::Ended;

/// How long events are waited for after the blocking call behind a group.
const STRAGGLERS: Duration = Duration::from_millis(100);
/// How often the blocking call behind a group is tried: a node that is overrun refuses it as well.
const BARRIERS: u32 = 20;

/// The groups of one string length and period.
#[derive(Serialize)]
pub(crate) struct Row {
    pub(crate) characters: usize,
    pub(crate) period_us: u64,
    pub(crate) groups: Vec<Group>,
    /// Executed requests over sent ones.
    pub(crate) availability: f64,
    /// That of the worst group.
    pub(crate) least: f64,
}

impl Row {
    /// Whether all requests were executed.
    pub(crate) fn is_whole(&self) -> bool {
        self.groups.iter().all(|group| group.executed == group.sent)
    }
}

/// A row of requests, one after each period.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Group {
    pub(crate) sent: usize,
    /// Not accepted by this side.
    pub(crate) refused: usize,
    /// Accepted, and reported as failed later.
    pub(crate) failed: usize,
    pub(crate) executed: usize,
    /// From the first request to the last, divided by their number less one.
    pub(crate) real_period_us: f64,
    /// Why the first of those that were refused was, or the call behind them.
    pub(crate) error: Option<String>,
}

pub(crate) fn measure(
    operator: &mut Operator,
    subject: &Subject,
    sizes: &[usize],
    arguments: &Arguments,
    shown: bool,
) -> anyhow::Result<Vec<Row>> {
    if arguments.groups == 0 {
        return Ok(Vec::new());
    }
    if shown {
        show::availability_heading(arguments)?;
    }
    let failures = count_failures(operator, &subject.node)?;
    let mut rows = Vec::new();
    for characters in sizes {
        for period in &arguments.periods {
            let groups = (0..arguments.groups).map(|_| {
                let group = Plan { subject, characters: *characters, period: *period, requests: arguments.group };
                group.run(operator, &failures)
            });
            let row = row(*characters, *period, groups.collect::<anyhow::Result<_>>()?);
            if shown {
                show::availability(&row)?;
            }
            rows.push(row);
        }
    }
    Ok(rows)
}

fn row(characters: usize, period: Duration, groups: Vec<Group>) -> Row {
    let share = |executed: usize, sent: usize| executed as f64 / sent.max(1) as f64;
    let sum = |of: fn(&Group) -> usize| groups.iter().map(of).sum();
    let least = groups.iter().map(|group| share(group.executed, group.sent)).fold(1.0, f64::min);
    let availability = share(sum(|group| group.executed), sum(|group| group.sent));
    Row { characters, period_us: period.as_micros() as u64, groups, availability, least }
}

/// Failed asynchronous requests of a node.
#[derive(Default)]
struct Failures {
    counted: AtomicUsize,
    /// Events came faster than they were read, so that some are not counted.
    lost: AtomicBool,
}

impl Failures {
    fn counted(&self) -> anyhow::Result<usize> {
        if self.lost.load(Ordering::SeqCst) {
            let text = "failures came faster than they could be counted: measure smaller groups (--group)";
            return Err(Ended::failed("EventsLost", text));
        }
        Ok(self.counted.load(Ordering::SeqCst))
    }
}

/// Counts failed asynchronous requests of a node from now on, in a thread that lasts as long as the command.
fn count_failures(operator: &Operator, node: &str) -> anyhow::Result<Arc<Failures>> {
    let failures = Arc::new(Failures::default());
    let (counted, node) = (failures.clone(), Some(nodes::without_role(node).to_owned()));
    let mut second = operator.another()?;
    let (ready, is_ready) = mpsc::channel();
    std::thread::Builder::new().name("failures".into()).spawn(move || {
        // It ends with the command, or with the unit, and then the requests fail too.
        let _ = second.ask(&Question::Watch, |answer| {
            let Answer::Event { event, node: of, .. } = answer else { return Ok(()) };
            match event.as_str() {
                "watching" => ready.send(())?,
                "request_failed" if of == node => _ = counted.counted.fetch_add(1, Ordering::SeqCst),
                "lost" => counted.lost.store(true, Ordering::SeqCst),
                _ => {}
            }
            Ok(())
        });
    })?;
    is_ready.recv().context("events cannot be watched")?;
    Ok(failures)
}

struct Plan<'s> {
    subject: &'s Subject,
    characters: usize,
    period: Duration,
    requests: u32,
}

impl Plan<'_> {
    fn run(&self, operator: &mut Operator, failures: &Failures) -> anyhow::Result<Group> {
        let before = failures.counted()?;
        let question = Question::Call(self.subject.call(self.characters, true));
        let start = Instant::now();
        let (mut refused, mut last, mut first) = (0, start, None);
        for number in 0..self.requests {
            let due = self.period.saturating_mul(number);
            std::thread::sleep(due.saturating_sub(start.elapsed()));
            last = Instant::now();
            let error = refusal(operator, &question)?;
            refused += usize::from(error.is_some());
            first = first.or(error);
        }
        let sent = self.requests as usize;
        let unfinished = self.barrier(operator)?;
        std::thread::sleep(STRAGGLERS);
        let failed = failures.counted()?.saturating_sub(before);
        let executed = if unfinished.is_none() { sent.saturating_sub(refused + failed) } else { 0 };
        let gaps = f64::from(self.requests.saturating_sub(1).max(1));
        let real_period_us = last.duration_since(start).as_secs_f64() * 1e6 / gaps;
        Ok(Group { sent, refused, failed, executed, real_period_us, error: first.or(unfinished) })
    }

    /// Why no blocking call came through behind the group, if none did.
    fn barrier(&self, operator: &mut Operator) -> anyhow::Result<Option<String>> {
        let mut error = None;
        let question = Question::Call(self.subject.call(self.characters.min(1), false));
        for _ in 0..BARRIERS {
            error = refusal(operator, &question)?;
            if error.is_none() {
                return Ok(None);
            }
            std::thread::sleep(STRAGGLERS);
        }
        Ok(error)
    }
}

/// Why a call was not accepted; `None` if it was.
fn refusal(operator: &mut Operator, question: &Question) -> anyhow::Result<Option<String>> {
    let mut refusal = Some("no answer".to_owned());
    operator.ask(question, |answer| {
        if let Answer::Called { error, .. } = answer {
            refusal = error.map(|failure| format!("{}: {}", failure.error, failure.text));
        }
        Ok(())
    })?;
    Ok(refusal)
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::{Group, row};

    #[test]
    fn availability_is_executed_over_sent() {
        let group = |executed| {
            let (failed, real_period_us) = (100 - executed, 5.0);
            Group { sent: 100, refused: 0, failed, executed, real_period_us, error: None }
        };
        let row = row(10, Duration::from_millis(5), vec![group(100), group(90)]);
        assert_eq!((row.availability, row.least, row.is_whole(), row.period_us), (0.95, 0.9, false, 5_000));
    }
}
