//! What one secured blocking request enters, at both ends: callgrind counts calls of functions in a run with few requests and
//! in one with many; a function that was called once more for each further request belongs to a request.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::{Context, Result, ensure};

use super::Figure;
use crate::command::Run;
use crate::{install, workspace};

const FEW: u64 = 20;
const MANY: u64 = 220;
const PROGRAM: &str = "blocking_requests";
const FOLDERS: [&str; 3] = ["core/src/", "core/secure/src/", "std-port/src/"];

/// How often each function was called, by its file and name.
type Calls = BTreeMap<(String, String), u64>;

pub(super) fn figures() -> Result<[Figure; 2]> {
    install::program("valgrind", "valgrind").map_err(anyhow::Error::msg)?;
    let (functions, files) = (entered("1")?, entered("0")?);
    let files: BTreeSet<_> = files.iter().map(|(file, _)| file).collect();
    Ok([
        Figure {
            name: "functions that a blocking request enters".into(),
            value: functions.len(),
            how: "callgrind, `opt-level` 1, secured, both ends; without closures and what the compiler has inlined",
        },
        Figure {
            name: "files that a blocking request enters".into(),
            value: files.len(),
            how: "those of the functions that are called with `opt-level` 0, which inlines none",
        },
    ])
}

/// The functions of the product that each request enters.
fn entered(opt_level: &str) -> Result<Vec<(String, String)>> {
    let target = workspace::target().join("house").join(opt_level);
    // Callgrind has no vDSO, which rustix looks for otherwise.
    let build = Run::cargo().args(["build", "--quiet", "--package", "cara-std", "--example", PROGRAM]);
    let build = build.env("RUSTFLAGS", "--cfg rustix_use_libc").env("CARGO_PROFILE_DEV_DEBUG", "line-tables-only");
    let build = build.env("CARGO_PROFILE_DEV_OPT_LEVEL", opt_level);
    build.env("CARGO_TARGET_DIR", &target.to_string_lossy()).stream()?;
    let (few, many) = (profile(&target, FEW)?, profile(&target, MANY)?);
    // Fewer than one for each, since a request of the first ones may have taken another way. What time sets off is called less
    // often than that, although callgrind makes each request slow.
    let enough = (MANY - FEW) * 19 / 20;
    let each = many.into_iter().filter(|(function, calls)| {
        let before = few.get(function).copied().unwrap_or_default();
        is_ours(&function.0) && !function.1.contains("{{closure}}") && *calls >= before + enough
    });
    let each: Vec<_> = each.map(|(function, _)| function).collect();
    ensure!(!each.is_empty(), "callgrind saw no request");
    Ok(each)
}

fn is_ours(file: &str) -> bool {
    let file = Path::new(file).strip_prefix(workspace::root()).unwrap_or(Path::new(file));
    FOLDERS.iter().any(|folder| file.starts_with(folder))
}

fn profile(target: &Path, requests: u64) -> Result<Calls> {
    let file = target.join(format!("callgrind.{requests}"));
    Run::new("valgrind")
        .args(["--tool=callgrind", "--quiet", "--compress-strings=no", "--compress-pos=no"])
        .args([format!("--callgrind-out-file={}", file.display())])
        .args([target.join("debug/examples").join(PROGRAM).as_os_str(), requests.to_string().as_ref()])
        .text()?;
    let text = std::fs::read_to_string(&file).with_context(|| format!("cannot read {}", file.display()))?;
    Ok(parsed(&text))
}

/// Reads callgrind's format, <https://valgrind.org/docs/manual/cl-format.html>, without compressed names and positions.
fn parsed(text: &str) -> Calls {
    let mut calls = Calls::new();
    let (mut file, mut called_file, mut called) = ("", None, "");
    for line in text.lines() {
        if let Some(name) = ["fl=", "fi=", "fe="].iter().find_map(|key| line.strip_prefix(key)) {
            file = name;
        } else if let Some(name) = ["cfi=", "cfl="].iter().find_map(|key| line.strip_prefix(key)) {
            called_file = Some(name);
        } else if let Some(name) = line.strip_prefix("cfn=") {
            called = name;
        } else if let Some(counts) = line.strip_prefix("calls=") {
            let count = counts.split_whitespace().next().and_then(|count| count.parse::<u64>().ok());
            let function = (called_file.take().unwrap_or(file).to_owned(), called.to_owned());
            *calls.entry(function).or_default() += count.unwrap_or_default();
        }
    }
    calls
}

#[cfg(test)]
mod tests {
    use super::parsed;

    #[test]
    fn calls_are_added_up_by_file_and_name() {
        let text = "fl=a.rs\nfn=f\n3 5\nfi=b.rs\n4 2\nfe=a.rs\ncfi=c.rs\ncfn=g\ncalls=7 1\n5 70\ncfn=h\ncalls=2 1\n6 9\ncalls=1 1\n7 1\n";
        let calls = parsed(text);
        assert_eq!((calls[&("c.rs".into(), "g".into())], calls[&("a.rs".into(), "h".into())]), (7, 3));
    }
}
