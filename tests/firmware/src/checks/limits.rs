//! Limits that the board and its manager have told each other, kept and broken.

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};

use anyhow::{Context, Result, ensure};
use cara_std::{Constraints, Parameters};

use crate::board::{Bench, LONG, Who};
use crate::manager::{Manager, position};

/// The manager knows the board's limit, and the board its manager's: neither sends what the other cannot take.
pub(super) fn oversize(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start()?;
    let small = Constraints { message_size: 16, ..manager.system.constraints() };
    manager.system.set_constraints(small)?;
    manager.offer_mechanic()?;
    let board = bench.board(&cable, &Who::agv(17))?;
    let agv = manager.meet(&Who::agv(17))?;
    let mut text = Parameters::<4096>::sized();
    text.add_string("text", 2_000)?;
    text.set_value("text", "a".repeat(2_000).as_str())?;
    let refused = agv.block_request("echo", &mut text);
    ensure!(refused.is_err(), "2,000 characters pass a limit of 1 KiB");
    board.logs("no mechanic: ask the")?;
    position(&agv)?;
    Ok(format!("by the manager: {refused:?}; by the board: no mechanic"))
}

/// Where somebody who breaks the limits stands in for the manager.
const STRANGER: &str = "10.77.0.1:4000";
/// A frame's header that announces the longest body there is.
const TOO_LONG: [u8; 2] = u16::MAX.to_le_bytes();
/// The frame that ends a link, and its code for what is too long (`docs/wire.md`, Frames).
const CLOSED_FOR_LENGTH: [u8; 4] = [2, 0, 0x03, 6];

/// The board ends the link with a code, and dials again.
pub(super) fn breaks_its_limit(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let listener = TcpListener::bind(STRANGER)?;
    let _board = bench.board(&cable, &Who { more: "manager_address=10.77.0.1:4000", ..Who::agv(17) })?;
    for _ in 0..3 {
        let (stream, _) = listener.accept()?;
        let said = answered(stream).context("the link does not end")?;
        ensure!(said.ends_with(&CLOSED_FOR_LENGTH), "the board's last words are {said:?}");
    }
    Ok("with code 6, three times".into())
}

/// Says that too much is coming; everything that the board says until it closes.
fn answered(mut stream: TcpStream) -> Result<Vec<u8>> {
    stream.set_read_timeout(Some(LONG))?;
    stream.write_all(&TOO_LONG)?;
    let mut said = Vec::new();
    match stream.read_to_end(&mut said) {
        // The board has one socket, and resets what is still saying farewell when it dials again.
        Err(error) if error.kind() == ErrorKind::ConnectionReset => Ok(said),
        read => Ok(read.map(|_| said)?),
    }
}
