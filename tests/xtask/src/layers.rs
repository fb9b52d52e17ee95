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
const FOUNDATION: [&str; 9] = ["ability", "bytes", "config", "counters", "error", "fmt", "random", "storage", "time"];

/// What services use of host directly, past distribution.
struct Purpose {
    /// What for.
    what: &'static str,
    /// Which files or folders below `core/src`; each of them uses each of the items.
    places: &'static [&'static str],
    /// Which items, as `module::Item` of host.
    items: &'static [&'static str],
}

/// A layer talks to its neighbour. These are the exceptions of services; everything else of host goes through distribution.
const HOST_FOR_SERVICES: [Purpose; 21] = [
    Purpose {
        what: "the cipher's trait, over which all of a session is generic",
        places: &["services"],
        items: &["secure::Secure"],
    },
    Purpose {
        what: "what happens on a link is counted in the link",
        places: &["services/session"],
        items: &["connections::LinkCounter"],
    },
    Purpose { what: "what a port is made of, for all layers", places: &["services/mod.rs"], items: &["port::Port"] },
    Purpose {
        what: "the peer's host, and where on it its datagrams go",
        places: &["services/session/inbound.rs", "services/session/proving.rs", "services/session/wire.rs"],
        items: &["endpoint::Endpoint"],
    },
    Purpose {
        what: "the port's sockets, lent down to the link",
        places: &["services/mod.rs"],
        items: &["mailman::Mailman"],
    },
    Purpose {
        what: "the port's name of a link",
        places: &["services/session/mod.rs", "services/run_times.rs"],
        items: &["mailman::LinkId"],
    },
    Purpose {
        what: "the link, which a session lends to its parts",
        places: &["services/session/mod.rs", "services/session/wire.rs"],
        items: &["connections::Link"],
    },
    Purpose {
        what: "whether the peer is still there decides how long a session lasts",
        places: &["services/session/mod.rs", "services/session/proving.rs", "services/session/wire.rs"],
        items: &["connections::Liveness"],
    },
    Purpose {
        what: "what each end tells of the other one's stream and datagrams",
        places: &["services/session/timing.rs", "services/session/wire.rs"],
        items: &["connections::Report"],
    },
    Purpose {
        what: "where the details of a failure and progress lie",
        places: &["services/session/details.rs"],
        items: &["connections::Span"],
    },
    Purpose { what: "farewells", places: &["services/session/wire.rs"], items: &["frame::Frame"] },
    Purpose { what: "a ping", places: &["services/session/pinging.rs"], items: &["frame::Frame"] },
    Purpose {
        what: "session bodies: leases, and what else fits a datagram",
        places: &["services/session/holding.rs", "services/session/timing.rs"],
        items: &["frame::Frame"],
    },
    Purpose {
        what: "hello, proof and renewal of keys: their frames, and where they lie",
        places: &["services/session/proving.rs", "services/session/renewing.rs"],
        items: &["connections::Span", "frame::Frame"],
    },
    Purpose {
        what: "the step of a renewal that is kept until it can be sent",
        places: &["services/session/renewing.rs"],
        items: &["secure::PROOF_BYTES"],
    },
    Purpose {
        what: "what a link has received whole, where it lies, and the answer to a ping",
        places: &["services/session/inbound.rs"],
        items: &["connections::Inbound", "connections::Span", "frame::Frame"],
    },
    Purpose {
        what: "where a sample lies that came whole",
        places: &["services/session/streaming.rs"],
        items: &["connections::Span"],
    },
    Purpose {
        what: "why a session datagram is dropped",
        places: &["services/session/inbound.rs"],
        items: &["secure::Unopened"],
    },
    Purpose {
        what: "how large a frame is that needs no buffer, and what a chunk adds",
        places: &["services/session/mod.rs"],
        items: &["frame::HEADER_BYTES"],
    },
    Purpose {
        what: "how large a buffer is that a session datagram fits",
        places: &["services/session/wire.rs"],
        items: &["secure::DATAGRAM_OVERHEAD"],
    },
    Purpose {
        what: "requests and replies are encoded in place",
        places: &["services/session/outbound.rs", "services/session/wire.rs"],
        items: &["frame::ChunkWriter"],
    },
];

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
    let unused = unused_exceptions(&used_of_host(&sources, &tests));
    unused.iter().for_each(|line| eprintln!("HOST_FOR_SERVICES: {line}"));
    if wrong.is_empty() && unused.is_empty() {
        println!("{} files of the core, every arrow points down", sources.len() - tests.len());
        return Ok(());
    }
    wrong.iter().for_each(|arrow| eprintln!("core/src/{arrow}"));
    bail!("{} wrong arrows in the core, {} exceptions without use", wrong.len(), unused.len())
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
pub(crate) fn test_files(sources: &[(PathBuf, String)]) -> HashSet<PathBuf> {
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
pub(crate) fn module_of(file: &Path) -> Vec<String> {
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
        if let Some(why) = objection(file, from, own, &target) {
            wrong.push(Wrong { file: file.to_owned(), line: path.line, path: path.segments.join("::"), why });
        }
    }
    wrong
}

