//! `cara web`: a page that shows a fleet and commands it, through its running manager.
//!
//! The page is served by this process and asks the manager as every verb of `cara` does, so the manager's access table and
//! audit log apply, and a page cannot hold it up. `watching` keeps a `picture` of the fleet, `push` sends pages what
//! has changed in it, and `asking` carries out what a page asks for. `guard` decides who may ask. Every limit is in
//! `limits`, and the page shows them.

mod asking;
mod door;
#[doc(hidden)]
pub mod entrance;
mod form;
mod guard;
mod limits;
mod lines;
mod map;
mod page;
mod picture;
mod push;
mod server;
mod start;
#[cfg(test)]
mod tests;
mod users;
mod watching;

use std::net::SocketAddr;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use cara_std::control::protocol::{Answer, Question};
use cara_tools::exit::Exit;
use cara_tools::global::Global;
use cara_tools::output;
use serde_json::{Value, json};

/// Shows the fleet of a running manager in a browser, and commands it: a map, its nodes, a form for each function, orders,
/// events, and stop-all.
///
/// It listens on loopback and prints the address of the page, with a key that is drawn at each start. Any other address
/// needs --token-file, --cert and --key. What the page asks for is asked of the manager as by any verb of `cara`.
#[derive(clap::Args)]
pub struct Arguments {
    /// Where to listen; port 0 is a free one.
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8420")]
    listen: SocketAddr,
    /// A file with the token that a page must know, instead of a key that is drawn; or with a line `ROLE NAME TOKEN` for each
    /// user, whose role is stop, see, operate or reset. Only its owner may read it.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// The certificate for TLS, as PEM, with those of its issuers behind it.
    #[arg(long, value_name = "FILE", requires = "key")]
    cert: Option<PathBuf>,
    /// Its private key, as PEM. Only its owner may read it.
    #[arg(long, value_name = "FILE", requires = "cert")]
    key: Option<PathBuf>,
    /// A name under which browsers reach this host, besides `localhost` and addresses. Can be repeated.
    #[arg(long, value_name = "NAME")]
    host_name: Vec<String>,
    /// Where browsers see the page if a proxy stands before it, as https://fleet.example/hall/. Can be repeated.
    #[arg(long, value_name = "URL")]
    #[allow(rustdoc::bare_urls, reason = "the text is help of the command line as well")]
    origin: Vec<guard::Outside>,
    /// A MovingAI map (`.map`) to draw below the vehicles: cell (x, y) is column x of row y, both from 0.
    #[arg(long, value_name = "MAP")]
    background: Option<PathBuf>,
}

/// The m_unit that the page is about.
pub trait Unit: Send + Sync + 'static {
    /// A way to it. For a stop also where all of its connections are in use.
    fn connect(&self, for_a_stop: bool) -> anyhow::Result<Box<dyn Connection>>;

    /// What the doctor finds when it listens for so long.
    fn findings(&self, listen: Duration) -> anyhow::Result<Value>;

    /// What makes an event `log` of each line of a log, in the place of the pieces that streams bring. Pieces of a board whose firmware is
    /// not known stay, and all else.
    fn logs(&self) -> Logs;

    /// Which m_unit has which s_unit, after a survey of so long: `rows` (`cells`: m_unit, fleet, s_unit, state; `kind`) and `remarks`.
    fn managers(&self, listen: Duration) -> anyhow::Result<Value>;
}

/// See [`Unit::logs`].
pub type Logs = Box<dyn FnMut(Answer) -> Vec<Answer>>;

/// Ends what is asked over a connection, from another thread.
pub type Cancel = Box<dyn Fn() + Send + Sync>;

/// Passes on to a held call that its page is there. It waits for nothing.
pub type Beat = Box<dyn Fn() + Send + Sync>;

/// A way to an m_unit, for one question at a time.
pub trait Connection: Send {
    /// Asks, and passes on each answer until that says `Break`. An [`Answer::Failed`] is passed on like the others.
    fn ask(&mut self, question: &Question, each: &mut dyn FnMut(Answer) -> ControlFlow<()>) -> anyhow::Result<()>;

    /// From here on a [`Question::Hold`] is kept by what this passes on alone.
    fn beats(&mut self) -> anyhow::Result<Beat>;

    /// What ends it, whatever is asked.
    fn cancel(&self) -> anyhow::Result<Cancel>;
}

/// Serves the page until the process ends.
pub fn run(arguments: Arguments, unit: Arc<dyn Unit>, global: &Global) -> anyhow::Result<ExitCode> {
    let prepared = start::prepare(arguments)?;
    let url = prepared.url();
    match global.json {
        true => output::object(&json!({ "url": url }))?,
        false => {
            output::line(format_args!("the page is at {url}"))?;
            if let Some(own) = prepared.for_a_proxy() {
                output::line(format_args!("the proxy there finds it at {own}"))?;
            }
            output::line("Ctrl-C ends it")?;
        }
    }
    server::serve(prepared, unit)?;
    Ok(Exit::Done.into())
}
