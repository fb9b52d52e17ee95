//! What operators have had a unit do, and what its own program has moved, stopped and reset: one line of JSON for each order,
//! stop, reset, take-over and refusal, at the end of a file.
//!
//! | key | |
//! |---|---|
//! | `at_ms` | milliseconds since 1970 |
//! | `origin` | `operator`, through the control socket, or `program` |
//! | `uid`, `pid`, `program` | the process that asked |
//! | `name`, `role` | the user, or for whom that process acts, and what they may do; no role of the program |
//! | `ask`, `function` | what for; several functions of a stop or a reset with a comma between them |
//! | `take_over` | `true` where an order of another unit, or of the other origin, was to give way |
//! | `node` | of which node, as far as it is known |
//! | `to` | the manager that it is handed over to |
//! | `outcome` | `ok`, the error's name, or `gone` where the asking ended before the answer; of what was held, how it ended: `ended`, `expired`, `released` by its client, an error; `stopped` where the unit itself was stopped first |

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use cara_core::distribution::function::Attributes;
use cara_core::error::Error;
use rustix::net::sockopt::socket_peercred;
use rustix::process::{getpid, getuid};
use serde_json::{Value, json};

use super::failure::name_of;
use super::location::own_uid;
use super::protocol::{Answer, By, CallQuestion, Failure, Question};
use super::role::{Role, names_of_users};
use crate::LineQueue;
use crate::seldom::warn_seldom;

/// A longer file is put aside, and the one before it is dropped: twice as much is kept.
const LONGEST: u64 = 4 * 1024 * 1024;

/// Of the name for whom a client acts.
const LONGEST_NAME: usize = 64;

/// Of what a client wrote, in bytes.
const LONGEST_TEXT: usize = 256;

/// The log's end of the queue. Whoever notes something watches a client, moves or stops something: none of them waits for a
/// disk.
#[derive(Debug)]
pub(crate) struct Audit {
    lines: LineQueue,
    /// This process.
    own: Who,
}

/// The file, which only its owner can read.
struct LogFile {
    path: PathBuf,
    longest: u64,
    file: Option<File>,
}

impl LogFile {
    fn open(path: &Path, longest: u64) -> io::Result<Self> {
        Ok(Self { path: path.to_owned(), longest, file: Some(Self::append_to(path)?) })
    }

    fn append_to(path: &Path) -> io::Result<File> {
        OpenOptions::new().append(true).create(true).mode(0o600).open(path)
    }

    fn write(&mut self, line: &[u8]) -> io::Result<()> {
        let mut file = match self.file.take() {
            Some(file) if file.metadata()?.len() < self.longest => file,
            Some(_) => {
                std::fs::rename(&self.path, self.path.with_added_extension("1"))?;
                Self::append_to(&self.path)?
            }
            None => Self::append_to(&self.path)?,
        };
        // In one piece: a line of another process that has the file open as well comes before it or behind it.
        let written = file.write_all(line);
        self.file = Some(file);
        written
    }
}

impl Audit {
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        Self::open_up_to(path, LONGEST)
    }

    fn open_up_to(path: &Path, longest: u64) -> io::Result<Self> {
        let mut file = LogFile::open(path, longest)?;
        let lines = LineQueue::new("cara-audit", move |line, _| {
            file.write(line).inspect_err(|error| {
                warn_seldom!(%error, path = %file.path.display(), "a line of the audit log is lost");
            })
        });
        Ok(Self { lines: lines?, own: Who::own() })
    }

    /// Lines that could not be written, or that came faster than the disk takes them.
    pub(crate) fn lost(&self) -> u64 {
        self.lines.lost()
    }

    /// Waits until all lines are written, at most for so long.
    pub(crate) fn flush(&self, at_most: Duration) {
        if !self.lines.flush(at_most) {
            tracing::warn!("the audit log's disk does not answer: its last lines are lost");
        }
    }

    fn write(&self, entry: &Value) {
        let lost = self.lines.lost();
        self.lines.write(format!("{entry}\n").as_bytes());
        if self.lines.lost() > lost {
            warn_seldom!("lines of the audit log are lost: its disk does not take them in time");
        }
    }

    fn append(&self, origin: &str, who: &Who, line: &Line<'_>) {
        self.write(&entry(origin, who, line));
    }
}

fn entry(origin: &str, who: &Who, line: &Line<'_>) -> Value {
    let at = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let Who { uid, pid, program, name, role } = who;
    let Line { ask, function, take_over, node, to, outcome } = line;
    // What a client wrote may be as long as a line of its own: it would push what was logged before out of the file.
    let [function, node, to] =
        [function, node, to].map(|text| text.map(|text| &text[..text.floor_char_boundary(LONGEST_TEXT)]));
    json!({
        "at_ms": at.as_millis() as u64, "origin": origin, "uid": uid, "pid": pid, "program": program, "name": name, "role": role,
        "ask": ask,
        "function": function, "take_over": take_over, "node": node, "to": to, "outcome": outcome,
    })
}

