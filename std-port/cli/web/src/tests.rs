//! The server over real connections, with a unit that answers as it is told.

mod crowd;

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use cara_std::control::Role;
use cara_std::control::protocol::{Answer, Failure, Question};
use serde_json::{Value, json};

use crate::limits::{BODY, CALLS, PAGES};
use crate::start::{Prepared, prepare};
use crate::{Arguments, Beat, Cancel, Connection, Unit, server};

const TOKEN: &str = "0123456789abcdef0123456789abcdef";
const PATIENCE: Duration = Duration::from_secs(30);

/// A manager with one node. A call of `wait` is answered once the test says so, or never.
struct Fake {
    asked: Mutex<Sender<Question>>,
    go: Arc<Mutex<Receiver<()>>>,
    is_gone: AtomicBool,
    /// It knows no users.
    is_old: Arc<AtomicBool>,
    beats: Arc<AtomicUsize>,
}

struct Way {
    asked: Sender<Question>,
    go: Arc<Mutex<Receiver<()>>>,
    wanted: Arc<AtomicBool>,
    is_old: Arc<AtomicBool>,
    beats: Arc<AtomicUsize>,
}

impl Unit for Fake {
    fn connect(&self, _: bool) -> anyhow::Result<Box<dyn Connection>> {
        anyhow::ensure!(!self.is_gone.load(Ordering::Acquire), "no unit answers");
        let (asked, wanted) = (self.asked.lock().unwrap().clone(), Arc::new(AtomicBool::new(true)));
        Ok(Box::new(Way { asked, go: self.go.clone(), wanted, is_old: self.is_old.clone(), beats: self.beats.clone() }))
    }

    fn findings(&self, _: Duration) -> anyhow::Result<Value> {
        Ok(json!({ "findings": [{ "id": "full" }], "listened_ms": 5 }))
    }

    fn logs(&self) -> crate::Logs {
        Box::new(|answer| vec![answer])
    }

    fn managers(&self, _: Duration) -> anyhow::Result<Value> {
        anyhow::ensure!(!self.is_gone.load(Ordering::Acquire), "no survey");
        Ok(
            json!({ "rows": [{ "cells": ["depot/1", "7", "agv/1", "connected"], "kind": "" }], "remarks": ["silent"], "more": 1 }),
        )
    }
}

impl Connection for Way {
    fn ask(&mut self, question: &Question, each: &mut dyn FnMut(Answer) -> ControlFlow<()>) -> anyhow::Result<()> {
        let called = |error| Answer::Called {
            node: "agv".into(),
            id: 1,
            results: Vec::new(),
            call: None,
            error,
            took_us: 7,
            functions: Vec::new(),
        };
        match question {
            Question::Nodes { .. } => {
                let node = json!({
                    "answer": "node", "name": "agv", "id": 1, "role": "s_unit", "connected": true, "expected": true,
                    "address": null, "version": 1, "epoch": "a", "connected_ms": 5, "limits": null, "functions": 1,
                    "clock": { "offset_us": -300_000, "error_us": 50, "age_ms": 7 },
                });
                let _ = each(serde_json::from_value(node)?);
            }
            Question::Streams { .. } => {
                let value = json!({
                    "answer": "value", "node": "agv/1", "stream": "pose(place: float[2], at: int[2], load: {id: int, kg: float})", "unix_ms": 0, "age_us": 0,
                    "error": null, "values": [
                        { "name": "place", "size": 2, "type": "float", "value": [1.5, 2.0] },
                        { "name": "at", "size": 2, "type": "int", "value": [1, 2] },
                        { "name": "load", "size": 1, "type": "record", "value": { "id": 1460549358372198212_i64, "a": 1.0 } },
                    ],
                });
                let _ = each(serde_json::from_value(value)?);
                std::thread::sleep(PATIENCE);
            }
            Question::Watch => std::thread::sleep(PATIENCE),
            Question::Call(call) | Question::Hold(call) => {
                self.asked.send(question.clone())?;
                while call.function == "wait" && self.go.lock().unwrap().try_recv().is_err() {
                    anyhow::ensure!(self.wanted.load(Ordering::Acquire), "the connection was closed");
                    std::thread::sleep(Duration::from_millis(5));
                }
                let _ = each(called(None));
            }
            Question::As { .. } => {
                self.asked.send(question.clone())?;
                if self.is_old.load(Ordering::Acquire) {
                    let _ = each(Answer::Failed(Failure::configuration("BadQuestion", "the line is no question")));
                    return Ok(());
                }
            }
            Question::Reset { .. } => self.asked.send(question.clone())?,
            Question::Stop { .. } => {
                self.asked.send(question.clone())?;
                let _ = each(called(Some(Failure::configuration("NoStop", "it has none"))));
            }
            Question::Functions { node } => {
                if node == "hung" {
                    std::thread::sleep(PATIENCE * 2);
                }
                let function = json!({ "answer": "function", "name": "f", "signature": "f(a: int)", "lease_us": 5 });
                let _ = each(serde_json::from_value(function)?);
            }
            _ => {}
        }
        let _ = each(Answer::Done);
        Ok(())
    }

