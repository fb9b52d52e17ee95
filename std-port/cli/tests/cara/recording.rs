//! `cara record` and `cara replay`.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use cara_std::{Definition, Duration, Parameters};
use rustix::process::{Pid, Resource, Rlimit, prlimit};
use serde_json::Value;

use crate::support::{PATIENCE, Running, Stage, until};
use crate::terminal::OnTerminal;

/// A line of the log of `agv-1`.
const LOGGED: &str = "agv-1 has drawn its map";

/// An AGV that streams its log as well.
fn stage() -> (Stage, cara_std::Unit, cara_std::Stream) {
    let (stage, agv, pose) = crate::streaming::stage();
    let mut log = cara_std::Log::default();
    agv.my_function_list().add_log(&log).unwrap();
    agv.publish_my_function_list().unwrap();
    log.write_all(format!("{LOGGED}\n").as_bytes()).unwrap();
    (stage, agv, pose)
}

/// The channels of a file that is written at this moment.
fn topics(file: &Path) -> BTreeSet<String> {
    let Ok(file) = File::open(file) else { return BTreeSet::new() };
    let messages = mcap::io::MessageReader::new(file).map_while(Result::ok);
    messages.map(|message| message.channel.topic.clone()).collect()
}

/// The messages of a channel of such a file.
fn messages(file: &Path, topic: &str) -> Vec<Value> {
    let messages = mcap::io::MessageReader::new(File::open(file).unwrap()).map_while(Result::ok);
    let its = messages.filter(|message| message.channel.topic == topic);
    its.map(|message| serde_json::from_slice(&message.data).unwrap()).collect()
}

/// How many messages a recording says to be lost.
fn losses(file: &Path) -> u64 {
    let messages = mcap::io::MessageReader::new(File::open(file).unwrap()).map_while(Result::ok);
    let own = messages.filter(|message| message.channel.topic == "/recording");
    own.filter_map(|message| serde_json::from_slice::<Value>(&message.data).ok()?["lost"].as_u64()).sum()
}

/// Records until something of every kind can be read. One recording is ended, and one is killed.
fn record(stage: &mut Stage, file: &Path, killed: &Path) {
    let record = |file: &Path| {
        let more = ["record", file.to_str().unwrap(), "--stream", "pose", "--stream", "log", "--every", "20ms"];
        let mut recording = Running::start(stage.command(&more));
        recording.expect("recording manager/1");
        recording
    };
    let (mut recording, mut to_kill) = (record(file), record(killed));
    let of_look = |topics: &BTreeSet<String>| topics.contains("/nodes") && topics.contains("/events");
    until("both watch", || of_look(&topics(file)) && of_look(&topics(killed)));
    stage.ends(0, &["set", ".", "request_timeout", "19s"]);
    stage.start_agv("late-1", 12);
    let all = ["/commands", "/counters", "/events", "/functions", "/nodes", "/streams/agv-1/11/pose", "/unit"];
    let all: BTreeSet<_> = all.map(str::to_owned).into();
    let has_all = |file: &Path| {
        let shown = stage.cara(&["replay", file.to_str().unwrap()]).out;
        topics(file) == all
            && ["joined            late-1/12", LOGGED, "log               manager/1"]
                .iter()
                .all(|part| shown.contains(part))
    };
    until("all is written down", || has_all(file) && has_all(killed));
    to_kill.kill();
    recording.interrupt();
    recording.expect("messages recorded, 0 lost");
    assert_eq!(recording.end(), 0);
}

