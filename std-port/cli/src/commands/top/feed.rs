//! The threads that ask the manager. What they hear goes into the channel of the thread that draws.

use std::collections::HashMap;
use std::io;
use std::sync::mpsc::{SendError, SyncSender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{Builder, sleep};
use std::time::{Duration, Instant};

use cara_std::control::protocol::{Answer, CallQuestion, Failure, Question};
use cara_tools::units::show_micros;

use super::Message;
use super::app::{Ask, Counted, News, Probe, Snapshot, Value, selector};
use crate::commands::call::{bound, of_its_lease, of_node, wrong};
use crate::nodes;
use crate::operator::{Operator, Way};
use crate::text::{read, show_call};

/// Between two looks at the manager, and before the next try to reach it.
const LOOK: Duration = Duration::from_millis(500);
/// Counters are asked for with each so many looks.
const COUNTERS: u32 = 4;
/// A node is asked for its round trip and its streams at most so often.
const PROBE: Duration = Duration::from_secs(1);
/// The watched one.
const WATCHED: Duration = Duration::from_millis(500);
/// How long a ping may take.
const PING: Duration = Duration::from_millis(300);
/// Streams of a node that take longer than this, since one has no value yet, are asked for less often.
const SLOW: Duration = Duration::from_millis(250);
/// By so many rounds.
const SKIPPED: u8 = 9;
/// Rows of a kind that are kept; far beyond the nodes of a manager.
const MOST: usize = 16_384;
/// Characters of a text that are kept.
const LONGEST: usize = 1_000;

/// How the manager is asked.
pub(super) struct Feed {
    way: Way,
    out: SyncSender<Message>,
    wanted: Arc<Mutex<Wanted>>,
}

/// Which nodes are probed.
#[derive(Default)]
struct Wanted {
    connected: Vec<String>,
    /// More often than the others.
    watched: Option<String>,
}

/// The thread that draws has ended.
struct Over;

impl From<SendError<Message>> for Over {
    fn from(_: SendError<Message>) -> Self {
        Self
    }
}

fn lock(wanted: &Mutex<Wanted>) -> MutexGuard<'_, Wanted> {
    wanted.lock().unwrap_or_else(PoisonError::into_inner)
}

fn cut(text: &str) -> String {
    text.chars().take(LONGEST).collect()
}

impl Feed {
    pub(super) fn start(operator: Operator, out: SyncSender<Message>) -> io::Result<Self> {
        let (way, wanted) = (operator.way(), Arc::<Mutex<Wanted>>::default());
        let named = |name: &str| Builder::new().name(name.to_owned());
        let (to, from, shared) = (out.clone(), way.clone(), wanted.clone());
        named("look").spawn(move || _ = look(operator, &from, &to, &shared))?;
        let (to, from) = (out.clone(), way.clone());
        named("watch").spawn(move || _ = watch(&from, &to))?;
        let (to, from, shared) = (out.clone(), way.clone(), wanted.clone());
        named("probe").spawn(move || _ = probe(&from, &to, &shared))?;
        Ok(Self { way, out, wanted })
    }

    /// This node is probed more often.
    pub(super) fn watch(&self, node: Option<&str>) {
        lock(&self.wanted).watched = node.map(str::to_owned);
    }

    /// Has it done in a thread of its own: what is drawn goes on, and a stop waits for nothing.
    pub(super) fn act(&self, task: u64, ask: Ask) {
        let (way, out) = (self.way.clone(), self.out.clone());
        let thread = Builder::new().name("command".into()).spawn(move || {
            let (is_bad, text) =
                carry_out(&way, task, &ask, &out).unwrap_or_else(|error| (true, format!("error: {error:#}")));
            // Over only at the end.
            let _ = out.send(Message::News(News::End { task, is_bad, text }));
        });
        if let Err(error) = thread {
            let text = format!("error: no thread for it: {error}");
            // The thread that draws reads the channel, and must not wait for itself.
            let _ = self.out.try_send(Message::News(News::End { task, is_bad: true, text }));
        }
    }

    /// A manager of this process ends.
    pub(super) fn end(&self) {
        self.way.end();
    }
}

