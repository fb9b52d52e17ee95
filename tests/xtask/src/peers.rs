//! `cargo xtask peers`: builds the other systems that the experiments measure beside CARA, and says of each that cannot
//! be built what would bring it.

use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context, Result, ensure};
use toml::{Table, Value};

use crate::command::Run;
use crate::workspace;

/// The folder of the table and of everything that it names.
const FOLDER: &str = "tests/experiments/peers";

/// One entry of the table, as far as it matters here; `cara-bench` reads the rest.
struct Peer {
    name: String,
    system: String,
    needs: Vec<String>,
    install: String,
    build: String,
}

/// Builds those called `names`, or all. What is absent is told; what does not build fails.
pub(crate) fn run(names: &[String]) -> Result<ExitCode> {
    let peers = all()?;
    let known: Vec<&str> = peers.iter().map(|peer| peer.name.as_str()).collect();
    for name in names {
        ensure!(known.contains(&name.as_str()), "no other system is called {name}; there are {known:?}");
    }
    let chosen = peers.iter().filter(|peer| names.is_empty() || names.contains(&peer.name));
    let reported: Vec<(String, bool)> = chosen.map(Peer::build).collect();
    println!();
    reported.iter().for_each(|(line, _)| println!("{line}"));
    Ok(if reported.iter().all(|(_, is_fine)| *is_fine) { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn all() -> Result<Vec<Peer>> {
    let file = Path::new(FOLDER).join("peers.toml");
    let table: Table = workspace::read(&file)?.parse().with_context(|| format!("cannot read {}", file.display()))?;
    let listed = table.get("peer").and_then(Value::as_array).context("the table has no peers")?;
    listed.iter().map(|entry| Peer::new(entry).with_context(|| format!("an entry of {}", file.display()))).collect()
}

impl Peer {
    fn new(entry: &Value) -> Result<Self> {
        let text = |key: &str| -> Result<String> {
            Ok(entry.get(key).and_then(Value::as_str).with_context(|| format!("{key} is not given"))?.to_owned())
        };
        let needs = entry.get("needs").and_then(Value::as_array).context("needs is not given")?;
        let needs = needs.iter().filter_map(|need| need.as_str().map(str::to_owned)).collect();
        let (name, system, install, build) = (text("name")?, text("system")?, text("install")?, text("build")?);
        Ok(Self { name, system, needs, install, build })
    }

    /// What came of it, as a line, and whether nothing went wrong.
    fn build(&self) -> (String, bool) {
        let Self { name, system, install, .. } = self;
        let missing: Vec<&str> = self.needs.iter().map(String::as_str).filter(|need| !is_there(need)).collect();
        if !missing.is_empty() {
            return (format!("{name}: absent, {system} needs {}: {install}", missing.join(", ")), true);
        }
        let script = format!("cd {FOLDER}\n{}", self.build);
        match Run::new("sh").args(["-ec", &script]).stream() {
            Ok(()) => (format!("{name}: built"), true),
            Err(_) => (format!("{name}: {system} did not build; perhaps something is missing: {install}"), false),
        }
    }
}

/// Whether a program is in the path, or a file is where it should be.
fn is_there(program: &str) -> bool {
    if program.contains('/') {
        return Path::new(program).exists();
    }
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| folder.join(program).is_file())
}

#[cfg(test)]
mod tests {
    use super::{Peer, all, is_there};

    fn peer(needs: &str, build: &str) -> Peer {
        let (name, system, install) = ("other".into(), "Other".into(), "apt-get install other".into());
        Peer { name, system, needs: vec![needs.into()], install, build: build.into() }
    }

    #[test]
    fn the_table_can_be_read() {
        assert!(all().unwrap().iter().any(|peer| peer.name == "omniorb" && peer.install.contains("libomniorb4-dev")));
    }

    #[test]
    fn what_is_absent_is_told_with_what_brings_it() {
        let (line, is_fine) = peer("no-such-program", "true").build();
        assert!(is_fine && line.contains("no-such-program: apt-get install other"), "{line}");
    }

    #[test]
    fn what_does_not_build_fails() {
        assert!(peer("sh", "true").build().1);
        assert!(!peer("sh", "false\ntrue").build().1);
    }

    #[test]
    fn files_and_programs_are_looked_for() {
        assert!(is_there("sh") && is_there("/bin/sh"));
        assert!(!is_there("no-such-program") && !is_there("/bin/no-such-program"));
    }
}
