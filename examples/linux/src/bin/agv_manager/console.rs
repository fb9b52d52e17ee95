//! Commands on standard input, one per line, each answered by one line that begins with `=`, or with `!` on an error.

use std::fmt::Write;
use std::io::BufRead;
use std::time::Duration;

use anyhow::{Context, Result, anyhow, bail};
use cara_examples::say;
use cara_std::{CommunicationSystem, Parameters, Peer, Renew};

/// How long an s_unit may take to tell its functions.
const PATIENCE: Duration = Duration::from_secs(2);
const HELP: &str = "units | functions N | pos_info N | go_to N X Y | release N | battery N | stop N | reset N | quit; N is an s_unit's index";

/// Takes commands until `quit` or the end of the input.
pub(crate) fn run(agv_manager: &CommunicationSystem) -> Result<()> {
    say!("console: {HELP}");
    for line in std::io::stdin().lock().split(b'\n') {
        // What is no text is no command, and is answered as such.
        let line = line?;
        let line = String::from_utf8_lossy(&line);
        let words: Vec<&str> = line.split_whitespace().collect();
        match words.as_slice() {
            [] => {}
            ["quit"] => break,
            words => match answer(agv_manager, words) {
                Ok(answer) => say!("= {answer}"),
                Err(error) => say!("! {error:#}"),
            },
        }
    }
    Ok(())
}

/// The s_units by their indexes.
pub(crate) fn units(agv_manager: &CommunicationSystem) -> String {
    let mut text = format!("{} s_units", agv_manager.number_of_s_units());
    for (index, peer) in agv_manager.s_units().iter().enumerate() {
        let epoch = peer.epoch().map_or("away".to_owned(), |epoch| format!("epoch {:016x}", epoch.0));
        // Writing to a text cannot fail.
        let _ = write!(text, "; {index} is {}, {epoch}", peer.identity());
    }
    text
}

fn answer(agv_manager: &CommunicationSystem, words: &[&str]) -> Result<String> {
    match *words {
        ["help"] => Ok(HELP.to_owned()),
        ["units"] => Ok(units(agv_manager)),
        ["functions", index] => Ok(functions(&s_unit(agv_manager, index)?)),
        ["pos_info", index] => pos_info(&s_unit(agv_manager, index)?),
        ["go_to", index, x, y] => go_to(&s_unit(agv_manager, index)?, [x.parse()?, y.parse()?]),
        ["release", index] => Ok(s_unit(agv_manager, index)?.release("go_to").map(|()| "released".to_owned())?),
        ["battery", index] => battery(&s_unit(agv_manager, index)?),
        ["stop", index] => command(&s_unit(agv_manager, index)?, "stop", "stopped"),
        ["reset", index] => command(&s_unit(agv_manager, index)?, "reset", "may drive again"),
        _ => bail!("no such command: {HELP}"),
    }
}

fn s_unit(agv_manager: &CommunicationSystem, index: &str) -> Result<Peer> {
    let index: usize = index.parse().context("the index is a number")?;
    let agv = agv_manager.s_units().into_iter().nth(index).ok_or_else(|| anyhow!("no s_unit has the index {index}"))?;
    // One that has just come may not have told its functions yet.
    let _ = agv.is_connected() && agv.wait_for_function("go_to", PATIENCE);
    Ok(agv)
}

fn functions(agv: &Peer) -> String {
    let functions = agv.their_function_list();
    functions.names().collect::<Vec<_>>().join(", ")
}

fn position() -> Result<Parameters> {
    let mut pos = Parameters::new();
    pos.add_int("position", 2)?;
    Ok(pos)
}

fn pos_info(agv: &Peer) -> Result<String> {
    let mut pos = position()?;
    agv.block_request("pos_info", &mut pos)?;
    Ok(format!("position {:?}", pos.variable::<[i64; 2]>("position")?))
}

fn go_to(agv: &Peer, target: [i64; 2]) -> Result<String> {
    let mut pos = position()?;
    pos.set_value("position", target)?;
    agv.call("go_to", &mut pos).renewing(Renew::Process).send()?;
    Ok(format!("accepted {target:?}"))
}

fn battery(agv: &Peer) -> Result<String> {
    let mut charge = Parameters::new();
    charge.add_float("charge", 1)?;
    agv.block_request("battery", &mut charge)?;
    Ok(format!("charge {:.1} %", charge.variable::<f64>("charge")?))
}

fn command(agv: &Peer, function: &str, done: &str) -> Result<String> {
    agv.block_request(function, &mut Parameters::new())?;
    Ok(done.to_owned())
}
