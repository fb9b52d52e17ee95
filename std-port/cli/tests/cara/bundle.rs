//! `cara support-bundle` and `cara black-box`, where something is missing, secret or full.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use cara_recording::Ring;
use cara_std::control::protocol::Answer;
use serde_json::Value;
use tempfile::TempDir;

use crate::support::{PATIENCE, Ran, Stage};

/// A folder with files, and a stage without nodes.
struct Host {
    folder: TempDir,
    stage: Stage,
}

impl Host {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap(), stage: Stage::empty() }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn put(&self, name: &str, text: impl AsRef<[u8]>) {
        let path = self.path(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    /// The command that writes `bundle.tar`, started in the folder.
    fn command(&self, arguments: &[&str]) -> Command {
        let mut command =
            self.stage.command(&[&["support-bundle", "bundle.tar", "--listen", "1ms"], arguments].concat());
        command.current_dir(self.folder.path());
        command
    }

    /// The members of a new `bundle.tar`, which the command writes with code 0.
    #[track_caller]
    fn bundle(&self, arguments: &[&str]) -> BTreeMap<String, String> {
        self.members(self.command(arguments))
    }

    #[track_caller]
    fn members(&self, mut command: Command) -> BTreeMap<String, String> {
        let ran = Ran::of(command.output().unwrap());
        assert_eq!(ran.code, 0, "{}", ran.everything());
        let archive = fs::read(self.path("bundle.tar")).unwrap();
        fs::remove_file(self.path("bundle.tar")).unwrap();
        members(&archive)
    }
}

/// The members of an archive, which is whole.
fn members(mut archive: &[u8]) -> BTreeMap<String, String> {
    let mut found = BTreeMap::new();
    while archive[0] != 0 {
        let (header, rest) = archive.split_at(512);
        let size = std::str::from_utf8(&header[124..135]).unwrap();
        let size = usize::from_str_radix(size, 8).unwrap();
        let name = String::from_utf8_lossy(&header[..100]).trim_end_matches('\0').to_owned();
        found.insert(name, String::from_utf8_lossy(&rest[..size]).into_owned());
        archive = &rest[size.next_multiple_of(512)..];
    }
    assert_eq!(archive, [0; 1024]);
    found
}

/// What `about.json` says under a key.
#[track_caller]
fn about(members: &BTreeMap<String, String>, key: &str) -> Value {
    serde_json::from_str::<Value>(&members["about.json"]).unwrap()[key].clone()
}

#[test]
fn what_cannot_be_read_is_missing_in_a_bundle_with_its_reason() {
    let host = Host::new();
    host.put("file", "");
    host.put("state/black-box", "");
    host.put("damaged/black-box/1.mcap", "no box");
    for (state, names, reason) in [
        ("/nonexist", ["black_boxes", "recordings in /nonexist", "audit.jsonl"], "No such file"),
        ("file", ["black_boxes", "recordings in file", "audit.jsonl"], "Not a directory"),
    ] {
        let missing = about(&host.bundle(&["--state", state]), "missing");
        for name in names {
            assert!(missing[name].as_str().is_some_and(|why| why.contains(reason)), "{name}: {missing}");
        }
    }
    let missing = about(&host.bundle(&["--state", "state"]), "missing");
    assert!(missing["black_boxes"].as_str().unwrap().contains("Not a directory"), "{missing}");
    let missing = about(&host.bundle(&["--state", "damaged"]), "missing");
    assert!(missing["black-box/1.mcap"].is_string(), "{missing}");
}

/// A limit of the system for the size of files stands for a disk that is full.
#[test]
fn a_bundle_that_the_disk_does_not_take_is_removed_and_the_error_says_why() {
    let host = Host::new();
    let inner = host.command(&[]);
    let mut command = Command::new("sh");
    command.args(["-c", "trap '' XFSZ; ulimit -S -f 1; exec \"$0\" \"$@\""]).arg(inner.get_program());
    command.args(inner.get_args()).current_dir(host.folder.path());
    command.envs(inner.get_envs().filter_map(|(name, value)| Some((name, value?))));
    let ran = Ran::of(command.output().unwrap());
    assert_eq!(ran.code, 1, "{}", ran.everything());
    assert!(ran.err.contains("File too large") && ran.err.contains("is removed"), "{}", ran.err);
    assert!(!host.path("bundle.tar").exists());
    host.bundle(&[]);
    // What was there before is not touched.
    host.put("bundle.tar", "mine");
    assert_eq!(Ran::of(host.command(&[]).output().unwrap()).code, 1);
    assert_eq!(fs::read(host.path("bundle.tar")).unwrap(), b"mine");
}

/// A black box that is intact, and has this text.
fn write_box(file: &Path, text: &str) {
    let event =
        |text: &str| Answer::Event { at_ms: 1, unix_ms: 1, event: "log".to_owned(), node: None, text: text.to_owned() };
    fs::create_dir_all(file.parent().unwrap()).unwrap();
    let about = [("unit", "agv/7"), ("cause", "stop"), ("unix_ms", "1")];
    let about = about.map(|(key, value)| (key.to_owned(), value.to_owned())).into();
    cara_recording::write(file, about, &[Ring::line(&event(text)).unwrap()]).unwrap();
}

#[test]
fn a_secret_gets_into_no_bundle_in_another_form() {
    let host = Host::new();
    let token = "pass\"w\\ord \u{7f}of mine";
    let key = "0a1b2c3d4e5f60718293a4b5c6d7e8f90a1b2c3d4e5f60718293a4b5c6d7e8f9";
    let as_base64 = ["ChssPU5fYHGCk6S1xtfo+QobLD1OX2BxgpOktcbX6Pk=", "ChssPU5fYHGCk6S1xtfo-QobLD1OX2BxgpOktcbX6Pk"];
    // With a byte before the key.
    let later = "/wobLD1OX2BxgpOktcbX6PkKGyw9Tl9gcYKTpLXG1+j5";
    host.put("state/a.keys", format!("pair {key}\n"));
    host.put("state/page.token", "see lobby NoHexOfAPageToken99\n");
    let quoted = serde_json::to_string(token).unwrap();
    let upper = key.to_ascii_uppercase();
    let forms = [token, &quoted, &upper, as_base64[0], as_base64[1], later, "NoHexOfAPageToken99", "second-line"];
    let lines: Vec<_> = forms.iter().map(|form| format!("a: {form}\n")).collect();
    host.put("log", lines.concat());
    // A box has the text of an event as JSON, in which JSON may be.
    let arguments = format!("called {}", serde_json::json!({ "text": token }));
    for (number, text) in [token, &arguments, &upper, as_base64[0], "harmless"].iter().enumerate() {
        write_box(&host.path(&format!("state/black-box/{number}.mcap")), text);
    }
    let mut command = host.command(&["--state", "state", "--log", "log"]);
    command.env("SMTP_PASSWORD", token).env("MY_SECRET", "first-line\nsecond-line\n");
    let members = host.members(command);
    assert_eq!(members["log.txt"], "(left out: it holds a secret)\n".repeat(forms.len()));
    let boxes: Vec<_> = members.iter().filter(|(name, _)| name.starts_with("black-box-")).collect();
    assert!(boxes.len() == 1 && boxes[0].1.contains("harmless"), "{boxes:?}");
    let missing = about(&members, "missing");
    assert_eq!(missing["black-box/0.mcap"], "it holds a secret", "{missing}");
}

#[test]
fn of_a_configuration_known_members_alone_get_into_a_bundle() {
    let host = Host::new();
    let config = r#"
name = "plant"
id = "7"
token = "secret-1"
interfaces = { token = "secret-2" }
metrics = "harmless"
[broker]
password = "secret-3"
[control]
operators = { daemon = "see" }
password = "secret-4"
[log]
level = { of = "secret-5" }
[[functions]]
signature = "f()"
secret = "secret-6"
run = "curl -H secret-7"
at_lease_end = ["sh -c secret-8", "secret-9"]
[[functions]]
run = [["curl", "secret-10"]]
answer = "echo"
at_lease_end = ["true"]
"#;
    host.put("plant.toml", config);
    let members = host.bundle(&["--config", "plant.toml"]);
    let text = &members["configuration.toml"];
    assert!(!members.values().any(|text| text.contains("secret-")), "{members:?}");
    let missing = about(&members, "missing");
    let missing = missing["configuration"].as_str().unwrap();
    for name in ["token", "interfaces", "broker", "control.password", "log.level", "functions.secret"] {
        assert!(missing.contains(name), "{name}: {missing}");
    }
    let kept = [
        "name = \"plant\"",
        "id = \"7\"",
        "metrics = \"harmless\"",
        "daemon = \"see\"",
        "signature = \"f()\"",
        "at_lease_end = [\"sh\", \"…\"]",
        "run = [\"…\"]",
        "answer = \"echo\"",
        "at_lease_end = [\"true\"]",
    ];
    for part in kept {
        assert!(text.contains(part), "{part}: {text}");
    }
    assert_eq!(text.matches("run = [\"…\"]").count(), 2, "{text}");
    // Of the file with every key nothing is left out.
    host.put("example.toml", host.stage.ends(0, &["node", "--example"]).out);
    let members = host.bundle(&["--config", "example.toml"]);
    assert!(about(&members, "missing")["configuration"].is_null(), "{members:?}");
    assert!(members["configuration.toml"].contains("[black_box]"), "{members:?}");
}

#[test]
fn the_keys_that_a_configuration_or_an_option_names_get_into_no_bundle() {
    let host = Host::new();
    let keys = [1, 2, 3].map(|number| format!("{number:02x}5ec7e7").repeat(8));
    host.put("elsewhere/own", format!("pair {}\n", keys[0]));
    host.put("option", format!("pair {}\n", keys[1]));
    host.put("variable", format!("pair {}\n", keys[2]));
    host.put("elsewhere/plant.toml", "keys = \"own\"\n");
    host.put("log", keys.join("\n") + "\n");
    let mut command = host.command(&["--config", "elsewhere/plant.toml", "--log", "log", "--key-file", "option"]);
    command.env("CARA_KEYS", host.path("variable"));
    let members = host.members(command);
    assert_eq!(members["log.txt"], "(left out: it holds a secret)\n".repeat(3));
    // Keys that cannot be read cannot be looked for.
    host.put("elsewhere/plant.toml", "keys = \"/nonexist/keys\"\n");
    let missing = about(&host.bundle(&["--config", "elsewhere/plant.toml"]), "missing");
    assert!(missing["secrets of /nonexist/keys"].as_str().unwrap().contains("not looked for"), "{missing}");
}

#[test]
fn recordings_are_found_in_every_folder_that_help_names() {
    let host = Host::new();
    host.stage
        .ends(0, &["support-bundle", "--help"])
        .says("in the folder of state, in /var/log/cara and in the current one");
    host.put("here.mcap", "");
    host.put("state/there.mcap.1", "");
    let all = |members| {
        let named = about(&members, "recordings");
        let named: Vec<_> = named.as_array().unwrap().iter().map(|name| name.as_str().unwrap().to_owned()).collect();
        let (of_service, others): (Vec<_>, Vec<_>) = named.into_iter().partition(|name| name.starts_with("/var/"));
        (others, of_service)
    };
    assert_eq!(all(host.bundle(&[])).0, ["./here.mcap"]);
    assert_eq!(all(host.bundle(&["--state", "state"])).0, ["state/there.mcap.1", "./here.mcap"]);
    // In a /var/log of its own.
    let unshare = |script: &str| {
        let mut command = Command::new("unshare");
        command.args(["-rm", "sh", "-c", &format!("mount -t tmpfs none /var/log && {script}")]);
        command
    };
    if !unshare("true").output().is_ok_and(|ran| ran.status.success()) {
        return println!("not looked for in /var/log/cara: no namespace for mounts here");
    }
    let inner = host.command(&[]);
    let mut command = unshare(
        "mkdir /var/log/cara && touch /var/log/cara/plant.mcap /var/log/cara/plant.mcap.1 && exec \"$0\" \"$@\"",
    );
    command.arg(inner.get_program()).args(inner.get_args()).current_dir(host.folder.path());
    command.envs(inner.get_envs().filter_map(|(name, value)| Some((name, value?))));
    let (_, mut of_service) = all(host.members(command));
    of_service.sort();
    assert_eq!(of_service, ["/var/log/cara/plant.mcap", "/var/log/cara/plant.mcap.1"]);
}

#[test]
fn a_node_without_black_boxes_is_told_which_nodes_have_some() {
    let host = Host::new();
    write_box(&host.path("state/black-box/1.mcap"), "harmless");

    let state = host.path("state").to_str().unwrap().to_owned();
    host.stage.ends(1, &["black-box", "--state", &state, "nobody"]).says("nobody").says("agv/7");
    host.stage.ends(1, &["black-box", "--state", &state, "agv/8", "--json"]).says("agv/7");
    host.stage.ends(0, &["black-box", "--state", &state, "agv"]).says("agv/7");
    fs::remove_file(host.path("state/black-box/1.mcap")).unwrap();
    host.stage.ends(0, &["black-box", "--state", &state, "nobody"]).says("has no black box");
}

#[test]
fn a_log_that_has_no_lines_to_take_is_missing_in_a_bundle() {
    let host = Host::new();
    host.put("log", format!("first\n{}\n", "x".repeat(300 << 10)));
    let members = host.bundle(&["--log", "log"]);
    assert!(!members.contains_key("log.txt"));
    assert!(about(&members, "missing")["log.txt"].as_str().unwrap().contains("no whole line"), "{members:?}");
    host.put("log", format!("{}\nlast\n", "x".repeat(300 << 10)));
    assert_eq!(host.bundle(&["--log", "log"])["log.txt"], "last\n");
    host.put("log", "whole\nand a part");
    assert_eq!(host.bundle(&["--log", "log"])["log.txt"], "whole\n");
    host.put("log", "");
    assert_eq!(host.bundle(&["--log", "log"])["log.txt"], "");
    rustix::fs::mkfifoat(rustix::fs::CWD, host.path("fifo"), rustix::fs::Mode::RWXU).unwrap();
    let mut waits = host.command(&["--log", "fifo"]).spawn().unwrap();
    let start = std::time::Instant::now();
    while waits.try_wait().unwrap().is_none() {
        if start.elapsed() > PATIENCE {
            waits.kill().unwrap();
            panic!("it waits for a pipe");
        }
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    let members = self::members(&fs::read(host.path("bundle.tar")).unwrap());
    assert!(about(&members, "missing")["log.txt"].as_str().unwrap().contains("no file"), "{members:?}");
}
