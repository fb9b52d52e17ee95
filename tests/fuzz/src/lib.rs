//! What libFuzzer drives, and what a plain test replays: each [target](TARGETS) is a function of bytes that panics where
//! something that must hold does not. `cargo xtask fuzz` runs them; the inputs in `corpus` and `crashes` are replayed by
//! `tests/replay.rs`.

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

/// The target of this name.
pub fn target(name: &str) -> Option<&'static Target> {
    TARGETS.iter().find(|target| target.name == name)
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
