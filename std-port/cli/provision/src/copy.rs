//! The bytes of a copy, and where it goes.

use cara_settings::Settings;
use cara_settings::board::Board;
use cara_settings::keys::kept;
use cara_settings::page::{BYTES, Copy, PageError, decode, encode_with, replaced};
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

/// The copies that come after those on the board, to be written one after the other: the first replaces the older one. The other
/// goes as well, since its keys, which may have been revoked, would count again where the new copy is damaged.
pub(super) fn next(board: &Board, content: &Content, first: &[u8], second: &[u8]) -> anyhow::Result<[Written; 2]> {
    let [one, two] = board.pages;
    let (copy, generation) = replaced(first, second);
    let (address, other) = match copy {
        Copy::First => (one, two),
        Copy::Second => (two, one),
    };
    let held = || kept(&content.settings, first, second).map(Secrets::kept);
    let secrets = content.secrets.clone().or_else(held);
    let left = if secrets.is_none() { owner(first, second) } else { None };
    let written = |address, generation| written(&content.settings, secrets.as_ref(), address, generation);
    Ok([Written { left, ..written(address, generation)? }, written(other, generation.wrapping_add(1))?])
}

/// Whether the page at this address holds something that may be a copy.
pub(super) fn is_held(board: &Board, pages: &[Zeroizing<Vec<u8>>; 2], address: u32) -> bool {
    let held = pages.iter().zip(board.pages).find(|(_, at)| *at == address);
    held.is_some_and(|(page, _)| decode(page) != Err(PageError::Absent))
}

/// Both copies, for a board with unknown content.
pub(super) fn both(board: &Board, Content { settings, secrets }: &Content) -> anyhow::Result<[Written; 2]> {
    let [one, two] = board.pages;
    let written = |address, generation| written(settings, secrets.as_ref(), address, generation);
    Ok([written(one, 1)?, written(two, 2)?])
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