/// Writes down at once what this process does without a unit.
pub(super) fn note(path: &Path, ask: &str, node: &str, outcome: &str) -> io::Result<()> {
    let line = Line { ask, function: None, take_over: false, node: Some(node), to: None, outcome };
    let who = Who { role: Some(Role::Reset), ..Who::own() };
    let entry = entry("operator", &who, &line);
    LogFile::open(path, LONGEST)?.write(format!("{entry}\n").as_bytes())
}

/// What a line tells beside who and when.
struct Line<'l> {
    ask: &'l str,
    function: Option<&'l str>,
    take_over: bool,
    node: Option<&'l str>,
    to: Option<&'l str>,
    outcome: &'l str,
}

/// Who asks, as far as the system tells.
#[derive(Debug)]
pub(super) struct Who {
    uid: u32,
    pid: i32,
    program: String,
    name: Option<String>,
    /// None of a program that asks its own unit.
    role: Option<Role>,
}

impl Who {
    /// Reads no file of a disk, which may hang: names were read before.
    pub(super) fn of(stream: &UnixStream, role: Role, names: &BTreeMap<u32, String>) -> io::Result<Self> {
        let credentials = socket_peercred(stream.as_fd())?;
        let (uid, pid) = (credentials.uid.as_raw(), credentials.pid.as_raw_nonzero().get());
        let program = std::fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
        let program = program.trim_end().to_owned();
        Ok(Self { uid, pid, program, name: names.get(&uid).cloned(), role: Some(role) })
    }

    pub(super) fn role(&self) -> Role {
        self.role.unwrap_or(Role::Reset)
    }

    /// Acts for somebody else from here on. Users that have been given a role cannot, or they would choose the name in the log.
    pub(super) fn act_as(&mut self, name: String, role: Role) -> Result<(), Failure> {
        if self.uid != own_uid() && self.uid != 0 {
            return Err(Failure::configuration("NotAllowed", "only the unit's own user and root act for others"));
        }
        if role > self.role() {
            return Err(Failure::role(self.role(), role));
        }
        if name.is_empty() || name.len() > LONGEST_NAME || name.chars().any(char::is_control) {
            let text = format!("a name has 1 to {LONGEST_NAME} bytes and no control characters");
            return Err(Failure::configuration("BadQuestion", text));
        }
        (self.name, self.role) = (Some(name), Some(role));
        Ok(())
    }

    /// As those that follow commands get it.
    pub(super) fn by(&self) -> By {
        let Self { uid, pid, program, name, role } = self;
        let (origin, program) = ("operator".to_owned(), Some(program.clone()));
        By { origin, uid: Some(*uid), pid: Some(*pid), program, name: name.clone(), role: *role }
    }

    pub(super) fn own() -> Self {
        let (uid, pid) = (getuid().as_raw(), getpid().as_raw_nonzero().get());
        let program = std::fs::read_to_string("/proc/self/comm").unwrap_or_default();
        Self { uid, pid, program: program.trim_end().to_owned(), name: names_of_users().remove(&uid), role: None }
    }
}

/// A call by the unit's own program, and what comes of it.
#[derive(Debug)]
pub(crate) struct ProgramCall {
    audit: Arc<Audit>,
    ask: &'static str,
    function: String,
    take_over: bool,
    node: String,
    is_reported: bool,
}

impl ProgramCall {
    /// `None` for a call that moves, stops and resets nothing. `attributes` are those of the function, if it is known.
    pub(crate) fn of(
        audit: &Arc<Audit>,
        function: &str,
        attributes: Option<Attributes>,
        take_over: bool,
        node: impl FnOnce() -> String,
    ) -> Option<Self> {
        let ask = match attributes {
            Some(Attributes { stop: true, .. }) => "stop",
            Some(Attributes { reset: true, .. }) => "reset",
            Some(Attributes { lease: Some(_), .. }) => "call",
            _ if take_over => "call",
            _ => return None,
        };
        let (audit, function) = (audit.clone(), function.to_owned());
        Some(Self { audit, ask, function, take_over, node: node(), is_reported: false })
    }

    /// Notes how it has ended.
    pub(crate) fn ended(mut self, outcome: Result<(), Error>) {
        let name = outcome.map_or_else(|error| name_of(&error), |()| "ok".to_owned());
        self.append(&name);
    }

    fn append(&mut self, outcome: &str) {
        self.is_reported = true;
        let Self { ask, ref function, take_over, ref node, .. } = *self;
        let line = Line { ask, function: Some(function), take_over, node: Some(node), to: None, outcome };
        self.audit.append("program", &self.audit.own, &line);
    }
}

