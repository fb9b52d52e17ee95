//! What one life of a board leaves for the next, in memory that a reset keeps and a start does not clear: why it ended, and
//! where.
#![cfg_attr(target_os = "none", allow(unsafe_code))]

use core::panic::PanicInfo;
use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use crate::Board;

/// Why a life of a board began.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[repr(u32)]
pub enum Reason {
    /// Power came.
    PowerOn,
    /// The reset pin.
    Pin,
    /// The voltage was too low.
    BrownOut,
    /// The unit's task or the motors' interrupt did not run.
    Watchdog,
    /// A panic.
    Panic,
    /// A fault of the processor.
    Fault,
    /// The stack was too small.
    StackOverflow,
    /// The program asked for it.
    Program,
    /// The chip does not say.
    Unknown,
}

impl Reason {
    /// Those that are noted, as opposed to what registers tell.
    const RECORDED: [Self; 4] = [Self::Watchdog, Self::Panic, Self::Fault, Self::StackOverflow];

    /// How it is noted: words that memory hardly holds when power comes.
    const fn word(self) -> u32 {
        0x0BAD_C0DE ^ ((self as u32) << 28)
    }
}

/// Where a program ended. 0 stands for not known.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place<'f> {
    /// The file of a panic; empty for a fault.
    pub file: &'f str,
    /// The line in it, or the address of the instruction.
    pub at: u32,
}

impl<'f> Place<'f> {
    /// Not known.
    pub const NOWHERE: Self = Self::address(0);

    /// The address of an instruction.
    pub const fn address(address: u32) -> Self {
        Self { file: "", at: address }
    }

    /// Of a panic, in images with log lines. Those without do not tell it: files and lines of all panics that could come took
    /// a tenth of such an image.
    pub fn of(panic: &'f PanicInfo<'_>) -> Self {
        let reported = if cfg!(feature = "defmt") { panic.location() } else { None };
        reported.map_or(Self::NOWHERE, |location| Self { file: location.file(), at: location.line() })
    }
}

/// The reason's word and the line or address. Not touched when the program starts.
#[cfg_attr(target_os = "none", unsafe(link_section = ".uninit.cara_note"))]
static NOTE: [AtomicU32; 2] = [AtomicU32::new(0), AtomicU32::new(0)];

/// The program ends, and is about to log why.
static ENDING: AtomicBool = AtomicBool::new(false);

/// Notes a reason for the next life; the last one counts.
pub fn leave(reason: Reason, at: u32) {
    let [word, place] = &NOTE;
    place.store(at, Ordering::Relaxed);
    word.store(reason.word(), Ordering::Relaxed);
}

/// What the life before this one has noted, if it has; asking clears it.
pub(crate) fn take() -> Option<(Reason, u32)> {
    let [word, place] = &NOTE;
    let found = word.load(Ordering::Relaxed);
    word.store(0, Ordering::Relaxed);
    let reason = Reason::RECORDED.into_iter().find(|reason| reason.word() == found)?;
    Some((reason, place.load(Ordering::Relaxed)))
}

/// Ends the program: motors off first, then the note, the log, and the reset.
pub fn end<B: Board>(reason: Reason, place: Place<'_>) -> ! {
    // The motors' interrupt would switch them on again.
    mask_interrupts();
    B::motors(false);
    if !ENDING.load(Ordering::Relaxed) {
        ENDING.store(true, Ordering::Relaxed);
        leave(reason, place.at);
        // May fail in turn: a program can end in the midst of a log line.
        B::ended(reason, place);
    }
    B::reset()
}

fn mask_interrupts() {
    // SAFETY: nothing runs behind this but what ends the program.
    #[cfg(target_os = "none")]
    unsafe {
        core::arch::asm!("cpsid i")
    };
}

#[cfg(test)]
mod tests {
    use super::{NOTE, Reason, leave, take};
    use core::sync::atomic::Ordering;

    #[test]
    fn a_note_is_read_once_and_noise_is_none() {
        assert_eq!(take(), None);
        for reason in Reason::RECORDED {
            leave(reason, 7);
            assert_eq!(take(), Some((reason, 7)));
            assert_eq!(take(), None);
        }
        leave(Reason::Program, 7);
        assert_eq!(take(), None, "what registers tell is not noted");
        let [word, _] = &NOTE;
        for noise in [u32::MAX, 0x5555_5555, Reason::Panic.word() ^ 1] {
            word.store(noise, Ordering::Relaxed);
            assert_eq!(take(), None);
        }
    }
}
