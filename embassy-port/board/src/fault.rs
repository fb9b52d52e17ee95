//! The entry of the processor's fault handler.
//!
//! A fault may be there because the stack has overflown: then each push of an ordinary handler would fault again, and the
//! processor would lock up with the motors as they were. So the stack pointer goes back to the top of the stack before
//! anything else is done; what lay there is lost, as is the program.
#![allow(unsafe_code, non_snake_case)]

use core::arch::naked_asm;

use crate::Reason;

unsafe extern "C" {
    /// Defined by [`guard!`](crate::guard).
    safe fn __cara_board_failed(reason: Reason, address: u32) -> !;
    /// Defined by `stack.x`: the lowest address of the stack.
    static _stack_end: u32;
}

/// Bytes that the processor pushes when it takes an exception.
const FRAME: u32 = 32;
/// The program counter's place in them.
const COUNTER: u32 = 24;

/// Empties the stack and goes on with [`failed`]. Interrupts cannot come in between: they have no higher priority.
macro_rules! fails {
    ($name:ident) => {
        /// What the vector table names.
        #[unsafe(naked)]
        #[unsafe(no_mangle)]
        unsafe extern "C" fn $name() -> ! {
            naked_asm!(
                "mov r0, sp",
                "ldr r1, =_stack_start",
                "msr msp, r1",
                "ldr r1, ={failed}",
                "bx r1",
                failed = sym failed,
            )
        }
    };
}

fails!(HardFault);
// Of exceptions and interrupts without a handler: hanging there would keep out the motors' interrupt.
fails!(DefaultHandler);

/// `frame` is the stack pointer as the processor left it.
extern "C" fn failed(frame: u32) -> ! {
    let lowest = &raw const _stack_end as u32;
    if frame < lowest.saturating_add(FRAME) || has_hit_limit() {
        __cara_board_failed(Reason::StackOverflow, 0)
    }
    // SAFETY: the frame lies within the stack, which is RAM, and what wrote over its words since is not there: this function
    // needs fewer than the program had pushed.
    let counter = unsafe { ((frame + COUNTER) as *const u32).read_volatile() };
    __cara_board_failed(Reason::Fault, counter)
}

/// Whether a push would have gone below the processor's own limit of the stack, which it does not do then.
#[cfg(has_stack_limit)]
fn has_hit_limit() -> bool {
    /// Configurable Fault Status Register, and the stack overflow in it.
    const CFSR: *const u32 = 0xE000_ED28 as *const u32;
    const STKOF: u32 = 1 << 20;
    // SAFETY: a register of the processor, which reading does not change.
    unsafe { CFSR.read_volatile() & STKOF != 0 }
}

/// Without such a limit, an overflow shows in the stack pointer.
#[cfg(not(has_stack_limit))]
const fn has_hit_limit() -> bool {
    false
}