impl Drop for ProgramCall {
    fn drop(&mut self) {
        if !self.is_reported {
            self.append("gone");
        }
    }
}

/// Whether a question has an [`Entry`].
pub(super) fn changes_something(question: &Question) -> bool {
    Asked::of(question).is_some()
}

/// What a question asks for.
#[derive(Clone, Copy)]
struct Asked<'q> {
    ask: &'static str,
    call: Option<&'q CallQuestion>,
    node: Option<&'q String>,
    /// Of a hand-over.
    to: Option<&'q String>,
    /// What the call starts is kept, and its end is told.
    holds: bool,
}

impl<'q> Asked<'q> {
    /// `None` for a question that only looks.
    fn of(question: &'q Question) -> Option<Self> {
        let of_node = |ask, node| Some(Self { ask, call: None, node, to: None, holds: false });
        let of_call = |ask, call: &'q CallQuestion| {
            Some(Self { ask, call: Some(call), node: call.node.as_ref(), to: None, holds: ask == "hold" })
        };
        match question {
            Question::Call(call) => of_call("call", call),
            Question::Hold(call) => of_call("hold", call),
            Question::Stop { node } => of_node("stop", node.as_ref()),
            Question::Reset { node } => of_node("reset", node.as_ref()),
            Question::Publish { node, .. } => of_node("publish", node.as_ref()),
            Question::Set { node, .. } => of_node("set", node.as_ref()),
            Question::Retire { node } => of_node("retire", Some(node)),
            Question::HandOver { node, to, .. } => {
                Some(Self { ask: "hand-over", call: None, node: Some(node), to: Some(to), holds: false })
            }
            Question::As { .. }
            | Question::Unit
            | Question::Nodes { .. }
            | Question::Search
            | Question::Functions { .. }
            | Question::Orders { .. }
            | Question::Watch
            | Question::Commands
            | Question::Counters { .. }
            | Question::Metrics
            | Question::Stream { .. }
            | Question::Streams { .. }
            | Question::Ping { .. } => None,
        }
    }
}

/// One question that changes something, and what comes of it.
pub(super) struct Entry<'a> {
    audit: &'a Audit,
    who: &'a Who,
    asked: Asked<'a>,
    reported: Report,
}

/// How much of an entry has been told.
enum Report {
    Nothing,
    /// That the node is held, whose end is to be told as well.
    Held(String),
    All,
}

impl<'a> Entry<'a> {
    /// `None` for a question that only looks.
    pub(super) fn of(audit: &'a Audit, who: &'a Who, question: &'a Question) -> Option<Self> {
        Some(Self { audit, who, asked: Asked::of(question)?, reported: Report::Nothing })
    }

    /// An answer on its way to the operator.
    pub(super) fn note(&mut self, answer: &Answer) {
        match answer {
            Answer::Called { node, id, error, functions, .. } => {
                let node = format!("{node}/{id}");
                let outcome = error.as_ref().map_or("ok", |failure| failure.error.as_str());
                let functions = (!functions.is_empty()).then(|| functions.join(","));
                self.append(Some(&node), functions.as_deref(), outcome);
                self.reported = if self.asked.holds && error.is_none() { Report::Held(node) } else { Report::All };
            }
            Answer::Ended { expired } => self.end(if *expired { "expired" } else { "ended" }),
            Answer::Failed(failure) => self.end(&failure.error),
            Answer::Done => {
                if let Report::Nothing = self.reported {
                    self.end("ok");
                }
            }
            _ => {}
        }
    }

    /// No more answers come: the client has gone, or the unit stops.
    pub(super) fn give_up(&mut self, unit_stops: bool) {
        match self.reported {
            Report::All => {}
            _ if unit_stops => self.end("stopped"),
            Report::Nothing => self.end("gone"),
            Report::Held(_) => self.end("released"),
        }
    }

    fn end(&mut self, outcome: &str) {
        match std::mem::replace(&mut self.reported, Report::All) {
            Report::Held(node) => self.append(Some(&node), None, outcome),
            Report::Nothing | Report::All => self.append(None, None, outcome),
        }
    }

    fn append(&self, node: Option<&str>, functions: Option<&str>, outcome: &str) {
        let Asked { ask, call, node: asked_of, to, .. } = self.asked;
        let function = functions.or_else(|| Some(call?.function.as_str()));
        let (node, take_over) = (node.or(asked_of.map(String::as_str)), call.is_some_and(|call| call.take_over));
        self.audit.append(
            "operator",
            self.who,
            &Line { ask, function, take_over, node, to: to.map(String::as_str), outcome },
        );
    }
}

