//! `cara support-bundle`: what somebody elsewhere needs to find a fault, in one file, without a key or a token.

mod archive;
mod secrets;

use std::fs::{self, OpenOptions};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use blake2::{Blake2s256, Digest};
use cara_std::control::protocol::{Answer, Question};
use cara_std::control::state_folder;
use serde_json::{Map, Value, json};

use crate::operator::{Need, Operator};
use archive::Archive;
use cara_tools::exit::{Ended, Exit};
use cara_tools::files;
use cara_tools::global::Global;
use cara_tools::output;
use cara_tools::units::parse_time;
use secrets::Secrets;

/// Longest configuration, as `cara node` reads it.
const LONGEST_FILE: u64 = 1024 * 1024;
/// What is taken of the end of a log.
const LOG_BYTES: usize = 256 * 1024;
/// Black boxes, and their bytes together.
const BOXES: usize = 8;
const BOX_BYTES: u64 = 64 << 20;
/// What a line of the audit log may say.
const AUDITED: [&str; 14] = [
    "at_ms",
    "origin",
    "uid",
    "pid",
    "program",
    "name",
    "role",
    "ask",
    "function",
    "take_over",
    "node",
    "to",
    "outcome",
    "trace",
];

/// Writes one archive (tar) for whoever is to help: releases, this host, the doctor's report, what the unit knows, its
/// configuration, the ends of logs, black boxes.
///
/// Keys and tokens are not in it: of files only known members are taken, and what holds a known secret all the same is left out.
/// Names, addresses, arguments of calls and log lines are in it.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The archive, which must not be there yet.
    file: PathBuf,
    /// The node's configuration.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// A log of the node, of which the end is taken.
    #[arg(long, value_name = "FILE")]
    log: Option<PathBuf>,
    /// The node's audit log; `audit.log` in the folder of state unless told.
    #[arg(long, value_name = "FILE")]
    audit: Option<PathBuf>,
    /// The node's folder of state; CARA_STATE or STATE_DIRECTORY unless told.
    #[arg(long, value_name = "FOLDER")]
    state: Option<PathBuf>,
    /// How long the doctor listens.
    #[arg(long, value_name = "TIME", default_value = "5s", value_parser = parse_time)]
    listen: Duration,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let Arguments { file, config, log, audit, state, listen } = arguments;
    let failed = |error: std::io::Error| Ended::failed("Failed", format!("{}: {error}", file.display()));
    let to = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&file).map_err(failed)?;
    let state = state.or_else(state_folder);
    let mut archive = Archive::new(to, Secrets::of_host(state.as_deref()));
    let mut missing = Map::new();
    let mut about = about();
    if let Some(config) = &config {
        match configuration(config) {
            Ok((text, hash)) => {
                about.insert("configuration_hash".into(), hash.into());
                archive.text("configuration.toml", &text).map_err(failed)?;
            }
            Err(why) => drop(missing.insert("configuration".into(), why.into())),
        }
    }
    match cara_doctor::examine(listen, global) {
        Ok(report) => archive.object("doctor.json", &report).map_err(failed)?,
        Err(error) => drop(missing.insert("doctor".into(), error.to_string().into())),
    }
    match known(global) {
        Ok(Some(known)) => known.iter().try_for_each(|(name, value)| archive.object(name, value)).map_err(failed)?,
        Ok(None) => drop(missing.insert("unit".into(), "no m_unit runs on this host".into())),
        Err(error) => drop(missing.insert("unit".into(), error.to_string().into())),
    }
    let audit = audit.or_else(|| state.as_ref().map(|state| state.join("audit.log")));
    for (name, path, take) in [("log.txt", log, end_of as fn(&Path) -> _), ("audit.jsonl", audit, audited)] {
        let Some(path) = path else { continue };
        match take(&path) {
            Ok(text) => archive.text(name, &text).map_err(failed)?,
            Err(why) => drop(missing.insert(name.into(), why.into())),
        }
    }
    if let Some(state) = &state {
        about.insert("recordings".into(), recordings(state).into());
        let boxes = black_boxes(state, &mut archive).map_err(|error| Ended::failed("Failed", error.to_string()))?;
        about.insert("black_boxes".into(), boxes);
    }
    about.insert("missing".into(), missing.into());
    archive.object("about.json", &about.into()).map_err(failed)?;
    let members = archive.end().map_err(failed)?;
    match global.json {
        true => output::object(&json!({ "bundle": file, "members": members }))?,
        false => output::line(format_args!(
            "{} has {}. Names, addresses, arguments of calls and log lines are in it",
            file.display(),
            members.join(", ")
        ))?,
    }
    Ok(Exit::Done.into())
}

