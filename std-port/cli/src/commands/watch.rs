//! `cara watch`: events as they come.

use std::process::ExitCode;
use std::time::Duration;

use cara_std::Shown;
use cara_std::control::protocol::{Answer, Question};
use serde_json::json;

use crate::operator::{Need, Operator};
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::output::{self, BAD, FAINT, GOOD, PLAIN};
use cara_tools::units::{parse_time, show_time};

/// Shows what happens, as it happens: joined, left, refused, failed requests, leases that end, each with its time (UTC). Ctrl-C
/// ends it.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// End after this time.
    #[arg(long = "for", value_name = "TIME", value_parser = parse_time)]
    span: Option<Duration>,
    /// End after so many events.
    #[arg(long, value_name = "NUMBER", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
}

pub(crate) fn run(Arguments { span, count }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let mut operator = Operator::open(global, &Need::Nothing)?;
    let mut left = count.unwrap_or(u64::MAX);
    operator.watch(&Question::Watch, span, |answer| {
        left -= u64::from(!matches!(&answer, Answer::Event { event, .. } if event == "watching"));
        print(answer, global)?;
        Ok(left > 0)
    })?;
    Ok(Exit::Done.into())
}

/// An event, in the form that is asked for.
pub(super) fn print(event: Answer, global: &Global) -> std::io::Result<()> {
    let Answer::Event { at_ms, unix_ms, event, node, text } = event else { return Ok(()) };
    match global.json {
        true => {
            output::object(&json!({ "at_ms": at_ms, "unix_ms": unix_ms, "event": event, "node": node, "text": text }))
        }
        false => show(unix_ms, &event, node.as_deref(), &text),
    }
}

fn show(unix_ms: u64, event: &str, node: Option<&str>, text: &str) -> std::io::Result<()> {
    let style = match event {
        "joined" => GOOD,
        "left" | "not_joined" | "request_failed" | "lease_expired" => BAD,
        _ => PLAIN,
    };
    let (time, node) = (show_time(unix_ms), node.unwrap_or("-"));
    output::line(format_args!("{FAINT}{time}{FAINT:#}  {style}{event:<17}{style:#} {node:<20} {}", Shown(text)))
}
