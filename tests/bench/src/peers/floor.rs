//! The floor: blocking sockets and nothing else. A length-prefixed frame in one write and normally one read, no Nagle,
//! a UTF-8 check and a string made at both ends. Whoever does less skips something that every middleware must do.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::thread;

use anyhow::{Result, ensure};

use super::{Caller, Peer, Server};

/// Longest text in bytes.
const TEXT_BYTES: usize = 100_000;
/// Bytes of the length in front of each text.
const PREFIX: usize = 4;

/// Raw blocking sockets; one thread per connection.
pub(crate) struct Floor;

impl Peer for Floor {
    fn start_server(&self, _run: u32) -> Result<Server> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let address = listener.local_addr()?.to_string();
        thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                thread::spawn(move || answer(stream));
            }
        });
        Ok(Server { address, keep: Box::new(()) })
    }

    fn connect(&self, _run: u32, address: &str) -> Result<Box<dyn Caller>> {
        Ok(Box::new(Frames::new(TcpStream::connect(address)?)?))
    }
}

/// Echoes until the other end closes.
fn answer(stream: TcpStream) -> Result<()> {
    let mut frames = Frames::new(stream)?;
    loop {
        let text = frames.receive()?;
        frames.send(&text)?;
    }
}

/// A connection with the buffers for one frame each way.
struct Frames {
    stream: TcpStream,
    incoming: Vec<u8>,
    outgoing: Vec<u8>,
}

impl Frames {
    fn new(stream: TcpStream) -> Result<Self> {
        stream.set_nodelay(true)?;
        let incoming = vec![0; PREFIX + TEXT_BYTES];
        Ok(Self { stream, incoming, outgoing: Vec::with_capacity(PREFIX + TEXT_BYTES) })
    }

    fn send(&mut self, text: &str) -> Result<()> {
        self.outgoing.clear();
        self.outgoing.extend_from_slice(&u32::try_from(text.len())?.to_le_bytes());
        self.outgoing.extend_from_slice(text.as_bytes());
        Ok(self.stream.write_all(&self.outgoing)?)
    }

    fn receive(&mut self) -> Result<String> {
        let mut have = 0;
        loop {
            let count = self.stream.read(&mut self.incoming[have..])?;
            ensure!(count > 0, "the connection was closed");
            have += count;
            let Some((prefix, rest)) = self.incoming[..have].split_first_chunk::<PREFIX>() else { continue };
            let length = u32::from_le_bytes(*prefix) as usize;
            ensure!(length <= TEXT_BYTES, "a frame of {length} bytes is too long");
            if let Some(text) = rest.get(..length) {
                return Ok(std::str::from_utf8(text)?.to_owned());
            }
        }
    }
}

impl Caller for Frames {
    fn echo(&mut self, text: &str) -> Result<usize> {
        self.send(text)?;
        Ok(self.receive()?.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_of_every_size_come_back() {
        let server = Floor.start_server(0).unwrap();
        let mut caller = Floor.connect(0, &server.address).unwrap();
        for length in [0, 1, 100, 20_000, TEXT_BYTES] {
            assert_eq!(caller.echo(&"x".repeat(length)).unwrap(), length);
        }
        assert_eq!(caller.echo("zażółć").unwrap(), "zażółć".len());
    }
}
