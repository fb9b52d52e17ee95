//! No panic is reachable from the core's public entry points: the link of `tests/panic-free` fails if one is.

use std::collections::BTreeSet;
use std::path::Path;

use anyhow::{Result, bail};

use crate::command::Run;
use crate::source::{self, Token};
use crate::workspace;

/// The smallest processor that the core is built for.
pub(crate) const TARGET: &str = "thumbv7m-none-eabi";

/// The symbol that the panic handler calls and that nothing defines.
const UNDEFINED: &str = "a_panic_is_reachable";

/// Public functions that the binary need not call, each with the reason.
const NOT_CALLED: [(&str, &str); 0] = [];

/// Links the binary, then once more with a panic planted in it, which must not link.
pub(crate) fn check() -> Result<()> {
    if let Err(error) = link("build", &[]).stream() {
        let (_, _, errors) = link("build", &[]).captured()?;
        if errors.contains(UNDEFINED) {
            explain()?;
        }
        return Err(error);
    }
    let (linked, _, errors) = link("build", &["--features", "planted"]).captured()?;
    if linked {
        bail!("a planted panic links: the check shows nothing");
    }
    if !errors.contains(UNDEFINED) {
        bail!("with a planted panic the build fails for another reason: {errors}");
    }
    let missing = uncalled()?;
    if !missing.is_empty() {
        bail!("tests/panic-free does not call: {}", missing.join(", "));
    }
    println!("{} entry points reach no panic; a planted one is found", entries()?.len());
    Ok(())
}

fn link(command: &str, arguments: &[&str]) -> Run {
    let build = [command, "--release", "--locked", "--manifest-path", "tests/panic-free/Cargo.toml"];
    let place = ["--target", TARGET, "--target-dir", "target/panic-free"];
    Run::cargo().args(build).args(place).args(arguments)
}

/// Links each entry point alone, with the missing symbol defined, and prints the calls that lead to a panic.
fn explain() -> Result<()> {
    let define = format!("-Clink-arg=--defsym={UNDEFINED}=0");
    let arguments = ["--", "-Wlinker-messages", "-Clink-arg=--why-live=*rust_begin_unwind*", &define];
    for entry in entries()? {
        let (linked, _, output) = link("rustc", &arguments).env("PANIC_FREE_ENTRY", &entry).captured()?;
        if !linked {
            bail!("{entry} does not build for another reason: {output}");
        }
        let calls = chain(&output);
        if !calls.is_empty() {
            eprintln!("{entry}: {}", calls.join(" <- "));
        }
    }
    Ok(())
}

/// The functions in the linker's report on why the panic handler is there, the handler first.
fn chain(output: &str) -> Vec<&str> {
    let report = output.lines().skip_while(|line| !line.contains("live symbol:"));
    let lines = report.take_while(|line| line.contains("live symbol:") || line.contains(">>> referenced by:"));
    lines.filter_map(|line| line.split_once(".o:(")?.1.split_once(')')).map(|(function, _)| function).collect()
}

/// The names of the binary's entry points.
fn entries() -> Result<Vec<String>> {
    let name = |line: &str| Some(line.strip_prefix("entry!(")?.split(',').next()?.to_owned());
    let mut names: Vec<String> =
        sources("tests/panic-free/src")?.iter().flat_map(|text| text.lines()).filter_map(name).collect();
    names.retain(|name| name != "planted");
    Ok(names)
}

/// Public functions of the core whose names the binary does not mention.
fn uncalled() -> Result<Vec<String>> {
    let callers = sources("tests/panic-free/src")?.concat();
    let called: BTreeSet<&str> = source::tokens(&callers).iter().map(|token| token.text).collect();
    let texts = sources("core/src")?;
    let mut names: BTreeSet<String> = BTreeSet::new();
    for text in &texts {
        let all = source::tokens(text);
        names.extend(public_functions(&source::without_tests(&all)).into_iter().map(str::to_owned));
    }
    names.retain(|name| !called.contains(name.as_str()) && !NOT_CALLED.iter().any(|(known, _)| known == name));
    Ok(names.into_iter().collect())
}

/// Names of the functions behind a bare `pub`; `pub(crate)` and the like are no entry points.
fn public_functions<'t>(tokens: &[Token<'t>]) -> Vec<&'t str> {
    let mut names = Vec::new();
    for (at, token) in tokens.iter().enumerate() {
        if token.text != "pub" {
            continue;
        }
        let mut rest = tokens.iter().skip(at + 1).skip_while(|token| token.text == "const");
        if rest.next().is_some_and(|token| token.text == "fn") {
            names.extend(rest.next().map(|token| token.text));
        }
    }
    names
}

/// The texts of the Rust files below a folder.
fn sources(folder: &str) -> Result<Vec<String>> {
    let files = workspace::files_with("rs")?;
    files.iter().filter(|file| file.starts_with(Path::new(folder))).map(|file| workspace::read(file)).collect()
}

#[cfg(test)]
mod tests {
    use super::{chain, public_functions};
    use crate::source::tokens;

    #[test]
    fn public_functions_are_found() {
        let tokens = tokens("pub fn a() {} pub const fn b() {} pub(crate) fn c() {} fn d() {} pub const E: u8 = 0;");
        assert_eq!(public_functions(&tokens), ["a", "b"]);
    }

    #[test]
    fn the_linkers_report_is_read() {
        let report = "warning: linker stdout: live symbol: x.rcgu.o:(__rustc::rust_begin_unwind)\n \
                      >>> referenced by: x.rcgu.o:(core::panicking::panic_fmt)\n \
                      >>> referenced by: x.rcgu.o:(frames) (undefined command line flag)\n\nwarning: other";
        assert_eq!(chain(report), ["__rustc::rust_begin_unwind", "core::panicking::panic_fmt", "frames"]);
        assert!(chain("warning: other").is_empty());
    }
}
