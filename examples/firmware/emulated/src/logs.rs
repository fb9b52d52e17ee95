//! Log lines over the link: a logger of `defmt` that also writes into the unit's log, in memory that a start does not touch. So what
//! the program said before a panic or a fault comes once the board has joined again.

use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicBool, Ordering};

use cara_embassy::{Log, LogCell};
use cara_vehicle::Vehicle;
use critical_section::RestoreState;
use semihosting::io::{Stdout, Write as _};
use static_cell::ConstStaticCell;

#[unsafe(link_section = ".uninit.cara_log")]
#[allow(unsafe_code)]
static LOG: Log = Log::new();

/// Hands the log out.
#[embassy_executor::task]
pub async fn send(vehicle: Vehicle) -> ! {
    static CELL: ConstStaticCell<LogCell> = ConstStaticCell::new(LogCell::new());
    let added = vehicle.my_function_list().add_log(&LOG, CELL.take(), build());
    match added.and_then(|log| vehicle.publish_my_function_list().map(|()| log)) {
        Ok(log) => log.run().await,
        Err(_) => {
            cara_vehicle::error!("no room for the log");
            core::future::pending().await
        }
    }
}

/// By which `cara logs` finds the image's ELF.
#[allow(unsafe_code)]
fn build() -> i64 {
    unsafe extern "C" {
        static cara_build_id: [u8; 8];
    }
    // SAFETY: the linker has put the eight bytes of the build id there (build-id.x of the board), and nothing writes to flash.
    i64::from_be_bytes(unsafe { cara_build_id })
}

#[defmt::global_logger]
struct Logger;

static FRAMES: Frames = Frames {
    taken: AtomicBool::new(false),
    restore: UnsafeCell::new(RestoreState::invalid()),
    encoder: UnsafeCell::new(defmt::Encoder::new()),
    emulator: UnsafeCell::new(None),
};

struct Frames {
    /// A frame is begun, which a line out of the middle of it would spoil.
    taken: AtomicBool,
    restore: UnsafeCell<RestoreState>,
    encoder: UnsafeCell<defmt::Encoder>,
    emulator: UnsafeCell<Option<Stdout>>,
}

// SAFETY: the cells are used between `acquire` and `release` alone, in a critical section.
#[allow(unsafe_code)]
unsafe impl Sync for Frames {}

impl Frames {
    /// Has the encoder write to both places. Only in the critical section of a frame.
    #[allow(unsafe_code)]
    fn encode(&self, act: impl FnOnce(&mut defmt::Encoder, &mut dyn FnMut(&[u8]))) {
        // SAFETY: nothing else runs in the critical section, and this does not call itself.
        let (encoder, emulator) = unsafe { (&mut *self.encoder.get(), &mut *self.emulator.get()) };
        if emulator.is_none() {
            *emulator = semihosting::io::stdout().ok();
        }
        act(encoder, &mut |bytes| {
            LOG.write(bytes);
            if let Some(emulator) = emulator {
                let _ = emulator.write_all(bytes);
            }
        });
    }
}

// SAFETY: `acquire` begins the critical section that `release` ends, and refuses a second frame within the first.
#[allow(unsafe_code)]
unsafe impl defmt::Logger for Logger {
    fn acquire() {
        // SAFETY: `release` ends it.
        let restore = unsafe { critical_section::acquire() };
        assert!(!FRAMES.taken.load(Ordering::Relaxed), "a line within a line");
        FRAMES.taken.store(true, Ordering::Relaxed);
        // SAFETY: in the critical section.
        unsafe { FRAMES.restore.get().write(restore) };
        FRAMES.encode(|encoder, to| encoder.start_frame(to));
    }

    unsafe fn flush() {}

    unsafe fn release() {
        FRAMES.encode(|encoder, to| encoder.end_frame(to));
        FRAMES.taken.store(false, Ordering::Relaxed);
        // SAFETY: what `acquire` has begun.
        unsafe { critical_section::release(FRAMES.restore.get().read()) };
    }

    unsafe fn write(bytes: &[u8]) {
        FRAMES.encode(|encoder, to| encoder.write(bytes, to));
    }
}

/// For tests: a hundred lines a second, each with its number, once it is told to.
#[cfg(feature = "faults")]
pub(crate) mod chatter {
    use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
    use embassy_sync::signal::Signal;
    use embassy_time::{Duration, Ticker};

    pub(crate) static BEGINS: Signal<CriticalSectionRawMutex, ()> = Signal::new();
    const LINES: u32 = 1000;

    /// Its task.
    #[embassy_executor::task]
    pub async fn chatter() -> ! {
        loop {
            BEGINS.wait().await;
            let mut ticker = Ticker::every(Duration::from_millis(10));
            for number in 0..LINES {
                ticker.next().await;
                defmt::info!("line {=u32} of {=u32}", number, LINES);
            }
        }
    }
}

#[cfg(feature = "faults")]
pub use chatter::chatter;
