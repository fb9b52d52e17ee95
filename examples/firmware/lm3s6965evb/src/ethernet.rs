//! The Stellaris Ethernet controller.
//!
//! Data sheet, Ethernet Controller: MAC registers at offset 0, FIFOs behind MACDATA, the PHY behind MACMCTL. The
//! controller keeps up to 31 frames in 2 KiB of receive FIFO. The first word read of a frame has its length in the lower
//! half (two bytes for itself and four of the checksum included) and the first two bytes of the frame in the upper one;
//! the first word written of one has the length without the Ethernet header.

use core::ops::Range;

use cara_emulated::ethernet::{self, Buffer, CHECKSUM_BYTES, Controller, FRAME_BYTES, WAKER};
use lm3s6965::{Interrupt, interrupt};

use crate::register::{ETHERNET, Register, SYSTEM, unmask};

const RCGC2: Register = SYSTEM.at(0x108);
const RCGC2_MAC_AND_PHY: u32 = 1 << 28 | 1 << 30;

/// Raw interrupt status; written to acknowledge.
const MACRIS: Register = ETHERNET.at(0x000);
const MACIM: Register = ETHERNET.at(0x004);
const MACRCTL: Register = ETHERNET.at(0x008);
const MACTCTL: Register = ETHERNET.at(0x00C);
const MACDATA: Register = ETHERNET.at(0x010);
const MACIA0: Register = ETHERNET.at(0x014);
const MACIA1: Register = ETHERNET.at(0x018);
const MACTHR: Register = ETHERNET.at(0x01C);
const MACMCTL: Register = ETHERNET.at(0x020);
const MACMRXD: Register = ETHERNET.at(0x030);
/// Frames in the receive FIFO.
const MACNP: Register = ETHERNET.at(0x034);
const MACTR: Register = ETHERNET.at(0x038);

const RECEIVED: u32 = 1;
const TRANSMIT_ERROR: u32 = 1 << 1;
const TRANSMIT_EMPTY: u32 = 1 << 2;
const OVERRUN: u32 = 1 << 3;
const ALL_INTERRUPTS: u32 = 0x7F;

const RECEIVE: u32 = 1;
const REJECT_BAD_CHECKSUM: u32 = 1 << 3;
const RESET_RECEIVER: u32 = 1 << 4;
/// Transmit, pad short frames, add the checksum, full duplex.
const TRANSMIT: u32 = 0b1111;
/// Transmit only when asked to, not when the FIFO has filled up to a threshold.
const WHEN_ASKED: u32 = 0x3F;
const NEW_TRANSMISSION: u32 = 1;

const MANAGEMENT_START: u32 = 1;
const PHY_STATUS: u32 = 1;
const PHY_IDENTIFIER: u32 = 2;
const PHY_LINK_UP: u32 = 1 << 2;

/// Most frames in the receive FIFO.
const FRAMES: usize = 31;
/// The length word shares its first word with the frame's head.
const LENGTH_BYTES: usize = 2;
const HEADER_BYTES: usize = 14;

/// The driver.
pub type Ethernet = ethernet::Ethernet<Stellaris>;

/// The controller.
pub struct Stellaris;

impl Controller for Stellaris {
    const HEAD: usize = LENGTH_BYTES;
    const STATUS: Register = MACRIS;
    const ENABLED: Register = MACIM;
    const RECEIVED: u32 = RECEIVED;
    const SENT: u32 = TRANSMIT_EMPTY | TRANSMIT_ERROR;

    fn start() -> [u8; 6] {
        RCGC2.set(RCGC2_MAC_AND_PHY);
        let ([a, b, c, d], [e, f, ..]) = (MACIA0.read().to_le_bytes(), MACIA1.read().to_le_bytes());
        MACIM.write(0);
        MACRIS.write(ALL_INTERRUPTS);
        MACTHR.write(WHEN_ASKED);
        MACTCTL.write(TRANSMIT);
        discard_received();
        MACRCTL.write(RESET_RECEIVER);
        MACRCTL.write(REJECT_BAD_CHECKSUM | RECEIVE);
        MACIM.write(RECEIVED | OVERRUN);
        unmask(Interrupt::ETHERNET);
        [a, b, c, d, e, f]
    }

    fn is_up() -> bool {
        // QEMU has no PHY: its registers read as zero, the identifier included.
        phy(PHY_IDENTIFIER) == 0 || phy(PHY_STATUS) & PHY_LINK_UP != 0
    }

    fn has_received() -> bool {
        MACNP.read() != 0
    }

    fn can_send() -> bool {
        MACTR.read() & NEW_TRANSMISSION == 0
    }

    fn take(buffer: &mut Buffer) -> Range<usize> {
        let first = MACDATA.read();
        let length = (first & 0xFFFF) as usize;
        let (head, rest) = buffer.split_at_mut(4);
        head.copy_from_slice(&first.to_le_bytes());
        ethernet::read(MACDATA, words_behind_the_first(length), rest);
        LENGTH_BYTES..length.saturating_sub(CHECKSUM_BYTES).clamp(LENGTH_BYTES, LENGTH_BYTES + FRAME_BYTES)
    }

    fn send(buffer: &mut Buffer, length: usize) {
        let reported = length.saturating_sub(HEADER_BYTES) as u16;
        buffer[..LENGTH_BYTES].copy_from_slice(&reported.to_le_bytes());
        ethernet::write(MACDATA, &buffer[..(LENGTH_BYTES + length).next_multiple_of(4)]);
        MACTR.write(NEW_TRANSMISSION);
    }
}

fn words_behind_the_first(length: usize) -> usize {
    length.div_ceil(4).saturating_sub(1)
}

/// Takes what an earlier life of the board has left in the receive FIFO. Resetting the receiver would do on the chip;
/// the emulator stops to deliver when its FIFO is full, and only goes on when a frame is read.
fn discard_received() {
    for _ in 0..FRAMES {
        if MACNP.read() == 0 {
            return;
        }
        let words = words_behind_the_first((MACDATA.read() & 0xFFFF) as usize);
        ethernet::read(MACDATA, words, &mut []);
    }
}

/// Reads a register of the PHY.
fn phy(register: u32) -> u32 {
    MACMCTL.write(register << 3 | MANAGEMENT_START);
    while MACMCTL.read() & MANAGEMENT_START != 0 {}
    MACMRXD.read()
}

#[allow(unsafe_code)]
mod handlers {
    use super::*;

    /// Masks what has fired, for the network's task to look at and arm again.
    #[interrupt]
    fn ETHERNET() {
        let fired = MACRIS.read() & MACIM.read();
        if fired & OVERRUN != 0 {
            MACRIS.write(OVERRUN);
            if MACNP.read() == 0 {
                MACRCTL.write(RESET_RECEIVER | REJECT_BAD_CHECKSUM | RECEIVE);
                MACRCTL.write(REJECT_BAD_CHECKSUM | RECEIVE);
            }
        }
        MACIM.write(MACIM.read() & !(fired & !OVERRUN));
        WAKER.wake();
    }
}
