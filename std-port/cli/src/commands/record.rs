//! `cara record`: what a manager reports, into a file.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{Builder, sleep};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use blake2::{Blake2s256, Digest};
use cara_std::control::protocol::{Answer, NodeInfo, OrderInfo, Question, UnitInfo};
use serde_json::json;

use super::logs::{Decoding, FirmwareArguments, Logs};
use crate::nodes;
use crate::operator::{Need, Operator, Way};
use cara_recording::{Limits, Recorder, StartError};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::interrupt::Asked;
use cara_tools::output;
use cara_tools::units::{parse_bytes, parse_time, show_bytes, show_micros};

/// Records what the manager reports into an MCAP file, which `cara replay`, Foxglove and other MCAP tools read: events, what
/// operators and the manager's program ask for and what comes of it, orders, nodes, counters, and the streams that are named.
/// Ctrl-C ends it.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The file. A recording that is there becomes FILE.1.
    file: PathBuf,
    /// Record the streams of this name, of all nodes; may be repeated. `log` is recorded line by line, as events, also the
    /// manager's own; a board's with --elf.
    #[arg(long, value_name = "NAME")]
    stream: Vec<String>,
    /// Record at most so many values of a stream a second; as many as the node grants, up to 50, if absent.
    #[arg(long, value_name = "NUMBER", value_parser = super::stream::rate, requires = "stream")]
    rate: Option<f64>,
    #[command(flatten)]
    firmware: FirmwareArguments,
    /// How often counters and the state of links are recorded; 10 ms at least.
    #[arg(long, value_name = "TIME", default_value = "10s", value_parser = every)]
    every: Duration,
    /// Begin the next file after so many bytes; the one before becomes FILE.1.
    #[arg(long, value_name = "SIZE", default_value = "256MiB", value_parser = size)]
    max_size: u64,
    /// Keep so many files besides the one that is written.
    #[arg(long, value_name = "NUMBER", default_value_t = 3, value_parser = clap::value_parser!(u16).range(1..))]
    keep: u16,
    /// End after this time.
    #[arg(long = "for", value_name = "TIME", value_parser = parse_time)]
    span: Option<Duration>,
}

/// Between two looks at nodes and orders, and before the next try to reach the manager.
const LOOK: Duration = Duration::from_secs(1);
/// What is recorded can be read after this time, also if the process is killed.
const CHUNK: Duration = Duration::from_secs(1);
/// Between two looks at whether it is to end.
const PAUSE: Duration = Duration::from_millis(20);
/// Between two warnings about losses.
const WARN: Duration = Duration::from_secs(10);
/// How long a disk that takes nothing is waited for at the end, and before it is said at the start.
const LAST: Duration = Duration::from_secs(2);
/// Every file begins with the state of everything.
const LEAST: u64 = 64 * 1024;

/// More often, nodes and orders would be asked for without a pause.
const OFTEN: Duration = Duration::from_millis(10);

fn every(text: &str) -> Result<Duration, String> {
    let every = parse_time(text)?;
    if every >= OFTEN { Ok(every) } else { Err(format!("at least {}", show_micros(OFTEN.as_micros() as f64))) }
}

fn size(text: &str) -> Result<u64, String> {
    let size = parse_bytes(text)?;
    if size >= LEAST { Ok(size) } else { Err(format!("a file has at least {}", show_bytes(LEAST))) }
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let asked = Asked::catch()?;
    let Arguments { file, stream, rate, firmware, every, max_size, keep, span } = arguments;
    let decoding = Arc::new(Decoding::of(&firmware, Decoding::OfLinux)?);
    let mut operator = Operator::open(global, &Need::Nothing)?;
    let unit = operator.unit()?;
    let start = Instant::now();
    let is_over = || asked.came() || span.is_some_and(|span| start.elapsed() >= span);
    let (path, limits, about) = (file.clone(), Limits { size: max_size, keep: keep.into() }, about(&unit));
    let recorder = begin(&file, move || Recorder::start(&path, limits, about), is_over)?;
    let way = operator.way();
    let mut questions = vec![Question::Commands];
    if !stream.is_empty() {
        let interval_ms = rate.map_or(0, |rate| (1000.0 / rate).ceil() as u64);
        questions.push(Question::Streams { interval_ms, names: stream });
    }
    let changed = Changed::default();
    for question in questions {
        let (way, recorder, changed, decoding) = (way.clone(), recorder.clone(), changed.clone(), decoding.clone());
        let follow = move || follow(&way, &recorder, question, &decoding, &changed);
        Builder::new().name("follow".into()).spawn(follow)?;
    }
    let (from, to) = (way.clone(), recorder.clone());
    Builder::new().name("look".into()).spawn(move || look(operator, &from, &to, every, &changed))?;
    match global.json {
        true => output::object(&json!({ "recording": file }))?,
        false => output::line(format_args!(
            "recording {}/{} (fleet {}) into {}",
            unit.name,
            unit.id,
            unit.fleet,
            file.display()
        ))?,
    }
    await_end(&recorder, is_over);
    way.end();
    let outcome = recorder.end(LAST);
    match global.json {
        true => output::object(&json!({ "messages": outcome.messages, "lost": outcome.lost }))?,
        false => output::line(format_args!("{} messages recorded, {} lost", outcome.messages, outcome.lost))?,
    }
    outcome.whole.map_err(|why| {
        let why = why.unwrap_or_else(|| "the disk does not answer".to_owned());
        let text = format!("the end of {} is missing ({why}); what was written before can be read", file.display());
        Ended::failed("Failed", text)
    })?;
    Ok(Exit::Done.into())
}

