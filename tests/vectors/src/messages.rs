//! Vectors of messages and session bodies.

use cara_core::config::Priority;
use cara_core::distribution::function::Attributes;
use cara_core::distribution::function_list::{Generation, Slot};
use cara_core::distribution::message::{
    Control, LeaseEnd, Release, Renewal, RequestHeader, SessionBody, encode_failure, encode_reply,
};
use cara_core::error::{Error, ServiceError};
use cara_core::time::Duration;
use serde_json::{Value, json};

use crate::decoded::hex;
use crate::values::{GO_TO, arguments, motion};
use crate::vector::{Context, Kind, Vector, definition};

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
        remaining: Duration::from_millis(2_000),
        stamp: 0x0001_0203_0405_0607,
        since: Duration::from_micros(250_000),
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
            "id": 0x0102_0304, "slot": 5, "generation": 0x0203, "wants_reply": wants_reply, "remaining": 2_000_000,
            "stamp": 0x0001_0203_0405_0607_u64, "since": 250_000, "block": hex(block),
        }})
    };
    let results: Vec<u8> = (1..=16).collect();
    let reply = [&encode_reply(0x0102_0304, Ok(()))[..], &results].concat();
    vec![
        message(("request", "a blocking request with arguments"), &request(true, &block), &fields(true, &block)),
        message(("request_one_way", "an asynchronous request without any"), &request(false, &[]), &fields(false, &[])),
        message(
            ("reply", "results"),
            &reply,
            &json!({ "reply": { "id": 0x0102_0304, "block": "0102030405060708090a0b0c0d0e0f10" } }),
        ),
        message(("message_of_no_kind", "refused: there is no kind 5"), &[5; 16], &Value::Null),
        message(("request_cut", "refused: a header of 31 bytes"), &request(true, &[])[..31], &Value::Null),
        message(
            ("failure_without_error", "refused: a failure needs an error"),
            &[4, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
            &Value::Null,
        ),
        message(
            ("error_with_block", "refused: nothing follows an error"),
            &[&encode_reply(1, Err(Error::Busy))[..], &[0; 8]].concat(),
            &Value::Null,
        ),
    ]
}

fn errors() -> Vec<Vector> {
    let wait = Duration::from_millis(30);
    let service = |error: ServiceError| Error::Service(error);
    let answers: [(&'static str, Error, Value); 20] = [
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
                &[2, 99, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
                &later,
            )
            .lossy(),
        ])
        .collect()
}

fn controls() -> Vec<Vector> {
    let stop = definition("stop()");
    let attributes = Attributes { priority: Priority::Emergency, idempotent: true, ..Attributes::default() }.encode();
    let publish = Control::Publish { slot: 300, generation: 2, attributes, signature: stop.as_bytes() };
    let all: [(&'static str, &'static str, Control<'_>, Value); 7] = [
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
    ];
    let encoded = |(name, about, control, value): (_, _, Control<'_>, _)| {
        let mut bytes = [0; 128];
        message((name, about), control.encode(&mut bytes).unwrap_or(&[]), &value)
    };
    let mut vectors: Vec<Vector> = all.into_iter().map(encoded).collect();
    vectors.push(
        message(
            ("long_varint", "a number in more bytes than needed is read all the same"),
            &[3, 5, 0x84, 0x00, 0],
            &json!({ "lease_ended": { "call": 4, "why": "finished" } }),
        )
        .lossy(),
    );
    vectors.push(message(("varint_too_big", "refused: beyond 16 bits"), &[3, 1, 0x84, 0x80, 0x04], &Value::Null));
    vectors.push(message(("control_behind", "refused: a byte follows"), &[3, 5, 4, 1, 0], &Value::Null));
    vectors.push(message(("lease_end_unknown", "refused: no such reason"), &[3, 5, 4, 3], &Value::Null));
    vectors
}

fn session_bodies() -> Vec<Vector> {
    let renewal = Renewal {
        call: 0x0102_0304,
        class: Priority::Normal,
        stamp: 0x0001_0203_0405_0607,
        since: Duration::from_micros(80_000),
    };
    let release = Release { call: 0x0102_0304, class: Priority::Low };
    let emergency = [&SessionBody::message_prefix(0)[..], &request(false, &[])].concat();
    let body =
        |names, bytes: &[u8], value: &Value| Vector::new(names, Kind::SessionBody, Context::default(), bytes, value);
    vec![
        body(
            ("keep_alive", "the sender's clock"),
            &SessionBody::keep_alive(0x0001_0203_0405_0607),
            &json!({ "keep_alive": { "stamp": 0x0001_0203_0405_0607_u64 } }),
        ),
        body(("ping", "to be answered at once, in a datagram"), &SessionBody::PING, &json!({ "ping": {} })),
        body(("pong", "the answer"), &SessionBody::PONG, &json!({ "pong": {} })),
        body(
            ("renew", "the caller still wants what a leased call started"),
            &SessionBody::renewal(&renewal),
            &json!({ "renew": {
                "class": "normal", "call": 0x0102_0304, "stamp": 0x0001_0203_0405_0607_u64, "since": 80_000,
            }}),
        ),
        body(
            ("release", "the caller no longer wants a leased call"),
            &SessionBody::release(&release),
            &json!({ "release": { "class": "low", "call": 0x0102_0304 } }),
        ),
        body(
            ("release_all", "nor any call of a function up to this one"),
            &SessionBody::release_all(Slot(5), 0x0102_0304),
            &json!({ "release_all": { "slot": 5, "call": 0x0102_0304 } }),
        ),
        body(("release_class", "refused: no such class"), &[6, 4, 1, 0, 0, 0], &Value::Null),
        body(
            ("session_message", "an emergency's second copy"),
            &emergency,
            &json!({ "message": { "priority": "emergency", "message": { "request": {
                "id": 0x0102_0304, "slot": 5, "generation": 0x0203, "wants_reply": false, "remaining": 2_000_000,
                "stamp": 0x0001_0203_0405_0607_u64, "since": 250_000, "block": "",
            }}}}),
        ),
    ]
}
