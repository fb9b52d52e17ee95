//! Vectors of a stream's frames and chunks.

use cara_core::config::Priority;
use cara_core::distribution::message::{SessionBody, encode_reply};
use cara_core::host::connections::Report;
use cara_core::host::frame::{ChunkWriter, Chunking, Frame, encode};
use serde_json::{Value, json};

use crate::decoded::hex;
use crate::vector::{Context, Kind, Vector};

/// Every vector of this file.
pub(crate) fn all() -> Vec<Vector> {
    [small_frames(), chunks(), violations()].concat()
}

/// The bytes of a frame that is no chunk.
pub(crate) fn frame(frame: &Frame<'_>) -> Vec<u8> {
    let mut out = vec![0; 512];
    let length = encode(frame, 0, &mut out);
    out.truncate(length);
    out
}

/// A message in chunks of at most `chunk` bytes.
pub(crate) fn chunked(chunk: usize, priority: Priority, message: &[u8]) -> Vec<u8> {
    let cut = Chunking { chunk, overhead: 0 };
    let mut out = vec![0; cut.framed_length(message.len())];
    if let Some(mut writer) = ChunkWriter::new(&mut out, cut, priority, message.len()) {
        writer.put(message);
    }
    out
}

/// A reply of `length` bytes in all.
fn reply(id: u32, length: usize) -> Vec<u8> {
    let mut message = encode_reply(id, Ok(())).to_vec();
    message.resize(length, 0xA5);
    message
}

fn stream(names: (&'static str, &'static str), limits: (usize, usize), bytes: &[u8], value: &Value) -> Vector {
    let vector = Vector::new(names, Kind::Stream, Context::limits(limits.0, limits.1), bytes, value);
    let last = value.as_array().and_then(|seen| seen.last());
    let ends_early = last.is_some_and(|last| last.get("violation").or(last.get("incomplete")).is_some());
    if ends_early { vector.lossy() } else { vector }
}

fn small_frames() -> Vec<Vector> {
    let keep_alive = SessionBody::keep_alive(1_000_000, Report { received: 300, holds: true, ..Report::default() });
    let frames = [
        frame(&Frame::Ping),
        frame(&Frame::Pong),
        frame(&Frame::Session(&keep_alive)),
        frame(&Frame::Refuse(4)),
        frame(&Frame::Close(1)),
    ];
    let value = json!(["ping", "pong", { "session": { "keep_alive": { "stamp": 1_000_000, "received": 300, "hears": false, "holds": true, "misses": false } } }, { "refuse": 4 }, { "close": 1 }]);
    vec![
        stream(
            ("frames", "one after the other: ping, pong, session, refuse, close"),
            (320, 512),
            &frames.concat(),
            &value,
        ),
        stream(
            ("frame_incomplete", "what is not complete yet waits"),
            (320, 512),
            &frames[2][..7],
            &json!([{ "incomplete": 7 }]),
        ),
        stream(
            ("frame_skipped", "a kind from 0x40 to 0x7F is passed over on a live link"),
            (320, 512),
            &[&frames[0][..], &[3, 0, 0x40, 1, 2], &frames[1]].concat(),
            &json!(["ping", "skipped", "pong"]),
        )
        .lossy(),
        stream(
            ("close_longer", "what follows the code is passed over"),
            (320, 512),
            &[3, 0, 3, 1, 9],
            &json!([{ "close": 1 }]),
        )
        .lossy(),
    ]
}

fn chunks() -> Vec<Vector> {
    let short = reply(1, 24);
    let long = reply(2, 700);
    let whole = |priority: &str, id: u32, message: &[u8]| json!({ "priority": priority, "message": { "reply": { "id": id, "block": hex(&message[16..]) } } });
    let cut = chunked(320, Priority::Low, &long);
    let (first, rest) = cut.split_at(322);
    let emergency = chunked(320, Priority::Emergency, &reply(3, 16));
    let between = [first, &emergency, &frame(&Frame::Ping), rest].concat();
    vec![
        stream(
            ("chunk_whole", "a message of one chunk"),
            (320, 512),
            &chunked(320, Priority::Normal, &short),
            &json!([whole("normal", 1, &short)]),
        ),
        stream(
            ("chunks_with_emergency", "an emergency and a ping between the chunks of a message of low priority"),
            (320, 1024),
            &between,
            &json!([whole("emergency", 3, &reply(3, 16)), "ping", whole("low", 2, &long)]),
        ),
    ]
}

/// What ends a link, each as the bytes that do it.
fn violations() -> Vec<Vector> {
    let protocol = json!([{ "violation": "protocol" }]);
    let oversize = json!([{ "violation": "oversize" }]);
    let long = chunked(320, Priority::Low, &reply(2, 700));
    let mut in_two = long.clone();
    in_two[3] = 0;
    let twice = [&long[..322], &long[..322]].concat();
    vec![
        stream(("frame_empty", "a frame without a kind"), (320, 512), &[0, 0], &protocol),
        stream(("frame_of_no_kind", "there is no kind 7"), (320, 512), &[1, 0, 7], &protocol),
        stream(("ping_with_body", "a ping has no body"), (320, 512), &[2, 0, 4, 0], &protocol),
        stream(("close_without_code", "a close has a code"), (320, 512), &[1, 0, 3], &protocol),
        stream(("frame_too_long", "told by its header alone"), (320, 512), &[0x41, 1, 4], &oversize),
        stream(("message_too_long", "told by its first chunk alone"), (320, 512), &long[..322], &oversize),
        stream(("chunk_of_nothing", "a later chunk without a first one"), (320, 1024), &long[322..], &protocol),
        stream(
            ("chunk_short", "a chunk that is not the last has 320 bytes or more"),
            (320, 512),
            &[7, 0, 0x11, 2, 9, 0, 0, 0, 2],
            &protocol,
        ),
        stream(("emergency_in_two", "an emergency is one chunk"), (320, 1024), &in_two[..322], &protocol),
        stream(("message_begun_twice", "one message at a time"), (320, 1024), &twice, &protocol),
        stream(
            ("chunk_total_wrong", "the told length is not that of the chunk"),
            (320, 512),
            &[7, 0, 0x13, 2, 2, 0, 0, 0, 5],
            &protocol,
        ),
    ]
}