/// Opens the file in a thread of its own, as its disk may hang. Fails if it has not opened when the recording is over.
fn begin<T: Send + 'static>(
    file: &Path,
    start: impl FnOnce() -> Result<T, StartError> + Send + 'static,
    is_over: impl Fn() -> bool,
) -> anyhow::Result<T> {
    let (to, started) = channel();
    Builder::new().name("open".into()).spawn(move || drop(to.send(start())))?;
    let (begun, mut is_warned) = (Instant::now(), false);
    loop {
        match started.recv_timeout(PAUSE) {
            Ok(Ok(recorder)) => return Ok(recorder),
            Ok(Err(error)) if matches!(error, StartError::Refused { .. }) => {
                return Err(Ended::usage(error.to_string()));
            }
            Ok(Err(error)) => return Err(Ended::failed("Failed", error.to_string())),
            Err(RecvTimeoutError::Disconnected) => anyhow::bail!("{}: the thread that opens it ended", file.display()),
            Err(RecvTimeoutError::Timeout) if is_over() => {
                let text = format!("{}: the disk does not answer: nothing is recorded", file.display());
                return Err(Ended::failed("Failed", text));
            }
            Err(RecvTimeoutError::Timeout) if !is_warned && begun.elapsed() >= LAST => {
                is_warned = true;
                output::warning(format_args!("{}: the disk does not answer, nothing is recorded yet", file.display()));
            }
            Err(RecvTimeoutError::Timeout) => {}
        }
    }
}

fn await_end(recorder: &Recorder, is_over: impl Fn() -> bool) {
    let (mut flushed, mut warned, mut lost) = (Instant::now(), None::<Instant>, 0);
    while !is_over() {
        sleep(PAUSE);
        if flushed.elapsed() >= CHUNK {
            flushed = Instant::now();
            recorder.flush();
        }
        if recorder.lost() > lost && warned.is_none_or(|warned| warned.elapsed() >= WARN) {
            (lost, warned) = (recorder.lost(), Some(Instant::now()));
            let why = recorder.held_up().map(|why| format!(": {why}")).unwrap_or_default();
            output::warning(format_args!("{lost} messages are lost until now, which the disk did not take{why}"));
        }
    }
}

/// What is recorded about the recording. Nothing of it is secret.
fn about(unit: &UnitInfo) -> BTreeMap<String, String> {
    let UnitInfo { name, id, role, fleet, mode, version, discovery_port, constraints, .. } = unit;
    let configuration = json!([name, id, role, fleet, mode, version, discovery_port, constraints]).to_string();
    let hash: String = Blake2s256::digest(configuration).iter().map(|byte| format!("{byte:02x}")).collect();
    let release = unit.release.clone().unwrap_or_default();
    [
        ("unit", format!("{name}/{id}")),
        ("fleet", fleet.to_string()),
        ("mode", mode.clone().unwrap_or_default()),
        ("epoch", unit.epoch.clone()),
        ("protocol_version", version.to_string()),
        ("release", release),
        ("recorded_by", format!("cara {}", env!("CARGO_PKG_VERSION"))),
        ("configuration_hash", hash),
    ]
    .into_iter()
    .map(|(key, value)| (key.to_owned(), value))
    .collect()
}

/// Nodes whose functions may be others than those that are recorded.
type Changed = Arc<Mutex<HashSet<String>>>;

