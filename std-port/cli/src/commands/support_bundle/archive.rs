//! A tar archive (POSIX.1-1988, ustar) of small files, none of which holds a secret.

use std::fs::File;
use std::io::{self, Write};

use serde_json::Value;

use super::secrets::Secrets;

const BLOCK: usize = 512;
/// The longest member whose size the header has digits for.
const LONGEST: usize = 1 << 33;
/// What stands in place of a line with a secret.
const LEFT_OUT: &str = "(left out: it holds a secret)";

pub(super) struct Archive {
    file: File,
    secrets: Secrets,
    members: Vec<String>,
}

impl Archive {
    pub(super) fn new(file: File, secrets: Secrets) -> Self {
        Self { file, secrets, members: Vec::new() }
    }

    /// Adds a text, without the lines that hold a secret.
    pub(super) fn text(&mut self, name: &str, text: &str) -> io::Result<()> {
        let lines = text.lines().map(|line| if self.secrets.are_in(line.as_bytes()) { LEFT_OUT } else { line });
        let text: String = lines.flat_map(|line| [line, "\n"]).collect();
        self.bytes(name, text.as_bytes()).map(drop)
    }

    pub(super) fn object(&mut self, name: &str, value: &Value) -> io::Result<()> {
        self.text(name, &serde_json::to_string_pretty(value)?)
    }

    /// Adds a member, unless it holds a secret; whether it has.
    pub(super) fn bytes(&mut self, name: &str, bytes: &[u8]) -> io::Result<bool> {
        if self.secrets.are_in(bytes) || bytes.len() >= LONGEST {
            return Ok(false);
        }
        self.file.write_all(&header(name, bytes.len())?)?;
        self.file.write_all(bytes)?;
        self.file.write_all(&vec![0; bytes.len().next_multiple_of(BLOCK) - bytes.len()])?;
        self.members.push(name.to_owned());
        Ok(true)
    }

    /// Ends the archive; the names of its members.
    pub(super) fn end(mut self) -> io::Result<Vec<String>> {
        self.file.write_all(&[0; 2 * BLOCK])?;
        self.file.sync_all()?;
        Ok(self.members)
    }
}

/// Name, mode, owner, group, size, time, checksum, kind, as the format has them.
fn header(name: &str, size: usize) -> io::Result<[u8; BLOCK]> {
    let mut header = [0; BLOCK];
    let fields: [(usize, usize, &str); 9] = [
        (0, 100, name),
        (100, 8, "0000600"),
        (108, 8, "0000000"),
        (116, 8, "0000000"),
        (124, 12, &format!("{size:011o}")),
        (136, 12, "00000000000"),
        // Counted as blanks in the sum itself.
        (148, 8, "        "),
        (156, 1, "0"),
        (257, 8, "ustar\x0000"),
    ];
    for (at, length, text) in fields {
        let text = text.as_bytes();
        let place = header.get_mut(at..at + text.len()).filter(|_| text.len() <= length);
        place.ok_or(io::ErrorKind::InvalidInput)?.copy_from_slice(text);
    }
    let sum: u32 = header.iter().map(|byte| u32::from(*byte)).sum();
    header[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
    Ok(header)
}
