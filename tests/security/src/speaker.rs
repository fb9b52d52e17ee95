//! One end of a link that speaks the wire protocol through raw sockets, step by step, with any key, as the dialling or
//! the accepting end. Each message is handed out before it is sent, so that it can be changed, repeated or replaced.

use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::time::Duration;

use cara_core::config::{Mode, Priority};
use cara_core::distribution::datagram::session_header;
use cara_core::distribution::function_list::{Generation, Slot};
use cara_core::distribution::hello::{Hello, Limits, Manager};
use cara_core::distribution::identity::{Epoch, Fleet, Identity};
use cara_core::distribution::message::{Message, RequestHeader, SessionBody};
use cara_core::host::connections::Report;
use cara_core::host::frame::{self, Frame};
use cara_core::host::secure::{Seal, Secure};
use cara_secure::keys::PairKey;
use cara_secure::link::{Cipher, Credentials};
use cara_secure::suite::Suite;

/// Longest wait for the other end.
pub const PATIENCE: Duration = Duration::from_secs(30);
/// The first steps, which prove the link.
pub const HANDSHAKE: usize = 3;
/// All steps.
pub const STEPS: usize = 8;
/// The kind of a chunk that is a whole message.
const WHOLE: u8 = 0x13;

/// The identity that an end claims.
#[derive(Clone, Debug)]
pub struct Claim {
    /// The fleet.
    pub fleet: Fleet,
    /// The name.
    pub identity: Identity,
    /// The manager that it wants, of a vehicle.
    pub wanted: Option<Manager>,
}

/// A message to be sent.
#[derive(Clone, Debug)]
pub struct Said {
    /// It goes as a datagram.
    pub datagram: bool,
    /// All of it.
    pub bytes: Vec<u8>,
}

/// How the other end has ended a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// With a close frame of this code.
    Closed(u8),
    /// With a refusal.
    Refused,
    /// Without a close frame that arrived: unread bytes reset the connection, and the reset can overtake the frame.
    Cut,
    /// Not within [`PATIENCE`].
    Never,
}

/// Close codes of the wire that blame what came: a frame that is wrong, one that is too long, a proof that is wrong.
const BLAMES: [u8; 3] = [5, 6, 12];

impl End {
    /// The link has ended because of what came, and not because nothing came for too long.
    pub fn blames_what_came(self) -> bool {
        match self {
            Self::Closed(code) => BLAMES.contains(&code),
            Self::Refused | Self::Cut => true,
            Self::Never => false,
        }
    }
}

/// One end of a link.
pub struct Speaker {
    stream: TcpStream,
    datagrams: UdpSocket,
    claim: Claim,
    dials: bool,
    key: PairKey,
    cipher: Cipher,
    own: Vec<u8>,
    theirs: Option<Hello>,
    came: Vec<u8>,
    at: usize,
    next_id: u32,
    /// Numbers with which it has asked for a service.
    pub asked: Vec<i64>,
    /// Frames that came, whole.
    pub heard: Vec<Vec<u8>>,
    /// The other end sent a message that only a proven peer may receive.
    pub reported: bool,
}

fn random<const BYTES: usize>() -> [u8; BYTES] {
    let mut bytes = [0; BYTES];
    fastrand::fill(&mut bytes);
    bytes
}

/// A number that no other request of this program has.
pub fn fresh_mark() -> i64 {
    static NEXT: AtomicI64 = AtomicI64::new(1);
    NEXT.fetch_add(1, Ordering::Relaxed)
}

impl Speaker {
    /// At one end of a connection, with a key. Every other one offers AES-256-GCM.
    pub fn new(stream: TcpStream, dials: bool, mode: Mode, claim: Claim, key: PairKey) -> io::Result<Self> {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        let datagrams = UdpSocket::bind((stream.local_addr()?.ip(), 0))?;
        let mut own = hello(&claim, mode, datagrams.local_addr()?.port());
        static AES: AtomicBool = AtomicBool::new(false);
        let cipher = Cipher::new(mode);
        let cipher = if AES.fetch_not(Ordering::Relaxed) { cipher } else { cipher.offering_aes() };
        cipher.offer(&mut own);
        Ok(Self {
            stream,
            datagrams,
            claim,
            dials,
            key,
            cipher,
            own,
            theirs: None,
            came: Vec::new(),
            at: 0,
            next_id: 1,
            asked: Vec::new(),
            heard: Vec::new(),
            reported: false,
        })
    }

