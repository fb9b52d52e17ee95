//! An executor that sleeps with WFI. embassy's own sleeps with WFE, which QEMU does not wait at: an idle board would
//! keep a core of the host busy.
#![allow(unsafe_code)]

use core::ptr::null_mut;
use core::sync::atomic::{AtomicBool, Ordering};

use embassy_executor::{Spawner, raw};
use static_cell::StaticCell;

/// Exit code of a program that cannot start: starting again would not help.
const NOT_STARTED: i32 = 101;

/// A task has been woken since the executor last looked.
static WOKEN: AtomicBool = AtomicBool::new(false);

#[unsafe(export_name = "__pender")]
fn pender(_context: *mut ()) {
    WOKEN.store(true, Ordering::Release);
}

/// Runs tasks for ever, beginning with those that `spawn` starts. If it fails, the emulator ends with its text.
pub fn run(spawn: impl FnOnce(Spawner) -> Result<(), &'static str>) -> ! {
    static EXECUTOR: StaticCell<raw::Executor> = StaticCell::new();
    let executor = EXECUTOR.init_with(|| raw::Executor::new(null_mut()));
    if let Err(text) = spawn(executor.spawner()) {
        cara_vehicle::error!("{=str}", text);
        semihosting::process::exit(NOT_STARTED)
    }
    loop {
        #[cfg(feature = "faults")]
        let turn = crate::faults::turn();
        // SAFETY: called here only, and not from within itself: `run` does not return, and `EXECUTOR` is taken once.
        unsafe { executor.poll() };
        #[cfg(feature = "faults")]
        crate::faults::turned(turn);
        cortex_m::interrupt::disable();
        // An interrupt that comes after this look still ends the wait, and runs when interrupts are on again.
        if !WOKEN.load(Ordering::Acquire) {
            #[cfg(feature = "faults")]
            crate::faults::sleeps(true);
            cortex_m::asm::wfi();
        }
        WOKEN.store(false, Ordering::Relaxed);
        // SAFETY: this is no part of a critical section.
        unsafe { cortex_m::interrupt::enable() };
        #[cfg(feature = "faults")]
        crate::faults::sleeps(false);
    }
}
