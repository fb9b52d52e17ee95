//! A serial line: its wire loses and repeats frames, or brings anything. What arrives of the stream is what was written.

use std::collections::VecDeque;

use cara_core::config::LINE_FRAME_BYTES;
use cara_core::host::line::{Line, State};
use cara_core::time::{Duration, Instant};

use crate::script::Script;

/// One end: its line, the frames on their way to it, what it has written and what has come.
struct End {
    line: Line,
    wire: VecDeque<Vec<u8>>,
    written: Vec<u8>,
    came: Vec<u8>,
}

pub(crate) fn run(data: &[u8]) {
    let mut script = Script::new(data);
    let mut now = Instant::from_micros(1_000);
    // Bytes that no line has made may be mistaken for frames: then nothing is said of what arrives.
    let mut is_garbled = script.flag();
    let mut ends = [1, 2].map(|seed| End {
        line: Line::new(115_200, seed),
        wire: VecDeque::new(),
        written: Vec::new(),
        came: Vec::new(),
    });
    while !script.is_over() {
        let act = script.below(16);
        let index = usize::from(act & 1);
        match act >> 1 {
            0 | 1 => {
                let bytes = script.bytes();
                let count = ends[index].line.write(bytes);
                assert!(count <= bytes.len());
                ends[index].written.extend_from_slice(&bytes[..count]);
            }
            2 | 3 => transmit(&mut ends, index, now, script.byte()),
            4 => now = now + Duration::from_millis(u64::from(script.byte()) * 4),
            5 => {
                let end = &mut ends[index];
                let arrived = end.wire.pop_front();
                let mut bytes = arrived.unwrap_or_default();
                if is_garbled {
                    bytes.extend_from_slice(script.bytes());
                }
                receive(end, &bytes, now);
            }
            6 => {
                // A second stream would bring bytes of its own.
                is_garbled |= change(&mut ends[index].line, index, now, script.byte());
            }
            _ => {
                let bytes = script.bytes();
                ends[index].line.send_datagram(script.byte().into(), 1, bytes);
            }
        }
        is_garbled |= ends.iter().any(|end| matches!(end.line.state(), State::Ended(_)));
        if !is_garbled {
            let [one, other] = &ends;
            for (from, to) in [(one, other), (other, one)] {
                assert!(from.written.starts_with(&to.came), "something else has come than was written");
            }
        }
    }
}

fn transmit(ends: &mut [End; 2], index: usize, now: Instant, fate: u8) {
    let mut out = [0; LINE_FRAME_BYTES];
    let frame = ends[index].line.transmit(now, &mut out).to_vec();
    let wire = &mut ends[1 - index].wire;
    for _ in 0..[1, 1, 1, 1, 1, 0, 0, 2][usize::from(fate) % 8] {
        if wire.len() < 16 {
            wire.push_back(frame.clone());
        }
    }
}

fn receive(end: &mut End, mut bytes: &[u8], now: Instant) {
    while !bytes.is_empty() {
        let count = end.line.receive(bytes, now);
        assert!(count > 0 && count <= bytes.len());
        bytes = &bytes[count..];
        while end.line.next_datagram().is_some() {}
    }
    let came = end.line.peek().to_vec();
    end.came.extend_from_slice(&came);
    end.line.take(came.len());
}

/// Dials, accepts or ends; whether it has ended a stream.
fn change(line: &mut Line, index: usize, now: Instant, act: u8) -> bool {
    match (act % 4, line.state()) {
        (0, State::Idle) if index == 0 => drop(line.dial(7)),
        (0 | 1, State::Offered(_)) => drop(line.accept()),
        (2, state) if state != State::Idle => line.close(now),
        (3, state) if state != State::Idle => line.abort(),
        _ => return false,
    }
    act & 2 != 0
}
