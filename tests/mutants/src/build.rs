//! Builds the tests that judge, and runs them.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;

/// What judges, the quickest first: package, program, and the tests of it. Faults that come seldom need many seeds.
const JUDGES: [(&str, &str, &[&str]); 6] = [
    ("cara-core", "cara_core", &["services::lease", "distribution::latch", "distribution::claim", "services::heart"]),
    ("cara-core", "cara_core", &["services::", "distribution::connection_handler"]),
    ("cara-sim", "chaos", &["whatever"]),
    ("cara-sim", "world", &[]),
    ("cara-sim", "standby", &[]),
    ("cara-sim", "orders", &["five_vehicles"]),
];
const SEEDS: &str = "24";
/// Longest run of one judge. Without a bug each takes a small part of it.
const LONGEST: Duration = Duration::from_secs(180);

/// An error of the compiler.
pub(crate) struct Wrong {
    pub(crate) file: String,
    /// Bytes of the file.
    pub(crate) place: Range<usize>,
    /// A function that is needed in a constant.
    pub(crate) constant: Option<String>,
    pub(crate) text: String,
}

/// The programs of [`JUDGES`], each with the folder that its tests run in.
pub(crate) struct Programs(Vec<(PathBuf, PathBuf)>);

/// Builds all, or says what is wrong.
pub(crate) fn build(tree: &Path) -> Result<Result<Programs, Vec<Wrong>>> {
    let cargo = |arguments: &[&str]| -> Result<Vec<Value>> {
        let mut cargo = Command::new(std::env::var("CARGO").unwrap_or_else(|_| "cargo".into()));
        cargo.current_dir(tree).args(arguments).args(["--message-format", "json", "--quiet"]);
        cargo.stderr(Stdio::inherit());
        let output = cargo.output()?;
        let lines = std::str::from_utf8(&output.stdout)?.lines();
        lines.map(|line| Ok(serde_json::from_str(line)?)).collect()
    };
    let checked = cargo(&["check", "-p", "cara-core", "--all-features", "--keep-going"])?;
    let wrong = errors(&checked);
    if !wrong.is_empty() {
        return Ok(Err(wrong));
    }
    let packages = ["-p", "cara-core", "-p", "cara-sim"];
    let tests = ["--test", "chaos", "--test", "world", "--test", "standby", "--test", "orders"];
    let built = cargo(&[&["test", "--no-run", "--lib"], &packages[..], &tests].concat())?;
    let wrong = errors(&built);
    if !wrong.is_empty() {
        return Ok(Err(wrong));
    }
    let program = |(package, name, _): &(&str, &str, &[&str])| {
        let is_meant = |message: &&Value| {
            message["target"]["name"] == **name
                && message["profile"]["test"] == true
                && message["executable"].is_string()
        };
        let message = built.iter().find(is_meant).with_context(|| format!("{name} was not built"))?;
        let program = message["executable"].as_str().context("no program")?;
        Ok((PathBuf::from(program), crate::folder(tree, package)))
    };
    Ok(Ok(Programs(JUDGES.iter().map(program).collect::<Result<_>>()?)))
}

fn errors(messages: &[Value]) -> Vec<Wrong> {
    let mut wrong = Vec::new();
    let errors = messages.iter().map(|message| &message["message"]).filter(|message| message["level"] == "error");
    for error in errors {
        let text = error["message"].as_str().unwrap_or_default();
        // "cannot call non-const method `Claim::raised` in constants"
        let constant = (error["code"]["code"] == "E0015").then(|| {
            let path = text.split('`').nth(1).unwrap_or_default();
            path.rsplit("::").next().unwrap_or_default().split(['<', '(']).next().unwrap_or_default().to_owned()
        });
        for span in error["spans"].as_array().into_iter().flatten().filter(|span| span["is_primary"] == true) {
            let byte = |name: &str| span[name].as_u64().unwrap_or_default() as usize;
            wrong.push(Wrong {
                file: span["file_name"].as_str().unwrap_or_default().to_owned(),
                place: byte("byte_start")..byte("byte_end"),
                constant: constant.clone(),
                text: error["rendered"].as_str().unwrap_or_default().to_owned(),
            });
        }
    }
    wrong
}

impl Programs {
    /// Fails if a judge finds something without a mutant.
    pub(crate) fn check(&self) -> Result<()> {
        let start = Instant::now();
        let found = self.kills(usize::MAX)?;
        ensure!(found.is_none(), "{} fails without a mutant", found.unwrap_or_default());
        println!("without a mutant all judges pass, in {:.0} s", start.elapsed().as_secs_f64());
        Ok(())
    }

    /// The judge that fails with this mutant.
    pub(crate) fn kills(&self, number: usize) -> Result<Option<String>> {
        for ((program, folder), (_, name, tests)) in self.0.iter().zip(JUDGES) {
            let mut command = Command::new(program);
            command
                .current_dir(folder)
                .args(tests)
                .arg("--quiet")
                .env("CARA_SIM_SEEDS", SEEDS)
                .env("RUST_BACKTRACE", "0");
            command.env("PROPTEST_FAILURE_PERSISTENCE", "off").env("CARA_MUTANT", (number as u32).to_string());
            let mut child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn()?;
            let start = Instant::now();
            let status = loop {
                if let Some(status) = child.try_wait()? {
                    break Some(status);
                }
                if start.elapsed() > LONGEST {
                    child.kill()?;
                    child.wait()?;
                    break None;
                }
                std::thread::sleep(Duration::from_millis(20));
            };
            match status {
                None => return Ok(Some(format!("{name} does not end"))),
                Some(status)
                    if status.code().is_none() && std::os::unix::process::ExitStatusExt::signal(&status) == Some(2) =>
                {
                    bail!("interrupted")
                }
                Some(status) if !status.success() => return Ok(Some((*name).to_owned())),
                Some(_) => {}
            }
        }
        Ok(None)
    }
}
