//! How much of the stack has been used: it is painted at the start, and what is still painted was never reached.
#![allow(unsafe_code)]

use embassy_time::{Duration, Ticker};

/// How often the stack is looked at.
const LOOKED_AT: Duration = Duration::from_secs(1);
const PAINT: u32 = 0xC0FF_EE11;
/// Bytes below the stack pointer that painting itself may need.
const MARGIN: usize = 64;

unsafe extern "C" {
    static mut _stack_end: u32;
    static mut _stack_start: u32;
}

/// Bytes of the stack.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Stack {
    /// Used at some time since the start.
    pub used: usize,
    /// There are.
    pub size: usize,
}

/// Paints what is not in use.
#[inline(never)]
pub fn paint() {
    let end = cortex_m::register::msp::read() as usize - MARGIN;
    let mut place = &raw mut _stack_end;
    while (place as usize) < end {
        // SAFETY: between the end of the stack and the stack pointer nothing lies.
        unsafe {
            place.write_volatile(PAINT);
            place = place.add(1);
        }
    }
}

/// Looks how far the paint reaches.
pub fn used() -> Stack {
    let (bottom, top) = (&raw const _stack_end, &raw const _stack_start as usize);
    let mut place = bottom;
    // SAFETY: reads words between the two ends of the stack, which are RAM.
    while (place as usize) < top && unsafe { place.read_volatile() } == PAINT {
        place = unsafe { place.add(1) };
    }
    Stack { used: top - place as usize, size: top - bottom as usize }
}

/// Tells how deep the stack has been, each time that it was deeper.
#[embassy_executor::task]
pub async fn report() -> ! {
    let mut ticker = Ticker::every(LOOKED_AT);
    let mut deepest = 0;
    loop {
        let stack = used();
        if stack.used > deepest {
            deepest = stack.used;
            cara_vehicle::info!("stack {=usize} of {=usize} bytes", stack.used, stack.size);
        }
        ticker.next().await;
    }
}
