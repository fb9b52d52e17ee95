//! Recordings written here, read back by the crate `mcap` and by [`Reading`].

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::time::Duration;

use cara_std::control::protocol::{Answer, Argument, ArgumentValue, KeysInfo, Number};
use mcap::records::op;
use mcap::sans_io::indexed_reader::{IndexedReadEvent, IndexedReader};
use serde_json::Value;

use super::reading::{Damage, End};
use super::{Limits, Reading, Recorder, StartError, event_of};

const LONG: Duration = Duration::from_secs(20);
const ALL: Limits = Limits { size: u64::MAX, keep: 2 };

fn start(path: &Path, limits: Limits) -> Recorder {
    Recorder::start(path, limits, BTreeMap::from([("unit".to_owned(), "depot/1".to_owned())])).unwrap()
}

fn event(text: &str) -> Answer {
    Answer::Event { at_ms: 1, unix_ms: 2, event: "left".into(), node: None, text: text.into() }
}

fn pose(stream: &str, x: ArgumentValue) -> Answer {
    let values = vec![
        Argument { name: "x".into(), size: 1, value: x },
        Argument { name: "route".into(), size: 2, value: ArgumentValue::Int(vec![1, 2]) },
    ];
    let (node, stream) = ("agv/7".to_owned(), stream.to_owned());
    Answer::Value { node, stream, unix_ms: 2_000, age_us: Some(500_000), values, error: None }
}

fn whole(recorder: Recorder) -> u64 {
    let outcome = recorder.end(LONG);
    assert_eq!((outcome.whole, outcome.lost), (Ok(()), 0));
    outcome.messages
}

/// The texts of a file's events, and how it ends.
fn texts(file: &[u8]) -> (Vec<String>, End) {
    let mut reading = Reading::of(file);
    let events = reading.by_ref().filter_map(|message| match event_of(&message)? {
        Answer::Event { text, .. } => Some(text),
        _ => None,
    });
    (events.collect(), reading.end().unwrap().clone())
}

#[test]
fn the_summary_and_the_index_lead_to_every_message() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = start(&path, ALL);
    recorder.take(&event("one"));
    recorder.flush();
    for x in [0.5, 1.0] {
        recorder.take(&pose("pose() -> (x: float)", ArgumentValue::Float(vec![Number::Finite(x)])));
    }
    recorder.take(&pose("pose() -> (x: bool)", ArgumentValue::Bool(vec![true])));
    assert_eq!(whole(recorder), 4);

    let file = fs::read(&path).unwrap();
    let summary = mcap::Summary::read(&file).unwrap().unwrap();
    let counted = summary.stats.as_ref().unwrap();
    assert_eq!((counted.message_count, counted.chunk_count, counted.metadata_count), (5, 2, 1));
    let mut found: Vec<(String, String, Value, u64)> = Vec::new();
    let mut indexed = IndexedReader::new(&summary).unwrap();
    while let Some(next) = indexed.next_event() {
        match next.unwrap() {
            IndexedReadEvent::ReadChunkRequest { offset, length } => {
                indexed.insert_chunk_record_data(offset, &file[offset as usize..][..length]).unwrap();
            }
            IndexedReadEvent::Message { header, data } => {
                let channel = &summary.channels[&header.channel_id];
                let schema = channel.schema.as_ref().unwrap();
                assert_eq!((channel.message_encoding.as_str(), schema.encoding.as_str()), ("json", "jsonschema"));
                let schema: Value = serde_json::from_slice(&schema.data).unwrap();
                assert_eq!(schema["type"], "object", "{schema}");
                let kind = schema["properties"]["values"]["properties"]["x"]["type"].to_string();
                found.push((channel.topic.clone(), kind, serde_json::from_slice(data).unwrap(), header.publish_time));
            }
        }
    }
    let topics: Vec<_> = found.iter().map(|(topic, ..)| topic.as_str()).collect();
    let pose = "/streams/agv/7/pose";
    assert_eq!(topics, ["/events", pose, pose, pose, "/recording"]);
    assert_eq!((&found[0].2["text"], found[0].2.get("node")), (&"one".into(), None), "no member is null");
    let (_, kind, body, published) = &found[1];
    assert_eq!((kind.as_str(), *published), ("\"number\"", 1_500_000_000));
    assert_eq!(body["values"], serde_json::json!({ "x": 0.5, "route": [1, 2] }));
    assert_eq!(found[4].2, serde_json::json!({ "event": "ended", "messages": 4, "lost_in_all": 0 }));
    assert_eq!(summary.channels.len(), 4, "another signature is another channel");
}

