//! Builds the tests that judge, and runs them.

use std::io::{BufReader, Read};
use std::ops::Range;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use serde_json::Value;

/// What judges, the quickest first: package, program, and the tests of it. Faults that come seldom need many seeds.
const JUDGES: [(&str, &str, &[&str]); 8] = [
    (
        "cara-core",
        "cara_core",
        &["services::lease", "distribution::latch", "distribution::claim", "services::heart", "time::"],
    ),
    ("cara-sim", "orders", &["five_vehicles"]),
    ("cara-sim", "chaos", &["whatever"]),
    ("cara-core", "cara_core", &["services::"]),
    ("cara-core", "cara_core", &["distribution::connection_handler"]),
    ("cara-sim", "world", &[]),
    ("cara-sim", "standby", &[]),
    ("cara-sim", "security", &[]),
];
const SEEDS: &str = "24";
/// Seconds of a processor that one judge may take, many times what it takes without a mutant. A busy machine does not change it.
const LONGEST: u32 = 60;

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
pub(crate) struct Programs {
    programs: Vec<(PathBuf, PathBuf)>,
    /// So many judges have passed without a mutant.
    trusted: usize,
}

const SIGINT: i32 = 2;
const SIGTERM: i32 = 15;

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
    let tests = ["chaos", "world", "standby", "orders", "security"].map(|test| ["--test", test]).concat();
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
    Ok(Ok(Programs { programs: JUDGES.iter().map(program).collect::<Result<_>>()?, trusted: 0 }))
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
    /// The judge that fails with this mutant. Each has to pass without one before it is believed.
    pub(crate) fn kills(&mut self, number: usize) -> Result<Option<String>> {
        for (judge, (_, name, tests)) in JUDGES.iter().enumerate() {
            let name = format!("{name} {}", tests.join(" "));
            if judge >= self.trusted {
                let start = Instant::now();
                ensure!(self.passes(judge, u32::MAX)?, "{name} fails without a mutant");
                println!("{name} passes without a mutant, in {:.0} s", start.elapsed().as_secs_f64());
                self.trusted += 1;
            }
            if !self.passes(judge, number as u32)? {
                return Ok(Some(name));
            }
        }
        Ok(None)
    }

    fn passes(&self, judge: usize, number: u32) -> Result<bool> {
        let ((program, folder), (_, _, tests)) = (&self.programs[judge], JUDGES[judge]);
        let limited = format!("ulimit -t {LONGEST} && exec \"$0\" \"$@\"");
        let mut judge = Command::new("sh");
        judge.arg("-c").arg(limited).arg(program).args(tests).arg("--quiet").current_dir(folder);
        judge.env("CARA_SIM_SEEDS", SEEDS).env("CARA_MUTANT", number.to_string()).env("RUST_BACKTRACE", "0");
        judge.env("PROPTEST_FAILURE_PERSISTENCE", "off").env("CARA_CHAOS_UNEXPLAINED", "1");
        let mut judge = judge.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn()?;
        let has_failed = fails(judge.stdout.take().context("its output is read")?);
        if has_failed {
            judge.kill()?;
        }
        let status = judge.wait()?;
        ensure!(!matches!(status.signal(), Some(SIGINT | SIGTERM)), "interrupted");
        Ok(!has_failed && status.success())
    }
}

/// Reads until the first test has failed, of which `--quiet` writes an `F` in place of a dot; else to the end.
fn fails(output: impl Read) -> bool {
    BufReader::new(output).bytes().map_while(Result::ok).any(|byte| byte == b'F')
}
