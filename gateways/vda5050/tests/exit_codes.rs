//! With which code the gateway ends when it does not start. Its unit of systemd tries again after 1, and not after 2.

use std::path::Path;
use std::process::Command;

/// Runs it with the example's file, of which a piece is replaced, where there are no keys.
fn code(from: &str, to: &str) -> Option<i32> {
    let folder = tempfile::tempdir().unwrap();
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("example.toml");
    let text = std::fs::read_to_string(example).unwrap();
    assert!(text.contains(from), "{from}");
    let file = folder.path().join("gateway.toml");
    std::fs::write(&file, text.replace(from, to)).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_cara-vda5050"));
    command.arg(&file).env("CARA_KEYS", folder.path().join("keys"));
    command.output().unwrap().status.code()
}

#[test]
fn a_mistake_ends_with_2_and_what_may_change_with_1() {
    assert_eq!(code("keep_alive = 15", "keep_alive = 1"), Some(2));
    assert_eq!(code("# key_file = \"vda5050.key\"", "key_file = \"absent.key\""), Some(2));
    assert_eq!(code("state_folder = \"state\"", "state_folder = \"gateway.toml/state\""), Some(2));
    // Keys that the file does not name may come.
    assert_eq!(code("fleet = 42", "fleet = 42"), Some(1));
}