#[test]
fn a_file_that_is_long_enough_is_put_aside_and_the_oldest_goes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = start(&path, Limits { size: 4096, keep: 2 });
    let mut all = 0;
    while recorder.file() < 5 {
        recorder.take(&event(&all.to_string()));
        recorder.flush();
        all += 1;
        std::thread::sleep(Duration::from_micros(200));
    }
    assert_eq!(whole(recorder), all);
    let mut names: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["a.mcap", "a.mcap.1", "a.mcap.2"]);
    let mut read = Vec::new();
    for name in ["a.mcap.2", "a.mcap.1", "a.mcap"] {
        let file = fs::read(folder.path().join(name)).unwrap();
        assert!(mcap::Summary::read(&file).unwrap().is_some(), "{name} is whole");
        let (texts, end) = texts(&file);
        assert_eq!(end, End::Whole);
        read.extend(texts.iter().map(|text| text.parse::<u64>().unwrap()));
    }
    assert!(read.len() > 3 && read.iter().copied().eq(read[0]..all), "no message is missing between files: {read:?}");
}

#[test]
fn a_small_file_is_not_as_long_as_a_large_chunk() {
    const SIZE: u64 = 64 * 1024;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = start(&path, Limits { size: SIZE, keep: 9 });
    // Nothing ends a chunk but its size.
    (0..400).for_each(|_| recorder.take(&event(&"x".repeat(1_000))));
    whole(recorder);
    let sizes: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().metadata().unwrap().len()).collect();
    assert!(sizes.len() > 4 && sizes.iter().all(|size| *size < SIZE * 3 / 2), "{sizes:?}");
}

#[test]
fn a_recording_that_is_there_is_kept_and_nothing_else_is_touched() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = start(&path, ALL);
    let refused = |path: &Path| Recorder::start(path, ALL, BTreeMap::new()).err().unwrap().to_string();
    assert!(refused(&path).contains("another process"), "it is being written");
    assert_eq!(whole(recorder), 0);
    let first = fs::read(&path).unwrap();
    whole(start(&path, ALL));
    assert_eq!(fs::read(folder.path().join("a.mcap.1")).unwrap(), first);
    let other = folder.path().join("notes.txt");
    fs::write(&other, "mine").unwrap();
    assert!(refused(&other).contains("no recording") && refused(folder.path()).contains("no file"));
    assert_eq!(fs::read(&other).unwrap(), b"mine");
}

#[test]
fn a_name_that_leaves_no_place_for_a_number_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let long = folder.path().join("x".repeat(253));
    let limits = Limits { size: 4096, keep: 10 };
    let refused = Recorder::start(&long, limits, BTreeMap::new()).err().unwrap();
    assert!(matches!(&refused, StartError::Refused { why, .. } if why.contains("too long")), "{refused}");
    assert_eq!(fs::read_dir(&folder).unwrap().count(), 0);
    whole(start(&long, Limits { keep: 9, ..limits }));
    whole(start(&long, Limits { keep: 9, ..limits }));
    assert!(long.with_added_extension("1").exists());
}

