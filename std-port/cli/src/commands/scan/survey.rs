//! A look at the network without a unit: whoever says something there.

use std::collections::BTreeSet;
use std::time::Duration;

use cara_std::survey::{Heard, Survey};
use cara_std::{Fleet, Role};
use serde_json::{Value, json};

use crate::global::Global;
use crate::output::{self, PLAIN, Rows};

/// How often a survey asks while it listens: one broadcast may be lost.
const QUESTIONS: u32 = 2;

pub(crate) fn show(listen: Duration, global: &Global) -> anyhow::Result<()> {
    let mut survey = Survey::open(global.interfaces(), global.port())?;
    for _ in 0..QUESTIONS {
        survey.ask(Fleet(global.fleet.unwrap_or(0)));
        survey.listen(listen / QUESTIONS);
    }
    let heard: Vec<_> = survey.heard().iter().filter(|heard| !heard.is_survey()).collect();
    if global.json {
        let heard: Vec<_> = heard.iter().map(|heard| as_json(heard)).collect();
        return Ok(output::object(&json!({ "unit": null, "heard": heard }))?);
    }
    if heard.is_empty() {
        output::line("nobody was heard; `cara doctor` looks for reasons")?;
    }
    table(&heard).print()?;
    let fleets: BTreeSet<u32> = heard.iter().map(|heard| heard.fleet.0).collect();
    if fleets.len() > 1 {
        output::line(format_args!("\nseveral fleets are here: {fleets:?}; units of different fleets do not meet"))?;
    }
    output::line(
        "\nA survey hears m_units, and s_units that look for their manager. S_units that have joined are silent: their \
         manager shows them (`cara scan` on its host).",
    )?;
    Ok(())
}

fn table(heard: &[&Heard]) -> Rows {
    let mut rows = Rows::new(["NODE", "ID", "ROLE", "FLEET", "VERSION", "HEARD FROM", "LISTENS AT", "LOOKS FOR"]);
    for heard in heard {
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".into());
        let identity = heard.identity.as_ref();
        rows.add(
            PLAIN,
            [
                or_dash(identity.map(|identity| identity.name().to_owned())),
                or_dash(identity.map(|identity| identity.id().to_string())),
                or_dash(identity.map(|identity| role(identity.role()).to_owned())),
                heard.fleet.0.to_string(),
                heard.version.to_string(),
                heard.source.to_string(),
                or_dash(heard.listens_at().map(|at| at.to_string())),
                or_dash(heard.wanted.as_ref().map(|manager| format!("{}/{}", manager.name, manager.id))),
            ],
        );
    }
    rows
}

fn as_json(heard: &Heard) -> Value {
    let identity = heard.identity.as_ref();
    json!({
        "name": identity.map(|identity| identity.name()),
        "id": identity.map(|identity| identity.id()),
        "role": identity.map(|identity| role(identity.role())),
        "fleet": heard.fleet.0,
        "version": heard.version,
        "same_version": heard.same_version(),
        "source": heard.source.to_string(),
        "listens_at": heard.listens_at().map(|at| at.to_string()),
        "looks_for": heard.wanted.as_ref().map(|manager| format!("{}/{}", manager.name, manager.id)),
        "room": heard.room,
        "by_broadcast": heard.by_broadcast,
        "searches": heard.searches,
        "answers": heard.answers,
    })
}

const fn role(role: Role) -> &'static str {
    match role {
        Role::MUnit => "m_unit",
        Role::SUnit => "s_unit",
    }
}
