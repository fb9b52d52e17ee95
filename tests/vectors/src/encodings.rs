//! Vectors of each encoding by itself. The values are written twice on purpose: once for the encoder, once as what a
//! reader must find.

use cara_core::config::Priority;
use cara_core::distribution::block::{self, SliceWriter};
use cara_core::distribution::datagram::{Announce, WhoHas, session_header, short_hash};
use cara_core::distribution::function::Attributes;
use cara_core::distribution::function_list::{Generation, Slot};
use cara_core::distribution::hello::{Hello, Limits, Manager};
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::distribution::message::{Control, Renewal, RequestHeader, SessionBody, encode_failure, encode_reply};
use cara_core::distribution::parameters::{Parameters, ParametersView};
use cara_core::error::{Error, ServiceError};
use cara_core::time::Duration;
use serde_json::{Value, json};

use crate::decoded::hex;
use crate::vector::{Context, Kind, Vector, definition};

/// Every vector of this file.
pub(crate) fn all() -> Vec<Vector> {
    [signatures(), attributes(), blocks(), hellos(), messages(), errors(), controls(), session_bodies(), datagrams()]
        .concat()
}

const GO_TO: &str = "go_to(position: int[2], speed: float) -> (position: int[2], arrived: bool)";
const REPORT: &str = "report(text: string[40], data: bytes[5], flags: bool[3], level: float[2])";
const HI: &str = "hi(name: string[8])";

fn signatures() -> Vec<Vector> {
    let plain = definition("stop()");
    let both = definition(GO_TO);
    let every = definition(REPORT);
    vec![
        Vector::new(
            ("signature_stop", "a function without arguments and results"),
            Kind::Signature,
            Context::default(),
            plain.as_bytes(),
            &json!({ "name": "stop", "arguments": [], "results": [], "text": "stop()" }),
        ),
        Vector::new(
            ("signature_go_to", "arguments and results, one variable in both"),
            Kind::Signature,
            Context::default(),
            both.as_bytes(),
            &json!({
                "name": "go_to",
                "arguments": [
                    { "name": "position", "type": "int", "size": 2 }, { "name": "speed", "type": "float", "size": 1 },
                ],
                "results": [
                    { "name": "position", "type": "int", "size": 2 }, { "name": "arrived", "type": "bool", "size": 1 },
                ],
                "text": GO_TO,
            }),
        ),
        Vector::new(
            ("signature_report", "the other types"),
            Kind::Signature,
            Context::default(),
            every.as_bytes(),
            &json!({
                "name": "report",
                "arguments": [
                    { "name": "text", "type": "string", "size": 40 }, { "name": "data", "type": "bytes", "size": 5 },
                    { "name": "flags", "type": "bool", "size": 3 }, { "name": "level", "type": "float", "size": 2 },
                ],
                "results": [],
                "text": REPORT,
            }),
        ),
        Vector::new(
            ("signature_name_taken", "refused: two arguments of one name"),
            Kind::Signature,
            Context::default(),
            &[1, b'f', 2, 0, 1, 1, 0, 0, 0, b'a', 0, 1, 1, 0, 0, 0, b'a', 0],
            &Value::Null,
        ),
        Vector::new(
            ("signature_other_result", "refused: a result has the name of an argument and another size"),
            Kind::Signature,
            Context::default(),
            &[1, b'f', 1, 0, 1, 1, 0, 0, 0, b'a', 1, 0, 1, 2, 0, 0, 0, b'a'],
            &Value::Null,
        ),
    ]
}

fn attributes() -> Vec<Vector> {
    let leased = Attributes { priority: Priority::High, lease: Some(Duration::from_millis(500)), idempotent: true };
    vec![
        Vector::new(
            ("attributes_default", "normal priority, no lease"),
            Kind::Attributes,
            Context::default(),
            &Attributes::default().encode(),
            &json!({ "priority": "normal", "idempotent": false, "lease": null }),
        ),
        Vector::new(
            ("attributes_leased", "high priority, idempotent, a lease of half a second"),
            Kind::Attributes,
            Context::default(),
            &leased.encode(),
            &json!({ "priority": "high", "idempotent": true, "lease": 500 }),
        ),
    ]
}

