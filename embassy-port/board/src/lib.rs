//! Stops the motors of a board when the unit above cannot: an interrupt that checks each millisecond whether they may run,
//! handlers for panics, faults and stack overflows, a watchdog, and a linker script (`stack.x`) that makes a stack overflow
//! fault before it overwrites anything. The same for every board; a board implements [`Board`] for its hardware, and calls
//! [`guard!`] once.
//!
//! - A board's interrupt calls [`tick`] each millisecond. Nothing else switches the motors on.
//! - A panic, and any fault of the processor, switches them off at once, notes why, and resets without waiting.
//! - The watchdog is fed by [`tick`] only, and only if the unit's task, wrapped in [`watched`], has had a turn since the last
//!   feeding: a unit that hangs, or an interrupt that no longer comes, causes a reset.
//! - A reset leaves pins as inputs: the motors' driver needs a pull-down. [`reason`] is the reset reason of this boot.
//!
//! Code that hangs with interrupts masked is ended by the watchdog alone. Nothing here replaces a certified emergency stop, which
//! cuts the motors' power without a program.

#![cfg_attr(target_os = "none", no_std)]

#[cfg(target_os = "none")]
mod fault;
mod note;
mod watch;

pub use note::{Place, Reason};
#[cfg(target_os = "none")]
pub use watch::start_systick;
pub use watch::{tick, watched};

#[doc(hidden)]
pub use note::{end, leave};

/// How a board does what this crate decides. Each function is called from interrupts, and from programs that have failed:
/// at any time, with little stack, never to wait.
pub trait Board {
    /// Switches the motors' output. Before the pins are set up it leaves them as they are, which is off.
    fn motors(on: bool);

    /// Feeds the watchdog, if it runs.
    fn feed();

    /// Logs why the program ends, right before the reset. The motors are off.
    fn ended(reason: Reason, place: Place<'_>);

    /// Resets the chip.
    fn reset() -> !;
}

/// Why this life of the board began: what the last one has noted, or else what the chip's registers tell. With it comes the
/// line of a panic, in images with log lines, or the address of a fault, else 0. Asking clears the note.
pub fn reason(of_chip: Reason) -> (Reason, u32) {
    note::take().unwrap_or((of_chip, 0))
}

/// Makes a board's panics and faults switch off its motors: a [`Board`] calls it once. It defines the panic handler, and
/// what the fault handler calls.
#[macro_export]
macro_rules! guard {
    ($board:ty) => {
        const _: () = {
            #[panic_handler]
            fn panic(information: &::core::panic::PanicInfo<'_>) -> ! {
                $crate::end::<$board>($crate::Reason::Panic, $crate::Place::of(information))
            }

            /// Called by the fault handler, on a stack that it has emptied.
            #[allow(unsafe_code)]
            #[unsafe(no_mangle)]
            extern "C" fn __cara_board_failed(reason: $crate::Reason, address: u32) -> ! {
                $crate::end::<$board>(reason, $crate::Place::address(address))
            }
        };
    };
}

/// Makes SysTick the motors' interrupt of a [`Board`]; the second argument is the function that says whether they may run.
#[macro_export]
macro_rules! tick_by_systick {
    ($board:ty, $may_move:path) => {
        const _: () = {
            #[allow(unsafe_code, non_snake_case)]
            #[unsafe(no_mangle)]
            extern "C" fn SysTick() {
                $crate::tick::<$board>($may_move());
            }
        };
    };
}
