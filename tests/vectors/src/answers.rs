//! What a unit answers to bytes that it must not take as they are, and to a few that it must: the rules of
//! `docs/wire.md`, sections 8 and 12 to 15, as the core's session keeps them.

use cara_core::config::Priority;
use cara_core::distribution::function_list::{Generation, Slot};
use cara_core::distribution::hello::Hello;
use cara_core::distribution::identity::{Fleet, Identity};
use cara_core::distribution::message::{Control, Release, Renewal, RequestHeader, SessionBody, encode_reply};
use cara_core::error::Error;
use cara_core::host::frame::Frame;
use cara_core::time::Duration;
use serde::Serialize;
use serde_json::{Value, json};

use crate::decoded::hex;
use crate::introductions::{agv_hello, encoded_hello, hello_of, hello_with, item, manager_hello};
use crate::side::{Side, Written};
use crate::stream;
use crate::streams::{chunked, frame};
use crate::talk::live;
use crate::vector::{Context, canonical};

/// What comes, and what is answered to it in the stream.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Answer {
    name: &'static str,
    about: &'static str,
    /// `live`: the s_unit of the conversation, after `talk_list_ack`. `fresh`: its manager, which has accepted a
    /// connection. `full`: the same, which takes no more nodes. `fresh s_unit`: the s_unit, which has accepted one.
    /// `slow`: as `live`, with a minimum interval of 10 ms.
    link: &'static str,
    /// Bytes of the stream that come in; each piece is dealt with before the next one comes.
    given: Vec<String>,
    /// Time that passes afterwards, in milliseconds.
    wait: u64,
    /// Bytes of the stream that are written then, keep-alives left out.
    answer: String,
    value: Value,
}

/// Every answer.
pub(crate) fn all() -> Vec<Answer> {
    [frames(), handshakes(), messages(), requests(), leases(), silence()].concat()
}

