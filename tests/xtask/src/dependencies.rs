//! Every direct dependency has a line in `docs/dependencies.md` that says what it replaces, and no line is stale.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Result, bail};

use crate::{manifests, workspace};

/// Compares the manifests with the table of reasons.
pub(crate) fn check() -> Result<()> {
    let manifests = manifests::all()?;
    let own: BTreeSet<&str> = manifests.iter().map(|manifest| manifest.name.as_str()).collect();
    let used: BTreeSet<&str> = manifests
        .iter()
        .flat_map(|manifest| &manifest.dependencies)
        .map(|dependency| dependency.name.as_str())
        .filter(|name| !own.contains(name))
        .collect();
    let text = workspace::read(Path::new("docs/dependencies.md"))?;
    let wrong = differences(&used, &explained(&text));
    if wrong.is_empty() {
        println!("{} direct dependencies, each with its reason", used.len());
        return Ok(());
    }
    wrong.iter().for_each(|line| eprintln!("{line}"));
    bail!("docs/dependencies.md does not agree with the manifests")
}

/// The names of the first table's first column that have a reason in its last one. Below a heading are those not taken.
fn explained(text: &str) -> BTreeSet<&str> {
    text.lines().take_while(|line| !line.starts_with("## ")).filter_map(explained_name).collect()
}

fn explained_name(line: &str) -> Option<&str> {
    let row = line.trim().strip_prefix('|')?.strip_suffix('|')?;
    let (name, rest) = row.split_once('|')?;
    let reason = rest.rsplit('|').next()?;
    (reason.trim().len() > 10).then(|| name.trim().strip_prefix('`')?.strip_suffix('`'))?
}

fn differences(used: &BTreeSet<&str>, explained: &BTreeSet<&str>) -> Vec<String> {
    let missing = used.difference(explained).map(|name| format!("`{name}` is used and has no reason there"));
    let stale = explained.difference(used).map(|name| format!("`{name}` has a reason and is not used"));
    missing.chain(stale).collect()
}

#[cfg(test)]
mod tests {
    use super::{differences, explained};
    use std::collections::BTreeSet;

    const TABLE: &str = "| crate | where | what it replaces |\n|---|---|---|\n| `serde` | core | hand-written code for \
                         each message |\n| `bare` | core | |\n";

    #[test]
    fn a_line_counts_with_a_reason_only() {
        assert_eq!(explained(TABLE), BTreeSet::from(["serde"]));
        let not_taken = TABLE.replace("serde", "bson");
        assert_eq!(explained(&format!("{TABLE}\n## Not taken\n{not_taken}")), BTreeSet::from(["serde"]));
    }

    #[test]
    fn a_missing_and_a_stale_line_are_told() {
        let used = BTreeSet::from(["serde", "postcard"]);
        assert_eq!(differences(&used, &explained(TABLE)).len(), 1);
        assert_eq!(differences(&BTreeSet::new(), &explained(TABLE)).len(), 1);
        assert!(differences(&BTreeSet::from(["serde"]), &explained(TABLE)).is_empty());
    }
}
