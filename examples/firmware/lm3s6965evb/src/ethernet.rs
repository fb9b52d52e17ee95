//! embassy-net's driver for the Stellaris Ethernet controller: interrupt-driven, a frame at a time.
//!
//! Data sheet, Ethernet Controller: MAC registers at offset 0, FIFOs behind MACDATA, the PHY behind MACMCTL. The
//! controller keeps up to 31 frames in 2 KiB of receive FIFO. The first word read of a frame has its length in the lower
//! half (two bytes for itself and four of the checksum included) and the first two bytes of the frame in the upper one;
//! the first word written of one has the length without the Ethernet header.

use core::sync::atomic::{AtomicU32, Ordering};
use core::task::Context;

use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState, RxToken, TxToken};
use embassy_sync::waitqueue::AtomicWaker;
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
/// Longest frame without its checksum.
const FRAME_BYTES: usize = 1514;
/// Length word and header share the first word; the checksum follows the frame.
const LENGTH_BYTES: usize = 2;
const CHECKSUM_BYTES: usize = 4;
const HEADER_BYTES: usize = 14;
const BUFFER_BYTES: usize = (LENGTH_BYTES + FRAME_BYTES + CHECKSUM_BYTES).next_multiple_of(4);

static WAKER: AtomicWaker = AtomicWaker::new();
static OVERRUNS: AtomicU32 = AtomicU32::new(0);

/// The controller. There is one.
pub struct Ethernet {
    address: [u8; 6],
    received: [u8; BUFFER_BYTES],
    sent: [u8; BUFFER_BYTES],
}

impl Ethernet {
    /// A controller that has not been started.
    pub const fn new() -> Self {
        Self { address: [0; 6], received: [0; BUFFER_BYTES], sent: [0; BUFFER_BYTES] }
    }

    /// Starts it, with the MAC address that it holds (QEMU: `-nic …,mac=…`), which is returned.
    pub fn start(&mut self) -> [u8; 6] {
        RCGC2.set(RCGC2_MAC_AND_PHY);
        let ([a, b, c, d], [e, f, ..]) = (MACIA0.read().to_le_bytes(), MACIA1.read().to_le_bytes());
        self.address = [a, b, c, d, e, f];
        MACIM.write(0);
        MACRIS.write(ALL_INTERRUPTS);
        MACTHR.write(WHEN_ASKED);
        MACTCTL.write(TRANSMIT);
        discard_received();
        MACRCTL.write(RESET_RECEIVER);
        MACRCTL.write(REJECT_BAD_CHECKSUM | RECEIVE);
        MACIM.write(RECEIVED | OVERRUN);
        unmask(Interrupt::ETHERNET);
        self.address
    }

    /// Times that frames came faster than they were read.
    pub fn overruns() -> u32 {
        OVERRUNS.load(Ordering::Relaxed)
    }
}

impl Default for Ethernet {
    fn default() -> Self {
        Self::new()
    }
}

impl Driver for &mut Ethernet {
    type RxToken<'a>
        = Received<'a>
    where
        Self: 'a;
    type TxToken<'a>
        = Free<'a>
    where
        Self: 'a;

    fn receive(&mut self, cx: &mut Context) -> Option<(Received<'_>, Free<'_>)> {
        let ready = || MACNP.read() != 0 && is_free();
        ready_or_armed(cx, RECEIVED | TRANSMIT_EMPTY, ready)
            .then_some((Received { buffer: &mut self.received }, Free { buffer: &mut self.sent }))
    }

    fn transmit(&mut self, cx: &mut Context) -> Option<Free<'_>> {
        ready_or_armed(cx, TRANSMIT_EMPTY | TRANSMIT_ERROR, is_free).then_some(Free { buffer: &mut self.sent })
    }

    fn link_state(&mut self, _: &mut Context) -> LinkState {
        // QEMU has no PHY: its registers read as zero, the identifier included.
        let emulated = phy(PHY_IDENTIFIER) == 0;
        if emulated || phy(PHY_STATUS) & PHY_LINK_UP != 0 { LinkState::Up } else { LinkState::Down }
    }

    fn capabilities(&self) -> Capabilities {
        let mut capabilities = Capabilities::default();
        capabilities.max_transmission_unit = FRAME_BYTES;
        capabilities.max_burst_size = Some(1);
        capabilities
    }

    fn hardware_address(&self) -> HardwareAddress {
        HardwareAddress::Ethernet(self.address)
    }
}

/// A frame that waits in the receive FIFO.
pub struct Received<'a> {
    buffer: &'a mut [u8; BUFFER_BYTES],
}

impl RxToken for Received<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, act: F) -> R {
        let first = MACDATA.read();
        let length = (first & 0xFFFF) as usize;
        let words = length.div_ceil(4).saturating_sub(1);
        let (head, rest) = self.buffer.split_at_mut(4);
        head.copy_from_slice(&first.to_le_bytes());
        let mut places = rest.chunks_exact_mut(4);
        for _ in 0..words {
            // All words are taken, also those of a frame that is too long: they would be the next frame's.
            let word = MACDATA.read();
            if let Some(place) = places.next() {
                place.copy_from_slice(&word.to_le_bytes());
            }
        }
        let end = (length.saturating_sub(CHECKSUM_BYTES)).clamp(LENGTH_BYTES, LENGTH_BYTES + FRAME_BYTES);
        let frame = &mut self.buffer[LENGTH_BYTES..end];
        #[cfg(feature = "faults")]
        cara_emulated::faults::received(frame);
        act(frame)
    }
}

/// The transmit FIFO while it is empty.
pub struct Free<'a> {
    buffer: &'a mut [u8; BUFFER_BYTES],
}

impl TxToken for Free<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, act: F) -> R {
        let length = length.min(FRAME_BYTES);
        let result = act(&mut self.buffer[LENGTH_BYTES..LENGTH_BYTES + length]);
        let reported = length.saturating_sub(HEADER_BYTES) as u16;
        self.buffer[..LENGTH_BYTES].copy_from_slice(&reported.to_le_bytes());
        let bytes = (LENGTH_BYTES + length).next_multiple_of(4);
        for word in self.buffer[..bytes].chunks_exact(4) {
            MACDATA.write(word.try_into().map(u32::from_le_bytes).unwrap_or(0));
        }
        MACTR.write(NEW_TRANSMISSION);
        result
    }
}

/// Takes what an earlier life of the board has left in the receive FIFO. Resetting the receiver would do on the chip;
/// the emulator stops to deliver when its FIFO is full, and only goes on when a frame is read.
fn discard_received() {
    for _ in 0..FRAMES {
        if MACNP.read() == 0 {
            return;
        }
        let words = ((MACDATA.read() & 0xFFFF) as usize).div_ceil(4).saturating_sub(1);
        (0..words).for_each(|_| _ = MACDATA.read());
    }
}

fn is_free() -> bool {
    MACTR.read() & NEW_TRANSMISSION == 0
}

/// Whether it is ready; if not, the task is woken when one of the interrupts comes.
fn ready_or_armed(cx: &mut Context, interrupts: u32, ready: impl Fn() -> bool) -> bool {
    if ready() {
        return true;
    }
    WAKER.register(cx.waker());
    MACRIS.write(interrupts);
    critical_section::with(|_| MACIM.set(interrupts));
    // What came before the acknowledgement raises no interrupt any more.
    ready()
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
            OVERRUNS.store(OVERRUNS.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
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
