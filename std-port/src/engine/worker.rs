//! What a thread of the pool has of its own: the bytes that it reads into, and the parameters in which it serves calls.

use cara_core::distribution::parameters::{Parameters, ParametersView};

/// Bytes that one read takes from a stream.
pub(super) const READ_BYTES: usize = 128 * 1024;

/// What a thread of the pool reads into and serves calls in, whichever unit they are for.
pub(crate) struct Worker {
    pub(super) buffer: Vec<u8>,
    pub(super) arguments: Box<ParametersView>,
    /// The longest call that `arguments` have room for.
    longest: usize,
}

impl Worker {
    pub(crate) fn new() -> Self {
        Self { buffer: vec![0; READ_BYTES], arguments: arena(0), longest: 0 }
    }

    pub(super) const fn longest(&self) -> usize {
        self.longest
    }

    /// The limit may have been raised since the last call.
    pub(super) fn fit(&mut self, longest: usize) {
        if self.longest < longest {
            self.arguments = arena(longest);
            self.longest = longest;
        }
    }
}

/// Bytes of the parameters in which calls of up to `message` bytes are served: as much again for results and names.
pub(crate) const fn arena_bytes(message: usize) -> usize {
    match message {
        0..=2048 => 8 * 1024,
        2049..=20_000 => 48 * 1024,
        20_001..=40_000 => 96 * 1024,
        _ => 320 * 1024,
    }
}

pub(crate) fn arena(message: usize) -> Box<ParametersView> {
    room(arena_bytes(message))
}

/// Parameters with room for so many bytes, or the most that there are.
pub(crate) fn room(bytes: usize) -> Box<ParametersView> {
    const SMALL: usize = arena_bytes(0);
    const MIDDLE: usize = arena_bytes(20_000);
    const LARGE: usize = arena_bytes(40_000);
    if bytes <= SMALL {
        Box::new(Parameters::<SMALL>::sized())
    } else if bytes <= MIDDLE {
        Box::new(Parameters::<MIDDLE>::sized())
    } else if bytes <= LARGE {
        Box::new(Parameters::<LARGE>::sized())
    } else {
        Box::new(Parameters::<{ arena_bytes(usize::MAX) }>::sized())
    }
}
