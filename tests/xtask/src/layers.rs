//! The arrows between the layers of the core: calls go down, and no file reaches upwards.

use std::collections::HashSet;
use std::fmt;
use std::path::{Component, Path, PathBuf};

use anyhow::{Result, bail};

use crate::source::{self, Token};
use crate::workspace;

/// The layers of the paper from the top, and what they all stand on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Layer {
    Foundation,
    Host,
    Distribution,
    Services,
}

/// Modules at the root of the core that belong to no layer and that every layer may use.
const FOUNDATION: [&str; 8] = ["bytes", "config", "counters", "error", "fmt", "random", "storage", "time"];

/// A layer talks to its neighbour. These modules of the host layer are the exceptions that services use directly: a
/// session owns one link and lends the port's trait down to it.
const HOST_FOR_SERVICES: [&str; 4] = ["connections", "frame", "mailman", "secure"];

/// One wrong arrow.
#[derive(Debug)]
struct Wrong {
    file: PathBuf,
    line: usize,
    path: String,
    why: String,
}

impl fmt::Display for Wrong {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}: `{}`: {}", self.file.display(), self.line, self.path, self.why)
    }
}

/// Reads every file of the core and fails with all arrows that point the wrong way.
pub(crate) fn check() -> Result<()> {
    let sources = core_sources()?;
    let tests = test_files(&sources);
    let mut wrong = Vec::new();
    for (file, text) in sources.iter().filter(|(file, _)| !tests.contains(file)) {
        wrong.extend(wrong_arrows(file, text));
        wrong.extend(forbidden_words(file, text));
    }
    if !sources.iter().any(|(file, text)| file == Path::new("lib.rs") && text.contains("#![no_std]")) {
        bail!("core/src/lib.rs does not say #![no_std]");
    }
    if wrong.is_empty() {
        println!("{} files of the core, every arrow points down", sources.len() - tests.len());
        return Ok(());
    }
    wrong.iter().for_each(|arrow| eprintln!("core/src/{arrow}"));
    bail!("{} wrong arrows in the core", wrong.len())
}

/// The files below `core/src`, named from there, with their texts.
fn core_sources() -> Result<Vec<(PathBuf, String)>> {
    let mut sources = Vec::new();
    for path in workspace::files_with("rs")? {
        if let Ok(file) = path.strip_prefix("core/src") {
            sources.push((file.to_owned(), workspace::read(&path)?));
        }
    }
    Ok(sources)
}

/// Files that are compiled for tests only, with the files below them.
fn test_files(sources: &[(PathBuf, String)]) -> HashSet<PathBuf> {
    let mut roots = Vec::new();
    for (file, text) in sources {
        let folder = children_folder(file);
        let tokens = source::tokens(text);
        roots.extend(source::test_modules(&tokens).into_iter().map(|name| folder.join(name)));
    }
    let is_test = |file: &Path| roots.iter().any(|root| file.with_extension("") == *root || file.starts_with(root));
    sources.iter().map(|(file, _)| file.clone()).filter(|file| is_test(file)).collect()
}

/// Where the files of a file's child modules are.
fn children_folder(file: &Path) -> PathBuf {
    let parent = file.parent().unwrap_or(Path::new("")).to_owned();
    match file.file_stem().and_then(|stem| stem.to_str()) {
        Some("lib" | "mod") | None => parent,
        Some(stem) => parent.join(stem),
    }
}

/// The module that a file holds, as segments below the crate.
fn module_of(file: &Path) -> Vec<String> {
    let mut segments: Vec<String> = children_folder(file)
        .components()
        .filter_map(|component| match component {
            Component::Normal(name) => name.to_str().map(str::to_owned),
            _ => None,
        })
        .collect();
    if file == Path::new("lib.rs") {
        segments.clear();
    }
    segments
}