/// This program and this host.
fn about() -> Map<String, Value> {
    let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let unix_ms = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis() as u64;
    let program = fs::read("/proc/self/exe").map(|bytes| hash(&bytes)).unwrap_or_default();
    let about = json!({
        "release": env!("CARGO_PKG_VERSION"), "program_hash": program, "unix_ms": unix_ms,
        "kernel": kernel.trim(), "machine": std::env::consts::ARCH,
    });
    if let Value::Object(about) = about { about } else { Map::new() }
}

fn hash(bytes: &[u8]) -> String {
    Blake2s256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The file without comments, and without arguments of programs, in which a token may be; and the hash of the whole.
fn configuration(path: &Path) -> Result<(String, String), String> {
    let (bytes, _) = files::read(path, LONGEST_FILE).map_err(|error| error.to_string())?;
    let text = std::str::from_utf8(&bytes).map_err(|error| error.to_string())?;
    // The text of the error shows the line.
    let mut table: toml::Table = toml::from_str(text).map_err(|_| "it is no TOML".to_owned())?;
    let functions = table.get_mut("functions").and_then(toml::Value::as_array_mut);
    for function in functions.into_iter().flatten().filter_map(toml::Value::as_table_mut) {
        for key in ["run", "at_lease_end"] {
            if let Some(words) = function.get_mut(key).and_then(toml::Value::as_array_mut) {
                words.iter_mut().skip(1).for_each(|word| *word = "…".into());
            }
        }
    }
    let text = toml::to_string(&table).map_err(|error| error.to_string())?;
    Ok((text, hash(&bytes)))
}

/// What a unit of this host knows, by the name of its member; `None` if there is no unit.
fn known(global: &Global) -> anyhow::Result<Option<Vec<(&'static str, Value)>>> {
    let Some(mut operator) = Operator::open_if_any(global, &Need::Nothing)? else { return Ok(None) };
    let mut unit = operator.unit()?;
    unit.keys.iter_mut().for_each(|keys| keys.file = None);
    let mut all = |question| {
        let answers = operator.answers(&question)?;
        Ok::<_, anyhow::Error>(
            answers.iter().filter(|answer| **answer != Answer::Done).map(|answer| json!(answer)).collect(),
        )
    };
    Ok(Some(vec![
        ("unit.json", json!(unit)),
        ("nodes.json", all(Question::Nodes { offering: None })?),
        ("orders.json", all(Question::Orders { node: None })?),
        ("counters.json", all(Question::Counters { node: None })?),
    ]))
}

/// The last whole lines of a file.
fn end_of(path: &Path) -> Result<String, String> {
    let bytes = fs::read(path).map_err(|error| error.to_string())?;
    let end = bytes.get(bytes.len().saturating_sub(LOG_BYTES)..).unwrap_or_default();
    let text = String::from_utf8_lossy(end).into_owned();
    let is_whole = bytes.len() <= LOG_BYTES;
    Ok(if is_whole { text } else { text.split_once('\n').map(|(_, rest)| rest.to_owned()).unwrap_or_default() })
}

/// The last lines of an audit log, with the members that it writes alone.
fn audited(path: &Path) -> Result<String, String> {
    let mut kept = String::new();
    for line in end_of(path)?.lines() {
        let Ok(mut line) = serde_json::from_str::<Map<String, Value>>(line) else { continue };
        line.retain(|key, _| AUDITED.contains(&key.as_str()));
        kept.push_str(&Value::from(line).to_string());
        kept.push('\n');
    }
    Ok(kept)
}

/// Names of recordings in the folder of state and in the current one.
fn recordings(state: &Path) -> Vec<String> {
    let entries = [state, Path::new(".")].into_iter().filter_map(|folder| fs::read_dir(folder).ok()).flatten();
    let names = entries.filter_map(|entry| Some(entry.ok()?.file_name().to_string_lossy().into_owned()));
    names.filter(|name| name.contains(".mcap")).collect()
}

/// Takes the newest, and says what each is.
fn black_boxes(state: &Path, archive: &mut Archive) -> anyhow::Result<Value> {
    let (mut taken, mut bytes) = (Vec::new(), 0);
    for (number, found) in super::black_box::all(state)?.into_iter().rev().take(BOXES).enumerate() {
        bytes += found.bytes;
        if bytes > BOX_BYTES {
            break;
        }
        let member = format!("black-box-{}.mcap", number + 1);
        if archive.bytes(&member, &fs::read(&found.file)?)? {
            taken.push(json!({ "member": member, "is": found }));
        }
    }
    Ok(taken.into())
}
