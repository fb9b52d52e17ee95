//! The board's LAN9220, which QEMU emulates as a LAN9118.
//!
//! Microchip DS00002417, *LAN9220*: registers of the host's bus; those of the MAC behind MAC_CSR_CMD, and those of the PHY behind
//! the MAC's MII_ACC. A frame in the receive FIFO has a word of status in a FIFO of its own; one that is sent begins with two words
//! of commands.

use core::ops::Range;

use cara_emulated::ethernet::{self, BUFFER_BYTES, Buffer, CHECKSUM_BYTES, Controller, WAKER};

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

/// What the FIFO needs for the longest frame.
const SENT_BYTES: u32 = 8 + BUFFER_BYTES as u32;

/// The driver.
pub type Ethernet = ethernet::Ethernet<Lan9220>;

/// The controller.
pub struct Lan9220;

impl Controller for Lan9220 {
    const HEAD: usize = 0;
    const STATUS: Register = INT_STS;
    const ENABLED: Register = INT_EN;
    const RECEIVED: u32 = RECEIVED;
    const SENT: u32 = CAN_SEND;

    fn start() -> [u8; 6] {
        let _ = BYTE_TEST.read();
        HW_CFG.write(SOFT_RESET);
        while HW_CFG.read() & SOFT_RESET != 0 {}
        // It loads its address.
        while E2P_CMD.read() & BUSY != 0 {}
        let ([a, b, c, d], [e, f, ..]) = (mac(ADDRL).to_le_bytes(), mac(ADDRH).to_le_bytes());
        HW_CFG.write(STORE_AND_FORWARD);
        FIFO_INT.write(LEVELS);
        set_phy(PHY_CONTROL, NEGOTIATE);
        TX_CFG.write(TX_ON);
        set_mac(MAC_CR, FULL_DUPLEX_BOTH_WAYS);
        INT_EN.write(0);
        INT_STS.write(u32::MAX);
        IRQ_CFG.write(IRQ_ENABLE_PUSH_PULL_HIGH);
        unmask(Interrupt::Ethernet);
        [a, b, c, d, e, f]
    }

    fn is_up() -> bool {
        phy(PHY_STATUS) & PHY_LINK_UP != 0
    }

    fn has_received() -> bool {
        RX_FIFO_INF.read() >> 16 & 0xFF != 0
    }

    /// Takes what became of frames that were sent: there is no room either while that lies there.
    fn can_send() -> bool {
        let state = TX_FIFO_INF.read();
        (0..state >> 16 & 0xFF).for_each(|_| _ = TX_STATUS_FIFO.read());
        state & 0xFFFF >= SENT_BYTES
    }

    fn take(buffer: &mut Buffer) -> Range<usize> {
        let status = RX_STATUS_FIFO.read();
        let length = (status >> 16 & 0x3FFF) as usize;
        ethernet::read(RX_DATA_FIFO, length.div_ceil(4), buffer);
        0..if status & ERROR == 0 { length.saturating_sub(CHECKSUM_BYTES) } else { 0 }
    }

    fn send(buffer: &mut Buffer, length: usize) {
        TX_DATA_FIFO.write(FIRST_AND_LAST | length as u32);
        TX_DATA_FIFO.write(length as u32);
        ethernet::write(TX_DATA_FIFO, &buffer[..length.next_multiple_of(4)]);
    }
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
