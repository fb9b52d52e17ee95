//! What the doctor prints.

use std::collections::HashSet;

use serde_json::{Value, json};

use super::finding::{Finding, Severity};
use super::look::Looked;
use crate::output::{self, BAD, FAINT, GOOD, HEADING, PLAIN};

/// As one object.
pub(crate) fn object(looked: &Looked) -> Value {
    let seen = &looked.evidence;
    let heard: Vec<Value> = seen
        .heard
        .iter()
        .filter(|heard| !heard.is_survey())
        .map(|heard| {
            json!({
                "address": heard.source.to_string(),
                "version": heard.version,
                "fleet": heard.fleet.0,
                "node": heard.identity.as_ref().map(ToString::to_string),
                "role": heard.identity.as_ref().map(|identity| super::role(identity.role())),
                "epoch": heard.epoch.map(|epoch| format!("{:016x}", epoch.0)),
                "looks_for": heard.wanted.as_ref().map(super::causes::text_of),
                "tcp_port": heard.tcp_port,
                "room": heard.room,
                "searches": heard.searches,
                "answers": heard.answers,
                "first_ms": heard.first.as_millis() as u64,
                "last_ms": heard.last.as_millis() as u64,
            })
        })
        .collect();
    json!({
        "node": seen.which.as_ref().map(|which| &which.0),
        "fleet": seen.fleet.0,
        "discovery_port": seen.port,
        "listened_ms": seen.listened.as_millis() as u64,
        "interfaces": seen.reach.iter().filter(|reach| reach.interface.up).map(|reach| &reach.interface.name).collect::<Vec<_>>(),
        "units_asked": seen.running.iter().map(|running| running.name()).collect::<Vec<_>>(),
        "findings": looked.findings,
        "heard": heard,
    })
}

/// For people: each finding, what was seen, and what to do.
pub(crate) fn text(looked: &Looked) -> std::io::Result<()> {
    let seen = &looked.evidence;
    for finding in &looked.findings {
        one(finding)?;
    }
    if looked.findings.is_empty() {
        output::line(format_args!("{GOOD}nothing strange was found{GOOD:#}"))?;
    }
    let heard = seen.units().map(|(heard, identity)| (heard.fleet, identity)).collect::<HashSet<_>>().len();
    let asked: Vec<String> = seen.running.iter().map(|running| running.name()).collect();
    let asked = if asked.is_empty() {
        "no unit of this host could be asked".to_owned()
    } else {
        format!("asked {}", asked.join(", "))
    };
    output::line(format_args!(
        "{FAINT}listened {:.1} s on UDP port {}, fleet {}; nodes heard: {heard}; {asked}{FAINT:#}",
        seen.listened.as_secs_f32(),
        seen.port,
        seen.fleet.0
    ))
}

fn one(finding: &Finding) -> std::io::Result<()> {
    let (style, word) = match finding.severity {
        Severity::Error => (BAD, "error"),
        Severity::Warning => (HEADING, "warning"),
        Severity::Info => (GOOD, "info"),
    };
    output::line(format_args!("{style}{word}{style:#} {HEADING}{}{HEADING:#}: {}", finding.id.name(), finding.found))?;
    output::line(format_args!("{PLAIN}  -> {}{PLAIN:#}", finding.advice))
}
