//! Operations of CARA whose instructions are counted: on the host, where `main.rs` runs them under callgrind, and on a
//! Cortex-M3, where the image in `board` runs them under QEMU.
//!
//! An operation is done a few times before it is counted, with inputs that are the same in every run. What its count
//! holds is written at each; `docs/instructions.md` has the figures.

#![no_std]

mod blocks;
mod discovery;
mod pair;
mod programs;
mod sealing;

pub use blocks::Blocks;
pub use discovery::{Discovery, DiscoveryMemory};
pub use pair::{Pair, PairMemory};
pub use programs::Programs;
pub use sealing::Sealing;

/// Counts the instructions of what it runs.
pub trait Meter {
    /// Runs `work` once.
    fn count(&mut self, work: &mut dyn FnMut());
}

/// Counts nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct Uncounted;

impl Meter for Uncounted {
    fn count(&mut self, work: &mut dyn FnMut()) {
        work();
    }
}

/// An operation on `B`, which can be repeated.
pub struct Operation<B: ?Sized> {
    /// What is done.
    pub name: &'static str,
    /// With how much.
    pub of: Of,
    run: fn(&mut B, &mut dyn Meter),
}

/// The size of an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Of {
    /// So many integers as arguments and as results.
    Ints(u32),
    /// A text of so many characters as argument and as result.
    Characters(u32),
    /// So many nodes are connected.
    Nodes(u32),
    /// So many bytes.
    Bytes(u32),
}

/// Times that an operation is done before it is counted.
const WARM: usize = 3;

impl<B: ?Sized> Operation<B> {
    /// Counts the operation once.
    pub fn count(&self, bench: &mut B, meter: &mut dyn Meter) {
        for _ in 0..WARM {
            (self.run)(bench, &mut Uncounted);
        }
        (self.run)(bench, meter);
    }
}

impl core::fmt::Display for Of {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Ints(count) => write!(f, "{count} ints"),
            Self::Characters(count) => write!(f, "{count} characters"),
            Self::Nodes(count) => write!(f, "{count} nodes"),
            Self::Bytes(count) => write!(f, "{count} bytes"),
        }
    }
}

/// A text of `length` characters.
fn text(bytes: &mut [u8], length: usize) -> &str {
    let bytes = &mut bytes[..length];
    for (place, letter) in bytes.iter_mut().zip((b'a'..=b'z').cycle()) {
        *place = letter;
    }
    core::str::from_utf8(bytes).expect("letters")
}
