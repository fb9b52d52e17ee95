//! The messages of a recording: JSON objects, each channel with a JSON schema. They are the answers of the control socket as
//! `cara_std::control::protocol` has them, without members that are null, but for streams and counters, whose values have names
//! here, so that a program that plots them finds each by its path.

use std::borrow::Cow;

use cara_std::control::protocol::{Answer, Argument, ArgumentValue, FunctionInfo, UnitInfo};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

const EVENTS: &str = "/events";
const COMMANDS: &str = "/commands";
pub(super) const FUNCTIONS: &str = "/functions";
/// Begins the channels of MQTT, before its own topic.
pub(super) const MQTT: &str = "/mqtt/";
/// Characters of a payload of MQTT that its event shows.
const MOST_SHOWN: usize = 200;

/// A message, and the channel that it belongs to.
pub(super) struct Message {
    pub(super) topic: Cow<'static, str>,
    /// Of streams the signature: a node that comes back with another one gets another channel.
    pub(super) form: String,
    pub(super) body: Value,
    /// Nanoseconds since 1970, when what is reported was so.
    pub(super) published: u64,
}

/// What is recorded of an answer, which came at that time; `None` if nothing is.
pub(super) fn message(answer: &Answer, came: u64) -> Option<Message> {
    let from_ms = |unix_ms: u64| unix_ms.saturating_mul(1_000_000);
    let (topic, published) = match answer {
        Answer::Event { unix_ms, .. } => (EVENTS, from_ms(*unix_ms)),
        Answer::Command { unix_ms, .. } => (COMMANDS, from_ms(*unix_ms)),
        Answer::Node(_) => ("/nodes", came),
        Answer::Order(_) => ("/orders", came),
        Answer::Unit(unit) => return Some(of("/unit", came, json!(Answer::Unit(without_keys(unit))))),
        Answer::Counters { node, counters } => {
            let counted = counters.iter().filter(|(_, count)| *count > 0);
            let counted: Map<String, Value> = counted.map(|(name, count)| (name.clone(), json!(count))).collect();
            return Some(of("/counters", came, json!({ "node": node, "counters": counted })));
        }
        Answer::Value { node, stream, unix_ms, age_us, values, error } => {
            let name = stream.split('(').next().unwrap_or_default();
            let body = json!({
                "node": node, "stream": stream, "unix_ms": unix_ms, "age_us": age_us, "values": named(values), "error": error,
            });
            let published = from_ms(*unix_ms).saturating_sub(age_us.unwrap_or(0).saturating_mul(1_000));
            let (topic, form) = (Cow::Owned(format!("/streams/{node}/{name}")), stream.clone());
            return Some(Message { topic, form, body: without_nulls(body), published });
        }
        _ => return None,
    };
    Some(of(topic, published, json!(answer)))
}

/// What was said elsewhere than between units of CARA, as over MQTT.
#[derive(Serialize, Deserialize)]
pub(super) struct Elsewhere {
    /// Of the channel. It comes first, by which a line of the queue is told from an answer.
    pub(super) topic: String,
    pub(super) body: Value,
}

impl Elsewhere {
    /// How its line begins.
    pub(super) const BEGIN: &[u8] = b"{\"topic\"";

    pub(super) fn message(self, came: u64) -> Message {
        Message { topic: Cow::Owned(self.topic), form: String::new(), body: without_nulls(self.body), published: came }
    }
}

/// What a node offers.
pub(super) fn functions(node: &str, functions: &[FunctionInfo], came: u64) -> Message {
    of(FUNCTIONS, came, json!({ "node": node, "functions": functions }))
}

/// What the recording says of itself.
pub(super) fn about_itself(body: Value, at: u64) -> Message {
    of("/recording", at, body)
}

/// The event that a message of a recording holds; of a command or a message of MQTT, one that tells it.
pub fn event_of(message: &super::Message) -> Option<Answer> {
    let (topic, body) = (message.topic.as_str(), message.body.as_slice());
    if topic.starts_with(MQTT) {
        return mqtt(message.came, &serde_json::from_slice(body).ok()?);
    }
    if ![EVENTS, COMMANDS].contains(&topic) {
        return None;
    }
    match serde_json::from_slice(body).ok()? {
        event @ Answer::Event { .. } => Some(event),
        Answer::Command { unix_ms, by, question, outcome } => {
            let who = by.name.or(by.program).unwrap_or(by.origin);
            let outcome = match outcome.as_deref() {
                None => "gone",
                Some(Answer::Called { error: Some(error), .. } | Answer::Failed(error)) => &error.error,
                Some(_) => "ok",
            };
            let text = format!("{who}: {}: {outcome}", without_nulls(json!(question)));
            Some(Answer::Event { at_ms: 0, unix_ms, event: "command".to_owned(), node: None, text })
        }
        _ => None,
    }
}

/// A message of MQTT: its direction, its topic and how its payload begins.
fn mqtt(came: u64, body: &Value) -> Option<Answer> {
    let (direction, topic) = (body["direction"].as_str()?, body["topic"].as_str()?);
    let retained = if body["retained"] == true { ", retained" } else { "" };
    let payload = body["payload"].as_str().or_else(|| body["payload_hex"].as_str()).unwrap_or_default();
    let begin = payload.char_indices().nth(MOST_SHOWN).map_or(payload, |(end, _)| payload.split_at(end).0);
    let more = if begin.len() < payload.len() { "…" } else { "" };
    let text = format!("{direction} {topic}{retained}: {begin}{more}");
    Some(Answer::Event { at_ms: 0, unix_ms: came / 1_000_000, event: "mqtt".to_owned(), node: None, text })
}

