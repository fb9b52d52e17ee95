//! `cara stop` and `cara reset`: the functions with that attribute, of one node or of all.

use std::collections::BTreeSet;
use std::fmt;
use std::io::{self, ErrorKind};
use std::mem;
use std::process::ExitCode;
use std::sync::mpsc::{Sender, channel};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use cara_std::Shown;
use cara_std::control::protocol::{Answer, Failure, Question};
use serde_json::{Value, json};

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
    let mut rounds = Rounds::begin(of, global);
    let (mut until, mut answered) = (None, None);
    let ended = loop {
        let ended = rounds.next(Operator::open_to_stop, |node| Question::Stop { node });
        if until.is_none()
            && let Err(error) = &ended
            && let Some(span) = is_asked_again_for(error)
        {
            until = Some(Instant::now() + span);
            if !global.json {
                let span = span.as_secs();
                let text = format!("{error:#}. Asking again for {span} s, should a standby take over");
                rounds.write(move || {
                    output::warning(text);
                    Ok(())
                });
            }
        }
        if let (Ok(Exit::Failed), Some(end)) = (&ended, &mut until) {
            *end = *answered.get_or_insert_with(|| (Instant::now() + JOINING).min(*end));
        }
        if matches!(ended, Ok(Exit::Done)) || until.is_none_or(|until| until < Instant::now()) {
            break ended;
        }
        thread::sleep(PAUSE);
    };
    rounds.end(ended)
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
    let mut rounds = Rounds::begin(of, global);
    let ended = rounds.next(Operator::open, |node| Question::Reset { node });
    rounds.end(ended)
}

/// What is written, in turn.
type Writing = Box<dyn FnOnce() -> io::Result<()> + Send>;

/// The question, until all have acknowledged it. Each round asks all of them again: a vehicle that has acknowledged may have started
/// anew since. A thread of its own writes what comes of it: an output that takes nothing holds up no round, and ends no stop.
struct Rounds<'g> {
    of: Of,
    global: &'g Global,
    sum: Sum,
    /// Those whose acknowledgement has been written.
    shown: BTreeSet<String>,
    lines: Sender<Writing>,
    /// Ends with the first error of the output.
    writer: io::Result<JoinHandle<io::Result<()>>>,
}

impl<'g> Rounds<'g> {
    fn begin(of: Of, global: &'g Global) -> Self {
        let (lines, writings) = channel::<Writing>();
        let write = move || {
            let mut ended = Ok(());
            for writing in writings {
                let written = writing();
                ended = ended.and(written);
            }
            ended
        };
        let writer = thread::Builder::new().spawn(write);
        Self { of, global, sum: Sum::default(), shown: BTreeSet::new(), lines, writer }
    }

    fn next(
        &mut self,
        open: fn(&Global, &Need<'_>) -> anyhow::Result<Operator>,
        question: impl FnOnce(Option<String>) -> Question,
    ) -> anyhow::Result<Exit> {
        let need = self.of.node.as_deref().map_or(Need::Everybody, Need::Node);
        let mut operator = open(self.global, &need)?;
        let node = match &self.of.node {
            Some(node) => Some(nodes::known(&mut operator, node)?.selector),
            None => None,
        };
        let asked = self.ask(&mut operator, &question(node));
        let sum = &self.sum;
        if sum.nodes() == 0 {
            asked?;
            let text = format!("no s_unit is known{}: nothing was called", operator.waited());
            return Err(Ended::failed("NoNodes", text));
        }
        let (json, text, object) = (self.global.json, sum.to_string(), sum.to_json());
        self.write(move || if json { output::object(&object) } else { output::line(text) });
        match asked {
            Err(error) if self.of.all || !sum.missing.is_empty() => Err(error.context(sum.to_string())),
            _ => Ok(if sum.missing.is_empty() { Exit::Done } else { Exit::Failed }),
        }
    }

    fn ask(&mut self, operator: &mut Operator, question: &Question) -> anyhow::Result<()> {
        let Self { sum, shown, lines, global, .. } = self;
        let earlier = mem::take(sum);
        let json = global.json;
        let asked = operator.ask(question, |answer| {
            let Answer::Called { node, id, error, took_us, .. } = answer else { return Ok(()) };
            let node = format!("{node}/{id}");
            sum.add(&node, error.is_none(), took_us);
            if error.is_some() {
                shown.remove(&node);
            }
            if error.is_some() || shown.insert(node.clone()) {
                let _ = lines.send(Box::new(move || show(&node, error.as_ref(), took_us, json)));
            }
            Ok(())
        });
        sum.carry(earlier);
        asked
    }

    fn write(&self, writing: impl FnOnce() -> io::Result<()> + Send + 'static) {
        // `end` says why there is no writer.
        let _ = self.lines.send(Box::new(writing));
    }

    /// Waits for the output.
    fn end(self, ended: anyhow::Result<Exit>) -> anyhow::Result<ExitCode> {
        let Self { sum, lines, writer, .. } = self;
        drop(lines);
        let written =
            writer.and_then(|writer| writer.join().unwrap_or_else(|_| Err(io::Error::other("its thread has ended"))));
        // A reader that has gone is no error: the exit code says the same.
        let unshown = written.err().filter(|error| error.kind() != ErrorKind::BrokenPipe);
        let unshown = unshown.map(|error| format!("standard output: {error}; {sum}"));
        match (ended, unshown) {
            (ended, None) => ended.map(Into::into),
            (Ok(_), Some(text)) => Err(Ended::failed("Output", text)),
            (Err(error), Some(text)) => Err(error.context(text)),
        }
    }
}

/// What came of all nodes.
#[derive(Default)]
struct Sum {
    acknowledged: BTreeSet<String>,
    missing: BTreeSet<String>,
    last_us: Option<u64>,
}

impl Sum {
    fn add(&mut self, node: &str, has_acknowledged: bool, took_us: u64) {
        if has_acknowledged {
            self.acknowledged.insert(node.to_owned());
            self.last_us = self.last_us.max(Some(took_us));
        } else {
            self.missing.insert(node.to_owned());
        }
    }