    /// The next message, after the messages that must be received before it; `None` at the end. An error if the other
    /// end has ended the link.
    pub fn step(&mut self) -> io::Result<Option<Said>> {
        let at = self.at;
        self.at += 1;
        let stream = |bytes| Ok(Some(Said { datagram: false, bytes }));
        match (self.cipher.mode(), at) {
            (Mode::Plain, 0) => stream(self.introduce()?),
            (Mode::Plain, 1) => {
                if self.dials {
                    self.hear_hello()?;
                }
                self.step()
            }
            (Mode::Plain, 2) => self.step(),
            (Mode::Secured, 0..HANDSHAKE) => stream(self.proof_step(at)?),
            (_, 3) => {
                if self.dials && self.cipher.mode() == Mode::Secured {
                    self.hear_confirmation()?;
                }
                stream(self.request(0, Priority::Normal, false))
            }
            (_, 4) => stream(self.request(0, Priority::High, true)),
            (_, 5) => stream(self.sealed(&[4])),
            (_, 6) => Ok(Some(self.request_in_datagram(0))),
            (_, 7) => stream(self.sealed(&[&[6][..], &SessionBody::keep_alive(7, Report::default())].concat())),
            _ => Ok(None),
        }
    }

    /// Sends a conversation up to step `end`; the number of steps made.
    pub fn converse(&mut self, end: usize) -> io::Result<usize> {
        while self.at < end {
            match self.step()? {
                Some(said) => self.say(&said)?,
                None => break,
            }
        }
        Ok(self.at)
    }

    /// The suite of the link, once it has proven itself.
    pub fn suite(&self) -> Option<Suite> {
        self.cipher.suite()
    }

    /// Sends a message.
    pub fn say(&mut self, said: &Said) -> io::Result<()> {
        if said.datagram {
            let to =
                SocketAddr::new(self.stream.peer_addr()?.ip(), self.theirs.as_ref().map_or(9, |them| them.udp_port));
            return self.datagrams.send_to(&said.bytes, to).map(drop);
        }
        self.stream.write_all(&said.bytes)
    }

    /// Sends bytes in the stream.
    pub fn say_bytes(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.stream.write_all(bytes)
    }

    /// Closes its sending direction, and receives until the other end is gone as well.
    pub fn finish(&mut self) {
        let _ = self.stream.shutdown(Shutdown::Write);
        while self.hear().is_ok() {}
    }

    /// Keeps its end open and receives until the other end has ended the link; how it ended.
    pub fn hear_end(&mut self) -> End {
        let mut end = End::Cut;
        loop {
            let mut body = match self.hear_frame() {
                Ok(body) => body,
                Err(error) if [io::ErrorKind::WouldBlock, io::ErrorKind::TimedOut].contains(&error.kind()) => {
                    return End::Never;
                }
                Err(_) => return end,
            };
            // A close frame is in clear until both ends have proven themselves.
            end = farewell(&body).or_else(|| farewell(&self.open(&mut body).ok()?)).unwrap_or(end);
        }
    }

    fn proof_step(&mut self, at: usize) -> io::Result<Vec<u8>> {
        match (self.dials, at) {
            (true, 0) | (false, 0) => self.introduce(),
            (true, 1) => {
                self.hear_hello()?;
                self.prove()?;
                // With another key there is no valid answer; random bytes are sent in its place.
                let answer = self.hear_proof().ok().flatten();
                Ok(framed(&Frame::Proof(&answer.unwrap_or_else(random))))
            }
            (false, 1) => self.prove().map(|proof| framed(&Frame::Proof(&proof.unwrap_or([0; 48])))),
            (dials, _) => {
                if !dials {
                    self.hear_proof()?;
                    self.hear_confirmation()?;
                } else if !self.cipher.is_sealing() {
                    self.hear()?;
                    return Err(over("another key"));
                }
                let confirmation = self.cipher.confirmation();
                Ok(self.sealed(&[&[8][..], &confirmation].concat()))
            }
        }
    }

