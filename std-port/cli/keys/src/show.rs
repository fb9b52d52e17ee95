//! Whose keys there are, by fingerprints: nothing of a key can be computed from one.

use std::path::Path;

use cara_std::keys::{KeyRing, Member, Store, full_name, shown};
use serde_json::json;

use super::report::generations;
use cara_tools::exit::Ended;
use cara_tools::global::Global;
use cara_tools::keys::failed;
use cara_tools::output::{self, FAINT, PLAIN, Rows};

/// Prints the nodes of a fleet.
pub(super) fn fleet(store: &Store, global: &Global) -> anyhow::Result<()> {
    if global.json {
        return Ok(output::object(&fleet_object(store))?);
    }
    let keys = store.keys();
    let members = keys.members();
    let (fleet, generations, root) = (members.fleet().0, generations(members), shown(keys.fingerprint()));
    output::line(format_args!("fleet {fleet}, {generations}, root {root}"))?;
    let mut rows = Rows::new(["node", "since", "belongs to", "talks to", "file"]);
    for node in members.nodes() {
        let path = store.file_of(&node.identity);
        let file = if path.exists() { path.display().to_string() } else { "not here".into() };
        let peers = members.peers(node).count().to_string();
        rows.add(PLAIN, [full_name(&node.identity), node.since.to_string(), managers(node).join(", "), peers, file]);
    }
    for revoked in members.revoked() {
        let name = full_name(&revoked.identity);
        rows.add(FAINT, [name, String::new(), String::new(), String::new(), format!("revoked with {}", revoked.from)]);
    }
    Ok(rows.print()?)
}

fn managers(node: &Member) -> Vec<String> {
    node.managers.iter().map(ToString::to_string).collect()
}

fn fleet_object(store: &Store) -> serde_json::Value {
    let members = store.keys().members();
    let nodes = members.nodes().iter().map(|node| {
        let peers: Vec<_> = members.peers(node).map(|peer| full_name(&peer.identity)).collect();
        let path = store.file_of(&node.identity);
        json!({
            "node": full_name(&node.identity), "since": node.since, "managers": managers(node), "peers": peers,
            "file": path.exists().then_some(path),
        })
    });
    let revoked = members.revoked().iter();
    let revoked = revoked.map(|revoked| json!({ "node": full_name(&revoked.identity), "from": revoked.from }));
    json!({
        "fleet": members.fleet().0,
        "root": shown(store.keys().fingerprint()),
        "folder": store.folder(),
        "generations": members.generations().collect::<Vec<_>>(),
        "nodes": nodes.collect::<Vec<_>>(),
        "revoked": revoked.collect::<Vec<_>>(),
    })
}

/// Prints what is in a node's file.
pub(super) fn ring(file: &Path, global: &Global) -> anyhow::Result<()> {
    if file.to_str().is_some_and(|text| cara_std::keys::parse_node(text).is_ok()) && !file.exists() {
        let text = format!("{} is no file: `cara keys show` tells the file of each node", file.display());
        return Err(Ended::usage(text));
    }
    let ring = KeyRing::load(file).map_err(failed)?;
    if global.json {
        return Ok(output::object(&ring_object(&ring))?);
    }
    let (node, fleet) = (full_name(ring.identity()), ring.fleet().0);
    output::line(format_args!("{node} in fleet {fleet}, generation {} is in use", ring.generation()))?;
    let mut rows = Rows::new(["generation", "with", "fingerprint"]);
    for (number, key) in ring.discoveries() {
        rows.add(PLAIN, [number.to_string(), "discovery".into(), shown(key.fingerprint())]);
        for (peer, fingerprint) in pairs(&ring, number) {
            rows.add(PLAIN, [number.to_string(), peer, fingerprint]);
        }
    }
    Ok(rows.print()?)
}

/// The peers of a generation, each with the fingerprint of its key.
fn pairs(ring: &KeyRing, generation: u32) -> impl Iterator<Item = (String, String)> {
    let peers = ring.peers().into_iter();
    peers.filter_map(move |peer| Some((full_name(peer), shown(ring.pair_in(generation, peer)?.fingerprint()))))
}

fn ring_object(ring: &KeyRing) -> serde_json::Value {
    let generations = ring.discoveries().map(|(number, key)| {
        let pairs = pairs(ring, number).map(|(peer, fingerprint)| json!({ "with": peer, "fingerprint": fingerprint }));
        json!({ "generation": number, "discovery": shown(key.fingerprint()), "pairs": pairs.collect::<Vec<_>>() })
    });
    json!({
        "node": full_name(ring.identity()), "fleet": ring.fleet().0, "keys": generations.collect::<Vec<_>>(),
    })
}
