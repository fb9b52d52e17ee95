//! A whole conversation with fixed keys, as it was committed: what is sealed stays as other implementations expect it.

use std::fmt::Write;
use std::path::PathBuf;

use super::ends::{Ends, key};

/// With this in the environment the file is written instead of compared.
const WRITE: &str = "CARA_WRITE_VECTORS";
const RUN: u8 = 1;

fn path() -> PathBuf {
    PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../vectors/secured.txt"))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().fold(String::new(), |text, byte| text + &format!("{byte:02x}"))
}

fn text() -> String {
    let mut text = String::from(
        "# A manager and a vehicle on a secured link, docs/wire.md section 17; the vehicle has dialled.\n\
         # Who sent it, how, and the bytes. Each end\'s 32 fresh bytes are 01… (manager) and 81… (vehicle).\n",
    );
    let _ = writeln!(text, "key {}", hex(key().expose()));
    let record = Ends::renewing(RUN).record();
    let plain = Ends::recorded(RUN).len();
    for (number, carried) in record.into_iter().enumerate() {
        if number == plain {
            text += "# The vehicle makes the keys anew, with c1… of its own and 41… of the manager, who then calls twice more.\n";
        }
        let from = if carried.to_manager { "vehicle" } else { "manager" };
        let how = if carried.datagram { "datagram" } else { "stream" };
        let _ = writeln!(text, "{from} {how} {}", hex(&carried.bytes));
    }
    text
}

#[test]
fn the_committed_conversation_is_the_one_that_is_held() {
    if std::env::var_os(WRITE).is_some() {
        std::fs::write(path(), text()).expect("the folder is there");
    }
    let committed = std::fs::read_to_string(path()).unwrap_or_default();
    assert!(committed == text(), "the conversation has changed: {WRITE}=1 writes the new one");
}
