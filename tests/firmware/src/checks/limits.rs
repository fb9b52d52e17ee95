//! Limits that the board and its manager have told each other, kept and broken.

use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};

use anyhow::{Context, Result, bail, ensure};
use cara_std::{Constraints, Parameters};

use crate::board::{Bench, LONG, Who};
use crate::manager::{Manager, position};

/// The manager knows the board's limit, and the board its manager's: neither sends what the other cannot take.
pub(super) fn oversize(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let manager = Manager::start(&bench.keys)?;
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

/// The address of a false manager that breaks the limits.
const FALSE_MANAGER: &str = "10.77.0.1:4000";
/// A frame's header that announces the longest body there is.
const TOO_LONG: [u8; 2] = u16::MAX.to_le_bytes();
/// The frame that ends a link, and its code for what is too long (`docs/wire.md`, Frames).
const CLOSED_FOR_LENGTH: [u8; 4] = [2, 0, 0x03, 6];

/// Links on which the board's last words are waited for, of which so many must arrive.
const LINKS: usize = 12;
const REPORTED: usize = 3;

/// The board ends every link, with a code, and dials again. It has one socket: when it dials again before the network has
/// taken its last words, they are lost with the link that they end.
pub(super) fn breaks_its_limit(bench: &Bench, _: u32) -> Result<String> {
    let cable = bench.cable()?;
    let listener = TcpListener::bind(FALSE_MANAGER)?;
    let _board = bench.board(&cable, &Who { manager_address: Some(FALSE_MANAGER), ..Who::agv(17) })?;
    let (mut reported, mut cut) = (0, 0);
    while reported < REPORTED {
        ensure!(reported + cut < LINKS, "{reported} of {LINKS} links ended with the code");
        let (stream, _) = listener.accept()?;
        match answered(stream).context("the link does not end")? {
            Ending::Closed(said) if said.ends_with(&CLOSED_FOR_LENGTH) => reported += 1,
            Ending::Closed(said) => bail!("the board's last words are {said:?}"),
            Ending::Reset(said) if said.ends_with(&CLOSED_FOR_LENGTH) => reported += 1,
            Ending::Reset(_) => cut += 1,
        }
    }
    Ok(format!("with code 6, {reported} times; {cut} times cut short"))
}

/// How the board ended a link, and everything that it said before.
enum Ending {
    Closed(Vec<u8>),
    Reset(Vec<u8>),
}

/// Says that too much is coming, and listens until the board ends the link.
fn answered(mut stream: TcpStream) -> Result<Ending> {
    stream.set_read_timeout(Some(LONG))?;
    stream.write_all(&TOO_LONG)?;
    let mut said = Vec::new();
    match stream.read_to_end(&mut said) {
        Err(error) if error.kind() == ErrorKind::ConnectionReset => Ok(Ending::Reset(said)),
        read => Ok(Ending::Closed(read.map(|_| said)?)),
    }
}
