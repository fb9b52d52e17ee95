//! The two child processes of a peer, and how the scheduler talks with them: one line of JSON each way per question.
//!
//! A child ends when its standard input does, so none outlives the scheduler.

use std::io::{BufRead, BufReader, Write, stdin, stdout};
use std::process::{self, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, Result, anyhow, ensure};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::block::{Callers, Order, cpu_time};
use crate::{Child, peers, pin};

/// The server process: tells its address, then on each line the CPU time that it has used.
pub(crate) fn serve(child: &Child) -> Result<()> {
    pin::stay_on(child.cpu)?;
    let server = peers::named(&child.peer)?.start_server(child.run)?;
    say(&server.address)?;
    for line in stdin().lines() {
        line?;
        say(&cpu_time())?;
    }
    drop(server.keep);
    Ok(())
}

/// The client process: makes the block of calls that each line orders.
pub(crate) fn call(child: &Child) -> Result<()> {
    pin::stay_on(child.cpu)?;
    let peer = peers::named(&child.peer)?;
    let mut callers = Callers::new(&*peer, child.run, &child.address);
    for line in stdin().lines() {
        let order: Order = serde_json::from_str(&line?)?;
        say(&callers.run(&order).map_err(|error| format!("{error:#}")))?;
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
    /// Starts this program again as `role` with `child`'s arguments.
    pub(crate) fn start(role: &str, child: &Child) -> Result<Self> {
        let mut command = Command::new(std::env::current_exe()?);
        command.args([role, "--peer", &child.peer, "--run", &child.run.to_string(), "--address", &child.address]);
        if let Some(cpu) = child.cpu {
            command.args(["--cpu", &cpu.to_string()]);
        }
        let mut process = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let questions = process.stdin.take();
        let answers = process.stdout.take().context("the child has no output")?;
        Ok(Self { process, questions, answers: BufReader::new(answers) })
    }

    /// Sends one line.
    pub(crate) fn ask(&mut self, question: &impl Serialize) -> Result<()> {
        let mut line = serde_json::to_string(question)?;
        line.push('\n');
        let questions = self.questions.as_mut().context("the child is being stopped")?;
        Ok(questions.write_all(line.as_bytes())?)
    }

    /// Waits for one line.
    pub(crate) fn answer<T: DeserializeOwned>(&mut self) -> Result<T> {
        let mut line = String::new();
        ensure!(self.answers.read_line(&mut line)? > 0, "a child process ended before it answered");
        Ok(serde_json::from_str(&line)?)
    }

    /// Sends an order and waits for what came of it.
    pub(crate) fn order<T: DeserializeOwned>(&mut self, order: &impl Serialize) -> Result<T> {
        self.ask(order)?;
        self.answer::<Result<T, String>>()?.map_err(|error| anyhow!(error))
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
