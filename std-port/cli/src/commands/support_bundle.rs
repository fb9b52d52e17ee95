//! `cara support-bundle`: what somebody elsewhere needs to find a fault, in one file, without a key or a token.

mod archive;
mod secrets;

use std::fs::{self, File, OpenOptions};
use std::io::{self, Read, Seek, SeekFrom};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use blake2::{Blake2s256, Digest};
use cara_std::control::protocol::{Answer, Question};
use cara_std::control::state_folder;
use serde_json::{Map, Value, json};

use super::black_box::All;
use crate::node::black_box::FOLDER;
use crate::node::shown::take_out;
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
const LOG_BYTES: u64 = 256 * 1024;
/// Where the service's recordings are (docs/node.md).
const OF_SERVICE: &str = "/var/log/cara";
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
/// configuration, the ends of logs, black boxes; and the names of recordings that are in the folder of state, in
/// /var/log/cara and in the current one.
///
/// Keys and tokens are not in it: of files only known members are taken, and what holds a known secret all the same is left out.
/// Names, addresses, arguments of calls and log lines are in it.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The archive, which must not be there yet.
    file: PathBuf,
    /// The node's configuration, of which the members that a node reads are taken, and of programs no arguments.
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
    let file = arguments.file.clone();
    let failed = |why: String| Ended::failed("Failed", format!("{}: {why}", file.display()));
    let to = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&file);
    let to = to.map_err(|error| failed(error.to_string()))?;
    let members = write(to, arguments, global).map_err(|error| {
        // A fragment looks like a bundle, and stands in the way of the next one.
        failed(match fs::remove_file(&file) {
            Ok(()) => format!("{error}; what was written of it is removed"),
            Err(why) => format!("{error}; what was written of it could not be removed: {why}"),
        })
    })?;
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

