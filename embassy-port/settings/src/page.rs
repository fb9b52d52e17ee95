//! How settings stand in flash.
//!
//! | offset | size | field |
//! |---|---|---|
//! | 0 | 4 | `CARs` |
//! | 4 | 1 | version of this layout: 1, 2 if keys stand behind the settings, or 3 for plain mode without keys |
//! | 5 | 1 | zero |
//! | 6 | 2 | n, bytes of settings and keys, little-endian |
//! | 8 | 4 | generation, little-endian |
//! | 12 | n | the settings, in postcard, and the keys behind them, in a form of their own |
//! | 12 + n | 4 | CRC-32 (ISO-HDLC) of all before, little-endian |
//!
//! A board keeps two copies in pages that are erased separately. [`newest`] takes the sound one with the higher
//! generation; [`replaced`] tells which one to write next, so that the newest sound copy is never the one being erased.
//! `cara provision` writes both, one after the other: keys of before would count again where the newer copy is damaged.
//!
//! A copy that cannot be used may be one whose writing was cut off, or the newest one with a bit that has changed. So the other
//! one counts, which may be older, unless it is for plain mode: nobody takes a board's keys away by damaging them.

use crc::{CRC_32_ISO_HDLC, Crc, NoTable};

use crate::Settings;

/// Most bytes of a copy; a page of flash is at least as long.
pub const BYTES: usize = 1280;
/// Most bytes of settings in a copy.
const SETTINGS_BYTES: usize = 240;
/// Most bytes of keys in a copy.
pub const KEYS_BYTES: usize = BYTES - HEADER - SETTINGS_BYTES - CHECKSUM;

const MAGIC: [u8; 4] = *b"CARs";
const SETTINGS_ONLY: u8 = 1;
const WITH_KEYS: u8 = 2;
const INSECURE: u8 = 3;
const HEADER: usize = 12;
const CHECKSUM: usize = 4;
/// Without a table: a few hundred bytes are summed once per boot, and a table takes 1 KiB of flash.
pub(crate) const SUM: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISO_HDLC);

/// Why a page has no settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PageError {
    /// Nothing was ever written, or something else was.
    #[error("the page holds no settings: write them with `cara provision`")]
    Absent,
    /// Another version of the layout.
    #[error(
        "the page holds settings of layout {0}, and this image knows 1 to 3: write them again, or update the image"
    )]
    Layout(u8),
    /// The checksum does not fit: a bit has changed, or power was cut while it was written.
    #[error("the page's checksum does not fit: write the settings again")]
    Damaged,
    /// No unit can be made of what stands there, or no host can have an address in it.
    #[error("the page's settings are of no unit, or of an address that no host can have: write them again")]
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

/// Writes a copy of settings alone; how many bytes of `page` it takes. `None` only if the page is shorter than [`BYTES`].
pub fn encode(settings: &Settings, generation: u32, page: &mut [u8; BYTES]) -> Option<usize> {
    encode_with(settings, &[], generation, page)
}

/// Writes a copy with keys in the form in which they stand in flash, or with none where `keys` is empty; how many bytes of
/// `page` it takes. `None` for more than [`KEYS_BYTES`] of them, and for keys of a board in plain mode.
pub fn encode_with(settings: &Settings, keys: &[u8], generation: u32, page: &mut [u8; BYTES]) -> Option<usize> {
    let layout = match (settings.insecure, keys) {
        (false, []) => SETTINGS_ONLY,
        (false, _) => WITH_KEYS,
        (true, []) => INSECURE,
        (true, _) => return None,
    };
    let length = {
        let body = page.get_mut(HEADER..BYTES - CHECKSUM)?;
        let settings = postcard::to_slice(settings, body.get_mut(..SETTINGS_BYTES)?).ok()?.len();
        body.get_mut(settings..settings.checked_add(keys.len())?)?.copy_from_slice(keys);
        settings + keys.len()
    };
    let header = page.get_mut(..HEADER)?;
    header.get_mut(..4)?.copy_from_slice(&MAGIC);
    header.get_mut(4..6)?.copy_from_slice(&[layout, 0]);
    header.get_mut(6..8)?.copy_from_slice(&(length as u16).to_le_bytes());
    header.get_mut(8..HEADER)?.copy_from_slice(&generation.to_le_bytes());
    let (summed, rest) = page.split_at_mut_checked(HEADER + length)?;
    rest.get_mut(..CHECKSUM)?.copy_from_slice(&SUM.checksum(summed).to_le_bytes());
    Some(HEADER + length + CHECKSUM)
}

/// A sound copy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Found<'p> {
    pub(crate) settings: Settings,
    generation: u32,
    /// In the form in which they stand in flash; empty where there are none. They are never shown.
    pub(crate) keys: KeyBytes<'p>,
}

/// Bytes that hold keys.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct KeyBytes<'p>(pub(crate) &'p [u8]);

impl core::fmt::Debug for KeyBytes<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{} bytes", self.0.len())
    }
}

/// Reads the settings of a copy with its generation.
pub fn decode(page: &[u8]) -> Result<(Settings, u32), PageError> {
    found(page).map(|found| (found.settings, found.generation))
}