    /// Its own hello; the accepting end receives the other hello first.
    fn introduce(&mut self) -> io::Result<Vec<u8>> {
        if !self.dials {
            self.hear_hello()?;
        }
        self.cipher.introduce(&self.own);
        Ok(framed(&Frame::Hello(&self.own)))
    }

    fn prove(&mut self) -> io::Result<Option<[u8; 48]>> {
        self.cipher.prove(!self.dials, Credentials::new(self.key.clone(), random())).map_err(|_| over("no proof"))
    }

    fn hear_hello(&mut self) -> io::Result<()> {
        let body = self.hear()?;
        let Ok(Frame::Hello(bytes)) = Frame::parse(&body) else { return Err(over("no hello")) };
        self.theirs = Hello::decode(bytes, self.cipher.mode()).ok();
        self.cipher.introduce(bytes);
        Ok(())
    }

    fn hear_proof(&mut self) -> io::Result<Option<[u8; 48]>> {
        let body = self.hear()?;
        let Ok(Frame::Proof(bytes)) = Frame::parse(&body) else { return Err(over("no proof")) };
        self.cipher.answer(bytes).map_err(|_| over("another key"))
    }

    fn hear_confirmation(&mut self) -> io::Result<()> {
        let body = self.hear()?;
        let Ok(Frame::Confirm(bytes)) = Frame::parse(&body) else { return Err(over("no confirmation")) };
        self.cipher.confirmed(bytes).map_err(|_| over("another key"))
    }

    /// Waits for the answer to a request: whether it was run.
    pub fn hear_answer(&mut self, id: u32) -> io::Result<bool> {
        loop {
            let body = self.hear()?;
            if body.first().is_some_and(|kind| kind & 0x10 == 0) {
                continue;
            }
            match Message::decode(body.get(6..).unwrap_or_default()) {
                Some(Message::Reply(found, outcome)) if found == id => return Ok(outcome.is_ok()),
                _ => {}
            }
        }
    }

    /// The next frame, opened if frames are sealed by now.
    fn hear(&mut self) -> io::Result<Vec<u8>> {
        let mut body = self.hear_frame()?;
        self.open(&mut body)
    }

    /// The body of the next frame as it came.
    fn hear_frame(&mut self) -> io::Result<Vec<u8>> {
        loop {
            if let Some(length) = frame::first_frame_length(&self.came).filter(|length| *length <= self.came.len()) {
                let whole: Vec<u8> = self.came.drain(..length).collect();
                let body = whole.get(2..).unwrap_or_default().to_vec();
                self.heard.push(whole);
                return Ok(body);
            }
            let mut buffer = [0; 4096];
            match self.stream.read(&mut buffer)? {
                0 => return Err(over("the other end is gone")),
                count => self.came.extend(buffer.iter().take(count)),
            }
        }
    }

    fn open(&mut self, body: &mut [u8]) -> io::Result<Vec<u8>> {
        let secured = self.cipher.mode() == Mode::Secured;
        if secured && !self.cipher.is_sealing() {
            let hello_or_end = matches!(
                Frame::parse(body),
                Ok(Frame::Hello(_) | Frame::Proof(_) | Frame::Close(_) | Frame::Refuse(_))
            );
            self.reported |= !hello_or_end;
            return Ok(body.to_vec());
        }
        let opened = self.cipher.open(body).map_err(|_| over("it does not open"))?;
        self.reported |= !secured && opened.first().is_some_and(|kind| kind & 0x10 != 0);
        Ok(opened.to_vec())
    }

    /// A frame of this body.
    pub fn sealed(&mut self, body: &[u8]) -> Vec<u8> {
        let overhead = if self.cipher.is_sealing() { self.cipher.overhead() } else { 0 };
        let length = u16::try_from(body.len() + overhead).expect("a short body").to_le_bytes();
        let mut bytes = [&length[..], body, &vec![0; overhead]].concat();
        if let (true, Some(frame)) = (overhead > 0, bytes.get_mut(2..)) {
            self.cipher.seal(frame).expect("the keys are agreed");
        }
        bytes
    }