/// Asks for everything, again and again.
fn look(first: Operator, way: &Way, out: &SyncSender<Message>, wanted: &Mutex<Wanted>) -> Result<(), Over> {
    let (mut operator, mut round) = (Some(first), 0_u32);
    loop {
        let opened = operator.take().map_or_else(|| way.open(), Ok);
        let reported = opened.and_then(|mut operator| Ok((snapshot(&mut operator, round % COUNTERS == 0)?, operator)));
        match reported {
            Ok((snapshot, opened)) => {
                operator = Some(opened);
                round = round.wrapping_add(1);
                let connected = snapshot.nodes.iter().filter(|node| node.connected);
                lock(wanted).connected = connected.map(selector).collect();
                out.send(Message::News(News::Snapshot(Box::new(snapshot))))?;
            }
            Err(error) => {
                round = 0;
                lock(wanted).connected.clear();
                out.send(Message::News(News::Gone(cut(&format!("{error:#}")))))?;
            }
        }
        sleep(LOOK);
    }
}

fn snapshot(operator: &mut Operator, with_counters: bool) -> anyhow::Result<Snapshot> {
    let unit = operator.unit()?;
    let (mut nodes, mut refused, mut orders, mut counters) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut sort = |answer| {
        match answer {
            Answer::Node(node) if nodes.len() < MOST => nodes.push(node),
            Answer::Refused(info) if refused.len() < MOST => refused.push(info),
            Answer::Order(order) if orders.len() < MOST => orders.push(order),
            Answer::Counters { node, counters: found } if counters.len() < MOST => {
                counters.push(Counted { node, counters: found });
            }
            _ => {}
        }
        Ok(())
    };
    operator.ask(&Question::Nodes { offering: None }, &mut sort)?;
    operator.ask(&Question::Orders { node: None }, &mut sort)?;
    if with_counters {
        operator.ask(&Question::Counters { node: None }, &mut sort)?;
    }
    Ok(Snapshot { unit, nodes, refused, orders, counters: with_counters.then_some(counters) })
}

/// Tells events as they come, also after the manager was away.
fn watch(way: &Way, out: &SyncSender<Message>) -> Result<(), Over> {
    let event = |unix_ms, name: String, node, text: &str| {
        out.send(Message::News(News::Event { unix_ms, name, node, text: cut(text) }))
    };
    let mut watched = false;
    loop {
        let mut sent = Ok(());
        // Why it has ended is told by who looks.
        let _ = way.open().and_then(|mut operator| {
            operator.watch(&Question::Watch, None, |answer| {
                let Answer::Event { unix_ms, event: name, node, text, .. } = answer else { return Ok(true) };
                watched = true;
                sent = event(Some(unix_ms), name, node, &text);
                Ok(sent.is_ok())
            })
        });
        sent?;
        if std::mem::take(&mut watched) {
            event(None, "not_watched".to_owned(), None, "what happens from here on is not seen")?;
        }
        sleep(LOOK);
    }
}

/// Asks one connected node after the other for its round trip and its streams.
fn probe(way: &Way, out: &SyncSender<Message>, wanted: &Mutex<Wanted>) -> Result<(), Over> {
    let mut operator = None;
    // Rounds in which the streams of a node are not asked for.
    let mut skipped = HashMap::<String, u8>::new();
    loop {
        let round = Instant::now();
        let connected = lock(wanted).connected.clone();
        skipped.retain(|node, _| connected.contains(node));
        let mut watched_at: Option<Instant> = None;
        for node in &connected {
            let watched = lock(wanted).watched.clone();
            if let Some(watched) = watched.filter(|node| connected.contains(node))
                && watched_at.is_none_or(|at| at.elapsed() >= WATCHED)
            {
                watched_at = Some(Instant::now());
                probe_one(way, &mut operator, &watched, true, out)?;
            }
            let skip = skipped.entry(node.clone()).or_default();
            let streams = *skip == 0;
            *skip = if probe_one(way, &mut operator, node, streams, out)? { SKIPPED } else { skip.saturating_sub(1) };
        }
        let pause = if lock(wanted).watched.is_some() { WATCHED } else { PROBE };
        sleep(pause.saturating_sub(round.elapsed()).max(Duration::from_millis(50)));
    }
}

/// Whether its streams took long.
fn probe_one(
    way: &Way,
    operator: &mut Option<Operator>,
    node: &str,
    streams: bool,
    out: &SyncSender<Message>,
) -> Result<bool, Over> {
    if operator.is_none() {
        *operator = way.open().ok();
    }
    let Some(opened) = operator else { return Ok(false) };
    let mut round_trip = None;
    let timeout_ms = PING.as_millis() as u64;
    let ping = Question::Ping { node: node.to_owned(), count: 1, pause_us: 0, timeout_ms };
    let asked = opened.ask(&ping, |answer| {
        if let Answer::Sample { us, .. } = answer {
            round_trip = us;
        }
        Ok(())
    });
    let started = Instant::now();
    let values = if asked.is_ok() && streams { values(opened, node).ok() } else { None };
    if asked.is_err() {
        // The node has left, or the manager is gone: a new connection will tell.
        *operator = None;
    }
    out.send(Message::News(News::Probe(Probe { node: node.to_owned(), round_trip, values })))?;
    Ok(streams && started.elapsed() > SLOW)
}