fn found(page: &[u8]) -> Result<Found<'_>, PageError> {
    let (header, rest) = page.split_at_checked(HEADER).ok_or(PageError::Absent)?;
    let [magic @ .., layout, _, low, high, first, second, third, fourth] = header else {
        return Err(PageError::Absent);
    };
    if !is_marked(magic, MAGIC) {
        return Err(PageError::Absent);
    }
    let length = usize::from(u16::from_le_bytes([*low, *high]));
    let (body, rest) = rest.split_at_checked(length).ok_or(PageError::Damaged)?;
    let checksum = rest.first_chunk::<CHECKSUM>().ok_or(PageError::Damaged)?;
    let summed = page.get(..HEADER + length).ok_or(PageError::Damaged)?;
    if SUM.checksum(summed) != u32::from_le_bytes(*checksum) {
        return Err(PageError::Damaged);
    }
    if !matches!(*layout, SETTINGS_ONLY | WITH_KEYS | INSECURE) {
        return Err(PageError::Layout(*layout));
    }
    let (mut settings, keys) = postcard::take_from_bytes::<Settings>(body).map_err(|_| PageError::Unsound)?;
    settings.insecure = *layout == INSECURE;
    let generation = u32::from_le_bytes([*first, *second, *third, *fourth]);
    if settings.is_sound() && keys.is_empty() == (*layout != WITH_KEYS) {
        Ok(Found { settings, generation, keys: KeyBytes(keys) })
    } else {
        Err(PageError::Unsound)
    }
}

/// Whether something was written here, also if one byte of the mark has changed since.
pub(crate) fn is_marked(bytes: &[u8], mark: [u8; 4]) -> bool {
    bytes.iter().zip(mark).filter(|(byte, expected)| *byte != expected).count() <= 1
}

/// The settings of the newest sound copy, but none for plain mode beside a copy that cannot be used; why there are none, of the copy
/// that came nearest.
pub fn newest(first: &[u8], second: &[u8]) -> Result<Settings, PageError> {
    newest_found(first, second).map(|found| found.settings)
}

/// The newest sound copy.
pub(crate) fn newest_found<'p>(first: &'p [u8], second: &'p [u8]) -> Result<Found<'p>, PageError> {
    match (found(first), found(second)) {
        (Ok(one), Ok(two)) => Ok(if is_newer(two.generation, one.generation) { two } else { one }),
        (Ok(found), Err(error)) | (Err(error), Ok(found)) => match error {
            PageError::Absent => Ok(found),
            _ if !found.settings.insecure => Ok(found),
            error => Err(error),
        },
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
            insecure: false,
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

    /// An image without support for keys still reads the settings.
    #[test]
    fn keys_stand_behind_the_settings() {
        let written = settings("agv-07", 7);
        let mut page = [0xFF; BYTES];
        encode_with(&written, &[0xC7; 100], 5, &mut page).unwrap();
        assert_eq!(decode(&page), Ok((written, 5)));
        let found = found(&page).unwrap();
        assert_eq!(found.keys.0, [0xC7; 100]);
        assert!(!std::format!("{found:?}").contains("199"), "{found:?}");
    }

    #[test]
    fn plain_mode_is_asked_for_in_words_and_has_no_keys() {
        let mut written = settings("agv-07", 7);
        written.insecure = true;
        assert_eq!(decode(&page(&written, 5)), Ok((written.clone(), 5)));
        assert!(encode_with(&written, &[0xC7; 100], 5, &mut [0; BYTES]).is_none());
        written.insecure = false;
        assert_eq!(decode(&page(&written, 5)), Ok((written, 5)));
    }

    /// The IP stack would panic at each start.
    #[test]
    fn addresses_that_no_host_can_have_are_refused() {
        let host = Ipv4Addr::new(10, 0, 0, 7);
        for none in [Ipv4Addr::new(239, 0, 0, 7), Ipv4Addr::BROADCAST, Ipv4Addr::UNSPECIFIED, Ipv4Addr::LOCALHOST] {
            for [address, gateway, manager] in [[none, host, host], [host, none, host], [host, host, none]] {
                let mut settings = settings("agv-07", 7);
                settings.network = Network::Static { address, prefix: 24, gateway: Some(gateway) };
                settings.manager_address = Some(SocketAddrV4::new(manager, 2_000));
                assert_eq!(decode(&page(&settings, 1)), Err(PageError::Unsound), "{settings}");
            }
        }
    }

    #[test]
    fn the_longest_settings_fit() {
        let longest = String::from_utf8([b'n'; 32].to_vec()).unwrap();
        let mut settings = settings(&longest, u32::MAX);
        settings.manager = Some(Manager::new(&longest, u32::MAX).unwrap());
        let highest = Ipv4Addr::new(223, 255, 255, 255);
        let network = Network::Static { address: highest, prefix: 32, gateway: Some(highest) };
        settings.network = network;
        settings.wifi = Some(Wifi::new(&longest, &"p".repeat(63)).unwrap());
        assert!(encode(&settings, u32::MAX, &mut [0; BYTES]).is_some());
        assert!(encode_with(&settings, &[1; KEYS_BYTES], u32::MAX, &mut [0; BYTES]).is_some());
        assert!(encode_with(&settings, &[1; BYTES], u32::MAX, &mut [0; BYTES]).is_none());
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

    /// The copy that is left may be of the time before the board got its keys.
    #[test]
    fn no_flipped_bit_leads_to_plain_mode() {
        let plain = Settings { insecure: true, ..settings("agv-07", 7) };
        let (first, mut second) = (page(&plain, 1), [0xFF; BYTES]);
        let used = encode_with(&settings("agv-07", 7), &[0xC7; 100], 2, &mut second).unwrap();
        for bit in 0..used * 8 {
            let mut damaged = second;
            damaged[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(newest(&first, &damaged), Err(PageError::Damaged), "bit {bit}");
            assert_eq!(newest(&damaged, &first), Err(PageError::Damaged), "bit {bit}");
        }
        for never_written in [[0xFF; BYTES], [0; BYTES]] {
            assert_eq!(newest(&first, &never_written), Ok(plain.clone()));
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
        fn nothing_summed_panics(body in prop::collection::vec(any::<u8>(), 0..200), layout in 0_u8..5) {
            let mut page = [0; BYTES];
            page[..4].copy_from_slice(&MAGIC);
            page[4] = layout;
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
