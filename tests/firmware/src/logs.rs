//! A board that logs a hundred lines a second over its link, to a manager that calls it meanwhile; and that says after a panic what
//! it was, once it has joined again. `cara logs` shows it, `cara record` records it, and a page has its last lines. For an image with the features `faults` and `logs`, and a `cara` with
//! the feature `defmt`.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use cara_std::Peer;
use cara_std::control::Control;

use crate::board::{Bench, LONG, Who};
use crate::manager::{Manager, fault, position};

/// Lines that the board logs when it is asked for, in 10 s.
const LINES: usize = 1000;
/// Calls that are made meanwhile, and as many without.
const CALLS: usize = 400;
const PAUSE: std::time::Duration = std::time::Duration::from_millis(10);

/// Runs it and prints what was found.
pub(crate) fn run(bench: &Bench) -> Result<()> {
    let cable = bench.cable()?;
    let socket = bench.keys.folder().join("manager.socket");
    let manager = Manager::of(bench.keys.give(Manager::builder()?.control(Control::Path(socket.clone())))?)?;
    let _board = bench.board(&cable, &Who::agv(17))?;
    let agv = manager.meet_offering(&Who::agv(17), "log")?;
    let folder = bench.keys.folder().join("images");
    let wrong = images(bench.image(), &folder)?;
    let cara = |verb: &[&str], elf: &OsStr| {
        let mut command = bench.keys.command();
        command.args(verb).arg("--socket").arg(&socket).arg("--elf").arg(elf);
        command
    };
    let file = bench.keys.folder().join("log.mcap");
    let recorded = file.to_str().context("the folder's name is no text")?;
    let _recording = Log::follow(&mut cara(&["record", recorded, "--stream", "log"], folder.as_os_str()))?;
    let web = Log::follow(&mut cara(&["web", "--listen", "127.0.0.1:0"], folder.as_os_str()))?;
    let page = Log::of_page(&web)?;
    let logs = |elf| cara(&["logs", "agv-17"], elf);
    let log = Log::follow(&mut logs(folder.as_os_str()))?;
    log.has("started because of")?;
    let without = call(&agv)?;
    agv.block_request("fault", &mut fault(8)?)?;
    log.has("line 0 of")?;
    let with = call(&agv)?;
    log.has(&format!("line {} of", LINES - 1))?;
    let lines = log.lines();
    let numbered = lines.iter().filter(|line| line.contains(" of 1000")).count();
    let lost: Vec<&String> = lines.iter().filter(|line| line.contains("bytes are lost here")).collect();
    println!("{numbered} of {LINES} lines came");
    ensure!(numbered == LINES, "lines are missing: {lost:?}");
    for (what, times) in [("without lines", &without), ("with 100 lines a second", &with)] {
        println!("{what}: {} calls, p50 {} µs, p99 {} µs", times.len(), percentile(times, 50), percentile(times, 99));
    }
    // Only now: each piece of what was kept goes to those who read at that moment.
    let refused = logs(wrong.as_os_str()).output().context("cannot start cara")?;
    let said = String::from_utf8_lossy(&refused.stderr);
    ensure!(refused.status.code() == Some(1) && said.contains("name the ELF that"), "another image's ELF: {said}");
    let before = log.lines().len();
    agv.request("fault", &fault(3)?)?;
    log.has_behind(before, "panic at")?;
    log.has_behind(before, "started because of")?;
    println!("after a panic the board told its place, and why it had started");
    page.has(&format!("line {} of", LINES - 1))?;
    page.has("panic at")?;
    let replayed = || Ok::<_, anyhow::Error>(bench.keys.command().args(["replay", recorded]).output()?.stdout);
    let end = Instant::now() + LONG;
    let wanted = [format!("line {} of", LINES - 1), "panic at".to_owned()];
    loop {
        let shown = String::from_utf8_lossy(&replayed()?).into_owned();
        if wanted.iter().all(|part| shown.contains(part)) {
            break;
        }
        ensure!(Instant::now() < end, "the recording lacks one of {wanted:?}:\n{shown}");
        std::thread::sleep(PAUSE);
    }
    println!("the recording and the page have both");
    Ok(())
}

