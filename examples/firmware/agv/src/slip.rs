//! IP over a serial line: SLIP (RFC 1055) between embassy-net and any UART that has embedded-io-async's `Read` and `Write`.
//!
//! [`new`] makes embassy-net's [`Driver`] and the two halves of the line, each of which runs in a task of its own. The page
//! `docs/serial.md` has the whole recipe, with the other end.
//!
//! SLIP has no checksum and no acknowledgement. A byte that is lost or changed spoils its packet, which the checksums of IP, TCP
//! and UDP find; secured links authenticate each frame besides. The line counts as up always: a pulled one is noticed by
//! keep-alives, and by the lease of whatever moves.

use core::task::Context;

use embassy_net::driver::{Capabilities, Driver, HardwareAddress, LinkState, RxToken, TxToken};
use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embassy_sync::zerocopy_channel::{Channel, Receiver, Sender};
use embassy_time::{Duration, Timer};
use embedded_io_async::{Read, Write};

/// Longest packet, the same at both ends. A packet that is being sent delays an emergency by its length, 50 ms at 115,200 baud;
/// a datagram of more than 548 bytes does not fit and is lost, which is more than discovery and emergencies need.
pub const MTU: usize = 576;
/// Packets received ahead of the network.
const RECEIVED: usize = 2;
/// Packets to send: one, because each that waits delays an emergency behind it.
const SENT: usize = 1;
/// Bytes read or written at a time.
const PIECE: usize = 32;
/// Pause after an error of the UART, so that a broken one does not keep the processor busy.
const AFTER_ERROR: Duration = Duration::from_millis(1);

const END: u8 = 0xC0;
const ESCAPE: u8 = 0xDB;
const ESCAPED_END: u8 = 0xDC;
const ESCAPED_ESCAPE: u8 = 0xDD;

type Packets = Channel<'static, NoopRawMutex, Packet>;

struct Packet {
    length: usize,
    bytes: [u8; MTU],
}

impl Packet {
    const EMPTY: Self = Self { length: 0, bytes: [0; MTU] };

    fn filled(&mut self) -> &mut [u8] {
        let length = self.length.min(MTU);
        &mut self.bytes[..length]
    }
}

/// The packets' memory, about three times [`MTU`].
pub struct Memory {
    received: [Packet; RECEIVED],
    sent: [Packet; SENT],
    queues: Option<[Packets; 2]>,
}

impl Memory {
    /// Without packets.
    pub const fn new() -> Self {
        Self { received: [Packet::EMPTY; RECEIVED], sent: [Packet::EMPTY; SENT], queues: None }
    }
}

impl Default for Memory {
    fn default() -> Self {
        Self::new()
    }
}

/// The driver for `embassy_net::new`, and the line's halves.
pub fn new(memory: &'static mut Memory) -> (Slip, Incoming, Outgoing) {
    let Memory { received, sent, queues } = memory;
    let [received, sent] = queues.insert([Channel::new(received), Channel::new(sent)]);
    let ((from_line, received), (sent, to_line)) = (received.split(), sent.split());
    (Slip { received, sent }, Incoming { packets: from_line }, Outgoing { packets: to_line })
}

/// embassy-net's driver.
pub struct Slip {
    received: Receiver<'static, NoopRawMutex, Packet>,
    sent: Sender<'static, NoopRawMutex, Packet>,
}

impl Driver for Slip {
    type RxToken<'a> = Received<'a>;
    type TxToken<'a> = Free<'a>;

    fn receive(&mut self, cx: &mut Context) -> Option<(Received<'_>, Free<'_>)> {
        let can_answer = self.sent.poll_send(cx).is_ready();
        (self.received.poll_receive(cx).is_ready() && can_answer)
            .then_some((Received(&mut self.received), Free(&mut self.sent)))
    }

    fn transmit(&mut self, cx: &mut Context) -> Option<Free<'_>> {
        self.sent.poll_send(cx).is_ready().then_some(Free(&mut self.sent))
    }

    fn link_state(&mut self, _: &mut Context) -> LinkState {
        LinkState::Up
    }

    fn capabilities(&self) -> Capabilities {
        let mut capabilities = Capabilities::default();
        capabilities.max_transmission_unit = MTU;
        capabilities.max_burst_size = Some(SENT);
        capabilities
    }

    fn hardware_address(&self) -> HardwareAddress {
        HardwareAddress::Ip
    }
}

/// A packet that has come.
pub struct Received<'a>(&'a mut Receiver<'static, NoopRawMutex, Packet>);

impl RxToken for Received<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, act: F) -> R {
        let Some(packet) = self.0.try_receive() else { return act(&mut []) };
        let result = act(packet.filled());
        self.0.receive_done();
        result
    }
}

/// Room for a packet to send.
pub struct Free<'a>(&'a mut Sender<'static, NoopRawMutex, Packet>);

impl TxToken for Free<'_> {
    fn consume<R, F: FnOnce(&mut [u8]) -> R>(self, length: usize, act: F) -> R {
        let Some(packet) = self.0.try_send() else { return act(&mut []) };
        packet.length = length;
        let result = act(packet.filled());
        self.0.send_done();
        result
    }
}

/// The receiving half of the line.
pub struct Incoming {
    packets: Sender<'static, NoopRawMutex, Packet>,
}

