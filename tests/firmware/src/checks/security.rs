//! Boards that have no keys, other keys, or bad random numbers, and boards that are told to be insecure.

use std::collections::BTreeSet;
use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, channel};
use std::thread;

use anyhow::{Context, Result, ensure};
use cara_core::config::Mode;
use cara_core::distribution::hello::Hello;
use cara_core::distribution::identity::Epoch;
use cara_core::host::frame::Frame;
use cara_std::{CloseReason, UnitEvent};

use crate::board::{Bench, LONG, Who};
use crate::manager::{Manager, position};

/// The ports of a manager whose address boards are given, and of a listener in between.
const DIRECT_PORT: u16 = 4000;
const DIRECT: &str = "10.77.0.1:4000";
const BETWEEN: &str = "10.77.0.1:4001";

pub(super) fn no_keys(bench: &Bench, _: u32) -> Result<String> {
    let (cable, other_cable) = (bench.cable()?, bench.cable()?);
    let manager = Manager::start(&bench.keys)?;
    let unknown = bench.with(bench.keys.none()?);
    let board = unknown.board(&cable, &Who::agv(17))?;
    board.logs("there are no keys, and this board joins no manager without")?;
    let _other = bench.board(&other_cable, &Who::agv(18))?;
    manager.meet(&Who::agv(18))?;
    ensure!(manager.system.number_of_s_units() == 1, "it has joined");
    Ok("and says what to do".into())
}

/// A board of another root is not heard when it searches, and when it dials it is refused before the node knows of it.
pub(super) fn other_keys(bench: &Bench, _: u32) -> Result<String> {
    let (cable, direct_cable, good_cable) = (bench.cable()?, bench.cable()?, bench.cable()?);
    let others = bench.with(bench.keys.others()?);
    let manager = Manager::of(bench.keys.give(Manager::builder()?.tcp_port(DIRECT_PORT))?)?;
    let _searches = others.board(&cable, &Who::agv(17))?;
    let dials = others.board(&direct_cable, &Who { manager_address: Some(DIRECT), ..Who::agv(17) })?;
    dials.logs("could not join, or be joined")?;
    let refused = |event: &UnitEvent| matches!(event, UnitEvent::NotJoined { reason: CloseReason::BadProof, .. });
    manager.event("refused proof", refused)?;
    let _good = bench.board(&good_cable, &Who { manager_address: Some(DIRECT), ..Who::agv(18) })?;
    position(&manager.meet(&Who::agv(18))?)?;
    ensure!(manager.system.number_of_s_units() == 1, "it has joined");
    Ok("neither found nor let in, and its log says so".into())
}

pub(super) fn insecure(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
    let plain = bench.with(bench.keys.plain()?);
    let board = plain.board(&cable, &Who::agv(17))?;
    board.logs("this unit is INSECURE")?;
    let other = Manager::start(&plain.keys)?;
    position(&other.meet(&Who::agv(17))?)?;
    ensure!(manager.system.number_of_s_units() == 0, "a board without keys has joined a manager with keys");
    Ok("each meets its like".into())
}

/// What a board says on its first link in one life.
struct Said {
    /// What it draws first.
    epoch: Epoch,
    proof: Vec<u8>,
    sealed: Vec<Vec<u8>>,
}

/// Times that a board is started.
const LIVES: usize = 5;

/// Each life of a board has the same noise. With the count of its starts it draws other numbers each time; with a generator
/// that is constant it draws the same ones, and the keys of its links differ nonetheless, since they depend on what the manager
/// draws.
pub(super) fn lives(bench: &Bench, _: u32) -> Result<String> {
    let heard = listen_between()?;
    let counted = said(bench, &heard)?;
    ensure!(epochs(&counted) == LIVES, "two lives have drawn the same");
    differ(&counted)?;
    let Some(constant) = bench.constant()? else { return Ok(format!("{LIVES} lives with the same noise")) };
    let same = said(&constant, &heard)?;
    ensure!(epochs(&same) == 1, "the generator is not constant");
    differ(&same)?;
    Ok(format!("{LIVES} lives with the same noise, and {LIVES} that draw the same numbers"))
}

