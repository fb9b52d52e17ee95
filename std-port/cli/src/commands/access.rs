//! `cara access check`: what an access table says, before a unit takes it over.

use std::path::PathBuf;
use std::process::ExitCode;

use cara_std::Identity;
use cara_std::access::{AccessTable, Decision, Principal, Verb, shown};
use cara_std::keys::parse_node;
use serde_json::json;

use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output;

/// The word for the operator on a unit's control socket.
const OPERATOR: &str = "operator";

/// Access tables: which node may see, call and publish which function.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    verb: What,
}

#[derive(clap::Subcommand)]
enum What {
    Check(Check),
}

/// Checks a table and shows it as a unit understands it; or tells what it says of one question, with the rule that decides.
///
/// The exit code is 0 if the table is correct, and what is asked for allowed; 1 if it is not allowed; 2 for mistakes in the
/// file, each with its line and column.
#[derive(clap::Args)]
#[command(group = clap::ArgGroup::new("question").args(["call", "take_over", "list", "publish"]))]
struct Check {
    /// The table, in TOML.
    file: PathBuf,
    /// The node that asks: NAME/ID, with @m_unit or @s_unit where the table tells the two apart, or `operator`.
    #[arg(long, value_name = "NODE", requires = "question")]
    who: Option<String>,
    /// May it call this function?
    #[arg(long, value_name = "FUNCTION", requires = "who")]
    call: Option<String>,
    /// May it take over what another caller moves with this function?
    #[arg(long, value_name = "FUNCTION", requires = "who")]
    take_over: Option<String>,
    /// May it see this function?
    #[arg(long, value_name = "FUNCTION", requires = "who")]
    list: Option<String>,
    /// May it publish this function to the unit?
    #[arg(long, value_name = "FUNCTION", requires = "who")]
    publish: Option<String>,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let What::Check(check) = arguments.verb;
    let table = AccessTable::read(&check.file).map_err(|error| Ended::usage(error.to_string()))?;
    match (&check.who, check.question()) {
        (Some(who), Some((function, verb))) => answer(&table, who, function, verb, global),
        _ => show(&table, global),
    }
}

impl Check {
    fn question(&self) -> Option<(&str, Verb)> {
        let asked = [
            (&self.call, Verb::Call),
            (&self.take_over, Verb::TakeOver),
            (&self.list, Verb::List),
            (&self.publish, Verb::Publish),
        ];
        asked.into_iter().find_map(|(function, verb)| Some((function.as_deref()?, verb)))
    }
}

fn show(table: &AccessTable, global: &Global) -> anyhow::Result<ExitCode> {
    if global.json {
        let rule = |(index, rule)| json!({ "line": table.line(index), "rule": shown(rule).to_string() });
        let rules: Vec<_> = table.rules().iter().enumerate().map(rule).collect();
        output::object(&json!({ "correct": true, "rules": rules }))?;
        return Ok(Exit::Done.into());
    }
    for (index, rule) in table.rules().iter().enumerate() {
        output::line(format_args!("{}:{}: {}", table.source(), table.line(index).unwrap_or(0), shown(rule)))?;
    }
    let rules = table.rules().len();
    output::line(format_args!("{}: correct: rules: {rules}; nothing else is allowed", table.source()))?;
    Ok(Exit::Done.into())
}

/// What the table says, where it says the same of both roles that a name without one can have.
fn answer(table: &AccessTable, who: &str, function: &str, verb: Verb, global: &Global) -> anyhow::Result<ExitCode> {
    let decisions = principals(who)?.map(|known| match known {
        None => table.decide(Principal::Operator, function, verb),
        Some(identity) => decide(table, &identity, function, verb),
    });
    if decisions[0] != decisions[1] {
        let text =
            format!("the answer differs between an m_unit {who} and an s_unit: write {who}@m_unit or {who}@s_unit");
        return Err(Ended::usage(text));
    }
    report(table, who, function, verb, decisions[0], global)
}

/// Permission to call includes permission to see.
fn decide(table: &AccessTable, identity: &Identity, function: &str, verb: Verb) -> Decision {
    let who = Principal::Node(identity);
    match table.decide(who, function, verb) {
        Decision::Denied if verb == Verb::List => table.decide(who, function, Verb::Call),
        decision => decision,
    }
}

fn principals(who: &str) -> anyhow::Result<[Option<Identity>; 2]> {
    if who == OPERATOR {
        return Ok([None, None]);
    }
    let known = parse_node(who).map_err(|error| Ended::usage(format!("--who {who}: {error}; or write operator")))?;
    let role_is_reported = ["@m_unit", "@s_unit"].iter().any(|role| who.ends_with(role));
    let other = if role_is_reported { known.clone() } else { Identity::m_unit(known.name(), known.id())? };
    Ok([Some(known), Some(other)])
}

fn report(
    table: &AccessTable,
    who: &str,
    function: &str,
    verb: Verb,
    decision: Decision,
    global: &Global,
) -> anyhow::Result<ExitCode> {
    let word = match verb {
        Verb::Call => "call",
        Verb::List => "see",
        Verb::Publish => "publish",
        Verb::TakeOver => "take over what another caller moves with",
    };
    let (rule, exit) = match decision {
        Decision::Denied => (None, Exit::Failed),
        Decision::Allowed { rule, .. } => (Some(rule), Exit::Done),
    };
    let line = rule.and_then(|rule| table.line(rule));
    let words = rule.and_then(|rule| table.rules().get(rule)).map(|rule| shown(rule).to_string());
    if global.json {
        output::object(&json!({ "allowed": rule.is_some(), "line": line, "rule": words }))?;
    } else if let (Some(line), Some(words)) = (line, words) {
        output::line(format_args!("allowed: {who} may {word} {function}: {}:{line}: {words}", table.source()))?;
    } else {
        output::line(format_args!("not allowed: no rule of {} lets {who} {word} {function}", table.source()))?;
    }
    Ok(exit.into())
}
