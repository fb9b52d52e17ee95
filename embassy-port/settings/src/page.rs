//! How settings stand in flash.
//!
//! | offset | size | field |
//! |---|---|---|
//! | 0 | 4 | `CARs` |
//! | 4 | 1 | version of this layout, 1 |
//! | 5 | 1 | zero |
//! | 6 | 2 | n, bytes of the settings, little-endian |
//! | 8 | 4 | generation, little-endian |
//! | 12 | n | the settings, in postcard |
//! | 12 + n | 4 | CRC-32 (ISO-HDLC) of all before, little-endian |
//!
//! A board keeps two copies in pages that are erased separately. [`newest`] takes the sound one with the higher
//! generation; [`replaced`] tells which one to write next, so that the newest sound copy is never the one being erased.

use crc::{CRC_32_ISO_HDLC, Crc, NoTable};

use crate::Settings;

/// Most bytes of a copy; a page of flash is at least as long.
pub const BYTES: usize = 256;

const MAGIC: [u8; 4] = *b"CARs";
const LAYOUT: u8 = 1;
const HEADER: usize = 12;
const CHECKSUM: usize = 4;
/// Without a table: a few hundred bytes are summed once per boot, and a table takes 1 KiB of flash.
const SUM: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISO_HDLC);

/// Why a page has no settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PageError {
    /// Nothing was ever written, or something else was.
    #[error("the page holds no settings: write them with `cara provision`")]
    Absent,
    /// Another version of the layout.
    #[error(
        "the page holds settings of layout {0}, and this image knows layout 1: write them again, or update the image"
    )]
    Layout(u8),
    /// The checksum does not fit: a bit has changed, or power was cut while it was written.
    #[error("the page's checksum does not fit: write the settings again")]
    Damaged,
    /// No unit can be made of what stands there.
    #[error("the page's settings are of no unit: write them again")]
    Unsound,
}

/// Which of two copies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Copy {
    /// The first page.
    First,
    /// The second page.
    Second,
}

/// Writes a copy; how many bytes of `page` it takes. `None` only if the page is shorter than [`BYTES`].
pub fn encode(settings: &Settings, generation: u32, page: &mut [u8; BYTES]) -> Option<usize> {
    let length = {
        let body = page.get_mut(HEADER..BYTES - CHECKSUM)?;
        postcard::to_slice(settings, body).ok()?.len()
    };
    let header = page.get_mut(..HEADER)?;
    header.get_mut(..4)?.copy_from_slice(&MAGIC);
    header.get_mut(4..6)?.copy_from_slice(&[LAYOUT, 0]);
    header.get_mut(6..8)?.copy_from_slice(&(length as u16).to_le_bytes());
    header.get_mut(8..HEADER)?.copy_from_slice(&generation.to_le_bytes());
    let (summed, rest) = page.split_at_mut_checked(HEADER + length)?;
    rest.get_mut(..CHECKSUM)?.copy_from_slice(&SUM.checksum(summed).to_le_bytes());
    Some(HEADER + length + CHECKSUM)
}

/// Reads a copy with its generation.
pub fn decode(page: &[u8]) -> Result<(Settings, u32), PageError> {
    let (header, rest) = page.split_at_checked(HEADER).ok_or(PageError::Absent)?;
    let [magic @ .., layout, _, low, high, first, second, third, fourth] = header else {
        return Err(PageError::Absent);
    };
    if magic != MAGIC {
        return Err(PageError::Absent);
    }
    let length = usize::from(u16::from_le_bytes([*low, *high]));
    let (body, rest) = rest.split_at_checked(length).ok_or(PageError::Damaged)?;
    let checksum = rest.first_chunk::<CHECKSUM>().ok_or(PageError::Damaged)?;
    let summed = page.get(..HEADER + length).ok_or(PageError::Damaged)?;
    if SUM.checksum(summed) != u32::from_le_bytes(*checksum) {
        return Err(PageError::Damaged);
    }
    if *layout != LAYOUT {
        return Err(PageError::Layout(*layout));
    }
    let (settings, left) = postcard::take_from_bytes::<Settings>(body).map_err(|_| PageError::Unsound)?;
    let generation = u32::from_le_bytes([*first, *second, *third, *fourth]);
    if left.is_empty() && settings.is_sound() { Ok((settings, generation)) } else { Err(PageError::Unsound) }
}

/// The settings of the newest sound copy; why there are none, of the copy that came nearest.
pub fn newest(first: &[u8], second: &[u8]) -> Result<Settings, PageError> {
    match (decode(first), decode(second)) {
        (Ok((first, one)), Ok((second, two))) => Ok(if is_newer(two, one) { second } else { first }),
        (Ok((settings, _)), Err(_)) | (Err(_), Ok((settings, _))) => Ok(settings),
        (Err(PageError::Absent), Err(error)) | (Err(error), Err(_)) => Err(error),
    }
}

/// Which copy to write next, and with which generation.
pub fn replaced(first: &[u8], second: &[u8]) -> (Copy, u32) {
    match (decode(first), decode(second)) {
        (Ok((_, one)), Ok((_, two))) if is_newer(two, one) => (Copy::First, two.wrapping_add(1)),
        (Ok((_, one)), _) => (Copy::Second, one.wrapping_add(1)),
        (Err(_), Ok((_, two))) => (Copy::First, two.wrapping_add(1)),
        (Err(_), Err(_)) => (Copy::First, 1),
    }
}

