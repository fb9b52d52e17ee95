//! What a build of the embassy port can leave out: it builds without any of it, with each alone, and with all.

use anyhow::{Context, Result};
use toml::Table;

use crate::command::Run;
use crate::{install, workspace};

/// A processor without atomic exchange, one with it, and one with floating point.
const TARGETS: [&str; 3] = ["thumbv6m-none-eabi", "thumbv7m-none-eabi", "thumbv7em-none-eabihf"];
/// What a unit reaches others over: one of them is always there.
const TRANSPORTS: [&str; 2] = ["net", "line"];

/// Gets what compilers need for them.
pub(crate) fn targets() -> Result<(), String> {
    TARGETS.into_iter().try_for_each(install::rust_target)
}

/// Builds all of it.
pub(crate) fn abilities() -> Result<()> {
    let features = features(&workspace::read("embassy-port/Cargo.toml".as_ref())?)?;
    for target in TARGETS {
        for transport in TRANSPORTS {
            check(target, &["--no-default-features", "--features", transport])?;
        }
        for feature in &features {
            check(target, &["--no-default-features", "--features", &format!("net,{feature}")])?;
        }
        check(target, &["--all-features"])?;
        println!("{target}: none, each of {} and all build", features.join(", "));
    }
    Ok(())
}

fn check(target: &str, features: &[&str]) -> Result<()> {
    let place = ["--target-dir", "target/abilities", "--target", target];
    let check = Run::cargo().args(["check", "--quiet", "--package", "cara-embassy"]).args(place).args(features);
    check.env("RUSTFLAGS", "-D warnings").stream().with_context(|| features.join(" "))
}

/// Those of a manifest that can be left out.
fn features(manifest: &str) -> Result<Vec<String>> {
    let manifest: Table = manifest.parse()?;
    let features =
        manifest.get("features").and_then(|features| features.as_table()).context("there are no features")?;
    let can_be_left_out = |name: &&String| *name != "default" && !TRANSPORTS.contains(&name.as_str());
    Ok(features.keys().filter(can_be_left_out).cloned().collect())
}

#[cfg(test)]
mod tests {
    use super::features;

    #[test]
    fn transports_and_the_default_are_no_abilities() {
        let manifest = "[features]\ndefault = [\"call\"]\ncall = []\nline = []\nnet = []\nrekey = []\n";
        assert_eq!(features(manifest).unwrap(), ["call", "rekey"]);
        assert!(features("[package]\n").is_err());
    }
}
