//! What security costs: a handshake, frames and datagrams sealed and opened.

use core::hint::black_box;

use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::host::secure::Seal;
use cara_secure::channel::{Channel, TAG_BYTES};
use cara_secure::handshake::{self, Initiator, MESSAGE_BYTES};
use cara_secure::keys::{KEY_BYTES, PairKey, RootKey};
use cara_secure::suite::Suite;

use crate::{Meter, Of, Operation, Uncounted};

const SHORT: usize = 64;
const LONG: usize = 1024;

/// Two ends with a pair's key.
pub struct Sealing {
    key: PairKey,
    prologue: [u8; 32],
    ends: [Channel; 2],
    frame: &'static mut [u8],
}

impl Sealing {
    /// Bytes that a frame needs.
    pub const FRAME_BYTES: usize = LONG + TAG_BYTES;

    /// After a handshake.
    pub fn new(frame: &'static mut [u8]) -> Self {
        let names = [Identity::m_unit("depot", 1), Identity::s_unit("agv-17", 17)].map(|name| name.expect("a name"));
        let key = RootKey::new([7; KEY_BYTES]).pair(Fleet(1), 1, &names[0], &names[1]);
        let prologue = handshake::prologue(b"initiator", b"responder");
        let ends = agree(&key, &prologue, &mut Uncounted, &mut Uncounted);
        Self { key, prologue, ends, frame }
    }

    fn handshake(&mut self, initiator: &mut dyn Meter, responder: &mut dyn Meter) {
        self.ends = agree(&self.key, &self.prologue, initiator, responder);
    }

    fn frame(&mut self, length: usize, seal: &mut dyn Meter, open: &mut dyn Meter) {
        let [sender, receiver] = &mut self.ends;
        let frame = &mut self.frame[..length + TAG_BYTES];
        seal.count(&mut || sender.seal(black_box(frame)).expect("it is sealed"));
        open.count(&mut || {
            black_box(receiver.open(black_box(frame)).expect("it opens"));
        });
    }

    /// What can be counted.
    pub fn operations() -> [Operation<Self>; 6] {
        const { assert!(SHORT == 64 && LONG == 1024 && MESSAGE_BYTES == 48) }
        let (message, short, long) = (Of::Bytes(48), Of::Bytes(64), Of::Bytes(1024));
        [
            Operation {
                name: "handshake, initiator",
                of: message,
                run: |sealing, meter| sealing.handshake(meter, &mut Uncounted),
            },
            Operation {
                name: "handshake, responder",
                of: message,
                run: |sealing, meter| sealing.handshake(&mut Uncounted, meter),
            },
            Operation { name: "seal a frame", of: short, run: |s, meter| s.frame(SHORT, meter, &mut Uncounted) },
            Operation { name: "open a frame", of: short, run: |s, meter| s.frame(SHORT, &mut Uncounted, meter) },
            Operation { name: "seal a frame", of: long, run: |s, meter| s.frame(LONG, meter, &mut Uncounted) },
            Operation { name: "open a frame", of: long, run: |s, meter| s.frame(LONG, &mut Uncounted, meter) },
        ]
    }
}

fn agree(key: &PairKey, prologue: &[u8; 32], initiator: &mut dyn Meter, responder: &mut dyn Meter) -> [Channel; 2] {
    let mut started = None;
    let suite = Suite::ChaChaPoly;
    initiator.count(&mut || {
        started = Some(Initiator::begin(suite, key, prologue, black_box(&[1; 32])).expect("it begins"));
    });
    let (waiting, message) = started.take().expect("it has begun");
    let mut answered = None;
    responder.count(&mut || {
        answered =
            Some(handshake::answer(suite, key, prologue, black_box(&[2; 32]), &message).expect("it is answered"));
    });
    let (to_initiator, answer) = answered.take().expect("it was answered");
    let (mut waiting, mut finished) = (Some(waiting), None);
    initiator.count(&mut || finished = waiting.take().map(|waiting| waiting.finish(&answer).expect("it ends").channel));
    [finished.expect("it has ended"), to_initiator.channel]
}