#[test]
fn a_crash_loop_pushes_one_long_recording_out_at_most() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let numbered = |number: u32| folder.path().join(format!("a.mcap.{number}"));
    let limits = Limits { size: 1 << 20, keep: 3 };
    let long = "x".repeat(100_000);
    let record = |text: &str| {
        let recorder = start(&path, limits);
        recorder.take(&event(text));
        whole(recorder);
    };
    let found = |path: &Path| texts(&fs::read(path).unwrap()).0.remove(0);
    record(&long);
    record(&long);
    (0..10).for_each(|number| record(&number.to_string()));
    // Both long ones, and the newest of the short ones.
    assert_eq!([found(&path), found(&numbered(1))], ["9", "8"]);
    assert!(found(&numbered(2)) == long && found(&numbered(3)) == long);
    record(&long);
    record(&long);
    assert_eq!([&path, &numbered(1), &numbered(2), &numbered(3)].map(|path| found(path).len()), [100_000; 4]);
    // What was recorded before the first crash is kept, even if it is short: the oldest goes once.
    let second = fs::read(numbered(2)).unwrap();
    record("short");
    assert_eq!(fs::read(numbered(3)).unwrap(), second);
    record("shorter");
    assert_eq!([found(&path), found(&numbered(1))], ["shorter", "short"]);
    record("shortest");
    assert_eq!([found(&path), found(&numbered(1))], ["shortest", "shorter"]);
    assert_eq!([&numbered(2), &numbered(3)].map(|path| found(path).len()), [100_000; 2]);
    assert!(!numbered(4).exists());
}

#[test]
fn what_ends_anywhere_is_read_up_to_there_and_no_damage_panics() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = start(&path, ALL);
    for text in ["one", "two"] {
        recorder.take(&event(text));
        recorder.flush();
    }
    whole(recorder);
    let file = fs::read(&path).unwrap();
    let (all, end) = texts(&file);
    assert_eq!((all, end), (vec!["one".to_owned(), "two".to_owned()], End::Whole));
    /// The magic, and the header, the first record of every file.
    const BEGIN: usize = mcap::MAGIC.len() + 9 + 4 + "cara".len() + 4 + super::LIBRARY.len();
    let mut most = 0;
    for length in 0..file.len() {
        let (read, end) = texts(&file[..length]);
        assert!(read.len() >= most, "more of the file brings no less");
        // Behind the messages stands what leads to them, which nothing here needs.
        assert_eq!(matches!(end, End::Damaged(_)), length < BEGIN, "{length}: {end:?}");
        most = read.len();
    }
    assert_eq!(most, 2);
    assert_eq!(texts(&file[..BEGIN]).1, End::CutOff);
    let mut damaged = file.clone();
    for index in 0..file.len() {
        damaged[index] ^= 0xff;
        texts(&damaged);
        damaged[index] ^= 0xff;
    }
    // What comes after a loss of power.
    let ended = texts(&[&file[..file.len() / 2], &[0; 5_000]].concat());
    assert_eq!(ended.1, End::CutOff);
    assert!(matches!(texts(b"a text").1, End::Damaged(_)));
}

/// The opcodes of a file's records, and where each begins.
fn places(file: &[u8]) -> Vec<(u8, usize)> {
    let (mut places, mut at) = (Vec::new(), mcap::MAGIC.len());
    while at + 9 < file.len() {
        places.push((file[at], at));
        at += 9 + u64::from_le_bytes(file[at + 1..at + 9].try_into().unwrap()) as usize;
    }
    places
}

/// As `texts`, with the damage.
fn damaged(file: &[u8]) -> (Vec<String>, Damage, End) {
    let mut reading = Reading::of(file);
    reading.by_ref().for_each(drop);
    let (texts, end) = texts(file);
    (texts, reading.damage(), end)
}