#[test]
fn what_a_manager_reports_is_recorded_and_a_recorder_that_is_killed_leaves_a_file_to_read() {
    let (mut stage, agv, _pose) = stage();
    let folder = tempfile::tempdir().unwrap();
    let (file, killed) = (folder.path().join("a.mcap"), folder.path().join("killed.mcap"));
    record(&mut stage, &file, &killed);
    let whole = stage.ends(0, &["replay", file.to_str().unwrap(), "--json"]);
    let lines = whole.lines();
    let joined: Vec<_> = lines.iter().filter(|event| event["event"] == "joined").collect();
    assert!(joined.len() == 1 && joined[0]["node"] == "late-1/12" && joined[0]["unix_ms"].is_u64(), "{}", whole.out);
    assert!(whole.err.is_empty() && lines.iter().any(|event| event["event"] == "watching"), "{}", whole.everything());
    stage
        .ends(0, &["replay", killed.to_str().unwrap()])
        .says("Z  joined            late-1/12")
        .says("was cut off here");
    let mut bytes = std::fs::read(&file).unwrap();
    let joined = bytes.windows(9).position(|part| part == b"late-1/12").unwrap();
    bytes[joined] ^= 1;
    let damaged = folder.path().join("damaged.mcap");
    std::fs::write(&damaged, bytes).unwrap();
    stage
        .ends(1, &["replay", damaged.to_str().unwrap(), killed.to_str().unwrap()])
        .says("Z  watching")
        .says("damaged.mcap is damaged: parts that are left out: 1")
        .says("Z  joined            late-1/12")
        .says("not all could be read of");
    stage.ends(2, &["record", killed.to_str().unwrap(), "--max-size", "1kB"]);
    for often in ["0s", "1us"] {
        stage.ends(2, &["record", killed.to_str().unwrap(), "--for", "1ms", "--every", often]).says("at least 10 ms");
    }
    assert!(whole.out.contains("request_timeout") && whole.out.contains(": ok"), "{}", whole.out);
    let socket = folder.path().join("replay.sock");
    let (file, socket) = (file.to_str().unwrap(), socket.to_str().unwrap());
    let _replaying = Running::start(stage.command(&["replay", file, "--serve", socket, "--speed", "1000"]));
    until("the recording answers", || stage.cara(&["scan", "--socket", socket, "--json"]).out.contains("late-1"));
    until("its functions are shown", || stage.cara(&["functions", "agv-1", "--socket", socket]).out.contains("pose"));
    stage.ends(2, &["stop", "--all", "--socket", socket]).says("this is a recording");
    stage.ends(1, &["replay", folder.path().join("none").to_str().unwrap()]);
    agv.stop();
}

/// A recording that answers at `socket`, with its manager and vehicles gone.
fn replaying(speed: &str) -> (Stage, tempfile::TempDir, Running, String) {
    let (mut stage, agv, _pose) = stage();
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (file, socket) = (path("a.mcap"), path("replay.sock"));
    record(&mut stage, Path::new(&file), Path::new(&path("killed.mcap")));
    agv.stop();
    stage.stop_agvs();
    stage.kill_manager();
    let replaying = Running::start(stage.command(&["replay", &file, "--serve", &socket, "--speed", speed]));
    until("the recording answers", || stage.cara(&["scan", "--socket", &socket]).code == 0);
    (stage, folder, replaying, socket)
}

#[test]
fn top_shows_a_recording_at_any_speed() {
    for speed in ["0.9", "1000"] {
        let (stage, _folder, _replaying, socket) = replaying(speed);
        let mut command = stage.command(&["top", "--socket", &socket]);
        command.env("TERM", "xterm-256color");
        let mut top = OnTerminal::start(&command);
        let is_live = |shown: &str, node| shown.lines().any(|line| line.contains(node) && line.contains(" live "));
        top.until(&format!("both at speed {speed}"), |shown| {
            shown.contains("cara top  manager/1") && is_live(shown, "agv-1/11") && is_live(shown, "late-1/12")
        });
        top.type_in("q");
        assert_eq!(top.ends_restored(), 0);
    }
}

#[test]
fn the_page_shows_a_recording_at_any_speed() {
    for speed in ["0.9", "1000"] {
        let (stage, _folder, _replaying, socket) = replaying(speed);
        // Its nodes, and a stream with its value.
        let wanted = ["\"agv-1/11@s_unit\":{", "\"late-1/12@s_unit\":{", "pose() -> (x: int)", "[[\"x\",[\"7\"]]"];
        page_shows(&stage, &["--socket", &socket], &wanted);
    }
}

/// Waits until a page was told all of these.
fn page_shows(stage: &Stage, more: &[&str], wanted: &[&str]) {
    let mut web = Running::start(stage.command(&[&["web", "--listen", "127.0.0.1:0"], more].concat()));
    let line = web.expect("the page is at ");
    let (address, key) = line.rsplit_once("http://").unwrap().1.split_once("/#").unwrap();
    let mut page = TcpStream::connect(address).unwrap();
    page.set_read_timeout(Some(PATIENCE)).unwrap();
    write!(page, "GET /api/stream HTTP/1.1\r\nhost: {address}\r\nauthorization: Bearer {key}\r\n\r\n").unwrap();
    let (mut told, mut piece, start) = (Vec::new(), [0; 4096], Instant::now());
    while !wanted.iter().all(|part| String::from_utf8_lossy(&told).contains(part)) {
        let read = page.read(&mut piece).unwrap_or_default();
        assert!(read > 0 && start.elapsed() < PATIENCE, "{more:?}: only {}", String::from_utf8_lossy(&told));
        told.extend_from_slice(&piece[..read]);
    }
}

