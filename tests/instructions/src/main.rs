//! Runs one operation for callgrind, which counts what happens within one function of this program.
//!
//! `cara-instructions` lists the operations; `cara-instructions N` does number N. `cargo xtask instructions` runs it as
//! `valgrind --tool=callgrind --toggle-collect='*counted_by_callgrind*' cara-instructions N` for each.

use cara_core::distribution::parameters::Parameters;
use cara_core::services::session::buffer_bytes;
use cara_instructions::{Blocks, Discovery, DiscoveryMemory, Meter, Operation, Pair, PairMemory, Programs};

const CHARACTERS: u32 = 20_000;
const ARGUMENTS: usize = CHARACTERS as usize + 64;
const BUFFER: usize = buffer_bytes(ARGUMENTS as u32, 0);
const NODES: usize = 1_000;

/// Names the function that callgrind looks for.
struct Callgrind;

impl Meter for Callgrind {
    fn count(&mut self, work: &mut dyn FnMut()) {
        counted_by_callgrind(work);
    }
}

#[inline(never)]
fn counted_by_callgrind(work: &mut dyn FnMut()) {
    work();
}

fn main() {
    let chosen = std::env::args().nth(1).and_then(|number| number.parse::<usize>().ok());
    let mut number = 0;
    on(&mut number, chosen, Blocks::operations_with_ints(), || {
        Blocks::ints([leaked(Parameters::<64>::sized()), leaked(Parameters::<64>::sized())], leaked([0; 256]))
    });
    on(&mut number, chosen, Blocks::operations_with_text(CHARACTERS), || {
        let parameters = || leaked(Parameters::<ARGUMENTS>::sized());
        Blocks::text([parameters(), parameters()], leaked([0; BUFFER]), leaked([0; CHARACTERS as usize]))
    });
    on(&mut number, chosen, Pair::operations(CHARACTERS), || {
        Pair::new(leaked(PairMemory::<BUFFER, ARGUMENTS>::new()), CHARACTERS)
    });
    on(&mut number, chosen, Programs::operations(), Programs::new);
    on(&mut number, chosen, Discovery::operations(NODES as u32), || {
        Discovery::new(leaked(DiscoveryMemory::<{ NODES + Discovery::SPARE }>::new()))
    });
}

/// Lists the operations, or does the one that was chosen.
fn on<B, const N: usize>(
    number: &mut usize,
    chosen: Option<usize>,
    operations: [Operation<B>; N],
    bench: impl FnOnce() -> B,
) {
    let first = *number;
    *number += N;
    match chosen {
        None => operations.iter().for_each(|operation| println!("{}\t{}", operation.name, operation.of)),
        Some(chosen) => {
            if let Some(operation) = chosen.checked_sub(first).and_then(|at| operations.get(at)) {
                operation.count(&mut bench(), &mut Callgrind);
            }
        }
    }
}

/// Memory that is lent for ever.
fn leaked<T>(memory: T) -> &'static mut T {
    Box::leak(Box::new(memory))
}
