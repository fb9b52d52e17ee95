//! What a board executes, instruction by instruction, as the emulator tells.

use std::io::{BufRead, BufReader, Read};
use std::ops::Range;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The addresses of all instructions so far.
pub(crate) struct Trace {
    executed: Arc<Mutex<Vec<u32>>>,
}

impl Trace {
    /// With these, the emulator writes a line for each instruction to its standard error. It is slow then, so the
    /// board's time goes by instructions, 64 ns each: otherwise timers would fire in the middle of everything.
    pub(crate) const ARGUMENTS: [&str; 5] = ["-singlestep", "-icount", "shift=6", "-d", "exec,nochain"];

    /// Keeps what is read until it ends.
    pub(crate) fn read(from: impl Read + Send + 'static) -> Self {
        let executed = Arc::new(Mutex::new(Vec::new()));
        let kept = executed.clone();
        std::thread::spawn(move || {
            let mut lines = BufReader::with_capacity(1 << 16, from);
            let mut line = Vec::new();
            while matches!(lines.read_until(b'\n', &mut line), Ok(1..)) {
                if let Some(address) = address(&line) {
                    lock(&kept).push(address);
                }
                line.clear();
            }
        });
        Self { executed }
    }

    /// How many there are so far.
    pub(crate) fn length(&self) -> usize {
        lock(&self.executed).len()
    }

    /// Some of them.
    pub(crate) fn part(&self, range: Range<usize>) -> Vec<u32> {
        lock(&self.executed).get(range).unwrap_or_default().to_vec()
    }
}

fn lock(executed: &Mutex<Vec<u32>>) -> MutexGuard<'_, Vec<u32>> {
    executed.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The address in a line such as `Trace 0: 0x7fddf4000dc0 [00800400/000000fe/00000110/ff000201] Reset`.
fn address(line: &[u8]) -> Option<u32> {
    let line = std::str::from_utf8(line).ok()?.strip_prefix("Trace ")?;
    let address = line.split_once('[')?.1.split('/').nth(1)?;
    u32::from_str_radix(address, 16).ok()
}

#[cfg(test)]
mod tests {
    use super::{Trace, address};

    const LINE: &str = "Trace 0: 0x7fddf4000dc0 [00800400/000000fe/00000110/ff000201] Reset";

    #[test]
    fn a_line_has_an_address() {
        assert_eq!(address(LINE.as_bytes()), Some(0xFE));
        assert_eq!(address(b"qemu-system-arm: warning: nic stellaris_enet.0 has no peer"), None);
    }

    #[test]
    fn other_lines_are_passed_over() {
        let trace = Trace::read(std::io::Cursor::new(format!("{LINE}\nTimer with period zero\n{LINE}\n")));
        while trace.length() < 2 {
            std::thread::yield_now();
        }
        assert_eq!(trace.part(0..2), [0xFE, 0xFE]);
        assert!(trace.part(1..9).is_empty());
    }
}