    fn beats(&mut self) -> anyhow::Result<Beat> {
        let beats = self.beats.clone();
        Ok(Box::new(move || {
            beats.fetch_add(1, Ordering::AcqRel);
        }))
    }

    fn cancel(&self) -> anyhow::Result<Cancel> {
        let wanted = self.wanted.clone();
        Ok(Box::new(move || wanted.store(false, Ordering::Release)))
    }
}

/// A server, what it asked of its unit, and what lets waiting calls go on.
struct Stage {
    address: SocketAddr,
    asked: Receiver<Question>,
    go: Sender<()>,
    unit: Arc<Fake>,
    _folder: tempfile::TempDir,
}

fn arguments() -> Arguments {
    let listen = ([127, 0, 0, 1], 0).into();
    Arguments {
        listen,
        token_file: None,
        cert: None,
        key: None,
        host_name: Vec::new(),
        origin: Vec::new(),
        background: None,
    }
}

fn stage() -> Stage {
    stage_with(|arguments, _| arguments)
}

fn stage_with(change: impl FnOnce(Arguments, &std::path::Path) -> Arguments) -> Stage {
    let folder = tempfile::tempdir().unwrap();
    let token = secret(folder.path(), "token", TOKEN);
    let prepared = prepare(change(Arguments { token_file: Some(token), ..arguments() }, folder.path())).unwrap();
    let address = prepared.listener.local_addr().unwrap();
    let ((asked, has_asked), (go, goes)) = (channel(), channel());
    let go_on = Arc::new(Mutex::new(goes));
    let (is_gone, is_old, beats) = (AtomicBool::new(false), Arc::default(), Arc::default());
    let unit = Arc::new(Fake { asked: Mutex::new(asked), go: go_on, is_gone, is_old, beats });
    let own = unit.clone();
    std::thread::spawn(move || server::serve(prepared, own));
    Stage { address, asked: has_asked, go, unit, _folder: folder }
}

/// A file that its owner alone may read.
fn secret(folder: &std::path::Path, name: &str, text: &str) -> std::path::PathBuf {
    use std::os::unix::fs::OpenOptionsExt;
    let path = folder.join(name);
    let mut file = std::fs::OpenOptions::new().write(true).create(true).truncate(true).mode(0o600).open(&path).unwrap();
    file.write_all(text.as_bytes()).unwrap();
    path
}

impl Stage {
    /// Sends a request, as the page does unless `headers` has them otherwise.
    fn send(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &str) -> TcpStream {
        let mut stream = TcpStream::connect(self.address).unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let (host, bearer) = (self.address.to_string(), format!("Bearer {TOKEN}"));
        let origin = format!("http://{host}");
        let own = [("host", &*host), ("origin", &*origin), ("x-cara", "1"), ("authorization", &*bearer)];
        let mut text = format!("{method} {path} HTTP/1.1\r\nconnection: close\r\ncontent-length: {}\r\n", body.len());
        let others = own.iter().filter(|(name, _)| !headers.iter().any(|(other, _)| other == name));
        for (name, value) in others.chain(headers).filter(|(_, value)| !value.is_empty()) {
            text += &format!("{name}: {value}\r\n");
        }
        let _ = write!(stream, "{text}\r\n{body}");
        stream
    }

