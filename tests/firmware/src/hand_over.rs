//! A board that two Linux managers hand over to each other, through losses of its power and of its manager.

use std::path::Path;

use anyhow::{Context, Result, ensure};
use cara_core::distribution::hello::Manager as Target;
use cara_core::distribution::message::HandOverRefusal;
use cara_std::control::Control;
use cara_std::{CommunicationSystem, Duration, HandOverError, Peer, UnitEvent};

use crate::board::{Bench, FLEET, Who};
use crate::keys::OTHER;
use crate::manager::{Manager, is_of_a_busy_host, position, sets_out};

/// For its answer.
const ANSWER: Duration = Duration::from_secs(20);

/// Runs it, and says what was seen.
pub(crate) fn run(bench: &Bench) -> Result<()> {
    let (cable, who, folder) = (bench.cable()?, Who::agv(17), tempfile::tempdir()?);
    let [at_depot, at_yard] = ["depot", "yard"].map(|name| folder.path().join(name));
    let (depot, yard) = (depot(bench, &at_depot)?, yard(bench, &at_yard)?);
    let (to_depot, to_yard) = (target("depot/1")?, target(OTHER)?);

    let board = bench.board(&cable, &who)?;
    let agv = depot.meet(&who)?;
    sets_out(&agv, [0, 50])?;
    let moving = patiently(|| agv.hand_over(&to_yard, ANSWER));
    ensure!(moving == Err(HandOverError::Refused(HandOverRefusal::Moves)), "while it moves it answers {moving:?}");
    agv.release("go_to")?;
    let nobody = target("stranger/3")?;
    let stranger = patiently(|| agv.hand_over(&nobody, ANSWER));
    ensure!(stranger == Err(HandOverError::Refused(HandOverRefusal::NoKey)), "of a stranger it answers {stranger:?}");
    moves(&depot, &yard, &who, &to_yard)?;
    println!("refused while it moves, and to a manager that it has no key with; then it goes over and drives there");

    board.cut_power()?;
    [&depot, &yard].into_iter().for_each(Manager::forget_events);
    let board = bench.board(&cable, &who)?;
    yard.joined(&who)?;
    drives(&yard, &who)?;
    ensure!(!has_joined(&depot, &who), "it has joined its first manager on the way");
    println!("after a loss of power it is back with its second manager, and with no other");

    moves(&yard, &depot, &who, &to_depot)?;
    board.cut_power()?;
    [&depot, &yard].into_iter().for_each(Manager::forget_events);
    let _board = bench.board(&cable, &who)?;
    depot.joined(&who)?;
    drives(&depot, &who)?;
    ensure!(!has_joined(&yard, &who), "it has joined the other one on the way");
    println!("handed back it is with its first manager again, also after a loss of power");

    drop(yard);
    depot.forget_events();
    let agv = depot.meet(&who)?;
    patiently(|| agv.hand_over(&to_yard, ANSWER)).context("to a manager that is gone")?;
    depot.left(&who)?;
    depot.joined(&who)?;
    drives(&depot, &who)?;
    println!("sent to a manager that is gone it comes back, and drives");
    Ok(())
}

fn target(name: &str) -> Result<Target> {
    let (name, id) = name.split_once('/').context("NAME/ID")?;
    Ok(Target::new(name, id.parse()?)?)
}

fn depot(bench: &Bench, folder: &Path) -> Result<Manager> {
    Manager::of(bench.keys.give(Manager::builder()?.state_folder(folder))?)
}

fn yard(bench: &Bench, folder: &Path) -> Result<Manager> {
    let Target { name, id } = target(OTHER)?;
    let builder = CommunicationSystem::builder(&name, id)?.fleet(FLEET).control(Control::Off);
    Manager::of(builder.key_file(bench.keys.other_file()?).state_folder(folder))
}

/// Asks again where this machine was too busy for an answer; one that was not heard has left all the same.
fn patiently(mut ask: impl FnMut() -> Result<(), HandOverError>) -> Result<(), HandOverError> {
    loop {
        match ask() {
            Err(HandOverError::Link(error)) if is_of_a_busy_host(&error) => {}
            ended => return ended,
        }
    }
}

/// Hands it over, and sees that the new manager commands it.
fn moves(from: &Manager, to: &Manager, who: &Who, target: &Target) -> Result<()> {
    let agv = from.meet(who)?;
    patiently(|| agv.hand_over(target, ANSWER))?;
    drives(to, who)?;
    ensure!(!from.system.s_unit(&who.name).is_ok_and(|agv| agv.is_connected()), "its old manager has it as well");
    Ok(())
}

fn drives(manager: &Manager, who: &Who) -> Result<()> {
    let agv: Peer = manager.meet(who)?;
    let [x, y] = position(&agv)?;
    sets_out(&agv, [x, y + 5])?;
    Ok(agv.release("go_to")?)
}

fn has_joined(manager: &Manager, who: &Who) -> bool {
    manager.has_seen(|event| matches!(event, UnitEvent::Joined { peer } if peer.name() == who.name))
}
