//! Vectors of the hello and of datagrams.

use cara_core::config::{Mode, VERSIONS, Versions};
use cara_core::distribution::claim::{Claim, TaggedClaim};
use cara_core::distribution::datagram::{Announce, WhoHas, session_header, short_hash};
use cara_core::distribution::hello::{ClaimReport, Hello, Limits, Manager};
use cara_core::distribution::identity::{Epoch, Fleet, Identity, Role};
use cara_core::distribution::message::SessionBody;
use cara_core::host::connections::Report;
use cara_core::host::secure::Plain;
use serde_json::{Value, json};

use crate::vector::{Context, Kind, Vector};

/// Every vector of this file.
pub(crate) fn all() -> Vec<Vector> {
    [hellos(), datagrams()].concat()
}

/// An item of any kind.
pub(crate) fn item(kind: u16, body: &[u8]) -> Vec<u8> {
    let length = u16::try_from(body.len()).unwrap_or(u16::MAX);
    let mut item = [&kind.to_le_bytes()[..], &length.to_le_bytes(), body].concat();
    item.resize(item.len().next_multiple_of(4), 0);
    item
}

pub(crate) fn agv_hello() -> Hello {
    Hello {
        versions: VERSIONS,
        capabilities: 0,
        fleet: Fleet(7),
        identity: identity("agv-07", 7, Role::SUnit),
        wanted: Some(manager("manager", 1)),
        epoch: Epoch(0x0102_0304_0506_0708),
        claim: None,
        obeyed: None,
        nonce: 0x1122_3344_5566_7788,
        limits: Limits { message_size: 1024, chunk_size: 1024, calls: 8, minimum_interval: 0 },
        link: 0,
        udp_port: 21_970,
        stamp: 1_000_000,
        keep_alive: 1_000,
        skipped: 0,
    }
}