/// The path below the crate that `segments` means inside `module`; `None` for paths of other crates and of locals.
pub(crate) fn resolve(module: &[String], segments: &[&str]) -> Option<Vec<String>> {
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

/// Why `file`, of layer `from` and in the crate's module `own`, may not use `target`.
fn objection(file: &Path, from: Layer, own: &str, target: &[String]) -> Option<String> {
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
        let item = item_of_host(target);
        let is_listed = |purpose: &Purpose| {
            purpose.places.iter().any(|place| file.starts_with(place)) && purpose.items.contains(&item.as_str())
        };
        if !HOST_FOR_SERVICES.iter().any(is_listed) {
            return Some("no purpose in HOST_FOR_SERVICES lets this file use it: go through Distribution".into());
        }
    }
    None
}

/// `host::module::Item::Variant` as `module::Item`.
fn item_of_host(target: &[String]) -> String {
    target.iter().skip(1).take(2).map(String::as_str).collect::<Vec<_>>().join("::")
}

/// Which items of host the files of the services name.
fn used_of_host(sources: &[(PathBuf, String)], tests: &HashSet<PathBuf>) -> HashSet<(PathBuf, String)> {
    let mut used = HashSet::new();
    for (file, text) in sources.iter().filter(|(file, _)| file.starts_with("services") && !tests.contains(file)) {
        let all = source::tokens(text);
        let kept = source::without_tests(&all);
        let targets = source::paths(&kept).into_iter().filter_map(|path| resolve(&module_of(file), &path.segments));
        let of_host = targets.filter(|target| target.first().is_some_and(|layer| layer == "host"));
        used.extend(of_host.map(|target| (file.clone(), item_of_host(&target))));
    }
    used
}

