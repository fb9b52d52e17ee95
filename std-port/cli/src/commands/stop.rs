//! `cara stop` and `cara reset`: the functions with that attribute, of one node or of all.

use std::io::ErrorKind;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use cara_std::Shown;
use cara_std::control::protocol::{Answer, Failure, Question};
use serde_json::json;

use crate::nodes;
use crate::operator::{Need, Operator};
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output::{self, BAD};
use cara_tools::units::show_micros;

/// How long a stop whose manager dies or hangs is asked again of the one that takes over. A standby commands after 3 s, and the control
/// socket of a manager that hangs is its own 2 s later.
const TAKING_OVER: Duration = Duration::from_secs(15);
/// Likewise, where no manager ran to begin with: one may have died just before.
const APPEARING: Duration = Duration::from_secs(4);
/// A manager that answers is asked again for so long while nodes are missing: they join a new one after the other.
const JOINING: Duration = Duration::from_secs(3);
const PAUSE: Duration = Duration::from_millis(500);

/// Calls each function with the attribute `stop`, at once and as an emergency: what they stop stands until a reset.
///
/// Ends with 0 only if every s_unit of the roster has acknowledged. A manager that dies or hangs meanwhile, or does not run, may have a
/// standby: the stop is asked again for 15 s, or 4 s, with a warning. Not a substitute for a certified emergency stop.
#[derive(clap::Args)]
pub(crate) struct Stop {
    #[command(flatten)]
    of: Of,
}

/// Calls each function with the attribute `reset`: what was stopped may move again, unless a node refuses.
#[derive(clap::Args)]
pub(crate) struct Reset {
    #[command(flatten)]
    of: Of,
}

#[derive(clap::Args)]
struct Of {
    /// The node: NAME, NAME/ID or #ID.
    #[arg(conflicts_with = "all")]
    node: Option<String>,
    /// Every s_unit of the roster, also those that are absent, and every m_unit that offers such a function.
    #[arg(long)]
    all: bool,
}

impl Of {
    fn check(&self, verb: &str) -> anyhow::Result<()> {
        if self.node.is_some() || self.all {
            return Ok(());
        }
        Err(Ended::usage(format!("name a node, as in `cara {verb} agv-1`, or all of them: `cara {verb} --all`")))
    }
}

pub(crate) fn stop(Stop { of }: Stop, global: &Global) -> anyhow::Result<ExitCode> {
    of.check("stop")?;
    let (mut until, mut answered) = (None, None);
    loop {
        let ended = run(&of, Operator::open_to_stop, |node| Question::Stop { node }, global);
        if until.is_none()
            && let Err(error) = &ended
            && let Some(span) = is_asked_again_for(error)
        {
            until = Some(Instant::now() + span);
            if !global.json {
                let span = span.as_secs();
                output::warning(format_args!("{error:#}. Asking again for {span} s, should a standby take over"));
            }
        }
        if let (Ok(Exit::Failed), Some(end)) = (&ended, &mut until) {
            *end = *answered.get_or_insert_with(|| (Instant::now() + JOINING).min(*end));
        }
        if matches!(ended, Ok(Exit::Done)) || until.is_none_or(|until| until < Instant::now()) {
            return ended.map(Into::into);
        }
        std::thread::sleep(PAUSE);
    }
}

/// How long a standby may take over from the manager that is missed, if one is.
fn is_asked_again_for(error: &anyhow::Error) -> Option<Duration> {
    match error.downcast_ref::<Ended>()?.name.as_str() {
        "Silent" | "Broken" => Some(TAKING_OVER),
        "NoUnit" => Some(APPEARING),
        _ => None,
    }
}

pub(crate) fn reset(Reset { of }: Reset, global: &Global) -> anyhow::Result<ExitCode> {
    of.check("reset")?;
    run(&of, Operator::open, |node| Question::Reset { node }, global).map(Into::into)
}

fn run(
    of: &Of,
    open: fn(&Global, &Need<'_>) -> anyhow::Result<Operator>,
    question: impl FnOnce(Option<String>) -> Question,
    global: &Global,
) -> anyhow::Result<Exit> {
    let need = of.node.as_deref().map_or(Need::Everybody, Need::Node);
    let mut operator = open(global, &need)?;
    let node = match &of.node {
        Some(node) => Some(nodes::known(&mut operator, node)?.selector),
        None => None,
    };
    let mut sum = Sum::default();
    let mut unshown = None;
    let asked = operator.ask(&question(node), |answer| {
        let Answer::Called { node, id, error, took_us, .. } = answer else { return Ok(()) };
        let node = format!("{node}/{id}");
        // An output that takes nothing ends no stop, and hides nothing of it.
        unshown = unshown.take().or(show(&node, error.as_ref(), took_us, global).err());
        sum.add(node, error.is_none().then_some(took_us));
        Ok(())
    });
    if asked.is_ok() && sum.nodes == 0 {
        return Err(Ended::failed("NoNodes", format!("no s_unit is known{}: nothing was called", operator.waited())));
    }
    // A reader that has gone is no error: the exit code says the same.
    unshown = unshown.or(sum.show(global).err()).filter(|error| error.kind() != ErrorKind::BrokenPipe);
    let unshown = unshown.map(|error| format!("standard output: {error}; {sum}"));
    match (asked, unshown) {
        (Ok(()), None) => Ok(if sum.missing.is_empty() { Exit::Done } else { Exit::Failed }),
        (Ok(()), Some(text)) => Err(Ended::failed("Output", text)),
        (Err(error), None) if sum.nodes == 0 => Err(error),
        (Err(error), text) => Err(error.context(text.unwrap_or_else(|| sum.to_string()))),
    }
}

/// What came of all nodes.
#[derive(Default)]
struct Sum {
    nodes: usize,
    /// Those that have not acknowledged.
    missing: Vec<String>,
    last_us: Option<u64>,
}

impl Sum {
    fn add(&mut self, node: String, acknowledged_us: Option<u64>) {
        self.nodes += 1;
        match acknowledged_us {
            Some(took_us) => self.last_us = self.last_us.max(Some(took_us)),
            None => self.missing.push(node),
        }
    }

    fn acknowledged(&self) -> usize {
        self.nodes - self.missing.len()
    }

    fn show(&self, global: &Global) -> std::io::Result<()> {
        let Self { nodes, missing, last_us } = self;
        match global.json {
            false => output::line(self),
            true => output::object(&json!({
                "nodes": nodes, "acknowledged": self.acknowledged(), "last_us": last_us, "missing": missing,
            })),
        }
    }
}

impl std::fmt::Display for Sum {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} of {} acknowledged", self.acknowledged(), self.nodes)?;
        if let Some(last) = self.last_us {
            write!(f, ", the last after {}", show_micros(last as f64))?;
        }
        if !self.missing.is_empty() {
            write!(f, "; not acknowledged: {}", Shown(&self.missing.join(", ")))?;
        }
        Ok(())
    }
}

fn show(node: &str, error: Option<&Failure>, took_us: u64, global: &Global) -> std::io::Result<()> {
    match error {
        _ if global.json => output::object(&json!({ "node": node, "error": error, "took_us": took_us })),
        None => output::line(format_args!("{node}  acknowledged after {}", show_micros(took_us as f64))),
        Some(Failure { error, text, .. }) => {
            let what = if error == "NotConnected" { "not reached" } else { error };
            output::line(format_args!("{BAD}{node}: {what}:{BAD:#} {}", Shown(text)))
        }
    }
}