    fn answer(&self, method: &str, path: &str, headers: &[(&str, &str)], body: &str) -> String {
        let mut text = String::new();
        let _ = self.send(method, path, headers, body).read_to_string(&mut text);
        text
    }

    fn post(&self, path: &str, body: &Value) -> String {
        self.answer("POST", path, &[], &body.to_string())
    }

    /// Reads pushed messages until one of them fits.
    fn follow(&self, fits: impl FnMut(&Value) -> bool) -> TcpStream {
        self.follow_as(&format!("Bearer {TOKEN}"), fits)
    }

    fn follow_as(&self, bearer: &str, mut fits: impl FnMut(&Value) -> bool) -> TcpStream {
        let mut stream = self.send("GET", "/api/stream", &[("authorization", bearer)], "");
        let (mut text, mut piece) = (Vec::new(), [0; 4096]);
        loop {
            let read = stream.read(&mut piece).unwrap();
            assert!(read > 0, "{}", String::from_utf8_lossy(&text));
            text.extend_from_slice(&piece[..read]);
            let lossy = String::from_utf8_lossy(&text).into_owned();
            let messages =
                lossy.split("data: ").skip(1).filter_map(|part| serde_json::from_str(part.split("\n\n").next()?).ok());
            if messages.into_iter().any(|message: Value| fits(&message)) {
                return stream;
            }
        }
    }
}

fn call(function: &str, hold: bool) -> Value {
    json!({
        "node": "agv/1", "function": function, "arguments": [], "asynchronous": false, "timeout_ms": null, "priority": null,
        "best_effort": false, "hold": hold,
    })
}

fn starts(answer: &str, status: u16) -> bool {
    answer.starts_with(&format!("HTTP/1.1 {status} "))
}

#[test]
fn the_page_is_whole_and_names_nothing_from_elsewhere() {
    let stage = stage();
    for (name, kind, text) in crate::page::FILES {
        let got = stage.answer("GET", &format!("/{name}"), &[("authorization", ""), ("origin", "")], "");
        assert!(
            starts(&got, 200) && got.ends_with(text) && got.contains(&format!("content-type: {kind}\r\n")),
            "{name}: {got}"
        );
        assert!(got.contains("content-security-policy: default-src 'none'; script-src 'self';"), "{got}");
        assert!(
            got.contains("x-content-type-options: nosniff\r\n") && got.contains("cache-control: no-store\r\n"),
            "{got}"
        );
        let foreign = text.replace("http://www.w3.org/2000/svg", "").contains("://");
        assert!(
            !foreign && !text.contains("innerHTML") && !text.contains(" style=") && !text.contains("eval("),
            "{name}"
        );
        let named = text.split(['"', '\'']).filter_map(|word| word.strip_prefix("./"));
        named.for_each(|file| {
            assert!(crate::page::FILES.iter().any(|(known, ..)| *known == file), "{name} names {file}")
        });
    }
    let bytes: usize = crate::page::FILES.iter().map(|(_, _, text)| text.len()).sum();
    assert!(bytes < 100_000, "{bytes} bytes for the first load");
    assert!(starts(&stage.answer("GET", "/nothing.js", &[], ""), 404));
}

