//! A control socket at which a recording is what a unit would be: it answers what only looks, as it was at the moment that is
//! replayed. `cara top` and `cara web` find it with `--socket`.

use std::collections::BTreeMap;
use std::io::{self, BufRead, BufReader, Read, Write};
use std::os::unix::fs::FileTypeExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use cara_std::control::protocol::{
    Answer, Argument, ArgumentValue, CONTROL_VERSION, Failure, FunctionInfo, Number, Question,
};
use serde::Deserialize;
use serde_json::Value;

use super::layout::FUNCTIONS;
use super::reading::Message;

/// Answers that wait for a client that watches; it loses more.
const WAITING: usize = 1024;
/// Longest question.
const LONGEST_LINE: u64 = 64 * 1024;
/// Connections at a time.
const MOST: usize = 32;
/// A client that takes nothing for so long is cut off.
const PATIENCE: Duration = Duration::from_secs(2);

/// What was so at that moment. Its clones show the same.
#[derive(Clone, Default)]
pub struct Stage(Arc<Mutex<State>>);

#[derive(Default)]
struct State {
    unit: Option<Answer>,
    /// By what they are about.
    nodes: BTreeMap<String, Answer>,
    orders: BTreeMap<String, Answer>,
    counters: BTreeMap<Option<String>, Answer>,
    /// By node.
    functions: BTreeMap<String, Vec<Answer>>,
    /// The last value of each, by node and name.
    streams: BTreeMap<(String, String), Answer>,
    watching: Vec<(Watched, SyncSender<Answer>)>,
    open: usize,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Watched {
    Events,
    Streams,
}

impl Stage {
    /// Listens at a path, at which nothing may be but the socket of a process that has ended.
    pub fn open(&self, path: &Path) -> io::Result<()> {
        let is_left =
            || path.metadata().is_ok_and(|found| found.file_type().is_socket()) && UnixStream::connect(path).is_err();
        let listener = match UnixListener::bind(path) {
            Err(error) if error.kind() == io::ErrorKind::AddrInUse && is_left() => {
                std::fs::remove_file(path)?;
                UnixListener::bind(path)?
            }
            bound => bound?,
        };
        let stage = self.clone();
        std::thread::Builder::new().name("stage".into()).spawn(move || stage.accept(&listener))?;
        Ok(())
    }

    /// Whether it is known whose recording it is, without which nobody can ask.
    pub fn has_unit(&self) -> bool {
        self.lock().unit.is_some()
    }

