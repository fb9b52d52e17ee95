//! What was changed, and what to do next.

use cara_core::distribution::identity::{Identity, Role};
use cara_std::keys::{Change, Members, Store, Written, full_name, shown};
use serde_json::json;

use cara_tools::global::Global;
use cara_tools::name_and_id::quoted;
use cara_tools::output;

/// What a command has done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Done<'n> {
    /// A root was drawn.
    Made,
    /// Nodes have got keys.
    Derived,
    /// Nodes were taken out.
    Revoked,
    /// These had been taken out before.
    RevokedAlready(&'n [Identity]),
    /// A step of a change of keys was made.
    Stepped,
    /// It had been made before, and not all of it was written.
    SteppedAlready,
}

/// Prints what a command has done.
pub(super) fn print(done: Done<'_>, store: &Store, written: &[Written], global: &Global) -> anyhow::Result<()> {
    let next = next(store, written);
    if global.json {
        return Ok(output::object(&object(store, written, &next))?);
    }
    output::line(headline(done, store))?;
    for Written { identity, path, change } in written {
        let what = match change {
            Change::New => "new",
            Change::Replaced => "changed",
            Change::Removed => "removed",
        };
        output::line(format_args!("  {what:8} {}  {}", full_name(identity), path.display()))?;
    }
    if written.is_empty() {
        output::line("  every file is as it should be")?;
    }
    Ok(next.iter().try_for_each(|line| output::line(format_args!("next: {line}")))?)
}

fn headline(done: Done<'_>, store: &Store) -> String {
    let members = store.keys().members();
    let (fleet, generations) = (members.fleet().0, generations(members));
    match done {
        Done::Made => format!(
            "fleet {fleet} has its root: {} ({}). A holder of it can speak as every node: keep a copy in a safe place",
            store.root_file().display(),
            shown(store.keys().fingerprint())
        ),
        Done::Revoked => {
            let revoked = members.revoked().iter().filter(|revoked| Some(revoked.from) == members.beside());
            let names: Vec<_> = revoked.map(|revoked| full_name(&revoked.identity)).collect();
            format!("fleet {fleet}, {generations}: without {}", names.join(", "))
        }
        Done::RevokedAlready(nodes) => {
            let names: Vec<_> = nodes.iter().map(full_name).collect();
            let are = if names.len() == 1 { "is" } else { "are" };
            format!("fleet {fleet}, {generations}: {} {are} revoked already", names.join(", "))
        }
        Done::SteppedAlready => format!("fleet {fleet}, {generations}, already; what was not written yet is now"),
        Done::Derived | Done::Stepped => format!("fleet {fleet}, {generations}"),
    }
}

/// The generation in use, and the one beside it.
pub(super) fn generations(members: &Members) -> String {
    let beside = members.beside().map(|beside| format!(", and {beside} is taken too"));
    format!("generation {} is in use{}", members.generation(), beside.unwrap_or_default())
}

fn next(store: &Store, written: &[Written]) -> Vec<String> {
    let members = store.keys().members();
    let fleet = members.fleet().0;
    let mut next = Vec::new();
    for lost in members.nodes().iter().filter(|node| node.identity.role() == Role::SUnit && node.managers.is_empty()) {
        let name = full_name(&lost.identity);
        next.push(format!(
            "{name} belongs to no m_unit now: `cara keys derive --fleet {fleet} {} --manager NAME/ID`",
            quoted(&name)
        ));
    }
    if members.nodes().is_empty() {
        next.push(format!("`cara keys derive --fleet {fleet} depot/1@m_unit agv-17/17` makes the keys of nodes"));
    }
    if written.iter().any(|written| written.change != Change::Removed) {
        let is_set = std::env::var_os("XDG_CONFIG_HOME").is_some_and(|folder| !folder.is_empty());
        let configuration = if is_set { "$XDG_CONFIG_HOME" } else { "~/.config" };
        next.push(format!(
            "bring each of these files to where its node runs, into {configuration}/cara/keys or /etc/cara/keys, for that \
             user alone; a board takes its own with `cara provision BOARD --keys FILE`"
        ));
    }
    let step = members.beside().map(|beside| if beside > members.generation() { "--switch" } else { "--finish" });
    next.extend(step.map(|step| format!("when all nodes have theirs: `cara keys rotate --fleet {fleet} {step}`")));
    next
}

fn object(store: &Store, written: &[Written], next: &[String]) -> serde_json::Value {
    let members = store.keys().members();
    let files = written.iter().map(|Written { identity, path, change }| {
        let change = match change {
            Change::New => "new",
            Change::Replaced => "replaced",
            Change::Removed => "removed",
        };
        json!({ "node": full_name(identity), "file": path, "change": change })
    });
    json!({
        "fleet": members.fleet().0,
        "root": shown(store.keys().fingerprint()),
        "folder": store.folder(),
        "generations": members.generations().collect::<Vec<_>>(),
        "written": files.collect::<Vec<_>>(),
        "next": next,
    })
}
