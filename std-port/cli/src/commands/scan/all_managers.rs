//! `cara scan --all-managers`: which m_unit has which s_unit. Only a control socket tells that: datagrams tell who is there, and
//! which s_units look for a manager.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::time::Duration;

use anstyle::Style;
use cara_std::control::{RunningUnit, directories, running_in};
use cara_std::survey::{Heard, Survey};
use cara_std::{Fleet, Shown};
use serde::Serialize;
use serde_json::{Value, json};

use super::survey::Remark;
use super::{LISTED, survey};
use crate::nodes::{self, full_name};
use crate::operator::{Way, of_others};
use cara_tools::global::Global;
use cara_tools::listening::shown_standing;
use cara_tools::output::{self, BAD, FAINT, PLAIN, Rows};

/// Said under the table.
const SILENT: &str = "S_units that have joined are silent: those of an m_unit that was not asked are not known here. `cara scan` on \
                      its host shows them.";

/// A run of an m_unit, or a socket whose unit cannot be asked.
#[derive(Default, Serialize)]
struct Manager {
    manager: String,
    fleet: u32,
    epoch: Option<String>,
    socket: Option<String>,
    not_asked: Option<String>,
    /// Those that it has connected; `None` unless it was asked.
    s_units: Option<BTreeSet<String>>,
    heard: Vec<Datagrams>,
    /// M_units that were asked and are connected with it.
    linked_to: BTreeSet<String>,
}

#[derive(Default, Serialize)]
struct Vehicle {
    s_unit: String,
    fleet: u32,
    /// An m_unit that was asked has it.
    #[serde(skip)]
    is_had: bool,
    /// M_units on whose rosters it is, and why it left.
    missed_by: BTreeMap<String, Option<String>>,
    heard: Vec<Datagrams>,
}

/// What was heard from one address.
#[derive(Serialize)]
struct Datagrams {
    source: String,
    proof: &'static str,
    looks_for: Option<String>,
    #[serde(skip)]
    shown: String,
}

#[derive(Default)]
struct Fleets {
    managers: Vec<Manager>,
    /// By fleet and `NAME/ID`.
    vehicles: BTreeMap<(u32, String), Vehicle>,
    /// Secured ones of m_units that were asked.
    secured: BTreeSet<Fleet>,
    /// What of this host was not looked at, and why.
    not_looked: Vec<String>,
}

/// Rows that the page shows at most. Whoever is on the network can have datagrams heard, so those that a socket tells come first.
const PAGE_ROWS: usize = 1000;

/// A line of the table.
struct Line {
    style: Style,
    cells: [String; 4],
    /// A control socket tells it, or is why it is not known.
    is_of_socket: bool,
}

pub(super) fn show(span: Duration, global: &Global) -> anyhow::Result<()> {
    let (fleets, survey, meant) = gather(span, global)?;
    let heard = heard_of(&survey, global);
    if global.json {
        let without_keys = survey::without_keys(&survey, &heard, &meant, global);
        return fleets.print_json(&survey, without_keys.iter().map(|fleet| fleet.0).collect());
    }
    if fleets.managers.is_empty() {
        output::line("no m_unit was found; `cara doctor` looks for reasons")?;
    }
    let mut rows = Rows::new(["M_UNIT", "FLEET", "S_UNIT", "STATE"]);
    fleets.lines().into_iter().for_each(|line| rows.add(line.style, line.cells));
    rows.print()?;
    let not_asked = fleets.not_looked.iter().map(|why| Remark { mistake: "not asked", text: Shown(why).to_string() });
    survey::print(not_asked.chain(survey::about_keys(&survey, &heard, &meant, global)))?;
    output::line(format_args!("\n{SILENT}"))?;
    Ok(())
}

/// The same for the page: `rows` (m_unit, fleet, s_unit, state, and how it is shown) and `remarks`.
pub(crate) fn for_page(span: Duration, global: &Global) -> anyhow::Result<Value> {
    let (fleets, survey, meant) = gather(span, global)?;
    let shown = |text: &str| Shown(&text.replace(['\n', '\r'], " ")).to_string();
    let mut lines = fleets.lines();
    lines.sort_by_key(|line| !line.is_of_socket);
    let left_out = lines.len().saturating_sub(PAGE_ROWS);
    let rows = lines.iter().take(PAGE_ROWS).map(|line| {
        let kind = if line.style == BAD {
            "bad"
        } else if line.style == FAINT {
            "faint"
        } else {
            ""
        };
        json!({ "cells": line.cells.each_ref().map(|cell| shown(cell)), "kind": kind })
    });
    let not_asked = fleets.not_looked.iter().map(|why| format!("not asked: {why}"));
    let about_keys = survey::about_keys(&survey, &heard_of(&survey, global), &meant, global);
    let about_keys = about_keys.into_iter().map(|remark| format!("{}{}", remark.head(), remark.text));
    let more = format!("{left_out} more lines: `cara scan --all-managers` shows them");
    let more = (left_out > 0).then_some(more);
    let remarks = not_asked.chain(about_keys).chain(more).chain([SILENT.to_owned()]).map(|text| shown(&text));
    Ok(json!({ "rows": rows.collect::<Vec<_>>(), "remarks": remarks.collect::<Vec<_>>() }))
}