fn values(operator: &mut Operator, node: &str) -> anyhow::Result<Vec<Value>> {
    let mut found = Vec::new();
    let question = Question::Stream { node: node.to_owned(), name: None, interval_ms: 0 };
    operator.ask(&question, |answer| {
        let Answer::Value { stream, age_us, values, error, .. } = answer else { return Ok(()) };
        let name = stream.split('(').next().unwrap_or_default();
        let text = match (error, age_us) {
            (Some(Failure { error, text, .. }), _) => format!("{name}: {error}: {text}"),
            (None, Some(_)) => show_call(name, &values),
            (None, None) => format!("{name}: no value yet"),
        };
        found.push(Value { stream: name.to_owned(), text: cut(&text), age: age_us.map(Duration::from_micros) });
        Ok(())
    })?;
    Ok(found)
}

/// What came of it in the end, and whether that is bad.
fn carry_out(way: &Way, task: u64, ask: &Ask, out: &SyncSender<Message>) -> anyhow::Result<(bool, String)> {
    match ask {
        Ask::Functions { node } => {
            let found = nodes::functions(&mut way.open()?, node)?;
            let signatures = found.into_iter().map(|function| function.signature).collect();
            out.send(Message::News(News::Functions { node: node.clone(), signatures }))?;
            Ok((false, String::new()))
        }
        Ask::Call { node, text } => call(&mut way.open()?, node, text),
        Ask::Stop { node } => each(&mut way.open_to_stop()?, task, &Question::Stop { node: node.clone() }, out),
        Ask::Reset { node } => each(&mut way.open()?, task, &Question::Reset { node: node.clone() }, out),
    }
}

/// As `cara call` does it, with the same mistakes and errors.
fn call(operator: &mut Operator, node: &str, text: &str) -> anyhow::Result<(bool, String)> {
    let written = read(text).map_err(|mistake| wrong(&mistake, text, None))?;
    let function = written.function.value;
    let node = nodes::connected(operator, node)?.selector;
    let published = of_node(operator, &node, function)?;
    let lease = published.attributes.lease.map(|lease| lease.as_micros());
    let question = CallQuestion {
        node: Some(node),
        function: function.to_owned(),
        arguments: bound(&written, &published)?,
        ..CallQuestion::default()
    };
    let mut outcome = (true, "the manager told no outcome".to_owned());
    operator.ask(&Question::Call(question), |answer| {
        let Answer::Called { node, id, results, error, took_us, .. } = answer else { return Ok(()) };
        let took = show_micros(took_us as f64);
        outcome = match error {
            None => (false, format!("{}  {took}", show_call(function, &results))),
            Some(failure) => {
                let ended = lease.filter(|lease| took_us >= lease / 4 * 3);
                let Failure { error, text, .. } = of_its_lease(failure, function, ended);
                (true, format!("{node}/{id}: {error}: {text}"))
            }
        };
        Ok(())
    })?;
    Ok(outcome)
}

/// A stop or a reset: a line for each node, as it answers.
fn each(
    operator: &mut Operator,
    task: u64,
    question: &Question,
    out: &SyncSender<Message>,
) -> anyhow::Result<(bool, String)> {
    let (mut nodes, mut acknowledged, mut last_us, mut only) = (0_u32, 0_u32, None, String::new());
    operator.ask(question, |answer| {
        let Answer::Called { node, id, error, took_us, .. } = answer else { return Ok(()) };
        nodes += 1;
        let is_bad = error.is_some();
        let text = match error {
            None => {
                acknowledged += 1;
                last_us = last_us.max(Some(took_us));
                format!("{node}/{id}  acknowledged after {}", show_micros(took_us as f64))
            }
            Some(Failure { error, text, .. }) => {
                let what = if error == "NotConnected" { "not reached" } else { &error };
                format!("{node}/{id}: {what}: {text}")
            }
        };
        only.clone_from(&text);
        Ok(out.send(Message::News(News::Line { task, is_bad, text }))?)
    })?;
    let is_bad = nodes == 0 || acknowledged < nodes;
    let last = last_us.map(|last| format!(", the last after {}", show_micros(last as f64))).unwrap_or_default();
    let text = match nodes {
        0 => "no s_unit is known: nothing was called".to_owned(),
        1 => only,
        _ => format!("{acknowledged} of {nodes} acknowledged{last}"),
    };
    Ok((is_bad, text))
}