#[test]
fn other_sites_and_strangers_are_refused_and_counted() {
    let stage = stage();
    let stop = |headers: &[(&str, &str)]| stage.answer("POST", "/api/stop", headers, "{\"node\":null}");
    assert!(starts(&stop(&[("host", "evil.example")]), 421));
    for wrong in [("origin", "http://evil.example"), ("origin", ""), ("x-cara", ""), ("sec-fetch-site", "cross-site")] {
        assert!(starts(&stop(&[wrong]), 403), "{wrong:?}");
    }
    for wrong in ["", "Bearer x", &format!("Bearer {TOKEN}0")] {
        assert!(starts(&stop(&[("authorization", wrong)]), 401), "{wrong}");
    }
    for path in ["/api/stream", "/api/map"] {
        assert!(starts(&stage.answer("GET", path, &[("authorization", "")], ""), 401), "{path}");
    }
    assert!(stage.asked.try_recv().is_err(), "none of it came to the unit");
    let right = stop(&[]);
    assert!(starts(&right, 200) && right.contains("\"error\":\"NoStop\""), "a stop that fails says so: {right}");
    assert!(matches!(stage.asked.recv_timeout(PATIENCE), Ok(Question::Stop { node: None, .. })));
    stage.follow(|message| {
        let Some(limits) = message["limits"]["rows"][""].as_array() else { return false };
        let refused = |what: &str| {
            let limit = limits.iter().find(|limit| limit["name"].as_str().unwrap().contains(what));
            limit.unwrap()["refused"].as_u64().unwrap()
        };
        (refused("host name"), refused("another site"), refused("token")) == (1, 4, 5)
    });
}

const USERS: &str = "stop gate 0123456789abcdef-gate\nsee lobby 0123456789abcdef-lobby\n\
                     operate anna 0123456789abcdef-anna\nreset bert 0123456789abcdef-bert\n";

fn stage_of_users() -> Stage {
    stage_with(|arguments, folder| Arguments { token_file: Some(secret(folder, "users", USERS)), ..arguments })
}

fn of(name: &str) -> String {
    format!("Bearer 0123456789abcdef-{name}")
}

/// The manager decides, by `Role::permit`; what it is not asked, the server decides.
#[test]
fn the_manager_is_told_who_asks_and_every_user_may_stop() {
    let stage = stage_of_users();
    let users = [("gate", Role::Stop), ("lobby", Role::See), ("anna", Role::Operate), ("bert", Role::Reset)];
    for (name, role) in users {
        let bearer = of(name);
        let post = |path: &str, body: &Value| {
            let answer = stage.answer("POST", path, &[("authorization", &bearer)], &body.to_string());
            assert!(starts(&answer, 200), "{name} {path}: {answer}");
        };
        let asked = || stage.asked.recv_timeout(PATIENCE).unwrap();
        let is_told = || assert_eq!(asked(), Question::As { name: name.to_owned(), role });
        post("/api/stop", &json!({ "node": null }));
        is_told();
        assert!(matches!(asked(), Question::Stop { node: None, .. }));
        post("/api/reset", &json!({ "node": "agv/1" }));
        is_told();
        assert!(matches!(asked(), Question::Reset { .. }));
        post("/api/call", &call("f", false));
        is_told();
        assert!(matches!(asked(), Question::Call(_)));
        post("/api/call", &call("f", true));
        is_told();
        assert!(matches!(asked(), Question::Hold(_)));
        post("/api/functions", &json!({ "node": "agv/1" }));
        is_told();
        let ready = stage.answer("POST", "/api/ready", &[("authorization", &bearer)], "{}");
        assert!(starts(&ready, 204), "{name}: {ready}");
        let status = if role == Role::Stop { 403 } else { 200 };
        for (method, path) in [("GET", "/api/map"), ("POST", "/api/doctor"), ("POST", "/api/managers")] {
            let answer = stage.answer(method, path, &[("authorization", &bearer)], "{}");
            assert!(starts(&answer, status), "{name} {path}: {answer}");
        }
    }
    let stranger = stage.answer("POST", "/api/stop", &[], "{\"node\":null}");
    assert!(starts(&stranger, 401) && stage.asked.try_recv().is_err(), "the only token of other tests: {stranger}");
}