/// Generations may wrap: the one that is ahead by less than half of all numbers is newer.
const fn is_newer(this: u32, other: u32) -> bool {
    this != other && this.wrapping_sub(other) < u32::MAX / 2
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Network, Wifi};
    use core::net::{Ipv4Addr, SocketAddrV4};
    use std::string::String;

    use cara_core::distribution::hello::Manager;
    use cara_core::distribution::identity::{Fleet, Identity};
    use proptest::prelude::*;

    fn settings(name: &str, id: u32) -> Settings {
        let network = Network::Static { address: Ipv4Addr::new(10, 0, 0, 7), prefix: 24, gateway: None };
        Settings {
            identity: Identity::s_unit(name, id).unwrap(),
            manager: Some(Manager::new("depot", 1).unwrap()),
            manager_address: Some(SocketAddrV4::new(Ipv4Addr::new(10, 0, 0, 1), 2_000)),
            fleet: Fleet(u32::MAX),
            network,
            wifi: None,
        }
    }

    fn page(settings: &Settings, generation: u32) -> [u8; BYTES] {
        let mut page = [0xFF; BYTES];
        encode(settings, generation, &mut page).unwrap();
        page
    }

    #[test]
    fn what_is_written_is_read() {
        let written = settings("agv-07", 7);
        assert_eq!(decode(&page(&written, 5)), Ok((written, 5)));
    }

    #[test]
    fn the_longest_settings_fit() {
        let longest = String::from_utf8([b'n'; 32].to_vec()).unwrap();
        let mut settings = settings(&longest, u32::MAX);
        settings.manager = Some(Manager::new(&longest, u32::MAX).unwrap());
        let network = Network::Static { address: Ipv4Addr::BROADCAST, prefix: 32, gateway: Some(Ipv4Addr::BROADCAST) };
        settings.network = network;
        settings.wifi = Some(Wifi::new(&longest, &"p".repeat(63)).unwrap());
        assert!(encode(&settings, u32::MAX, &mut [0; BYTES]).is_some());
    }

    /// Power may be cut, or a bit flip, anywhere in one copy: the other one counts, and never something between.
    #[test]
    fn every_flipped_bit_of_either_copy_is_noticed() {
        let (old, new) = (settings("agv-07", 7), settings("agv-08", 8));
        let (first, second) = (page(&old, 1), page(&new, 2));
        let used = encode(&new, 2, &mut [0; BYTES]).unwrap();
        assert_eq!(newest(&first, &second), Ok(new.clone()));
        for bit in 0..used * 8 {
            let mut damaged = second;
            damaged[bit / 8] ^= 1 << (bit % 8);
            // The byte that is always zero is covered by the checksum as well.
            assert!(decode(&damaged).is_err(), "bit {bit}");
            assert_eq!(newest(&first, &damaged), Ok(old.clone()), "bit {bit}");
            assert_eq!(newest(&damaged, &first), Ok(old.clone()), "bit {bit}");
        }
    }

    #[test]
    fn every_cut_while_writing_leaves_the_other_copy() {
        let (old, new) = (settings("agv-07", 7), settings("agv-08", 8));
        let (first, second) = (page(&old, 1), page(&new, 2));
        let used = encode(&new, 2, &mut [0; BYTES]).unwrap();
        for written in 0..used {
            let mut cut = [0xFF; BYTES];
            cut[..written].copy_from_slice(&second[..written]);
            assert_eq!(newest(&first, &cut), Ok(old.clone()), "{written} bytes");
            assert_eq!(replaced(&first, &cut), (Copy::Second, 2));
        }
    }

    #[test]
    fn the_newest_copy_is_never_the_one_that_is_erased() {
        let settings = settings("agv", 1);
        let erased = [0xFF; BYTES];
        assert_eq!(replaced(&erased, &erased), (Copy::First, 1));
        assert_eq!(replaced(&page(&settings, 1), &erased), (Copy::Second, 2));
        assert_eq!(replaced(&page(&settings, 1), &page(&settings, 2)), (Copy::First, 3));
        assert_eq!(replaced(&page(&settings, 3), &page(&settings, 2)), (Copy::Second, 4));
        assert_eq!(replaced(&page(&settings, 0), &page(&settings, u32::MAX)), (Copy::Second, 1));
    }

    #[test]
    fn each_way_of_having_none_is_told() {
        assert_eq!(newest(&[0xFF; BYTES], &[0; BYTES]), Err(PageError::Absent));
        assert_eq!(newest(&[], &[]), Err(PageError::Absent));
        let mut damaged = page(&settings("agv", 1), 1);
        damaged[20] ^= 1;
        assert_eq!(newest(&[0xFF; BYTES], &damaged), Err(PageError::Damaged));
        assert_eq!(newest(&damaged, &[0xFF; BYTES]), Err(PageError::Damaged));
    }

    proptest! {
        #[test]
        fn nothing_in_flash_panics(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let _ = decode(&bytes);
        }

        /// A checksum that fits does not make settings sound.
        #[test]
        fn nothing_summed_panics(body in prop::collection::vec(any::<u8>(), 0..200)) {
            let mut page = [0; BYTES];
            page[..4].copy_from_slice(&MAGIC);
            page[4] = LAYOUT;
            page[6..8].copy_from_slice(&(body.len() as u16).to_le_bytes());
            page[HEADER..HEADER + body.len()].copy_from_slice(&body);
            let end = HEADER + body.len();
            let sum = SUM.checksum(&page[..end]).to_le_bytes();
            page[end..end + 4].copy_from_slice(&sum);
            if let Ok((settings, _)) = decode(&page) {
                prop_assert!(settings.is_sound());
            }
        }
    }
}
