//! embassy-net's driver for the board's LAN9220, which QEMU emulates as a LAN9118: interrupt-driven, a frame at a time.
//!
//! Microchip DS00002417, *LAN9220*: registers of the host's bus; those of the MAC behind MAC_CSR_CMD, and those of the PHY behind
//! the MAC's MII_ACC. A frame in the receive FIFO has a word of status in a FIFO of its own; one that is sent begins with two words
//! of commands.

use core::task::Context;

use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState, RxToken, TxToken};
use embassy_sync::waitqueue::AtomicWaker;

use crate::interrupt::Interrupt;
use crate::register::{ETHERNET, Register, unmask};

const RX_DATA_FIFO: Register = ETHERNET.at(0x00);
const TX_DATA_FIFO: Register = ETHERNET.at(0x20);
const RX_STATUS_FIFO: Register = ETHERNET.at(0x40);
const TX_STATUS_FIFO: Register = ETHERNET.at(0x48);
const IRQ_CFG: Register = ETHERNET.at(0x54);
/// Written to acknowledge.
const INT_STS: Register = ETHERNET.at(0x58);
const INT_EN: Register = ETHERNET.at(0x5C);
/// Reading it wakes the controller.
const BYTE_TEST: Register = ETHERNET.at(0x64);
const FIFO_INT: Register = ETHERNET.at(0x68);
const TX_CFG: Register = ETHERNET.at(0x70);
const HW_CFG: Register = ETHERNET.at(0x74);
const RX_FIFO_INF: Register = ETHERNET.at(0x7C);
const TX_FIFO_INF: Register = ETHERNET.at(0x80);
const MAC_CSR_CMD: Register = ETHERNET.at(0xA4);
const MAC_CSR_DATA: Register = ETHERNET.at(0xA8);
const E2P_CMD: Register = ETHERNET.at(0xB0);

/// The interrupt drives its line, and high is active.
const IRQ_ENABLE_PUSH_PULL_HIGH: u32 = 1 << 8 | 1 << 4 | 1;
const RECEIVED: u32 = 1 << 3;
const CAN_SEND: u32 = 1 << 9;
/// `CAN_SEND` above 24 times 64 bytes that are free, `RECEIVED` above no frame.
const LEVELS: u32 = 24 << 24;
const SOFT_RESET: u32 = 1;
/// Frames are forwarded when they are whole; 5 KiB are for sending.
const STORE_AND_FORWARD: u32 = 1 << 20 | 5 << 16;
const TX_ON: u32 = 1 << 1;
const BUSY: u32 = 1 << 31;
const READ: u32 = 1 << 30;

const MAC_CR: u32 = 1;
const ADDRH: u32 = 2;
const ADDRL: u32 = 3;
const MII_ACC: u32 = 6;
const MII_DATA: u32 = 7;
const FULL_DUPLEX_BOTH_WAYS: u32 = 1 << 20 | 1 << 3 | 1 << 2;
/// The PHY's address.
const PHY: u32 = 1 << 11;
const MII_WRITE: u32 = 1 << 1;
const PHY_CONTROL: u32 = 0;
const PHY_STATUS: u32 = 1;
const NEGOTIATE: u32 = 1 << 12 | 1 << 9;
const PHY_LINK_UP: u32 = 1 << 2;

/// A frame with an error of any kind.
const ERROR: u32 = 1 << 15;
/// The whole frame is in this buffer.
const FIRST_AND_LAST: u32 = 1 << 13 | 1 << 12;

/// Longest frame without its checksum.
const FRAME_BYTES: usize = 1514;
const CHECKSUM_BYTES: usize = 4;
const BUFFER_BYTES: usize = (FRAME_BYTES + CHECKSUM_BYTES).next_multiple_of(4);
/// What the FIFO needs for the longest frame.
const SENT_BYTES: u32 = 8 + BUFFER_BYTES as u32;

static WAKER: AtomicWaker = AtomicWaker::new();

/// The controller. There is one.
pub struct Ethernet {
    address: [u8; 6],
    received: [u8; BUFFER_BYTES],
    sent: [u8; BUFFER_BYTES],
}

impl Ethernet {
    /// A controller that has not been started.
    #[expect(clippy::new_without_default, reason = "there is one")]
    pub const fn new() -> Self {
        Self { address: [0; 6], received: [0; BUFFER_BYTES], sent: [0; BUFFER_BYTES] }
    }