#[test]
fn a_page_is_told_its_role_and_what_that_sees() {
    let stage = stage_of_users();
    let told = |name: &str, fits: &dyn Fn(&Value) -> bool| drop(stage.follow_as(&of(name), fits));
    told("lobby", &|message| {
        assert_eq!(message["me"], json!({ "name": "lobby", "role": "see" }));
        !message["values"]["rows"]["1"].is_null()
    });
    told("gate", &|message| {
        let seen =
            message.as_object().unwrap().keys().all(|key| ["now", "me", "link", "unit", "nodes"].contains(&&**key));
        assert!(seen, "{message}");
        message["nodes"]["rows"]["agv/1@s_unit"]["connected"] == true
    });
}

#[test]
fn nobody_elses_page_keeps_a_hold() {
    let stage = stage_of_users();
    let _held = stage.send("POST", "/api/call", &[("authorization", &of("anna"))], &call("wait", true).to_string());
    while !matches!(stage.asked.recv_timeout(PATIENCE), Ok(Question::Hold(_))) {}
    let beat = |name: &str| stage.answer("POST", "/api/beat", &[("authorization", &of(name))], "{\"hold\":1}");
    assert!(starts(&beat("bert"), 410));
    assert_eq!(stage.unit.beats.load(Ordering::Acquire), 0);
    assert!(starts(&beat("anna"), 204) || starts(&beat("anna"), 410), "unless this host was too slow");
}

#[test]
fn a_manager_that_knows_no_users_is_stopped_and_asked_nothing_else() {
    let stage = stage_of_users();
    stage.unit.is_old.store(true, Ordering::Release);
    let bearer = of("bert");
    let post = |path: &str, body: Value| stage.answer("POST", path, &[("authorization", &bearer)], &body.to_string());
    for (path, body) in [("/api/call", call("f", false)), ("/api/reset", json!({ "node": null }))] {
        let refused = post(path, body);
        assert!(refused.contains("not newer than it"), "{refused}");
    }
    assert!(post("/api/stop", json!({ "node": null })).contains("called"));
    let asked: Vec<_> = std::iter::from_fn(|| stage.asked.try_recv().ok()).collect();
    let changes = asked.iter().filter(|question| !matches!(question, Question::As { .. }));
    assert!(matches!(changes.collect::<Vec<_>>()[..], [Question::Stop { .. }]), "{asked:?}");
}

/// With what a stop needs, and without doing anything.
#[test]
fn a_page_is_ready_once_a_stop_would_pass() {
    let stage = stage_with(|arguments, _| Arguments {
        origin: vec!["https://fleet.example/hall/".parse().unwrap()],
        ..arguments
    });
    let ready = |headers: &[(&str, &str)]| stage.answer("POST", "/api/ready", headers, "{}");
    let proxied = ("origin", "https://fleet.example");
    assert!(starts(&ready(&[]), 204) && starts(&ready(&[proxied, ("host", "fleet.example")]), 204));
    assert!(starts(&ready(&[proxied]), 204), "a proxy may name the server as it reaches it");
    for wrong in [("origin", "https://other.example"), ("x-cara", ""), ("sec-fetch-site", "cross-site")] {
        let refused = ready(&[wrong]);
        assert!(starts(&refused, 403) && refused.contains("--origin"), "{wrong:?}: {refused}");
    }
    assert!(starts(&ready(&[("authorization", "")]), 401) && starts(&ready(&[("host", "evil.example")]), 421));
    assert!(starts(&stage.answer("GET", "/api/ready", &[], ""), 405));
    // What Chromium sends with a module script, behind a proxy that ends TLS.
    let script = stage.answer("GET", "/main.js", &[proxied, ("authorization", "")], "");
    assert!(starts(&script, 200) && script.contains("content-length: "), "{script}");
    assert!(stage.asked.try_recv().is_err(), "none of it came to the unit");
}

/// Below any path: a proxy takes that away.
#[test]
fn the_page_names_no_path_from_the_root() {
    for (name, _, text) in crate::page::FILES {
        for start in ["\"/", "'/", "`/"] {
            let paths: Vec<_> =
                text.match_indices(start).map(|(at, _)| text[at..].chars().take(20).collect::<String>()).collect();
            // Keys, and what is no path.
            let paths: Vec<_> =
                paths.iter().filter(|path| path.chars().nth(2).is_some_and(char::is_alphabetic)).collect();
            assert!(paths.is_empty(), "{name}: {paths:?}");
        }
    }
}

