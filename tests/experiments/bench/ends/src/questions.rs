//! What the processes of a pair are asked: one line of JSON each way per question.
//!
//! A process ends when its standard input does, so none outlives its parent.

use std::io::{Write, stdin, stdout};

use anyhow::{Context, Result};
use clap::{Args, Parser, Subcommand};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use crate::block::{Callers, Order};
use crate::burst::{self, Burst};
use crate::further::Further;
use crate::peer::{Limits, Peer, Place};
use crate::{clock, pin};

/// What a server process is asked.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub enum ServerQuestion {
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
pub enum ClientQuestion {
    /// A block of echo calls.
    Echo(Order),
    /// One-way messages.
    Burst(Burst),
    /// Messages of bursts that were reported as not executed since this was last asked.
    Failed,
}

/// What a process of a pair is told when it starts.
#[derive(Debug, Clone, Args)]
pub struct End {
    /// The role to play.
    #[arg(long)]
    pub peer: String,
    /// The CPU to stay on.
    #[arg(long)]
    pub cpu: Option<usize>,
    /// Which pair.
    #[command(flatten)]
    pub place: Place,
    /// Where the server listens, as it told.
    #[arg(long, default_value = "")]
    pub address: String,
}

/// Plays the process of a pair that the command line names. All that the program of another system does.
pub fn main(peer: &dyn Peer) -> Result<()> {
    main_with(peer, &std::env::args().collect::<Vec<_>>())
}

/// As [`main`] with this command line.
pub fn main_with(peer: &dyn Peer, arguments: &[String]) -> Result<()> {
    Arguments::parse_from(arguments).role.play(peer)
}

#[derive(Parser)]
struct Arguments {
    #[command(subcommand)]
    role: Role,
}

/// Which process of a pair.
#[derive(Debug, Clone, Subcommand)]
enum Role {
    /// The process that answers.
    Serve(End),
    /// The process that calls.
    Call(End),
    /// The process of the five further nodes.
    Further(End),
}

impl Role {
    fn play(&self, peer: &dyn Peer) -> Result<()> {
        match self {
            Self::Serve(end) => serve(peer, end),
            Self::Call(end) => call(peer, end),
            Self::Further(end) => further(peer, end),
        }
    }
}

/// The server process: tells its address, then answers.
pub fn serve(peer: &dyn Peer, end: &End) -> Result<()> {
    pin::stay_on(end.cpu)?;
    let server = peer.start_server(&end.place)?;
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

fn call(peer: &dyn Peer, end: &End) -> Result<()> {
    pin::stay_on(end.cpu)?;
    let mut callers = Callers::new(peer, &end.place, &end.address);
    answer_all(|question| answer_client(&mut callers, &question))
}

/// Does what a client process is asked.
pub fn answer_client(callers: &mut Callers, question: &ClientQuestion) -> Result<Value> {
    Ok(match question {
        ClientQuestion::Echo(order) => json!(callers.run(order)?),
        ClientQuestion::Burst(burst) => json!(burst::offer(callers.first()?, burst)),
        ClientQuestion::Failed => json!(callers.first()?.failed()),
    })
}

/// The process of the further nodes of distribution 2: they call while told to.
pub fn further(peer: &dyn Peer, end: &End) -> Result<()> {
    pin::stay_on(end.cpu)?;
    let further = Further::connect(peer, &end.place, &end.address)?;
    answer_all(|is_calling: bool| {
        Ok(match is_calling {
            true => json!(further.begin()),
            false => json!(further.end()?),
        })
    })
}

/// Answers each question until there are no more.
pub fn answer_all<Q: DeserializeOwned>(mut answer: impl FnMut(Q) -> Result<Value>) -> Result<()> {
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
