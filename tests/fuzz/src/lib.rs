//! What libFuzzer drives, and what a plain test replays: each [target](TARGETS) is a function of bytes that panics where
//! something that must hold does not. `cargo xtask fuzz` runs them; the inputs in `corpus` and `crashes` are replayed by
//! `tests/replay.rs`. `page` has the target of the command line, on which nothing else here stands.

mod discovery;
mod files;
mod handshake;
mod peer;
mod play;
mod said;
mod script;
mod serial;
mod session;
mod unit;
mod values;
mod vda5050;
mod whole;

use std::cell::RefCell;
use std::fs;
use std::path::Path;

pub use script::{Script, text};

/// Something to fuzz.
pub struct Target {
    /// Its name, and that of its folder in `corpus`.
    pub name: &'static str,
    /// Runs one input.
    pub run: fn(&[u8]),
    /// Longest useful input.
    pub longest: u32,
}

/// All of them.
pub const TARGETS: &[Target] = &[
    Target { name: "session", run: session::plain, longest: 200 },
    Target { name: "sealed", run: session::sealed, longest: 128 },
    Target { name: "handshake", run: handshake::run, longest: 128 },
    Target { name: "discovery", run: discovery::run, longest: 256 },
    Target { name: "unit", run: whole::run, longest: 200 },
    Target { name: "values", run: values::run, longest: 512 },
    Target { name: "files", run: files::run, longest: 400 },
    Target { name: "vda5050", run: vda5050::run, longest: 300 },
    Target { name: "serial", run: serial::run, longest: 400 },
];

/// The inputs in a file of `corpus`: each behind its length in two bytes, little-endian.
pub fn inputs(mut file: &[u8]) -> impl Iterator<Item = &[u8]> {
    std::iter::from_fn(move || {
        let (length, rest) = file.split_first_chunk()?;
        let (input, rest) = rest.split_at_checked(u16::from_le_bytes(*length).into())?;
        file = rest;
        Some(input)
    })
}

/// Runs each input below `folder` again: those in `corpus`, of which each target has a file, and those in `crashes`, whose names
/// begin with that of their target.
pub fn replay(folder: &Path, targets: &[Target]) {
    for target in targets {
        let corpus = folder.join("corpus").join(target.name).with_extension("inputs");
        let corpus = fs::read(corpus).expect("each target has a corpus");
        let inputs: Vec<_> = inputs(&corpus).collect();
        assert!(inputs.len() > 20, "{} has {} inputs", target.name, inputs.len());
        inputs.into_iter().for_each(target.run);
    }
    for crash in fs::read_dir(folder.join("crashes")).into_iter().flatten() {
        let path = crash.expect("it can be read").path();
        let name = path.file_name().and_then(|name| name.to_str()).and_then(|name| name.split('-').next());
        let target = targets.iter().find(|target| Some(target.name) == name).expect("a crash has a target");
        println!("{}", path.display());
        (target.run)(&fs::read(&path).expect("it can be read"));
    }
}

/// Bytes of the wire format that a target gave to the core's decoders, and as what.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Wire {
    /// As what, as `tests/vectors` calls it.
    pub kind: &'static str,
    /// The function whose arguments they are, of a block.
    pub function: &'static str,
    /// The bytes.
    pub bytes: Vec<u8>,
}

thread_local! {
    static SEEN: RefCell<Option<Vec<Wire>>> = const { RefCell::new(None) };
}

/// Runs one input, and returns what it gave to decoders, for decoders in other languages.
pub fn wire(target: &Target, input: &[u8]) -> Vec<Wire> {
    SEEN.set(Some(Vec::new()));
    (target.run)(input);
    SEEN.take().unwrap_or_default()
}

/// Notes bytes that are decoded, where somebody asks for that.
fn saw(kind: &'static str, function: &'static str, bytes: &[u8]) {
    SEEN.with_borrow_mut(|seen| {
        seen.iter_mut().for_each(|seen| seen.push(Wire { kind, function, bytes: bytes.to_owned() }));
    });
}
