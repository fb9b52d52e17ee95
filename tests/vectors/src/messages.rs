//! Vectors of messages and session bodies.

use cara_core::config::Priority;
use cara_core::distribution::claim::Claim;
use cara_core::distribution::function::Attributes;
use cara_core::distribution::function_list::{Generation, Slot};
use cara_core::distribution::message::{
    Control, HandOverRefusal, LastOrder, Latch, LeaseEnd, Release, Renewal, RequestHeader, SampleHeader, SessionBody,
    SubscriptionRefusal, encode_failure, encode_progress, encode_reply,
};
use cara_core::error::{Error, ServiceError};
use cara_core::host::connections::Report;
use cara_core::time::Duration;
use serde_json::{Value, json};

use crate::decoded::hex;
use crate::introductions::item;
use crate::introductions::{report, reported};
use crate::values::{GO_TO, arguments, motion};
use crate::vector::{Context, Kind, Vector, definition};

const CLAIM: Claim = Claim { term: 5, claimant: 0x0123_4567_89AB_CDEF };

/// Every vector of this file.
pub(crate) fn all() -> Vec<Vector> {
    [messages(), errors(), controls(), session_bodies()].concat()
}

fn request(wants_reply: bool, block: &[u8]) -> Vec<u8> {
    let header = RequestHeader {
        id: 0x0102_0304,
        slot: Slot(5),
        generation: Generation(0x0203),
        wants_reply,
        wants_progress: false,
        takes_over: false,
        operator: false,
        unknown: 0,
        remaining: Duration::from_millis(2_000),
        stamp: 0x0001_0203_0405_0607,
        since: Duration::from_micros(250_000),
        number: 0x0506_0708,
    };
    [&header.encode()[..], block].concat()
}

fn message(names: (&'static str, &'static str), bytes: &[u8], value: &Value) -> Vector {
    Vector::new(names, Kind::Message, Context::default(), bytes, value)
}