impl Incoming {
    /// Reads packets, for ever. The UART's driver must buffer what comes until this task has its turn: 100 bytes are 9 ms at
    /// 115,200 baud.
    pub async fn run(mut self, mut uart: impl Read) -> ! {
        let mut decoder = Decoder::default();
        let mut piece = [0; PIECE];
        loop {
            let Ok(length) = uart.read(&mut piece).await else {
                decoder.spoil();
                Timer::after(AFTER_ERROR).await;
                continue;
            };
            for byte in piece.iter().take(length) {
                if decoder.push(*byte, self.packets.send().await) {
                    self.packets.send_done();
                }
            }
        }
    }
}

/// The sending half of the line.
pub struct Outgoing {
    packets: Receiver<'static, NoopRawMutex, Packet>,
}

impl Outgoing {
    /// Writes packets, for ever. One that the UART does not take is lost.
    pub async fn run(mut self, mut uart: impl Write) -> ! {
        loop {
            if write(&mut uart, self.packets.receive().await.filled()).await.is_err() {
                Timer::after(AFTER_ERROR).await;
            }
            self.packets.receive_done();
        }
    }
}

/// Writes a packet. It begins with an end, so that noise on an idle line is a packet of its own.
async fn write<W: Write>(uart: &mut W, packet: &[u8]) -> Result<(), W::Error> {
    uart.write_all(&[END]).await?;
    // Half a piece fits into one with each of its bytes escaped.
    for bytes in packet.chunks(PIECE / 2) {
        let mut piece = [0; PIECE];
        let mut length = 0;
        for byte in bytes {
            let escaped: &[u8] = match byte {
                &END => &[ESCAPE, ESCAPED_END],
                &ESCAPE => &[ESCAPE, ESCAPED_ESCAPE],
                other => core::slice::from_ref(other),
            };
            piece[length..][..escaped.len()].copy_from_slice(escaped);
            length += escaped.len();
        }
        uart.write_all(&piece[..length]).await?;
    }
    uart.write_all(&[END]).await?;
    uart.flush().await
}

/// Takes packets out of a stream of bytes.
#[derive(Default)]
struct Decoder {
    length: usize,
    is_escaped: bool,
    /// The packet is dropped at its end: it is too long, or misses a byte.
    is_spoilt: bool,
}

impl Decoder {
    /// The packet misses a byte.
    fn spoil(&mut self) {
        self.is_spoilt = true;
    }

    /// Adds a byte to `packet`; `true` when that is complete. Until then it gets the same packet.
    fn push(&mut self, byte: u8, packet: &mut Packet) -> bool {
        if byte == END {
            let ended = core::mem::take(self);
            packet.length = ended.length;
            return ended.length > 0 && !ended.is_spoilt && !ended.is_escaped;
        }
        match (byte, core::mem::take(&mut self.is_escaped)) {
            (ESCAPE, false) => self.is_escaped = true,
            (ESCAPED_END, true) => self.add(END, packet),
            (ESCAPED_ESCAPE, true) => self.add(ESCAPE, packet),
            (_, true) => self.spoil(),
            (_, false) => self.add(byte, packet),
        }
        false
    }

    fn add(&mut self, byte: u8, packet: &mut Packet) {
        match packet.bytes.get_mut(self.length) {
            Some(place) => *place = byte,
            None => return self.spoil(),
        }
        self.length += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::{Decoder, END, ESCAPE, MTU, Packet, write};
    use core::pin::pin;
    use core::task::{Context, Poll, Waker};
    use std::vec;
    use std::vec::Vec;

    fn encoded(packet: &[u8]) -> Vec<u8> {
        let mut bytes = vec![0; 2 * packet.len() + 2];
        let mut free = bytes.as_mut_slice();
        let written = pin!(write(&mut free, packet)).poll(&mut Context::from_waker(Waker::noop()));
        assert_eq!(written, Poll::Ready(Ok(())));
        let left = free.len();
        bytes.truncate(bytes.len() - left);
        bytes
    }

    fn decoded(decoder: &mut Decoder, bytes: &[u8]) -> Vec<Vec<u8>> {
        let mut packet = Packet::EMPTY;
        let mut packets = Vec::new();
        for byte in bytes {
            if decoder.push(*byte, &mut packet) {
                packets.push(packet.filled().to_vec());
            }
        }
        packets
    }

    #[test]
    fn packets_come_as_they_went() {
        let all: Vec<u8> = (0..=255).collect();
        let packets = [vec![1], all, vec![END; MTU], vec![ESCAPE; MTU], vec![7; MTU]];
        let bytes: Vec<u8> = packets.iter().flat_map(|packet| encoded(packet)).collect();
        assert_eq!(decoded(&mut Decoder::default(), &bytes), packets);
    }

    #[test]
    fn what_is_spoilt_is_dropped_and_the_next_packet_comes() {
        let (long, next) = (vec![7; MTU + 1], encoded(&[1, 2]));
        for spoilt in [&[9, ESCAPE, 9][..], &[9, ESCAPE], &[ESCAPE, ESCAPE], &long] {
            assert_eq!(decoded(&mut Decoder::default(), &[spoilt, &next].concat()), [[1, 2]], "{spoilt:?}");
        }
        let mut decoder = Decoder::default();
        assert!(decoded(&mut decoder, &[9, 9]).is_empty());
        decoder.spoil();
        assert_eq!(decoded(&mut decoder, &next), [[1, 2]]);
    }
}
