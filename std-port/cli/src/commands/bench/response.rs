//! Response time: from a call to its results, one after the other.

use std::collections::BTreeMap;

use cara_std::control::protocol::{Answer, Question};
use serde::Serialize;

use super::subject::Subject;
use super::{Arguments, show};
use crate::operator::Operator;
use crate::statistics::Times;

/// The response times of one string length.
#[derive(Serialize)]
pub(crate) struct Row {
    pub(crate) characters: usize,
    pub(crate) times: Times,
    /// Errors by name, with how often each came.
    pub(crate) errors: BTreeMap<String, usize>,
}

pub(crate) fn measure(
    operator: &mut Operator,
    subject: &Subject,
    sizes: &[usize],
    arguments: &Arguments,
    shown: bool,
) -> anyhow::Result<Vec<Row>> {
    if shown {
        show::response_heading(arguments)?;
    }
    let mut rows = Vec::new();
    for characters in sizes {
        let row = of_size(operator, subject, *characters, arguments)?;
        if shown {
            show::response(&row)?;
        }
        rows.push(row);
    }
    Ok(rows)
}

fn of_size(operator: &mut Operator, subject: &Subject, characters: usize, how: &Arguments) -> anyhow::Result<Row> {
    let call = subject.call(characters, false);
    let question = Question::Bench { call, count: how.count, pause_us: how.pause.as_micros() as u64 };
    let (mut samples, mut errors) = (Vec::new(), BTreeMap::new());
    operator.ask(&question, |answer| {
        if let Answer::Sample { us, error } = answer {
            samples.push(us);
            let name = error.map(|failure| failure.error);
            name.into_iter().for_each(|name| *errors.entry(name).or_insert(0) += 1);
        }
        Ok(())
    })?;
    Ok(Row { characters, times: Times::of(samples), errors })
}
