//! `cara node`: a unit that stays up, with a configuration file instead of code.

pub(crate) mod black_box;
mod events;
mod file;
mod functions;
mod http;
mod json;
mod limits;
mod logging;
mod mistake;
mod offer;
mod places;
mod program;
mod running;
mod service;
mod settings;
pub(crate) mod shown;
mod unit;
mod values;

use std::fmt::Display;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use cara_std::keys::KeyRing;
use cara_std::{Fleet, Identity, Interfaces};
use serde_json::json;

use black_box::BlackBox;
use cara_tools::exit::{Ended, Exit};
use cara_tools::files;
use cara_tools::global::Global;
use cara_tools::keys::Keys;
use cara_tools::name_and_id::NameAndId;
use cara_tools::output;
use mistake::{Mistakes, Source};
use settings::{Overrides, Settings};

/// What `--example` prints.
const EXAMPLE: &str = include_str!("example.toml");
/// Longest configuration in bytes.
const LONGEST_FILE: u64 = 1024 * 1024;

/// Stays up as an m_unit, or as an s_unit, until SIGINT or SIGTERM.
///
/// FILE has its identity, its limits and the functions it offers; options override the file. SIGHUP takes over the
/// tables `constraints` and `log` of a file that has changed.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The configuration, in TOML; without one, --name and --id suffice.
    file: Option<PathBuf>,
    /// Only check the file: 0 if it is correct, 2 with each mistake's line and column if not.
    #[arg(long, requires = "file")]
    check: bool,
    /// Print a configuration with every key, explained.
    #[arg(long, conflicts_with_all = ["file", "check"])]
    example: bool,
    /// The node's name.
    #[arg(long)]
    name: Option<String>,
    /// The node's ID number.
    #[arg(long)]
    id: Option<u32>,
    /// An m_unit that an m_unit connects to, instead of all; as often as there are such.
    #[arg(long = "m-unit", value_name = "NAME/ID")]
    m_units: Vec<NameAndId>,
    /// The TCP port for connections of others; a free one unless told.
    #[arg(long, value_name = "PORT")]
    tcp_port: Option<u16>,
    /// Start although a live m_unit has this one's name and ID: it steps down, and its vehicles come to this one.
    #[arg(long)]
    take_over: bool,
    /// The same also where another one has taken over within the last minute.
    #[arg(long)]
    force_take_over: bool,
    /// Start as a standby: command once no manager of this name and ID is there any more, and wait again where one is.
    #[arg(long, conflicts_with_all = ["take_over", "force_take_over"])]
    standby: bool,
    /// The folder in which the node stores its claims; CARA_STATE or STATE_DIRECTORY unless told.
    #[arg(long, value_name = "DIR")]
    state: Option<PathBuf>,
    /// Serve http://ADDR/metrics for Prometheus, as 127.0.0.1:9464.
    #[arg(long, value_name = "ADDR", value_parser = address)]
    metrics: Option<SocketAddr>,
    /// Serve metrics at an address that other hosts reach too: plain HTTP, for everybody.
    #[arg(long)]
    metrics_anywhere: bool,
    /// Which node may see, call and publish which function: an access table, which may change while the node runs.
    #[arg(long, value_name = "TABLE")]
    access: Option<PathBuf>,
    /// What to log: error, warn, info, debug, trace, or as RUST_LOG.
    #[arg(long, value_name = "LEVEL")]
    log: Option<String>,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    if arguments.example {
        output::line(EXAMPLE.trim_end())?;
        return Ok(Exit::Done.into());
    }
    let over = overrides(&arguments, global)?;
    let settings = Settings::of(read(arguments.file.as_deref())?, &over).map_err(wrong)?;
    if over.takes_over && settings.manager.is_some() {
        return Err(Ended::usage("--take-over is for an m_unit: an s_unit takes nothing over"));
    }
    if over.stands_by && settings.manager.is_some() {
        return Err(Ended::usage("--standby is for an m_unit: an s_unit commands nobody"));
    }
    // Also without --check, so that a service manager sees the code of a mistake and does not try again.
    check_start(&settings)?;
    if arguments.check {
        report_correct(&settings, global)?;
        return Ok(Exit::Done.into());
    }
    let black_box = BlackBox::new(&settings);
    let logging = logging::Logging::start(over.log.as_deref(), &settings, &black_box)?;
    running::run(settings, &over, &logging, &black_box, global)?;
    Ok(Exit::Done.into())
}

/// Mistakes in a configuration are the user's to correct.
fn wrong(mistakes: Mistakes) -> anyhow::Error {
    Ended::usage(mistakes.to_string())
}