impl Drop for Entry<'_> {
    fn drop(&mut self) {
        self.give_up(false);
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    const LONG: Duration = Duration::from_secs(20);

    fn who() -> Who {
        Who { uid: 7, pid: 8, program: "cara".to_owned(), name: Some("anna".to_owned()), role: Some(Role::Operate) }
    }

    fn lines(path: &Path) -> Vec<Value> {
        let text = std::fs::read_to_string(path).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    #[test]
    fn each_outcome_is_a_line_and_what_has_none_is_told_as_gone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit");
        let audit = Audit::open(&path).unwrap();
        let who = who();
        let stop = Question::Stop { node: None };
        let called = |id, error| Answer::Called {
            node: "agv".to_owned(),
            id,
            results: Vec::new(),
            call: None,
            error,
            took_us: 1,
            functions: vec!["halt".to_owned(), "brake".to_owned()],
        };
        let mut entry = Entry::of(&audit, &who, &stop).unwrap();
        entry.note(&called(1, None));
        entry.note(&called(2, Some(super::super::protocol::Failure::configuration("NoStop", "it has none"))));
        entry.note(&Answer::Done);
        drop(entry);
        drop(Entry::of(&audit, &who, &stop));
        audit.flush(LONG);
        assert!(Entry::of(&audit, &who, &Question::Watch).is_none(), "it only looks");
        let reported: Vec<_> =
            lines(&path).iter().map(|line| [line["node"].clone(), line["outcome"].clone()]).collect();
        let expected = [("agv/1", "ok"), ("agv/2", "NoStop")].map(|(node, outcome)| [json!(node), json!(outcome)]);
        assert_eq!(reported[..2], expected);
        assert_eq!(reported[2..], [[Value::Null, json!("gone")]]);
        let first = &lines(&path)[0];
        assert_eq!((&first["ask"], &first["uid"], &first["origin"]), (&json!("stop"), &json!(7), &json!("operator")));
        assert_eq!(first["function"], "halt,brake");
        assert_eq!((&first["name"], &first["role"]), (&json!("anna"), &json!("operate")));
    }

    #[test]
    fn the_end_of_what_was_held_is_a_line_however_it_ends() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit");
        let audit = Audit::open(&path).unwrap();
        let who = who();
        let hold = Question::Hold(CallQuestion { function: "go".to_owned(), ..CallQuestion::default() });
        let ends: [fn(&mut Entry<'_>); 5] = [
            |entry| entry.note(&Answer::Ended { expired: false }),
            |entry| entry.note(&Answer::Ended { expired: true }),
            |entry| entry.note(&Answer::Failed(super::super::protocol::Failure::configuration("TakenOver", ""))),
            |entry| entry.give_up(true),
            |entry| entry.give_up(false),
        ];
        for end in ends {
            let mut entry = Entry::of(&audit, &who, &hold).unwrap();
            entry.note(&Answer::Called {
                node: "agv".to_owned(),
                id: 1,
                results: Vec::new(),
                call: None,
                error: None,
                took_us: 1,
                functions: Vec::new(),
            });
            end(&mut entry);
            entry.note(&Answer::Done);
        }
        audit.flush(LONG);
        let reported = lines(&path);
        assert!(reported.iter().all(|line| line["node"] == "agv/1" && line["function"] == "go"), "{reported:?}");
        let outcomes: Vec<_> = reported.iter().map(|line| line["outcome"].as_str().unwrap()).collect();
        let expected = ["ended", "expired", "TakenOver", "stopped", "released"].map(|end| ["ok", end]);
        assert_eq!(outcomes, expected.concat());
    }

    #[test]
    fn a_long_file_is_put_aside_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit");
        let audit = Audit::open_up_to(&path, 100).unwrap();
        for number in 0..40 {
            audit.write(&json!({ "number": number, "text": "as long as half of the file that is kept" }));
        }
        audit.flush(LONG);
        let [before, now] = [path.with_added_extension("1"), path.clone()].map(|path| lines(&path));
        assert_eq!(now.last().unwrap()["number"], 39);
        assert_eq!(now[0]["number"].as_u64().unwrap(), before.last().unwrap()["number"].as_u64().unwrap() + 1);
        let kept: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(Result::unwrap).collect();
        let modes: Vec<u32> = kept.iter().map(|file| file.metadata().unwrap().permissions().mode() & 0o777).collect();
        assert_eq!(modes, [0o600; 2], "its owner alone reads what is kept, also behind a change of the file");
    }

    #[test]
    fn what_cannot_be_written_is_no_end_and_is_tried_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit");
        let audit = Audit::open_up_to(&path, 1).unwrap();
        audit.write(&json!(1));
        audit.flush(LONG);
        std::fs::remove_file(&path).unwrap();
        audit.write(&json!(2));
        audit.write(&json!(3));
        audit.flush(LONG);
        assert_eq!(lines(&path), [json!(3)]);
        assert_eq!(audit.lost(), 1);
    }
}
