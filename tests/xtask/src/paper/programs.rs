//! Which test a name like `core/src/time.rs::name` is: the program that cargo makes of its file, and its name in there.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde_json::Value;

use super::RULES;
use crate::command::Run;

/// The programs that run scenarios, whose files are no modules of theirs: they know a scenario by its bare name.
const SUITES: &str = "tests/scenarios/tests/";

/// A test program that cargo has built.
pub(crate) struct Program {
    /// Its main source file, relative to the root.
    source: String,
    /// The folder of its package, in which cargo would run it.
    package: PathBuf,
    executable: String,
    tests: Vec<String>,
}

impl Program {
    /// Builds what `cargo test` with these arguments would run, and asks each program for its tests.
    pub(crate) fn build(cargo: Run, root: &Path, arguments: &[&str]) -> Result<Vec<Self>> {
        let words = ["test", "--quiet", "--no-run", "--message-format=json-render-diagnostics"];
        let output = cargo.args(words).args(arguments).text()?;
        let artifacts = output.lines().filter_map(|line| serde_json::from_str(line).ok());
        artifacts.filter_map(|artifact: Value| Self::new(root, &artifact).transpose()).collect()
    }

    /// The program of one of cargo's messages, if it is one about a test program.
    fn new(root: &Path, artifact: &Value) -> Result<Option<Self>> {
        let text = |value: &Value| value.as_str().map(str::to_owned);
        let (true, Some(executable)) = (artifact["profile"]["test"] == true, text(&artifact["executable"])) else {
            return Ok(None);
        };
        let source = text(&artifact["target"]["src_path"]).context("an artifact without source")?;
        let manifest = PathBuf::from(text(&artifact["manifest_path"]).context("an artifact without manifest")?);
        let package = manifest.parent().unwrap_or(root).to_owned();
        let listed = Run::new(&executable).within(&package).args(["--list"]).text()?;
        Ok(Some(Self {
            source: Path::new(&source).strip_prefix(root).unwrap_or(Path::new(&source)).to_string_lossy().into_owned(),
            package,
            executable,
            tests: listed.lines().filter_map(|line| line.strip_suffix(": test")).map(str::to_owned).collect(),
        }))
    }

    /// The name in this program of a test that documents call `reference`.
    pub(crate) fn test(&self, reference: &str) -> Option<&str> {
        let (file, name) = reference.split_once("::")?;
        let module = self.module(file)?;
        let is = |test: &&String| {
            let inner = test.strip_prefix(&module).filter(|rest| module.is_empty() || rest.starts_with("::"));
            inner.is_some_and(|inner| inner.rsplit("::").next() == name.rsplit("::").next())
        };
        self.tests.iter().find(is).map(String::as_str)
    }

    /// The module that a file is in this program.
    fn module(&self, file: &str) -> Option<String> {
        if file == self.source || (file.starts_with(RULES) && self.source.starts_with(SUITES)) {
            return Some(String::new());
        }
        let (folder, _) = self.source.rsplit_once('/')?;
        let inner = file.strip_prefix(folder)?.strip_prefix('/')?.strip_suffix(".rs")?;
        Some(inner.strip_suffix("/mod").unwrap_or(inner).replace('/', "::"))
    }

    /// Whether the test passes; an error unless it ran to its end.
    pub(crate) fn passes(&self, test: &str) -> Result<bool> {
        let run = Run::new("timeout").within(&self.package).args(["--kill-after=5", LIMIT, &self.executable]);
        let (_, output, errors) = run.env("RUST_MIN_STACK", STACK).args([test, "--exact"]).captured()?;
        let line = format!("test {test} ");
        let ended = output.lines().filter(|found| found.starts_with(&line));
        let verdict = ended.filter_map(|line| line.split_once(" ... ")?.1.split_whitespace().next()).next();
        match verdict {
            Some("ok") => Ok(true),
            Some("FAILED") => Ok(false),
            _ => bail!("{test} did not come to an end: {}", errors.trim()),
        }
    }
}

/// Seconds that a test may take.
const LIMIT: &str = "150";
/// Bytes of a test's stack: without optimisation the boards of a scenario need more than the usual 2 MiB.
const STACK: &str = "33554432";

/// What to tell cargo, so that it builds the program of a test that documents call `reference`, and not much else.
pub(crate) fn selection(root: &Path, reference: &str) -> Result<Vec<String>> {
    let (file, _) = reference.split_once("::").with_context(|| format!("{reference} is no test"))?;
    if file.starts_with(RULES) {
        return Ok(["--package", "cara-scenarios", "--test", "simulator"].map(str::to_owned).into());
    }
    let folder = Path::new(file).ancestors().skip(1).find(|folder| root.join(folder).join("Cargo.toml").is_file());
    let folder = folder.with_context(|| format!("{file} is in no package"))?;
    let manifest: toml::Table = std::fs::read_to_string(root.join(folder).join("Cargo.toml"))?.parse()?;
    let name = manifest["package"]["name"].as_str().context("a package without name")?;
    let inner = Path::new(file).strip_prefix(folder)?;
    let mut parts = inner.iter().map(|part| part.to_string_lossy());
    let mut chosen = vec!["--package".to_owned(), name.to_owned()];
    match (parts.next().as_deref(), parts.next()) {
        (Some("tests"), Some(test)) => chosen.extend(["--test".to_owned(), test.trim_end_matches(".rs").to_owned()]),
        _ if root.join(folder).join("src/lib.rs").is_file() => chosen.push("--lib".to_owned()),
        _ => chosen.push("--bins".to_owned()),
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::Program;

    fn program(source: &str, tests: &[&str]) -> Program {
        let tests = tests.iter().map(|&test| test.to_owned()).collect();
        Program { source: source.to_owned(), package: "".into(), executable: String::new(), tests }
    }

    #[test]
    fn a_reference_leads_to_the_test_of_its_module() {
        let library = program("core/src/lib.rs", &["a::tests::one", "b::two", "b::inner::three", "ab::one"]);
        assert_eq!(library.test("core/src/a.rs::one"), Some("a::tests::one"));
        assert_eq!(library.test("core/src/b/mod.rs::two"), Some("b::two"));
        assert_eq!(library.test("core/src/b.rs::inner::three"), Some("b::inner::three"));
        for other in ["core/src/a.rs::two", "core/src/a.rs", "std-port/src/a.rs::one", "core/src/b.rs::one"] {
            assert_eq!(library.test(other), None, "{other}");
        }
        let outside = program("std-port/tests/port/main.rs", &["calls::one"]);
        assert_eq!(outside.test("std-port/tests/port/calls.rs::one"), Some("calls::one"));
        let suite = program("tests/scenarios/tests/linux.rs", &["one"]);
        assert_eq!(suite.test("tests/scenarios/src/rules/calls.rs::one"), Some("one"));
    }
}
