//! A word that one life of the board leaves for the next, in memory that a reset does not clear: why it ended. The emulated
//! chip's own register does not tell.
#![allow(unsafe_code)]

use core::cell::UnsafeCell;
use core::mem::MaybeUninit;

/// Why a life ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Note {
    /// Nobody fed the watchdog.
    Watchdog,
    /// A panic or a fault.
    Program,
}

struct Place(UnsafeCell<MaybeUninit<u32>>);

// SAFETY: a word, written whole when a life ends and read whole when the next one begins.
unsafe impl Sync for Place {}

/// Not touched when the program starts.
#[unsafe(link_section = ".uninit.note")]
static PLACE: Place = Place(UnsafeCell::new(MaybeUninit::uninit()));
/// What power leaves in memory is hardly one of these.
const RAN_OUT: u32 = 0x0DD_F00D;
const PANICKED: u32 = 0x0BAD_C0DE;

/// Leaves a note.
pub(crate) fn leave(note: Note) {
    let word = match note {
        Note::Watchdog => RAN_OUT,
        Note::Program => PANICKED,
    };
    // SAFETY: RAM that nobody else uses; volatile, because no code of this life reads it.
    unsafe { PLACE.0.get().cast::<u32>().write_volatile(word) };
}

/// What the life before this one has left, if it has; asking clears it.
pub(crate) fn take() -> Option<Note> {
    let place = PLACE.0.get().cast::<u32>();
    // SAFETY: as above; volatile, so that whatever power has left there is read as it is.
    let found = unsafe { place.read_volatile() };
    unsafe { place.write_volatile(0) };
    match found {
        RAN_OUT => Some(Note::Watchdog),
        PANICKED => Some(Note::Program),
        _ => None,
    }
}
