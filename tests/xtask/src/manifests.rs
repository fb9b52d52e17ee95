//! The arrows between crates, read from the manifests: examples, tests and the command line stand on the ports, the
//! ports on the core.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use toml::{Table, Value};

use crate::workspace;

/// A manifest of the project, whether or not it is a member of the workspace.
pub(crate) struct Manifest {
    /// From the project's root, as `core/Cargo.toml`.
    pub(crate) file: PathBuf,
    /// The package's name.
    pub(crate) name: String,
    /// Dependencies of any kind, each with whether only tests see it.
    pub(crate) dependencies: Vec<Dependency>,
    table: Table,
}

/// One line below `[dependencies]` or one of its relatives.
pub(crate) struct Dependency {
    /// The package's name, also where the manifest gives it another one.
    pub(crate) name: String,
    /// Below `[dev-dependencies]`.
    pub(crate) for_tests: bool,
}

/// What may stand on what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    Core,
    /// Member crates of the core: typed services and the cipher.
    CoreMember,
    Port,
    /// What a program adds to the Linux port, which does not know it.
    Provider,
    CommandLine,
    /// Recordings, for programs on the Linux port.
    Recording,
    /// Speaks for units of CARA to what a plant has.
    Gateway,
    Examples,
    Tests,
    /// Tests of whole programs, on which no other crate stands.
    ProgramTests,
}

/// Packages that need an operating system, a runtime or a network stack: never below the core.
const NOT_IN_CORE: [&str; 12] = [
    "async-std",
    "embassy",
    "libc",
    "mio",
    "nix",
    "polling",
    "rustix",
    "smol",
    "smoltcp",
    "socket2",
    "tokio",
    "winapi",
];

/// Fails with every dependency between crates that points the wrong way.
pub(crate) fn check() -> Result<()> {
    let manifests = all()?;
    let wrong = wrong_arrows(&manifests);
    if wrong.is_empty() {
        println!("{} manifests, every arrow points down", manifests.len());
        return Ok(());
    }
    wrong.iter().for_each(|line| eprintln!("{line}"));
    bail!("{} wrong arrows between crates", wrong.len())
}

/// Every manifest of the project that has a package.
pub(crate) fn all() -> Result<Vec<Manifest>> {
    let shared = parsed(Path::new("Cargo.toml"))?;
    let mut manifests = Vec::new();
    for file in workspace::files()? {
        if file.file_name().is_some_and(|name| name == "Cargo.toml") {
            manifests.extend(Manifest::new(file.clone(), parsed(&file)?, &shared));
        }
    }
    Ok(manifests)
}

fn parsed(file: &Path) -> Result<Table> {
    workspace::read(file)?.parse().with_context(|| format!("cannot read {}", file.display()))
}

impl Manifest {
    /// `None` for a manifest without a package, such as the root's. `root` holds the shared dependencies.
    fn new(file: PathBuf, table: Table, root: &Table) -> Option<Self> {
        let name = table.get("package")?.get("name")?.as_str()?.to_owned();
        let mut dependencies = Vec::new();
        collect(&table, root, &mut dependencies);
        for target in table.get("target").and_then(Value::as_table).into_iter().flat_map(|targets| targets.values()) {
            target.as_table().into_iter().for_each(|table| collect(table, root, &mut dependencies));
        }
        Some(Self { file, name, dependencies, table })
    }

    /// Whether it is a workspace of its own, which the root's commands do not reach.
    pub(crate) fn is_workspace(&self) -> bool {
        self.table.contains_key("workspace")
    }

    /// The oldest Rust that it names, or `none`; `None` where it inherits that of its workspace.
    pub(crate) fn rust_version(&self) -> Option<&str> {
        let named = self.table.get("package").and_then(|package| package.get("rust-version"));
        named.map_or(Some("none"), Value::as_str)
    }

