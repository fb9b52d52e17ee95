//! All that is unsafe here: entry points with names of their own, values from nowhere, and the panic handler.
#![allow(unsafe_code)]

use core::fmt;
use core::hint::black_box;
use core::panic::PanicInfo;

unsafe extern "C" {
    /// Defined nowhere.
    fn a_panic_is_reachable() -> !;
}

#[panic_handler]
fn panic(_: &PanicInfo<'_>) -> ! {
    // SAFETY: never linked, hence never called.
    unsafe { a_panic_is_reachable() }
}

/// Declares a root of the link. The name stands on the line of the macro, where `build.rs` looks for it.
macro_rules! entry {
    ($name:ident, $body:block) => {
        #[allow(unsafe_code)]
        #[unsafe(no_mangle)]
        extern "C" fn $name() $body
    };
}

/// Some value of which the compiler knows nothing.
pub fn unknown<T>() -> &'static mut T {
    // SAFETY: the binary is not run; the address only has to be one that the compiler cannot see through.
    unsafe { &mut *black_box(core::ptr::with_exposed_provenance_mut(0x2000_0000)) }
}

/// Some slice of some length.
pub fn unknown_slice<T>() -> &'static mut [T] {
    // SAFETY: as above.
    unsafe {
        core::slice::from_raw_parts_mut(
            black_box(core::ptr::with_exposed_provenance_mut(0x2000_0000)),
            black_box(100_usize) & 0xFF_FFFF,
        )
    }
}

/// Some text of some length.
pub fn unknown_text() -> &'static str {
    // SAFETY: as above.
    unsafe { core::str::from_utf8_unchecked(unknown_slice()) }
}

/// Keeps a result alive, so that nothing that leads to it is dropped.
pub fn keep<T>(value: T) {
    black_box(value);
}

/// Takes everything out of an iterator.
pub fn drain<T>(items: impl Iterator<Item = T>) {
    items.for_each(keep);
}

/// Formats a value into nowhere.
pub fn show(value: impl fmt::Display) {
    keep(fmt::write(&mut Sink, format_args!("{value}")));
}

struct Sink;

impl fmt::Write for Sink {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        keep(text);
        *unknown()
    }
}
