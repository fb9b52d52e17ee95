//! A serial wire between two boards, which have no IP stack on it.

use std::cell::{Cell, RefCell};
use std::convert::Infallible;
use std::rc::Rc;

use cara_core::random::Random;
use cara_embassy::line::{self, Line, Memory};
use embassy_sync::blocking_mutex::raw::NoopRawMutex;
use embassy_sync::pipe::Pipe;
use embedded_io_async::{ErrorType, Read, Write};

use crate::Board;

/// What a UART's driver buffers of what comes; more is lost.
const BUFFER: usize = 512;

/// A wire, whose ends are 0 and 1. Copies are the same wire.
#[derive(Clone)]
pub struct Wire {
    baud: u32,
    /// By the end that receives.
    ways: Rc<[Way; 2]>,
}

/// One direction.
struct Way {
    buffer: Pipe<NoopRawMutex, BUFFER>,
    is_pulled: Cell<bool>,
    /// One byte in so many is changed, and one is lost; 0 for none.
    damaged: Cell<u64>,
    random: RefCell<Random>,
    counts: Cell<WireCounts>,
}

/// What became of the bytes of a wire.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WireCounts {
    /// Received, whatever became of them.
    pub bytes: u64,
    /// Received as another byte.
    pub changed: u64,
    /// Lost by noise, or because the receiver's buffer was full.
    pub lost: u64,
}

impl Wire {
    /// A sound wire; what damages it is drawn from `seed`.
    pub fn new(baud: u32, seed: u64) -> Self {
        let way = |end| Way {
            buffer: Pipe::new(),
            is_pulled: Cell::new(false),
            damaged: Cell::new(0),
            random: RefCell::new(Random::new(seed ^ end)),
            counts: Cell::default(),
        };
        Self { baud, ways: Rc::new([way(0), way(1)]) }
    }

    /// The line of a board at an end, in this life of the board.
    pub fn line(&self, end: usize, board: &Board, seed: u64) -> Line {
        let (line, incoming, outgoing) = line::new(Box::leak(Box::new(Memory::new())), self.baud, seed);
        self.ways[end].buffer.clear();
        let (receiver, sender) = (Receiver(self.clone(), end), Sender(self.clone(), 1 - end));
        board.spawn(async move { incoming.run(receiver).await });
        board.spawn(async move { outgoing.run(sender).await });
        line
    }

    /// Changes one byte in so many, and loses one, in both directions; 0 for none.
    pub fn set_damage(&self, one_in: u64) {
        self.ways.iter().for_each(|way| way.damaged.set(one_in));
    }

    /// Pulls the wire that leads to an end, or plugs it in.
    pub fn pull(&self, end: usize, is_pulled: bool) {
        self.ways[end].is_pulled.set(is_pulled);
    }

    /// Bytes that no unit has sent come to an end.
    pub fn inject(&self, end: usize, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.ways[end].carry(*byte));
    }

    /// What became of the bytes in both directions.
    pub fn counts(&self) -> WireCounts {
        let [one, other] = [0, 1].map(|end| self.ways[end].counts.get());
        WireCounts { bytes: one.bytes + other.bytes, changed: one.changed + other.changed, lost: one.lost + other.lost }
    }
}

impl Way {
    fn is_hit(&self) -> bool {
        let damaged = self.damaged.get();
        damaged > 0 && self.random.borrow_mut().below(damaged) == 0
    }

    fn carry(&self, byte: u8) {
        let mut counts = self.counts.get();
        counts.bytes += 1;
        let changed = self.is_hit();
        counts.changed += u64::from(changed);
        let arrives = !self.is_hit() && self.buffer.try_write(&[if changed { byte ^ 0x10 } else { byte }]).is_ok();
        counts.lost += u64::from(!arrives);
        self.counts.set(counts);
    }
}

/// The receiving half of the UART at an end.
struct Receiver(Wire, usize);

impl ErrorType for Receiver {
    type Error = Infallible;
}

impl Read for Receiver {
    async fn read(&mut self, into: &mut [u8]) -> Result<usize, Infallible> {
        Ok(self.0.ways[self.1].buffer.read(into).await)
    }
}

/// The half that sends to an end.
struct Sender(Wire, usize);

impl ErrorType for Sender {
    type Error = Infallible;
}

impl Write for Sender {
    async fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        let way = &self.0.ways[self.1];
        if !way.is_pulled.get() {
            bytes.iter().for_each(|byte| way.carry(*byte));
        }
        Ok(bytes.len())
    }

    async fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}