    fn place(&self) -> Option<Place> {
        let mut folders = self.file.components().map(|component| component.as_os_str().to_str().unwrap_or_default());
        if ["page", "libfuzzer"].iter().any(|folder| self.file.starts_with(Path::new("tests/fuzz").join(folder))) {
            return Some(Place::ProgramTests);
        }
        match (folders.next()?, folders.next()?) {
            ("core", "Cargo.toml") => Some(Place::Core),
            ("core", _) => Some(Place::CoreMember),
            ("std-port", "etcd") => Some(Place::Provider),
            ("std-port", "cli") => Some(Place::CommandLine),
            ("std-port", "recording") => Some(Place::Recording),
            ("std-port" | "embassy-port", _) => Some(Place::Port),
            ("gateways", _) => Some(Place::Gateway),
            ("examples", _) => Some(Place::Examples),
            ("tests", _) => Some(Place::Tests),
            _ => None,
        }
    }

    fn forbids_unsafe(&self) -> bool {
        let lints = self.table.get("lints");
        let own = lints.and_then(|lints| lints.get("rust")).and_then(|rust| rust.get("unsafe_code"));
        let shared = lints.and_then(|lints| lints.get("workspace")).and_then(Value::as_bool);
        shared == Some(true) || own.and_then(Value::as_str) == Some("forbid")
    }
}

fn collect(table: &Table, root: &Table, found: &mut Vec<Dependency>) {
    for kind in ["dependencies", "dev-dependencies", "build-dependencies"] {
        for (key, value) in table.get(kind).and_then(Value::as_table).into_iter().flatten() {
            let name = package(value, key, root).to_owned();
            found.push(Dependency { name, for_tests: kind == "dev-dependencies" });
        }
    }
}

/// The package that a dependency means, which `package = "…"` here or in the workspace may rename.
fn package<'t>(value: &'t Value, key: &'t str, root: &'t Table) -> &'t str {
    let shared = || root.get("workspace")?.get("dependencies")?.get(key)?.get("package")?.as_str();
    value.get("package").and_then(Value::as_str).or_else(shared).unwrap_or(key)
}

fn wrong_arrows(manifests: &[Manifest]) -> Vec<String> {
    let places: BTreeMap<&str, Option<Place>> =
        manifests.iter().map(|manifest| (manifest.name.as_str(), manifest.place())).collect();
    let mut wrong = Vec::new();
    for manifest in manifests {
        let file = manifest.file.display();
        let Some(from) = manifest.place() else {
            wrong.push(format!("{file}: the design has no place for this crate"));
            continue;
        };
        if matches!(from, Place::Core | Place::CoreMember)
            || ["std-port", "gateways"].iter().any(|folder| manifest.file.starts_with(folder))
        {
            let why = "must say unsafe_code = \"forbid\" in its lints";
            wrong.extend((!manifest.forbids_unsafe()).then(|| format!("{file}: {why}")));
        }
        for Dependency { name, for_tests } in &manifest.dependencies {
            if let Some(Some(to)) = places.get(name.as_str()) {
                if !allowed(from, *to, *for_tests) {
                    wrong.push(format!("{file}: {from:?} must not depend on {name} ({to:?})"));
                }
            } else if from == Place::Core && !for_tests && NOT_IN_CORE.iter().any(|banned| name.starts_with(banned)) {
                wrong.push(format!("{file}: the core must not depend on {name}"));
            }
        }
    }
    wrong
}

