//! `cara stream`: values of a node's stream as they come, or the last ones of all its streams.

use std::process::ExitCode;
use std::time::Duration;

use cara_std::Shown;
use cara_std::control::protocol::{Answer, Argument, Failure, Question};
use serde_json::json;

use crate::nodes;
use crate::operator::{Need, Operator};
use crate::text::show_call;
use cara_recording::values;
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::output::{self, BAD, FAINT};
use cara_tools::units::{parse_time, show_micros, show_time};

/// Shows the values of a stream as they come, each with its age and the time (UTC); without a name, the last value of each
/// stream of the node. Ctrl-C ends it. Of several that watch one stream through one unit the node sees one.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The node: NAME, NAME/ID or #ID.
    node: String,
    /// The stream; all of them, once, if absent.
    name: Option<String>,
    /// At most so many values a second; as many as the node grants if absent.
    #[arg(long, value_name = "NUMBER", value_parser = rate, requires = "name")]
    rate: Option<f64>,
    /// End after this time.
    #[arg(long = "for", value_name = "TIME", value_parser = parse_time, requires = "name")]
    span: Option<Duration>,
    /// End after so many values.
    #[arg(long, value_name = "NUMBER", value_parser = clap::value_parser!(u64).range(1..), requires = "name")]
    count: Option<u64>,
}

pub(super) fn rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().ok().filter(|rate: &f64| rate.is_finite() && *rate > 0.0);
    rate.ok_or_else(|| "a number of values a second, above 0".to_owned())
}

pub(crate) fn run(Arguments { node, name, rate, span, count }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let mut operator = Operator::open(global, &Need::Node(&node))?;
    let node = nodes::connected(&mut operator, &node)?.selector;
    if let Some(name) = &name {
        let published = nodes::functions(&mut operator, &node)?;
        if !published.iter().any(|function| function.name == *name && nodes::is_stream(function)) {
            return Err(nodes::no_such_stream(&node, name, &published));
        }
    }
    let interval_ms = rate.map_or(0, |rate| (1000.0 / rate).ceil() as u64);
    let question = Question::Stream { node: node.clone(), name: name.clone(), interval_ms };
    let (mut left, mut any) = (count.unwrap_or(u64::MAX), false);
    operator.watch(&question, span, |answer| {
        let Answer::Value { node, stream, unix_ms, age_us, values: found, error } = answer else { return Ok(true) };
        any = true;
        match global.json {
            true => output::object(&json!({
                "node": node, "stream": stream, "unix_ms": unix_ms, "age_us": age_us, "values": values(&found), "error": error,
            }))?,
            false => show(&stream, unix_ms, age_us, &found, error.as_ref())?,
        }
        left -= 1;
        Ok(left > 0)
    })?;
    if !any && name.is_none() && !global.json {
        output::line(format_args!("{node} has published no streams to this unit"))?;
    }
    Ok(Exit::Done.into())
}

fn show(
    stream: &str,
    unix_ms: u64,
    age_us: Option<u64>,
    values: &[Argument],
    error: Option<&Failure>,
) -> std::io::Result<()> {
    let name = stream.split('(').next().unwrap_or(stream);
    match (age_us, error) {
        (_, Some(Failure { error, text, .. })) => {
            output::line(format_args!("{BAD}{name}: {error}:{BAD:#} {}", Shown(text)))
        }
        (Some(age), None) => {
            let (age, time) = (show_micros(age as f64), show_time(unix_ms));
            output::line(format_args!("{FAINT}{time}{FAINT:#}  {}  {FAINT}{age} old{FAINT:#}", show_call(name, values)))
        }
        (None, None) => output::line(format_args!("{stream}  {FAINT}no value yet{FAINT:#}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_a_number_above_zero() {
        assert_eq!(rate("0.5"), Ok(0.5));
        assert!(["0", "-1", "inf", "fast"].iter().all(|text| rate(text).is_err()));
    }
}