    /// Starts it, with the MAC address that it holds (QEMU: `-nic …,mac=…`).
    pub fn start(&mut self) {
        let _ = BYTE_TEST.read();
        HW_CFG.write(SOFT_RESET);
        while HW_CFG.read() & SOFT_RESET != 0 {}
        // It loads its address.
        while E2P_CMD.read() & BUSY != 0 {}
        let ([a, b, c, d], [e, f, ..]) = (mac(ADDRL).to_le_bytes(), mac(ADDRH).to_le_bytes());
        self.address = [a, b, c, d, e, f];
        HW_CFG.write(STORE_AND_FORWARD);
        FIFO_INT.write(LEVELS);
        set_phy(PHY_CONTROL, NEGOTIATE);
        TX_CFG.write(TX_ON);
        set_mac(MAC_CR, FULL_DUPLEX_BOTH_WAYS);
        INT_EN.write(0);
        INT_STS.write(u32::MAX);
        IRQ_CFG.write(IRQ_ENABLE_PUSH_PULL_HIGH);
        unmask(Interrupt::Ethernet);
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
        let ready = ready_or_armed(cx, RECEIVED, has_received) && ready_or_armed(cx, CAN_SEND, can_send);
        ready.then_some((Received { buffer: &mut self.received }, Free { buffer: &mut self.sent }))
    }

    fn transmit(&mut self, cx: &mut Context) -> Option<Free<'_>> {
        ready_or_armed(cx, CAN_SEND, can_send).then_some(Free { buffer: &mut self.sent })
    }

    fn link_state(&mut self, _: &mut Context) -> LinkState {
        if phy(PHY_STATUS) & PHY_LINK_UP != 0 { LinkState::Up } else { LinkState::Down }
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
        let status = RX_STATUS_FIFO.read();
        let length = (status >> 16 & 0x3FFF) as usize;
        let mut places = self.buffer.chunks_exact_mut(4);
        for _ in 0..length.div_ceil(4) {
            // All words are taken, also those of a frame that is too long: they would be the next frame's.
            let word = RX_DATA_FIFO.read();
            if let Some(place) = places.next() {
                place.copy_from_slice(&word.to_le_bytes());
            }
        }
        let whole = if status & ERROR == 0 { length.saturating_sub(CHECKSUM_BYTES) } else { 0 };
        let frame = self.buffer.get_mut(..whole).unwrap_or_default();
        #[cfg(feature = "faults")]
        cara_emulated::faults::received(frame);
        act(frame)
    }
}

/// Room for a frame in the transmit FIFO.
pub struct Free<'a> {
    buffer: &'a mut [u8; BUFFER_BYTES],
}

impl TxToken for Free<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, act: F) -> R {
        let length = length.min(FRAME_BYTES);
        let result = act(&mut self.buffer[..length]);
        TX_DATA_FIFO.write(FIRST_AND_LAST | length as u32);
        TX_DATA_FIFO.write(length as u32);
        for word in self.buffer[..length.next_multiple_of(4)].chunks_exact(4) {
            TX_DATA_FIFO.write(word.try_into().map(u32::from_le_bytes).unwrap_or(0));
        }
        result
    }
}

fn has_received() -> bool {
    RX_FIFO_INF.read() >> 16 & 0xFF != 0
}

/// Whether there is room for the longest frame. Takes what became of those that were sent: there is no room either while that lies there.
fn can_send() -> bool {
    let state = TX_FIFO_INF.read();
    (0..state >> 16 & 0xFF).for_each(|_| _ = TX_STATUS_FIFO.read());
    state & 0xFFFF >= SENT_BYTES
}

/// Whether it is ready; if not, the task is woken when the interrupt comes.
fn ready_or_armed(cx: &mut Context, interrupt: u32, ready: impl Fn() -> bool) -> bool {
    if ready() {
        return true;
    }
    WAKER.register(cx.waker());
    INT_STS.write(interrupt);
    critical_section::with(|_| INT_EN.set(interrupt));
    // What came before the acknowledgement raises no interrupt any more.
    ready()
}

/// Reads a register of the MAC.
fn mac(register: u32) -> u32 {
    command(BUSY | READ | register);
    MAC_CSR_DATA.read()
}

fn set_mac(register: u32, value: u32) {
    MAC_CSR_DATA.write(value);
    command(BUSY | register);
}

fn command(command: u32) {
    MAC_CSR_CMD.write(command);
    while MAC_CSR_CMD.read() & BUSY != 0 {}
}

/// Reads a register of the PHY.
fn phy(register: u32) -> u32 {
    access(PHY | register << 6);
    mac(MII_DATA)
}

fn set_phy(register: u32, value: u32) {
    set_mac(MII_DATA, value);
    access(PHY | register << 6 | MII_WRITE);
}

fn access(access: u32) {
    const MII_BUSY: u32 = 1;
    set_mac(MII_ACC, access | MII_BUSY);
    while mac(MII_ACC) & MII_BUSY != 0 {}
}

/// Masks what has fired, for the network's task to look at and arm again.
pub(crate) extern "C" fn interrupt() {
    INT_EN.write(INT_EN.read() & !INT_STS.read());
    WAKER.wake();
}
