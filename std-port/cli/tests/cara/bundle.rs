//! `cara support-bundle` and `cara black-box`, where something is missing, secret or full.

use std::collections::BTreeMap;
use std::fs;
use std::path::PathBuf;
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

use crate::support::{Ran, Stage};

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
