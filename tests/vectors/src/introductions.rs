//! Vectors of the hello and of datagrams.

use cara_core::config::Mode;
use cara_core::distribution::datagram::{Announce, WhoHas, session_header, short_hash};
use cara_core::distribution::hello::{Hello, Limits, Manager};
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::distribution::message::SessionBody;
use cara_core::host::secure::Plain;
use serde_json::{Value, json};

use crate::vector::{Context, Kind, Vector};

/// Every vector of this file.
pub(crate) fn all() -> Vec<Vector> {
    [hellos(), datagrams()].concat()
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
    let length = hello.encode(Mode::Plain, &mut bytes).unwrap_or(0);
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
    let search = search.encode(Fleet(7), &Plain, &mut out).unwrap_or(&[]).to_vec();
    let wish = wish.encode(Fleet(7), &Plain, &mut out).unwrap_or(&[]).to_vec();
    let answer = answer.encode(Fleet(7), &Plain, None, &mut out).unwrap_or(&[]).to_vec();
    let session =
        [&session_header(Mode::Plain, Fleet(7), 300, 0xA1A2_A3A4_A5A6_A7A8)[..], &SessionBody::keep_alive(1_000_000)]
            .concat();
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
