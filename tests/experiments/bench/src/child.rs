//! The child processes as the scheduler sees them: one line of JSON each way per question.

use std::io::{BufRead, BufReader, Read};
use std::process::{self, ChildStdin, Command, Stdio};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use cara_bench_ends::{CABLE_END, Callers, ClientQuestion, End, answer_all, answer_client, pin};
use cara_processes::cable::Host;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::json;
use std::io::Write;

use crate::counted::under_callgrind;
use crate::peers::{self, Contender};
use crate::share;

/// Characters of what a child says last that are kept, to tell why it ended.
const LAST_WORDS: usize = 300;

/// What a client process of our own is asked.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(untagged)]
pub(crate) enum OwnQuestion {
    Shared(ClientQuestion),
    Share { share: share::Order },
}

/// The client process: makes the calls that each line orders.
pub(crate) fn call(end: &End) -> Result<()> {
    pin::stay_on(end.cpu)?;
    let peer = peers::named(&end.peer)?;
    let mut callers = Callers::new(&*peer, &end.place, &end.address);
    answer_all(|question| match question {
        OwnQuestion::Shared(question) => answer_client(&mut callers, &question),
        OwnQuestion::Share { share } => Ok(json!(share::measure(callers.first()?, &share)?)),
    })
}

/// A question that a child answered with an error; it goes on and can be asked something else.
#[derive(Debug)]
pub(crate) struct Refused(String);

impl std::fmt::Display for Refused {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for Refused {}

/// A child process as the scheduler sees it.
pub(crate) struct Handle {
    process: process::Child,
    questions: Option<ChildStdin>,
    answers: Receiver<String>,
    last_words: Arc<Mutex<String>>,
    /// How long it may take to answer; our own may take what they need.
    patience: Option<Duration>,
    /// How long it may take to end when there are no more questions.
    farewell: Duration,
}

/// What a process needs to end, and what it needs to write a profile before.
const FAREWELLS: [Duration; 2] = [Duration::from_secs(2), Duration::from_secs(60)];

impl Handle {
    /// Starts this program again with `arguments`.
    pub(crate) fn start(arguments: &[String]) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(arguments);
        Self::spawn(command, None)
    }

    /// Starts `role` of a pair, on `host` where there is a cable. What it prints as a service is read and thrown away.
    pub(crate) fn of_pair(role: &str, contender: &Contender, end: &End, host: Option<&Host>) -> Result<Self> {
        let mut command = contender.command()?;
        command.args([role, "--peer", &end.peer, "--run", &end.place.run.to_string(), "--address", &end.address]);
        command.args(end.place.print.then_some("--print"));
        if let Some(host) = host {
            command.env(CABLE_END, host.server().to_string());
        }
        if end.place.client > 0 {
            command.args(["--client", &end.place.client.to_string()]);
        }
        let patience = match contender {
            Contender::Outside(outside) => Some(outside.patience()),
            Contender::Counted(_, folder) => {
                command = under_callgrind(&command, folder);
                None
            }
            Contender::Own(_) => None,
        };
        if patience.is_some() || (end.place.print && role == "serve") {
            command.stderr(Stdio::piped());
        }
        // Children inherit the CPU and the host of the thread that starts them, so a program need not know of either.
        thread::scope(|scope| {
            let starter = scope.spawn(|| {
                pin::stay_on(end.cpu)?;
                host.map_or(Ok(()), |host| host.enter())?;
                Self::spawn(command, patience)
            });
            let mut started = starter.join().expect("starting does not panic")?;
            let is_counted = matches!(contender, Contender::Counted(..));
            started.farewell = FAREWELLS[usize::from(is_counted)];
            Ok(started)
        })
    }

    fn spawn(mut command: Command, patience: Option<Duration>) -> Result<Self> {
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut process = command.spawn().with_context(|| format!("cannot start {:?}", command.get_program()))?;
        let last_words = Arc::new(Mutex::new(String::new()));
        if let Some(said) = process.stderr.take() {
            let kept = last_words.clone();
            thread::spawn(move || listen(said, &kept));
        }
        let questions = process.stdin.take();
        let lines = BufReader::new(process.stdout.take().context("the child has no output")?).lines();
        let (sender, answers) = mpsc::channel();
        thread::spawn(move || lines.map_while(Result::ok).try_for_each(|line| sender.send(line)));
        Ok(Self { process, questions, answers, last_words, patience, farewell: FAREWELLS[0] })
    }

    /// Sends one line.
    pub(crate) fn ask(&mut self, question: &impl Serialize) -> Result<()> {
        let mut line = serde_json::to_string(question)?;
        line.push('\n');
        let questions = self.questions.as_mut().context("the child is being stopped")?;
        questions.write_all(line.as_bytes()).with_context(|| self.end("a child process does not listen any more"))
    }

    /// Waits for one line.
    pub(crate) fn line<T: DeserializeOwned>(&mut self) -> Result<T> {
        let line = match self.patience {
            None => self.answers.recv().map_err(|_| RecvTimeoutError::Disconnected),
            Some(patience) => self.answers.recv_timeout(patience),
        };
        match line {
            Ok(line) => serde_json::from_str(&line).with_context(|| format!("a child process said {line:?}")),
            Err(RecvTimeoutError::Disconnected) => bail!(self.end("a child process ended before it answered")),
            Err(RecvTimeoutError::Timeout) => {
                bail!(self.end(&format!("no answer for {} s", self.patience.unwrap_or_default().as_secs())))
            }
        }
    }

    /// Waits for what came of the last question.
    pub(crate) fn answer<T: DeserializeOwned>(&mut self) -> Result<T> {
        Ok(self.line::<Result<T, String>>()?.map_err(Refused)?)
    }

    /// Sends a question and waits for its answer.
    pub(crate) fn order<T: DeserializeOwned>(&mut self, question: &impl Serialize) -> Result<T> {
        self.ask(question)?;
        self.answer()
    }

    /// The id of its process.
    pub(crate) fn id(&self) -> u32 {
        self.process.id()
    }

    /// There will be no more questions, so it ends.
    pub(crate) fn dismiss(&mut self) {
        drop(self.questions.take());
    }

    /// What happened, with what the child said last.
    fn end(&self, what: &str) -> String {
        // What it said before it ended may still be on its way.
        thread::sleep(Duration::from_millis(50));
        let said = self.last_words.lock().unwrap_or_else(PoisonError::into_inner);
        let last = said.trim().lines().next_back().unwrap_or_default();
        if last.is_empty() { what.to_owned() } else { format!("{what}: {last}") }
    }
}

/// Reads what a child prints, and keeps the end of it.
fn listen(mut said: impl Read, kept: &Mutex<String>) {
    let mut buffer = [0; 1 << 16];
    while let Ok(count @ 1..) = said.read(&mut buffer) {
        let mut kept = kept.lock().unwrap_or_else(PoisonError::into_inner);
        let fresh = buffer.get(count.saturating_sub(LAST_WORDS)..count).unwrap_or_default();
        kept.push_str(&String::from_utf8_lossy(fresh));
        let surplus = kept.len().saturating_sub(LAST_WORDS);
        let cut = (surplus..kept.len()).find(|at| kept.is_char_boundary(*at)).unwrap_or(kept.len());
        kept.drain(..cut);
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        self.dismiss();
        // It ends by itself now; one that does not must not hold up the report.
        for _ in 0..self.farewell.as_millis() / 10 {
            if !matches!(self.process.try_wait(), Ok(None)) {
                return;
            }
            thread::sleep(Duration::from_millis(10));
        }
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