fn read(path: Option<&Path>) -> anyhow::Result<Source> {
    let Some(path) = path else { return Ok(Source::default()) };
    let shown = path.display();
    let wrong = |error: &dyn Display| {
        Ended::usage(format!("{shown} cannot be read: {error}; `cara node --example` prints a configuration"))
    };
    let (bytes, is_longer) = files::read(path, LONGEST_FILE).map_err(|error| wrong(&error))?;
    if is_longer {
        return Err(Ended::usage(format!("{shown} has more than {LONGEST_FILE} bytes: is it a configuration?")));
    }
    if matches!(bytes.as_slice(), [0xFF, 0xFE, ..] | [0xFE, 0xFF, ..]) {
        return Err(Ended::usage(format!("{shown} is UTF-16, as PowerShell writes it: save it as UTF-8")));
    }
    let text = String::from_utf8(bytes.to_vec()).map_err(|error| wrong(&error.utf8_error()))?;
    Ok(Source { name: shown.to_string(), text })
}

fn overrides(arguments: &Arguments, global: &Global) -> anyhow::Result<Overrides> {
    if global.unit.is_some() || global.socket.is_some() {
        return Err(Ended::usage("a node is a unit itself: --unit and --socket are for commands that ask one"));
    }
    let named = global.act_as.clone();
    if let Some(named) = &named
        && (arguments.name.as_ref().is_some_and(|name| *name != named.name)
            || arguments.id.is_some_and(|id| id != named.id))
    {
        return Err(Ended::usage(format!(
            "--as {named} and --name or --id contradict each other: write one of the two"
        )));
    }
    let over = Overrides {
        name: arguments.name.clone().or(named.as_ref().map(|named| named.name.clone())),
        id: arguments.id.or(named.map(|named| named.id)),
        fleet: global.fleet,
        interfaces: global.loopback.then_some(Interfaces::Loopback),
        keys: global.keys(),
        discovery_port: global.discovery_port,
        m_units: arguments.m_units.clone(),
        tcp_port: arguments.tcp_port,
        takes_over: arguments.take_over || arguments.force_take_over,
        forces: arguments.force_take_over,
        stands_by: arguments.standby,
        state: arguments.state.clone(),
        metrics: arguments.metrics,
        metrics_anywhere: arguments.metrics_anywhere,
        access: arguments.access.clone(),
        log: arguments.log.clone(),
    };
    over.check().map_err(Ended::usage)?;
    if arguments.file.is_none() && (over.name.is_none() || over.id.is_none()) {
        return Err(Ended::usage(
            "the node has no identity: write --name and --id, or a FILE as `cara node --example` prints it",
        ));
    }
    Ok(over)
}

/// An address is not looked up by a name: the host could have several of it.
fn address(text: &str) -> Result<SocketAddr, String> {
    if text.strip_prefix(':').is_some_and(|port| port.parse::<u16>().is_ok()) {
        return Err(format!(
            "say at which address: 127.0.0.1{text} for this host alone, 0.0.0.0{text} for others as well"
        ));
    }
    text.parse().map_err(|_| "write an IP address and a port, as 127.0.0.1:9464; names are not looked up".to_owned())
}

/// What the file names and what is elsewhere, which shows only when the node starts. Keys that it does not name may come later.
fn check_start(settings: &Settings) -> anyhow::Result<()> {
    let Settings { name, id, .. } = settings;
    let wrong = |text: String| match settings.source.name.as_str() {
        "" => Ended::usage(text),
        file => Ended::usage(format!("{file}: {text}")),
    };
    let own = if settings.manager.is_some() { Identity::s_unit(name, *id) } else { Identity::m_unit(name, *id) };
    if let (Keys::File(path), Ok(own)) = (&settings.keys, own) {
        KeyRing::load_of(path, &own, Fleet(settings.fleet)).map_err(|error| wrong(format!("keys: {error}")))?;
    }
    let is_own = |m_unit: &NameAndId| m_unit.name == *name && m_unit.id == *id;
    match settings.m_units.iter().flatten().any(is_own) {
        true => Err(wrong(format!("m_units: {name}/{id} is this node itself: take it out"))),
        false => Ok(()),
    }
}

fn report_correct(settings: &Settings, global: &Global) -> anyhow::Result<()> {
    let role = if settings.manager.is_some() { "s_unit" } else { "m_unit" };
    let (name, id, functions) = (&settings.name, settings.id, settings.services.len());
    if global.json {
        output::object(&json!({ "correct": true, "name": name, "id": id, "role": role, "functions": functions }))?;
    } else {
        output::line(format_args!(
            "{}: correct: {role} {name}/{id}, functions of its own: {functions}",
            settings.source.name
        ))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
