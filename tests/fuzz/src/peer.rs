//! The other end of a link: it makes a genuine handshake, and then says whatever it is given.

use std::net::SocketAddrV4;

use cara_core::config::{Mode, Priority, VERSIONS};
use cara_core::distribution::datagram::{SESSION_HEADER_BYTES, session_header};
use cara_core::distribution::hello::Hello;
use cara_core::distribution::message::SessionBody;
use cara_core::host::frame::{self, ChunkWriter, Chunking, Frame};
use cara_core::host::secure::{Seal as _, Secure as _};
use cara_secure::link::Cipher;

use crate::unit::{FLEET, Keyed};

/// Longest frame that a unit takes before its peer has proven itself.
const CHUNK: usize = 320;

/// The other end of a link.
pub(crate) struct Peer {
    cipher: Cipher,
    /// It has opened the stream.
    dials: bool,
    keys: Keyed,
    hello: Vec<u8>,
    /// What the unit has written and was not read.
    came: Vec<u8>,
    /// What is to be written.
    says: Vec<u8>,
    pub(crate) theirs: Option<Hello>,
    /// Its handshake is finished.
    pub(crate) is_live: bool,
    /// It takes no further part.
    is_lost: bool,
    pub(crate) address: SocketAddrV4,
    /// The id of its last call.
    pub(crate) last: u32,
}

impl Peer {
    /// One that has dialled, or was dialled.
    pub(crate) fn new(mode: Mode, dials: bool, own: &Hello, keys: Keyed, address: SocketAddrV4) -> Self {
        let mut bytes = [0; 400];
        let length = own.encode(mode, &mut bytes).expect("a hello is short");
        let mut peer = Self {
            cipher: Cipher::new(mode),
            dials,
            keys,
            hello: bytes[..length].to_vec(),
            came: Vec::new(),
            says: Vec::new(),
            theirs: None,
            is_live: false,
            is_lost: false,
            address,
            last: 0,
        };
        if dials {
            peer.introduce();
        }
        peer
    }

    fn introduce(&mut self) {
        self.cipher.introduce(&self.hello);
        let hello = std::mem::take(&mut self.hello);
        self.say(&Frame::Hello(&hello));
    }

    fn say(&mut self, frame: &Frame<'_>) {
        let bytes = self.frame(frame);
        self.says.extend(bytes);
    }

    /// A frame as it travels now.
    pub(crate) fn frame(&mut self, frame: &Frame<'_>) -> Vec<u8> {
        let overhead = if self.cipher.is_sealing() { self.cipher.overhead() } else { 0 };
        let mut bytes = [0; 600];
        let length = frame::encode(frame, overhead, &mut bytes);
        self.seal(&mut bytes[..length]);
        bytes[..length].to_vec()
    }

    /// A frame of these bytes as its body.
    pub(crate) fn raw(&mut self, body: &[u8]) -> Vec<u8> {
        let overhead = if self.cipher.is_sealing() { self.cipher.overhead() } else { 0 };
        let length = (body.len() + overhead) as u16;
        let mut bytes = [&length.to_le_bytes()[..], body, &vec![0; overhead]].concat();
        self.seal(&mut bytes);
        bytes
    }

    /// Frames with a message.
    pub(crate) fn message(&mut self, priority: Priority, message: &[u8]) -> Vec<u8> {
        let overhead = if self.cipher.is_sealing() { self.cipher.overhead() } else { 0 };
        let chunking = Chunking { chunk: CHUNK, overhead };
        let mut bytes = vec![0; chunking.framed_length(message.len())];
        let writer = ChunkWriter::new(&mut bytes, chunking, priority, message.len());
        writer.expect("it has its length").put(message);
        self.seal(&mut bytes);
        bytes
    }