    /// A request of the function in a slot, with a number of its own.
    pub fn request(&mut self, slot: u16, priority: Priority, wants_reply: bool) -> Vec<u8> {
        let message = self.message(slot, wants_reply);
        let total = u32::try_from(message.len()).expect("a short message").to_le_bytes();
        self.sealed(&[&[WHOLE, priority as u8][..], &total, &message].concat())
    }

    /// The number of the last request.
    pub fn last_id(&self) -> u32 {
        self.next_id - 1
    }

    fn message(&mut self, slot: u16, wants_reply: bool) -> Vec<u8> {
        let mark = fresh_mark();
        self.asked.push(mark);
        let header = RequestHeader {
            id: self.next_id,
            slot: Slot(slot),
            generation: Generation(0),
            wants_reply,
            takes_over: false,
            operator: false,
            wants_progress: false,
            unknown: 0,
            remaining: cara_core::time::Duration::from_secs(600),
            stamp: self.theirs.as_ref().map_or(0, |them| them.stamp),
            since: cara_core::time::Duration::ZERO,
            number: self.next_id,
        };
        self.next_id += 1;
        [&header.encode()[..], &mark.to_le_bytes()].concat()
    }

    /// A best-effort request in a datagram.
    pub fn request_in_datagram(&mut self, slot: u16) -> Said {
        let body = [&[3, 2][..], &self.message(slot, false)].concat();
        let (link, nonce) = self.theirs.as_ref().map_or((0, 0), |them| (them.link, them.nonce));
        let header =
            session_header(self.cipher.mode(), cara_core::config::VERSIONS.last, self.claim.fleet, link, nonce);
        let (front, behind) = self.cipher.datagram_room();
        let mut sealed = [&vec![0; front][..], &body, &vec![0; behind]].concat();
        self.cipher.seal_datagram(&header, &mut sealed);
        Said { datagram: true, bytes: [&header[..], &sealed].concat() }
    }
}

fn farewell(body: &[u8]) -> Option<End> {
    match Frame::parse(body) {
        Ok(Frame::Close(code)) => Some(End::Closed(code)),
        Ok(Frame::Refuse(_)) => Some(End::Refused),
        _ => None,
    }
}

fn over(why: &str) -> io::Error {
    io::Error::new(io::ErrorKind::UnexpectedEof, why)
}

/// A frame in clear.
pub fn framed(frame: &Frame<'_>) -> Vec<u8> {
    let mut bytes = [0; 512];
    let length = frame::encode(frame, 0, &mut bytes);
    bytes.get(..length).unwrap_or_default().to_vec()
}

/// A frame in clear around a request.
pub fn request_in_clear() -> Vec<u8> {
    let header = RequestHeader {
        id: 1,
        slot: Slot(0),
        generation: Generation(0),
        wants_reply: true,
        takes_over: false,
        operator: false,
        wants_progress: false,
        unknown: 0,
        remaining: cara_core::time::Duration::from_secs(600),
        stamp: 0,
        since: cara_core::time::Duration::ZERO,
        number: 1,
    };
    let message = [&header.encode()[..], &fresh_mark().to_le_bytes()].concat();
    let body = [&[WHOLE, 2][..], &(message.len() as u32).to_le_bytes(), &message].concat();
    [&(body.len() as u16).to_le_bytes()[..], &body].concat()
}

/// The hello of a claimed identity.
pub fn hello(claim: &Claim, mode: Mode, udp_port: u16) -> Vec<u8> {
    let hello = Hello {
        versions: cara_core::config::VERSIONS,
        capabilities: 0,
        fleet: claim.fleet,
        identity: claim.identity.clone(),
        wanted: claim.wanted.clone(),
        epoch: Epoch(u64::from_le_bytes(random())),
        claim: None,
        obeyed: None,
        nonce: u64::from_le_bytes(random()),
        limits: Limits { message_size: 1_024, chunk_size: 1_024, calls: 8, minimum_interval: 0 },
        link: 0,
        udp_port,
        stamp: 0,
        keep_alive: 1_000,
        skipped: 0,
    };
    let mut bytes = [0; 320];
    let length = hello.encode(mode, &mut bytes).expect("a hello fits");
    bytes.get(..length).unwrap_or_default().to_vec()
}