/// A vehicle that logs as boards do.
fn board(stage: &Stage) -> (cara_std::Unit, cara_std::Stream) {
    let board = stage.vehicle("late-1", 12).build().unwrap();
    let definition = Definition::stream("log(at: int, build: int, piece: bytes[256])").unwrap();
    let log = board.my_function_list().add_stream(&definition, Duration::from_millis(50)).unwrap();
    let mut piece = Parameters::new();
    for (name, value) in [("at", 0), ("build", 0x0bad_cafe)] {
        piece.add_int(name, 1).unwrap();
        piece.set_value(name, value).unwrap();
    }
    piece.add_bytes("piece", 256).unwrap();
    piece.set_value("piece", &b"\x01\x02\x03\x00"[..]).unwrap();
    log.publish(&piece).unwrap();
    board.publish_my_function_list().unwrap();
    board.start().unwrap();
    (board, log)
}

#[test]
fn a_board_s_log_without_its_firmware_stays_bytes_and_the_missing_build_id_is_said() {
    let (stage, agv, _pose) = stage();
    let (board, _log) = board(&stage);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.mcap");
    let mut recording = Running::start(stage.command(&["record", file.to_str().unwrap(), "--stream", "log"]));
    recording.expect("recording manager/1");
    until("its bytes are recorded", || topics(&file).contains("/streams/late-1/12/log"));
    let said = stage.ends(0, &["replay", file.to_str().unwrap()]);
    said.says("no_firmware       late-1/12").says("whose build id is 000000000badcafe");
    let bytes = messages(&file, "/streams/late-1/12/log");
    assert_eq!(bytes[0]["values"]["piece"], "01020300", "{bytes:?}");
    let build = "[\"build\",\"000000000badcafe\",true],[\"piece\",\"4 bytes, whose firmware is not known\",true]";
    page_shows(&stage, &[], &[build, "no_firmware", "\"manager/1\":[[", LOGGED]);
    agv.stop();
    board.stop();
}

#[test]
fn a_stream_that_is_replaced_while_its_vehicle_stays_is_in_the_recording() {
    let (stage, agv, _pose) = stage();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.mcap");
    let mut recording = Running::start(stage.command(&["record", file.to_str().unwrap()]));
    recording.expect("recording manager/1");
    let has = |signature: &str| messages(&file, "/functions").iter().any(|told| told.to_string().contains(signature));
    until("the old one is there", || has("battery() -> (percent: float)"));
    agv.my_function_list().remove("battery").unwrap();
    agv.my_function_list().add_stream(&Definition::stream("battery(volts: float)").unwrap(), Duration::ZERO).unwrap();
    agv.publish_my_function_list().unwrap();
    until("the new one is there", || has("battery() -> (volts: float)"));
    agv.stop();
}

/// A limit of the system for the size of files stands for a disk that is full, and later has space again.
#[test]
fn a_full_disk_costs_messages_that_are_counted_and_the_recording_goes_on() {
    let stage = Stage::with(&[]);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.mcap");
    let inner = stage.command(&["record", file.to_str().unwrap(), "--every", "10ms"]);
    let mut command = Command::new("sh");
    // A process that does not ignore the signal ends with it.
    command
        .args(["-c", "trap '' XFSZ; ulimit -S -f 32; exec \"$0\" \"$@\" 2>&1"])
        .arg(inner.get_program())
        .args(inner.get_args());
    inner.get_envs().for_each(|(name, value)| {
        value.map(|value| command.env(name, value));
    });
    let mut recording = Running::start(command);
    recording.expect("recording manager/1");
    let size = || std::fs::metadata(&file).unwrap().len();
    until("the disk is full", || size() >= 16 * 1024);
    let full = size();
    recording.expect("messages are lost until now");
    assert_eq!(size(), full);
    let pid = Pid::from_raw(recording.id() as i32).unwrap();
    let limit = Rlimit { current: Some(1 << 30), maximum: None };
    prlimit(Some(pid), Resource::Fsize, limit).unwrap();
    until("the losses are written down", || losses(&file) > 0);
    recording.interrupt();
    let line = recording.expect("messages recorded");
    let said: u64 = line.split(' ').nth(3).unwrap().parse().unwrap();
    assert_eq!((recording.end(), losses(&file)), (0, said), "{line}");
    assert!(mcap::Summary::read(&std::fs::read(&file).unwrap()).unwrap().is_some(), "the file is whole");
}

/// As above, but the disk is full from the start.
#[test]
fn a_disk_that_is_full_at_the_start_is_said_and_no_file_is_left() {
    let stage = Stage::with(&[]);
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a.mcap");
    let inner = stage.command(&["record", file.to_str().unwrap()]);
    let mut command = Command::new("sh");
    command
        .args(["-c", "trap '' XFSZ; ulimit -S -f 0; exec \"$0\" \"$@\" 2>&1"])
        .arg(inner.get_program())
        .args(inner.get_args());
    inner.get_envs().for_each(|(name, value)| {
        value.map(|value| command.env(name, value));
    });
    let mut recording = Running::start(command);
    recording.expect("make room, or record to another disk");
    assert_eq!(recording.end(), 1);
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
}