type Case<G> = (&'static str, &'static str, &'static str, G, u64, Value);

/// Bytes that come in, in pieces.
type Given = Vec<Vec<u8>>;

fn answers<const N: usize>(cases: [Case<Vec<u8>>; N]) -> Vec<Answer> {
    let in_one = |(name, about, link, given, wait, expected)| answer((name, about, link, vec![given], wait, expected));
    cases.into_iter().map(in_one).collect()
}

/// Plays a case, and fails if the answer is another than expected.
fn answer((name, about, link, given, wait, expected): Case<Given>) -> Answer {
    let mut side = match link {
        "fresh" => Side::new(manager_hello(), false, &[]),
        "full" => Side::with_room(manager_hello(), false, &[], 0),
        "fresh s_unit" => Side::new(agv_hello(), false, &[]),
        "slow" => live(slow_hello()).0,
        _ => live(agv_hello()).0,
    };
    let _ = side.written();
    let mut bytes = Vec::new();
    for piece in &given {
        side.hear(&Written::Stream(piece.clone()));
        bytes.extend(stream_bytes(&mut side));
    }
    for _ in 0..wait {
        side.wait(Duration::from_millis(1));
        side.poll();
        bytes.extend(stream_bytes(&mut side));
    }
    let value = stream::decode(&Context::limits(4096, 32_800), &bytes);
    assert_eq!(canonical(&value), canonical(&expected), "{name} is answered otherwise");
    let given = given.iter().map(|piece| hex(piece)).collect();
    Answer { name, about, link, given, wait, answer: hex(&bytes), value }
}

fn stream_bytes(side: &mut Side) -> Vec<u8> {
    let keep_alive = |bytes: &[u8]| bytes.starts_with(&[15, 0, 6, 1]);
    let pieces = side.written().into_iter().filter_map(|piece| match piece {
        Written::Stream(bytes) if !keep_alive(&bytes) => Some(bytes),
        _ => None,
    });
    pieces.flatten().collect()
}

fn slow_hello() -> Hello {
    let mut hello = agv_hello();
    hello.limits.minimum_interval = 10_000;
    hello
}

fn normal(message: &[u8]) -> Vec<u8> {
    chunked(1024, Priority::Normal, message)
}

fn control(control: &Control<'_>) -> Vec<u8> {
    let mut bytes = [0; 128];
    normal(control.encode(&mut bytes).unwrap_or(&[]))
}

/// A control message of these items.
fn items(items: &[Vec<u8>]) -> Vec<u8> {
    normal(&[&[3, 0, 0, 0][..], &items.concat()].concat())
}

/// A control message of one item, as it is written.
fn reported(item: Value) -> Value {
    json!({ "priority": "high", "message": { "control": [item] } })
}

fn close(code: u8) -> Value {
    json!([{ "close": code }])
}

fn frames() -> Vec<Answer> {
    let long = [&[0x00, 0x04, 0x11, 2][..], &1089_u32.to_le_bytes(), &[0; 1018]].concat();
    answers([
        ("ping", "answered at once", "live", frame(&Frame::Ping), 0, json!(["pong"])),
        ("pong_unasked", "no harm", "live", frame(&Frame::Pong), 0, json!([])),
        ("frame_unknown", "there is no kind 7", "live", vec![1, 0, 7], 0, close(5)),
        ("frame_skipped", "kind 0x40 is passed over", "live", vec![3, 0, 0x40, 1, 2], 0, json!([])),
        ("frame_not_skipped", "kind 0x80 is not", "live", vec![1, 0, 0x80], 0, close(5)),
        ("frame_oversize", "1,025 bytes, 1,024 are taken", "live", vec![0x01, 0x04], 0, close(6)),
        ("message_oversize", "1,057 bytes, 1,024 + 32 are taken", "live", long, 0, close(6)),
        ("chunk_without_first", "nothing was begun", "live", vec![3, 0, 0x12, 2, 9], 0, close(5)),
        ("second_hello", "one is enough", "live", frame(&Frame::Hello(&encoded_hello(&manager_hello()))), 0, close(5)),
        ("session_body_unknown", "dropped", "live", frame(&Frame::Session(&[9, 9])), 0, json!([])),
    ])
}

fn handshakes() -> Vec<Answer> {
    let mut magic = hello_of(3, 5);
    magic[0] = b'X';
    let mut small = agv_hello();
    small.limits.chunk_size = 319;
    let small = encoded_hello(&small);
    let mut fleet = agv_hello();
    fleet.fleet = Fleet(8);
    let mut stray = agv_hello();
    stray.wanted = None;
    let hello = |hello: &Hello| frame(&Frame::Hello(&encoded_hello(hello)));
    let same = hello(&manager_hello());
    let mut taken = stream::decode(&Context::limits(4096, 32_800), &same);
    let mut other_versions = taken.clone();
    let then = |seen: &mut Value, next| seen.as_array_mut().unwrap_or_else(|| panic!("a stream")).push(next);
    then(&mut taken, reported(json!({ "list_end": { "serial": 1 } })));
    then(&mut other_versions, json!({ "refuse": 1 }));
    let refuse = |code: u8| json!([{ "refuse": code }]);
    let given = |hello: &[u8]| frame(&Frame::Hello(hello));
    let later = given(&[&hello_of(2, 9)[..], &item(0x7000, b"later")].concat());
    let strict = given(&hello_with(&item(0xF000, b"later")));
    answers([
        (
            "other_versions",
            "3 to 5: answered with a hello, which tells the versions of this end, and refused",
            "fresh",
            given(&hello_of(3, 5)),
            0,
            other_versions.clone(),
        ),
        ("version_1", "the same", "fresh", given(&hello_of(1, 7)), 0, other_versions),
        ("more_versions", "2 to 9, and an unknown item: taken", "fresh", later, 0, taken.clone()),
        ("must_understand", "an unknown item that must be understood", "fresh", strict, 0, refuse(8)),
        ("other_magic", "not of this mode", "fresh", frame(&Frame::Hello(&magic)), 0, refuse(8)),
        ("small_chunks", "a chunk limit of 319", "fresh", frame(&Frame::Hello(&small)), 0, refuse(8)),
        (
            "hello_taken",
            "answered with a hello, and the end of a list that is empty",
            "fresh",
            hello(&agv_hello()),
            0,
            taken,
        ),
        ("fleet_refused", "fleet 8 and fleet 7", "fresh", hello(&fleet), 0, refuse(2)),
        ("manager_refused", "an s_unit of no manager", "fresh", hello(&stray), 0, refuse(3)),
        ("full_refused", "no more nodes", "full", hello(&agv_hello()), 0, refuse(4)),
        ("own_identity", "the manager's own name and id", "fresh", same, 0, refuse(5)),
        ("role_refused", "two s_units", "fresh s_unit", hello(&other_agv()), 0, refuse(6)),
        ("ping_before_hello", "too early", "fresh", frame(&Frame::Ping), 0, close(5)),
        ("skipped_before_hello", "passed over on a live link only", "fresh", vec![1, 0, 0x40], 0, close(5)),
        ("no_hello", "none within 2 s", "fresh", Vec::new(), 2_000, close(7)),
    ])
}

fn other_agv() -> Hello {
    let identity = Identity::s_unit("agv-08", 8).unwrap_or_else(|error| panic!("{error}"));
    Hello { identity, ..agv_hello() }
}

fn messages() -> Vec<Answer> {
    let list_end = item(3, &[9]);
    let nameless = item(1, &[0, 0, 8, 2, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0]);
    let withdraw = item(2, &[77]);
    let attributes = Control::Publish { slot: 0, generation: 0, attributes: &[2; 7], signature: &[0, 0, 0] };
    let ack = |skipped| reported(json!({ "list_ack": { "serial": 9, "skipped": skipped } }));
    answers([
        ("message_unknown", "there is no kind 5", "live", normal(&[5; 16]), 0, close(5)),
        (
            "failure_of_nothing",
            "a failure needs an error",
            "live",
            normal(&[4, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]),
            0,
            close(5),
        ),
        ("reply_to_nobody", "dropped", "live", normal(&encode_reply(77, Err(Error::Busy))), 0, json!([])),
        (
            "publish_unreadable",
            "a function without a name is not kept, and counted",
            "live",
            items(&[nameless, list_end.clone()]),
            0,
            json!([ack(1)]),
        ),
        ("publish_malformed", "attributes of 7 bytes", "live", control(&attributes), 0, close(5)),
        ("withdraw_unknown", "no harm", "live", control(&Control::Withdraw { slot: 77 }), 0, json!([])),
        ("list_end", "acknowledged", "live", control(&Control::ListEnd { serial: 9 }), 0, json!([ack(0)])),
        (
            "list_end_last",
            "behind an unknown item and a withdrawal",
            "live",
            items(&[item(0x7000, b"later"), withdraw.clone(), list_end.clone()]),
            0,
            json!([ack(0)]),
        ),
        (
            "list_end_not_last",
            "nothing may follow it in its message",
            "live",
            items(&[list_end, withdraw]),
            0,
            json!([ack(0), { "close": 5 }]),
        ),
        (
            "control_must_understand",
            "an unknown item that must be understood",
            "live",
            items(&[item(0xF000, b"later")]),
            0,
            close(5),
        ),
    ])
}

/// A request of the s_unit's function in `slot`. The newest keep-alive of it that the manager has heard was made at
/// 1,001,000 of its clock, which is now.
fn header(id: u32, slot: u16) -> RequestHeader {
    RequestHeader {
        id,
        slot: Slot(slot),
        generation: Generation(0),
        wants_reply: true,
        wants_progress: false,
        takes_over: false,
        operator: false,
        unknown: 0,
        remaining: Duration::from_secs(1),
        stamp: 1_001_000,
        since: Duration::ZERO,
        number: id,
    }
}

fn request(header: RequestHeader, block: &[u8]) -> Vec<u8> {
    normal(&[&header.encode()[..], block].concat())
}

fn refused(id: u32, error: Value) -> Value {
    json!({ "priority": "normal", "message": { "reply": { "id": id, "error": error } } })
}

fn requests() -> Vec<Answer> {
    let first = || header(1, 0);
    let publish = json!({ "publish": {
        "slot": 0, "generation": 0, "attributes": "0200000000000000",
        "signature": "08706f735f696e666f0001000802000000706f736974696f6e",
    }});
    let stale = refused(1, json!("stale_function"));
    let news = json!([stale, reported(publish), reported(json!({ "list_end": { "serial": 2 } }))]);
    let one_way = json!([{ "priority": "normal", "message": { "failure": { "id": 1, "error": "unknown_function" } } }]);
    let twice = [request(first(), &[]), request(first(), &[])].concat();
    let below = [request(header(100, 0), &[]), request(header(36, 0), &[]), request(header(37, 0), &[])].concat();
    let many = (1..=9).flat_map(|id| request(header(id, 0), &[])).collect();
    let three = (1..=3).flat_map(|id| request(header(id, 0), &[])).collect();
    let future = RequestHeader { stamp: 1_001_001, ..first() };
    let late = RequestHeader { stamp: 1_000_000, remaining: Duration::from_micros(1_000), ..first() };
    let just = RequestHeader { stamp: 1_000_000, remaining: Duration::from_micros(1_001), ..first() };
    let unknown = RequestHeader { wants_reply: false, ..header(1, 7) };
    let critical = RequestHeader { unknown: 0x80, ..first() };
    let unsupported = [request(critical, &[0; 8]), request(critical, &[])].concat();
    let mut passed_over = [&first().encode()[..], &[0xEE; 4]].concat();
    (passed_over[1], passed_over[6]) = (0x0F, 9);
    answers([
        ("request_accepted", "it runs, and is answered later", "live", request(first(), &[]), 0, json!([])),
        (
            "request_unknown",
            "slot 7 was never published",
            "live",
            request(header(1, 7), &[]),
            0,
            json!([refused(1, json!("unknown_function"))]),
        ),
        ("request_unknown_one_way", "the same without waiting", "live", request(unknown, &[]), 0, one_way),
        (
            "request_stale_function",
            "another generation: refused, and the news again",
            "live",
            request(RequestHeader { generation: Generation(9), ..first() }, &[]),
            0,
            news,
        ),
        (
            "request_malformed",
            "a block of 8 bytes where none belongs",
            "live",
            request(first(), &[0; 8]),
            0,
            json!([refused(1, json!("malformed"))]),
        ),
        (
            "request_from_the_future",
            "a stamp of 1 us from now",
            "live",
            request(future, &[]),
            0,
            json!([refused(1, json!("malformed"))]),
        ),
        (
            "request_expired",
            "exactly as old as its remaining time",
            "live",
            request(late, &[]),
            0,
            json!([refused(1, json!("expired"))]),
        ),
        ("request_in_time", "1 us younger: it runs", "live", request(just, &[]), 0, json!([])),
        ("request_twice", "the second copy is dropped without an answer", "live", twice, 0, json!([])),
        (
            "request_unsupported",
            "a flag that must be understood, whatever its block; the second copy is dropped",
            "live",
            unsupported,
            0,
            json!([refused(1, json!("unsupported"))]),
        ),
        (
            "request_of_a_later_version",
            "flags that may be passed over, and a longer header: it runs",
            "live",
            normal(&passed_over),
            0,
            json!([]),
        ),
        (
            "request_below_window",
            "64 below the newest is refused, 63 runs",
            "live",
            below,
            0,
            json!([refused(36, json!("stale"))]),
        ),
        (
            "request_busy",
            "eight calls are held, the ninth is refused",
            "live",
            many,
            0,
            json!([refused(9, json!("busy"))]),
        ),
        (
            "request_too_soon",
            "one may come early, not two",
            "slow",
            three,
            0,
            json!([refused(3, json!({ "too_soon": { "wait": 10_000 } }))]),
        ),
    ])
}

fn leases() -> Vec<Answer> {
    let position = [[3, 0, 0, 0, 0, 0, 0, 0], [4, 0, 0, 0, 0, 0, 0, 0]].concat();
    let go_to = RequestHeader { wants_reply: false, ..header(1, 1) };
    let old = RequestHeader { stamp: 501_000, remaining: Duration::from_secs(9), ..go_to };
    let body = |body: &[u8]| frame(&Frame::Session(body));
    let renewal =
        Renewal { call: 1, class: Priority::Normal, stamp: 1_001_000, since: Duration::ZERO, age: Duration::ZERO };
    let renew = body(&SessionBody::renewal(&renewal));
    let started = request(go_to, &position);
    let release = body(&SessionBody::release(&Release { call: 1, class: Priority::Normal }));
    let renewed_after = vec![started.clone(), release.clone(), renew.clone()];
    let released = vec![started.clone(), release.clone()];
    let all = vec![started.clone(), body(&SessionBody::release_all(Slot(1), 9))];
    let overtaken = vec![release, request(RequestHeader { wants_reply: true, ..go_to }, &position)];
    let expired = || reported(json!({ "lease_ended": { "call": 1, "why": "expired" } }));
    let heard = || json!({ "session": { "renewed": { "call": 1 } } });
    let failure = json!([{ "priority": "normal", "message": { "failure": { "id": 1, "error": "expired" } } }]);
    let lease_released = answer(("lease_released", "it ends without an answer", "live", released, 600, json!([])));
    let mut leases = answers([
        ("lease_expires", "500 ms after the request was made", "live", started.clone(), 500, json!([expired()])),
        ("lease_lives", "1 ms less", "live", started, 499, json!([])),
        ("renewal_too_early", "the call has not arrived", "live", renew, 0, json!([heard()])),
        ("lease_over", "made 500 ms ago, though its deadline is later", "live", request(old, &position), 0, failure),
    ]);
    leases.push(lease_released);
    for (name, about, given, after, expected) in [
        ("leases_released", "all of a function", all, 600, json!([])),
        ("release_overtakes", "the call is dropped when it arrives", overtaken, 0, json!([])),
        ("renewal_of_nothing", "the call has ended", renewed_after, 0, json!([expired(), heard()])),
    ] {
        leases.push(answer((name, about, "live", given, after, expected)));
    }
    leases
}

fn silence() -> Vec<Answer> {
    answers([
        (
            "silence",
            "datagrams have come before: 3.5 pauses of 1 s, and a question with each keep-alive that is missed",
            "live",
            Vec::new(),
            3_500,
            json!(["ping", "ping", { "close": 3 }]),
        ),
        ("not_yet_silence", "1 ms less", "live", Vec::new(), 3_499, json!(["ping", "ping"])),
    ])
}
