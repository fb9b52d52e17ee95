//! A survey of the network without a unit: every node that is heard.

use std::collections::BTreeSet;
use std::time::Duration;

use anstyle::Style;
use cara_std::Fleet;
use cara_std::survey::{Heard, Reach, Standing, Survey};
use serde_json::{Value, json};

use cara_tools::global::Global;
use cara_tools::listening::{self, shown_standing};
use cara_tools::output::{self, BAD, FAINT, PLAIN, Rows};

/// How often a survey asks while it listens: one broadcast may be lost.
const QUESTIONS: u32 = 2;

/// A survey that has asked the fleets that are meant and `more`, and listened; and those of them whose keys should be here.
pub(super) fn listen(span: Duration, more: &[Fleet], global: &Global) -> anyhow::Result<(Survey, Vec<Fleet>)> {
    let keys = listening::keys(global)?;
    let mut fleets = listening::fleets(global, &keys);
    let is_meant = global.fleet.is_some() || keys.fleets().is_empty() && more.is_empty();
    let meant = if is_meant { fleets.clone() } else { Vec::new() };
    fleets.extend(more.iter().filter(|fleet| !fleets.contains(fleet)).collect::<Vec<_>>());
    let mut survey = listening::open(global, keys)?;
    for _ in 0..QUESTIONS {
        for fleet in &fleets {
            survey.ask(*fleet);
        }
        survey.listen(span / QUESTIONS);
    }
    Ok((survey, meant))
}

pub(super) fn show(span: Duration, global: &Global) -> anyhow::Result<()> {
    let (survey, meant) = listen(span, &[], global)?;
    let heard: Vec<_> = survey.heard().iter().filter(|heard| !heard.is_survey()).collect();
    if global.json {
        let heard: Vec<_> = heard.iter().map(|heard| as_json(heard)).collect();
        let keys_of: Vec<u32> = survey.keys().fleets().iter().map(|fleet| fleet.0).collect();
        let refused: Vec<String> = survey.keys().refused().iter().map(ToString::to_string).collect();
        let targets: Vec<_> = survey.reach().iter().map(target).collect();
        let whole = json!({
            "unit": null, "keys_of": keys_of, "key_files_refused": refused, "targets": targets, "heard": heard
        });
        return Ok(output::object(&whole)?);
    }
    if heard.is_empty() {
        output::line("no node was heard; `cara doctor` looks for reasons")?;
    }
    table(&heard).print()?;
    about_fleets(&heard)?;
    print(about_keys(&survey, &heard, &meant, global))?;
    output::line(
        "\nA survey hears m_units, and s_units that look for their manager. S_units that have joined are silent: their \
         manager shows them (`cara scan` on its host).",
    )?;
    Ok(())
}

fn about_fleets(heard: &[&Heard]) -> std::io::Result<()> {
    let fleets: BTreeSet<u32> = heard.iter().map(|heard| heard.fleet.0).collect();
    if fleets.len() > 1 {
        let fleets: Vec<String> = fleets.iter().map(u32::to_string).collect();
        output::line(format_args!("\nfleets {} are here; units of different fleets do not meet", fleets.join(", ")))?;
    }
    let modes: BTreeSet<&str> = heard.iter().map(|heard| heard.mode.as_str()).collect();
    if modes.len() > 1 {
        output::line("\nunits in plain mode and secured ones are here; they do not meet")?;
    }
    Ok(())
}

/// Something to know of a survey.
pub(super) struct Remark {
    /// What went wrong; empty if nothing did.
    pub(super) mistake: &'static str,
    pub(super) text: String,
}

impl Remark {
    /// What stands before the text.
    pub(super) fn head(&self) -> String {
        if self.mistake.is_empty() { String::new() } else { format!("{}: ", self.mistake) }
    }
}

/// Each as a paragraph.
pub(super) fn print(remarks: impl IntoIterator<Item = Remark>) -> std::io::Result<()> {
    remarks.into_iter().try_for_each(|Remark { mistake, text }| match mistake {
        "" => output::line(format_args!("\n{text}")),
        _ => output::line(format_args!("\n{BAD}{mistake}{BAD:#}: {text}")),
    })
}

