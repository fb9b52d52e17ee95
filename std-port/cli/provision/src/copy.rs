//! The bytes of a copy, and where it goes.

use cara_settings::Settings;
use cara_settings::board::Board;
use cara_settings::keys::kept;
use cara_settings::page::{BYTES, Copy, encode_with, replaced};
use cara_settings::uf2::{PAYLOAD, Place, block};
use cara_std::keys::Owner;
use zeroize::Zeroizing;

use super::secrets::{Secrets, owner};
use cara_tools::exit::Ended;

/// What a copy says.
pub(super) struct Content {
    pub(super) settings: Settings,
    /// Keys that the board gets; none where it keeps those that it has.
    pub(super) secrets: Option<Secrets>,
}

/// A copy to be written.
pub(super) struct Written {
    /// Where it goes.
    pub(super) address: u32,
    pub(super) generation: u32,
    /// What is not written stays as erased flash is. Wiped when it is dropped: there may be keys in it.
    pub(super) bytes: Zeroizing<Vec<u8>>,
    /// How many of them say something.
    used: usize,
    pub(super) has_keys: bool,
    /// Whose keys the board has and this copy leaves behind.
    pub(super) left: Option<Owner>,
}

/// The copy that comes after those on the board; it replaces the older one.
pub(super) fn next(board: &Board, content: &Content, first: &[u8], second: &[u8]) -> anyhow::Result<Written> {
    let [one, two] = board.pages;
    let (copy, generation) = replaced(first, second);
    let address = match copy {
        Copy::First => one,
        Copy::Second => two,
    };
    let held = || kept(&content.settings, first, second).map(Secrets::kept);
    let secrets = content.secrets.clone().or_else(held);
    let left = if secrets.is_none() { owner(first, second) } else { None };
    Ok(Written { left, ..written(&content.settings, secrets.as_ref(), address, generation)? })
}

/// Both copies, for a board with unknown content.
pub(super) fn both(board: &Board, Content { settings, secrets }: &Content) -> anyhow::Result<Vec<Written>> {
    let copies = (1..).zip(board.pages);
    copies.map(|(generation, address)| written(settings, secrets.as_ref(), address, generation)).collect()
}

fn written(settings: &Settings, secrets: Option<&Secrets>, address: u32, generation: u32) -> anyhow::Result<Written> {
    let mut page = Zeroizing::new([0xFF; BYTES]);
    let keys = secrets.map_or(&[][..], Secrets::bytes);
    match encode_with(settings, keys, generation, &mut page) {
        Some(used) => {
            let bytes = Zeroizing::new(page.to_vec());
            Ok(Written { address, generation, bytes, used, has_keys: !keys.is_empty(), left: None })
        }
        None => Err(Ended::usage("the settings are longer than a page")),
    }
}

/// The same as a UF2 file.
pub(super) fn uf2(written: &[Written], family: u32) -> Zeroizing<Vec<u8>> {
    let pieces: Vec<_> = written.iter().flat_map(Written::pieces).collect();
    let total = pieces.len() as u32;
    let blocks = (0..).zip(pieces).map(|(number, (address, payload))| {
        let place = Place { address, number, total, family };
        Zeroizing::new(block(place, payload))
    });
    let mut file = Zeroizing::new(Vec::with_capacity(total as usize * cara_settings::uf2::BLOCK));
    blocks.for_each(|block| file.extend_from_slice(block.as_slice()));
    file
}

impl Written {
    /// What says something, in the pieces of a UF2 file, each with its address.
    fn pieces(&self) -> impl Iterator<Item = (u32, &[u8; PAYLOAD])> {
        let (pieces, _) = self.bytes.as_chunks();
        (self.address..).step_by(PAYLOAD).zip(pieces.iter().take(self.used.div_ceil(PAYLOAD)))
    }
}
