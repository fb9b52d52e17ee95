//! `cara call`: a function of one node, or of all that offer it.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::Context;

use cara_std::control::Closer;
use cara_std::control::protocol::{Answer, Argument, CallQuestion, Failure, FunctionInfo, Question};
use cara_std::{Definition, Priority, Shown};
use serde_json::json;

use crate::attended::Attended;
use crate::nodes::{self, Chosen};
use crate::operator::{Need, Operator, exit_of};
use crate::text::{Mistake, Written, bind, read, show_call};
use cara_recording::values;
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::interrupt;
use cara_tools::name_and_id::quoted;
use cara_tools::output::{self, BAD};
use cara_tools::units::{parse_time, show_micros};

/// Calls a function and prints its results in the form of a call.
///
/// A call is written with its arguments by name, as 'go_to(position: [1, 2])', and checked against what the node has
/// published before anything is sent. Texts go in double quotes, bytes are written as 0x01ff, several numbers and lists in
/// brackets, records in braces: 'order(nodes: [{id: "a", x: 1.5}])'. Arguments may be a JSON object of their own as well:
/// order '{"nodes": [{"id": "a", "x": 1.5}]}', also from a file: order --arguments order.json.
#[derive(clap::Args)]
#[command(override_usage = "cara call [OPTIONS] <NODE> <CALL> [JSON]\n       cara call [OPTIONS] --all <CALL> [JSON]")]
pub(crate) struct Arguments {
    /// The node (NAME, NAME/ID or #ID), unless all are called; and the call, as 'go_to(position: [1, 2])', or the name
    /// alone where there are no arguments, or where they follow as a JSON object.
    #[arg(required = true, num_args = 1..=3, value_names = ["NODE", "CALL", "JSON"])]
    words: Vec<String>,
    /// The arguments as a JSON object from this file, or from standard input (-).
    #[arg(long, value_name = "FILE")]
    arguments: Option<PathBuf>,
    /// Call every node, with an outcome for each s_unit of the roster; it fails where one is missing.
    #[arg(long)]
    all: bool,
    /// Do not wait for results: return when the request is accepted.
    #[arg(long = "async")]
    asynchronous: bool,
    /// How long to wait for results, instead of the unit's constraint.
    #[arg(long, value_name = "TIME", value_parser = parse_time)]
    timeout: Option<Duration>,
    /// The class of the request, instead of the function's own.
    #[arg(long, value_parser = Priority::ALL.map(Priority::word))]
    priority: Option<String>,
    /// In one datagram, now or never.
    #[arg(long, requires = "asynchronous")]
    best_effort: bool,
    /// Take over what another unit or this unit's program moves, instead of the error that names it.
    #[arg(long)]
    take_over: bool,
    /// Keep the lease of what the call starts until it has finished, or until Ctrl-C, or until standard input or output ends or
    /// hangs up: then it stops.
    #[arg(long, conflicts_with_all = ["all", "asynchronous"])]
    hold: bool,
    /// With --hold: go on without standard input and output, as a background job of a script. Only the end of this command
    /// stops it then.
    #[arg(long, requires = "hold")]
    detached: bool,
}

impl Arguments {
    /// Options may stand between the two, so they are told apart here and not by their places.
    fn node_and_call(&self) -> anyhow::Result<(Option<&str>, String)> {
        match (self.all, self.words.as_slice()) {
            (true, [call]) => Ok((None, call.clone())),
            (false, [node, call]) => Ok((Some(node), call.clone())),
            (true, [call, json]) if json.trim_start().starts_with('{') => Ok((None, format!("{call} {json}"))),
            (false, [node, call, json]) if json.trim_start().starts_with('{') => {
                Ok((Some(node), format!("{call} {json}")))
            }
            (true, _) => Err(Ended::usage("with --all no node is named: cara call --all 'go_to(position: [1, 2])'")),
            (false, _) => Err(Ended::usage("name the node and the call: cara call agv-1 'go_to(position: [1, 2])'")),
        }
    }
}

/// As much as the control socket takes in one line.
const LONGEST_ARGUMENTS: u64 = 4 << 20;