    /// Shows a message of the recording.
    pub fn show(&self, message: &Message) {
        let mut state = self.lock();
        if message.topic == "/counters" {
            if let Some((node, counters)) = counters_of(&message.body) {
                state.counters.insert(node, counters);
            }
        } else if message.topic == FUNCTIONS {
            if let Some((node, functions)) = functions_of(&message.body) {
                state.functions.insert(node, functions);
            }
        } else if message.topic.starts_with("/streams/") {
            let Some((key, value)) = value_of(&message.body) else { return };
            state.streams.insert(key, value.clone());
            state.report(Watched::Streams, &value);
        } else if let Ok(answer) = serde_json::from_slice(&message.body) {
            match &answer {
                Answer::Unit(_) => state.unit = Some(answer),
                Answer::Node(node) => {
                    let key = format!("{}/{}@{}", node.name, node.id, node.role);
                    state.nodes.insert(key, answer);
                }
                Answer::Order(order) => {
                    let key = format!("{}/{} {}", order.node, order.id, order.function);
                    state.orders.insert(key, answer);
                }
                Answer::Event { .. } => state.report(Watched::Events, &answer),
                _ => {}
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn accept(&self, listener: &UnixListener) {
        for stream in listener.incoming().map_while(Result::ok) {
            if self.lock().open >= MOST {
                continue;
            }
            self.lock().open += 1;
            let stage = self.clone();
            let serve = move || {
                // A client that has gone misses its answer.
                let _ = stage.serve(&stream);
                stage.lock().open -= 1;
            };
            if std::thread::Builder::new().name("client".into()).spawn(serve).is_err() {
                self.lock().open -= 1;
            }
        }
    }

    fn serve(&self, stream: &UnixStream) -> io::Result<()> {
        stream.set_write_timeout(Some(PATIENCE))?;
        let Some(Answer::Unit(unit)) = self.lock().unit.clone() else { return Ok(()) };
        let name = format!("{}/{}", unit.name, unit.id);
        send(stream, &Answer::Hello { control_version: CONTROL_VERSION, unit: name, fleet: unit.fleet, full: false })?;
        let mut lines = BufReader::new(stream);
        loop {
            let mut line = String::new();
            if lines.by_ref().take(LONGEST_LINE).read_line(&mut line)? == 0 {
                return Ok(());
            }
            match serde_json::from_str(&line) {
                Ok(question) => self.answer(stream, &question)?,
                // A sign of life.
                Err(_) if line.trim().is_empty() => {}
                Err(error) => send(stream, &Answer::Failed(Failure::configuration("BadQuestion", error)))?,
            }
        }
    }

    fn answer(&self, stream: &UnixStream, question: &Question) -> io::Result<()> {
        let found: Vec<_> = {
            let mut state = self.lock();
            match question {
                Question::Unit => state.unit.iter().cloned().collect(),
                Question::Nodes { offering: None } => state.nodes.values().cloned().collect(),
                Question::Orders { node: None } => state.orders.values().cloned().collect(),
                Question::Counters { node: None } => state.counters.values().cloned().collect(),
                Question::Functions { node } => {
                    let found = state.functions.iter().find(|(of, _)| is_of(of, node));
                    found.map(|(_, functions)| functions.clone()).unwrap_or_default()
                }
                Question::Stream { node, name: None, .. } => {
                    let of_node = state.streams.iter().filter(|((of, _), _)| of == node);
                    of_node.map(|(_, value)| value.clone()).collect()
                }
                Question::Watch | Question::Streams { .. } => {
                    let watched = if *question == Question::Watch { Watched::Events } else { Watched::Streams };
                    let (sender, answers) = sync_channel(WAITING);
                    // The newest values come first, as a unit sends them.
                    let newest = state.streams.values().filter(|_| watched == Watched::Streams);
                    newest.for_each(|value| drop(sender.try_send(value.clone())));
                    state.watching.push((watched, sender));
                    drop(state);
                    return pass_on(stream, watched, &answers);
                }
                _ => {
                    let text = "this is a recording, which cannot do that";
                    return send(stream, &Answer::Failed(Failure::configuration("Recording", text)));
                }
            }
        };
        found.iter().try_for_each(|answer| send(stream, answer))?;
        send(stream, &Answer::Done)
    }
}

impl State {
    fn report(&mut self, what: Watched, answer: &Answer) {
        self.watching.retain(|(watched, sender)| {
            *watched != what || !matches!(sender.try_send(answer.clone()), Err(TrySendError::Disconnected(_)))
        });
    }
}

fn pass_on(stream: &UnixStream, watched: Watched, answers: &Receiver<Answer>) -> io::Result<()> {
    if watched == Watched::Events {
        let unix_ms = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_millis() as u64;
        let (event, text) = ("watching".to_owned(), "events of a recording".to_owned());
        send(stream, &Answer::Event { at_ms: 0, unix_ms, event, node: None, text })?;
    }
    answers.iter().try_for_each(|answer| send(stream, &answer))
}

fn send(mut stream: &UnixStream, answer: &Answer) -> io::Result<()> {
    let mut line = serde_json::to_vec(answer)?;
    line.push(b'\n');
    stream.write_all(&line)
}

/// Whether a node, NAME/ID, is meant by NAME, NAME/ID or #ID.
fn is_of(node: &str, meant: &str) -> bool {
    node == meant || node.split_once('/').is_some_and(|(name, id)| name == meant || meant.strip_prefix('#') == Some(id))
}

fn functions_of(body: &[u8]) -> Option<(String, Vec<Answer>)> {
    #[derive(Deserialize)]
    struct Functions {
        node: String,
        functions: Vec<FunctionInfo>,
    }
    let Functions { node, functions } = serde_json::from_slice(body).ok()?;
    Some((node, functions.into_iter().map(Answer::Function).collect()))
}

/// Counters, which a recording has by name.
fn counters_of(body: &[u8]) -> Option<(Option<String>, Answer)> {
    let body: Value = serde_json::from_slice(body).ok()?;
    let node = body.get("node").and_then(Value::as_str).map(str::to_owned);
    let counts = body.get("counters")?.as_object()?.iter();
    let counters = counts.filter_map(|(name, count)| Some((name.clone(), count.as_u64()?))).collect();
    Some((node.clone(), Answer::Counters { node, counters }))
}

/// A value of a stream, whose types are those that its text shows.
fn value_of(body: &[u8]) -> Option<((String, String), Answer)> {
    let body: Value = serde_json::from_slice(body).ok()?;
    let text = |key: &str| body.get(key).and_then(Value::as_str).map(str::to_owned);
    let number = |key: &str| body.get(key).and_then(Value::as_u64);
    let (node, stream) = (text("node")?, text("stream")?);
    let values = body.get("values")?.as_object()?.iter().map(|(name, value)| {
        let size = value.as_array().map_or(1, Vec::len) as u32;
        Argument { name: name.clone(), size, value: argument(value) }
    });
    let values = values.collect();
    let key = (node.clone(), stream.split('(').next().unwrap_or_default().to_owned());
    let (unix_ms, age_us) = (number("unix_ms")?, number("age_us"));
    Some((key, Answer::Value { node, stream, unix_ms, age_us, values, error: None }))
}

fn argument(value: &Value) -> ArgumentValue {
    let values = value.as_array().map_or(std::slice::from_ref(value), Vec::as_slice);
    let all = |of: fn(&Value) -> bool| values.iter().all(of);
    let floats = || values.iter().filter_map(Value::as_f64).map(Number::Finite).collect();
    match value {
        Value::String(text) => ArgumentValue::String(text.clone()),
        Value::Object(_) => ArgumentValue::Record(value.clone()),
        _ if all(Value::is_i64) => ArgumentValue::Int(values.iter().filter_map(Value::as_i64).collect()),
        _ if all(Value::is_number) => ArgumentValue::Float(floats()),
        _ if all(Value::is_boolean) => ArgumentValue::Bool(values.iter().filter_map(Value::as_bool).collect()),
        _ => ArgumentValue::List(value.clone()),
    }
}

#[cfg(test)]
mod tests {
    use cara_std::control::Client;

    use super::*;

    fn message(topic: &str, body: &str) -> Message {
        Message { topic: topic.to_owned(), came: 0, body: body.as_bytes().to_vec() }
    }

    #[test]
    fn a_client_finds_what_was_so_and_can_change_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let (stage, path) = (Stage::default(), folder.path().join("stage.sock"));
        let node =
            r#"{"answer":"node","name":"agv","id":7,"role":"s_unit","connected":true,"expected":true,"functions":2}"#;
        let unit = r#"{"answer":"unit","name":"depot","id":1,"role":"m_unit","fleet":9,"version":1,"discovery_port":1,
            "tcp_port":2,"epoch":"0","uptime_ms":1,"interfaces":[],"connected":1,"constraints":{"request_timeout_us":1,
            "minimum_interval_us":0,"maximum_nodes":1,"message_size":1,"chunk_size":1,"keep_alive_us":1,"calls_per_peer":1}}"#;
        for (topic, body) in [
            ("/unit", unit),
            ("/nodes", &node.replace("true", "false")),
            ("/nodes", node),
            ("/counters", r#"{"node":"agv/7","counters":{"RequestsSent":3}}"#),
            (
                "/streams/agv/7/pose",
                r#"{"node":"agv/7","stream":"pose(p: float[2])","unix_ms":5,"age_us":1,"values":{"p":[0.5,1]}}"#,
            ),
            (
                "/functions",
                r#"{"node":"agv/7","functions":[{"name":"go_to","signature":"go_to(x: int)","lease_us":5}]}"#,
            ),
            ("/streams/agv/7/pose", "{}"),
            ("/functions", "[]"),
            ("/nodes", "damaged"),
        ] {
            stage.show(&message(topic, body));
        }
        assert!(stage.has_unit());
        stage.open(&path).unwrap();
        let mut client = Client::connect(&path).unwrap();
        assert_eq!((client.unit().unit.as_str(), client.unit().fleet), ("depot/1", 9));
        let mut ask = |question| client.ask(&question).unwrap().map(Result::unwrap).collect::<Vec<_>>();
        let [Answer::Node(node)] = &ask(Question::Nodes { offering: None })[..] else { panic!("one node") };
        assert!(node.connected && node.functions == 2);
        for node in ["agv", "agv/7", "#7"] {
            let [Answer::Function(function)] = &ask(Question::Functions { node: node.into() })[..] else {
                panic!("{node}")
            };
            assert!(function.name == "go_to" && function.attributes.lease.is_some());
        }
        assert!(ask(Question::Functions { node: "agv-1".into() }).is_empty());
        let counters = vec![("RequestsSent".to_owned(), 3)];
        assert_eq!(ask(Question::Counters { node: None }), [Answer::Counters { node: Some("agv/7".into()), counters }]);
        let [Answer::Value { values, .. }] =
            &ask(Question::Stream { node: "agv/7".into(), name: None, interval_ms: 0 })[..]
        else {
            panic!("one value")
        };
        assert_eq!(values[0].value, ArgumentValue::Float(vec![Number::Finite(0.5), Number::Finite(1.0)]));
        let mut watching = Client::connect(&path).unwrap();
        let mut events = watching.ask(&Question::Watch).unwrap();
        assert!(matches!(events.next(), Some(Ok(Answer::Event { .. }))));
        stage.show(&message("/events", r#"{"answer":"event","at_ms":1,"unix_ms":2,"event":"left","text":"gone"}"#));
        assert!(matches!(events.next(), Some(Ok(Answer::Event { event, .. })) if event == "left"));
        let refused = client.ask(&Question::Stop { node: None }).unwrap().last();
        assert!(format!("{refused:?}").contains("this is a recording"), "{refused:?}");
    }
}
