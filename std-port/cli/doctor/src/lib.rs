//! `cara doctor`: diagnostics for a missing node, and for this host and its network.
//!
//! `look` gathers evidence: a survey of the network, trial connections, the units of this host through their control
//! sockets. `node`, `connected`, `network`, `secured` and `host` derive findings from it; they are pure functions.

mod causes;
mod connected;
mod dial;
mod evidence;
mod finding;
mod holder;
mod host;
mod left;
mod look;
mod network;
mod node;
mod report;
mod running;
mod secured;
mod unasked;
mod which;

use std::process::ExitCode;
use std::time::Duration;

use cara_std::survey::VERSIONS;

use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output;
use cara_tools::units::parse_time;

use self::finding::Severity;
use self::which::Which;

/// Finds out why a node is not there; or, without NAME, what is strange on this host and its network.
///
/// It asks the m_units of the network to show themselves, listens, tries to connect to those that do, and asks the
/// units that run on this host. It joins nothing and manages no node. Each finding is explained in
/// docs/troubleshooting.md. The exit code is 4 at an error or a warning.
#[derive(clap::Args)]
pub struct Arguments {
    /// NAME, NAME/ID or #ID of a node.
    #[arg(value_name = "NAME", value_parser = which::parse)]
    node: Option<Which>,
    /// How long to listen at most. A node that looks for its manager says something every 16 s at the latest.
    #[arg(long, value_name = "TIME", default_value = "17s", value_parser = parse_time)]
    listen: Duration,
}

/// What is strange on this host and its network, as the object of `--json`.
pub fn examine(listen: Duration, global: &Global) -> anyhow::Result<serde_json::Value> {
    look::look(None, listen, global).map(|looked| report::object(&looked))
}

/// Does what the command line asks, and prints it.
pub fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    if global.act_as.is_some() {
        return Err(Ended::usage("the doctor is no manager: leave out --as"));
    }
    let looked = look::look(arguments.node, arguments.listen, global)?;
    match global.json {
        true => output::object(&report::object(&looked))?,
        false => report::text(&looked)?,
    }
    let found = looked.findings.iter().any(|finding| finding.severity != Severity::Info);
    Ok(if found { Exit::Findings } else { Exit::Done }.into())
}