fn epochs(lives: &[Said]) -> usize {
    lives.iter().map(|said| said.epoch).collect::<BTreeSet<_>>().len()
}

/// No message of a proof, and no sealed frame, comes twice: all of them would where two links have one key.
fn differ(lives: &[Said]) -> Result<()> {
    let proofs: BTreeSet<&Vec<u8>> = lives.iter().map(|said| &said.proof).collect();
    ensure!(proofs.len() == lives.len(), "two links begin with the same proof");
    let sealed: Vec<&Vec<u8>> = lives.iter().flat_map(|said| &said.sealed).collect();
    let different: BTreeSet<&&Vec<u8>> = sealed.iter().collect();
    ensure!(sealed.len() > 2 * lives.len() && different.len() == sealed.len(), "a sealed frame comes twice");
    Ok(())
}

/// What a board sends in each boot, recorded between it and its manager.
fn said(bench: &Bench, heard: &Receiver<Vec<u8>>) -> Result<Vec<Said>> {
    let cable = bench.cable()?;
    let manager = Manager::of(bench.keys.give(Manager::builder()?.tcp_port(DIRECT_PORT))?)?;
    let who = Who { manager_address: Some(BETWEEN), seed: Some(7), ..Who::agv(17) };
    let mut lives = Vec::new();
    for _ in 0..LIVES {
        let board = bench.board(&cable, &who)?;
        board.logs("has joined")?;
        position(&manager.meet(&who)?)?;
        board.cut_power()?;
        manager.left(&who)?;
        // A board may dial before its manager listens.
        let mut links = std::iter::from_fn(|| heard.recv_timeout(LONG).ok());
        lives.push(read(&links.find(|said| !said.is_empty()).context("nothing was heard")?)?);
    }
    Ok(lives)
}

/// Passes on what is said on each connection; when it has ended, tells what the board has said.
fn listen_between() -> Result<Receiver<Vec<u8>>> {
    let listener = TcpListener::bind(BETWEEN)?;
    let (notify, heard) = channel();
    thread::spawn(move || {
        for board in listener.incoming().map_while(Result::ok) {
            let reported = notify.send(passed_on(board).unwrap_or_default());
            if reported.is_err() {
                return;
            }
        }
    });
    Ok(heard)
}

fn passed_on(mut board: TcpStream) -> Result<Vec<u8>> {
    let mut manager = TcpStream::connect(DIRECT)?;
    let (mut back, mut forth) = (manager.try_clone()?, board.try_clone()?);
    // The manager ends the connection when it misses the board.
    thread::spawn(move || {
        let _ = std::io::copy(&mut back, &mut forth);
        forth.shutdown(Shutdown::Both)
    });
    let mut heard = Vec::new();
    let mut bytes = [0; 1024];
    while let Ok(length @ 1..) = board.read(&mut bytes) {
        heard.extend_from_slice(&bytes[..length]);
        manager.write_all(&bytes[..length])?;
    }
    Ok(heard)
}

fn read(mut heard: &[u8]) -> Result<Said> {
    let mut frames = Vec::new();
    while let Some((length, rest)) = heard.split_first_chunk() {
        let Some((frame, rest)) = rest.split_at_checked(u16::from_le_bytes(*length).into()) else { break };
        frames.push(frame.to_vec());
        heard = rest;
    }
    let mut frames = frames.into_iter();
    let (hello, proof) = (frames.next().context("no hello")?, frames.next().context("no proof")?);
    let Ok(Frame::Hello(hello)) = Frame::parse(&hello) else { anyhow::bail!("it does not begin with a hello") };
    let hello = Hello::decode(hello, Mode::Secured).map_err(|error| anyhow::anyhow!("{error:?}"))?;
    ensure!(matches!(Frame::parse(&proof), Ok(Frame::Proof(_))), "no proof follows its hello");
    Ok(Said { epoch: hello.epoch, proof, sealed: frames.collect() })
}