pub(crate) fn manager_hello() -> Hello {
    Hello {
        versions: VERSIONS,
        capabilities: 0,
        fleet: Fleet(7),
        identity: identity("manager", 1, Role::MUnit),
        wanted: None,
        epoch: Epoch(9),
        claim: None,
        obeyed: None,
        nonce: 0xA1A2_A3A4_A5A6_A7A8,
        limits: Limits { message_size: 32_768, chunk_size: 4096, calls: 64, minimum_interval: 0 },
        link: 300,
        udp_port: 40_001,
        stamp: 5_000_000,
        keep_alive: 1_000,
        skipped: 0,
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

/// The hello of the s_unit with these items in front of its own.
pub(crate) fn hello_with(items: &[u8]) -> Vec<u8> {
    let hello = encoded_hello(&agv_hello());
    let (prefix, own) = hello.split_at(20);
    [prefix, items, own].concat()
}

/// The hello of the s_unit, which says that it speaks these versions.
pub(crate) fn hello_of(first: u8, last: u8) -> Vec<u8> {
    encoded_hello(&Hello { versions: Versions { first, last }, ..agv_hello() })
}

/// A claim with its tag.
pub(crate) fn report(since: u32) -> ClaimReport {
    let claim = Claim { term: 300, claimant: 0x0102_0304_0506_0708 };
    ClaimReport { tagged: TaggedClaim { claim, tag: [0xA7; 16] }, since }
}

pub(crate) fn reported(since: u32) -> Value {
    json!({ "term": 300, "claimant": 0x0102_0304_0506_0708_u64, "tag": "a7".repeat(16), "since": since })
}

fn hellos() -> Vec<Vector> {
    let mut small = agv_hello();
    small.limits.chunk_size = 319;
    let agv = json!({
        "versions": [2, 2], "capabilities": 0, "fleet": 7,
        "identity": { "name": "agv-07", "id": 7, "role": "s_unit" },
        "wanted": { "name": "manager", "id": 1 },
        "epoch": 0x0102_0304_0506_0708_u64,
        "claim": null, "obeyed": null,
        "nonce": 0x1122_3344_5566_7788_u64,
        "message_size": 1024, "chunk_size": 1024, "calls": 8, "minimum_interval": 0,
        "link": 0, "udp_port": 21_970, "stamp": 1_000_000, "keep_alive": 1000,
        "skipped": 0,
    });
    let manager = json!({
        "versions": [2, 2], "capabilities": 0, "fleet": 7,
        "identity": { "name": "manager", "id": 1, "role": "m_unit" },
        "wanted": null,
        "epoch": 9,
        "claim": null, "obeyed": null,
        "nonce": 0xA1A2_A3A4_A5A6_A7A8_u64,
        "message_size": 32_768, "chunk_size": 4096, "calls": 64, "minimum_interval": 0,
        "link": 300, "udp_port": 40_001, "stamp": 5_000_000, "keep_alive": 1000,
        "skipped": 0,
    });
    let but = |key: &str, value: Value| {
        let mut changed = agv.clone();
        changed[key] = value;
        changed
    };
    let mut later = but("versions", json!([2, 9]));
    later["capabilities"] = json!(0x8000_0000_0000_0001_u64);
    let later_hello =
        Hello { versions: Versions { first: 2, last: 9 }, capabilities: 0x8000_0000_0000_0001, ..agv_hello() };
    let obeyed = Hello { obeyed: Some(report(1_500)), ..agv_hello() };
    let claiming = Hello { claim: Some(report(ClaimReport::NEVER)), ..manager_hello() };
    let mut of_claim = manager.clone();
    of_claim["claim"] = reported(u32::MAX);
    let own = encoded_hello(&agv_hello());
    let more_calls = [&own[..], &item(4, &[0x80, 8, 0x80, 8, 9, 0, 0xEE, 0xEE, 0xEE])].concat();
    let other = |versions: Value| json!({ "other_versions": versions });
    let hello = |names, bytes: &[u8], value: &Value| Vector::new(names, Kind::Hello, Context::default(), bytes, value);
    vec![
        hello(("hello_s_unit", "an s_unit that belongs to a manager"), &encoded_hello(&agv_hello()), &agv),
        hello(("hello_m_unit", "an m_unit"), &encoded_hello(&manager_hello()), &manager),
        hello(
            ("hello_obeyed", "an s_unit that has obeyed the claim 300, whose manager it has heard 1.5 s ago"),
            &encoded_hello(&obeyed),
            &but("obeyed", reported(1_500)),
        ),
        hello(("hello_claim", "an m_unit of the claim 300"), &encoded_hello(&claiming), &of_claim),
        hello(
            ("hello_of_more_versions", "versions 2 to 9 and two capabilities: version 2 is in common"),
            &encoded_hello(&later_hello),
            &later,
        ),
        hello(("hello_of_other_versions", "3 to 5 are told as such"), &hello_of(3, 5), &other(json!([3, 5]))).lossy(),
        hello(("hello_of_version_1", "byte 5 is no version there"), &hello_of(1, 7), &other(json!([1, 1]))).lossy(),
        hello(("hello_of_no_range", "a last version below the first"), &hello_of(3, 2), &other(json!([3, 3]))).lossy(),
        hello(
            ("hello_unknown_item", "an unknown item is passed over and counted"),
            &hello_with(&item(0x7000, b"later")),
            &but("skipped", json!(1)),
        )
        .lossy(),
        hello(
            ("hello_must_understand", "refused: an unknown item that must be understood"),
            &hello_with(&item(0xF000, b"later")),
            &Value::Null,
        ),
        hello(("hello_padding", "an item of padding is not counted"), &hello_with(&item(0, &[9; 5])), &agv).lossy(),
        hello(
            ("hello_limits_twice", "the later item of a kind counts; its body is longer than known"),
            &more_calls,
            &but("calls", json!(9)),
        )
        .lossy(),
        hello(("hello_without_limits", "refused: the last item is missing"), &own[..own.len() - 12], &Value::Null),
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
        standby: false,
        skipped: 0,
    };
    let wish = WhoHas {
        identity: identity("agv-07", 7, Role::SUnit),
        wanted: Some(manager("manager", 1)),
        tcp_port: 0,
        expected: 1,
        known: heapless::Vec::new(),
        ..search.clone()
    };
    let standby = WhoHas {
        wanted: Some(manager("manager", 1)),
        tcp_port: 0,
        expected: 0,
        known: heapless::Vec::new(),
        standby: true,
        ..search.clone()
    };
    let answer = Announce {
        identity: identity("manager", 1, Role::MUnit),
        epoch: Epoch(9),
        claim: None,
        obeyed: None,
        sequence: 2,
        nonce: 0x0102_0304_0506_0708,
        tcp_port: 40_000,
        room: 64,
        expected: 1,
        skipped: 0,
    };
    let mut out = [0; 512];
    let search = search.encode(Fleet(7), &Plain, &mut out).unwrap_or(&[]).to_vec();
    let wish = wish.encode(Fleet(7), &Plain, &mut out).unwrap_or(&[]).to_vec();
    let standby = standby.encode(Fleet(7), &Plain, &mut out).unwrap_or(&[]).to_vec();
    let of_claim = Announce { claim: Some(report(1_500)), ..answer.clone() };
    let of_claim = of_claim.encode(Fleet(7), &Plain, None, &mut out).unwrap_or(&[]).to_vec();
    let answer = answer.encode(Fleet(7), &Plain, None, &mut out).unwrap_or(&[]).to_vec();
    let header = session_header(Mode::Plain, VERSIONS.last, Fleet(7), 300, 0xA1A2_A3A4_A5A6_A7A8);
    let session =
        [&header[..], &SessionBody::keep_alive(1_000_000, Report { received: 300, hears: true, ..Report::default() })]
            .concat();
    let with = |bytes: &[u8], kind| [bytes, &item(kind, b"later")].concat();
    let of_versions = |bytes: &[u8], first, last| {
        let mut bytes = bytes.to_vec();
        (bytes[4], bytes[6]) = (first, last);
        bytes
    };
    let manager = json!({ "name": "manager", "id": 1, "role": "m_unit" });
    let datagram = |names, fleet, bytes: &[u8], value: &Value| {
        Vector::new(names, Kind::Datagram, Context::fleet(fleet), bytes, value)
    };
    let wished = |skipped| {
        json!({ "who_has": {
            "identity": { "name": "agv-07", "id": 7, "role": "s_unit" }, "epoch": 9, "sequence": 3,
            "nonce": 0x0102_0304_0506_0708_u64, "wanted": { "name": "manager", "id": 1 },
            "tcp_port": 0, "expected": 1, "known": [], "standby": false, "skipped": skipped,
        }})
    };
    let announced = |claim: Value| {
        json!({ "announce": {
            "identity": manager, "epoch": 9, "claim": claim, "obeyed": null, "sequence": 2, "nonce": 0x0102_0304_0506_0708_u64,
            "tcp_port": 40_000, "room": 64, "expected": 1, "skipped": 0,
        }})
    };
    vec![
        datagram(
            ("who_has_m_unit", "an m_unit looks for others; one s_unit is connected and stays silent"),
            7,
            &search,
            &json!({ "who_has": {
                "identity": manager, "epoch": 9, "sequence": 3, "nonce": 0x0102_0304_0506_0708_u64, "wanted": null,
                "tcp_port": 40_000, "expected": 12, "known": [short_hash(&known)], "standby": false, "skipped": 0,
            }}),
        ),
        datagram(("who_has_s_unit", "an s_unit looks for its manager"), 7, &wish, &wished(0)),
        datagram(
            ("who_has_standby", "a standby of `manager` asks whether that one is there"),
            7,
            &standby,
            &json!({ "who_has": {
                "identity": manager, "epoch": 9, "sequence": 3, "nonce": 0x0102_0304_0506_0708_u64,
                "wanted": { "name": "manager", "id": 1 }, "tcp_port": 0, "expected": 0, "known": [], "standby": true, "skipped": 0,
            }}),
        ),
        datagram(
            ("who_has_unknown_item", "an unknown item is passed over and counted"),
            7,
            &with(&wish, 0x7000),
            &wished(1),
        )
        .lossy(),
        datagram(
            ("who_has_must_understand", "dropped: an unknown item that must be understood"),
            7,
            &with(&wish, 0xF000),
            &Value::Null,
        ),
        datagram(("who_has_padding", "an item of padding is not counted"), 7, &with(&wish, 0), &wished(0)).lossy(),
        datagram(
            ("who_has_of_more_versions", "versions 2 to 9: version 2 is among them"),
            7,
            &of_versions(&wish, 2, 9),
            &wished(0),
        )
        .lossy(),
        datagram(
            ("who_has_of_other_versions", "3 to 5 are told as such"),
            7,
            &of_versions(&wish, 3, 5),
            &json!({ "other_versions": [3, 5] }),
        )
        .lossy(),
        datagram(("announce", "the manager answers"), 7, &answer, &announced(Value::Null)),
        datagram(("announce_claim", "the manager of claim 300 answers"), 7, &of_claim, &announced(reported(1_500))),
        datagram(
            ("session_datagram", "a keep-alive to link 300 of the manager"),
            7,
            &session,
            &json!({ "session": {
                "link": 300, "nonce": 0xA1A2_A3A4_A5A6_A7A8_u64, "body": { "keep_alive": { "stamp": 1_000_000, "received": 300, "hears": true, "holds": false, "misses": false } },
            }}),
        ),
        datagram(("other_fleet", "another fleet is told as such"), 8, &answer, &json!({ "other_fleet": 7 })).lossy(),
    ]
}
