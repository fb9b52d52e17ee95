//! `cara set`: a constraint of the unit, or of its side towards one node.

use std::process::ExitCode;

use cara_std::Scheduling;
use cara_std::control::protocol::{Answer, ConstraintsInfo, Question};

use crate::nodes;
use crate::operator::{Need, Operator};
use cara_tools::close_names;
use cara_tools::exit::{Ended, Exit};
use cara_tools::global::Global;
use cara_tools::output::{self, HEADING, PLAIN, Rows};
use cara_tools::units::{parse_bytes, parse_micros, show_bytes, show_micros};

/// Changes a constraint while the unit runs; peers are told what concerns them.
#[derive(clap::Args)]
#[command(after_help = "\
Constraints:
  request_timeout   how long a request may take; a time from 1ms, as 2s
  minimum_interval  least time between two requests to one node; a time, 0 for none
  maximum_nodes     most connected nodes; a number
  message_size      longest message received; a size from 16 B to 256 KiB
  chunk_size        longest frame received; a size from 320 B to 4 KiB
  keep_alive        between two signs of life; a time
  calls_per_peer    calls that one peer may have waiting or running here; a number
  scheduling        which of the calls that wait begins next: deadline, fifo or admission")]
pub(crate) struct Arguments {
    /// The unit itself, by its name or as `.`; or a node, for this unit's side towards it: NAME, NAME/ID or #ID.
    node: String,
    /// Which constraint.
    constraint: String,
    /// Its new value: 50ms, 2s, 32KiB, 64, fifo.
    value: String,
}

#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Time,
    Size,
    Number,
    Scheduling,
}

/// The constraints by name, with what their values are and how they are found among those in force.
type Known = (&'static str, Kind, fn(&ConstraintsInfo) -> u64);

const CONSTRAINTS: [Known; 8] = [
    ("request_timeout", Kind::Time, |c| c.request_timeout_us),
    ("minimum_interval", Kind::Time, |c| c.minimum_interval_us),
    ("maximum_nodes", Kind::Number, |c| c.maximum_nodes.into()),
    ("message_size", Kind::Size, |c| c.message_size.into()),
    ("chunk_size", Kind::Size, |c| c.chunk_size.into()),
    ("keep_alive", Kind::Time, |c| c.keep_alive_us),
    ("calls_per_peer", Kind::Number, |c| c.calls_per_peer.into()),
    ("scheduling", Kind::Scheduling, |c| c.scheduling as u64),
];

pub(crate) fn run(Arguments { node, constraint, value }: Arguments, global: &Global) -> anyhow::Result<ExitCode> {
    let (name, kind, _) = find(&constraint)?;
    let value = parse(name, kind, &value)?;
    let towards = if node == "." { Need::Nothing } else { Need::UnitOrNode(&node) };
    let mut operator = Operator::open(global, &towards)?;
    let node = match operator.is_itself(&node)? {
        true => None,
        false => Some(nodes::known(&mut operator, &node)?.selector),
    };
    let question = Question::Set { node: node.clone(), constraint: name.into(), value };
    let answers = operator.answers(&question)?.into_iter();
    let constraints = answers.filter_map(|answer| if let Answer::Constraints(c) = answer { Some(c) } else { None });
    for constraints in constraints {
        match global.json {
            true => output::object(&constraints)?,
            false => table(&constraints, name).print()?,
        }
    }
    Ok(Exit::Done.into())
}

/// The names of all constraints.
pub(super) fn names() -> impl Iterator<Item = &'static str> {
    CONSTRAINTS.iter().map(|(name, ..)| *name)
}

fn find(wanted: &str) -> anyhow::Result<Known> {
    let wanted = wanted.replace('-', "_");
    let found = CONSTRAINTS.into_iter().find(|(name, ..)| *name == wanted);
    found.ok_or_else(|| {
        let names = CONSTRAINTS.iter().map(|(name, ..)| *name);
        Ended::usage(format!("there is no constraint `{wanted}`; it may be {}", close_names::either(&wanted, names)))
    })
}

fn parse(name: &str, kind: Kind, text: &str) -> anyhow::Result<u64> {
    let value = match kind {
        Kind::Time => parse_micros(text),
        Kind::Size => parse_bytes(text),
        Kind::Scheduling => Scheduling::ALL
            .iter()
            .position(|known| known.word() == text)
            .map(|at| at as u64)
            .ok_or_else(|| format!("it is `deadline`, `fifo` or `admission`, not `{text}`")),
        Kind::Number => text.parse().map_err(|_| format!("write a whole number, as 64, not `{text}`")),
    };
    value.map_err(|wrong| Ended::usage(format!("{name}: {wrong}")))
}

fn table(constraints: &ConstraintsInfo, changed: &str) -> Rows {
    let mut rows = Rows::new(["CONSTRAINT", "IN FORCE"]);
    for (name, kind, value) in CONSTRAINTS {
        let value = value(constraints);
        let value = match kind {
            Kind::Time => show_micros(value as f64),
            Kind::Size => show_bytes(value),
            Kind::Number => value.to_string(),
            Kind::Scheduling => {
                let known = Scheduling::ALL.get(value as usize);
                known.map_or_else(|| value.to_string(), |known| known.word().to_owned())
            }
        };
        rows.add(if name == changed { HEADING } else { PLAIN }, [name.into(), value]);
    }
    rows
}

#[cfg(test)]
mod tests {
    use super::{Kind, find, parse};

    #[test]
    fn names_are_found_however_they_are_written() {
        assert_eq!(find("keep-alive").unwrap().0, "keep_alive");
        let wrong = find("message_sise").err().map(|error| error.to_string()).unwrap_or_default();
        assert!(wrong.contains("`message_size`"), "{wrong}");
    }

    #[test]
    fn values_have_the_units_of_their_constraint() {
        assert_eq!(parse("request_timeout", Kind::Time, "50ms").unwrap(), 50_000);
        assert_eq!(parse("message_size", Kind::Size, "32KiB").unwrap(), 32_768);
        assert_eq!(parse("maximum_nodes", Kind::Number, "64").unwrap(), 64);
        assert_eq!(parse("scheduling", Kind::Scheduling, "fifo").unwrap(), 1);
        for (kind, wrong) in [
            (Kind::Scheduling, "lifo"),
            (Kind::Time, "50"),
            (Kind::Size, "1s"),
            (Kind::Number, "64KiB"),
            (Kind::Number, "-1"),
        ] {
            assert!(parse("x", kind, wrong).is_err(), "{wrong}");
        }
    }
}
