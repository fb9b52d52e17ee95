#![allow(clippy::unwrap_used, clippy::indexing_slicing, clippy::panic, clippy::arithmetic_side_effects)]
use std::format;
use std::vec::Vec;

use super::*;
use proptest::prelude::*;

const MS: Duration = Duration::from_millis(1);
/// Unknown flags that a callee may ignore.
const SKIPPABLE: u8 = 0x08;
const REPORT: Report = Report { received: 0x0102_0304, hears: true, holds: false, misses: true };

fn headers() -> impl Strategy<Value = RequestHeader> {
    let numbers = (any::<u32>(), any::<u16>(), any::<u16>(), any::<u32>(), any::<u64>(), any::<u32>());
    (numbers, any::<bool>(), any::<u8>()).prop_map(
        |((id, slot, generation, remaining, stamp, since), wants_reply, unknown)| RequestHeader {
            id,
            slot: Slot(slot),
            generation: Generation(generation),
            wants_reply,
            wants_progress: unknown & 4 != 0,
            takes_over: unknown & 1 != 0,
            operator: unknown & 2 != 0,
            unknown: unknown & UNKNOWN,
            remaining: Duration::from_micros(u64::from(remaining)),
            stamp,
            since: Duration::from_micros(u64::from(since)),
            number: !id,
        },
    )
}

proptest! {
    #[test]
    fn a_request_header_survives(header in headers()) {
        let bytes = header.encode();
        let Some(Message::Request(read, block)) = Message::decode(&bytes) else { panic!() };
        prop_assert_eq!(read, header);
        prop_assert!(block.is_empty());
    }

    #[test]
    fn a_longer_header_of_a_later_version_is_read(header in headers(), more in 0..20_usize, flags in 0..16_u8) {
        let mut bytes = Vec::from(header.encode());
        bytes[1] |= flags & SKIPPABLE;
        bytes[6] += more as u8;
        bytes[7] = 99;
        bytes.extend((0..more * WORD + 3).map(|_| 0xEE));
        let Some(Message::Request(read, block)) = Message::decode(&bytes) else { panic!() };
        prop_assert_eq!((read, block), (header, &[0xEE; 3][..]));
        bytes[6] = REQUEST_WORDS - 1;
        prop_assert!(Message::decode(&bytes).is_none());
        let mut reply = Vec::from(encode_reply(7, Ok(())));
        reply[3] += more as u8;
        reply.extend((0..more * WORD + 3).map(|_| 0xEE));
        let Some(Message::Reply(7, Ok(block))) = Message::decode(&reply) else { panic!() };
        prop_assert_eq!(block, &[0xEE; 3]);
        reply[3] = REPLY_WORDS - 1;
        prop_assert!(Message::decode(&reply).is_none());
    }

    #[test]
    fn decoding_never_panics(bytes in prop::collection::vec(any::<u8>(), 0..80), kind in 0..8u8) {
        let mut bytes = bytes;
        bytes.insert(0, kind);
        let _ = Message::decode(&bytes);
        let _ = SessionBody::decode(&bytes);
    }

    #[test]
    fn error_codes_are_total(code in 1..=255u8, index: u8, first: u32, second: u32) {
        let error = error_of(code, index, first, second);
        let bytes = encode_reply(7, Err(error));
        let Some(Message::Reply(7, Err(read))) = Message::decode(&bytes) else { panic!() };
        prop_assert_eq!(read, error);
    }
}

#[cfg(feature = "streams")]
#[test]
fn a_sample_survives() {
    let header = SampleHeader { slot: Slot(7), generation: Generation(0x102), made: -3 };
    let mut bytes = Vec::from(header.encode());
    assert_eq!(bytes[..8], [6, 0, 7, 0, 2, 1, REPLY_WORDS, 0]);
    bytes[6] += 1;
    bytes.extend([0xEE; WORD + 3]);
    let Some(Message::Sample(read, block)) = Message::decode(&bytes) else { panic!() };
    assert_eq!((read, block), (header, &[0xEE; 3][..]), "a later version says more");
    bytes[6] = 3;
    assert!(Message::decode(&bytes).is_none());
}

