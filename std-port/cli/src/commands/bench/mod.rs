//! `cara bench`: the paper's experiments (section 3) on the user's own network and board.
//!
//! Response time: calls of a function that takes and returns a string, one after the other, for strings of several
//! lengths. Availability: asynchronous requests at a fixed period, in groups; the share that was executed. Nothing is
//! discarded.

mod availability;
mod response;
mod show;
mod subject;

use std::process::ExitCode;
use std::time::Duration;

use cara_std::control::Closer;
use clap::ArgAction;

use crate::attended::Attended;
use crate::nodes;
use crate::operator::{Need, Operator};
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::output;
use cara_tools::units::parse_time;

/// Measures response time and availability of a node, with strings through one of its functions.
///
/// The function takes one string; for response times it returns one as well. It is called for real, many times: choose one
/// that does nothing else. Every measured time is in the result, none is discarded.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The node: NAME, NAME/ID or #ID.
    node: String,
    /// The function; unless told, the first one that takes one string and returns one.
    #[arg(long, value_name = "FUNCTION")]
    function: Option<String>,
    /// Characters per string; those beyond the function's signature are left out.
    #[arg(long, value_name = "NUMBERS", value_delimiter = ',', default_value = "1,10,100,1000,5000,10000,20000")]
    sizes: Vec<usize>,
    /// Calls per size.
    #[arg(long, value_name = "NUMBER", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..))]
    count: u32,
    /// Between two calls; the paper waits 2s.
    #[arg(long, value_name = "TIME", default_value = "10ms", value_parser = parse_time)]
    pause: Duration,
    /// Between two asynchronous requests.
    #[arg(long, value_name = "TIMES", value_delimiter = ',', default_value = "5ms,10ms,20ms,50ms",
          value_parser = parse_time, action = ArgAction::Set, num_args = 1)]
    periods: Vec<Duration>,
    /// Groups of asynchronous requests per size and period; 0 leaves availability out. The paper has 10.
    #[arg(long, value_name = "NUMBER", default_value_t = 1)]
    groups: u32,
    /// Asynchronous requests per group.
    #[arg(long, value_name = "NUMBER", default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..))]
    group: u32,
    /// Go on without standard input and output, which a function with a lease otherwise needs: as a background job of a script.
    #[arg(long)]
    detached: bool,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let need = match arguments.function.as_deref() {
        Some(function) => Need::Function(&arguments.node, function),
        None => Need::Node(&arguments.node),
    };
    let mut operator = Operator::open(global, &need)?;
    let node = nodes::connected(&mut operator, &arguments.node)?.selector;
    let subject = subject::choose(&mut operator, &node, arguments.function.as_deref())?;
    if subject.is_leased && !arguments.detached {
        Attended::check("a bench of a function with a lease")?;
        let (closer, way) = (operator.closer()?, operator.way());
        Attended::watch(move || {
            closer.inspect(Closer::close);
            way.end();
            std::process::exit(Exit::Failed as i32);
        })?;
    }
    let (sizes, left_out): (Vec<_>, Vec<_>) = arguments.sizes.iter().partition(|size| **size <= subject.longest());
    let shown = !global.json;
    if shown {
        show::heading(&node, &subject, &left_out)?;
    }
    let response = response::measure(&mut operator, &subject, &sizes, &arguments, shown)?;
    let availability = availability::measure(&mut operator, &subject, &sizes, &arguments, shown)?;
    let failed = response.iter().any(|row| row.times.failed > 0) || availability.iter().any(|row| !row.is_whole());
    if global.json {
        output::object(&serde_json::json!({
            "node": node, "function": subject.signature, "response": response, "availability": availability,
            "left_out": left_out,
        }))?;
    }
    Ok(if failed { Exit::Failed } else { Exit::Done }.into())
}