fn wrong_arrows(file: &Path, text: &str) -> Vec<Wrong> {
    let module = module_of(file);
    let Some(own) = module.first() else { return Vec::new() };
    let Some(from) = layer(own) else {
        let why = format!("module `{own}` belongs to no layer: name it in FOUNDATION or move it into a layer");
        return vec![Wrong { file: file.to_owned(), line: 1, path: own.clone(), why }];
    };
    let all = source::tokens(text);
    let kept = source::without_tests(&all);
    let mut wrong = Vec::new();
    for path in source::paths(&kept) {
        let Some(target) = resolve(&module, &path.segments) else { continue };
        if let Some(why) = objection(from, own, &target) {
            wrong.push(Wrong { file: file.to_owned(), line: path.line, path: path.segments.join("::"), why });
        }
    }
    wrong
}

/// The path below the crate that `segments` means inside `module`; `None` for paths of other crates and of locals.
fn resolve(module: &[String], segments: &[&str]) -> Option<Vec<String>> {
    let (first, mut rest) = segments.split_first()?;
    let mut base = match *first {
        "crate" | "cara_core" => Vec::new(),
        "self" | "super" => module.to_vec(),
        _ => return None,
    };
    if *first == "super" {
        base.pop();
    }
    while let Some(("super", below)) = rest.split_first().map(|(first, below)| (*first, below)) {
        base.pop();
        rest = below;
    }
    base.extend(rest.iter().map(|segment| (*segment).to_owned()));
    Some(base)
}

/// Why a file of layer `from`, in the crate's module `own`, may not use `target`.
fn objection(from: Layer, own: &str, target: &[String]) -> Option<String> {
    let name = target.first()?;
    if name == "*" {
        return Some("takes everything from the crate's root: name the module".into());
    }
    if name == own {
        return None;
    }
    // Macros and items that the crate's root re-exports have no layer of their own to check.
    let to = layer(name)?;
    if to > from {
        return Some(format!("{from:?} must not use {to:?}, which lies above it"));
    }
    if to == Layer::Host && from == Layer::Services {
        let module = target.get(1).map_or("", String::as_str);
        if !HOST_FOR_SERVICES.contains(&module) {
            return Some(format!("Services may use {HOST_FOR_SERVICES:?} of Host, the rest through Distribution"));
        }
    }
    None
}

fn layer(module: &str) -> Option<Layer> {
    match module {
        "services" => Some(Layer::Services),
        "distribution" => Some(Layer::Distribution),
        "host" => Some(Layer::Host),
        name if FOUNDATION.contains(&name) => Some(Layer::Foundation),
        _ => None,
    }
}

