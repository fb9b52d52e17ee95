//! embassy's time: SysTick runs freely for `now`, a timer of the chip fires for the next alarm.
//!
//! SysTick has 24 bits and wraps every second or so, which an interrupt counts. Alarms are exact to a microsecond, and nothing ticks
//! in between.

use core::cell::RefCell;
use core::marker::PhantomData;
use core::sync::atomic::{AtomicU32, Ordering};
use core::task::Waker;

use cortex_m::peripheral::syst::SystClkSource;
use cortex_m::peripheral::{SCB, SYST};
use critical_section::Mutex;
use embassy_time_driver::Driver;
use embassy_time_queue_utils::Queue;

const RELOAD: u32 = 0x00FF_FFFF;
/// Microseconds of [`Alarm::CYCLES`].
const MICROSECONDS: u64 = 2;
/// The alarm is looked at at least this often, which keeps its cycles within 32 bits.
const LONGEST_ALARM: u64 = 50_000_000;

/// A timer of the chip, which counts cycles of the processor.
pub trait Alarm: 'static {
    /// Cycles in two microseconds.
    const CYCLES: u64;

    /// Interrupts after so many cycles, at least one.
    fn set(cycles: u32);

    /// Does not interrupt any more.
    fn stop();
}

/// A board has one as a static of embassy's `time_driver_impl!`, and calls it from two interrupts.
pub struct Clock<A> {
    wraps: AtomicU32,
    queue: Mutex<RefCell<Queue>>,
    alarm: PhantomData<fn() -> A>,
}

impl<A: Alarm> Clock<A> {
    /// One that stands.
    #[expect(clippy::new_without_default, reason = "a static needs a constant")]
    pub const fn new() -> Self {
        Self { wraps: AtomicU32::new(0), queue: Mutex::new(RefCell::new(Queue::new())), alarm: PhantomData }
    }

    /// Starts it at zero. The alarm's timer can be set.
    pub fn start(&self, systick: &mut SYST) {
        systick.set_clock_source(SystClkSource::Core);
        systick.set_reload(RELOAD);
        systick.clear_current();
        systick.enable_counter();
        // QEMU counts a wrap when the counter starts from zero; the chip does not.
        while SYST::get_current() == 0 {}
        SCB::clear_pendst();
        systick.enable_interrupt();
    }

    /// SysTick has wrapped; from its interrupt.
    pub fn wrapped(&self) {
        // Interrupts of one priority do not interrupt each other, and not every chip has atomic addition.
        self.wraps.store(self.wraps.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
    }

    /// The alarm has fired; from its interrupt, which it has acknowledged.
    pub fn alarmed(&self) {
        critical_section::with(|section| self.wake_due(&mut self.queue.borrow(section).borrow_mut()));
    }

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
        A::stop();
        if at == u64::MAX {
            return true;
        }
        let Some(left) = at.checked_sub(self.read()).filter(|left| *left > 0) else { return false };
        let cycles = left.min(LONGEST_ALARM) * A::CYCLES / MICROSECONDS;
        A::set(u32::try_from(cycles).unwrap_or(u32::MAX).max(1));
        true
    }

    /// Wakes what is due and sets the alarm for what comes next.
    fn wake_due(&self, queue: &mut Queue) {
        let mut next = queue.next_expiration(self.read());
        while !self.set_alarm(next) {
            next = queue.next_expiration(self.read());
        }
    }

    fn read(&self) -> u64 {
        self.cycles() * MICROSECONDS / A::CYCLES
    }
}

impl<A: Alarm> Driver for Clock<A> {
    fn now(&self) -> u64 {
        self.read()
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