/// The text of a file, or of standard input.
fn text_of(file: &Path) -> anyhow::Result<String> {
    let mut text = String::new();
    let source: Box<dyn Read> =
        if file == Path::new("-") { Box::new(std::io::stdin()) } else { Box::new(File::open(file)?) };
    source.take(LONGEST_ARGUMENTS + 1).read_to_string(&mut text)?;
    if text.len() as u64 > LONGEST_ARGUMENTS {
        anyhow::bail!("it is longer than {LONGEST_ARGUMENTS} bytes");
    }
    Ok(text)
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let (node, mut text) = arguments.node_and_call()?;
    let is_attended = arguments.hold && !arguments.detached;
    if is_attended {
        Attended::check("--hold")?;
    }
    if let Some(file) = &arguments.arguments {
        if text.contains(['(', '{']) {
            return Err(Ended::usage("with --arguments the call is the function's name alone"));
        }
        if is_attended && file == Path::new("-") {
            return Err(Ended::usage(
                "--hold watches standard input: put the arguments into a file, or add --detached",
            ));
        }
        let from_file = text_of(file).with_context(|| format!("the arguments cannot be read from {}", file.display()));
        text = format!("{text} {}", from_file.map_err(|error| Ended::usage(format!("{error:#}")))?.trim());
        if !text.ends_with('}') {
            return Err(Ended::usage(format!(
                "{} is no JSON object: it begins with {{ and ends with }}",
                file.display()
            )));
        }
    }
    let text = text.as_str();
    let written = read(text).map_err(|mistake| wrong(&mistake, text, None))?;
    let function = written.function.value;
    let need = node.map_or(Need::Offering(function), |node| Need::Function(node, function));
    let mut operator = Operator::open(global, &need)?;
    let node = match node {
        Some(node) => Some(nodes::connected(&mut operator, node)?.selector),
        None => None,
    };
    let published = match &node {
        Some(node) => of_node(&mut operator, node, function)?,
        None => match of_any(&mut operator, function)? {
            Some(published) => published,
            None => return Err(offered_by_none(&mut operator, function, global)?),
        },
    };
    let question = CallQuestion {
        node,
        function: function.to_owned(),
        arguments: bound(&written, &published)?,
        asynchronous: arguments.asynchronous,
        timeout_ms: arguments.timeout.map(|span| span.as_millis() as u64),
        priority: arguments.priority,
        best_effort: arguments.best_effort,
        take_over: arguments.take_over,
        progress: reports_progress(&published),
    };
    let question = CallQuestion { progress: question.progress && question.node.is_some(), ..question };
    // At the end of this command its unit gives up the call, and a manager whose client has gone does so as well.
    if arguments.hold || !arguments.asynchronous {
        interrupt::end_at_signals()?;
    }
    let lease = published.attributes.lease.filter(|_| !arguments.hold).map(|lease| lease.as_micros());
    if !is_attended {
        return Ok(call(&mut operator, question, arguments.hold, lease, global)?.into());
    }
    let (closer, way) = (operator.closer()?, operator.way());
    let attended = Attended::watch(move || {
        closer.inspect(Closer::close);
        way.end();
    })?;
    let outcome = call(&mut operator, question, true, lease, global);
    match attended.end().filter(|_| !matches!(outcome, Ok(Exit::Done))) {
        Some(end) => {
            let text = format!("{end}, and what this command held was released; with --detached it goes on without");
            Err(Ended::failed("Unattended", text))
        }
        None => Ok(outcome?.into()),
    }
}

fn call(
    operator: &mut Operator,
    question: CallQuestion,
    hold: bool,
    not_kept_us: Option<u64>,
    global: &Global,
) -> anyhow::Result<Exit> {
    let (function, asynchronous, one) = (question.function.clone(), question.asynchronous, question.node.is_some());
    let mut worst = Exit::Done;
    let question = if hold { Question::Hold(question) } else { Question::Call(question) };
    let mut has_ended = !hold;
    operator.ask(&question, |answer| {
        if let Answer::Ended { expired } = answer {
            has_ended = true;
            worst = if expired { Exit::Failed } else { worst };
            return Ok(show_end(expired, global)?);
        }
        if let Answer::Progress { node, id, values: reported } = answer {
            return Ok(show_progress(&format!("{node}/{id}"), &reported, global)?);
        }
        let Answer::Called { node, id, results, call, error, took_us, .. } = answer else { return Ok(()) };
        // The lease counts from when the call was made, and its end is on its way like any answer.
        let ended = not_kept_us.filter(|lease| took_us >= lease / 4 * 3);
        let error = error.map(|failure| of_its_lease(failure, &function, ended));
        let node = format!("{node}/{id}");
        if let Some(failure) = &error {
            has_ended = true;
            worst = if worst == Exit::Failed { worst } else { exit_of(failure) };
        }
        Ok(show_outcome(&node, &function, &results, call, error.as_ref(), (took_us, one), global)?)
    })?;
    if asynchronous {
        operator.deliver();
    }
    // A unit of this process that was stopped meanwhile says nothing.
    Ok(if has_ended { worst } else { Exit::Failed })
}

/// Why a service failed that went on for longer than a lease which nothing has kept.
pub(super) fn of_its_lease(failure: Failure, function: &str, ended_us: Option<u64>) -> Failure {
    let Some(lease) = ended_us.filter(|_| failure.error == "Service") else { return failure };
    let text = format!(
        "the lease of `{function}` ({}) ended before it had finished, which stops it: a call keeps it with --hold. It said: {}",
        show_micros(lease as f64),
        failure.text
    );
    Failure { text, ..failure }
}

