//! `cargo xtask instructions`: how many instructions the core's operations take, on the host and on a Cortex-M3.
//!
//! On the host callgrind counts what happens within one function of `tests/instructions`. On the board an emulator gives
//! every instruction the same time, and the image measures time. Both are the same in every run of one compiler.

use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use cara_processes::files;
use serde_json::{Value, json};

use crate::command::Run;
use crate::figures::{self, Document, cells, table};
use crate::firmware::{self, built, image_build};
use crate::groups::Outcome;
use crate::{install, workspace};

const DOCUMENT: Document = Document { file: "docs/instructions.md", command: "cargo xtask instructions --write" };
/// Counts on any other processor are not compared: another one has other instructions.
const HOST: &str = "x86_64";
const BOARD: &str = "Cortex-M3";
const TARGET: &str = "thumbv7m-none-eabi";
/// The image of the operations, and where its crate is.
const OPERATIONS: &str = "operations";
/// An s_unit that serves, in the same crate; and a board's bare echo.
const SERVED: &str = "served";
const ECHO: &str = "echo";
const NO_NETWORK: &str = "this user cannot make a network with virtual devices";
const FOLDER: &str = "tests/instructions/board";
/// Of a hundred instructions, how many more may be.
const GROWTH: u64 = 3;
/// Two checkouts differed by 108 in the same operation.
const LAYOUT_CHANCE: u64 = 128;
/// Texts at other places differed by up to 2,300.
const TEXT_CHANCE: u64 = 2_300;
/// Owners of instructions, as the last word of an operation over a network.
const NOT_OURS: [&str; 2] = [", TCP/IP", ", driver, clock, executor"];
/// glibc copies with other instructions on other processors, and callgrind counts `rep movsb` byte by byte.
const TUNABLES: &str = "glibc.cpu.hwcaps=-AVX512F,-AVX512VL,-AVX512BW,-AVX2,-AVX,-ERMS,-FSRM,-AVX_Fast_Unaligned_Load";