/// What the sockets and a survey tell, and the fleets whose keys should be here.
fn gather(span: Duration, global: &Global) -> anyhow::Result<(Fleets, Survey, Vec<Fleet>)> {
    let mut fleets = Fleets::default();
    let looked = directories().into_iter().filter_map(|directory| {
        running_in(&directory).map_err(|refused| fleets.not_looked.push(refused.to_string())).ok()
    });
    let running: Vec<_> = looked.flatten().filter(|unit| is_meant(unit.fleet, global)).collect();
    fleets.not_looked.extend(Some(of_others(None, global.fleet)).filter(|others| !others.is_empty()));
    let of_sockets: Vec<_> = running.iter().map(|unit| Fleet(unit.fleet)).collect();
    let (survey, mut meant) = survey::listen(span, &of_sockets, global)?;
    heard_of(&survey, global).iter().for_each(|heard| fleets.hear(heard));
    let not_asked: Vec<_> = running.into_iter().filter_map(|unit| fleets.ask(unit)).collect();
    not_asked.into_iter().for_each(|(unit, why)| fleets.not_asked(unit, why));
    fleets.managers.sort_by(|a, b| (a.fleet, &a.manager).cmp(&(b.fleet, &b.manager)));
    meant.extend(&fleets.secured);
    Ok((fleets, survey, meant))
}

fn is_meant(fleet: u32, global: &Global) -> bool {
    global.fleet.is_none_or(|meant| meant == fleet)
}

fn heard_of<'s>(survey: &'s Survey, global: &Global) -> Vec<&'s Heard> {
    survey.heard().iter().filter(|heard| !heard.is_survey() && is_meant(heard.fleet.0, global)).collect()
}

impl Fleets {
    fn hear(&mut self, heard: &Heard) {
        let Some(identity) = &heard.identity else { return };
        let (name, source) = (format!("{}/{}", identity.name(), identity.id()), heard.source.to_string());
        let looks_for = heard.wanted.as_ref().map(|manager| format!("{}/{}", manager.name, manager.id));
        let shown = format!("heard from {source} ({})", survey::proof(heard.standing).1);
        let datagrams = Datagrams { source, proof: shown_standing(heard.standing).0, looks_for, shown };
        if identity.role().as_str() == "s_unit" {
            return self.vehicle(heard.fleet.0, name).heard.push(datagrams);
        }
        let epoch = heard.epoch.map(|epoch| format!("{:016x}", epoch.0));
        self.manager(heard.fleet.0, name, epoch).heard.push(datagrams);
    }

    /// Why it was not asked, if so.
    fn ask(&mut self, running: RunningUnit) -> Option<(RunningUnit, String)> {
        let refusal = running.refusal().map_or(Ok(()), |refusal| Err(refusal.into()));
        let error = refusal.and_then(|()| self.ask_at(&running.path)).err()?;
        Some((running, error.to_string()))
    }

    /// It is the run of its name that is known from others, if that is one alone; of several its socket does not say which.
    fn not_asked(&mut self, RunningUnit { unit: manager, fleet, path, .. }: RunningUnit, why: String) {
        let is_same = |known: &&mut Manager| known.fleet == fleet && known.manager == manager && known.socket.is_none();
        let mut known: Vec<_> = self.managers.iter_mut().filter(is_same).collect();
        let (socket, not_asked) = (Some(path.display().to_string()), Some(why));
        match known.as_mut_slice() {
            [one] => (one.socket, one.not_asked) = (socket, not_asked),
            _ => self.managers.push(Manager { manager, fleet, socket, not_asked, ..Manager::default() }),
        }
    }

