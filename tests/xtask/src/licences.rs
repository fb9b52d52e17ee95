//! Licences and sources of everything in the lock file: what may be linked, and from the registry only.

use std::collections::{HashMap, HashSet};
use std::path::Path;

use anyhow::{Result, bail, ensure};
use serde_json::Value;

use crate::command::Run;
use crate::workspace;

/// Licences that MIT OR Apache-2.0 software may be linked with.
const ALLOWED: [&str; 12] = [
    "0BSD",
    "Apache-2.0",
    "Apache-2.0 WITH LLVM-exception",
    "BSD-2-Clause",
    "BSD-3-Clause",
    "BSL-1.0",
    "CC0-1.0",
    "ISC",
    "MIT",
    "Unicode-3.0",
    "Unlicense",
    "Zlib",
];

/// Licences of crates that only tests use, unchanged and not distributed.
const ALLOWED_IN_TESTS: [&str; 1] = ["MPL-2.0"];

const REGISTRY: &str = "registry+https://github.com/rust-lang/crates.io-index";

/// Asks cargo for all packages and fails with those that may not be used.
pub(crate) fn check() -> Result<()> {
    let metadata = workspace::metadata(Path::new("Cargo.toml"))?;
    let packages = metadata.get("packages").and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
    let shipped = shipped(&metadata);
    let is_shipped = |package: &Value| package.get("id").and_then(Value::as_str).is_none_or(|id| shipped.contains(id));
    let wrong: Vec<String> = packages.iter().filter_map(|package| objection(package, is_shipped(package))).collect();
    if packages.is_empty() {
        bail!("cargo metadata names no packages");
    }
    if wrong.is_empty() {
        println!("{} packages, all licences and sources allowed", packages.len());
        return Ok(());
    }
    wrong.iter().for_each(|line| eprintln!("{line}"));
    bail!("{} packages may not be used", wrong.len())
}

/// Asks cargo-deny about every workspace of the repository, with all features; deny.toml says what is allowed.
pub(crate) fn deny(tool: &Path) -> Result<()> {
    let mut failed = Vec::new();
    for lock in workspace::files()?.iter().filter(|file| file.ends_with("Cargo.lock")) {
        let deny = Run::new(&tool.to_string_lossy()).args(["--locked", "--config", "deny.toml", "--manifest-path"]);
        let check = deny.args([lock.with_file_name("Cargo.toml")]).args(["check", "--hide-inclusion-graph"]);
        if check.args(["licenses", "bans", "sources"]).stream().is_err() {
            failed.push(lock.display().to_string());
        }
    }
    ensure!(failed.is_empty(), "cargo-deny objects to {}", failed.join(", "));
    Ok(())
}

/// Everything that is linked into a crate outside `tests`.
fn shipped(metadata: &Value) -> HashSet<&str> {
    let list = |value: &'_ Value, key: &str| value.get(key).and_then(Value::as_array).cloned().unwrap_or_default();
    let nodes = metadata.get("resolve").and_then(|resolve| resolve.get("nodes")).and_then(Value::as_array);
    let edges: HashMap<&str, &Value> =
        nodes.into_iter().flatten().filter_map(|node| Some((node.get("id")?.as_str()?, node))).collect();
    let members = metadata.get("workspace_members").and_then(Value::as_array).into_iter().flatten();
    let mut left: Vec<&str> = members.filter_map(Value::as_str).filter(|id| !id.contains("/tests/")).collect();
    let mut found = HashSet::new();
    while let Some(id) = left.pop() {
        if found.insert(id) {
            let dependencies = edges.get(id).and_then(|node| node.get("deps")).and_then(Value::as_array);
            let linked = |dependency: &&Value| list(dependency, "dep_kinds").iter().any(|kind| kind["kind"] != "dev");
            let ids = dependencies.into_iter().flatten().filter(linked).filter_map(|one| one.get("pkg")?.as_str());
            left.extend(ids);
        }
    }
    found
}

