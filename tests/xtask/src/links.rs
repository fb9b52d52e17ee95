//! Relative links of the Markdown documents lead to files that exist.

use std::path::Path;

use anyhow::{Result, bail};

use crate::workspace;

/// Reads every Markdown file and fails with all links that lead nowhere.
pub(crate) fn check() -> Result<()> {
    let files = workspace::files_with("md")?;
    let (mut count, mut broken) = (0, Vec::new());
    for file in &files {
        let text = workspace::read(file)?;
        let folder = file.parent().unwrap_or(Path::new(""));
        for target in targets(&text) {
            count += 1;
            if !workspace::root().join(folder).join(target).exists() {
                broken.push(format!("{}: {target} does not exist", file.display()));
            }
        }
    }
    if broken.is_empty() {
        println!("{count} relative links in {} documents", files.len());
        return Ok(());
    }
    broken.iter().for_each(|line| eprintln!("{line}"));
    bail!("{} links lead nowhere", broken.len())
}

/// The files that `](…)` names, without anchors; addresses on the net are not looked up.
fn targets(text: &str) -> impl Iterator<Item = &str> {
    text.split("](").skip(1).filter_map(|rest| {
        let target = rest.split(')').next()?.split('#').next()?.trim();
        (!target.is_empty() && !target.contains("://") && !target.starts_with("mailto:")).then_some(target)
    })
}

#[cfg(test)]
mod tests {
    use super::targets;

    #[test]
    fn relative_targets_are_found() {
        let text = "[a](docs/wire.md#frames) [b](https://example.org) [c](#here) ![d](e.svg)";
        assert_eq!(targets(text).collect::<Vec<_>>(), ["docs/wire.md", "e.svg"]);
    }
}