    fn ask_at(&mut self, path: &Path) -> anyhow::Result<()> {
        let mut operator = Way::Socket(path.to_owned()).open()?;
        let (unit, nodes) = (operator.unit()?, nodes::all(&mut operator, None)?);
        let (fleet, manager) = (unit.fleet, format!("{}/{}", unit.name, unit.id));
        self.secured.extend((unit.mode.as_deref() == Some("secured")).then_some(Fleet(fleet)));
        let mut s_units = BTreeSet::new();
        for node in nodes {
            let name = full_name(&node);
            match (node.role.as_str(), node.connected) {
                ("s_unit", true) => {
                    self.vehicle(fleet, name.clone()).is_had = true;
                    s_units.insert(name);
                }
                ("s_unit", false) if node.expected => {
                    self.vehicle(fleet, name).missed_by.insert(manager.clone(), node.left_text);
                }
                ("m_unit", true) => {
                    self.manager(fleet, name, node.epoch).linked_to.insert(manager.clone());
                }
                _ => {}
            }
        }
        let entry = self.manager(fleet, manager, Some(unit.epoch));
        (entry.socket, entry.s_units) = (Some(path.display().to_string()), Some(s_units));
        Ok(())
    }

    /// Two of one name are told apart by their epochs.
    fn manager(&mut self, fleet: u32, manager: String, epoch: Option<String>) -> &mut Manager {
        let is_same = |known: &Manager| known.fleet == fleet && known.manager == manager && known.epoch == epoch;
        let index = self.managers.iter().position(is_same).unwrap_or_else(|| {
            self.managers.push(Manager { manager, fleet, epoch, ..Manager::default() });
            self.managers.len() - 1
        });
        &mut self.managers[index]
    }

    fn vehicle(&mut self, fleet: u32, s_unit: String) -> &mut Vehicle {
        let key = (fleet, s_unit.clone());
        self.vehicles.entry(key).or_insert_with(|| Vehicle { s_unit, fleet, ..Vehicle::default() })
    }

    /// S_units that no m_unit which was asked has.
    fn without(&self) -> impl Iterator<Item = &Vehicle> {
        self.vehicles.values().filter(|vehicle| !vehicle.is_had)
    }

    fn print_json(&self, survey: &Survey, without_keys: Vec<u32>) -> anyhow::Result<()> {
        let refused: Vec<String> = survey.keys().refused().iter().map(ToString::to_string).collect();
        Ok(output::object(&json!({
            "managers": self.managers,
            "without_manager": self.without().collect::<Vec<_>>(),
            "not_looked": self.not_looked,
            "fleets_without_keys": without_keys,
            "key_files_refused": refused,
        }))?)
    }

    fn lines(&self) -> Vec<Line> {
        let mut lines = Vec::new();
        for manager in &self.managers {
            let is_of_socket = manager.socket.is_some();
            let mut add = |style, s_unit: &str, state: String| {
                let cells = [manager.manager.clone(), manager.fleet.to_string(), s_unit.to_owned(), state];
                lines.push(Line { style, cells, is_of_socket });
            };
            match &manager.s_units {
                None => add(FAINT, "not known", format!("not asked: {}", manager.why_not())),
                Some(s_units) if s_units.is_empty() => add(PLAIN, "none", "asked".into()),
                Some(s_units) => s_units.iter().for_each(|s_unit| add(PLAIN, s_unit, "connected".into())),
            }
        }
        lines.extend(self.without().map(|vehicle| Line {
            style: BAD,
            cells: ["-".into(), vehicle.fleet.to_string(), vehicle.s_unit.clone(), vehicle.state()],
            is_of_socket: !vehicle.missed_by.is_empty(),
        }));
        lines
    }
}

impl Manager {
    fn why_not(&self) -> String {
        let linked = self.linked_to.iter().map(|manager| format!("connected with {manager}"));
        let seen = self.heard.iter().take(LISTED).map(|heard| heard.shown.clone()).chain(linked);
        self.not_asked.iter().cloned().chain(seen).collect::<Vec<_>>().join("; ")
    }
}

impl Vehicle {
    fn state(&self) -> String {
        let missed = self.missed_by.iter().map(|(manager, why)| match why {
            Some(why) => format!("missed by {manager} ({why})"),
            None => format!("missed by {manager}"),
        });
        let heard = self.heard.iter().take(LISTED).map(|heard| match &heard.looks_for {
            Some(manager) => format!("looks for {manager}, {}", heard.shown),
            None => heard.shown.clone(),
        });
        let first = "at no m_unit that was asked".to_owned();
        std::iter::once(first).chain(missed).chain(heard).collect::<Vec<_>>().join("; ")
    }
}