/// Puts the board's image into a folder, beside one with another build id; where that one is.
fn images(image: &Path, folder: &Path) -> Result<std::path::PathBuf> {
    /// In an ELF's note: the sizes of name and build id, its kind, its name.
    const NOTE: &[u8] = b"\x04\0\0\0\x08\0\0\0\x03\0\0\0GNU\0";
    let mut bytes = std::fs::read(image)?;
    std::fs::create_dir(folder)?;
    std::fs::write(folder.join("right"), &bytes)?;
    let note = bytes.windows(NOTE.len()).position(|window| window == NOTE).context("the image has no build id")?;
    let id = bytes.get_mut(note + NOTE.len()).context("the note is cut short")?;
    *id ^= 1;
    let wrong = folder.join("another");
    std::fs::write(&wrong, &bytes)?;
    Ok(wrong)
}

/// What `cara` shows, or a page is sent, line by line.
struct Log {
    /// None of a page.
    cara: Option<Child>,
    lines: Arc<Mutex<Vec<String>>>,
}

impl Log {
    fn follow(command: &mut Command) -> Result<Self> {
        let mut cara = command.stdout(Stdio::piped()).spawn().context("cannot start cara")?;
        let output = cara.stdout.take().context("cara has no output")?;
        Ok(Self { cara: Some(cara), lines: collect(output) })
    }

    /// What `cara web` sends a page.
    fn of_page(web: &Self) -> Result<Self> {
        web.has("the page is at ")?;
        let lines = web.lines();
        let url = lines.iter().find_map(|line| line.split_once("http://")).context("it has no address")?.1;
        let (address, key) = url.split_once("/#").context("it has no key")?;
        let mut page = TcpStream::connect(address)?;
        write!(page, "GET /api/stream HTTP/1.1\r\nhost: {address}\r\nauthorization: Bearer {key}\r\n\r\n")?;
        Ok(Self { cara: None, lines: collect(page) })
    }

    fn lines(&self) -> Vec<String> {
        self.lines.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn has(&self, text: &str) -> Result<()> {
        self.has_behind(0, text)
    }

    fn has_behind(&self, from: usize, text: &str) -> Result<()> {
        let end = Instant::now() + LONG;
        while !self.lines().iter().skip(from).any(|line| line.contains(text)) {
            ensure!(Instant::now() < end, "`{text}` did not come:\n{}", self.lines().join("\n"));
            std::thread::sleep(PAUSE);
        }
        Ok(())
    }
}

/// The lines that come there, as they come.
fn collect(from: impl Read + Send + 'static) -> Arc<Mutex<Vec<String>>> {
    let lines = Arc::<Mutex<Vec<String>>>::default();
    let found = lines.clone();
    std::thread::spawn(move || {
        for line in BufReader::new(from).lines().map_while(Result::ok) {
            found.lock().unwrap_or_else(PoisonError::into_inner).push(line);
        }
    });
    lines
}

impl Drop for Log {
    fn drop(&mut self) {
        if let Some(cara) = &mut self.cara {
            let _ = cara.kill();
            let _ = cara.wait();
        }
    }
}

/// How long calls in a row took, in microseconds, in order of length.
fn call(agv: &Peer) -> Result<Vec<u64>> {
    let times = (0..CALLS).map(|_| {
        std::thread::sleep(PAUSE);
        let began = Instant::now();
        position(agv).context("a call beside the log")?;
        Ok(began.elapsed().as_micros() as u64)
    });
    let mut times = times.collect::<Result<Vec<_>>>()?;
    times.sort_unstable();
    Ok(times)
}

fn percentile(times: &[u64], percent: usize) -> u64 {
    times.get((times.len() * percent / 100).min(times.len().saturating_sub(1))).copied().unwrap_or(0)
}
