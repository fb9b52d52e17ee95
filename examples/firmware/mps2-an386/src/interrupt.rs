//! The chip's interrupts that are used, and their handlers (board, Interrupts).
#![allow(unsafe_code)]

use cortex_m::interrupt::InterruptNumber;

/// Its number.
#[derive(Clone, Copy)]
#[repr(u16)]
pub(crate) enum Interrupt {
    Timer0 = 8,
    Timer1 = 9,
    Ethernet = 13,
}

// SAFETY: numbers of the processor's interrupts, which has 32.
unsafe impl InterruptNumber for Interrupt {
    fn number(self) -> u16 {
        self as u16
    }
}

unsafe extern "C" {
    /// Defined by `cara_board`.
    fn DefaultHandler();
}

type Handler = unsafe extern "C" fn();

/// The processor's table, behind its exceptions.
#[unsafe(link_section = ".vector_table.interrupts")]
#[unsafe(no_mangle)]
static __INTERRUPTS: [Handler; 14] = {
    let mut table: [Handler; 14] = [DefaultHandler; 14];
    table[Interrupt::Timer0 as usize] = crate::clock::alarm;
    table[Interrupt::Timer1 as usize] = crate::motor::tick;
    table[Interrupt::Ethernet as usize] = crate::ethernet::interrupt;
    table
};
