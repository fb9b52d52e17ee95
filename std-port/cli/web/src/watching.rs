//! Threads that keep the picture: each with a way of its own to the manager, which it opens again when that is lost.

use std::collections::{HashMap, HashSet};
use std::ops::ControlFlow;
use std::sync::{Arc, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use cara_std::control::protocol::{Answer, ClockInfo, NodeInfo, Question};
use serde_json::{Map, Value, json};

use crate::picture::Section;
use crate::server::Shared;
use crate::{Connection, form};

/// Between two looks at nodes and orders.
const LOOK: Duration = Duration::from_millis(500);
/// Looks between two at the counters.
const COUNTERS_EVERY: u64 = 4;
/// Before a lost manager is looked for again.
const RETRY: Duration = Duration::from_millis(500);
/// Least time between two values of a stream.
const STREAM_INTERVAL_MS: u64 = 100;
/// A node is pinged so often.
const PING_EVERY: u64 = 2_000;
/// How long pongs are waited for in one look: of one node, and about of all that are due. The others come with the next look.
const PING_TIMEOUT_MS: u64 = 200;
const PINGS: Duration = Duration::from_millis(200);
/// A node is taken to be connected since the same time while that does not move by more than this.
const SAME: u64 = 2_000;

/// Starts them all. They end with the process.
pub(crate) fn start(shared: &Arc<Shared>) -> std::io::Result<()> {
    keep("web-look", shared, true, look)?;
    keep("web-events", shared, false, events)?;
    keep("web-streams", shared, false, streams)
}

/// Runs `work` on a connection, again and again. Where `reports` is set, pages are told when that is impossible.
fn keep(
    name: &str,
    shared: &Arc<Shared>,
    reports: bool,
    work: fn(&Shared, &mut dyn Connection) -> anyhow::Result<()>,
) -> std::io::Result<()> {
    let shared = shared.clone();
    thread::Builder::new().name(name.to_owned()).spawn(move || {
        loop {
            let outcome = shared.unit.connect(false).and_then(|mut way| work(&shared, &mut *way));
            if reports {
                let error = outcome.err().map_or_else(|| "the unit has ended".to_owned(), |error| format!("{error:#}"));
                shared.picture().lost(&error);
            }
            thread::sleep(RETRY);
        }
    })?;
    Ok(())
}

/// All answers to a question; one that it failed is an error.
fn answers(way: &mut dyn Connection, question: &Question) -> anyhow::Result<Vec<Answer>> {
    let (mut all, mut failed) = (Vec::new(), None);
    way.ask(question, &mut |answer| {
        match answer {
            Answer::Done => {}
            Answer::Failed(failure) => failed = Some(failure),
            answer => all.push(answer),
        }
        ControlFlow::Continue(())
    })?;
    failed.map_or(Ok(all), |failure| Err(anyhow::anyhow!("{}: {}", failure.error, failure.text)))
}

/// Looks at the unit, its nodes and what they move.
fn look(shared: &Shared, way: &mut dyn Connection) -> anyhow::Result<()> {
    let (mut joined, mut pinged) = (Map::new(), HashMap::new());
    for round in 0_u64.. {
        let unit = answers(way, &Question::Unit)?;
        let nodes = answers(way, &Question::Nodes { offering: None })?;
        let orders = answers(way, &Question::Orders { node: None })?;
        let counters = match round % COUNTERS_EVERY {
            0 => Some(answers(way, &Question::Counters { node: None })?),
            _ => None,
        };
        let mut picture = shared.picture();
        picture.answered();
        let now = picture.now();
        let (unit, nodes, refused) =
            (of_unit(unit), of_nodes(&nodes, now, &mut joined), of_refused(&nodes, now, &mut joined));
        // What is known of others would grow with each address that was refused.
        let known: HashSet<&str> = nodes.iter().chain(&refused).map(|(key, _)| key.as_str()).collect();
        joined.retain(|key, _| known.contains(key.as_str()));
        picture.put(Section::Unit, "", &unit);
        let names: HashSet<&str> = nodes.iter().filter_map(|(key, _)| Some(key.rsplit_once('@')?.0)).collect();
        let own = format!("{}/{}", unit["name"].as_str().unwrap_or_default(), unit["id"]);
        picture.only_streams_of(|node| names.contains(node) || node == own);
        picture.set(Section::Nodes, &nodes);
        picture.set(Section::Refused, &refused);
        picture.set(Section::Orders, &of_orders(orders, now));
        if let Some(counters) = counters {
            picture.set(Section::Counters, &of_counters(counters));
        }
        let limits = shared.limits.json();
        picture.put(Section::Limits, "", &limits);
        drop(picture);
        ping(shared, way, &nodes, &mut pinged)?;
        thread::sleep(LOOK);
    }
    Ok(())
}

fn of_unit(answers: Vec<Answer>) -> Value {
    let unit = answers.into_iter().find_map(|answer| if let Answer::Unit(unit) = answer { Some(unit) } else { None });
    let mut unit = unit.map_or(Value::Null, |unit| json!(unit));
    // It changes by itself, and would be told with each look.
    unit.as_object_mut().and_then(|unit| unit.remove("uptime_ms"));
    unit
}

/// Each with the time since when it is as it is. `since` keeps those times, so that they do not jitter.
fn of_nodes(answers: &[Answer], now: u64, since: &mut Map<String, Value>) -> Vec<(String, Value)> {
    let nodes = answers.iter().filter_map(|answer| if let Answer::Node(node) = answer { Some(node) } else { None });
    nodes
        .map(|node| {
            let NodeInfo { name, id, role, .. } = node;
            let key = format!("{name}/{id}@{role}");
            let at = steady(now, if node.connected { node.connected_ms } else { node.left_ms }, &key, since);
            let mut reported = json!(node);
            if let Some(reported) = reported.as_object_mut() {
                ["connected_ms", "left_ms"].iter().for_each(|name| drop(reported.remove(*name)));
                reported.insert("since".to_owned(), at.into());
                // Without its age, as that changes by itself.
                if let Some(clock) = node.clock {
                    let ClockInfo { offset_us, error_us, .. } = clock;
                    let clock = json!({ "offset_us": offset_us, "error_us": error_us, "trouble": clock.trouble() });
                    reported.insert("clock".to_owned(), clock);
                }
            }
            (key, reported)
        })
        .collect()
}

/// The time that was so long ago, as it was reported before where that is about the same.
fn steady(now: u64, ago: Option<u64>, key: &str, since: &mut Map<String, Value>) -> Option<i64> {
    let at = ago.map(|ago| i128::from(now) - i128::from(ago)).and_then(|at| i64::try_from(at).ok());
    let kept = since.get(key).and_then(Value::as_i64);
    let at = kept.filter(|kept| at.is_some_and(|at| at.abs_diff(*kept) < SAME)).or(at);
    since.insert(key.to_owned(), at.into());
    at
}

fn of_refused(answers: &[Answer], now: u64, since: &mut Map<String, Value>) -> Vec<(String, Value)> {
    let refused = answers.iter().filter_map(|answer| if let Answer::Refused(one) = answer { Some(one) } else { None });
    refused
        .map(|one| {
            let at = steady(now, Some(one.ago_ms), &one.address, since);
            (one.address.clone(), json!({ "node": one.node, "reason": one.reason, "text": one.text, "at": at }))
        })
        .collect()
}

fn of_orders(answers: Vec<Answer>, now: u64) -> Vec<(String, Value)> {
    let orders =
        answers.into_iter().filter_map(|answer| if let Answer::Order(order) = answer { Some(order) } else { None });
    orders
        .map(|order| {
            let key = format!("{}/{} {}", order.node, order.id, order.function);
            let mut reported = json!(order);
            if let (Some(left), Some(reported)) = (order.left_ms, reported.as_object_mut()) {
                reported.insert("ends".to_owned(), (now + left).into());
                reported.remove("left_ms");
            }
            (key, reported)
        })
        .collect()
}

/// Those that are not 0.
fn of_counters(answers: Vec<Answer>) -> Vec<(String, Value)> {
    let counted = answers.into_iter().filter_map(|answer| match answer {
        Answer::Counters { node, counters } => Some((node, counters)),
        _ => None,
    });
    counted
        .map(|(node, counters)| {
            let counters: Map<String, Value> = counters
                .into_iter()
                .filter(|(_, count)| *count > 0)
                .map(|(name, count)| (name, count.into()))
                .collect();
            (node.unwrap_or_default(), counters.into())
        })
        .collect()
}

fn events(shared: &Shared, way: &mut dyn Connection) -> anyhow::Result<()> {
    way.ask(&Question::Watch, &mut |answer| {
        take(shared, answer);
        ControlFlow::Continue(())
    })
}

fn streams(shared: &Shared, way: &mut dyn Connection) -> anyhow::Result<()> {
    let mut logs = shared.unit.logs();
    way.ask(&Question::Streams { interval_ms: STREAM_INTERVAL_MS, names: Vec::new() }, &mut |answer| {
        logs(answer).into_iter().for_each(|answer| take(shared, answer));
        ControlFlow::Continue(())
    })
}

/// Something happened, was logged, or is the value of a stream.
fn take(shared: &Shared, answer: Answer) {
    match answer {
        // A recording has lines as events.
        Answer::Event { unix_ms, event, node: Some(node), text, .. } if event == "log" => {
            shared.picture().log(&node, unix_ms, &text);
        }
        Answer::Event { unix_ms, event, node, text, .. } => {
            let kept =
                shared.picture().event(&json!({ "unix_ms": unix_ms, "event": event, "node": node, "text": text }));
            shared.limits.events.uses(kept);
        }
        Answer::Value { node, stream, age_us: Some(age), values, error: None, .. } => {
            // Pairs, in the order of the signature: an object has none, and a place is the first two numbers of a pose.
            let values = form::streamed_all(&stream, &values);
            shared.picture().value(&node, &stream, &values, age / 1000, &shared.limits);
        }
        _ => {}
    }
}

/// The round trips of connected nodes that are due, the longest unasked ones first. `pinged` has when each was asked.
fn ping(
    shared: &Shared,
    way: &mut dyn Connection,
    nodes: &[(String, Value)],
    pinged: &mut HashMap<String, u64>,
) -> anyhow::Result<()> {
    let (start, now) = (Instant::now(), shared.picture().now());
    pinged.retain(|key, _| nodes.iter().any(|(known, _)| known == key));
    let connected = nodes.iter().filter(|(_, node)| node["connected"] == true).map(|(key, _)| key);
    let asked = |key: &String| pinged.get(key).copied();
    let mut due: Vec<_> = connected.filter(|key| asked(key).is_none_or(|at| now - at >= PING_EVERY)).collect();
    due.sort_by_key(|key| asked(key));
    for key in due {
        if start.elapsed() >= PINGS {
            break;
        }
        let question = Question::Ping { node: key.clone(), count: 1, pause_us: 0, timeout_ms: PING_TIMEOUT_MS };
        // A node that has left meanwhile fails it, which its row tells.
        let mut took = None;
        way.ask(&question, &mut |answer| {
            if let Answer::Sample { us, .. } = answer {
                took = us;
            }
            ControlFlow::Continue(())
        })?;
        let mut picture = shared.picture();
        let (at, name) = (picture.now(), key.rsplit_once('@').map_or(key.as_str(), |(name, _)| name));
        picture.put(Section::Pings, name, &json!({ "us": took, "at": at }));
        pinged.insert(key.clone(), at);
    }
    Ok(())
}

impl Shared {
    pub(crate) fn picture(&self) -> std::sync::MutexGuard<'_, crate::picture::Picture> {
        self.picture.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