/// What could not be asked or checked, and how it can be.
pub(super) fn about_keys(survey: &Survey, heard: &[&Heard], meant: &[Fleet], global: &Global) -> Vec<Remark> {
    let plain = |text| Remark { mistake: "", text };
    let refused = survey.keys().refused().iter();
    let refused = refused.map(|refused| Remark { mistake: "keys were not taken", text: refused.to_string() });
    let others = heard.iter().any(|heard| heard.standing == Standing::OtherKeys).then(|| {
        plain(
            "\"other keys\": their codes were made with none of the keys that are here: they have keys of another root, or of \
             a generation that is over, or somebody speaks in their name"
                .to_owned(),
        )
    });
    let without = without_keys(survey, heard, meant, global).into_iter().map(|fleet| {
        plain(format!(
            "there are no keys of fleet {} here, so the survey did not ask its secured units, and nothing shows that those \
             which were heard belong to it: {}",
            fleet.0,
            listening::how_to_get_keys(fleet)
        ))
    });
    refused.chain(others).chain(without).collect()
}

/// Fleets whose secured units were not asked. Plain mode needs no keys.
pub(super) fn without_keys(survey: &Survey, heard: &[&Heard], meant: &[Fleet], global: &Global) -> BTreeSet<Fleet> {
    let unchecked = heard.iter().filter(|heard| heard.standing == Standing::Unchecked).map(|heard| heard.fleet);
    let all = unchecked.chain(meant.iter().copied()).filter(|fleet| !survey.keys().has(*fleet));
    all.filter(|_| !global.insecure).collect()
}

/// How far a datagram can be believed, for people.
pub(super) const fn proof(standing: Standing) -> (Style, &'static str) {
    match standing {
        Standing::Plain => (PLAIN, "plain"),
        Standing::Proven { .. } => (PLAIN, "secured, of the fleet"),
        Standing::OtherKeys => (BAD, "secured, other keys"),
        Standing::Unchecked => (FAINT, "secured, not checked"),
    }
}

fn table(heard: &[&Heard]) -> Rows {
    let mut rows =
        Rows::new(["NODE", "ID", "ROLE", "FLEET", "MODE", "VERSION", "HEARD FROM", "LISTENS AT", "LOOKS FOR"]);
    for heard in heard {
        let or_dash = |text: Option<String>| text.unwrap_or_else(|| "-".into());
        let identity = heard.identity.as_ref();
        let (style, mode) = proof(heard.standing);
        rows.add(
            style,
            [
                or_dash(identity.map(|identity| identity.name().to_owned())),
                or_dash(identity.map(|identity| identity.id().to_string())),
                or_dash(identity.map(|identity| identity.role().as_str().to_owned())),
                heard.fleet.0.to_string(),
                mode.to_owned(),
                heard.versions.to_string(),
                heard.source.to_string(),
                or_dash(heard.listens_at().map(|at| at.to_string())),
                or_dash(heard.wanted.as_ref().map(|manager| format!("{}/{}", manager.name, manager.id))),
            ],
        );
    }
    rows
}

/// Where broadcasts go, and what became of them.
pub(super) fn target(reach: &Reach) -> Value {
    json!({
        "interface": reach.interface.name,
        "address": reach.interface.address.to_string(),
        "broadcast": reach.interface.broadcast.map(|address| address.to_string()),
        "port": reach.port,
        "up": reach.interface.up,
        "sent": reach.sent,
        "refused": reach.refused.map(|kind| kind.to_string()),
    })
}

fn as_json(heard: &Heard) -> Value {
    let identity = heard.identity.as_ref();
    let (proof, generation) = shown_standing(heard.standing);
    json!({
        "name": identity.map(|identity| identity.name()),
        "id": identity.map(|identity| identity.id()),
        "role": identity.map(|identity| identity.role().as_str()),
        "fleet": heard.fleet.0,
        "mode": heard.mode.as_str(),
        "proof": proof,
        "generation": generation,
        "versions": [heard.versions.first, heard.versions.last],
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
