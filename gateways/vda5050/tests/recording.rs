//! What goes over MQTT is recorded, and a full disk costs the recording alone. With mosquitto: `cargo xtask test vda5050`.

mod fake;
mod plant;

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use cara_recording::Reading;
use plant::{Plant, Process, until};
use rustix::process::Signal;
use serde_json::Value;

/// A plant whose gateway is to record, and the file. The gateway does not run.
fn plant() -> (Plant, PathBuf) {
    let mut plant = Plant::start("{ do = \"stop\" }");
    plant.kill_gateway();
    plant.heard.lock().unwrap().clear();
    let mut file = std::fs::OpenOptions::new().append(true).open(plant.file()).unwrap();
    file.write_all(b"\n[recording]\nfile = \"mqtt.mcap\"\n").unwrap();
    let recorded = plant.folder.path().join("mqtt.mcap");
    (plant, recorded)
}

/// The messages of MQTT that can be read at this moment.
fn messages(file: &Path) -> Vec<Value> {
    let Ok(reading) = Reading::open(file) else { return Vec::new() };
    let of_mqtt = reading.filter(|message| message.topic.starts_with("/mqtt/uagv/v2/KIT/0001/"));
    of_mqtt.map(|message| serde_json::from_slice(&message.body).unwrap()).collect()
}

fn has(all: &[Value], direction: &str, topic: &str, part: &str) -> bool {
    let fits = |message: &Value| {
        message["direction"] == direction
            && message["topic"] == format!("uagv/v2/KIT/0001/{topic}")
            && message["payload"].as_str().is_some_and(|payload| payload.contains(part))
    };
    all.iter().any(fits)
}

#[test]
fn both_directions_are_recorded_and_the_file_ends_with_the_gateway() {
    let (mut plant, file) = plant();
    plant.start_gateway();
    until("the recording is there", || file.exists());
    plant.wait_for("the vehicle is online", |plant| plant.connection() == "ONLINE");
    plant.order("o1", 0, 0, "a! b!");
    plant.wait_for_end("o1", "b");
    until("all is written down", || {
        let all = messages(&file);
        has(&all, "received", "order", "\"orderId\":\"o1\"")
            && has(&all, "sent", "connection", "ONLINE")
            && has(&all, "sent", "state", "\"lastNodeId\":\"b\"")
    });
    let mut gateway = plant.gateway.take().unwrap();
    gateway.signal(Signal::TERM);
    assert!(gateway.child.wait().unwrap().success());
    let all = messages(&file);
    assert!(has(&all, "sent", "connection", "OFFLINE"), "{all:?}");
    assert!(!all.iter().any(|message| message["topic"].as_str().unwrap().ends_with("cara-probe")));
    let mut reading = Reading::open(&file).unwrap();
    let ended = reading.by_ref().filter(|message| message.topic == "/recording").count();
    assert_eq!((ended, reading.about()["unit"].as_str()), (1, "vda5050/1"));
    // As `cargo xtask test recordings` has it.
    match std::env::var_os("CARA_TEST_PYTHON") {
        Some(python) => {
            let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../std-port/cli/tests/recording.py");
            let ran = Command::new(python).arg(script).arg(&file).output().unwrap();
            assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
            println!("{}", String::from_utf8_lossy(&ran.stdout));
        }
        None => println!("not read by mcap of PyPI: CARA_TEST_PYTHON names no python with mcap and jsonschema"),
    }
}

/// A limit of the system for the size of files stands for a disk that is full.
#[test]
fn a_full_disk_costs_the_recording_alone() {
    const MOST: u64 = 16 * 1024;
    let (mut plant, file) = plant();
    let mut command = Command::new("sh");
    // A process that does not ignore the signal ends with it.
    command.args(["-c", "trap '' XFSZ; ulimit -f 32; exec \"$0\" \"$@\""]).arg(env!("CARGO_BIN_EXE_cara-vda5050"));
    command.arg(plant.file()).env("CARA_KEYS", plant.folder.path().join("keys"));
    command.env("XDG_RUNTIME_DIR", plant.folder.path());
    let gateway = Process::start(&mut command);
    gateway.wait_for("up with");
    plant.gateway = Some(gateway);
    plant.wait_for("the vehicle is online", |plant| plant.connection() == "ONLINE");
    let size = || std::fs::metadata(&file).map_or(0, |found| found.len());
    for number in 0..8 {
        plant.publish("instantActions", false, &format!("{number}{}", "x".repeat(4_000)));
    }
    until("the disk is full", || size() >= MOST);
    plant.order("o1", 0, 0, "a! b!");
    plant.wait_for_end("o1", "b");
    assert_eq!(size(), MOST);
}