/// Not in the order of their names, which would have a vehicle drawn where `at` is.
#[test]
fn values_of_a_stream_come_in_the_order_of_its_signature() {
    stage().follow(|message| {
        let value = &message["values"]["rows"]["1"];
        let load = "{\n  \"id\": 1460549358372198212,\n  \"a\": 1.0\n}";
        let right = json!([["place", [1.5, 2.0]], ["at", ["1", "2"]], ["load", load, true]]);
        assert!(value.is_null() || value[2] == right, "{value}");
        !value.is_null()
    });
}

#[test]
fn what_is_asked_wrongly_is_told() {
    let stage = stage();
    assert!(starts(&stage.answer("POST", "/api/call", &[], "{"), 400));
    assert!(stage.post("/api/call", &json!({ "function": 5 })).contains("BadCall"));
    assert!(stage.post("/api/stop", &json!({})).contains("BadQuestion"), "no node and not null: not all of them");
    assert!(starts(&stage.post("/api/beat", &json!({ "hold": 99 })), 410));
    assert!(starts(&stage.answer("GET", "/api/stop", &[], ""), 405));
    let long = " ".repeat(BODY + 1);
    assert!(starts(&stage.answer("POST", "/api/call", &[], &long), 413));
    assert!(stage.asked.try_recv().is_err());
}

#[test]
fn pages_are_told_what_is_known_up_to_their_number() {
    let stage = stage();
    let has_node = |message: &Value| message["nodes"]["rows"]["agv/1@s_unit"]["connected"] == true;
    let mut pages: Vec<_> = (0..PAGES).map(|_| stage.follow(has_node)).collect();
    let refused = stage.answer("GET", "/api/stream", &[], "");
    assert!(starts(&refused, 503) && refused.contains("close one"), "{refused}");
    pages.pop();
    // Its place is free once the server has seen its end.
    soon(|| {
        let mut first = [0; 12];
        stage.send("GET", "/api/stream", &[], "").read_exact(&mut first).unwrap();
        &first == b"HTTP/1.1 200"
    });
}

/// Its age changes by itself, and would be told with each look.
#[test]
fn the_page_is_told_how_far_a_clock_is_off() {
    let clock = json!({ "offset_us": -300_000, "error_us": 50, "trouble": "clock 0.300 s behind" });
    stage().follow(|message| message["nodes"]["rows"]["agv/1@s_unit"]["clock"] == clock);
}