/// Places that are listed with an item that they do not name.
fn unused_exceptions(used: &HashSet<(PathBuf, String)>) -> Vec<String> {
    let mut unused = Vec::new();
    for Purpose { what, places, items } in &HOST_FOR_SERVICES {
        for (place, item) in places.iter().flat_map(|place| items.iter().map(move |item| (place, item))) {
            if !used.iter().any(|(file, named)| file.starts_with(place) && named == item) {
                unused.push(format!("{what}: {place} does not use host::{item}"));
            }
        }
    }
    unused
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

/// The one file that knows of IP.
const ENDPOINTS: &str = "host/endpoint.rs";

/// What the core refuses altogether: the standard library, an allocator, `unsafe`, addresses of IP.
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
            "SocketAddr" | "SocketAddrV4" | "SocketAddrV6" | "IpAddr" | "Ipv4Addr" | "Ipv6Addr"
                if file != Path::new(ENDPOINTS) =>
            {
                found.push(wrong(token, "an address is the port's own: host::endpoint::Endpoint"));
            }
            "async" | "await" => found.push(wrong(token, "the core is polled, it has no async")),
            _ => {}
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::{
        HOST_FOR_SERVICES, forbidden_words, module_of, test_files, unused_exceptions, used_of_host, wrong_arrows,
    };
    use std::collections::HashSet;
    use std::path::{Path, PathBuf};

    fn arrows(file: &str, text: &str) -> usize {
        wrong_arrows(Path::new(file), text).len()
    }

    #[test]
    fn arrows_down_are_right() {
        assert_eq!(arrows("services/session.rs", "use crate::distribution::message::Message;"), 0);
        assert_eq!(arrows("services/session/mod.rs", "use crate::host::{connections::Link, mailman::LinkId};"), 0);
        assert_eq!(arrows("distribution/message.rs", "use crate::{host::frame::Frame, error::Error};"), 0);
        assert_eq!(arrows("host/frame.rs", "use super::mailman::LinkId; use crate::config::CHUNK_BYTES;"), 0);
        assert_eq!(arrows("error.rs", "use crate::time::Duration;"), 0);
    }

    #[test]
    fn an_arrow_up_is_wrong_in_every_spelling() {
        assert_eq!(arrows("host/frame.rs", "use crate::services::session::Unit;"), 1);
        assert_eq!(arrows("host/frame.rs", "use super::super::distribution::message;"), 1);
        assert_eq!(arrows("host/frame.rs", "use crate::{error::Error, distribution::{message, identity}};"), 2);
        assert_eq!(arrows("host/frame/inner.rs", "fn f() { super::super::super::services::session::run() }"), 1);
        assert_eq!(arrows("host/mod.rs", "pub use super::distribution::message;"), 1);
        assert_eq!(arrows("time.rs", "use crate::host::mailman::LinkId;"), 1);
        assert_eq!(arrows("distribution/message.rs", "use cara_core::services::session::Unit;"), 1);
    }

    #[test]
    fn the_core_keeps_to_its_layers() {
        super::check().unwrap();
    }

    #[test]
    fn services_reach_past_their_neighbour_only_where_it_is_written() {
        assert_eq!(arrows("services/session.rs", "use crate::host::something_else::Thing;"), 1);
        assert_eq!(arrows("services/session.rs", "use crate::host;"), 1);
        // Of each module of the host layer: what is not listed, the module as a whole, everything in it.
        for module in ["connections", "frame", "mailman", "secure"] {
            for item in ["Unlisted", "*", "{self}", "{*}", "{Unlisted as Link}"] {
                let text = format!("use crate::host::{module}::{item};");
                assert_eq!(arrows("services/session/mod.rs", &text), 1, "{text}");
            }
            assert_eq!(arrows("services/session.rs", &format!("use crate::host::{module};")), 1);
        }
        assert_eq!(arrows("services/session/mod.rs", "use crate::host::connections::{Link, Received};"), 1);
        assert_eq!(arrows("services/session.rs", "fn f() { crate::host::frame::encode() }"), 1);
        assert_eq!(arrows("distribution/message.rs", "use crate::host::frame::Cut;"), 0, "a neighbour");
    }

    #[test]
    fn a_purpose_holds_for_its_files_only() {
        let writer = "fn f(writer: &mut crate::host::frame::ChunkWriter<'_>) {}";
        assert_eq!(arrows("services/session/outbound.rs", writer), 0);
        for other in ["services/session/granting.rs", "services/session/outbound_too.rs", "services/requests.rs"] {
            assert_eq!(arrows(other, writer), 1, "{other}");
        }
        let counter = "use crate::host::connections::LinkCounter;";
        assert_eq!((arrows("services/session/new.rs", counter), arrows("services/lease.rs", counter)), (0, 1));
        assert_eq!(arrows("services/lease.rs", "use crate::host::secure::Secure;"), 0);
    }

    #[test]
    fn an_exception_that_is_not_used_is_told() {
        let unused = |file: &str, text: &str| {
            let source = [(PathBuf::from(file), text.to_owned())];
            unused_exceptions(&used_of_host(&source, &HashSet::new())).len()
        };
        let all: usize = HOST_FOR_SERVICES.iter().map(|purpose| purpose.places.len() * purpose.items.len()).sum();
        let file = "services/session/pinging.rs";
        assert_eq!(unused(file, ""), all);
        assert_eq!(unused(file, "use crate::host::frame::Frame;"), all - 1);
        assert_eq!(unused("services/requests.rs", "use crate::host::frame::Frame;"), all);
        assert_eq!(unused(file, "#[cfg(test)] mod tests { use crate::host::frame::Frame; }"), all);
    }

    #[test]
    fn tests_may_use_any_layer() {
        assert_eq!(arrows("host/frame.rs", "#[cfg(test)] mod tests { use crate::services::session::Unit; }"), 0);
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
    fn the_core_refuses_std_alloc_async_unsafe_and_ip() {
        let words = |text: &str| forbidden_words(Path::new("time.rs"), text).len();
        assert_eq!(words("use std::time::Instant;"), 1);
        assert_eq!(words("extern crate alloc;"), 1);
        assert_eq!(words("fn f(from: core::net::SocketAddr) {}"), 1);
        assert_eq!(forbidden_words(Path::new("host/endpoint.rs"), "use core::net::SocketAddr;").len(), 0);
        assert_eq!(words("fn f() { unsafe { g() } }"), 1);
        assert_eq!(words("async fn f() {}"), 1);
        assert_eq!(words("#[cfg(test)] extern crate std; #[cfg(test)] mod tests { use std::vec; }"), 0);
        assert_eq!(words("use core::time; fn f() { alloc(); x.std(); }"), 0);
    }
}
