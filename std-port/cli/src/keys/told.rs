//! What was changed, and what to do next.

use cara_core::distribution::identity::Role;
use cara_std::keys::{Change, Members, Store, Written, full_name, shown};
use serde_json::json;

use crate::global::Global;
use crate::output;

/// What a command has done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Done {
    /// A root was drawn.
    Made,
    /// Nodes have got keys.
    Derived,
    /// Nodes were taken out.
    Revoked,
    /// A generation has begun.
    Rotated,
    /// All generations but the newest have ended.
    Finished,
}

/// Prints what a command has done.
pub(super) fn tell(done: Done, store: &Store, written: &[Written], global: &Global) -> anyhow::Result<()> {
    let next = next(done, store, written);
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

fn headline(done: Done, store: &Store) -> String {
    let members = store.keys().members();
    let (fleet, newest) = (members.fleet().0, members.generation());
    match done {
        Done::Made => format!(
            "fleet {fleet} has its root: {} ({}). Whoever reads it can speak as every node: keep a copy where nobody else \
             gets it",
            store.root_file().display(),
            shown(store.keys().fingerprint())
        ),
        Done::Derived => format!("fleet {fleet}, generation {newest}"),
        Done::Revoked => {
            let revoked = members.revoked().iter().filter(|revoked| revoked.from == newest);
            let names: Vec<_> = revoked.map(|revoked| full_name(&revoked.identity)).collect();
            format!("fleet {fleet}, generation {newest}: without {}", names.join(", "))
        }
        Done::Rotated => format!("fleet {fleet}, generation {newest} has begun: {}", in_use(members)),
        Done::Finished => format!("fleet {fleet}: only generation {newest} is in use"),
    }
}

fn in_use(members: &Members) -> String {
    let older: Vec<_> = members.generations().skip(1).map(|number| number.to_string()).collect();
    match older.as_slice() {
        [] => "no other is in use".into(),
        [one] => format!("{one} stays in use"),
        several => format!("{} stay in use", several.join(" and ")),
    }
}

fn next(done: Done, store: &Store, written: &[Written]) -> Vec<String> {
    let members = store.keys().members();
    let fleet = members.fleet().0;
    let mut next = Vec::new();
    for lost in members.nodes().iter().filter(|node| node.identity.role() == Role::SUnit && node.managers.is_empty()) {
        let name = full_name(&lost.identity);
        next.push(format!(
            "{name} belongs to no m_unit now: `cara keys derive --fleet {fleet} {name} --manager NAME/ID`"
        ));
    }
    if members.nodes().is_empty() {
        next.push(format!("`cara keys derive --fleet {fleet} depot/1@m_unit agv-17/17` makes the keys of nodes"));
    }
    if written.iter().any(|written| written.change != Change::Removed) {
        next.push(
            "bring each of these files to where its node runs, into ~/.config/cara/keys or /etc/cara/keys, for that \
             user alone; a board takes its own with `cara provision BOARD --keys FILE`"
                .into(),
        );
    }
    match done {
        Done::Revoked | Done::Rotated => {
            let finish = format!("`cara keys rotate --fleet {fleet} --finish`");
            next.push(format!("when all nodes have theirs: {finish}; until then {}", in_use(members)));
        }
        Done::Finished => next.push("a node takes older keys until it has its file".into()),
        Done::Made | Done::Derived => {}
    }
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
