//! Serial line 0 at 115,200 baud, 8N1, as embedded-io-async's `Read` and `Write` (data sheet, Universal Asynchronous
//! Receivers/Transmitters). The emulator takes bytes as fast as they are written.

use core::convert::Infallible;
use core::future::poll_fn;
use core::task::Poll;

use embassy_sync::blocking_mutex::raw::CriticalSectionRawMutex;
use embassy_sync::pipe::Pipe;
use embassy_sync::waitqueue::AtomicWaker;
use embedded_io_async::{ErrorType, Write};
use lm3s6965::{Interrupt, interrupt};

use crate::register::{PORT_A, Register, SYSTEM, UART_0, unmask};

const RCGC1: Register = SYSTEM.at(0x104);
const RCGC1_UART_0: u32 = 1;
const RCGC2: Register = SYSTEM.at(0x108);
const RCGC2_PORT_A: u32 = 1;

/// The pins, PA0 and PA1.
const PINS: u32 = 0b11;
const GPIOAFSEL: Register = PORT_A.at(0x420);
const GPIODEN: Register = PORT_A.at(0x51C);

/// A byte, and above it what was wrong with it.
const UARTDR: Register = UART_0.at(0x000);
const UARTFR: Register = UART_0.at(0x018);
const UARTIBRD: Register = UART_0.at(0x024);
const UARTFBRD: Register = UART_0.at(0x028);
const UARTLCRH: Register = UART_0.at(0x02C);
const UARTCTL: Register = UART_0.at(0x030);
const UARTIM: Register = UART_0.at(0x038);
const UARTICR: Register = UART_0.at(0x044);

const RECEIVED_NONE: u32 = 1 << 4;
const SEND_FULL: u32 = 1 << 5;
const EIGHT_BITS_AND_FIFOS: u32 = 0b11 << 5 | 1 << 4;
const ENABLE_BOTH_WAYS: u32 = 1 | 0b11 << 8;
/// The FIFO has filled, or holds bytes and no more have come for the time of 32 bits.
const RECEIVED: u32 = 1 << 4 | 1 << 6;
/// The FIFO for sending has drained.
const SENT: u32 = 1 << 5;

/// Bits per second.
pub const BAUD: u32 = 115_200;
/// The divisor of 12.5 MHz for that, 12,500,000 / (16 × 115,200), in 64ths.
const DIVISOR: u32 = 434;

/// Bytes received ahead of their task, 44 ms of the line. What comes beyond them is lost.
static INCOMING: Pipe<CriticalSectionRawMutex, 512> = Pipe::new();
static CAN_SEND: AtomicWaker = AtomicWaker::new();

/// The receiving half.
pub type Receiver = &'static Pipe<CriticalSectionRawMutex, 512>;

/// The sending half.
pub struct Sender(());

/// Starts the line, once; its halves.
pub fn start() -> (Receiver, Sender) {
    RCGC1.set(RCGC1_UART_0);
    RCGC2.set(RCGC2_PORT_A);
    GPIOAFSEL.set(PINS);
    GPIODEN.set(PINS);
    UARTCTL.write(0);
    UARTIBRD.write(DIVISOR / 64);
    UARTFBRD.write(DIVISOR % 64);
    UARTLCRH.write(EIGHT_BITS_AND_FIFOS);
    UARTICR.write(u32::MAX);
    UARTIM.write(RECEIVED);
    UARTCTL.write(ENABLE_BOTH_WAYS);
    unmask(Interrupt::UART0);
    (&INCOMING, Sender(()))
}

impl ErrorType for Sender {
    type Error = Infallible;
}

impl Write for Sender {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        poll_fn(|cx| {
            let mut written = send(bytes);
            if written == 0 && !bytes.is_empty() {
                CAN_SEND.register(cx.waker());
                critical_section::with(|_| UARTIM.set(SENT));
                // It may have drained before it was waited for.
                written = send(bytes);
            }
            if written > 0 || bytes.is_empty() { Poll::Ready(Ok(written)) } else { Poll::Pending }
        })
        .await
    }

    /// What was written leaves by itself.
    async fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

/// Sends as many bytes as there is room for; their number.
fn send(bytes: &[u8]) -> usize {
    let free = |_: &&u8| UARTFR.read() & SEND_FULL == 0;
    bytes.iter().take_while(free).map(|byte| UARTDR.write(u32::from(*byte))).count()
}

#[allow(unsafe_code)]
mod handlers {
    use super::*;

    #[interrupt]
    fn UART0() {
        UARTICR.write(RECEIVED | SENT);
        UARTIM.write(RECEIVED);
        while UARTFR.read() & RECEIVED_NONE == 0 {
            let [byte, errors, ..] = UARTDR.read().to_le_bytes();
            // One that is lost here spoils its packet, whose checksum shows it.
            if errors == 0 {
                let _ = INCOMING.try_write(&[byte]);
            }
        }
        CAN_SEND.wake();
    }
}