/// Waits until something is so.
fn soon(mut is_so: impl FnMut() -> bool) {
    let started = std::time::Instant::now();
    while !is_so() {
        assert!(started.elapsed() < PATIENCE);
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[test]
fn a_manager_that_is_lost_is_told() {
    let stage = stage();
    stage.follow(|message| message["link"]["up"] == true);
    stage.unit.is_gone.store(true, Ordering::Release);
    let stop = stage.post("/api/stop", &json!({ "node": null }));
    assert!(stop.contains("\"failed\"") && stop.contains("no unit answers"), "{stop}");
}

#[test]
fn calls_have_a_limit_and_a_call_whose_page_goes_is_given_up() {
    let stage = stage();
    let held: Vec<_> =
        (0..CALLS).map(|_| stage.send("POST", "/api/call", &[], &call("wait", false).to_string())).collect();
    (0..CALLS).for_each(|_| assert!(matches!(stage.asked.recv_timeout(PATIENCE), Ok(Question::Call(_)))));
    assert!(stage.post("/api/call", &call("f", false)).contains("Busy"));
    assert!(stage.post("/api/stop", &json!({ "node": "agv/1" })).contains("called"), "a stop has places of its own");
    drop(held);
    // The waiting calls are never let go: only their pages' end frees their places.
    soon(|| !stage.post("/api/call", &call("f", false)).contains("Busy"));
}

#[test]
fn a_hold_ends_when_its_page_says_nothing() {
    let stage = stage();
    let reported = stage.post("/api/call", &call("wait", true));
    assert!(reported.contains("\"answer\":\"held\"") && reported.contains("Unattended"), "{reported}");
    assert!(matches!(stage.asked.recv_timeout(PATIENCE), Ok(Question::Hold(_))));
}

#[test]
fn a_hold_goes_on_while_its_page_is_there() {
    let stage = stage();
    let mut stream = stage.send("POST", "/api/call", &[], &call("wait", true).to_string());
    stage.asked.recv_timeout(PATIENCE).unwrap();
    assert_eq!(stage.unit.beats.load(Ordering::Acquire), 0, "the server makes no sign of life up");
    // Twice as long as an unattended one lasts. A host that holds this test up for longer ends it, which is right as well.
    let started = std::time::Instant::now();
    let (mut beaten, mut gap, mut count) = (std::time::Instant::now(), Duration::ZERO, 0);
    while started.elapsed() < crate::asking::ATTENDED * 2 {
        count += usize::from(starts(&stage.post("/api/beat", &json!({ "hold": 1 })), 204));
        gap = gap.max(beaten.elapsed());
        beaten = std::time::Instant::now();
        std::thread::sleep(Duration::from_millis(100));
    }
    assert_eq!(stage.unit.beats.load(Ordering::Acquire), count, "each of the page's is passed on, and no other");
    stage.go.send(()).unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    assert!(text.contains("\"answer\":\"called\"") || gap >= crate::asking::ATTENDED / 2, "{text}");
}

#[test]
fn functions_and_findings_come_in_the_pages_form() {
    let stage = stage();
    let reported = stage.post("/api/functions", &json!({ "node": "agv/1" }));
    assert!(
        reported.contains("\"inputs\":[{\"name\":\"a\",\"size\":1,\"type\":\"int\"}]")
            || reported.contains("\"inputs\":[{\"name\":\"a\",\"type\":\"int\",\"size\":1}]"),
        "{reported}"
    );
    assert!(
        reported.trim_end().ends_with("{\"answer\":\"done\"}") || reported.contains("\"answer\":\"done\""),
        "{reported}"
    );
    assert!(stage.post("/api/doctor", &json!({})).contains("done"));
    stage.follow(|message| message["doctor"]["rows"][""]["findings"][0]["id"] == "full");
    assert!(stage.post("/api/managers", &json!({})).contains("done"));
    stage.follow(|message| {
        let found = &message["managers"]["rows"][""];
        found["rows"][0]["cells"][2] == "agv/1" && found["remarks"][0] == "silent" && found["at"].is_u64()
    });
    stage.unit.is_gone.store(true, Ordering::Release);
    assert!(stage.post("/api/managers", &json!({})).contains("no survey"));
}

fn refused(change: impl FnOnce(&std::path::Path) -> Arguments) -> String {
    let folder = tempfile::tempdir().unwrap();
    prepare(change(folder.path())).err().map(|error| error.to_string()).unwrap_or_default()
}

/// A certificate and its key, as PEM.
fn pair() -> (String, String) {
    let rcgen::CertifiedKey { cert, signing_key } =
        rcgen::generate_simple_self_signed(["depot.example".to_owned()]).unwrap();
    (cert.pem(), signing_key.serialize_pem())
}

#[test]
fn beyond_loopback_a_token_and_tls_are_needed() {
    let open = || ([0, 0, 0, 0], 0).into();
    let (cert, key) = pair();
    let without = refused(|_| Arguments { listen: open(), ..arguments() });
    assert!(without.contains("--token-file token --cert cert.pem --key key.pem"), "{without}");
    let with_token = |folder: &std::path::Path| Some(secret(folder, "token", TOKEN));
    let no_tls = refused(|folder| Arguments { listen: open(), token_file: with_token(folder), ..arguments() });
    assert!(no_tls.contains("give it a token and TLS"), "{no_tls}");
    let tls = |folder: &std::path::Path| (Some(secret(folder, "cert", &cert)), Some(secret(folder, "key", &key)));
    let no_token = refused(|folder| {
        let (cert, key) = tls(folder);
        Arguments { listen: open(), cert, key, ..arguments() }
    });
    assert!(no_token.contains("give it a token and TLS"), "{no_token}");
    let both = refused(|folder| {
        let (cert, key) = tls(folder);
        Arguments { listen: open(), token_file: with_token(folder), cert, key, ..arguments() }
    });
    assert_eq!(both, "");
}

#[test]
fn files_that_cannot_be_used_are_told() {
    use std::os::unix::fs::PermissionsExt;
    let with = |token: &'static str| {
        refused(move |folder| Arguments { token_file: Some(secret(folder, "token", token)), ..arguments() })
    };
    assert!(
        with("short").contains("at least 16")
            && with("with a space in it 0123456789").contains("token:1: this is no role")
    );
    let readable = refused(|folder| {
        let file = secret(folder, "token", TOKEN);
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o640)).unwrap();
        Arguments { token_file: Some(file), ..arguments() }
    });
    assert!(readable.contains("chmod 600"), "{readable}");
    let nonsense = refused(|folder| {
        let file = Some(secret(folder, "pem", "nonsense"));
        Arguments { cert: file.clone(), key: file, ..arguments() }
    });
    assert!(nonsense.contains("certificate") || nonsense.contains("PEM"), "{nonsense}");
    let map = refused(|folder| Arguments { background: Some(secret(folder, "x.map", "type hex\n")), ..arguments() });
    assert!(map.contains("x.map: line 1") && map.contains("octile"), "{map}");
    assert!(
        refused(|folder| Arguments { background: Some(folder.join("none")), ..arguments() }).contains("cannot read")
    );
}

