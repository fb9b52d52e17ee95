//! Instructions of a round trip, counted by callgrind at both ends: how many there are, and how many of them make and
//! read messages. What the kernel does is in none of them.

use std::collections::HashMap;
use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, Result, ensure};
use cara_bench_ends::{Order, Pin};

use crate::pair::{Pair, Setting};
use crate::peers::Contender;
use crate::results::{Instructions, ratio};

/// Callgrind counts a copy that one instruction makes byte by byte, so the C library is to copy otherwise.
const TUNABLES: &str = "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX2,-AVX,-ERMS,-FSRM,-AVX_Fast_Unaligned_Load";

/// A program's parameters become a message.
const GENERATE: [&str; 3] = ["IntoValue>::into_value", "distribution::block::measure", "distribution::block::write"];
/// A message becomes parameters, or a text that the program reads.
const PROCESS: [&str; 4] =
    ["distribution::block::read", "distribution::block::check", "FromValue>::from_value", "str::converts::from_utf8"];

/// Whether callgrind can be started here.
pub(crate) fn is_installed() -> bool {
    let mut asked = Command::new("valgrind");
    asked.arg("--version").stdout(Stdio::null()).stderr(Stdio::null());
    asked.status().is_ok_and(|status| status.success())
}

/// `command` under callgrind, which writes into `folder` when the process ends.
pub(crate) fn under_callgrind(command: &Command, folder: &Path) -> Command {
    let mut counted = Command::new("valgrind");
    let file = folder.join("callgrind.%p");
    counted.args(["--tool=callgrind", "--quiet", "--compress-strings=no", "--compress-pos=no"]);
    counted.arg(format!("--callgrind-out-file={}", file.display()));
    counted.arg(command.get_program()).args(command.get_args()).env("GLIBC_TUNABLES", TUNABLES);
    counted
}

/// Both ends of `peer`, which is one of our own. A second run makes so many calls more than the first: their difference
/// is counted, so that what happens before and after the calls is not.
pub(crate) fn measure(peer: &'static str, chars: u32, calls: u32) -> Result<Instructions> {
    let few = run(peer, chars, calls / 10)?;
    let many = run(peer, chars, calls / 10 + calls)?;
    let [client, server] = [0, 1].map(|end| many[end].since(&few[end]));
    let all = (client.all + server.all).max(1) as f64;
    let part = |of: u64, all: u64| ratio(of as f64 / all.max(1) as f64);
    let each = |of: u64| (of as f64 / f64::from(calls)).round();
    Ok(Instructions {
        calls,
        per_call: each(client.all + server.all),
        client_per_call: each(client.all),
        server_per_call: each(server.all),
        generate: ratio((client.generate + server.generate) as f64 / all),
        process: ratio((client.process + server.process) as f64 / all),
        client_generate: part(client.generate, client.all),
        client_process: part(client.process, client.all),
        server_generate: part(server.generate, server.all),
        server_process: part(server.process, server.all),
    })
}

/// So many calls; what the client and the server took.
fn run(peer: &'static str, chars: u32, calls: u32) -> Result<[Counts; 2]> {
    let folder = tempfile::tempdir()?;
    let contender = Contender::Counted(peer, folder.path().to_owned());
    let mut pair = Pair::start(&contender, Setting { pin: Pin::None, distribution: 1, print: false, wire: None })?;
    pair.block(&Order { chars, callers: 1, calls_per_caller: calls, pause_ms: 0, delay_us: 0 })?;
    // Callgrind writes when the processes end.
    drop(pair);
    let mut ends = [None, None];
    for file in std::fs::read_dir(folder.path())? {
        let profile = std::fs::read_to_string(file?.path())?;
        let command =
            profile.lines().find_map(|line| line.strip_prefix("cmd: ")).context("callgrind tells no command")?;
        let [client, server] = &mut ends;
        *if command.contains(" serve ") { server } else { client } = Some(counts(&profile)?);
    }
    let [client, server] = ends;
    Ok([client.context("no counts of the client")?, server.context("no counts of the server")?])
}

/// Instructions of one process.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct Counts {
    all: u64,
    generate: u64,
    process: u64,
}

impl Counts {
    fn since(&self, earlier: &Self) -> Self {
        Self {
            all: self.all.saturating_sub(earlier.all),
            generate: self.generate.saturating_sub(earlier.generate),
            process: self.process.saturating_sub(earlier.process),
        }
    }
}

/// Sums up a profile: a function of interest counts with all that it calls, where none of interest calls it.
fn counts(profile: &str) -> Result<Counts> {
    let total = profile.lines().find_map(|line| line.strip_prefix("totals: ")).context("callgrind tells no total")?;
    let mut counts = Counts { all: total.trim().parse()?, ..Counts::default() };
    let (mut caller, mut callee, mut is_call) = ("", "", false);
    let mut inclusive: HashMap<&str, u64> = HashMap::new();
    for line in profile.lines() {
        if let Some(name) = line.strip_prefix("fn=") {
            caller = name;
        } else if let Some(name) = line.strip_prefix("cfn=") {
            callee = name;
        } else if line.starts_with("calls=") {
            is_call = true;
        } else if line.starts_with(|first: char| first.is_ascii_digit()) && std::mem::take(&mut is_call) {
            let cost = line.split_whitespace().nth(1).context("a call has a cost")?.parse::<u64>()?;
            if !is_among(caller, &GENERATE) && !is_among(caller, &PROCESS) {
                *inclusive.entry(callee).or_default() += cost;
            }
        }
    }
    ensure!(!inclusive.is_empty(), "callgrind tells no calls");
    let sum = |names: &[&str]| inclusive.iter().filter(|(name, _)| is_among(name, names)).map(|(_, cost)| cost).sum();
    (counts.generate, counts.process) = (sum(&GENERATE), sum(&PROCESS));
    Ok(counts)
}

fn is_among(name: &str, names: &[&str]) -> bool {
    names.iter().any(|known| name.contains(known))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_function_counts_with_what_it_calls_and_once() {
        let profile = "cmd: cara-bench call --peer cara\n\
            fn=main\n10 5\ncfn=cara_core::distribution::block::write\ncalls=1 7\n11 70\n\
            cfn=core::str::converts::from_utf8\ncalls=2 1\n12 20\n\n\
            fn=cara_core::distribution::block::write\n7 30\ncfn=core::str::converts::from_utf8\ncalls=1 1\n8 40\n\n\
            fn=core::str::converts::from_utf8\n1 60\n\ntotals: 95\n";
        assert_eq!(counts(profile).unwrap(), Counts { all: 95, generate: 70, process: 20 });
        assert!(counts("cmd: nothing\n").is_err());
    }
}
