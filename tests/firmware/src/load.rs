//! What makes the stack of a board deepest: everything that an image does, one after the other. How deep it was, the
//! board finds by painting its stack.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::time::Duration;

use anyhow::{Context, Result, bail, ensure};
use cara_std::Parameters;
use clap::ValueEnum;

use crate::board::{self, Bench, Board, Cable, LONG, Who};
use crate::manager::{Manager, at, patiently, position, reset, sets_out};

/// An image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Image {
    /// The AGV.
    Agv,
    /// The least unit.
    Unit,
    /// The same, whose settings say where its manager is.
    UnitFixed,
    /// The bare TCP echo.
    Echo,
}

/// How often everything is done: interrupts come at other places each time.
const ROUNDS: u32 = 3;
/// Where the echo listens, and how much it is sent.
pub(crate) const ECHO_PORT: u16 = 7777;
const ECHO_BYTES: usize = 20_000;
/// Where a board's settings may name the manager.
const MANAGER: &str = "10.77.0.1:4000";
const MANAGER_PORT: u16 = 4000;
/// The board looks at its stack every second, the echo every five.
const LOOKED: Duration = Duration::from_secs(6);

/// Puts an image under load and prints the board's line about its stack, `stack N of M bytes`.
pub(crate) fn run(bench: &Bench, image: Image) -> Result<()> {
    let cable = bench.cable()?;
    let manager_address = (image == Image::UnitFixed).then_some(MANAGER);
    let board = bench.board(&cable, &Who { manager_address, ..Who::agv(17) })?;
    for round in 0..ROUNDS {
        match image {
            Image::Agv => vehicle(bench, &board, &cable, round)?,
            Image::Unit | Image::UnitFixed => least(bench, &board, &cable)?,
            Image::Echo => echo(&cable)?,
        }
    }
    std::thread::sleep(LOOKED);
    println!("{}", board.last_with("stack ").context("the board says nothing of its stack")?);
    Ok(())
}

/// Joining, lists in both directions, calls in both directions, refusals, a lost manager and a pulled cable.
fn vehicle(bench: &Bench, board: &Board, cable: &Cable, round: u32) -> Result<()> {
    let who = Who::agv(17);
    let line = board.line();
    let manager = Manager::start(&bench.keys)?;
    let functions = manager.system.my_function_list();
    for number in 0..40 {
        let name = format!("a_function_with_a_long_name_{number}");
        functions.add_function(&name, &Parameters::<512>::new(), |parameters: Parameters| parameters)?;
    }
    manager.system.publish_my_function_list()?;
    let agv = manager.meet(&who)?;
    // Of an image with streams.
    let streams = ["pose", "charge"].map(|name| agv.stream(name).map(|stream| stream.subscribe(Duration::ZERO)));
    for x in 1..=2 {
        sets_out(&agv, [x + 2 * i64::from(round), 0])?;
        agv.request("pos_info", &at([0, 0])?)?;
        position(&agv)?;
        let mut text = Parameters::<1024>::sized();
        text.add_string("text", 400)?;
        text.set_value("text", "a".repeat(400).as_str())?;
        patiently(|| agv.block_request("echo", &mut text))?;
    }
    ensure!(agv.block_request("fly_to", &mut at([0, 0])?).is_err(), "it flies");
    patiently(|| agv.block_request("stop", &mut Parameters::<512>::new()))?;
    reset(&agv)?;
    for mut stream in streams.into_iter().flatten() {
        stream.next(LONG)?;
    }
    drop(manager);
    board.logs_behind(line, "depot has left")?;
    // A list that is full with other functions has no room for the mechanic.
    let manager = Manager::start(&bench.keys)?;
    manager.offer_mechanic()?;
    manager.meet(&who)?;
    board.logs_behind(line, "a mechanic comes in 5 minutes")?;
    let line = board.line();
    cable.pull()?;
    board.logs_behind(line, "depot has left")?;
    cable.plug_in()
}

/// Joining, a list, calls, refusals, a lost manager and a pulled cable.
fn least(bench: &Bench, board: &Board, cable: &Cable) -> Result<()> {
    let who = Who::agv(17);
    let mut line = board.line();
    for loss in [Loss::OfManager, Loss::OfCable] {
        let manager = Manager::of(bench.keys.give(Manager::builder()?.tcp_port(MANAGER_PORT))?)?;
        manager.offer_mechanic()?;
        let unit = manager.meet_offering(&who, "add")?;
        for number in 0..10 {
            let mut sum = Parameters::<256>::sized();
            for name in ["a", "b", "sum"] {
                sum.add_int(name, 1)?;
                sum.set_value(name, number)?;
            }
            unit.request("add", &sum)?;
            patiently(|| unit.block_request("add", &mut sum))?;
            ensure!(sum.variable::<i64>("sum")? == 2 * number, "it cannot add");
        }
        ensure!(unit.block_request("add", &mut at([0, 0])?).is_err(), "it adds a position");
        match loss {
            Loss::OfManager => drop(manager),
            Loss::OfCable => cable.pull()?,
        }
        board.logs_behind(line, "depot has left")?;
        line = board.line();
        cable.plug_in()?;
    }
    Ok(())
}

enum Loss {
    OfManager,
    OfCable,
}

/// More than fits its buffers, there and back.
fn echo(cable: &Cable) -> Result<()> {
    let address = SocketAddr::new(board::address(cable).into(), ECHO_PORT);
    let mut stream = connected(address)?;
    stream.set_read_timeout(Some(LONG))?;
    let mut writer = stream.try_clone()?;
    let writing = std::thread::spawn(move || -> Result<()> {
        writer.write_all(&[7; ECHO_BYTES])?;
        Ok(writer.shutdown(Shutdown::Write)?)
    });
    let mut back = Vec::new();
    stream.read_to_end(&mut back)?;
    ensure!(back.len() == ECHO_BYTES, "{} bytes came back", back.len());
    match writing.join() {
        Ok(written) => written,
        Err(_) => bail!("the writer ended"),
    }
}

/// A connection, as soon as the board takes one.
pub(crate) fn connected(address: SocketAddr) -> Result<TcpStream> {
    let mut tries = 0;
    loop {
        match TcpStream::connect_timeout(&address, Duration::from_secs(1)) {
            Err(_) if tries < 60 => tries += 1,
            connected => return connected.with_context(|| format!("nobody answers at {address}")),
        }
        std::thread::sleep(Duration::from_millis(200));
    }
}
