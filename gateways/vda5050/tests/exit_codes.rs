//! With which code the gateway ends when it does not start. Its unit of systemd tries again after 1, and not after 2.

mod fake;
mod plant;

use std::io::Read;
use std::path::Path;
use std::process::{Command, Stdio};

use plant::{Process, free_port, keys, until};
use rustix::process::getuid;

/// A user that nobody else is: a limit of its threads is the gateway's alone, and for root there is none.
const USER: &str = "54321";

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

/// On a host that starts no more threads, however many there are, the program ends with 1 and says why, and no vehicle is left
/// without a part of it.
#[test]
fn a_thread_that_cannot_be_started_ends_the_program() {
    if !getuid().is_root() {
        eprintln!("skipped: only root can give the gateway a user of its own");
        return;
    }
    let (folder, fleet) = (tempfile::tempdir().unwrap(), 5_040_000 + std::process::id() % 10_000);
    let [program, file] = ["gateway", "vda5050.toml"].map(|name| folder.path().join(name));
    keys(folder.path(), fleet, 3);
    let example = Path::new(env!("CARGO_MANIFEST_DIR"));
    std::fs::copy(example.join("example-factsheet.json"), folder.path().join("example-factsheet.json")).unwrap();
    let text = std::fs::read_to_string(example.join("example.toml")).unwrap();
    let text = text.replace("fleet = 42", &format!("fleet = {fleet}")).replace("port = 1883", "port = 1");
    let text = text.replace("# metrics = \"127.0.0.1:9465\"", &format!("metrics = \"127.0.0.1:{}\"", free_port()));
    let more = (2..=3).map(|number| {
        format!("\n[[vehicle]]\nname = \"agv-{number}\"\nid = {}\nserial_number = \"{number}\"\n", 100 + number)
    });
    std::fs::write(&file, text + &more.collect::<String>()).unwrap();
    // Where this user can reach it.
    std::fs::copy(env!("CARGO_BIN_EXE_cara-vda5050"), &program).unwrap();
    assert!(Command::new("chown").args(["-R", USER]).arg(folder.path()).status().unwrap().success());
    let mut told = Vec::new();
    let enough = (1..100).find(|threads| {
        let mut command = Command::new("setpriv");
        command.args(["--reuid", USER, "--regid", USER, "--clear-groups", "prlimit", &format!("--nproc={threads}")]);
        command.arg(&program).arg(&file).env("CARA_KEYS", folder.path().join("keys"));
        command.env("XDG_RUNTIME_DIR", folder.path()).stderr(Stdio::piped());
        let mut gateway = Process::start(&mut command);
        let (lines, mut status) = (gateway.lines.clone(), None);
        until("it is up, or ends", || {
            status = gateway.child.try_wait().unwrap();
            status.is_some() || lines.lock().unwrap().iter().any(|(_, line)| line.starts_with("up with"))
        });
        let Some(status) = status else { return true };
        let mut error = String::new();
        gateway.child.stderr.take().unwrap().read_to_string(&mut error).unwrap();
        assert_eq!(status.code(), Some(1), "{threads}: {error}");
        told.push(error);
        false
    });
    assert!(enough.is_some(), "{told:#?}");
    // Those of the unit and of signals say it in words of their own.
    for thread in ["metrics", "the log", "looks at certificates", "the thread of vehicle"] {
        let is_named = |error: &String| error.contains(thread) && error.contains("Resource temporarily unavailable");
        assert!(told.iter().any(is_named), "{thread}: {told:#?}");
    }
}