    fn seal(&mut self, mut frames: &mut [u8]) {
        if !self.cipher.is_sealing() || self.cipher.mode() == Mode::Plain {
            return;
        }
        while let Some(length) = frame::first_frame_length(frames).filter(|length| *length <= frames.len()) {
            let (frame, rest) = frames.split_at_mut(length);
            if self.cipher.seal(&mut frame[2..]).is_err() {
                self.is_lost = true;
            }
            frames = rest;
        }
    }

    /// A datagram with a session body.
    pub(crate) fn datagram(&mut self, body: &[u8]) -> Vec<u8> {
        let (link, nonce) = self.theirs.as_ref().map_or((0, 0), |theirs| (theirs.link, theirs.nonce));
        let header = session_header(self.cipher.mode(), VERSIONS.last, FLEET, link, nonce);
        let (front, behind) = self.cipher.datagram_room();
        let mut sealed = [&vec![0; front][..], body, &vec![0; behind]].concat();
        self.cipher.seal_datagram(&header, &mut sealed);
        [&header[..], &sealed].concat()
    }

    /// What the unit has sent it in a datagram must be readable.
    pub(crate) fn hear_datagram(&mut self, datagram: &mut [u8]) {
        if let Some((header, body)) = datagram.split_at_mut_checked(SESSION_HEADER_BYTES)
            && self.is_live
            && let Ok(body) = self.cipher.open_datagram(header, body)
        {
            assert!(SessionBody::decode(body).is_some(), "an unreadable datagram");
        }
    }

    /// Takes what the unit has written; returns what it answers.
    pub(crate) fn hear(&mut self, bytes: &[u8]) -> Vec<u8> {
        self.came.extend(bytes);
        while let Some(length) = frame::first_frame_length(&self.came).filter(|length| *length <= self.came.len()) {
            let mut frame: Vec<u8> = self.came.drain(..length).collect();
            if !self.is_lost && self.hear_frame(&mut frame[2..]).is_none() {
                self.is_lost = true;
            }
        }
        std::mem::take(&mut self.says)
    }

    fn hear_frame(&mut self, frame: &mut [u8]) -> Option<()> {
        let sealing = self.cipher.mode() == Mode::Secured && self.cipher.is_sealing();
        let body = if sealing { self.cipher.open(frame).ok()? } else { frame };
        let parsed = Frame::parse(body);
        match parsed.ok() {
            Some(Frame::Hello(bytes)) if self.theirs.is_none() => {
                let mode = self.cipher.mode();
                let hello = Hello::decode(bytes, mode).expect("a unit's hello is valid");
                self.cipher.introduce(bytes);
                if !self.dials {
                    self.introduce();
                }
                let credentials = self.keys.credentials_for(&hello.identity);
                self.theirs = Some(hello);
                if mode == Mode::Plain {
                    self.is_live = true;
                    return Some(());
                }
                if let Some(proof) = self.cipher.prove(!self.dials, credentials?).ok()? {
                    self.say(&Frame::Proof(&proof));
                }
            }
            Some(Frame::Proof(bytes)) if !self.is_live => {
                let answer = self.cipher.answer(bytes).ok()?;
                if let Some(answer) = answer {
                    // The answer itself is not sealed.
                    let mut bytes = [0; 100];
                    let length = frame::encode(&Frame::Proof(&answer), 0, &mut bytes);
                    self.says.extend_from_slice(&bytes[..length]);
                }
                if self.dials {
                    self.confirm();
                }
            }
            Some(Frame::Confirm(bytes)) if !self.is_live => {
                self.cipher.confirmed(bytes).ok()?;
                if !self.dials {
                    self.confirm();
                }
                self.is_live = true;
            }
            Some(Frame::Session(bytes)) => assert!(SessionBody::decode(bytes).is_some(), "an unreadable frame"),
            Some(_) => {}
            None => assert!(!self.is_live, "a frame that nobody can read"),
        }
        Some(())
    }

    fn confirm(&mut self) {
        let confirmation = self.cipher.confirmation();
        self.say(&Frame::Confirm(&confirmation));
    }
}