/// With Python's `mcap` and `jsonschema`: `cargo xtask test recordings` installs them.
#[test]
#[ignore = "needs packages of PyPI"]
fn tools_of_pypi_read_a_recording() {
    let python =
        std::env::var_os("CARA_TEST_PYTHON").expect("CARA_TEST_PYTHON names a python with mcap and jsonschema");
    let (mut stage, agv, _pose) = stage();
    let folder = tempfile::tempdir().unwrap();
    let (file, killed) = (folder.path().join("a.mcap"), folder.path().join("killed.mcap"));
    record(&mut stage, &file, &killed);
    let read = |file: &Path| {
        let ran = Command::new(&python).arg("tests/recording.py").arg(file).output().unwrap();
        assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
        serde_json::from_slice::<Value>(&ran.stdout).unwrap()
    };
    let (whole, cut) = (read(&file), read(&killed));
    assert!(whole["summary"].as_bool().unwrap() && !cut["summary"].as_bool().unwrap(), "{whole} {cut}");
    for topic in ["/commands", "/counters", "/events", "/functions", "/nodes", "/streams/agv-1/11/pose", "/unit"] {
        assert!(
            whole["topics"][topic].as_u64() > Some(0) && cut["topics"][topic].as_u64() > Some(0),
            "{topic}: {whole} {cut}"
        );
    }
    assert_eq!((&whole["metadata"]["unit"], &cut["metadata"]["unit"]), (&"manager/1".into(), &"manager/1".into()));
    agv.stop();
}

/// A secret in every file that may have one, and in the environment.
#[test]
fn a_support_bundle_has_no_secret_and_says_what_it_could_not_get() {
    let (folder, keys) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let secret = |number: u8| format!("{number:02x}5ec7e7").repeat(8);
    let put = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    };
    std::fs::write(keys.path().join("agv-7-s_unit-0.keys"), format!("pair {}\n", secret(1))).unwrap();
    put("agv-7-s_unit-0.claims", &secret(2));
    put("page.token", &secret(3));
    put("black-box/no.mcap", &secret(4));
    put("audit.log", &format!("{{\"ask\":\"stop\",\"node\":\"agv/7\",\"more\":\"{}\"}}\n{}\n", secret(5), secret(6)));
    let run = format!("run = [\"curl\", \"{}\"]", secret(7));
    put("plant.toml", &format!("name = \"plant\" # {}\n[[functions]]\nsignature = \"f()\"\n{run}\n", secret(8)));
    put("log", &format!("first\nsays {}\nsays {}\nsays {}\nlast\n", secret(9), secret(1), secret(3)));
    let stage = Stage::empty();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (bundle, config, log, state) = (path("bundle.tar"), path("plant.toml"), path("log"), path(""));
    let arguments = ["--state", &state, "--config", &config, "--log", &log, "--listen", "1ms", "--json"];
    let mut command = stage.command(&[&["support-bundle", &bundle], &arguments[..]].concat());
    command.env("CARA_KEYS", keys.path()).env("SMTP_PASSWORD", secret(9)).env("OTHER", secret(10));
    let ran = crate::support::Ran::of(command.output().unwrap());
    let listed: Vec<_> =
        ran.json()["members"].as_array().unwrap().iter().map(|name| name.as_str().unwrap().to_owned()).collect();
    let members = ["configuration.toml", "doctor.json", "log.txt", "audit.jsonl", "about.json"];
    assert_eq!(listed, members, "{}", ran.everything());
    let archive = std::fs::read(&bundle).unwrap();
    let text = String::from_utf8_lossy(&archive);
    let found: Vec<_> = (1..=10).filter(|number| text.contains(&secret(*number))).collect();
    assert!(found.is_empty(), "{found:?}");
    for part in
        ["first\n(left out", "last\n", "\"ask\":\"stop\"", "run = [\"curl\", \"…\"]", "no m_unit runs on this host"]
    {
        assert!(text.contains(part), "{part} is not in {text}");
    }
    match Command::new("tar").args(["-tf", &bundle]).output() {
        Ok(ran) => assert_eq!(String::from_utf8_lossy(&ran.stdout).lines().collect::<Vec<_>>(), members),
        Err(_) => println!("not read: no tar here"),
    }
    stage.ends(1, &["support-bundle", &bundle, "--listen", "1ms"]);
}