/// Counts, prints, and writes the same as JSON or into the document.
pub(crate) fn run(json: Option<&Path>, write: bool) -> Result<ExitCode> {
    json.map_or(Ok(()), files::can_write)?;
    installed().map_err(anyhow::Error::msg)?;
    let mut rows = counted()?;
    match network()? {
        Some(more) => rows.extend(more),
        None if write => bail!("without a network of its own there are not all figures: {NO_NETWORK}"),
        None => println!("warning: requests over a network are left out: {NO_NETWORK}"),
    }
    println!("{}", table(&rows));
    if let Some(path) = json {
        let rows: Vec<Value> = rows.iter().map(Row::to_json).collect();
        let written = std::fs::write(path, serde_json::to_string_pretty(&rows)? + "\n");
        written.with_context(|| format!("cannot write {}", path.display()))?;
    }
    if write {
        DOCUMENT.write(&rows)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Fails when an operation takes more instructions than the document allows.
pub(crate) fn check() -> Outcome {
    if let Err(reason) = installed() {
        return Outcome::Skipped(reason);
    }
    let compared = || {
        DOCUMENT.check(&counted()?)?;
        let more = network()?;
        DOCUMENT.check(more.as_deref().unwrap_or_default())?;
        Ok(more.is_some())
    };
    match compared() {
        Ok(true) => Outcome::Passed,
        Ok(false) => Outcome::Skipped(format!("requests over a network: {NO_NETWORK}; all others are as they were")),
        Err(error) => Err(error).into(),
    }
}

fn installed() -> Result<(), String> {
    install::program("valgrind", "valgrind")?;
    install::program("qemu-system-arm", "qemu-system-arm")?;
    install::rust_target(TARGET)
}

/// What needs no network.
fn counted() -> Result<Vec<Row>> {
    let mut rows = host()?;
    rows.extend(board()?);
    Ok(rows)
}

/// What callgrind counts.
fn host() -> Result<Vec<Row>> {
    if std::env::consts::ARCH != HOST {
        println!("warning: this host is no {HOST}: its instructions are not counted");
        return Ok(Vec::new());
    }
    Run::cargo().args(["build", "--quiet", "--profile", "counted", "--package", "cara-instructions"]).stream()?;
    let program = workspace::target().join("counted/cara-instructions");
    let listed = Run::new(&program.to_string_lossy()).text()?;
    listed.lines().enumerate().map(|(number, line)| of_host(&program, number, line)).collect()
}

fn of_host(program: &Path, number: usize, line: &str) -> Result<Row> {
    let (operation, of) = line.split_once('\t').context("an operation has a name and a size")?;
    let folder = workspace::target().join("instructions");
    std::fs::create_dir_all(&folder)?;
    let profile = folder.join(format!("callgrind.{number}"));
    let counted = ["--tool=callgrind", "--quiet", "--toggle-collect=*counted_by_callgrind*"];
    Run::new("valgrind")
        .args(counted)
        .args([format!("--callgrind-out-file={}", profile.display())])
        .args([program.as_os_str(), number.to_string().as_ref()])
        .env("GLIBC_TUNABLES", TUNABLES)
        .text()?;
    let text = std::fs::read_to_string(&profile)?;
    let total = text.lines().find_map(|line| line.strip_prefix("totals: "));
    let instructions = total.context("callgrind tells no total")?.trim().parse()?;
    Ok(Row { machine: HOST.into(), operation: operation.into(), of: of.into(), instructions })
}

/// What the emulated board counts itself.
fn board() -> Result<Vec<Row>> {
    // Both ends of a pair live on the stack.
    image_build(Path::new(FOLDER), TARGET, OPERATIONS).args(["--features", "large-stack"]).stream()?;
    let machine = ["-M", "lm3s6965evb", "-display", "none", "-monitor", "none", "-serial", "none", "-nic", "none"];
    // A board that panics would start again and again.
    let machine = machine.iter().chain(&["-no-reboot"]);
    let reported = Run::new("qemu-system-arm")
        .args(machine)
        .args(["-icount", "shift=10,sleep=off", "-semihosting-config", "enable=on,target=native", "-kernel"])
        .args([built(TARGET, OPERATIONS)])
        .text()?;
    // A board that panics is started again, which ends the emulator without an error.
    let rows = reported.trim_end().strip_suffix("end").context("the board has ended before its last operation")?;
    rows.lines().map(of_board).collect()
}

/// Requests that a board serves over its network, and the bare echo; `None` where this user can make no network.
fn network() -> Result<Option<Vec<Row>>> {
    image_build(Path::new(FOLDER), TARGET, SERVED).stream()?;
    let board = firmware::find(firmware::TESTED)?;
    let echo = board.images.iter().find(|image| image.name == ECHO);
    let images = [(SERVED, built(TARGET, SERVED)), (ECHO, board.build(echo.context("the board has no echo")?)?)];
    let mut rows = Vec::new();
    for (image, file) in images {
        match firmware::tests(board, &file)?.args(["--insecure", "instructions", image]).output()? {
            (Some(0), reported) => rows.extend(reported.lines().map(of_board).collect::<Result<Vec<Row>>>()?),
            (Some(firmware::NOT_ALLOWED), _) => return Ok(None),
            (code, _) => bail!("the board's instructions could not be counted: exit code {code:?}"),
        }
    }
    Ok(Some(rows))
}

fn of_board(line: &str) -> Result<Row> {
    let [operation, of, instructions] = line.split('\t').collect::<Vec<_>>()[..] else {
        bail!("the board says: {line}")
    };
    Ok(Row {
        machine: BOARD.into(),
        operation: operation.into(),
        of: of.into(),
        instructions: instructions.trim().parse()?,
    })
}

/// How many instructions an operation takes.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Row {
    machine: String,
    operation: String,
    of: String,
    instructions: u64,
}

impl Row {
    fn to_json(&self) -> Value {
        let Self { machine, operation, of, instructions } = self;
        json!({ "machine": machine, "operation": operation, "of": of, "instructions": instructions })
    }
}

impl Row {
    /// What the same code may take more by chance. On a board: bytes are copied and compared word by word where both begin
    /// with a word, which for constants is the linker's choice and differs between checkouts in two folders; a text that
    /// comes over the network begins anywhere in the socket's buffer.
    fn chance(&self) -> u64 {
        match (self.machine.as_str(), self.operation.starts_with(SERVED)) {
            (BOARD, true) if self.of.ends_with("characters") => TEXT_CHANCE,
            (BOARD, _) => LAYOUT_CHANCE,
            _ => 0,
        }
    }
}

impl figures::Row for Row {
    const COLUMNS: &'static str = "| machine | operation | of | instructions |";

    fn line(&self) -> String {
        format!("| {} | {} | {} | {} |", self.machine, self.operation, self.of, self.instructions)
    }

    fn parse(line: &str) -> Option<Self> {
        let [machine, operation, of, instructions] = cells(line)[..] else { return None };
        let instructions = instructions.parse().ok()?;
        Some(Self { machine: machine.into(), operation: operation.into(), of: of.into(), instructions })
    }

    fn name(&self) -> String {
        format!("{}: {}, {}", self.machine, self.operation, self.of)
    }

    /// More than 3 %. What is not CARA's is told beside it and not compared: it depends on when the host sends its
    /// acknowledgements.
    fn growth(&self, before: &Self) -> Vec<String> {
        if NOT_OURS.iter().any(|owner| self.operation.ends_with(owner)) {
            return Vec::new();
        }
        let (now, before) = (self.instructions, before.instructions);
        let has_grown = now > before + before * GROWTH / 100 + self.chance();
        has_grown.then(|| format!("{}: {now} instructions, and {before}", self.name())).into_iter().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::{Row, of_board};
    use crate::figures::Row as _;

    fn row(instructions: u64) -> Row {
        Row { machine: "Z80".into(), operation: "encode".into(), of: "2 ints".into(), instructions }
    }

    #[test]
    fn a_row_is_read_as_it_was_written() {
        assert_eq!(Row::parse(&row(7).line()), Some(row(7)));
        assert_eq!(Row::parse(Row::COLUMNS), None);
    }

    #[test]
    fn three_per_cent_pass_and_more_does_not() {
        assert!(row(1030).growth(&row(1000)).is_empty());
        assert_eq!(row(1031).growth(&row(1000)), ["Z80: encode, 2 ints: 1031 instructions, and 1000"]);
        assert!(row(1).growth(&row(1000)).is_empty());
        let network = |instructions| Row { operation: "served request, TCP/IP".into(), ..row(instructions) };
        assert!(network(2000).growth(&network(1000)).is_empty());
    }

    #[test]
    fn on_a_board_chance_has_its_part() {
        let board = |instructions| Row { machine: "Cortex-M3".into(), ..row(instructions) };
        assert!(board(1158).growth(&board(1000)).is_empty());
        assert_eq!(board(1159).growth(&board(1000)).len(), 1);
        let served = |instructions| Row {
            operation: "served request, CARA".into(),
            of: "512 characters".into(),
            ..board(instructions)
        };
        assert!(served(12_600).growth(&served(10_000)).is_empty());
        assert_eq!(served(12_601).growth(&served(10_000)).len(), 1);
    }

    #[test]
    fn a_board_tells_a_row_in_each_line() {
        assert_eq!(of_board("encode\t2 ints\t2519").unwrap().instructions, 2519);
        assert!(of_board("panic at src/main.rs:1").is_err());
    }
}
