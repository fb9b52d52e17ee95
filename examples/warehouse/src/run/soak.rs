//! A soak: what each process holds, as lines of a file that a later run goes on with, links that are cut, and a page that is read.

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Read, Seek, Write};
use std::net::{Ipv4Addr, TcpStream};
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};

use super::child::{Held, Usage, held, usage};

/// Where the page of a soak listens, in a network of its own.
pub(super) const PAGE: u16 = 8420;
/// Between two looks at what processes hold.
const EACH: Duration = Duration::from_secs(10);
const COLUMNS: &str =
    "segment,seconds,process,life,resident_kib,proportional_kib,descriptors,threads,cpu_ms,messages,datagrams";
/// Set where a program may change the firewall: in a network of its own.
const OWN_NETWORK: &str = "CARA_OWN_NETWORK";

/// The file of a soak.
pub struct Samples {
    file: File,
    segment: u32,
    /// Seconds of earlier runs.
    before: u64,
    began: Instant,
    last: Instant,
}

impl Samples {
    /// Goes on with a file, or begins one.
    pub fn open(path: &Path) -> Result<Self> {
        let mut file = OpenOptions::new().read(true).append(true).create(true).open(path)?;
        let mut text = String::new();
        file.read_to_string(&mut text)?;
        if text.is_empty() {
            writeln!(file, "{COLUMNS}")?;
        } else if !text.ends_with('\n') {
            // A run that was killed can leave half a line, which no reader takes for a whole one.
            writeln!(file)?;
        }
        file.rewind()?;
        let last = text.lines().rev().find_map(|line| {
            let mut fields = line.split(',');
            Some((fields.next()?.parse::<u32>().ok()?, fields.next()?.parse::<u64>().ok()?))
        });
        let (segment, before) = last.map_or((0, 0), |(segment, seconds)| (segment + 1, seconds + EACH.as_secs()));
        Ok(Self { file, segment, before, began: Instant::now(), last: Instant::now() })
    }

    /// Whether it is time to look again.
    pub fn is_due(&mut self) -> bool {
        let is_due = self.last.elapsed() >= EACH;
        if is_due {
            self.last = Instant::now();
        }
        is_due
    }

    /// Adds a line for each process, which have its columns from `process` on.
    pub fn write(&mut self, processes: &[String]) -> Result<()> {
        let (segment, seconds) = (self.segment, self.before + self.began.elapsed().as_secs());
        let lines: String = processes.iter().map(|line| format!("{segment},{seconds},{line}\n")).collect();
        self.file.write_all(lines.as_bytes()).context("the file of the soak")
    }
}

/// The line of a process, in its life of this number, with the messages and datagrams that it has sent; `None` once it is gone.
pub fn line(process: &str, life: usize, pid: u32, sent: [u64; 2]) -> Option<String> {
    let (Usage { cpu, resident_kib, threads }, Held { proportional_kib, descriptors }) = (usage(pid)?, held(pid)?);
    let ([messages, datagrams], cpu) = (sent, cpu.as_millis());
    Some(format!(
        "{process},{life},{resident_kib},{proportional_kib},{descriptors},{threads},{cpu},{messages},{datagrams}"
    ))
}

/// Links are cut in a network of its own only.
pub(super) fn may_cut() -> Result<()> {
    let why = "a soak cuts links: `cargo xtask soak` runs it in its own network";
    ensure!(std::env::var_os(OWN_NETWORK).is_some(), why);
    Ok(())
}

/// A rule that cuts links of some kind; an eighth of all streams, or a fifth of all packets.
pub(super) fn cut(rng: &mut fastrand::Rng) -> Result<String> {
    let streams = format!("meta l4proto tcp tcp dport != {PAGE} tcp sport != {PAGE} symhash mod 8 == {}", rng.u8(..8));
    let rule = match rng.u8(..3) {
        0 => format!("{streams} reject with tcp reset"),
        1 => format!("{streams} drop"),
        _ => format!(
            "tcp dport != {PAGE} numgen random mod 100 < 20 drop\nudp dport > 0 numgen random mod 100 < 20 drop"
        ),
    };
    nft(&format!("table inet soak {{\nchain input {{\ntype filter hook input priority 0\n{rule}\n}}\n}}"))?;
    Ok(rule)
}

/// Links are whole again.
pub(super) fn heal() -> Result<()> {
    nft("delete table inet soak")
}

fn nft(rules: &str) -> Result<()> {
    let status = Command::new("nft").arg(rules).status().context("cannot start nft")?;
    ensure!(status.success(), "nft {rules}: {status}");
    Ok(())
}

/// Reads the page as a browser that stays open, until this process ends. It opens the page anew each minute.
pub(super) fn read_page(token: String) {
    std::thread::spawn(move || {
        loop {
            // A page that is not there yet is tried again.
            let _ = read_once(&token);
            std::thread::sleep(Duration::from_secs(1));
        }
    });
}

fn read_once(token: &str) -> std::io::Result<()> {
    let opened = Instant::now();
    let mut stream = TcpStream::connect((Ipv4Addr::LOCALHOST, PAGE))?;
    stream.set_read_timeout(Some(Duration::from_secs(10)))?;
    write!(stream, "GET /api/stream HTTP/1.1\r\nHost: localhost:{PAGE}\r\nAuthorization: Bearer {token}\r\n\r\n")?;
    let mut reader = BufReader::new(stream);
    let mut line = Vec::new();
    while opened.elapsed() < Duration::from_secs(60) && reader.read_until(b'\n', &mut line)? > 0 {
        line.clear();
    }
    Ok(())
}