/// Records the answers to a question that has no end, also after the manager was away.
fn follow(way: &Way, recorder: &Recorder, mut question: Question, decoding: &Arc<Decoding>, changed: &Changed) {
    let is_streams = matches!(question, Question::Streams { .. });
    let (mut is_warned, mut logs) = (false, Logs::new(decoding.clone()));
    loop {
        let mut is_followed = false;
        let ended = way.open().and_then(|mut operator| {
            operator.watch(&question, None, |answer| {
                is_followed = true;
                if let Answer::Event { event, node: Some(node), .. } = &answer
                    && event == "list_changed"
                {
                    changed.lock().unwrap_or_else(PoisonError::into_inner).insert(node.clone());
                }
                logs.events(answer).iter().for_each(|answer| recorder.take(answer));
                Ok(true)
            })
        });
        let is_older = |error: &anyhow::Error| {
            error.downcast_ref::<Ended>().is_some_and(|ended| ended.name == "BadQuestion")
                && question != Question::Watch
        };
        match ended {
            Err(error) if is_older(&error) => {
                let what = if is_streams { "streams by name" } else { "commands" };
                output::warning(format_args!("the manager is older and does not report {what}: they are not recorded"));
                if is_streams {
                    return;
                }
                question = Question::Watch;
                continue;
            }
            Err(error) if !is_followed && !is_warned => {
                let what = if is_streams { "streams" } else { "events" };
                output::warning(format_args!("{what} are not recorded at this moment: {error:#}"));
            }
            _ => {}
        }
        is_warned = !is_followed;
        if is_followed && !is_streams {
            let unix_ms = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis() as u64;
            let (event, text) = ("not_watched".to_owned(), "what happens from here on is not seen".to_owned());
            recorder.take(&Answer::Event { at_ms: 0, unix_ms, event, node: None, text });
        }
        sleep(LOOK);
    }
}

/// Records what has changed of the unit, nodes and orders, again and again; counters and the state of links every so often.
fn look(first: Operator, way: &Way, recorder: &Recorder, every: Duration, changed: &Changed) {
    let (mut operator, mut file, mut sampled) = (Some(first), 0, None::<Instant>);
    // By what they are about, without what changes with time alone.
    let mut known = HashMap::<String, Answer>::new();
    loop {
        if recorder.file() != file {
            file = recorder.file();
            known.clear();
        }
        let is_due = sampled.is_none_or(|sampled| sampled.elapsed() >= every) || known.is_empty();
        let opened = operator.take().map_or_else(|| way.open(), Ok);
        let looked = opened.and_then(|mut operator| {
            let mut questions = vec![Question::Nodes { offering: None }, Question::Orders { node: None }];
            if is_due {
                questions.extend([Question::Unit, Question::Counters { node: None }]);
            }
            let mut changed = std::mem::take(&mut *changed.lock().unwrap_or_else(PoisonError::into_inner));
            for question in questions {
                operator.ask(&question, |answer| {
                    changed.extend(record_changed(recorder, &mut known, answer, is_due));
                    Ok(())
                })?;
            }
            for node in changed {
                // A node that has left meanwhile has none.
                if let Ok(functions) = nodes::functions(&mut operator, &node) {
                    recorder.take_functions(&node, &functions);
                }
            }
            Ok(operator)
        });
        if is_due {
            sampled = Some(Instant::now());
        }
        operator = looked.ok();
        if operator.is_none() {
            known.clear();
        }
        sleep(LOOK.min(every));
    }
}

/// Returns the node whose functions may be others than before.
fn record_changed(
    recorder: &Recorder,
    known: &mut HashMap<String, Answer>,
    answer: Answer,
    is_due: bool,
) -> Option<String> {
    let (key, lasting, is_sampled, offers) = match &answer {
        Answer::Node(node) => {
            let lasting = NodeInfo {
                connected_ms: None,
                left_ms: None,
                searched_ms: None,
                link: None,
                clock: None,
                ..node.clone()
            };
            let name = format!("{}/{}", node.name, node.id);
            let key = format!("{name}@{}", node.role);
            (key, Answer::Node(lasting), node.connected, Some(name).filter(|_| node.connected))
        }
        Answer::Order(order) => {
            let lasting = OrderInfo { left_ms: None, age_ms: None, ..order.clone() };
            (format!("{}/{} {}", order.node, order.id, order.function), Answer::Order(lasting), false, None)
        }
        Answer::Unit(unit) => {
            let lasting = UnitInfo { uptime_ms: 0, connected: 0, ..unit.clone() };
            (String::new(), Answer::Unit(lasting), false, None)
        }
        Answer::Counters { .. } => {
            recorder.take(&answer);
            return None;
        }
        _ => return None,
    };
    let has_changed = known.get(&key) != Some(&lasting);
    if is_sampled && is_due || has_changed {
        recorder.take(&answer);
        known.insert(key, lasting);
    }
    offers.filter(|_| has_changed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_that_hangs_at_the_start_does_not_hold_up_the_end() {
        let (go_on, hangs) = channel::<()>();
        let looks = std::cell::Cell::new(0);
        let is_over = || {
            looks.set(looks.get() + 1);
            looks.get() == 3
        };
        let start = move || {
            let _ = hangs.recv();
            Ok(())
        };
        let ended = begin(Path::new("a.mcap"), start, is_over).unwrap_err();
        let ended = ended.downcast::<Ended>().unwrap();
        assert!(ended.exit == Exit::Failed && ended.text.contains("does not answer"), "{}", ended.text);
        drop(go_on);
        assert_eq!(begin(Path::new("a.mcap"), || Ok(7), || false).unwrap(), 7);
    }
}