/// What came of the call of one node, in the form that is asked for.
fn show_outcome(
    node: &str,
    function: &str,
    results: &[Argument],
    call: Option<u32>,
    error: Option<&Failure>,
    (took_us, one): (u64, bool),
    global: &Global,
) -> std::io::Result<()> {
    if !global.json {
        return show(node, function, results, call, error, took_us, one);
    }
    let text = (error.is_none() && call.is_none()).then(|| show_call(function, results));
    output::object(&json!({
        "node": node, "text": text, "results": values(results), "call": call, "error": error, "took_us": took_us,
    }))
}

/// What came of the call of one node; its name goes before where there are several.
fn show(
    node: &str,
    function: &str,
    results: &[Argument],
    call: Option<u32>,
    error: Option<&Failure>,
    took_us: u64,
    one: bool,
) -> std::io::Result<()> {
    let before = if one { String::new() } else { format!("{node}  ") };
    match (error, call) {
        (Some(Failure { error, text, said, .. }), _) => {
            let values = said.as_ref().map_or(&[][..], |said| &said.values);
            let values = if values.is_empty() { String::new() } else { format!(" {}", show_call("", values)) };
            output::line(format_args!("{BAD}{node}: {error}:{BAD:#} {}{values}", Shown(text)))
        }
        (None, Some(call)) => {
            output::line(format_args!("{before}accepted as call {call}; `cara watch` tells if it fails"))
        }
        (None, None) if one => output::line(show_call(function, results)),
        (None, None) => {
            let took = show_micros(took_us as f64);
            output::line(format_args!("{before}{}  {took}", show_call(function, results)))
        }
    }
}

/// What the call tells while it runs.
fn show_progress(node: &str, reported: &[Argument], global: &Global) -> std::io::Result<()> {
    match global.json {
        true => output::object(&json!({ "node": node, "progress": values(reported) })),
        false => output::line(show_call("…", reported)),
    }
}

/// Whether its calls tell how far they are.
fn reports_progress(function: &FunctionInfo) -> bool {
    Definition::parse(&function.signature).is_ok_and(|function| function.signature().progress().next().is_some())
}

/// How what the call started has ended.
fn show_end(expired: bool, global: &Global) -> std::io::Result<()> {
    match (global.json, expired) {
        (true, _) => output::object(&json!({ "finished": !expired })),
        (false, false) => output::line("finished"),
        (false, true) => output::line(format_args!("{BAD}it stopped there:{BAD:#} the node was lost, or stopped it")),
    }
}

/// The function as a node has published it.
pub(super) fn of_node(operator: &mut Operator, node: &str, function: &str) -> anyhow::Result<FunctionInfo> {
    let functions = nodes::functions(operator, node)?;
    match functions.iter().find(|info| info.name == function) {
        Some(stream) if nodes::is_stream(stream) => Err(Ended::usage(format!(
            "`{function}` of {node} is a stream, which is read and not called: `cara stream {} {function}`",
            quoted(nodes::without_role(node))
        ))),
        Some(found) => Ok(found.clone()),
        None => Err(nodes::no_such_function(node, function, &functions)),
    }
}

/// The function as the first of the nodes that offer it has published it.
fn of_any(operator: &mut Operator, function: &str) -> anyhow::Result<Option<FunctionInfo>> {
    let offering = nodes::all(operator, Some(function))?;
    let Some(node) = offering.iter().find(|node| node.connected) else { return Ok(None) };
    let all = nodes::all(operator, None)?;
    of_node(operator, &Chosen::among(&all, node).selector, function).map(Some)
}

/// Shows an outcome for each node of the roster, none of which was called; the error that tells what there is.
fn offered_by_none(operator: &mut Operator, function: &str, global: &Global) -> anyhow::Result<anyhow::Error> {
    let all = nodes::all(operator, None)?;
    for node in all.iter().filter(|node| node.expected) {
        let failure = Failure::not_called(node.connected.then_some(function));
        show_outcome(&nodes::full_name(node), function, &[], None, Some(&failure), (0, false), global)?;
    }
    let mut functions: Vec<FunctionInfo> = Vec::new();
    for node in all.iter().filter(|node| node.connected) {
        let more = nodes::functions(operator, &Chosen::among(&all, node).selector)?.into_iter();
        functions.extend(more);
    }
    functions.sort_by(|a, b| a.signature.cmp(&b.signature));
    functions.dedup_by(|a, b| a.signature == b.signature);
    let is_missing = all.iter().any(|node| node.expected && !node.connected);
    Ok(nodes::offered_nowhere(function, &functions, is_missing))
}

/// The arguments as the signature asks for them.
pub(super) fn bound(written: &Written, published: &FunctionInfo) -> anyhow::Result<Vec<Argument>> {
    let signature = &published.signature;
    let definition = Definition::parse(signature).map_err(|error| {
        Ended::failed("Malformed", format!("the published signature `{signature}` cannot be read: {error}"))
    })?;
    bind(written, &definition.signature()).map_err(|mistake| wrong(&mistake, written.text, Some(signature)))
}

pub(super) fn wrong(mistake: &Mistake, text: &str, signature: Option<&str>) -> anyhow::Error {
    Ended::usage(mistake.show(text, signature))
}
