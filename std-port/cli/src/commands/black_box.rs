//! `cara black-box`: what the nodes of this host have written about incidents.

use std::collections::BTreeSet;
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use cara_std::control::state_folder;
use serde::Serialize;
use serde_json::json;

use crate::node::black_box::FOLDER;
use cara_recording::Reading;
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output::{self, PLAIN, Rows};
use cara_tools::units::{show_bytes, show_time};

/// Lists the black boxes of this host's nodes: recordings of the 10 minutes before a stop, a reset, an ended lease or an error.
///
/// `cara replay FILE` shows one.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The node: NAME or NAME/ID; all if absent.
    node: Option<String>,
    /// The folder of state of the nodes; CARA_STATE or STATE_DIRECTORY unless told.
    #[arg(long, value_name = "FOLDER")]
    state: Option<PathBuf>,
}

/// A black box.
#[derive(Debug, Serialize)]
pub(crate) struct Found {
    /// When it was written, in milliseconds since 1970.
    unix_ms: u64,
    node: String,
    cause: String,
    pub(crate) bytes: u64,
    pub(crate) file: PathBuf,
}

pub(crate) fn run(Arguments { node, state }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let state = state.or_else(state_folder);
    let state = state.ok_or_else(|| Ended::usage("say which folder of state the nodes have: --state FOLDER"))?;
    let All { mut found, .. } = all(&state)?;
    if let Some(node) = &node {
        let nodes: BTreeSet<_> = found.iter().map(|found| found.node.clone()).collect();
        found.retain(|found| found.node == *node || found.node.rsplit_once('/').is_some_and(|(name, _)| name == node));
        if found.is_empty() && !nodes.is_empty() {
            let nodes = Vec::from_iter(nodes).join(", ");
            let text = format!("{} has no black box of {node}, but of {nodes}", state.display());
            return Err(Ended::failed("NoBlackBox", text));
        }
    }
    if global.json {
        output::object(&json!({ "black_boxes": found }))?;
    } else if found.is_empty() {
        output::line(format_args!("{} has no black box", state.display()))?;
    } else {
        let mut rows = Rows::new(["WRITTEN", "NODE", "CAUSE", "SIZE", "FILE"]);
        for Found { unix_ms, node, cause, bytes, file } in found {
            rows.add(PLAIN, [show_time(unix_ms), node, cause, show_bytes(bytes), file.display().to_string()]);
        }
        rows.print()?;
    }
    Ok(Exit::Done.into())
}

/// The black boxes in a folder of state.
#[derive(Default)]
pub(crate) struct All {
    /// The oldest first.
    pub(crate) found: Vec<Found>,
    /// Files that cannot be read as such, and why.
    pub(crate) unread: Vec<(PathBuf, String)>,
}

/// Those in a folder of state.
pub(crate) fn all(state: &Path) -> anyhow::Result<All> {
    let folder = state.join(FOLDER);
    let failed = |error: std::io::Error| Ended::failed("Failed", format!("{}: {error}", folder.display()));
    let mut all = All::default();
    let entries = match fs::read_dir(&folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == ErrorKind::NotFound && state.is_dir() => return Ok(all),
        Err(error) => return Err(failed(error)),
    };
    for entry in entries {
        let file = entry.map_err(failed)?.path();
        if file.extension().is_none_or(|own| own != "mcap") {
            continue;
        }
        match of(&file) {
            Ok(found) => all.found.push(found),
            Err(why) => all.unread.push((file, why)),
        }
    }
    all.found.sort_by_key(|found| found.unix_ms);
    Ok(all)
}

fn of(file: &Path) -> Result<Found, String> {
    let told = |error: std::io::Error| error.to_string();
    let is = fs::metadata(file).map_err(told)?;
    if !is.is_file() {
        return Err("it is no file".into());
    }
    let mut reading = Reading::open(file).map_err(told)?;
    // What it says of itself comes before its messages.
    let _ = reading.next();
    let about = |key: &str| reading.about().get(key).cloned();
    let found = || {
        let (node, cause, unix_ms) = (about("unit")?, about("cause")?, about("unix_ms")?.parse().ok()?);
        Some(Found { unix_ms, node, cause, bytes: is.len(), file: file.to_owned() })
    };
    found().ok_or_else(|| "it does not say what it is, as a black box does".into())
}