fn messages() -> Vec<Vector> {
    let block = arguments(GO_TO, &motion().unwrap_or_default());
    let fields = |wants_reply: bool, block: &[u8]| {
        json!({ "request": {
            "id": 0x0102_0304, "slot": 5, "generation": 0x0203, "wants_reply": wants_reply, "wants_progress": false, "takes_over": false, "operator": false,
            "unknown": 0,
            "remaining": 2_000_000, "stamp": 0x0001_0203_0405_0607_u64, "since": 250_000, "number": 0x0506_0708,
            "block": hex(block),
        }})
    };
    let flags = |flags: u8| {
        let mut bytes = request(true, &[]);
        bytes[1] |= flags;
        bytes
    };
    let mut critical = fields(true, &[]);
    critical["request"]["unknown"] = json!(0xA0);
    let mut taking_over = fields(true, &[]);
    taking_over["request"]["takes_over"] = json!(true);
    let mut watching = fields(true, &[]);
    watching["request"]["wants_progress"] = json!(true);
    let mut operators = fields(true, &[]);
    operators["request"]["operator"] = json!(true);
    let mut longer = request(true, &[0xEE; 4]);
    longer[6] += 1;
    longer.extend(&block);
    let mut shorter = request(true, &[]);
    shorter[6] -= 1;
    let results: Vec<u8> = (1..=16).collect();
    let mut longer_reply = [&encode_reply(0x0102_0304, Ok(()))[..], &[0xEE; 4], &results].concat();
    longer_reply[3] += 1;
    let reply = [&encode_reply(0x0102_0304, Ok(()))[..], &results].concat();
    let replied = json!({ "reply": { "id": 0x0102_0304, "block": "0102030405060708090a0b0c0d0e0f10" } });
    let header = SampleHeader { slot: Slot(3), generation: Generation(2), made: -1_500 }.encode();
    let sample = [&header[..], &results].concat();
    let mut longer_sample = [&header[..], &[0xEE; 4], &results].concat();
    longer_sample[6] += 1;
    let mut shorter_sample = sample.clone();
    shorter_sample[6] -= 1;
    let sampled = json!({ "sample": {
        "slot": 3, "generation": 2, "made": -1_500, "block": "0102030405060708090a0b0c0d0e0f10",
    }});
    let failed = Error::Service(ServiceError::Failed(7));
    let details = [&[7, 0, 0, 0, 0, 0, 0, 0][..], b"blocked\0", &results].concat();
    let reported = json!({
        "id": 0x0102_0304, "error": { "service_failed": { "code": 7 } },
        "details": { "text": "blocked", "values": "0102030405060708090a0b0c0d0e0f10" },
    });
    vec![
        message(("request", "a blocking request with arguments"), &request(true, &block), &fields(true, &block)),
        message(("request_one_way", "an asynchronous request without any"), &request(false, &[]), &fields(false, &[])),
        message(
            ("request_longer_header", "a later version has more in front of the block"),
            &longer,
            &fields(true, &block),
        )
        .lossy(),
        message(("request_shorter_header", "refused: 7 words"), &shorter, &Value::Null),
        message(("request_flags", "flags that may be passed over"), &flags(0x08), &fields(true, &[])).lossy(),
        message(("request_wants_progress", "the caller wants to be told progress"), &flags(0x02), &watching),
        message(("request_critical_flags", "flags that must be understood"), &flags(0xA0), &critical),
        message(("request_takes_over", "it takes over what another caller moves"), &flags(0x10), &taking_over),
        message(("request_of_operator", "an operator made it, and not the program"), &flags(0x04), &operators),
        message(("reply", "results"), &reply, &replied),
        message(("reply_longer_header", "a later version has more in front of the block"), &longer_reply, &replied)
            .lossy(),
        message(("sample", "a value of a stream"), &sample, &sampled),
        message(("sample_longer_header", "a later version has more in front of the block"), &longer_sample, &sampled)
            .lossy(),
        message(("sample_shorter_header", "refused: 3 words"), &shorter_sample, &Value::Null),
        message(
            ("progress", "what a running call tells"),
            &[&encode_progress(0x0102_0304)[..], &results].concat(),
            &json!({ "progress": { "id": 0x0102_0304, "block": "0102030405060708090a0b0c0d0e0f10" } }),
        ),
        message(("progress_shorter_header", "refused: 1 word"), &[5, 0, 0, 1, 7, 0, 0, 0], &Value::Null),
        message(
            ("reply_with_details", "why a service failed, in words and values"),
            &[&encode_reply(0x0102_0304, Err(failed))[..], &details].concat(),
            &json!({ "reply": reported }),
        ),
        message(
            ("failure_with_details", "the same of a request that nothing waits for"),
            &[&encode_failure(0x0102_0304, failed)[..], &details].concat(),
            &json!({ "failure": reported }),
        ),
        message(
            ("reply_with_cut_details", "what cannot be read leaves the code"),
            &[&encode_reply(0x0102_0304, Err(failed))[..], &[9, 0, 0, 0, 0, 0, 0, 0, b'x']].concat(),
            &json!({ "reply": { "id": 0x0102_0304, "error": { "service_failed": { "code": 7 } } } }),
        )
        .lossy(),
        message(("message_of_no_kind", "refused: there is no kind 7"), &[7; 16], &Value::Null),
        message(("request_cut", "refused: a header of 31 bytes"), &request(true, &[])[..31], &Value::Null),
        message(
            ("failure_without_error", "refused: a failure needs an error"),
            &[4, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
            &Value::Null,
        ),
        message(
            ("error_with_more", "what follows an error is passed over"),
            &[&encode_reply(1, Err(Error::Busy))[..], &[0; 8]].concat(),
            &json!({ "reply": { "id": 1, "error": "busy" } }),
        )
        .lossy(),
    ]
}

fn errors() -> Vec<Vector> {
    let wait = Duration::from_millis(30);
    let service = |error: ServiceError| Error::Service(error);
    let answers: [(&'static str, Error, Value); 25] = [
        ("error_unknown_function", Error::UnknownFunction, json!("unknown_function")),
        ("error_stale_function", Error::StaleFunction, json!("stale_function")),
        ("error_missing_argument", Error::MissingArgument { index: 3 }, json!({ "missing_argument": { "index": 3 } })),
        ("error_wrong_type", Error::WrongType { index: 3 }, json!({ "wrong_type": { "index": 3 } })),
        (
            "error_wrong_size",
            Error::WrongSize { index: 1, expected: 2, found: 3 },
            json!({ "wrong_size": { "index": 1, "expected": 2, "found": 3 } }),
        ),
        ("error_expired", Error::Expired, json!("expired")),
        ("error_stale", Error::Stale, json!("stale")),
        ("error_busy", Error::Busy, json!("busy")),
        ("error_malformed", Error::Malformed, json!("malformed")),
        ("error_not_allowed", Error::NotAllowed, json!("not_allowed")),
        ("error_would_deadlock", Error::WouldDeadlock, json!("would_deadlock")),
        ("error_too_large", Error::TooLarge { limit: 1024 }, json!({ "too_large": { "limit": 1024 } })),
        ("error_too_soon", Error::TooSoon { wait }, json!({ "too_soon": { "wait": 30_000 } })),
        (
            "error_result_would_not_fit",
            Error::ResultWouldNotFit { need: 40, have: 16 },
            json!({ "result_would_not_fit": { "need": 40, "have": 16 } }),
        ),
        ("error_result_lost", Error::ResultLost, json!("result_lost")),
        ("error_unsupported", Error::Unsupported, json!("unsupported")),
        ("error_held", Error::Held { by: 7, operator: false }, json!({ "held": { "by": 7, "operator": false } })),
        (
            "error_held_by_operator",
            Error::Held { by: 7, operator: true },
            json!({ "held": { "by": 7, "operator": true } }),
        ),
        ("error_inhibited", Error::Inhibited { by: 0, reason: 9 }, json!({ "inhibited": { "by": 0, "reason": 9 } })),
        ("error_replaced", Error::Replaced, json!("replaced")),
        ("error_service_failed", service(ServiceError::Failed(513)), json!({ "service_failed": { "code": 513 } })),
        ("error_service_panicked", service(ServiceError::Panicked), json!("service_panicked")),
        ("error_service_not_ready", service(ServiceError::NotReady), json!("service_not_ready")),
        ("error_service_bad_results", service(ServiceError::BadResults), json!("service_bad_results")),
        ("error_without_code", Error::NotConnected, json!("malformed")),
    ];
    let replies = answers.into_iter().map(|(name, error, value)| {
        let value = json!({ "reply": { "id": 9, "error": value } });
        message((name, "a reply with this error"), &encode_reply(9, Err(error)), &value)
    });
    let failure = json!({ "failure": { "id": 9, "error": "expired" } });
    let later = json!({ "reply": { "id": 1, "error": "malformed" } });
    replies
        .chain([
            message(
                ("failure", "an asynchronous request that came too late"),
                &encode_failure(9, Error::Expired),
                &failure,
            ),
            message(
                ("error_of_a_later_version", "an unknown code reads as malformed"),
                &[2, 99, 0, 4, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
                &later,
            )
            .lossy(),
        ])
        .collect()
}

fn controls() -> Vec<Vector> {
    let stop = definition("stop()");
    let attributes = Attributes { priority: Priority::Emergency, idempotent: true, ..Attributes::default() }.encode();
    let publish = Control::Publish { slot: 300, generation: 2, attributes: &attributes, signature: stop.as_bytes() };
    let all: [(&'static str, &'static str, Control<'_>, Value); 18] = [
        (
            "publish",
            "a function may be called",
            publish,
            json!({ "publish": {
                "slot": 300, "generation": 2, "attributes": hex(&attributes), "signature": hex(stop.as_bytes()),
            }}),
        ),
        ("withdraw", "it may no longer", Control::Withdraw { slot: 300 }, json!({ "withdraw": { "slot": 300 } })),
        (
            "list_end",
            "the news up to here are to be acknowledged",
            Control::ListEnd { serial: 70_000 },
            json!({ "list_end": { "serial": 70_000 } }),
        ),
        (
            "list_ack",
            "they were read, two functions were not kept",
            Control::ListAck { serial: 70_000, skipped: 2 },
            json!({ "list_ack": { "serial": 70_000, "skipped": 2 } }),
        ),
        (
            "limits",
            "the sender's limits changed",
            Control::Limits { message_size: 65_536, minimum_interval: 10_000, calls: 4 },
            json!({ "limits": { "message_size": 65_536, "minimum_interval": 10_000, "calls": 4 } }),
        ),
        (
            "claimed",
            "the manager has raised its claim",
            Control::Claimed { report: report(u32::MAX) },
            json!({ "claimed": reported(u32::MAX) }),
        ),
        (
            "hand_over",
            "the manager sends its vehicle to another one",
            Control::HandOver { name: b"yard", id: 70_000 },
            json!({ "hand_over": { "name": "79617264", "id": 70_000 } }),
        ),
        (
            "handed_over",
            "something moves: the vehicle stays",
            Control::HandedOver { refusal: Some(HandOverRefusal::Moves) },
            json!({ "handed_over": { "refusal": 1 } }),
        ),
        (
            "lease_ended",
            "a lease has expired at the callee",
            Control::LeaseEnded { call: 70_000, why: LeaseEnd::Expired },
            json!({ "lease_ended": { "call": 70_000, "why": "expired" } }),
        ),
        (
            "lease_replaced",
            "a newer call of the same function goes on",
            Control::LeaseEnded { call: 4, why: LeaseEnd::Replaced },
            json!({ "lease_ended": { "call": 4, "why": "replaced" } }),
        ),
        (
            "subscribe",
            "values of a stream, at least 100 ms apart",
            Control::Subscribe { slot: 300, generation: 2, interval: 100 },
            json!({ "subscribe": { "slot": 300, "generation": 2, "interval": 100 } }),
        ),
        (
            "subscribe_no_more",
            "no more values of a stream",
            Control::Subscribe { slot: 3, generation: 2, interval: u32::MAX },
            json!({ "subscribe": { "slot": 3, "generation": 2, "interval": u32::MAX } }),
        ),
        (
            "subscribed",
            "a subscription is granted",
            Control::Subscribed {
                slot: 3,
                generation: 2,
                interval: 200,
                bytes: 100_000,
                refusal: SubscriptionRefusal::None,
            },
            json!({ "subscribed": {
                "slot": 3, "generation": 2, "interval": 200, "bytes": 100_000, "refusal": "none",
            } }),
        ),
        (
            "subscribed_refused",
            "the reader has as many subscriptions as it may",
            Control::Subscribed {
                slot: 3,
                generation: 2,
                interval: u32::MAX,
                bytes: 100_000,
                refusal: SubscriptionRefusal::Full,
            },
            json!({ "subscribed": {
                "slot": 3, "generation": 2, "interval": u32::MAX, "bytes": 100_000, "refusal": "full",
            } }),
        ),
        (
            "actuator_free",
            "nothing has moved since the sender's start, and nothing is stopped",
            Control::Actuator { slot: 3, latch: None, last: None },
            json!({ "actuator": { "slot": 3, "latch": null, "last": null } }),
        ),
        (
            "actuator_runs",
            "an order of the reader has it",
            Control::Actuator {
                slot: 3,
                latch: None,
                last: Some(LastOrder { holder: 1, link: 0xC0FF_EE00, call: 700, claim: CLAIM, end: None }),
            },
            json!({ "actuator": {
                "slot": 3, "latch": null,
                "last": { "holder": 1, "link": 0xC0FF_EE00_u32, "call": 700, "claim": [5, 0x0123_4567_89AB_CDEF_u64], "end": null },
            } }),
        ),
        (
            "actuator_stopped",
            "a unit has stopped it, and with it the order of a third one",
            Control::Actuator {
                slot: 300,
                latch: Some(Latch { by: 70_000, reason: 12 }),
                last: Some(LastOrder { holder: 2, link: 0, call: 0, claim: Claim::NONE, end: Some(LeaseEnd::Stopped) }),
            },
            json!({ "actuator": {
                "slot": 300, "latch": { "by": 70_000, "reason": 12 },
                "last": { "holder": 2, "link": 0, "call": 0, "claim": [0, 0], "end": "stopped" },
            } }),
        ),
        (
            "actuator_released",
            "its caller gave the order up",
            Control::Actuator {
                slot: 3,
                latch: None,
                last: Some(LastOrder {
                    holder: 1,
                    link: 0xC0FF_EE00,
                    call: 700,
                    claim: CLAIM,
                    end: Some(LeaseEnd::Released),
                }),
            },
            json!({ "actuator": {
                "slot": 3, "latch": null,
                "last": { "holder": 1, "link": 0xC0FF_EE00_u32, "call": 700, "claim": [5, 0x0123_4567_89AB_CDEF_u64], "end": "released" },
            } }),
        ),
    ];
    let encoded = |(name, about, control, value): (_, _, Control<'_>, _)| {
        let mut bytes = [0; 128];
        message((name, about), control.encode(&mut bytes).unwrap_or(&[]), &json!({ "control": [value] }))
    };
    let mut vectors: Vec<Vector> = all.into_iter().map(encoded).collect();
    let control =
        |names, items: &[Vec<u8>], value: &Value| message(names, &[&[3, 0, 0, 0][..], &items.concat()].concat(), value);
    let withdrawn = json!({ "withdraw": { "slot": 300 } });
    let later = json!({ "unknown": { "kind": 0x7000, "body": "6c61746572" } });
    let ended = json!({ "control": [{ "lease_ended": { "call": 4, "why": "expired" } }] });
    vectors.extend([
        control(
            ("control_items", "two items that are known, and one between them that is not"),
            &[item(2, &[0xAC, 2]), item(0x7000, b"later"), item(3, &[9])],
            &json!({ "control": [withdrawn, later, { "list_end": { "serial": 9 } }] }),
        ),
        control(("control_nothing", "no item at all"), &[], &json!({ "control": [] })),
        control(
            ("control_padding", "padding means nothing"),
            &[item(0, &[9; 3]), item(2, &[0xAC, 2])],
            &json!({ "control": [withdrawn] }),
        )
        .lossy(),
        control(
            ("control_must_understand", "refused: an unknown item that must be understood"),
            &[item(0xF000, b"later")],
            &Value::Null,
        ),
        control(("control_cut", "refused: an item without its padding"), &[vec![2, 0, 1, 0, 7]], &Value::Null),
        control(("control_longer", "what follows the fields is passed over"), &[item(6, &[4, 1, 9])], &ended).lossy(),
        control(("control_shorter", "refused: a field is missing"), &[item(6, &[4])], &Value::Null),
        control(
            ("long_varint", "a number in more bytes than needed is read all the same"),
            &[item(6, &[0x84, 0x00, 1])],
            &ended,
        )
        .lossy(),
        control(("varint_too_big", "refused: beyond 16 bits"), &[item(2, &[0x84, 0x80, 0x04])], &Value::Null),
        control(("lease_end_unknown", "a reason of a later version counts as expired"), &[item(6, &[4, 99])], &ended)
            .lossy(),
    ]);
    vectors
}

fn session_bodies() -> Vec<Vector> {
    let renewal = Renewal {
        call: 0x0102_0304,
        class: Priority::Normal,
        stamp: 0x0001_0203_0405_0607,
        since: Duration::from_micros(80_000),
        age: Duration::from_micros(100_000),
    };
    let release = Release { call: 0x0102_0304, class: Priority::Low };
    let report = Report { received: 0x0A0B_0C0D, hears: true, holds: false, misses: false };
    let emergency = [&SessionBody::message_prefix(0)[..], &request(false, &[])].concat();
    let body =
        |names, bytes: &[u8], value: &Value| Vector::new(names, Kind::SessionBody, Context::default(), bytes, value);
    vec![
        body(
            (
                "keep_alive",
                "the sender's clock, and what comes of the receiver: bytes of the stream, and its datagrams",
            ),
            &SessionBody::keep_alive(0x0001_0203_0405_0607, report),
            &json!({ "keep_alive": {
                "stamp": 0x0001_0203_0405_0607_u64, "received": 0x0A0B_0C0D, "hears": true, "holds": false, "misses": false,
            }}),
        ),
        body(("ping", "to be answered at once, in a datagram"), &SessionBody::PING, &json!({ "ping": {} })),
        body(
            ("pong", "the answer, of a unit that does not read more of the stream for now, and misses a keep-alive"),
            &SessionBody::pong(Report { hears: false, holds: true, misses: true, ..report }),
            &json!({ "pong": { "received": 0x0A0B_0C0D, "hears": false, "holds": true, "misses": true } }),
        ),
        body(("close", "the stream is dead"), &SessionBody::close(13), &json!({ "close": { "code": 13 } })),
        body(
            ("renew", "the caller still wants what a leased call started"),
            &SessionBody::renewal(&renewal),
            &json!({ "renew": {
                "class": "normal", "call": 0x0102_0304, "stamp": 0x0001_0203_0405_0607_u64, "since": 80_000,
                "age": 100_000,
            }}),
        ),
        body(
            ("renewed", "the answer, on the way that the renewal came"),
            &SessionBody::renewed(0x0102_0304),
            &json!({ "renewed": { "call": 0x0102_0304 } }),
        ),
        body(
            ("release", "the caller no longer wants a leased call"),
            &SessionBody::release(&release),
            &json!({ "release": { "class": "low", "call": 0x0102_0304 } }),
        ),
        body(
            ("cancel", "the caller waits for a call no longer"),
            &SessionBody::cancel(&release),
            &json!({ "cancel": { "class": "low", "call": 0x0102_0304 } }),
        ),
        body(
            ("release_all", "nor any call of a function up to this one"),
            &SessionBody::release_all(Slot(5), 0x0102_0304),
            &json!({ "release_all": { "slot": 5, "call": 0x0102_0304 } }),
        ),
        body(("release_class", "refused: no such class"), &[6, 4, 1, 0, 0, 0], &Value::Null),
        body(
            ("release_longer", "what follows the fields is passed over"),
            &[&SessionBody::release(&release)[..], &[9, 9]].concat(),
            &json!({ "release": { "class": "low", "call": 0x0102_0304 } }),
        )
        .lossy(),
        body(("session_body_unknown", "refused: there is no kind 11"), &[11, 9], &Value::Null),
        body(
            ("session_message", "an emergency's second copy"),
            &emergency,
            &json!({ "message": { "priority": "emergency", "message": { "request": {
                "id": 0x0102_0304, "slot": 5, "generation": 0x0203, "wants_reply": false, "wants_progress": false, "takes_over": false, "operator": false,
                "unknown": 0, "remaining": 2_000_000, "stamp": 0x0001_0203_0405_0607_u64, "since": 250_000, "number": 0x0506_0708,
                "block": "",
            }}}}),
        ),
    ]
}
