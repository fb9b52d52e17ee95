//! Counts the core's operations by the clock of an emulator that lets each instruction take the same time: QEMU with
//! `-icount shift=10`, where it takes 1,024 ns. Prints a line for each, and "end" behind the last one.

#![no_std]
#![no_main]

use cara_core::distribution::parameters::Parameters;
use cara_core::services::session::buffer_bytes;
use cara_instructions::{Blocks, Discovery, DiscoveryMemory, Meter, Operation, Pair, PairMemory, Programs, Sealing};
use cara_lm3s6965evb as _;
use defmt_semihosting as _;
use embassy_time::Instant;
use semihosting::println;
use static_cell::{ConstStaticCell, StaticCell};

const CHARACTERS: usize = 512;
const ARGUMENTS: usize = CHARACTERS + 64;
const BUFFER: usize = buffer_bytes(ARGUMENTS as u32, 0);
/// With more of them there is too little stack for the pair.
const NODES: usize = 24;

/// Nanoseconds of an instruction.
const INSTRUCTION: u64 = 1 << 10;

/// Measures the time.
struct Clock {
    /// What measuring takes.
    itself: u64,
    micros: u64,
}

impl Meter for Clock {
    fn count(&mut self, work: &mut dyn FnMut()) {
        let start = Instant::now();
        work();
        self.micros += (Instant::now() - start).as_micros().saturating_sub(self.itself);
    }
}

impl Clock {
    fn new() -> Self {
        let mut empty = Self { itself: 0, micros: 0 };
        empty.count(&mut || {});
        Self { itself: empty.micros, micros: 0 }
    }

    fn instructions(&mut self) -> u64 {
        (core::mem::take(&mut self.micros) * 1_000).div_ceil(INSTRUCTION)
    }
}

fn count_all<B, const N: usize>(clock: &mut Clock, operations: [Operation<B>; N], bench: &mut B) {
    for operation in operations {
        operation.count(bench, clock);
        println!("{}\t{}\t{}", operation.name, operation.of, clock.instructions());
    }
}

macro_rules! lent {
    ($what:ty, $value:expr) => {{
        static MEMORY: ConstStaticCell<Words<$what>> = ConstStaticCell::new(Words($value));
        &mut MEMORY.take().0
    }};
}

/// Copying bytes costs less where they begin with a word; where bytes alone would lie is the linker's choice.
#[repr(C, align(8))]
struct Words<T>(T);

#[cortex_m_rt::entry]
fn main() -> ! {
    let _core = cara_lm3s6965evb::start();
    let mut clock = Clock::new();
    messages(&mut clock);
    requests(&mut clock);
    count_all(&mut clock, Programs::operations(), &mut Programs::new());
    nodes(&mut clock);
    seals(&mut clock);
    println!("end");
    semihosting::process::exit(0)
}

#[inline(never)]
fn messages(clock: &mut Clock) {
    let few = [lent!(Parameters<64>, Parameters::sized()), lent!(Parameters<64>, Parameters::sized())];
    let mut ints = Blocks::ints(few.map(|few| few.as_mut_view()), lent!([u8; 256], [0; 256]));
    count_all(clock, Blocks::operations_with_ints(), &mut ints);
    let many = [lent!(Parameters<ARGUMENTS>, Parameters::sized()), lent!(Parameters<ARGUMENTS>, Parameters::sized())];
    let (message, characters) = (lent!([u8; BUFFER], [0; BUFFER]), lent!([u8; CHARACTERS], [0; CHARACTERS]));
    let mut text = Blocks::text(many.map(|many| many.as_mut_view()), message, characters);
    count_all(clock, Blocks::operations_with_text(CHARACTERS as u32), &mut text);
}

#[inline(never)]
fn requests(clock: &mut Clock) {
    static MEMORY: StaticCell<PairMemory<BUFFER, ARGUMENTS>> = StaticCell::new();
    let mut pair = Pair::new(MEMORY.init_with(PairMemory::new), CHARACTERS as u32);
    count_all(clock, Pair::operations(CHARACTERS as u32), &mut pair);
}

#[inline(never)]
fn nodes(clock: &mut Clock) {
    let mut manager = Discovery::new(memory_of_nodes());
    count_all(clock, Discovery::operations(NODES as u32), &mut manager);
}

/// What it is made of lies on the stack first, and is not to be there while a session is.
#[inline(never)]
fn memory_of_nodes() -> &'static mut DiscoveryMemory<{ NODES + Discovery::SPARE }> {
    static MEMORY: StaticCell<DiscoveryMemory<{ NODES + Discovery::SPARE }>> = StaticCell::new();
    MEMORY.init_with(DiscoveryMemory::new)
}

#[inline(never)]
fn seals(clock: &mut Clock) {
    let frame = lent!([u8; Sealing::FRAME_BYTES], [0; Sealing::FRAME_BYTES]);
    count_all(clock, Sealing::operations(), &mut Sealing::new(frame));
}
