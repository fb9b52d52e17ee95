//! What operators have had a unit do: one line of JSON for each order, stop, reset, take-over and refusal, at the end of a file.
//!
//! | key | |
//! |---|---|
//! | `at_ms` | milliseconds since 1970 |
//! | `uid`, `pid`, `program` | who asked through the control socket |
//! | `ask`, `function` | what for; `function` of calls alone |
//! | `take_over` | `true` where an order of another unit, or of this unit's program, was to give way |
//! | `node` | of which node, as far as one has answered |
//! | `outcome` | `ok`, `ended`, `expired`, the error's name, or `gone` where the client went before the answer |

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::OpenOptionsExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{SystemTime, UNIX_EPOCH};

use rustix::net::sockopt::socket_peercred;
use serde_json::{Value, json};

use super::protocol::{Answer, CallQuestion, Question};
use crate::locks::lock;
use crate::seldom::warn_seldom;

/// A longer file is put aside, and the one before it is dropped: twice as much is kept.
const LONGEST: u64 = 4 * 1024 * 1024;

/// The file, which only its owner can read.
#[derive(Debug)]
pub(crate) struct Audit {
    path: PathBuf,
    longest: u64,
    file: Mutex<Option<File>>,
}

impl Audit {
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        Ok(Self { path: path.to_owned(), longest: LONGEST, file: Mutex::new(Some(Self::append_to(path)?)) })
    }

    fn append_to(path: &Path) -> io::Result<File> {
        OpenOptions::new().append(true).create(true).mode(0o600).open(path)
    }

    fn write(&self, entry: &Value) {
        if let Err(error) = self.try_write(entry) {
            // What an operator wants does not wait for a disk: a stop least of all.
            warn_seldom!(%error, path = %self.path.display(), "a line of the audit log is lost");
        }
    }

    fn try_write(&self, entry: &Value) -> io::Result<()> {
        let mut place = lock(&self.file);
        let mut file = match place.take() {
            Some(file) if file.metadata()?.len() < self.longest => file,
            Some(_) => {
                std::fs::rename(&self.path, self.path.with_added_extension("1"))?;
                Self::append_to(&self.path)?
            }
            None => Self::append_to(&self.path)?,
        };
        // In one piece: a line of another process that has the file open as well comes before it or behind it.
        let written = file.write_all(format!("{entry}\n").as_bytes());
        *place = Some(file);
        written
    }
}

/// Who asks, as far as the system tells.
#[derive(Debug)]
pub(super) struct Who {
    uid: u32,
    pid: i32,
    program: String,
}

impl Who {
    pub(super) fn of(stream: &UnixStream) -> io::Result<Self> {
        let credentials = socket_peercred(stream.as_fd())?;
        let (uid, pid) = (credentials.uid.as_raw(), credentials.pid.as_raw_nonzero().get());
        let program = std::fs::read_to_string(format!("/proc/{pid}/comm")).unwrap_or_default();
        Ok(Self { uid, pid, program: program.trim_end().to_owned() })
    }
}

/// What a question asks for.
#[derive(Clone, Copy)]
struct Asked<'q> {
    ask: &'static str,
    call: Option<&'q CallQuestion>,
    node: Option<&'q String>,
}

impl<'q> Asked<'q> {
    /// `None` for a question that only looks.
    fn of(question: &'q Question) -> Option<Self> {
        let of_node = |ask, node| Some(Self { ask, call: None, node });
        let of_call = |ask, call: &'q CallQuestion| Some(Self { ask, call: Some(call), node: call.node.as_ref() });
        match question {
            Question::Call(call) => of_call("call", call),
            Question::Hold(call) => of_call("hold", call),
            Question::Bench { call, .. } => of_call("bench", call),
            Question::Stop { node } => of_node("stop", node.as_ref()),
            Question::Reset { node } => of_node("reset", node.as_ref()),
            Question::Publish { node, .. } => of_node("publish", node.as_ref()),
            Question::Set { node, .. } => of_node("set", node.as_ref()),
            Question::Retire { node } => of_node("retire", Some(node)),
            Question::Unit
            | Question::Nodes { .. }
            | Question::Search
            | Question::Functions { .. }
            | Question::Orders { .. }
            | Question::Watch
            | Question::Counters { .. }
            | Question::Metrics
            | Question::Ping { .. } => None,
        }
    }
}

