//! `cara functions`: what a node has published to the unit that is asked.

use std::process::ExitCode;

use cara_std::control::protocol::FunctionInfo;
use serde_json::json;

use crate::nodes;
use crate::operator::{Need, Operator};
use crate::text;
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::output::{self, PLAIN, Rows};

/// Shows what a node has published, with the form in which it is called.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The node: NAME, NAME/ID or #ID.
    node: String,
    /// Print them as the trait of a typed program.
    #[arg(long)]
    rust: bool,
}

pub(crate) fn run(Arguments { node, rust }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let mut operator = Operator::open(global, &Need::Node(&node))?;
    let node = nodes::connected(&mut operator, &node)?.selector;
    let functions = nodes::functions(&mut operator, &node)?;
    if rust {
        let source = text::interface(&node, &functions).map_err(|why| anyhow::anyhow!("cannot read {why}"))?;
        match global.json {
            true => output::object(&json!({ "node": node, "rust": source }))?,
            false => output::line(source.trim_end())?,
        }
    } else if global.json {
        output::object(&json!({ "node": node, "functions": functions }))?;
    } else if functions.is_empty() {
        output::line(format_args!("{node} has published nothing to this unit"))?;
    } else {
        table(&functions).print()?;
    }
    Ok(Exit::Done.into())
}

/// A column of help where a function has any.
fn table(functions: &[FunctionInfo]) -> Rows {
    let helps: Vec<String> = functions.iter().map(help).collect();
    let has_help = helps.iter().any(|help| !help.is_empty());
    let mut rows =
        if has_help { Rows::new(["FUNCTION", "ATTRIBUTES", "HELP"]) } else { Rows::new(["FUNCTION", "ATTRIBUTES"]) };
    for (FunctionInfo { signature, attributes, .. }, help) in functions.iter().zip(helps) {
        let columns = [signature.clone(), attributes.to_string()];
        rows.add(PLAIN, columns.into_iter().chain(has_help.then_some(help)));
    }
    rows
}

/// What it does, and the units of its variables.
fn help(FunctionInfo { help, units, .. }: &FunctionInfo) -> String {
    let units = units.iter().map(|(variable, unit)| format!("{variable} in {unit}")).collect::<Vec<_>>().join(", ");
    [help.as_str(), &units].into_iter().filter(|said| !said.is_empty()).collect::<Vec<_>>().join(" ")
}
