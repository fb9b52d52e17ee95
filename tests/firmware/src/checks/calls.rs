//! A board and its manager while nothing is broken.

use anyhow::{Context, Result, ensure};
use cara_std::{Delivery, Error, Parameters, Renew, RequestOptions, UnitEvent};

use crate::board::{Bench, Who};
use crate::manager::{Manager, arrives, at, drives, outcome, patiently, position, reset, sets_out};

/// What the board offers, in the order in which it was added.
const FUNCTIONS: &str = "\
pos_info(position: int[2]) -> (position: int[2])
battery() -> (charge: float)
stop()
reset()
echo(text: string[400]) -> (text: string[400])
go_to(position: int[2])
";

/// Two boards run the same image, and are told apart by what they are told.
pub(super) fn found(bench: &Bench, _: u32) -> Result<String> {
    let (cable, other_cable) = (bench.cable()?, bench.cable()?);
    let manager = Manager::start(&bench.keys)?;
    let _boards = (bench.board(&cable, &Who::agv(17))?, bench.board(&other_cable, &Who::agv(18))?);
    for id in [17, 18] {
        let peer = manager.meet(&Who::agv(id))?;
        ensure!(peer.id() == id, "{} has the number {}", peer.name(), peer.id());
        let shown = peer.their_function_list().show_functions().to_string();
        ensure!(shown == FUNCTIONS, "it shows\n{shown}");
    }
    Ok("two boards with one image".into())
}

pub(super) fn driven(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let board = bench.board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    ensure!(position(&agv)? == [0, 0], "it begins elsewhere");
    drives(&board, [1, 2], || Ok(agv.call("go_to", &mut at([1, 2])?).renewing(Renew::Process).send().map(drop)?))?;
    arrives(&agv, [1, 2])?;
    drives(&board, [0, 2], || sets_out(&agv, [0, 2]))?;
    arrives(&agv, [0, 2])?;
    let mut charge = Parameters::new();
    charge.add_float("charge", 1)?;
    patiently(|| agv.block_request("battery", &mut charge))?;
    let left: f64 = charge.variable("charge")?;
    ensure!(left < 100.0, "driving costs nothing: {left} % are left");
    for length in [0, 1, 100, 400] {
        let mut text = Parameters::<1024>::sized();
        text.add_string("text", 400)?;
        let sent = "a".repeat(length);
        text.set_value("text", sent.as_str())?;
        patiently(|| agv.block_request("echo", &mut text))?;
        ensure!(text.variable::<&str>("text")? == sent, "an echo of {length} characters came back changed");
    }
    Ok("asynchronously and blocking; float and string results".into())
}

pub(super) fn not_renewed(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let board = bench.board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    let once = RequestOptions { renew: Renew::Never, ..RequestOptions::default() };
    let mut far = at([1_000, 0])?;
    patiently(|| agv.call("go_to", &mut far).with(once).wait().map_err(Error::from))?;
    board.logs("stopped at")?;
    let [x, _] = position(&agv)?;
    ensure!((0..10).contains(&x), "it stands at {x}");
    let line = board.line();
    sets_out(&agv, [1_000, 0])?;
    agv.release("go_to")?;
    board.logs_behind(line, "stopped at")?;
    let line = board.line();
    sets_out(&agv, [1_000, 0])?;
    patiently(|| agv.block_request("stop", &mut Parameters::<512>::new()))?;
    board.logs_behind(line, "stopped at")?;
    let refused = outcome(|| agv.block_request("go_to", &mut at([0, 0])?));
    ensure!(matches!(refused, Err(Error::Inhibited { by: 1, reason: 0 })), "behind the stop it says {refused:?}");
    reset(&agv)?;
    sets_out(&agv, [0, 0])?;
    Ok(format!("without renewal after {x} units; on release; by a stop, until a reset"))
}

pub(super) fn wrong(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let _board = bench.board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    let mut empty = Parameters::<512>::new();
    let expect = |found: Result<(), Error>, wanted: Error| {
        ensure!(found == Err(wanted), "{found:?} in place of {wanted:?}");
        Ok(())
    };
    expect(agv.block_request("fly_to", &mut empty), Error::UnknownFunction)?;
    expect(agv.block_request("go_to", &mut empty), Error::MissingArgument { index: 0 })?;
    expect(agv.request("go_to", &empty).map(drop), Error::MissingArgument { index: 0 })?;
    let mut float = Parameters::<512>::new();
    float.add_float("position", 2)?;
    expect(agv.block_request("go_to", &mut float), Error::WrongType { index: 0 })?;
    let mut short = Parameters::<512>::new();
    short.add_int("position", 1)?;
    expect(agv.block_request("go_to", &mut short), Error::WrongSize { index: 0, expected: 2, found: 1 })?;
    let mut long = Parameters::<4096>::sized();
    long.add_string("text", 2_000)?;
    long.set_value("text", "a".repeat(2_000).as_str())?;
    let refused = agv.block_request("echo", &mut long);
    ensure!(refused.is_err(), "a text of 2,000 characters passes a limit of 400");
    ensure!(position(&agv)? == [0, 0], "it has moved");
    Ok(format!("unknown, missing, type, size; oversize: {refused:?}"))
}

pub(super) fn best_effort(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let board = bench.board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    let one_datagram = RequestOptions { delivery: Delivery::BestEffort, ..RequestOptions::renewing(Renew::Process) };
    drives(&board, [1, 1], || Ok(agv.call("go_to", &mut at([1, 1])?).with(one_datagram).send().map(drop)?))?;
    Ok("in one datagram".into())
}

pub(super) fn mechanic(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let board = bench.board(&cable, &Who::agv(17))?;
    manager.meet(&Who::agv(17))?;
    manager.offer_mechanic()?;
    board.logs("a mechanic comes in 5 minutes")?;
    Ok("after it was published".into())
}

/// The manager offers far more than a board keeps: it keeps some, and says how many it has skipped.
pub(super) fn many_functions(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let board = bench.board(&cable, &Who::agv(17))?;
    let functions = manager.system.my_function_list();
    let nothing = Parameters::<512>::new();
    for number in 0..40 {
        let name = format!("a_function_with_a_long_name_{number}");
        functions.add_function(&name, &nothing, |parameters: Parameters| parameters)?;
    }
    manager.system.publish_my_function_list()?;
    let agv = manager.meet(&Who::agv(17))?;
    let event = manager.event("skipped functions", |event| matches!(event, UnitEvent::FunctionsSkipped { .. }))?;
    let UnitEvent::FunctionsSkipped { skipped, .. } = event else { return Err(Error::NotConnected.into()) };
    ensure!((1..40).contains(&skipped), "{skipped} skipped");
    drives(&board, [1, 0], || sets_out(&agv, [1, 0])).context("it no longer serves")?;
    Ok(format!("{} kept, {skipped} skipped", 40 - skipped))
}