/// One question that changes something, and what comes of it.
pub(super) struct Entry<'a> {
    audit: &'a Audit,
    who: &'a Who,
    asked: Asked<'a>,
    is_told: bool,
}

impl<'a> Entry<'a> {
    /// `None` for a question that only looks.
    pub(super) fn of(audit: &'a Audit, who: &'a Who, question: &'a Question) -> Option<Self> {
        Some(Self { audit, who, asked: Asked::of(question)?, is_told: false })
    }

    /// An answer on its way to the operator.
    pub(super) fn note(&mut self, answer: &Answer) {
        match answer {
            Answer::Called { node, id, error, .. } => {
                let outcome = error.as_ref().map_or("ok", |failure| failure.error.as_str());
                self.tell(Some(format!("{node}/{id}")), outcome);
            }
            Answer::Ended { expired } => self.tell(None, if *expired { "expired" } else { "ended" }),
            Answer::Failed(failure) => self.tell(None, &failure.error),
            Answer::Done if !self.is_told => self.tell(None, "ok"),
            _ => {}
        }
    }

    fn tell(&mut self, node: Option<String>, outcome: &str) {
        self.is_told = true;
        let Asked { ask, call, node: asked_of } = self.asked;
        let at = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let Who { uid, pid, program } = self.who;
        self.audit.write(&json!({
            "at_ms": at.as_millis() as u64, "uid": uid, "pid": pid, "program": program,
            "ask": ask, "function": call.map(|call| &call.function), "take_over": call.is_some_and(|call| call.take_over),
            "node": node.as_ref().or(asked_of), "outcome": outcome,
        }));
    }
}

impl Drop for Entry<'_> {
    fn drop(&mut self) {
        if !self.is_told {
            self.tell(None, "gone");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(path: &Path) -> Vec<Value> {
        let text = std::fs::read_to_string(path).unwrap();
        text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }

    #[test]
    fn each_outcome_is_a_line_and_what_has_none_is_told_as_gone() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit");
        let audit = Audit::open(&path).unwrap();
        let who = Who { uid: 7, pid: 8, program: "cara".to_owned() };
        let stop = Question::Stop { node: None };
        let called = |id, error| Answer::Called {
            node: "agv".to_owned(),
            id,
            results: Vec::new(),
            call: None,
            error,
            took_us: 1,
        };
        let mut entry = Entry::of(&audit, &who, &stop).unwrap();
        entry.note(&called(1, None));
        entry.note(&called(2, Some(super::super::protocol::Failure::configuration("NoStop", "it has none"))));
        entry.note(&Answer::Done);
        drop(entry);
        drop(Entry::of(&audit, &who, &stop));
        assert!(Entry::of(&audit, &who, &Question::Watch).is_none(), "it only looks");
        let told: Vec<_> = lines(&path).iter().map(|line| [line["node"].clone(), line["outcome"].clone()]).collect();
        let expected = [("agv/1", "ok"), ("agv/2", "NoStop")].map(|(node, outcome)| [json!(node), json!(outcome)]);
        assert_eq!(told[..2], expected);
        assert_eq!(told[2..], [[Value::Null, json!("gone")]]);
        assert_eq!((&lines(&path)[0]["ask"], &lines(&path)[0]["uid"]), (&json!("stop"), &json!(7)));
    }

    #[test]
    fn a_long_file_is_put_aside_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit");
        let audit = Audit { longest: 100, ..Audit::open(&path).unwrap() };
        for number in 0..40 {
            audit.write(&json!({ "number": number, "text": "as long as half of the file that is kept" }));
        }
        let [before, now] = [path.with_added_extension("1"), path.clone()].map(|path| lines(&path));
        assert_eq!(now.last().unwrap()["number"], 39);
        assert_eq!(now[0]["number"].as_u64().unwrap(), before.last().unwrap()["number"].as_u64().unwrap() + 1);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
    }

    #[test]
    fn what_cannot_be_written_is_no_end_and_is_tried_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("audit");
        let audit = Audit { longest: 1, ..Audit::open(&path).unwrap() };
        audit.write(&json!(1));
        std::fs::remove_file(&path).unwrap();
        audit.write(&json!(2));
        audit.write(&json!(3));
        assert_eq!(lines(&path), [json!(3)]);
    }
}
