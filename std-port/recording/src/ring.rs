//! The last minutes of a recording, in memory, and a file of them.

use std::collections::{BTreeMap, VecDeque};
use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use cara_std::control::protocol::Answer;
use mcap::McapResult;
use mcap::write::Metadata;

use super::file::{CHUNK, Open, create};
use super::recorder::{came, line_of, message_of};

/// An answer, as the recorder's queue has it.
pub type Line = Arc<[u8]>;

/// What an entry takes beyond its bytes.
const OVERHEAD: u64 = 64;

/// The newest answers, of at most so many bytes and so much time.
pub struct Ring {
    lines: VecDeque<Line>,
    bytes: u64,
    most: u64,
    span: Duration,
}

impl Ring {
    /// Holds so many bytes and so much time.
    pub fn new(most: u64, span: Duration) -> Self {
        Self { lines: VecDeque::new(), bytes: 0, most, span }
    }

    /// An answer that comes now, in the form that [`push`](Self::push) takes; `None` if it is too long. Needs no lock of the ring.
    pub fn line(answer: &Answer) -> Option<Line> {
        line_of(answer).map(Arc::from)
    }

    /// Takes the newest, and forgets the oldest for it.
    pub fn push(&mut self, line: Line) {
        let begin = came(&line).unwrap_or_default().saturating_sub(self.span.as_nanos() as u64);
        self.bytes += size(&line);
        self.lines.push_back(line);
        while let Some(oldest) = self.lines.front()
            && (self.bytes > self.most || came(oldest) < Some(begin))
        {
            self.bytes -= size(oldest);
            self.lines.pop_front();
        }
    }

    /// All that it holds, the oldest first.
    pub fn lines(&self) -> Vec<Line> {
        self.lines.iter().cloned().collect()
    }
}

fn size(line: &Line) -> u64 {
    line.len() as u64 + OVERHEAD
}

/// Writes a recording of its own. The file is there once it is whole and on the disk.
pub fn write(path: &Path, about: BTreeMap<String, String>, lines: &[Line]) -> McapResult<()> {
    let part = path.with_extension("part");
    let written = write_part(&part, about, lines).and_then(|()| Ok(fs::rename(&part, path)?));
    if written.is_err() {
        // It is removed at the next start otherwise.
        let _ = fs::remove_file(&part);
    }
    written
}

fn write_part(part: &Path, about: BTreeMap<String, String>, lines: &[Line]) -> McapResult<()> {
    let mut open = Open::begin(create(part)?, &Metadata { name: "cara".to_owned(), metadata: about }, CHUNK)?;
    for line in lines {
        if let Some((message, came)) = message_of(line)? {
            open.write(&message, came)?;
        }
    }
    Ok(open.finish()?.sync_all()?)
}
