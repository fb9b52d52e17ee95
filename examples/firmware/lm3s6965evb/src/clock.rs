//! embassy's time: SysTick runs freely for `now`, general-purpose timer 0 fires once for the next alarm.
//!
//! SysTick has 24 bits and wraps every 1.3 s, which an interrupt counts. Alarms are exact to a microsecond, and nothing
//! ticks in between. (Data sheet: System Timer; General-Purpose Timers.)

use core::cell::RefCell;
use core::sync::atomic::{AtomicU32, Ordering};
use core::task::Waker;

use cortex_m::peripheral::syst::SystClkSource;
use cortex_m::peripheral::{SCB, SYST};
use critical_section::Mutex;
use embassy_time_driver::Driver;
use embassy_time_queue_utils::Queue;
use lm3s6965::{Interrupt, interrupt};

use crate::register::{Register, SYSTEM, TIMER_0, unmask};

const RCGC1: Register = SYSTEM.at(0x104);
const RCGC1_TIMER_0: u32 = 1 << 16;

const GPTMCFG: Register = TIMER_0.at(0x000);
const GPTMTAMR: Register = TIMER_0.at(0x004);
const GPTMCTL: Register = TIMER_0.at(0x00C);
const GPTMIMR: Register = TIMER_0.at(0x018);
const GPTMICR: Register = TIMER_0.at(0x024);
const GPTMTAILR: Register = TIMER_0.at(0x028);
const ONE_SHOT: u32 = 1;
const ENABLE: u32 = 1;
const TIMEOUT: u32 = 1;

/// QEMU's board runs at 12.5 MHz after reset: 25 cycles are 2 microseconds.
const CYCLES: u64 = 25;
const MICROSECONDS: u64 = 2;
const RELOAD: u32 = 0x00FF_FFFF;
/// The alarm is looked at at least this often, which keeps its cycles within 32 bits.
const LONGEST_ALARM: u64 = 100_000_000;

struct Clock {
    wraps: AtomicU32,
    queue: Mutex<RefCell<Queue>>,
}

embassy_time_driver::time_driver_impl!(static CLOCK: Clock = Clock {
    wraps: AtomicU32::new(0),
    queue: Mutex::new(RefCell::new(Queue::new())),
});

/// Starts the clock at zero.
pub(crate) fn start(systick: &mut SYST) {
    RCGC1.set(RCGC1_TIMER_0);
    GPTMCTL.write(0);
    GPTMCFG.write(0);
    GPTMTAMR.write(ONE_SHOT);
    GPTMICR.write(u32::MAX);
    GPTMIMR.write(TIMEOUT);
    unmask(Interrupt::TIMER_0A);
    systick.set_clock_source(SystClkSource::Core);
    systick.set_reload(RELOAD);
    systick.clear_current();
    systick.enable_counter();
    // QEMU counts a wrap when the counter starts from zero; the chip does not.
    while SYST::get_current() == 0 {}
    SCB::clear_pendst();
    systick.enable_interrupt();
}

impl Clock {
    fn cycles(&self) -> u64 {
        critical_section::with(|_| {
            let mut wraps = self.wraps.load(Ordering::Relaxed);
            let mut left = SYST::get_current();
            if SCB::is_pendst_pending() {
                // It has wrapped, before or after it was read, and the interrupt has not counted it yet.
                left = SYST::get_current();
                wraps += 1;
            }
            u64::from(wraps) * (u64::from(RELOAD) + 1) + u64::from(RELOAD - left)
        })
    }

    /// `false` when the time has passed already.
    fn set_alarm(&self, at: u64) -> bool {
        GPTMCTL.write(0);
        if at == u64::MAX {
            return true;
        }
        let Some(left) = at.checked_sub(self.now()).filter(|left| *left > 0) else { return false };
        let cycles = left.min(LONGEST_ALARM) * CYCLES / MICROSECONDS;
        GPTMTAILR.write(u32::try_from(cycles).unwrap_or(u32::MAX).max(1));
        GPTMCTL.write(ENABLE);
        true
    }

    /// Wakes what is due and sets the alarm for what comes next.
    fn wake_due(&self, queue: &mut Queue) {
        let mut next = queue.next_expiration(self.now());
        while !self.set_alarm(next) {
            next = queue.next_expiration(self.now());
        }
    }
}

impl Driver for Clock {
    fn now(&self) -> u64 {
        self.cycles() * MICROSECONDS / CYCLES
    }

    fn schedule_wake(&self, at: u64, waker: &Waker) {
        critical_section::with(|section| {
            let mut queue = self.queue.borrow(section).borrow_mut();
            if queue.schedule_wake(at, waker) {
                self.wake_due(&mut queue);
            }
        });
    }
}

#[allow(unsafe_code)]
mod handlers {
    use super::*;

    #[cortex_m_rt::exception]
    fn SysTick() {
        // Interrupts of one priority do not interrupt each other, and this chip has no atomic addition.
        CLOCK.wraps.store(CLOCK.wraps.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
    }

    #[interrupt]
    fn TIMER_0A() {
        GPTMICR.write(TIMEOUT);
        critical_section::with(|section| CLOCK.wake_due(&mut CLOCK.queue.borrow(section).borrow_mut()));
    }
}
