//! `cara ping`: round trips of the protocol's own ping, with no function involved.

use std::process::ExitCode;
use std::time::Duration;

use cara_std::Shown;
use cara_std::control::protocol::{Answer, Question};
use serde_json::json;

use crate::nodes;
use crate::operator::{Need, Operator};
use crate::statistics::Times;
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::interrupt::Interrupt;
use cara_tools::output::{self, BAD};
use cara_tools::units::{parse_time, show_micros};

/// Measures round trips to a node, with no function of it involved. Ctrl-C ends it with its summary.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The node: NAME, NAME/ID or #ID.
    node: String,
    /// How many.
    #[arg(long, short, value_name = "NUMBER", default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    count: u32,
    /// Between two of them.
    #[arg(long, short, value_name = "TIME", default_value = "1s", value_parser = parse_time)]
    interval: Duration,
    /// How long to wait for each.
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = parse_time)]
    timeout: Duration,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let mut operator = Operator::open(global, &Need::Node(&arguments.node))?;
    let node = nodes::connected(&mut operator, &arguments.node)?.selector;
    let interrupt = Interrupt::catch()?;
    let mut samples = Vec::new();
    for number in 1..=arguments.count {
        samples.extend(round_trip(&mut operator, &node, number, arguments.timeout, global)?);
        if number < arguments.count {
            interrupt.pause(arguments.interval);
        }
        if interrupt.came() {
            break;
        }
    }
    let times = Times::of(samples);
    if global.json {
        output::object(&json!({ "node": node, "times": times }))?;
    } else {
        let [median, p99, max] = times.shown();
        let answered = times.tried - times.failed;
        output::line(format_args!("{answered} of {} answered: median {median}, p99 {p99}, max {max}", times.tried))?;
    }
    Ok(if times.failed == 0 { Exit::Done } else { Exit::Failed }.into())
}

/// One of them, shown to people; without a time if it failed.
fn round_trip(
    operator: &mut Operator,
    node: &str,
    number: u32,
    timeout: Duration,
    global: &Global,
) -> anyhow::Result<Option<Option<f64>>> {
    let question =
        Question::Ping { node: node.to_owned(), count: 1, pause_us: 0, timeout_ms: timeout.as_millis() as u64 };
    let mut sample = None;
    operator.ask(&question, |answer| {
        let Answer::Sample { us, error } = answer else { return Ok(()) };
        sample = Some(us);
        if global.json {
            return Ok(());
        }
        match (us, error) {
            (Some(us), _) => output::line(format_args!("{node} {number}: {}", show_micros(us)))?,
            (None, Some(failure)) if failure.error == "TimedOut" => {
                output::line(format_args!("{BAD}{node} {number}:{BAD:#} no answer within --timeout"))?
            }
            (None, Some(failure)) => {
                output::line(format_args!("{BAD}{node} {number}:{BAD:#} {}", Shown(&failure.text)))?
            }
            (None, None) => output::line(format_args!("{BAD}{node} {number}:{BAD:#} no answer"))?,
        }
        Ok(())
    })?;
    Ok(sample)
}