#[test]
fn damage_is_seen_and_costs_no_other_chunk() {
    const NONE: Damage = Damage { parts: 0, messages: 0 };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = start(&path, ALL);
    for text in ["one", "two", "three"] {
        recorder.take(&event(text));
        recorder.flush();
    }
    whole(recorder);
    let file = fs::read(&path).unwrap();
    let places = places(&file);
    let chunks: Vec<_> = places.iter().filter(|(opcode, _)| *opcode == op::CHUNK).map(|(_, at)| *at).collect();
    let data_end = places.iter().find(|(opcode, _)| *opcode == op::DATA_END).unwrap().1;
    // A byte anywhere before the end of the messages.
    let mut changed = file.clone();
    for index in 0..data_end + 13 {
        changed[index] ^= 0x10;
        let (texts, damage, end) = damaged(&changed);
        assert!(damage != NONE || matches!(end, End::Damaged(_)), "{index}");
        // Neither its beginning, nor the first chunk, which has the channel.
        if index >= chunks[1] {
            assert!(
                texts.len() >= 2 && texts[0] == "one" && (damage.parts, end) == (1, End::Whole),
                "{index}: {texts:?}"
            );
        }
        changed[index] ^= 0x10;
    }
    let changed = |from: usize, bytes: &[u8]| {
        let mut file = file.clone();
        file[from..from + bytes.len()].copy_from_slice(bytes);
        file
    };
    let of = |texts: &[&str], parts, messages| {
        let texts: Vec<_> = texts.iter().map(|text| (*text).to_owned()).collect();
        (texts, Damage { parts, messages }, End::Whole)
    };
    // A message is not shown with what it did not say; the channel of the first chunk is known.
    for (chunk, left) in [(0, ["two", "three"]), (1, ["one", "three"]), (2, ["one", "two"])] {
        let said = file[chunks[chunk]..].windows(6).position(|part| part == b"\"text\"").unwrap();
        assert_eq!(damaged(&changed(chunks[chunk] + said + 9, b"x")), of(&left, 1, 0));
    }
    // A length, and a page.
    assert_eq!(damaged(&changed(chunks[1] + 1, &[0xff, 0xff])), of(&["one", "three"], 1, 0));
    assert_eq!(damaged(&changed(chunks[1] + 1, &[0xff; 8])), of(&["one", "three"], 1, 0));
    assert_eq!(damaged(&changed(chunks[1], &vec![0; chunks[2] - chunks[1]])), of(&["one", "three"], 1, 0));
    assert_eq!(damaged(&changed(chunks[0], &vec![0; chunks[1] - chunks[0]])), of(&[], 1, 2));
    // A name of a compression that swallows the sizes behind it.
    for name in [8, 9] {
        assert_eq!(damaged(&changed(chunks[1] + 9 + 28, &[name])), of(&["one", "three"], 1, 0));
    }
    // Opcodes of records that would be passed over, without the checksum at the end.
    for opcode in [0x07, 0x86] {
        let (texts, damage, end) = damaged(&changed(chunks[1], &[opcode])[..data_end - 3]);
        assert_eq!((texts.len(), damage.parts, end), (2, 1, End::CutOff), "{opcode}");
    }
    // What is also cut off.
    let cut = &changed(chunks[1] + 1, &[0xff; 8])[..data_end - 3];
    let (read, damage, end) = damaged(cut);
    assert_eq!((read.len(), damage.parts, end), (2, 1, End::CutOff));
}

#[test]
fn what_is_reported_after_the_end_begins_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let recorder = start(&folder.path().join("a.mcap"), ALL);
    let other = recorder.clone();
    assert_eq!(whole(recorder), 0);
    other.take(&event("late"));
    assert_eq!(whole(other), 0);
    assert_eq!(fs::read_dir(&folder).unwrap().count(), 1);
}

