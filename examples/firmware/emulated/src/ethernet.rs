//! embassy-net's driver for the Ethernet controller of a board: interrupt-driven, a frame at a time through FIFOs of words.

use core::marker::PhantomData;
use core::ops::Range;
use core::task::Context;

use embassy_net_driver::{Capabilities, Driver, HardwareAddress, LinkState, RxToken, TxToken};
use embassy_sync::waitqueue::AtomicWaker;

use crate::register::Register;

/// Longest frame without its checksum.
pub const FRAME_BYTES: usize = 1514;
/// Behind a frame that was received.
pub const CHECKSUM_BYTES: usize = 4;
/// A frame with its checksum, and what a controller has before it, in words.
pub const BUFFER_BYTES: usize = (2 + FRAME_BYTES + CHECKSUM_BYTES).next_multiple_of(4);

/// A frame in words.
pub type Buffer = [u8; BUFFER_BYTES];

/// Woken by the controller's interrupt, which masks what has fired.
pub static WAKER: AtomicWaker = AtomicWaker::new();

/// A board's controller. There is one.
pub trait Controller: 'static {
    /// Where a frame begins in its buffer.
    const HEAD: usize;
    /// Written to acknowledge interrupts.
    const STATUS: Register;
    /// Which interrupts are let through.
    const ENABLED: Register;
    /// Interrupts after which there may be a frame.
    const RECEIVED: u32;
    /// Interrupts after which a frame may be sent.
    const SENT: u32;

    /// Starts it; its address.
    fn start() -> [u8; 6];
    /// Whether the cable is plugged in.
    fn is_up() -> bool;
    /// Whether a frame waits.
    fn has_received() -> bool;
    /// Whether there is room for the longest frame.
    fn can_send() -> bool;
    /// Takes the frame that waits; where it lies.
    fn take(buffer: &mut Buffer) -> Range<usize>;
    /// Sends a frame of that length.
    fn send(buffer: &mut Buffer, length: usize);
}

/// The driver.
pub struct Ethernet<C> {
    address: [u8; 6],
    received: Buffer,
    sent: Buffer,
    controller: PhantomData<C>,
}

impl<C: Controller> Ethernet<C> {
    /// A controller that has not been started.
    #[expect(clippy::new_without_default, reason = "there is one")]
    pub const fn new() -> Self {
        Self { address: [0; 6], received: [0; BUFFER_BYTES], sent: [0; BUFFER_BYTES], controller: PhantomData }
    }

    /// Starts it, with the MAC address that it holds (QEMU: `-nic …,mac=…`).
    pub fn start(&mut self) {
        self.address = C::start();
    }

    fn free(&mut self) -> Free<'_, C> {
        Free { buffer: &mut self.sent, controller: PhantomData }
    }
}

impl<C: Controller> Driver for &mut Ethernet<C> {
    type RxToken<'a>
        = Received<'a, C>
    where
        Self: 'a;
    type TxToken<'a>
        = Free<'a, C>
    where
        Self: 'a;

    fn receive(&mut self, cx: &mut Context) -> Option<(Received<'_, C>, Free<'_, C>)> {
        let ready =
            ready_or_armed::<C>(cx, C::RECEIVED, C::has_received) && ready_or_armed::<C>(cx, C::SENT, C::can_send);
        let Ethernet { received, sent, controller, .. } = &mut **self;
        let controller = *controller;
        ready.then_some((Received { buffer: received, controller }, Free { buffer: sent, controller }))
    }

    fn transmit(&mut self, cx: &mut Context) -> Option<Free<'_, C>> {
        ready_or_armed::<C>(cx, C::SENT, C::can_send).then(|| self.free())
    }

    fn link_state(&mut self, _: &mut Context) -> LinkState {
        if C::is_up() { LinkState::Up } else { LinkState::Down }
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
pub struct Received<'a, C> {
    buffer: &'a mut Buffer,
    controller: PhantomData<C>,
}

impl<C: Controller> RxToken for Received<'_, C> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, act: F) -> R {
        let frame = C::take(self.buffer);
        let frame = self.buffer.get_mut(frame).unwrap_or_default();
        #[cfg(feature = "faults")]
        crate::faults::received(frame);
        act(frame)
    }
}

/// Room for a frame in the transmit FIFO.
pub struct Free<'a, C> {
    buffer: &'a mut Buffer,
    controller: PhantomData<C>,
}

impl<C: Controller> TxToken for Free<'_, C> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, act: F) -> R {
        let length = length.min(FRAME_BYTES);
        let result = act(&mut self.buffer[C::HEAD..C::HEAD + length]);
        C::send(self.buffer, length);
        result
    }
}

/// Takes words from a FIFO. All of them, also those of a frame that is too long: they would be the next frame's.
pub fn read(fifo: Register, words: usize, into: &mut [u8]) {
    let mut places = into.chunks_exact_mut(4);
    for _ in 0..words {
        let word = fifo.read();
        if let Some(place) = places.next() {
            place.copy_from_slice(&word.to_le_bytes());
        }
    }
}

/// Writes words to a FIFO.
pub fn write(fifo: Register, bytes: &[u8]) {
    for word in bytes.chunks_exact(4) {
        fifo.write(word.try_into().map(u32::from_le_bytes).unwrap_or(0));
    }
}

/// Whether it is ready; if not, the task is woken when one of the interrupts comes.
fn ready_or_armed<C: Controller>(cx: &mut Context, interrupts: u32, ready: impl Fn() -> bool) -> bool {
    if ready() {
        return true;
    }
    WAKER.register(cx.waker());
    C::STATUS.write(interrupts);
    critical_section::with(|_| C::ENABLED.set(interrupts));
    // What came before the acknowledgement raises no interrupt any more.
    ready()
}