/// What the core refuses altogether: the standard library, an allocator, `unsafe`.
fn forbidden_words(file: &Path, text: &str) -> Vec<Wrong> {
    let all = source::tokens(text);
    let kept = source::without_tests(&all);
    let wrong = |token: &Token<'_>, why: &str| Wrong {
        file: file.to_owned(),
        line: token.line,
        path: token.text.to_owned(),
        why: why.to_owned(),
    };
    let mut found = Vec::new();
    for (at, token) in kept.iter().enumerate() {
        let before = at.checked_sub(1).and_then(|at| kept.get(at)).map(|token| token.text);
        let behind = kept.get(at + 1).map(|token| token.text);
        let names_a_crate = before == Some("crate") || (before != Some("::") && behind == Some("::"));
        match token.text {
            "unsafe" => found.push(wrong(token, "the core has no unsafe")),
            "std" | "alloc" if names_a_crate => found.push(wrong(token, "the core has no std and no alloc")),
            "async" | "await" => found.push(wrong(token, "the core is polled, it has no async")),
            _ => {}
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::{forbidden_words, module_of, test_files, wrong_arrows};
    use std::path::{Path, PathBuf};

    fn arrows(file: &str, text: &str) -> usize {
        wrong_arrows(Path::new(file), text).len()
    }

    #[test]
    fn arrows_down_are_right() {
        assert_eq!(arrows("services/unit.rs", "use crate::distribution::message::Message;"), 0);
        assert_eq!(arrows("services/unit.rs", "use crate::host::mailman::{LinkId, Mailman};"), 0);
        assert_eq!(arrows("distribution/message.rs", "use crate::{host::frame::Frame, error::Error};"), 0);
        assert_eq!(arrows("host/frame.rs", "use super::mailman::LinkId; use crate::config::CHUNK_BYTES;"), 0);
        assert_eq!(arrows("error.rs", "use crate::time::Duration;"), 0);
    }

    #[test]
    fn an_arrow_up_is_wrong_in_every_spelling() {
        assert_eq!(arrows("host/frame.rs", "use crate::services::unit::Unit;"), 1);
        assert_eq!(arrows("host/frame.rs", "use super::super::distribution::message;"), 1);
        assert_eq!(arrows("host/frame.rs", "use crate::{error::Error, distribution::{message, identity}};"), 2);
        assert_eq!(arrows("host/frame/inner.rs", "fn f() { super::super::super::services::unit::run() }"), 1);
        assert_eq!(arrows("host/mod.rs", "pub use super::distribution::message;"), 1);
        assert_eq!(arrows("time.rs", "use crate::host::mailman::LinkId;"), 1);
        assert_eq!(arrows("distribution/message.rs", "use cara_core::services::unit::Unit;"), 1);
    }

    #[test]
    fn services_reach_past_their_neighbour_only_where_it_is_written() {
        assert_eq!(arrows("services/unit.rs", "use crate::host::something_else::Thing;"), 1);
        assert_eq!(arrows("services/unit.rs", "use crate::host;"), 1);
    }

    #[test]
    fn tests_may_use_any_layer() {
        assert_eq!(arrows("host/frame.rs", "#[cfg(test)] mod tests { use crate::services::unit::Unit; }"), 0);
    }

    #[test]
    fn a_module_without_layer_is_wrong() {
        assert_eq!(arrows("helpers.rs", ""), 1);
    }

    #[test]
    fn a_glob_of_the_root_hides_arrows() {
        assert_eq!(arrows("host/frame.rs", "use crate::*;"), 1);
    }

    #[test]
    fn files_of_test_modules_are_found() {
        let file = |name: &str, text: &str| (PathBuf::from(name), text.to_owned());
        let sources = [
            file("host/frame.rs", "#[cfg(test)] mod tests;"),
            file("host/frame/tests.rs", ""),
            file("host/frame/tests/deep.rs", ""),
            file("host/mod.rs", "#[cfg(test)] mod frame_tests; mod frame;"),
            file("host/frame_tests.rs", ""),
        ];
        let mut found: Vec<_> = test_files(&sources).into_iter().collect();
        found.sort();
        let expected = ["host/frame/tests/deep.rs", "host/frame/tests.rs", "host/frame_tests.rs"];
        assert_eq!(found, expected.map(PathBuf::from));
    }

    #[test]
    fn modules_are_named_after_their_files() {
        assert!(module_of(Path::new("lib.rs")).is_empty());
        assert_eq!(module_of(Path::new("host/mod.rs")), ["host"]);
        assert_eq!(module_of(Path::new("host/frame.rs")), ["host", "frame"]);
    }

    #[test]
    fn the_core_refuses_std_alloc_async_and_unsafe() {
        let words = |text: &str| forbidden_words(Path::new("time.rs"), text).len();
        assert_eq!(words("use std::time::Instant;"), 1);
        assert_eq!(words("extern crate alloc;"), 1);
        assert_eq!(words("fn f() { unsafe { g() } }"), 1);
        assert_eq!(words("async fn f() {}"), 1);
        assert_eq!(words("#[cfg(test)] extern crate std; #[cfg(test)] mod tests { use std::vec; }"), 0);
        assert_eq!(words("use core::time; fn f() { alloc(); x.std(); }"), 0);
    }
}