/// The names of the members. Fails only where the archive cannot be written: what cannot be read is missing in it.
fn write(to: File, arguments: Arguments, global: &Global) -> io::Result<Vec<String>> {
    let Arguments { config, log, audit, state, listen, .. } = arguments;
    let state = state.or_else(state_folder);
    let configuration = config.as_deref().map(configuration).transpose();
    let named = configuration.as_ref().ok().and_then(|read| read.as_ref()?.keys.clone());
    let secrets = Secrets::of_host(state.as_deref(), named.iter().chain(&global.key_file));
    let mut missing = Map::new();
    for (path, why) in &secrets.unread {
        missing.insert(format!("secrets of {}", path.display()), format!("{why}: they are not looked for").into());
    }
    let mut archive = Archive::new(to, secrets);
    let mut about = about();
    match configuration {
        Ok(Some(Configuration { text, hash, left_out, .. })) => {
            about.insert("configuration_hash".into(), hash.into());
            archive.text("configuration.toml", &text)?;
            if !left_out.is_empty() {
                let why = format!("left out, as no node reads it: {}", left_out.join(", "));
                missing.insert("configuration".into(), why.into());
            }
        }
        Ok(None) => {}
        Err(why) => drop(missing.insert("configuration".into(), why.into())),
    }
    match cara_doctor::examine(listen, global) {
        Ok(report) => archive.object("doctor.json", &report)?,
        Err(error) => drop(missing.insert("doctor".into(), error.to_string().into())),
    }
    match known(global) {
        Ok(Some(known)) => known.iter().try_for_each(|(name, value)| archive.object(name, value))?,
        Ok(None) => drop(missing.insert("unit".into(), "no m_unit runs on this host".into())),
        Err(error) => drop(missing.insert("unit".into(), error.to_string().into())),
    }
    let audit = audit.or_else(|| state.as_ref().map(|state| state.join("audit.log")));
    for (name, path, take) in [("log.txt", log, end_of as fn(&Path) -> _), ("audit.jsonl", audit, audited)] {
        let Some(path) = path else { continue };
        match take(&path) {
            Ok(text) => archive.text(name, &text)?,
            Err(why) => drop(missing.insert(name.into(), why.into())),
        }
    }
    about.insert("recordings".into(), recordings(state.as_deref(), &mut missing).into());
    if let Some(state) = &state {
        about.insert("black_boxes".into(), black_boxes(state, &mut archive, &mut missing)?);
    }
    about.insert("missing".into(), missing.into());
    archive.object("about.json", &about.into())?;
    archive.end()
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

/// What is taken of a configuration.
struct Configuration {
    /// Without comments, members that no node reads, and arguments of programs: a token may be in any of them.
    text: String,
    /// Of the whole file.
    hash: String,
    /// Members that are not in the text.
    left_out: Vec<String>,
    /// The file with the node's keys.
    keys: Option<PathBuf>,
}

fn configuration(path: &Path) -> Result<Configuration, String> {
    let (bytes, is_longer) = files::read(path, LONGEST_FILE).map_err(|error| error.to_string())?;
    if is_longer {
        return Err(format!("it has more than {LONGEST_FILE} bytes"));
    }
    let text = std::str::from_utf8(&bytes).map_err(|error| error.to_string())?;
    // The text of the error shows the line.
    let mut table: toml::Table = toml::from_str(text).map_err(|_| "it is no TOML".to_owned())?;
    let keys = table.get("keys").and_then(toml::Value::as_str).map(|keys| match Path::new(keys) {
        // The node was perhaps started beside its file.
        keys if !keys.exists() => path.with_file_name(keys),
        keys => keys.to_owned(),
    });
    let left_out = take_out(&mut table);
    let text = toml::to_string(&table).map_err(|error| error.to_string())?;
    Ok(Configuration { text, hash: hash(&bytes), left_out, keys })
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

/// The last whole lines of a file. A part of a line might have a part of a secret, which would not be found.
fn end_of(path: &Path) -> Result<String, String> {
    let (bytes, is_whole) = last_bytes(path).map_err(|error| error.to_string())?;
    let text = String::from_utf8_lossy(&bytes);
    let (first, last) = (text.find('\n').map(|at| at + 1), text.rfind('\n').map_or(0, |at| at + 1));
    let first = if is_whole { Some(0) } else { first };
    match first.and_then(|first| text.get(first..last)) {
        Some(lines) if !lines.is_empty() || text.is_empty() => Ok(lines.to_owned()),
        _ => Err(format!("its last {LOG_BYTES} bytes have no whole line")),
    }
}

/// The end of a file, and whether that is all of it. Anything but a regular file is refused: a pipe would be waited for.
fn last_bytes(path: &Path) -> io::Result<(Vec<u8>, bool)> {
    if !path.metadata()?.is_file() {
        return Err(io::Error::other("it is no file"));
    }
    let mut file = File::open(path)?;
    let from = file.metadata()?.len().saturating_sub(LOG_BYTES);
    file.seek(SeekFrom::Start(from))?;
    let mut bytes = Vec::new();
    file.take(LOG_BYTES).read_to_end(&mut bytes)?;
    Ok((bytes, from == 0))
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

/// The recordings in the folders in which they are looked for.
fn recordings(state: Option<&Path>, missing: &mut Map<String, Value>) -> Vec<String> {
    let mut found = Vec::new();
    for folder in state.into_iter().chain([OF_SERVICE, "."].map(Path::new)) {
        match fs::read_dir(folder) {
            Ok(entries) => found.extend(entries.flatten().map(|entry| entry.path().to_string_lossy().into_owned())),
            // A host without the service.
            Err(error) if error.kind() == io::ErrorKind::NotFound && folder == Path::new(OF_SERVICE) => {}
            Err(error) => drop(missing.insert(format!("recordings in {}", folder.display()), error.to_string().into())),
        }
    }
    found.retain(|path| path.rsplit('/').next().is_some_and(|name| name.contains(".mcap")));
    found
}

/// Takes the newest, and says what each is.
fn black_boxes(state: &Path, archive: &mut Archive, missing: &mut Map<String, Value>) -> io::Result<Value> {
    let All { found, unread } = match super::black_box::all(state) {
        Ok(all) => all,
        Err(error) => {
            missing.insert("black_boxes".into(), error.to_string().into());
            return Ok(Value::Array(Vec::new()));
        }
    };
    let mut miss = |file: &Path, why: String| {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        missing.insert(format!("{FOLDER}/{name}"), why.into());
    };
    unread.into_iter().for_each(|(file, why)| miss(&file, why));
    let (mut taken, mut bytes) = (Vec::new(), 0);
    for (number, found) in found.into_iter().rev().take(BOXES).enumerate() {
        bytes += found.bytes;
        if bytes > BOX_BYTES {
            miss(&found.file, format!("with the newer ones it has more than {BOX_BYTES} bytes"));
            break;
        }
        let member = format!("black-box-{}.mcap", number + 1);
        match fs::read(&found.file) {
            Ok(read) if archive.bytes(&member, &read)? => taken.push(json!({ "member": member, "is": found })),
            Ok(_) => miss(&found.file, "it holds a secret".into()),
            Err(error) => miss(&found.file, error.to_string()),
        }
    }
    Ok(taken.into())
}