    /// Who was asked in an earlier round is missing until it has acknowledged in this one: whoever took over may not know it yet.
    fn carry(&mut self, earlier: Self) {
        let asked = earlier.acknowledged.into_iter().chain(earlier.missing);
        self.missing.extend(asked.filter(|node| !self.acknowledged.contains(node)));
    }

    fn nodes(&self) -> usize {
        self.acknowledged.len() + self.missing.len()
    }

    fn to_json(&self) -> Value {
        let Self { acknowledged, missing, last_us } = self;
        json!({ "nodes": self.nodes(), "acknowledged": acknowledged.len(), "last_us": last_us, "missing": missing })
    }
}

impl fmt::Display for Sum {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of {} acknowledged", self.acknowledged.len(), self.nodes())?;
        if let Some(last) = self.last_us {
            write!(f, ", the last after {}", show_micros(last as f64))?;
        }
        if !self.missing.is_empty() {
            write!(
                f,
                "; not acknowledged: {}",
                Shown(&self.missing.iter().map(String::as_str).collect::<Vec<_>>().join(", "))
            )?;
        }
        Ok(())
    }
}

fn show(node: &str, error: Option<&Failure>, took_us: u64, json: bool) -> io::Result<()> {
    match error {
        _ if json => output::object(&json!({ "node": node, "error": error, "took_us": took_us })),
        None => output::line(format_args!("{node}  acknowledged after {}", show_micros(took_us as f64))),
        Some(Failure { error, text, .. }) => {
            let what = if error == "NotConnected" { "not reached" } else { error };
            output::line(format_args!("{BAD}{node}: {what}:{BAD:#} {}", Shown(text)))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_was_missing_stays_so_until_it_has_acknowledged() {
        let round = |earlier, answers: &[(&str, bool)]| {
            let mut sum = Sum::default();
            answers.iter().for_each(|(node, has)| sum.add(node, *has, 7));
            sum.carry(earlier);
            sum
        };
        let first = round(Sum::default(), &[("agv/7", true), ("lift/8", false)]);
        let second = round(first, &[("agv/7", true)]);
        assert_eq!(second.to_string(), "1 of 2 acknowledged, the last after 7 us; not acknowledged: lift/8");
        let third = round(second, &[("agv/7", false), ("lift/8", true)]);
        assert_eq!(third.to_string(), "1 of 2 acknowledged, the last after 7 us; not acknowledged: agv/7");
        let fourth = round(third, &[("agv/7", true), ("lift/8", true)]);
        assert!(fourth.missing.is_empty());
        let fifth = round(fourth, &[("lift/8", true)]);
        assert_eq!(fifth.to_string(), "1 of 2 acknowledged, the last after 7 us; not acknowledged: agv/7");
    }
}
