//! The experiments for people, line by line as they are measured.

use std::io;

use cara_std::Shown;

use super::Arguments;
use super::subject::Subject;
use super::{availability, response};
use cara_tools::output::{HEADING, line};
use cara_tools::units::show_micros;

pub(crate) fn heading(node: &str, subject: &Subject, left_out: &[usize]) -> io::Result<()> {
    line(format_args!("{HEADING}{node}{HEADING:#}  {}", subject.signature))?;
    if left_out.is_empty() {
        return Ok(());
    }
    let sizes = left_out.iter().map(usize::to_string).collect::<Vec<_>>().join(", ");
    line(format_args!("left out, since the signature does not take them: {sizes} characters"))
}

pub(crate) fn response_heading(Arguments { count, pause, .. }: &Arguments) -> io::Result<()> {
    let pause = show_micros(pause.as_micros() as f64);
    line(format_args!("\n{HEADING}response time{HEADING:#}, {count} calls per size, {pause} apart"))?;
    line(format_args!(
        "{HEADING}{:>10}  {:>10}  {:>10}  {:>10}  {:>6}{HEADING:#}",
        "characters", "median", "p99", "max", "failed"
    ))
}

pub(crate) fn response(row: &response::Row) -> io::Result<()> {
    let [median, p99, max] = row.times.shown();
    let errors = row.errors.iter().map(|(name, count)| format!("  {count} {name}")).collect::<String>();
    let (characters, failed) = (row.characters, row.times.failed);
    line(format_args!("{characters:>10}  {median:>10}  {p99:>10}  {max:>10}  {failed:>6}{errors}"))
}

pub(crate) fn availability_heading(Arguments { groups, group, .. }: &Arguments) -> io::Result<()> {
    line(format_args!(
        "\n{HEADING}availability{HEADING:#}, groups of {group} asynchronous requests, {groups} for each line"
    ))?;
    line(format_args!(
        "{HEADING}{:>10}  {:>8}  {:>10}  {:>8}  {:>7}  {:>7}  {:>6}  {:>12}{HEADING:#}",
        "characters", "period", "real", "sent", "refused", "failed", "worst", "availability"
    ))
}

pub(crate) fn availability(row: &availability::Row) -> io::Result<()> {
    let sum = |of: fn(&availability::Group) -> usize| row.groups.iter().map(of).sum::<usize>();
    let (sent, refused, failed) = (sum(|group| group.sent), sum(|group| group.refused), sum(|group| group.failed));
    let real = row.groups.iter().map(|group| group.real_period_us).fold(0.0, f64::max);
    let (period, real) = (show_micros(row.period_us as f64), show_micros(real));
    let (characters, least, availability) = (row.characters, row.least, row.availability);
    line(format_args!(
        "{characters:>10}  {period:>8}  {real:>10}  {sent:>8}  {refused:>7}  {failed:>7}  {least:>6.3}  {availability:>12.4}"
    ))?;
    let error = row.groups.iter().find_map(|group| group.error.as_deref());
    error.map_or(Ok(()), |error| line(format_args!("{:>10}  {}", "", Shown(error))))
}