fn objection(package: &Value, is_shipped: bool) -> Option<String> {
    let text = |key: &str| package.get(key).and_then(Value::as_str);
    let name = format!("{} {}", text("name").unwrap_or("?"), text("version").unwrap_or("?"));
    if let Some(source) = text("source").filter(|source| *source != REGISTRY) {
        return Some(format!("{name}: comes from {source}, not from the registry"));
    }
    match text("license") {
        None => Some(format!("{name}: names no licence")),
        Some(licence) if !is_shipped && ALLOWED_IN_TESTS.contains(&licence) => None,
        Some(licence) if !is_allowed(licence) => Some(format!("{name}: licence {licence}")),
        Some(_) => None,
    }
}

/// Reads an SPDX expression as alternatives of conjunctions, brackets included.
fn is_allowed(expression: &str) -> bool {
    let expression = expression.replace('/', " OR ");
    split(&expression, " OR ").iter().any(|alternative| {
        split(alternative, " AND ").iter().all(|part| {
            let part = part.trim();
            match part.strip_prefix('(').and_then(|part| part.strip_suffix(')')) {
                Some(inner) => is_allowed(inner),
                None => ALLOWED.contains(&part),
            }
        })
    })
}

/// Splits at `separator` where no bracket is open.
fn split<'t>(text: &'t str, separator: &str) -> Vec<&'t str> {
    let (mut parts, mut depth, mut start) = (Vec::new(), 0_i32, 0);
    for (at, c) in text.char_indices() {
        depth += i32::from(c == '(') - i32::from(c == ')');
        if depth == 0 && at >= start && text[at..].starts_with(separator) {
            parts.push(&text[start..at]);
            start = at + separator.len();
        }
    }
    parts.push(&text[start..]);
    parts
}

#[cfg(test)]
mod tests {
    use super::{is_allowed, objection, shipped};
    use serde_json::json;

    #[test]
    fn expressions_are_read() {
        assert!(is_allowed("MIT OR Apache-2.0"));
        assert!(is_allowed("MIT/Apache-2.0"));
        assert!(is_allowed("(MIT OR GPL-3.0) AND Unicode-3.0"));
        assert!(is_allowed("GPL-3.0 OR MIT"));
        assert!(!is_allowed("MIT AND GPL-3.0"));
        assert!(!is_allowed("(MIT AND GPL-3.0)"));
        assert!(!is_allowed(""));
    }

    #[test]
    fn git_sources_are_refused() {
        assert!(
            objection(&json!({"name": "a", "license": "MIT", "source": "git+https://example.org/a"}), true).is_some()
        );
        assert!(objection(&json!({"name": "a", "license": "MIT", "source": null}), true).is_none());
        assert!(objection(&json!({"name": "a", "source": null}), true).is_some());
    }

    #[test]
    fn what_only_tests_use_may_have_a_licence_of_its_own() {
        let package = json!({"name": "a", "license": "MPL-2.0", "source": null});
        assert!(objection(&package, true).is_some() && objection(&package, false).is_none());
        let (kept, dev) = (json!([{"kind": null}]), json!([{"kind": "dev"}]));
        let metadata = json!({
            "workspace_members": ["path+file:///x/core#a@1", "path+file:///x/tests/b#b@1"],
            "resolve": {"nodes": [
                {"id": "path+file:///x/core#a@1", "deps": [{"pkg": "linked", "dep_kinds": kept}, {"pkg": "dev", "dep_kinds": dev}]},
                {"id": "path+file:///x/tests/b#b@1", "deps": [{"pkg": "mpl", "dep_kinds": kept}]},
                {"id": "linked", "deps": [{"pkg": "deep", "dep_kinds": kept}]},
            ]},
        });
        let mut found: Vec<&str> = shipped(&metadata).into_iter().collect();
        found.sort_unstable();
        assert_eq!(found, ["deep", "linked", "path+file:///x/core#a@1"]);
    }
}
