//! A line and the sockets of its other end's unit, joined by one loop.

use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use cara_core::config::LINE_FRAME_BYTES;
use cara_core::host::line::{Line, State};
use cara_core::time::{Duration as Span, Instant as Moment};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::net::sockopt::socket_error;

use crate::host::Host;
use crate::tty::{Tty, none_if_waiting};

const BUFFER_BYTES: usize = 4_096;
/// Longest wait, for a clock that is narrower than the line's.
const LONGEST_WAIT: Duration = Duration::from_secs(60);
/// By how much a frame may be late and count as sent right behind the one before.
const LATENESS: Span = Span::from_millis(1);

pub(crate) struct Bridge<'h> {
    tty: Tty,
    host: &'h mut Host,
    line: Line,
    baud: u32,
    start: Instant,
    /// The link of a unit of this host, and whether it is still being dialled.
    link: Option<TcpStream>,
    is_dialing: bool,
    /// What the device has not taken yet of a frame.
    unsent: Vec<u8>,
    /// When the frames so far are out: a device takes more than is on the wire, and what it has cannot be overtaken.
    free: Moment,
}

impl<'h> Bridge<'h> {
    pub(crate) fn new(tty: Tty, host: &'h mut Host, baud: u32) -> Self {
        let seed = u64::from(std::process::id()) << 32 ^ since_epoch();
        let (start, free) = (Instant::now(), Moment::START);
        let line = Line::new(baud, seed);
        Self { tty, host, line, baud, start, link: None, is_dialing: false, unsent: Vec::new(), free }
    }

    /// Works until the device fails.
    pub(crate) fn run(mut self) -> io::Error {
        loop {
            if let Err(error) = self.turn() {
                return error;
            }
        }
    }

    fn turn(&mut self) -> io::Result<()> {
        self.read_device()?;
        let line = &mut self.line;
        self.host.receive(|to, from, datagram| {
            line.send_datagram(to, from, datagram);
        })?;
        self.carry_link();
        self.write_device()?;
        self.wait()
    }

    fn now(&self) -> Moment {
        Moment::from_micros(u64::try_from(self.start.elapsed().as_micros()).unwrap_or(u64::MAX))
    }

    fn read_device(&mut self) -> io::Result<()> {
        let mut buffer = [0; BUFFER_BYTES];
        let count = self.tty.read(&mut buffer)?;
        let mut rest = buffer.get(..count).unwrap_or_default();
        while !rest.is_empty() {
            let consumed = self.line.receive(rest, self.now());
            rest = rest.get(consumed..).unwrap_or_default();
            if let Some(datagram) = self.line.next_datagram()
                && let Err(error) = self.host.deliver(&datagram)
            {
                cara_tools::output::warning(format_args!("a datagram of the line was not passed on: {error}"));
            }
            // A full stream is emptied before more of it comes.
            self.carry_link();
        }
        Ok(())
    }

    /// Brings the link of this host to where that of the line is, and carries bytes.
    fn carry_link(&mut self) {
        match self.line.state() {
            State::Idle => {
                self.link = None;
                if let Some((port, stream)) = self.host.accept()
                    && self.line.dial(port)
                {
                    self.link = Some(stream);
                }
            }
            State::Offered(port) => self.take_offered(port),
            State::Open => {
                if self.forward().is_err() {
                    self.close();
                }
            }
            State::Ended(_) => {
                let _ = self.write_link();
                self.close();
            }
            State::Dialing | State::Closing => {}
        }
    }

    /// Dials the unit that is meant, and accepts when it has answered.
    fn take_offered(&mut self, port: u16) {
        if !self.is_dialing {
            self.link = self.host.dial(port).ok();
            self.is_dialing = self.link.is_some();
        }
        match &self.link {
            None => self.close(),
            Some(stream) if stream.peer_addr().is_ok() => {
                self.is_dialing = false;
                self.line.accept();
            }
            Some(stream) => {
                if !matches!(socket_error(stream), Ok(Ok(()))) {
                    self.close();
                }
            }
        }
    }

    fn close(&mut self) {
        (self.link, self.is_dialing) = (None, false);
        let now = self.now();
        self.line.close(now);
    }

    /// Bytes in both directions; an error when the host's link has ended.
    fn forward(&mut self) -> io::Result<()> {
        self.write_link()?;
        let Some(stream) = &mut self.link else { return Err(io::ErrorKind::NotConnected.into()) };
        let mut buffer = [0; BUFFER_BYTES];
        let free = self.line.capacity().min(buffer.len());
        let Some(buffer) = buffer.get_mut(..free).filter(|buffer| !buffer.is_empty()) else { return Ok(()) };
        match stream.read(buffer) {
            Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
            read => {
                let count = none_if_waiting(read)?;
                self.line.write(buffer.get(..count).unwrap_or_default());
                Ok(())
            }
        }
    }

    fn write_link(&mut self) -> io::Result<()> {
        let Some(stream) = &mut self.link else { return Ok(()) };
        while !self.line.peek().is_empty() {
            match none_if_waiting(stream.write(self.line.peek()))? {
                0 => break,
                count => self.line.take(count),
            }
        }
        Ok(())
    }

    /// Gives the device a frame when the one before is out.
    fn write_device(&mut self) -> io::Result<()> {
        let now = self.now();
        if self.unsent.is_empty() && now >= self.free {
            let mut buffer = [0; LINE_FRAME_BYTES];
            let frame = self.line.transmit(now, &mut buffer);
            self.unsent.extend_from_slice(frame);
            let micros = (frame.len() as u64).saturating_mul(10_000_000).checked_div(self.baud.into()).unwrap_or(0);
            // The loop is late by a little each time, which must not add up.
            let start = if now.since(self.free) < LATENESS { self.free } else { now };
            self.free = start + Span::from_micros(micros);
        }
        if !self.unsent.is_empty() {
            let count = self.tty.write(&self.unsent)?;
            self.unsent.drain(..count);
        }
        Ok(())
    }

    /// Waits until there is something to do.
    fn wait(&mut self) -> io::Result<()> {
        let now = self.now();
        let has_bytes = !self.line.peek().is_empty();
        let state = self.line.state();
        let mut watched = vec![PollFd::new(&self.tty, when(!self.unsent.is_empty(), PollFlags::IN))];
        watched.extend(self.host.hears().map(|socket| PollFd::new(socket, PollFlags::IN)));
        if state == State::Idle {
            watched.extend(self.host.links.iter().map(|(_, socket)| PollFd::new(socket, PollFlags::IN)));
        }
        if let Some(stream) = &self.link {
            let reads = state == State::Open && self.line.capacity() > 0;
            let events = if reads { PollFlags::IN } else { PollFlags::empty() };
            // A link whose other end has gone, while nothing is to be read of it, is looked at when something is.
            let events = when(self.is_dialing || has_bytes, events);
            if !events.is_empty() {
                watched.push(PollFd::new(stream, events));
            }
        }
        // Later than the frame that is being sent, there may be another one.
        let due = if now < self.free { self.free } else { self.line.deadline() };
        let wait = Duration::from_micros(due.since(now).as_micros()).min(LONGEST_WAIT);
        match poll(&mut watched, Timespec::try_from(wait).ok().as_ref()) {
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
            Err(errno) => Err(errno.into()),
        }
    }
}

/// `events`, with writing where it is waited for.
fn when(writes: bool, events: PollFlags) -> PollFlags {
    if writes { events | PollFlags::OUT } else { events }
}

/// Differs from start to start.
fn since_epoch() -> u64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    since.map_or(0, |since| since.as_micros() as u64)
}
