//! The baseline: blocking sockets and nothing else. A length-prefixed frame in one write and normally one read, no
//! Nagle, a UTF-8 check and a string made at both ends: less than this would skip something that every middleware must
//! do.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::ops::Range;
use std::sync::Arc;
use std::thread;

use anyhow::{Result, ensure};
use cara_bench_ends::{Caller, Delivery, Executed, Peer, Place, Printer, Server};

/// Longest text in bytes.
const TEXT_BYTES: usize = 100_000;
/// Bytes of the length in front of each text.
const PREFIX: usize = 4;
/// Set in the length of a text that wants no answer.
const ONE_WAY: u32 = 1 << 31;

/// Raw blocking sockets; one thread per connection.
pub(crate) struct Floor;

impl Peer for Floor {
    fn start_server(&self, place: &Place) -> Result<Server> {
        let listener = TcpListener::bind((place.host(), 0))?;
        let address = listener.local_addr()?.to_string();
        let executed = Arc::new(Executed::default());
        let (counted, printer) = (executed.clone(), place.printer());
        thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let counted = counted.clone();
                thread::spawn(move || answer(stream, &counted, printer));
            }
        });
        Ok(Server::new(address, executed, ()))
    }

    fn connect(&self, _place: &Place, address: &str) -> Result<Box<dyn Caller>> {
        Ok(Box::new(Frames::new(TcpStream::connect(address)?)?))
    }
}

/// Serves until the other end closes.
fn answer(stream: TcpStream, executed: &Executed, printer: Printer) -> Result<()> {
    let mut frames = Frames::new(stream)?;
    loop {
        let (text, is_one_way) = frames.receive()?;
        printer.print(&text);
        match is_one_way {
            true => executed.note(),
            false => frames.write(&text, 0)?,
        }
    }
}

/// A connection with the buffers for frames each way.
struct Frames {
    stream: TcpStream,
    incoming: Vec<u8>,
    /// The part of `incoming` that is filled and not yet taken: frames that want no answer may come together.
    filled: Range<usize>,
    outgoing: Vec<u8>,
}

impl Frames {
    fn new(stream: TcpStream) -> Result<Self> {
        stream.set_nodelay(true)?;
        let incoming = vec![0; PREFIX + TEXT_BYTES];
        Ok(Self { stream, incoming, filled: 0..0, outgoing: Vec::with_capacity(PREFIX + TEXT_BYTES) })
    }

    fn write(&mut self, text: &str, flag: u32) -> Result<()> {
        self.outgoing.clear();
        self.outgoing.extend_from_slice(&(u32::try_from(text.len())? | flag).to_le_bytes());
        self.outgoing.extend_from_slice(text.as_bytes());
        Ok(self.stream.write_all(&self.outgoing)?)
    }

    /// The next text, and whether it wants no answer.
    fn receive(&mut self) -> Result<(String, bool)> {
        loop {
            if let Some((prefix, rest)) = self.incoming[self.filled.clone()].split_first_chunk::<PREFIX>() {
                let prefix = u32::from_le_bytes(*prefix);
                let length = (prefix & !ONE_WAY) as usize;
                ensure!(length <= TEXT_BYTES, "a frame of {length} bytes is too long");
                if let Some(text) = rest.get(..length) {
                    let text = std::str::from_utf8(text)?.to_owned();
                    self.filled.start += PREFIX + length;
                    return Ok((text, prefix & ONE_WAY != 0));
                }
            }
            self.fill()?;
        }
    }

    fn fill(&mut self) -> Result<()> {
        if self.filled.start > 0 {
            self.incoming.copy_within(self.filled.clone(), 0);
            self.filled = 0..self.filled.len();
        }
        let count = self.stream.read(&mut self.incoming[self.filled.end..])?;
        ensure!(count > 0, "the connection was closed");
        self.filled.end += count;
        Ok(())
    }
}

impl Caller for Frames {
    fn echo(&mut self, text: &str) -> Result<usize> {
        self.write(text, 0)?;
        Ok(self.receive()?.0.len())
    }

    fn send(&mut self, text: &str, delivery: Delivery) -> Result<(), String> {
        match delivery {
            Delivery::Reliable => self.write(text, ONE_WAY).map_err(|error| error.to_string()),
            Delivery::BestEffort => Err("the floor has no datagrams".into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::{Duration, Instant};

    #[test]
    fn texts_of_every_size_come_back() {
        let server = Floor.start_server(&Place::default()).unwrap();
        let mut caller = Floor.connect(&Place::default(), &server.address).unwrap();
        for length in [0, 1, 100, 20_000, TEXT_BYTES] {
            assert_eq!(caller.echo(&"x".repeat(length)).unwrap(), length);
        }
        assert_eq!(caller.echo("zażółć").unwrap(), "zażółć".len());
    }

    #[test]
    fn one_way_texts_are_counted_by_who_takes_them() {
        let server = Floor.start_server(&Place::default()).unwrap();
        let mut caller = Floor.connect(&Place::default(), &server.address).unwrap();
        for length in [0, 1, 100, 20_000, TEXT_BYTES] {
            for _ in 0..20 {
                caller.send(&"x".repeat(length), Delivery::Reliable).unwrap();
            }
        }
        assert!(caller.send("x", Delivery::BestEffort).is_err());
        let end = Instant::now() + Duration::from_secs(20);
        while server.executed.read().0 < 100 && Instant::now() < end {
            thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(server.executed.read().0, 100);
    }
}