fn of(topic: &'static str, published: u64, body: Value) -> Message {
    Message { topic: topic.into(), form: String::new(), body: without_nulls(body), published }
}

/// Generations are no secret. The path of the file means nothing on another host, where a recording may be read.
fn without_keys(unit: &UnitInfo) -> UnitInfo {
    let mut unit = unit.clone();
    unit.keys.iter_mut().for_each(|keys| keys.file = None);
    unit
}

fn named(values: &[Argument]) -> Map<String, Value> {
    let read =
        self::values(values).into_iter().map(|mut value| value.get_mut("value").map(Value::take).unwrap_or_default());
    values.iter().map(|value| value.name.clone()).zip(read).collect()
}

/// Values as `cara` shows them in JSON: what is one value is no list.
pub fn values(results: &[Argument]) -> Vec<Value> {
    let one = |value: Value| match value {
        Value::Array(list) if list.len() == 1 => list.into_iter().next().unwrap_or_default(),
        value => value,
    };
    let as_value = |result: &Argument| {
        let mut value = json!(result);
        if result.size == 1
            && matches!(result.value, ArgumentValue::Int(_) | ArgumentValue::Float(_) | ArgumentValue::Bool(_))
            && let Some(inner) = value.get_mut("value")
        {
            *inner = one(inner.take());
        }
        value
    };
    results.iter().map(as_value).collect()
}

fn without_nulls(value: Value) -> Value {
    match value {
        Value::Object(members) => {
            let members = members.into_iter().filter(|(_, value)| !value.is_null());
            members.map(|(name, value)| (name, without_nulls(value))).collect()
        }
        Value::Array(elements) => elements.into_iter().map(without_nulls).collect(),
        value => value,
    }
}

/// The name of a channel's schema, and the schema. Each member has one type, as Foxglove wants it; one that is null is left out.
pub(super) fn schema(message: &Message) -> (String, Value) {
    let (name, members) = match &*message.topic {
        EVENTS => ("cara.Event", json!({ "at_ms": 0, "unix_ms": 0, "event": "", "node": "", "text": "" })),
        COMMANDS => ("cara.Command", command()),
        FUNCTIONS => {
            let function = json!({ "name": "", "signature": "", "priority": "", "help": "" });
            ("cara.Functions", json!({ "node": "", "functions": [function] }))
        }
        "/nodes" => ("cara.Node", node()),
        "/orders" => ("cara.Order", order()),
        "/recording" => {
            ("cara.Recording", json!({ "event": "", "messages": 0, "lost": 0, "lost_in_all": 0, "text": "" }))
        }
        "/unit" => ("cara.Unit", message.body.clone()),
        "/counters" => ("cara.Counters", with(&message.body, "node", json!(""))),
        topic if topic.starts_with(MQTT) => {
            let message = json!({ "direction": "", "topic": "", "retained": false, "payload": "", "payload_hex": "" });
            ("mqtt.Message", message)
        }
        topic => (topic, with(&message.body, "error", json!({ "error": "", "text": "" }))),
    };
    (name.to_owned(), schema_of(&members))
}

/// One of the samples that schemas are made of: what can come, each with a value of its type.
fn command() -> Value {
    let failure = json!({ "cause": "", "error": "", "kind": "", "code": 0, "text": "" });
    let variable = json!({ "name": "", "size": 0, "type": "" });
    json!({
        "unix_ms": 0,
        "by": { "origin": "", "uid": 0, "pid": 0, "program": "", "name": "", "role": "" },
        "question": { "ask": "", "node": "", "function": "", "arguments": [variable] },
        "outcome": { "answer": "", "node": "", "id": 0, "results": [variable], "took_us": 0, "error": failure, "expired": false },
    })
}

fn node() -> Value {
    json!({
        "name": "", "id": 0, "role": "", "connected": true, "expected": true, "address": "", "version": 0, "epoch": "",
        "connected_ms": 0, "left_ms": 0, "left_reason": "", "left_text": "", "searched_ms": 0, "searched_from": "",
        "functions": 0,
        "limits": { "message_size": 0, "chunk_size": 0, "calls": 0, "minimum_interval_us": 0 },
        "link": {
            "silent_ms": 0, "calls": 0, "calls_here": 0, "queued_bytes": 0, "stream_ms": 0, "datagrams": "", "segment": 0,
            "cipher": "",
        },
        "clock": { "offset_us": 0, "error_us": 0, "age_ms": 0 },
    })
}

fn order() -> Value {
    json!({
        "node": "", "id": 0, "function": "", "order": "", "holder": 0, "trace": "", "claim": [0], "left_ms": 0, "age_ms": 0,
        "inhibited": { "by": 0, "reason": 0 },
    })
}

fn with(sample: &Value, name: &str, value: Value) -> Value {
    let mut sample = sample.clone();
    if let Value::Object(members) = &mut sample {
        members.entry(name).or_insert(value);
    }
    sample
}

/// The schema that a sample follows.
fn schema_of(sample: &Value) -> Value {
    match sample {
        Value::Object(members) => {
            let members: Map<String, Value> =
                members.iter().map(|(name, value)| (name.clone(), schema_of(value))).collect();
            json!({ "type": "object", "properties": members })
        }
        Value::Array(elements) => {
            json!({ "type": "array", "items": elements.first().map_or_else(|| json!({ "type": "object" }), schema_of) })
        }
        Value::String(_) => json!({ "type": "string" }),
        Value::Bool(_) => json!({ "type": "boolean" }),
        Value::Number(number) if number.is_f64() => json!({ "type": "number" }),
        Value::Number(_) | Value::Null => json!({ "type": "integer" }),
    }
}
