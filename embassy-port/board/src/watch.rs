//! The motors' interrupt, and the watchdog that it feeds.

use core::future::{Future, poll_fn};
use core::pin::pin;
use core::sync::atomic::{AtomicBool, Ordering};

use crate::Board;

/// The unit's task has had a turn since the watchdog was last fed.
static HAD_TURN: AtomicBool = AtomicBool::new(false);

/// Switches the motors on or off, and feeds the watchdog if the unit's task has had a turn since the last feeding.
///
/// For a board's interrupt, each millisecond. `may_move` says whether motion is wanted *now*: it reads a lease, and not
/// the application's state.
pub fn tick<B: Board>(may_move: bool) {
    B::motors(may_move);
    if is_due(&HAD_TURN) {
        B::feed();
    }
}

/// Lets the processor's own timer interrupt, SysTick, come each millisecond: for boards that need it for nothing else, with
/// [`tick_by_systick!`](crate::tick_by_systick). `cycles` are those of the processor in a millisecond, below 2^24.
#[cfg(target_os = "none")]
#[allow(unsafe_code)]
pub fn start_systick(cycles: u32) {
    /// Control; reload value and current value follow.
    const REGISTERS: *mut u32 = 0xE000_E010 as *mut u32;
    /// The processor's clock, with the interrupt, on.
    const ON: u32 = 0b111;
    // SAFETY: registers of the processor, which belong to this crate on boards that call this.
    unsafe {
        REGISTERS.add(1).write_volatile(cycles.saturating_sub(1));
        REGISTERS.add(2).write_volatile(0);
        REGISTERS.write_volatile(ON);
    }
}

/// Runs the unit's task, and notes each of its turns for the watchdog. A turn that does not end is none.
pub async fn watched<F: Future>(unit: F) -> F::Output {
    let mut unit = pin!(unit);
    poll_fn(|context| {
        let polled = unit.as_mut().poll(context);
        HAD_TURN.store(true, Ordering::Release);
        polled
    })
    .await
}

/// Load and store, which every chip has: tasks only set it, and do not run during the interrupt that clears it.
fn is_due(had_turn: &AtomicBool) -> bool {
    let due = had_turn.load(Ordering::Acquire);
    if due {
        had_turn.store(false, Ordering::Release);
    }
    due
}

#[cfg(test)]
mod tests {
    use super::{tick, watched};
    use crate::{Board, Place, Reason};
    use core::cell::Cell;
    use core::future::{Future, poll_fn};
    use core::pin::pin;
    use core::task::{Context, Poll, Waker};

    struct Fake;

    thread_local! {
        static FED: Cell<u32> = const { Cell::new(0) };
        static ON: Cell<bool> = const { Cell::new(false) };
    }

    impl Board for Fake {
        fn motors(on: bool) {
            ON.set(on);
        }

        fn feed() {
            FED.set(FED.get() + 1);
        }

        fn ended(_: Reason, _: Place<'_>) {}

        fn reset() -> ! {
            unreachable!("nothing ends here")
        }
    }

    /// One test, because there is one note of a turn in the whole program, as on a board.
    #[test]
    fn the_watchdog_is_fed_only_while_unit_and_motor_check_have_both_run() {
        let mut context = Context::from_waker(Waker::noop());
        let hangs = Cell::new(false);
        let fed_within = Cell::new(0);
        let mut unit = pin!(watched(poll_fn(|_| {
            // A turn that has not ended while the interrupt comes, as one that hangs.
            if hangs.get() {
                fed_within.set(fed_by_ticks(3));
            }
            Poll::<()>::Pending
        })));
        let mut turns = |turns: u32| (0..turns).for_each(|_| assert!(unit.as_mut().poll(&mut context).is_pending()));
        assert_eq!(fed_by_ticks(3), 0, "without a turn of the unit");
        turns(3);
        assert_eq!(FED.get(), 0, "without the motors' interrupt");
        assert_eq!(fed_by_ticks(3), 1, "turns that came before count once");
        hangs.set(true);
        turns(1);
        assert_eq!(fed_within.get(), 0, "in a turn that does not end");
        assert_eq!(fed_by_ticks(1), 1);
        assert!(ON.get());
        tick::<Fake>(false);
        assert!(!ON.get());
    }

    fn fed_by_ticks(ticks: u32) -> u32 {
        let before = FED.get();
        (0..ticks).for_each(|_| tick::<Fake>(true));
        FED.get() - before
    }
}
