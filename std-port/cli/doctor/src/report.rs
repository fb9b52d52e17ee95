//! What the doctor prints.

use std::collections::HashSet;

use serde_json::{Value, json};

use super::finding::{Finding, Severity};
use super::look::Looked;
use cara_std::Mode;
use cara_tools::listening;
use cara_tools::output::{self, BAD, FAINT, GOOD, HEADING, PLAIN};

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
                "versions": [heard.versions.first, heard.versions.last],
                "fleet": heard.fleet.0,
                "mode": heard.mode.as_str(),
                "proof": listening::shown_standing(heard.standing).0,
                "generation": listening::shown_standing(heard.standing).1,
                "node": heard.identity.as_ref().map(ToString::to_string),
                "role": heard.identity.as_ref().map(|identity| identity.role().as_str()),
                "epoch": heard.epoch.map(|epoch| format!("{:016x}", epoch.0)),
                "looks_for": heard.wanted.as_ref().map(super::causes::text_of),
                "tcp_port": heard.tcp_port,
                "room": heard.room,
                "claim": heard.claim.map(|claim| claim.to_string()),
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
        "mode": seen.mode.map(Mode::as_str),
        "keys": seen.keys.has,
        "discovery_ports": seen.ports.numbers(),
        "listened_ms": seen.listened.as_millis() as u64,
        "interfaces": seen.interfaces_up(),
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
    let ports: Vec<String> = seen.ports.numbers().iter().map(u16::to_string).collect();
    let ports = ports.join(" and ");
    let without = if seen.keys.has { "" } else { ", without its keys" };
    output::line(format_args!(
        "{FAINT}listened {:.1} s on UDP port {ports}, fleet {}{without}; nodes heard: {heard}; {asked}{FAINT:#}",
        seen.listened.as_secs_f32(),
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