fn allowed(from: Place, to: Place, for_tests: bool) -> bool {
    match (from, to) {
        // Typed services are a macro that the core re-exports.
        (Place::Core, to) => to == Place::CoreMember,
        (Place::CoreMember, to) => matches!(to, Place::Core | Place::CoreMember),
        (Place::Port, Place::Core | Place::CoreMember) => true,
        // What tests of ports stand on: networks, processes, applications.
        (
            Place::Port | Place::Provider | Place::Recording | Place::CommandLine | Place::Gateway,
            Place::Tests | Place::Examples,
        ) => for_tests,
        (Place::Port, _) => false,
        (_, Place::Core | Place::CoreMember | Place::Port) => true,
        // The simulator is there for an application's own tests.
        (Place::Examples, Place::Tests) => for_tests,
        (Place::ProgramTests, to) => to != Place::Gateway,
        (_, Place::ProgramTests) => false,
        (Place::Provider | Place::Recording, Place::Provider | Place::Recording | Place::CommandLine) => false,
        (Place::CommandLine, Place::Provider) => false,
        (_, Place::Recording) => true,
        (_, Place::Provider) | (Place::CommandLine, Place::CommandLine) => true,
        (Place::Examples, Place::Examples) | (Place::Tests, Place::Tests | Place::Examples) => true,
        (Place::Tests | Place::Examples | Place::Gateway, Place::CommandLine) | (_, Place::Gateway) => false,
    }
}

#[cfg(test)]
mod tests {
    use super::{Manifest, wrong_arrows};
    use toml::Table;

    fn manifest(file: &str, text: &str) -> Manifest {
        let root: Table = "[workspace.dependencies]\ncara-core = { path = \"core\" }".parse().unwrap();
        let text = format!("lints.workspace = true\n{text}");
        Manifest::new(file.into(), text.parse().unwrap(), &root).unwrap()
    }

    fn wrong(std_port: &str, core: &str) -> Vec<String> {
        let package = |name: &str, rest: &str| format!("[package]\nname = \"{name}\"\n{rest}");
        wrong_arrows(&[
            manifest("core/Cargo.toml", &package("cara-core", core)),
            manifest("std-port/Cargo.toml", &package("cara-std", std_port)),
            manifest("tests/sim/Cargo.toml", &package("cara-sim", "[dependencies]\ncara-core.workspace = true")),
        ])
    }

    #[test]
    fn ports_stand_on_the_core() {
        assert!(wrong("[dependencies]\ncara-core.workspace = true\nlibc = \"1\"", "").is_empty());
    }

    #[test]
    fn the_core_stands_on_no_port() {
        assert_eq!(wrong("", "[dependencies]\ncara-std = { path = \"../std-port\" }").len(), 1);
    }

    #[test]
    fn a_renamed_dependency_is_seen() {
        assert_eq!(wrong("", "[dev-dependencies]\nport = { path = \"../std-port\", package = \"cara-std\" }").len(), 1);
    }

    #[test]
    fn a_target_table_is_seen() {
        assert_eq!(wrong("[target.'cfg(unix)'.dependencies]\ncara-sim = { path = \"../tests/sim\" }", "").len(), 1);
    }

    #[test]
    fn the_core_needs_no_runtime() {
        assert_eq!(wrong("", "[dependencies]\nembassy-time = \"1\"\ntokio = \"1\"").len(), 2);
        assert!(wrong("", "[dev-dependencies]\ntokio = \"1\"").is_empty());
    }

    #[test]
    fn only_tests_of_programs_stand_on_the_command_line() {
        let package = |name: &str, on: &str| format!("[package]\nname = \"{name}\"\n[dependencies]\n{on} = \"1\"");
        let wrong = |folder: &str, other_on: &str| {
            wrong_arrows(&[
                manifest("std-port/cli/web/Cargo.toml", "[package]\nname = \"cara-web\""),
                manifest(&format!("tests/{folder}/Cargo.toml"), &package("tested", "cara-web")),
                manifest("tests/other/Cargo.toml", &package("other", other_on)),
            ])
        };
        assert!(wrong("fuzz/page", "serde").is_empty());
        assert_eq!(wrong("fuzz/page", "tested").len(), 1);
        assert_eq!(wrong("page", "serde").len(), 1);
    }

    #[test]
    fn unsafe_must_be_forbidden() {
        let root = Table::new();
        let table = "[package]\nname = \"cara-core\"".parse().unwrap();
        let core = Manifest::new("core/Cargo.toml".into(), table, &root).unwrap();
        assert_eq!(wrong_arrows(&[core]).len(), 1);
    }
}
