//! The listing, line by line: the calls as they stand in the example's source, and what came of each.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, ensure};
use cara_processes::Process;
use cara_processes::ticker::Ticker;

use super::stage::{LEASE, STEP, Stage, TRY};
use crate::workspace;

const SOURCE: &str = "examples/linux/src/bin/agv_manager/main.rs";
/// The paper's listing has this many lines.
const LINES: u32 = 24;
/// What an AGV offers.
const FUNCTIONS: [&str; 4] =
    ["pos_info(position: int[2]) -> (position: int[2])", "go_to(position: int[2])", "battery()", "stop()"];

/// Runs the listing in a manager that waits behind each line. Returns the AGVs that came meanwhile.
pub(super) fn run(stage: &Stage, manager: &mut Process) -> Result<[Process; 2]> {
    let text = workspace::read(Path::new(SOURCE))?;
    let mut listing = Listing { stage, manager, code: code(&text)?, shown: 0 };
    listing.through(1, "AGV_manager/1, secured")?;
    listing.through(2, "started")?;
    listing.through(3, "0 s_units")?;
    listing.manager.expect("line 6: searching", STEP)?;
    let mut first = listing.join(1)?;
    let second = listing.join(2)?;
    listing.until(9, "0 is agv-1/11")?;
    ensure!(listing.manager.has("1 is agv-2/12") || listing.manager.has("joined agv-2/12"), "agv-2 is not there");
    listing.go_on()?;

    listing.functions()?;
    listing.through(12, "pos holds 1 variable")?;
    listing.through(13, "answered")?;
    listing.through(15, "position [0, 0]")?;
    listing.until(18, "position set to [1, 2]")?;
    let ticker = Ticker::start();
    listing.go_on()?;
    listing.until(19, "accepted")?;
    if let Ok(line) = first.seen("driving to [1.000, 2.000]", TRY) {
        stage.heard(&line, &first);
    }
    let arrives = stage.arrives(&mut first, "[1.000, 2.000]")?;
    let longest = ticker.longest();
    ensure!(
        arrives || ticker.may_have_ended(LEASE),
        "agv-1 did not arrive, and the machine was held up {longest:?} at most"
    );
    if arrives {
        stage.heard(&listing.manager.seen("go_to at agv-1/11 is finished", STEP)?, listing.manager);
    }
    listing.go_on()?;

    listing.until(22, "call_mechanic(fault: string[64], minutes: int)")?;
    ensure!(!first.has("call_mechanic"), "agv-1 knows call_mechanic before it is published");
    listing.go_on()?;
    listing.until(23, "published to agv-1/11")?;
    stage.heard(&first.seen("call_mechanic: one comes in 5 minutes", STEP)?, &first);
    ensure!(!second.has("call_mechanic"), "agv-2 knows call_mechanic, which was published to agv-1 only");
    listing.go_on()?;
    listing.until(24, "published to all")?;
    stage.heard(&second.seen("call_mechanic: one comes in 5 minutes", STEP)?, &second);
    listing.go_on()?;
    ensure!(listing.shown == LINES, "{} lines of {LINES} were shown", listing.shown);
    listing.manager.expect("console: ", STEP)?;
    if !arrives {
        stage.sends(listing.manager, &mut first, "go_to 0 1 2", |stage, agv| stage.arrives(agv, "[1.000, 2.000]"))?;
        stage.heard(&listing.manager.seen("go_to at agv-1/11 is finished", STEP)?, listing.manager);
    }
    Ok([first, second])
}

/// The listing on its way.
struct Listing<'s> {
    stage: &'s Stage,
    manager: &'s mut Process,
    code: BTreeMap<u32, String>,
    /// Up to this line.
    shown: u32,
}

impl Listing<'_> {
    /// Waits for what came of a line; shows it and the lines before it that say nothing themselves.
    fn until(&mut self, number: u32, wanted: &str) -> Result<()> {
        let prefix = format!("line {number}: ");
        let line = self.manager.expect(&prefix, STEP)?;
        let came = line.text.strip_prefix(&prefix).unwrap_or_default();
        ensure!(came.contains(wanted), "line {number} brought `{came}` and not `{wanted}`");
        for quiet in self.shown + 1..number {
            let code = Some(self.code(quiet)?).filter(|code| !code.is_empty());
            self.stage.line(quiet, code.unwrap_or("(stands in the line before)"), "");
        }
        self.stage.line(number, self.code(number)?, came);
        self.shown = number;
        Ok(())
    }

    /// As [`until`](Self::until), then goes on.
    fn through(&mut self, number: u32, wanted: &str) -> Result<()> {
        self.until(number, wanted)?;
        self.go_on()
    }

    fn go_on(&mut self) -> Result<()> {
        self.manager.send("")
    }

    fn join(&mut self, number: u32) -> Result<Process> {
        let agv = self.stage.agv(number)?;
        self.stage.show(&format!("agv-{number} starts"));
        let joined = format!("joined agv-{number}/1{number}");
        self.stage.heard(&self.manager.seen(&joined, STEP)?, self.manager);
        Ok(agv)
    }

    /// Line 10: what the AGV offers stands in the manager's lines before the one that says that it was shown.
    fn functions(&mut self) -> Result<()> {
        self.until(10, "shown")?;
        for function in FUNCTIONS {
            let line = self.manager.seen(function, STEP)?;
            println!("{:19}{}", "", line.text);
        }
        self.go_on()
    }

    fn code(&self, number: u32) -> Result<&str> {
        self.code.get(&number).map(String::as_str).with_context(|| format!("{SOURCE} has no line {number}"))
    }
}

/// The example's code by the paper's line numbers, which stand in its comments.
fn code(source: &str) -> Result<BTreeMap<u32, String>> {
    let started = source.split_once("// README begins.").with_context(|| format!("no listing begins in {SOURCE}"))?.1;
    let listing = started.split_once("// README ends.").with_context(|| format!("no listing ends in {SOURCE}"))?.0;
    let mut code = BTreeMap::<u32, String>::new();
    let mut pending = String::new();
    for line in listing.lines().map(str::trim).filter(|line| !line.starts_with("transcript.")) {
        let (text, comment) = line.split_once("// ").unwrap_or((line, ""));
        pending = format!("{pending} {}", text.trim()).trim().to_owned();
        for number in comment.split(", ").map_while(|number| number.parse().ok()) {
            let text = code.entry(number).or_default();
            *text = format!("{text} {pending}").trim().to_owned();
            pending.clear();
        }
        if !comment.is_empty() {
            pending.clear();
        }
    }
    Ok(code)
}

#[cfg(test)]
mod tests {
    use super::{LINES, SOURCE, code};
    use crate::workspace;

    #[test]
    fn every_line_of_the_paper_has_its_code() {
        let code = code(&workspace::read(SOURCE.as_ref()).unwrap()).unwrap();
        assert_eq!(code.keys().copied().collect::<Vec<_>>(), (1..=LINES).collect::<Vec<_>>());
        assert!(code[&1].starts_with("let agv_manager = ") && code[&1].ends_with(';'));
        assert_eq!(code[&13], "agv_manager.s_units()[0].block_request(\"pos_info\", &mut pos)?;");
        assert_eq!(code[&4], "while s_unit_number < 1 {");
        assert!(code[&10].starts_with("print!"));
    }
}
