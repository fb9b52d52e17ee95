//! A cipher and codes that may say anything, so that what is around them holds whatever they are.

use cara_core::config::Mode;
use cara_core::distribution::authenticator::{Authenticator, CODE_BYTES};
use cara_core::distribution::identity::Identity;
use cara_core::error::CloseReason;
use cara_core::host::secure::{CONFIRMATION_BYTES, PROOF_BYTES, Plain, Seal, Secure, Unopened};

use crate::linkage::{keep, unknown, unknown_slice};

/// Any cipher.
pub struct AnyCipher;

impl Seal for AnyCipher {
    fn overhead(&self) -> usize {
        *unknown()
    }

    fn seal(&mut self, frame: &mut [u8]) -> Result<(), CloseReason> {
        keep(frame);
        *unknown()
    }

    fn turn(&mut self) -> Result<(), CloseReason> {
        *unknown()
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        keep(frame);
        if *unknown() { Ok(unknown_slice()) } else { Err(*unknown()) }
    }
}

impl Secure for AnyCipher {
    type Credentials = u64;

    fn mode(&self) -> Mode {
        *unknown()
    }

    fn is_sealing(&self) -> bool {
        *unknown()
    }

    fn introduce(&mut self, hello: &[u8]) {
        keep(hello);
    }

    fn prove(&mut self, dialed: bool, credentials: u64) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        keep((dialed, credentials));
        *unknown()
    }

    fn answer(&mut self, message: &[u8]) -> Result<Option<[u8; PROOF_BYTES]>, CloseReason> {
        keep(message);
        *unknown()
    }

    fn confirmation(&self) -> [u8; CONFIRMATION_BYTES] {
        *unknown()
    }

    fn confirmed(&mut self, confirmation: &[u8]) -> Result<(), CloseReason> {
        keep(confirmation);
        *unknown()
    }

    fn turned(&mut self) -> Result<(), CloseReason> {
        *unknown()
    }

    fn acknowledged(&mut self) -> Result<(), CloseReason> {
        *unknown()
    }

    fn forget_previous(&mut self) {
        keep(self);
    }

    fn hears_newest(&self) -> bool {
        *unknown()
    }

    fn is_worn(&self) -> bool {
        *unknown()
    }

    fn datagram_room(&self) -> (usize, usize) {
        *unknown()
    }

    fn seal_datagram(&mut self, bound: &[u8], datagram: &mut [u8]) -> bool {
        keep((bound, datagram));
        *unknown()
    }

    fn open_datagram<'d>(&mut self, bound: &[u8], datagram: &'d mut [u8]) -> Result<&'d mut [u8], Unopened> {
        keep((bound, datagram));
        if *unknown() { Ok(unknown_slice()) } else { Err(*unknown()) }
    }
}

/// Any codes.
pub struct AnyCodes;

impl Authenticator for AnyCodes {
    fn mode(&self) -> Mode {
        *unknown()
    }

    fn sign_for_fleet(&self, datagram: &[u8]) -> [u8; CODE_BYTES] {
        keep(datagram);
        *unknown()
    }

    fn is_of_fleet(&self, datagram: &[u8], code: &[u8; CODE_BYTES]) -> bool {
        keep((datagram, code));
        *unknown()
    }

    fn sign_for(&self, peer: &Identity, datagram: &[u8]) -> Option<[u8; CODE_BYTES]> {
        keep((peer, datagram));
        *unknown()
    }

    fn is_of(&self, peer: &Identity, datagram: &[u8], code: &[u8; CODE_BYTES]) -> bool {
        keep((peer, datagram, code));
        *unknown()
    }
}

entry!(plain, {
    keep((Plain.overhead(), Secure::mode(&Plain), Plain.is_sealing(), Plain.confirmation(), Plain.datagram_room()));
    keep((Plain.seal(unknown_slice()), Plain.open(unknown_slice())));
    Plain.introduce(unknown_slice());
    keep((Plain.prove(*unknown(), ()), Plain.answer(unknown_slice()), Plain.confirmed(unknown_slice())));
    keep(Plain.seal_datagram(unknown_slice(), unknown_slice()));
    keep((Plain.turn(), Plain.turned(), Plain.acknowledged(), Plain.hears_newest(), Plain.is_worn()));
    Plain.forget_previous();
    keep(Plain.open_datagram(unknown_slice(), unknown_slice()));
});

entry!(plain_codes, {
    let identity: &Identity = unknown();
    keep((
        Authenticator::mode(&Plain),
        Plain.sign_for_fleet(unknown_slice()),
        Plain.sign_for(identity, unknown_slice()),
    ));
    keep((Plain.is_of_fleet(unknown_slice(), unknown()), Plain.is_of(identity, unknown_slice(), unknown())));
});

entry!(modes, {
    let mode: Mode = *unknown();
    keep((mode.as_str(), mode.magic(), mode.port(), Mode::of_magic(*unknown())));
});