#[cfg(feature = "details")]
#[test]
fn progress_details_and_cancellation_survive() {
    let mut bytes = Vec::from(encode_progress(7));
    assert_eq!(bytes[..8], [5, 0, 0, (PROGRESS_BYTES / WORD) as u8, 7, 0, 0, 0]);
    bytes[3] += 1;
    bytes.extend([0xEE; WORD + 3]);
    let Some(Message::Progress(7, block)) = Message::decode(&bytes) else { panic!() };
    assert_eq!(block, [0xEE; 3], "a later version says more");
    bytes[3] = 1;
    assert!(Message::decode(&bytes).is_none());

    let cancel = Release { call: 5, class: Priority::High };
    assert_eq!(SessionBody::decode(&SessionBody::cancel(&cancel)), Some(SessionBody::Cancel(cancel)));
    assert_eq!(SessionBody::cancel(&cancel), [9, 1, 5, 0, 0, 0]);

    for text in ["", "too far", "achteinh"] {
        let mut failure = Vec::from(encode_failure(7, Error::Service(ServiceError::Failed(300))));
        assert_eq!(FailureDetails::of(&failure), None);
        let mut more = [0; 32];
        FailureDetails::put_text(text, &mut super::super::block::SliceWriter::new(&mut more));
        failure.extend(&more[..FailureDetails::text_bytes(text)]);
        failure.extend([1; 8]);
        assert_eq!(FailureDetails::of(&failure), Some(FailureDetails { text, values: &[1; 8] }));
        assert_eq!(FailureDetails::of(&failure[..failure.len() - 9]), None, "it is cut");
    }
    let mut other = Vec::from(encode_reply(7, Err(Error::Busy)));
    other.extend([0; 8]);
    assert_eq!(FailureDetails::of(&other), None, "of another error what follows is passed over");
}

/// Flag 2 is ignored by callees that do not know it; their answer has 0 where others report it.
#[test]
fn an_operators_origin_is_told_both_ways() {
    let header = RequestHeader {
        id: 7,
        slot: Slot(1),
        generation: Generation(2),
        wants_reply: false,
        wants_progress: false,
        takes_over: false,
        operator: true,
        unknown: 0,
        remaining: MS,
        stamp: 3,
        since: MS,
        number: 8,
    };
    let (operators, programs) = (header.encode(), RequestHeader { operator: false, ..header }.encode());
    assert_eq!((operators[1], programs[1]), (1 << 2, 0));
    assert_eq!(operators[2..], programs[2..]);
    for operator in [true, false] {
        let reply = encode_reply(7, Err(Error::Held { by: 9, operator }));
        assert_eq!((reply[1], reply[8], reply[12]), (17, 9, operator.into()));
        let Some(Message::Reply(7, Err(error))) = Message::decode(&reply) else { panic!() };
        assert_eq!(error, Error::Held { by: 9, operator });
    }
}

#[test]
fn session_bodies_may_be_longer() {
    let longer = |bytes: &[u8]| format!("{:?}", SessionBody::decode(&[bytes, &[0xEE; 5]].concat()));
    let exact = |bytes: &[u8]| format!("{:?}", SessionBody::decode(bytes));
    let renewal = Renewal { call: 1, class: Priority::Low, stamp: 3, since: Duration::from_micros(4), age: MS };
    let bodies: [&[u8]; 8] = [
        &SessionBody::PING,
        &SessionBody::pong(REPORT),
        &SessionBody::keep_alive(9, REPORT),
        &SessionBody::close(13),
        &SessionBody::renewal(&renewal),
        &SessionBody::renewed(9),
        &SessionBody::release(&Release { call: 5, class: Priority::High }),
        &SessionBody::release_all(Slot(6), 7),
    ];
    for body in bodies {
        assert_eq!(longer(body), exact(body));
    }
    assert_eq!(SessionBody::decode(&[200, 1, 2]), None);
}

#[test]
fn session_bodies_survive() {
    assert_eq!(SessionBody::decode(&SessionBody::PING), Some(SessionBody::Ping));
    assert_eq!(SessionBody::decode(&SessionBody::pong(REPORT)), Some(SessionBody::Pong(REPORT)));
    assert_eq!(SessionBody::decode(&SessionBody::close(13)), Some(SessionBody::Close(13)));
    let keep_alive = SessionBody::KeepAlive { stamp: 9, report: REPORT };
    assert_eq!(SessionBody::decode(&SessionBody::keep_alive(9, REPORT)), Some(keep_alive));
    let renewal = Renewal { call: 1, class: Priority::Low, stamp: 3, since: Duration::from_micros(4), age: MS };
    assert_eq!(SessionBody::decode(&SessionBody::renewal(&renewal)), Some(SessionBody::Renew(renewal)));
    assert_eq!(SessionBody::decode(&SessionBody::renewed(7)), Some(SessionBody::Renewed(7)));
    let release = Release { call: 5, class: Priority::Emergency };
    assert_eq!(SessionBody::decode(&SessionBody::release(&release)), Some(SessionBody::Release(release)));
    let all = SessionBody::ReleaseAll(Slot(6), 7);
    assert_eq!(SessionBody::decode(&SessionBody::release_all(Slot(6), 7)), Some(all));
}