/// The block of `parameters` as arguments of a function.
pub(crate) fn arguments(text: &str, parameters: &ParametersView) -> Vec<u8> {
    let definition = definition(text);
    let specs = definition.signature().arguments();
    let length = block::measure(specs, parameters).unwrap_or_else(|error| panic!("{text}: {error}"));
    let mut bytes = vec![0; length];
    block::write(specs, parameters, &mut SliceWriter::new(&mut bytes));
    bytes
}

fn motion() -> Result<Parameters, Error> {
    let mut parameters = Parameters::new();
    parameters.add_float("speed", 1)?;
    parameters.set_value("speed", 1.5)?;
    parameters.add_int("position", 2)?;
    parameters.set_value("position", [1, -2])?;
    Ok(parameters)
}

fn report() -> Result<Parameters, Error> {
    let mut parameters = Parameters::new();
    parameters.add_string("text", 40)?;
    parameters.set_value("text", "größer")?;
    parameters.add_bytes("data", 5)?;
    parameters.set_value("data", &[1_u8, 2, 3, 4, 5][..])?;
    parameters.add_bool("flags", 3)?;
    parameters.set_value("flags", [true, false, true])?;
    parameters.add_float("level", 2)?;
    parameters.set_value("level", [0.25, f64::NEG_INFINITY])?;
    Ok(parameters)
}

fn blocks() -> Vec<Vector> {
    let motion = motion().unwrap_or_default();
    let report = report().unwrap_or_default();
    let refused = |names, text, bytes: &[u8]| {
        Vector::new(names, Kind::Block, Context::block(text, "arguments"), bytes, &Value::Null)
    };
    let hi = |length: u8, text: &[u8; 8]| [&[length, 0, 0, 0, 0, 0, 0, 0], &text[..]].concat();
    vec![
        Vector::new(
            ("block_go_to", "two integers and a float, in the signature's order"),
            Kind::Block,
            Context::block(GO_TO, "arguments"),
            &arguments(GO_TO, &motion),
            &json!({ "position": [1, -2], "speed": ["3ff8000000000000"] }),
        ),
        Vector::new(
            ("block_go_to_results", "two integers and a truth value"),
            Kind::Block,
            Context::block(GO_TO, "results"),
            &[3, 0, 0, 0, 0, 0, 0, 0, 4, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0],
            &json!({ "position": [3, 4], "arrived": [true] }),
        ),
        Vector::new(
            ("block_report", "text and bytes with their lengths, truth values, two floats"),
            Kind::Block,
            Context::block(REPORT, "arguments"),
            &arguments(REPORT, &report),
            &json!({
                "text": "größer", "data": "0102030405", "flags": [true, false, true],
                "level": ["3fd0000000000000", "fff0000000000000"],
            }),
        ),
        Vector::new(
            ("block_empty_text", "a text of no bytes has no padding"),
            Kind::Block,
            Context::block(HI, "arguments"),
            &[0; 8],
            &json!({ "name": "" }),
        ),
        Vector::new(
            ("block_nothing", "no variables, no bytes"),
            Kind::Block,
            Context::block("stop()", "arguments"),
            &[],
            &json!({}),
        ),
        refused(("block_bad_text", "refused: the text is no UTF-8"), HI, &hi(2, b"\xC3\x28\0\0\0\0\0\0")),
        refused(("block_padding", "refused: the padding is not zero"), HI, &hi(2, b"ab\0\0\0\0\0\x01")),
        refused(("block_long_text", "refused: longer than declared"), HI, &hi(9, b"abcdefgh")),
        refused(("block_cut", "refused: a byte is missing"), HI, &hi(2, b"ab\0\0\0\0\0\0")[..15]),
        refused(("block_behind", "refused: bytes follow"), "stop()", &[0; 8]),
    ]
}

pub(crate) fn agv_hello() -> Hello {
    Hello {
        fleet: Fleet(7),
        identity: identity("agv-07", 7, Role::SUnit),
        wanted: Some(manager("manager", 1)),
        epoch: Epoch(0x0102_0304_0506_0708),
        nonce: 0x1122_3344_5566_7788,
        term: 0,
        capabilities: 0,
        limits: Limits { message_size: 1024, chunk_size: 1024, calls: 8, minimum_interval: 0 },
        link: 0,
        udp_port: 21_970,
        stamp: 1_000_000,
        keep_alive: 1_000,
    }
}

