//! The cipher of simulated links: the real one, with a look at everything that is sealed. Two things sealed with the same
//! key and the same number, anywhere in a world, end the run.

use std::cell::RefCell;
use std::collections::HashSet;
use std::rc::Rc;

use cara_core::config::Mode;
use cara_core::error::CloseReason;
use cara_core::host::secure::{CONFIRMATION_BYTES, PROOF_BYTES, Seal, Secure, Unopened};
use cara_secure::link::{Cipher, Credentials};

/// What has been sealed with, in all of a world: a hash of the key, and the number.
#[derive(Clone, Debug, Default)]
pub(super) struct Seals(Rc<RefCell<HashSet<(u64, u64)>>>);

impl Seals {
    pub(super) fn count(&self) -> usize {
        self.0.borrow().len()
    }

    fn note(&self, (key, number): ([u8; 16], u64)) {
        let key = key.first_chunk().copied().map_or(0, u64::from_le_bytes);
        assert!(self.0.borrow_mut().insert((key, number)), "number {number} is sealed twice with key {key:016x}");
    }
}

/// A cipher whose seals are noted.
pub(super) struct Audited {
    cipher: Cipher,
    seals: Seals,
}

impl Audited {
    pub(super) fn new(mode: Mode, seals: &Seals) -> Self {
        Self { cipher: Cipher::new(mode), seals: seals.clone() }
    }
}

impl Seal for Audited {
    fn overhead(&self) -> usize {
        self.cipher.overhead()
    }

    fn seal(&mut self, frame: &mut [u8]) -> Result<(), CloseReason> {
        if let Some([frames, _]) = self.cipher.next_seals() {
            self.seals.note(frames);
        }
        self.cipher.seal(frame)
    }

    fn turn(&mut self) -> Result<(), CloseReason> {
        self.cipher.turn()
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        self.cipher.open(frame)
    }
}

impl Secure for Audited {
    type Credentials = Credentials;

    fn mode(&self) -> Mode {
        self.cipher.mode()
    }

    fn offer(&self, hello: &mut [u8]) {
        self.cipher.offer(hello);
    }

    fn is_sealing(&self) -> bool {
        self.cipher.is_sealing()
    }

    fn introduce(&mut self, hello: &[u8]) {
        self.cipher.introduce(hello);
    }

    fn prove(&mut self, begins: bool, credentials: Credentials) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        self.cipher.prove(begins, credentials)
    }

    fn answer(&mut self, message: &[u8]) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        self.cipher.answer(message)
    }

    fn confirmation(&self) -> [u8; CONFIRMATION_BYTES] {
        self.cipher.confirmation()
    }

    fn confirmed(&mut self, confirmation: &[u8]) -> Result<(), CloseReason> {
        self.cipher.confirmed(confirmation)
    }

    fn turned(&mut self) -> Result<(), CloseReason> {
        self.cipher.turned()
    }

    fn acknowledged(&mut self) -> Result<(), CloseReason> {
        self.cipher.acknowledged()
    }

    fn forget_previous(&mut self) {
        self.cipher.forget_previous();
    }

    fn hears_newest(&self) -> bool {
        self.cipher.hears_newest()
    }

    fn is_worn(&self) -> bool {
        self.cipher.is_worn()
    }

    fn datagram_room(&self) -> (usize, usize) {
        self.cipher.datagram_room()
    }

    fn seal_datagram(&mut self, bound: &[u8], datagram: &mut [u8]) -> bool {
        if let Some([_, datagrams]) = self.cipher.next_seals() {
            self.seals.note(datagrams);
        }
        self.cipher.seal_datagram(bound, datagram)
    }

    fn open_datagram<'d>(&mut self, bound: &[u8], datagram: &'d mut [u8]) -> Result<&'d mut [u8], Unopened> {
        self.cipher.open_datagram(bound, datagram)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[should_panic(expected = "number 7 is sealed twice")]
    fn a_number_that_comes_back_ends_the_run() {
        let seals = Seals::default();
        seals.note(([1; 16], 7));
        seals.note(([2; 16], 7));
        seals.note(([1; 16], 7));
    }
}
