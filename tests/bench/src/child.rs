//! The child processes, and how the scheduler talks with them: one line of JSON each way per question.
//!
//! A child ends when its standard input does, so none outlives the scheduler.

use std::io::{BufRead, BufReader, Read, Write, stdin, stdout};
use std::process::{self, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, Result, anyhow, ensure};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::block::{Callers, Order};
use crate::burst::{self, Burst};
use crate::further::Further;
use crate::peers::{self, Limits};
use crate::{Child, clock, pin, share};

/// What a server process is asked.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) enum ServerQuestion {
    /// CPU time so far, in nanoseconds.
    CpuTime,
    /// What the one-way service counted, and when it last did.
    Executed,
    /// What the peer counts of its own accord.
    Counters,
    /// Constraints towards all callers.
    Constrain(Limits),
}

/// What a client process is asked.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(crate) enum ClientQuestion {
    Echo(Order),
    Burst(Burst),
    /// Messages of bursts that were reported as not executed since this was last asked.
    Failed,
    Share(share::Order),
}

/// The server process: tells its address, then answers.
pub(crate) fn serve(child: &Child) -> Result<()> {
    pin::stay_on(child.cpu)?;
    let server = peers::named(&child.peer)?.start_server(&child.place)?;
    say(&server.address)?;
    answer_all(|question| {
        Ok(match question {
            ServerQuestion::CpuTime => json!(clock::cpu_time()),
            ServerQuestion::Executed => json!(server.executed.read()),
            ServerQuestion::Counters => json!((server.counters)()),
            ServerQuestion::Constrain(limits) => {
                let constrain = server.constrain.as_ref().context("this peer has no constraints")?;
                json!(constrain(limits)?)
            }
        })
    })?;
    drop(server.keep);
    Ok(())
}

/// The client process: makes the calls that each line orders.
pub(crate) fn call(child: &Child) -> Result<()> {
    pin::stay_on(child.cpu)?;
    let peer = peers::named(&child.peer)?;
    let mut callers = Callers::new(&*peer, &child.place, &child.address);
    answer_all(|question| {
        Ok(match question {
            ClientQuestion::Echo(order) => json!(callers.run(&order)?),
            ClientQuestion::Burst(burst) => json!(burst::offer(callers.first()?, &burst)),
            ClientQuestion::Failed => json!(callers.first()?.failed()),
            ClientQuestion::Share(order) => json!(share::measure(callers.first()?, &order)?),
        })
    })
}

/// The process of the further nodes of distribution 2: they call while told to.
pub(crate) fn further(child: &Child) -> Result<()> {
    pin::stay_on(child.cpu)?;
    let further = Further::connect(&*peers::named(&child.peer)?, &child.place, &child.address)?;
    answer_all(|is_calling: bool| {
        Ok(match is_calling {
            true => json!(further.begin()),
            false => json!(further.end()?),
        })
    })
}

/// Answers each question until there are no more.
pub(crate) fn answer_all<Q: DeserializeOwned>(mut answer: impl FnMut(Q) -> Result<Value>) -> Result<()> {
    for line in stdin().lines() {
        let question = serde_json::from_str(&line?)?;
        say(&answer(question).map_err(|error| format!("{error:#}")))?;
    }
    Ok(())
}

fn say(answer: &impl Serialize) -> Result<()> {
    let mut line = serde_json::to_string(answer)?;
    line.push('\n');
    let mut out = stdout().lock();
    out.write_all(line.as_bytes())?;
    Ok(out.flush()?)
}

/// A child process as the scheduler sees it.
pub(crate) struct Handle {
    process: process::Child,
    questions: Option<ChildStdin>,
    answers: BufReader<ChildStdout>,
}

impl Handle {
    /// Starts this program again with `arguments`; what it prints as a service is read and thrown away.
    pub(crate) fn start(arguments: &[String], prints: bool) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args(arguments).stdin(Stdio::piped()).stdout(Stdio::piped());
        if prints {
            command.stderr(Stdio::piped());
        }
        let mut process = command.spawn()?;
        if let Some(mut printed) = process.stderr.take() {
            std::thread::spawn(move || {
                let mut buffer = [0; 1 << 16];
                while printed.read(&mut buffer).is_ok_and(|count| count > 0) {}
            });
        }
        let questions = process.stdin.take();
        let answers = process.stdout.take().context("the child has no output")?;
        Ok(Self { process, questions, answers: BufReader::new(answers) })
    }

    /// Starts this program again as `role` of a pair.
    pub(crate) fn of_pair(role: &str, child: &Child) -> Result<Self> {
        let run = child.place.run.to_string();
        let mut arguments =
            [role, "--peer", &child.peer, "--run", &run, "--address", &child.address].map(String::from).to_vec();
        if let Some(cpu) = child.cpu {
            arguments.extend(["--cpu".into(), cpu.to_string()]);
        }
        if child.place.print {
            arguments.push("--print".into());
        }
        Self::start(&arguments, child.place.print && role == "serve")
    }

    /// Sends one line.
    pub(crate) fn ask(&mut self, question: &impl Serialize) -> Result<()> {
        let mut line = serde_json::to_string(question)?;
        line.push('\n');
        let questions = self.questions.as_mut().context("the child is being stopped")?;
        Ok(questions.write_all(line.as_bytes())?)
    }

    /// Waits for one line.
    pub(crate) fn line<T: DeserializeOwned>(&mut self) -> Result<T> {
        let mut line = String::new();
        ensure!(self.answers.read_line(&mut line)? > 0, "a child process ended before it answered");
        Ok(serde_json::from_str(&line)?)
    }

    /// Waits for what came of the last question.
    pub(crate) fn answer<T: DeserializeOwned>(&mut self) -> Result<T> {
        self.line::<Result<T, String>>()?.map_err(|error| anyhow!(error))
    }

    /// Sends a question and waits for its answer.
    pub(crate) fn order<T: DeserializeOwned>(&mut self, question: &impl Serialize) -> Result<T> {
        self.ask(question)?;
        self.answer()
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        drop(self.questions.take());
        // It ends by itself now; one that does not must not hold up the report.
        for _ in 0..200 {
            if !matches!(self.process.try_wait(), Ok(None)) {
                return;
            }
            std::thread::sleep(std::time::Duration::from_millis(10));
        }
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