#[test]
fn a_message_that_is_too_long_is_counted_and_the_recording_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = start(&path, ALL);
    recorder.take(&event(&"x".repeat(300_000)));
    recorder.take(&event("short"));
    let outcome = recorder.end(LONG);
    assert_eq!((outcome.whole, outcome.messages, outcome.lost), (Ok(()), 1, 1));
    let lost = Reading::open(&path).unwrap().find(|message| message.topic == "/recording").unwrap();
    let lost: Value = serde_json::from_slice(&lost.body).unwrap();
    assert_eq!((&lost["event"], &lost["lost"]), (&"lost".into(), &1.into()));
}

#[test]
fn messages_of_mqtt_go_both_ways_and_each_topic_is_a_channel() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = start(&path, ALL);
    recorder.take_mqtt(false, "uagv/order", true, b"{\"orderId\":\"o1\"}");
    recorder.take_mqtt(true, "uagv/state", false, &[0xff, 0]);
    assert_eq!(whole(recorder), 2);
    let found: Vec<_> = Reading::open(&path).unwrap().filter(|message| message.topic.starts_with("/mqtt/")).collect();
    let topics: Vec<_> = found.iter().map(|message| message.topic.as_str()).collect();
    assert_eq!(topics, ["/mqtt/uagv/order", "/mqtt/uagv/state"]);
    let body = |index: usize| serde_json::from_slice::<Value>(&found[index].body).unwrap();
    assert_eq!(
        body(0),
        serde_json::json!({ "direction": "received", "topic": "uagv/order", "retained": true, "payload": "{\"orderId\":\"o1\"}" })
    );
    assert_eq!((&body(1)["direction"], &body(1)["payload_hex"]), (&"sent".into(), &"ff00".into()));
}

#[test]
fn messages_of_mqtt_are_events_of_a_replay() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let recorder = start(&path, ALL);
    recorder.take_mqtt(false, "uagv/order", true, b"{\"orderId\":\"o1\"}");
    recorder.take_mqtt(true, "uagv/state", false, "ü".repeat(300).as_bytes());
    recorder.take_mqtt(true, "uagv/state", false, &[0xff, 0]);
    whole(recorder);
    let all: Vec<_> = Reading::open(&path).unwrap().collect();
    let shown = |index: usize| match event_of(&all[index]) {
        Some(Answer::Event { unix_ms, event, text, .. }) => {
            assert_eq!((unix_ms, event.as_str()), (all[index].came / 1_000_000, "mqtt"));
            text
        }
        other => panic!("{other:?}"),
    };
    assert_eq!(shown(0), "received uagv/order, retained: {\"orderId\":\"o1\"}");
    assert_eq!(shown(1), format!("sent uagv/state: {}…", "ü".repeat(200)));
    assert_eq!(shown(2), "sent uagv/state: ff00");
    // A file of another program.
    let foreign = super::reading::Message { topic: "/mqtt/x".into(), came: 0, body: b"[1]".to_vec() };
    assert!(event_of(&foreign).is_none());
}

#[test]
fn where_the_keys_are_is_not_recorded() {
    let unit = serde_json::json!({
        "answer": "unit", "name": "depot", "id": 1, "role": "m_unit", "fleet": 0, "version": 2,
        "discovery_port": 1, "tcp_port": 1, "epoch": "1", "uptime_ms": 1, "interfaces": [], "connected": 0,
        "keys": { "file": "/etc/cara/secret.keys", "generations": [1] },
        "constraints": {
            "request_timeout_us": 1, "minimum_interval_us": 1, "maximum_nodes": 1, "message_size": 1, "chunk_size": 1,
            "keep_alive_us": 1, "calls_per_peer": 1,
        },
    });
    let unit: Answer = serde_json::from_value(unit).unwrap();
    let Answer::Unit(info) = &unit else { panic!("{unit:?}") };
    assert!(matches!(&info.keys, Some(KeysInfo { file: Some(_), .. })));
    let message = super::layout::message(&unit, 7).unwrap();
    assert_eq!(message.body["keys"], serde_json::json!({ "generations": [1] }));
}