#[test]
fn without_a_token_file_a_key_is_drawn_anew() {
    let url = |prepared: Prepared| prepared.url();
    let (one, two) = (url(prepare(arguments()).unwrap()), url(prepare(arguments()).unwrap()));
    let key = |url: &str| url.split_once("/#").unwrap().1.to_owned();
    assert!(one.starts_with("http://127.0.0.1:") && key(&one).len() == 32 && key(&one) != key(&two), "{one} {two}");
}

#[test]
fn with_tls_nothing_is_served_in_clear_and_bad_handshakes_are_counted() {
    let (cert, key) = pair();
    let stage = stage_with(|arguments, folder| {
        let (cert, key) = (Some(secret(folder, "cert", &cert)), Some(secret(folder, "key", &key)));
        Arguments { cert, key, ..arguments }
    });
    let clear = stage.answer("GET", "/", &[], "");
    assert!(!clear.contains("HTTP/1.1 200"), "{clear}");
    let mut roots = tokio_rustls::rustls::RootCertStore::empty();
    roots.add(der(&cert)).unwrap();
    let provider = Arc::new(tokio_rustls::rustls::crypto::ring::default_provider());
    let config = tokio_rustls::rustls::ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()
        .unwrap();
    let config = Arc::new(config.with_root_certificates(roots).with_no_client_auth());
    let mut session = tokio_rustls::rustls::ClientConnection::new(config, "depot.example".try_into().unwrap()).unwrap();
    let mut stream = TcpStream::connect(stage.address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut secured = tokio_rustls::rustls::Stream::new(&mut session, &mut stream);
    secured.write_all(b"GET / HTTP/1.1\r\nhost: 127.0.0.1\r\nconnection: close\r\n\r\n").unwrap();
    let mut text = String::new();
    let _ = secured.read_to_string(&mut text);
    assert!(starts(&text, 200) && text.contains("<title>CARA</title>"), "{text}");
    secured.conn.send_close_notify();
}

fn der(pem: &str) -> tokio_rustls::rustls::pki_types::CertificateDer<'static> {
    use tokio_rustls::rustls::pki_types::pem::PemObject;
    tokio_rustls::rustls::pki_types::CertificateDer::from_pem_slice(pem.as_bytes()).unwrap()
}