pub(crate) fn manager_hello() -> Hello {
    Hello {
        fleet: Fleet(7),
        identity: identity("manager", 1, Role::MUnit),
        wanted: None,
        epoch: Epoch(9),
        nonce: 0xA1A2_A3A4_A5A6_A7A8,
        term: 0,
        capabilities: 0,
        limits: Limits { message_size: 32_768, chunk_size: 4096, calls: 64, minimum_interval: 0 },
        link: 300,
        udp_port: 40_001,
        stamp: 5_000_000,
        keep_alive: 1_000,
    }
}

fn identity(name: &str, id: u32, role: Role) -> Identity {
    Identity::new(name, id, role).unwrap_or_else(|error| panic!("{name}: {error}"))
}

fn manager(name: &str, id: u32) -> Manager {
    Manager { name: name.try_into().unwrap_or_default(), id }
}

pub(crate) fn encoded_hello(hello: &Hello) -> Vec<u8> {
    let mut bytes = vec![0; 320];
    let length = hello.encode(&mut bytes).unwrap_or(0);
    bytes.truncate(length);
    bytes
}

fn hellos() -> Vec<Vector> {
    let mut other = encoded_hello(&agv_hello());
    other[4] = 2;
    let mut small = agv_hello();
    small.limits.chunk_size = 319;
    let agv = json!({
        "fleet": 7,
        "identity": { "name": "agv-07", "id": 7, "role": "s_unit" },
        "wanted": { "name": "manager", "id": 1 },
        "epoch": 0x0102_0304_0506_0708_u64,
        "nonce": 0x1122_3344_5566_7788_u64,
        "term": 0, "capabilities": 0,
        "message_size": 1024, "chunk_size": 1024, "calls": 8, "minimum_interval": 0,
        "link": 0, "udp_port": 21_970, "stamp": 1_000_000, "keep_alive": 1000,
    });
    let manager = json!({
        "fleet": 7,
        "identity": { "name": "manager", "id": 1, "role": "m_unit" },
        "wanted": null,
        "epoch": 9,
        "nonce": 0xA1A2_A3A4_A5A6_A7A8_u64,
        "term": 0, "capabilities": 0,
        "message_size": 32_768, "chunk_size": 4096, "calls": 64, "minimum_interval": 0,
        "link": 300, "udp_port": 40_001, "stamp": 5_000_000, "keep_alive": 1000,
    });
    let hello = |names, bytes: &[u8], value: &Value| Vector::new(names, Kind::Hello, Context::default(), bytes, value);
    vec![
        hello(("hello_s_unit", "an s_unit that belongs to a manager"), &encoded_hello(&agv_hello()), &agv),
        hello(("hello_m_unit", "an m_unit"), &encoded_hello(&manager_hello()), &manager),
        hello(("hello_other_version", "version 2 is told as such"), &other, &json!({ "other_version": 2 })).lossy(),
        hello(("hello_small_chunks", "refused: a chunk limit below 320"), &encoded_hello(&small), &Value::Null),
    ]
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
    let answers: [(&'static str, Error, Value); 19] = [
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
    let attributes = Attributes { priority: Priority::Emergency, lease: None, idempotent: true }.encode();
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
        ("release", "a lease is given up", Control::Release { slot: 4 }, json!({ "release": { "slot": 4 } })),
        (
            "lease_ended",
            "a lease has expired at the callee",
            Control::LeaseEnded { slot: 4, expired: true },
            json!({ "lease_ended": { "slot": 4, "expired": true } }),
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
            &[3, 5, 0x84, 0x00],
            &json!({ "release": { "slot": 4 } }),
        )
        .lossy(),
    );
    vectors.push(message(("varint_too_big", "refused: beyond 16 bits"), &[3, 5, 0x84, 0x80, 0x04], &Value::Null));
    vectors.push(message(("control_behind", "refused: a byte follows"), &[3, 5, 4, 0], &Value::Null));
    vectors
}

fn session_bodies() -> Vec<Vector> {
    let renewal = Renewal {
        slot: Slot(5),
        generation: Generation(1),
        stamp: 0x0001_0203_0405_0607,
        since: Duration::from_micros(80_000),
    };
    let emergency = [&SessionBody::message_prefix(0)[..], &request(false, &[])].concat();
    let body =
        |names, bytes: &[u8], value: &Value| Vector::new(names, Kind::SessionBody, Context::default(), bytes, value);
    vec![
        body(
            ("keep_alive", "the sender's clock"),
            &SessionBody::keep_alive(0x0001_0203_0405_0607),
            &json!({ "keep_alive": { "stamp": 0x0001_0203_0405_0607_u64 } }),
        ),
        body(
            ("renew", "the caller still wants what a leased function started"),
            &SessionBody::renewal(&renewal),
            &json!({ "renew": {
                "slot": 5, "generation": 1, "stamp": 0x0001_0203_0405_0607_u64, "since": 80_000,
            }}),
        ),
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

fn datagrams() -> Vec<Vector> {
    let known = identity("agv-01", 1, Role::SUnit);
    let search = WhoHas {
        identity: identity("manager", 1, Role::MUnit),
        epoch: Epoch(9),
        sequence: 3,
        nonce: 0x0102_0304_0506_0708,
        wanted: None,
        tcp_port: 40_000,
        expected: 12,
        known: heapless::Vec::from_slice(&[short_hash(&known)]).unwrap_or_default(),
    };
    let wish = WhoHas {
        identity: identity("agv-07", 7, Role::SUnit),
        wanted: Some(manager("manager", 1)),
        tcp_port: 0,
        expected: 1,
        known: heapless::Vec::new(),
        ..search.clone()
    };
    let answer = Announce {
        identity: identity("manager", 1, Role::MUnit),
        epoch: Epoch(9),
        sequence: 2,
        nonce: 0x0102_0304_0506_0708,
        tcp_port: 40_000,
        room: 64,
        expected: 1,
    };
    let mut out = [0; 512];
    let search = search.encode(Fleet(7), &mut out).unwrap_or(&[]).to_vec();
    let wish = wish.encode(Fleet(7), &mut out).unwrap_or(&[]).to_vec();
    let answer = answer.encode(Fleet(7), &mut out).unwrap_or(&[]).to_vec();
    let session =
        [&session_header(Fleet(7), 300, 0xA1A2_A3A4_A5A6_A7A8)[..], &SessionBody::keep_alive(1_000_000)].concat();
    let manager = json!({ "name": "manager", "id": 1, "role": "m_unit" });
    let datagram = |names, fleet, bytes: &[u8], value: &Value| {
        Vector::new(names, Kind::Datagram, Context::fleet(fleet), bytes, value)
    };
    vec![
        datagram(
            ("who_has_m_unit", "an m_unit looks for others; one s_unit is connected and stays silent"),
            7,
            &search,
            &json!({ "who_has": {
                "identity": manager, "epoch": 9, "sequence": 3, "nonce": 0x0102_0304_0506_0708_u64, "wanted": null,
                "tcp_port": 40_000, "expected": 12, "known": [short_hash(&known)],
            }}),
        ),
        datagram(
            ("who_has_s_unit", "an s_unit looks for its manager"),
            7,
            &wish,
            &json!({ "who_has": {
                "identity": { "name": "agv-07", "id": 7, "role": "s_unit" }, "epoch": 9, "sequence": 3,
                "nonce": 0x0102_0304_0506_0708_u64, "wanted": { "name": "manager", "id": 1 },
                "tcp_port": 0, "expected": 1, "known": [],
            }}),
        ),
        datagram(
            ("announce", "the manager answers"),
            7,
            &answer,
            &json!({ "announce": {
                "identity": manager, "epoch": 9, "sequence": 2, "nonce": 0x0102_0304_0506_0708_u64,
                "tcp_port": 40_000, "room": 64, "expected": 1,
            }}),
        ),
        datagram(
            ("session_datagram", "a keep-alive to link 300 of the manager"),
            7,
            &session,
            &json!({ "session": {
                "link": 300, "nonce": 0xA1A2_A3A4_A5A6_A7A8_u64, "body": { "keep_alive": { "stamp": 1_000_000 } },
            }}),
        ),
        datagram(("other_fleet", "another fleet is told as such"), 8, &answer, &json!({ "other_fleet": 7 })).lossy(),
    ]
}
