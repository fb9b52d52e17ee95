//! The boot counter of a board, kept in two pages of flash of its own. It makes random numbers differ between boots
//! even where the board's noise does not.
//!
//! Each boot appends a record; when a page is full the other one is erased, so that the record with the highest count
//! is never in a page that is being erased. Where no record of the other page can be read any more, it is filled instead: one of
//! them may have had that count. A record has 64 bytes:
//!
//! | offset | size | field |
//! |---|---|---|
//! | 0 | 4 | `CARb` |
//! | 4 | 8 | the count, little-endian, from 1 |
//! | 12 | 16 | the highest claim that the unit has obeyed: term and claimant, little-endian; zero for none |
//! | 28 | 16 | its tag |
//! | 44 | 6 | the fingerprint of the pair key |
//! | 50 | 10 | zero |
//! | 60 | 4 | CRC-32 (ISO-HDLC) of all before, little-endian |
//!
//! A claim that is stored is a record with a count of its own; each later one repeats it, so that it is where the count is.
//!
//! A count is returned once its record has been read back, and counts only rise: wherever power is cut, no count is
//! returned twice. Nothing else erases the pages; a full chip erase takes the keys with them. For each record behind the newest
//! that cannot be read a number is passed over: its own may have been returned. If such a record was the only one with a claim, the
//! claim before counts again.

use cara_core::distribution::claim::{Claim, StoredClaim, TaggedClaim};
use cara_secure::random::BootCounter;
use embedded_storage::nor_flash::NorFlash;

use crate::page::{SUM, is_marked};

/// Bytes of a record, which are written at once: a multiple of what any of these chips writes at once.
pub const RECORD_BYTES: usize = 64;
/// Most bytes of a page that are used: the pages of some chips are far longer than need be.
const USED_BYTES: u32 = 16 * 1024;

const MAGIC: [u8; 4] = *b"CARb";
const COUNT: core::ops::Range<usize> = 4..12;
const CLAIM: core::ops::Range<usize> = 12..50;
const SUMMED: usize = RECORD_BYTES - 4;
const ERASED: [u8; RECORD_BYTES] = [0xFF; RECORD_BYTES];

/// Why a board does not know which of its lives this is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BootError<E> {
    /// The driver says so.
    #[error("the flash with the count of starts cannot be read or written")]
    Flash(E),
    /// No record can be written to either page any more, or the count has come to its end.
    #[error("the pages with the count of starts are worn out: this board needs other flash")]
    Worn,
}

impl<E> From<E> for BootError<E> {
    fn from(error: E) -> Self {
        Self::Flash(error)
    }
}

/// The count in two pages of flash.
pub struct Boots<F> {
    flash: F,
    pages: [u32; 2],
    erase_bytes: u32,
}

/// What stands in a page.
#[derive(Clone, Copy)]
struct Seen {
    /// The highest count, or 0.
    newest: u64,
    /// The claim beside it.
    claim: StoredClaim,
    /// Where the page is erased from.
    free: u32,
    /// Records behind the newest that cannot be read.
    lost: u64,
}

impl<F: NorFlash> Boots<F> {
    /// The count in the pages at these offsets, as the driver counts them, of so many bytes each.
    pub const fn new(flash: F, pages: [u32; 2], erase_bytes: u32) -> Self {
        const { assert!(RECORD_BYTES.is_multiple_of(F::WRITE_SIZE), "a record is written at once") }
        Self { flash, pages, erase_bytes }
    }

    /// Ends with the driver.
    pub fn free(self) -> F {
        self.flash
    }

    fn used_bytes(&self) -> u32 {
        self.erase_bytes.min(USED_BYTES)
    }

    fn offsets(&self) -> impl DoubleEndedIterator<Item = u32> + use<F> {
        (0..self.used_bytes() / RECORD_BYTES as u32).map(|index| index * RECORD_BYTES as u32)
    }

    fn look(&mut self, page: u32) -> Result<Seen, F::Error> {
        let mut seen = Seen { newest: 0, claim: StoredClaim::default(), free: 0, lost: 0 };
        for offset in self.offsets() {
            let record = self.read(page + offset)?;
            if record != ERASED {
                seen.free = offset + RECORD_BYTES as u32;
            }
            match count(&record) {
                Some((count, claim)) if count > seen.newest => {
                    (seen.newest, seen.claim, seen.lost) = (count, claim, 0);
                }
                None if is_marked(&record, MAGIC) => seen.lost = seen.lost.saturating_add(1),
                _ => {}
            }
        }
        Ok(seen)
    }

    fn read(&mut self, at: u32) -> Result<[u8; RECORD_BYTES], F::Error> {
        let mut record = ERASED;
        self.flash.read(at, &mut record).map(|()| record)
    }

    /// Writes a record to the first place from `free` on that takes it; whether there was one.
    fn put(&mut self, page: u32, free: u32, record: &[u8; RECORD_BYTES]) -> Result<bool, F::Error> {
        for offset in self.offsets().filter(|offset| *offset >= free) {
            self.flash.write(page + offset, record)?;
            if self.read(page + offset)? == *record {
                return Ok(true);
            }
        }
        Ok(false)
    }
}

impl<F: NorFlash> Boots<F> {
    /// The claim that is stored.
    pub fn claim(&mut self) -> Result<StoredClaim, BootError<F::Error>> {
        Ok(self.newest()?.1.claim)
    }

    /// Stores a claim, which costs one record; nothing where it is stored already. When a page is full the other one is erased, for
    /// which the processor may stand still: not while anything moves.
    pub fn store_claim(&mut self, claim: &StoredClaim) -> Result<(), BootError<F::Error>> {
        if self.claim()? != *claim {
            self.append(Some(claim))?;
        }
        Ok(())
    }

    /// The page with the highest count, what stands in it, and the other page with what stands there.
    fn newest(&mut self) -> Result<(u32, Seen, u32, Seen), F::Error> {
        let [one, two] = self.pages;
        let (first, second) = (self.look(one)?, self.look(two)?);
        let (page, mut seen, older, other) =
            if second.newest > first.newest { (two, second, first, one) } else { (one, first, second, two) };
        // All that has been written since it was erased.
        if older.newest == 0 {
            seen.lost = seen.lost.saturating_add(older.lost);
        }
        Ok((page, seen, other, older))
    }

    /// Writes the next count, with the claim that is stored or another one.
    fn append(&mut self, claim: Option<&StoredClaim>) -> Result<u64, BootError<F::Error>> {
        let (page, seen, other, older) = self.newest()?;
        let next = seen.newest.checked_add(1).and_then(|next| next.checked_add(seen.lost)).ok_or(BootError::Worn)?;
        let record = record(next, claim.unwrap_or(&seen.claim));
        if self.put(page, seen.free, &record)? {
            return Ok(next);
        }
        // If power were cut behind the erasure, nothing would say that the counts of those that cannot be read were returned.
        if older.newest == 0 && older.lost > 0 && self.put(other, older.free, &record)? {
            return Ok(next);
        }
        self.flash.erase(other, other + self.erase_bytes)?;
        if self.put(other, 0, &record)? { Ok(next) } else { Err(BootError::Worn) }
    }
}

/// The claim in [`Boots`], whatever the flash: a program of several boards has one static for it.
pub trait ClaimStore: Send {
    /// The claim that is stored; `None` if the flash cannot be read.
    fn stored(&mut self) -> Option<StoredClaim>;

    /// Stores a claim, as [`Boots::store_claim`] does; whether it is stored.
    fn store(&mut self, claim: &StoredClaim) -> bool;
}

impl<F: NorFlash + Send> ClaimStore for Boots<F> {
    fn stored(&mut self) -> Option<StoredClaim> {
        self.claim().ok()
    }

    fn store(&mut self, claim: &StoredClaim) -> bool {
        self.store_claim(claim).is_ok()
    }
}

impl<F: NorFlash> BootCounter for Boots<F> {
    type Error = BootError<F::Error>;

    fn advance(&mut self) -> Result<u64, Self::Error> {
        self.append(None)
    }
}

fn record(count: u64, claim: &StoredClaim) -> [u8; RECORD_BYTES] {
    let mut record = [0; RECORD_BYTES];
    let (summed, sum) = record.split_at_mut(SUMMED);
    let (magic, rest) = summed.split_at_mut(MAGIC.len());
    magic.copy_from_slice(&MAGIC);
    let (number, rest) = rest.split_at_mut(COUNT.len());
    number.copy_from_slice(&count.to_le_bytes());
    let StoredClaim { tagged: TaggedClaim { claim: Claim { term, claimant }, tag }, key } = claim;
    let fields: [&[u8]; 4] = [&term.to_le_bytes(), &claimant.to_le_bytes(), tag, key];
    rest.iter_mut().zip(fields.into_iter().flatten()).for_each(|(to, from)| *to = *from);
    sum.copy_from_slice(&SUM.checksum(summed).to_le_bytes());
    record
}

/// The count of a sound record, and the claim in it.
fn count(record: &[u8; RECORD_BYTES]) -> Option<(u64, StoredClaim)> {
    let count = u64::from_le_bytes(*record.get(COUNT)?.first_chunk()?);
    let (term, rest) = record.get(CLAIM)?.split_first_chunk()?;
    let (claimant, rest) = rest.split_first_chunk()?;
    let (tag, rest) = rest.split_first_chunk()?;
    let claim = Claim { term: u64::from_le_bytes(*term), claimant: u64::from_le_bytes(*claimant) };
    let claim = StoredClaim { tagged: TaggedClaim { claim, tag: *tag }, key: *rest.first_chunk()? };
    (*record == self::record(count, &claim)).then_some((count, claim))
}

#[cfg(test)]
mod tests {
    use super::*;
    use embedded_storage::nor_flash::{ErrorType, NorFlashError, NorFlashErrorKind, ReadNorFlash};
    use proptest::prelude::*;
    use std::vec::Vec;

    const PAGE: usize = 4 * RECORD_BYTES;
    const WORD: usize = 4;

    #[derive(Clone, Copy, Debug, PartialEq, Eq)]
    struct PowerCut;

    impl NorFlashError for PowerCut {
        fn kind(&self) -> NorFlashErrorKind {
            NorFlashErrorKind::Other
        }
    }

    /// Two pages, and power for so many words that are written or erased.
    struct Chip {
        bytes: Vec<u8>,
        power: usize,
        /// Places that take nothing any more.
        worn: Vec<usize>,
    }

    impl Chip {
        fn new() -> Self {
            Self { bytes: std::vec![0xFF; 2 * PAGE], power: usize::MAX, worn: Vec::new() }
        }

        fn spend(&mut self) -> Result<(), PowerCut> {
            self.power = self.power.checked_sub(1).ok_or(PowerCut)?;
            Ok(())
        }

        fn keep(&mut self, claim: &StoredClaim) -> Result<(), BootError<PowerCut>> {
            Boots::new(self, [0, PAGE as u32], PAGE as u32).store_claim(claim)
        }

        fn claim(&mut self) -> StoredClaim {
            Boots::new(self, [0, PAGE as u32], PAGE as u32).claim().unwrap()
        }

        fn boot(&mut self) -> Result<u64, BootError<PowerCut>> {
            Boots::new(self, [0, PAGE as u32], PAGE as u32).advance()
        }
    }

    impl ErrorType for Chip {
        type Error = PowerCut;
    }

    impl ReadNorFlash for Chip {
        const READ_SIZE: usize = 1;

        fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), PowerCut> {
            bytes.copy_from_slice(&self.bytes[offset as usize..][..bytes.len()]);
            Ok(())
        }

        fn capacity(&self) -> usize {
            self.bytes.len()
        }
    }

    impl NorFlash for Chip {
        const WRITE_SIZE: usize = WORD;
        const ERASE_SIZE: usize = PAGE;

        /// What power leaves of a page that is being erased is anything: here every other word is erased already.
        fn erase(&mut self, from: u32, to: u32) -> Result<(), PowerCut> {
            assert_eq!(to as usize - from as usize, PAGE);
            let words = (from as usize..to as usize).step_by(WORD);
            for at in words.clone().step_by(2).chain(words.skip(1).step_by(2)) {
                self.spend()?;
                self.bytes[at..][..WORD].fill(0xFF);
            }
            Ok(())
        }

        /// Programming clears bits and sets none; of the word that power is cut in, half has been written.
        fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), PowerCut> {
            for (at, word) in (offset as usize..).step_by(WORD).zip(bytes.chunks(WORD)) {
                let powered = self.spend();
                let written = if powered.is_ok() { WORD } else { WORD / 2 };
                let worn = self.worn.contains(&(at / RECORD_BYTES));
                for (to, from) in self.bytes[at..].iter_mut().zip(&word[..written]).filter(|_| !worn) {
                    *to &= from;
                }
                powered?;
            }
            Ok(())
        }
    }

    #[test]
    fn counts_rise_by_one_through_page_after_page() {
        let mut chip = Chip::new();
        for life in 1..50 {
            assert_eq!(chip.boot(), Ok(life));
        }
    }

    /// Power is cut in each word that is written or erased, in each life around two changes of page, and also in the life
    /// that comes after that: no count is returned twice, and none is lost.
    #[test]
    fn wherever_power_is_cut_counts_rise() {
        let (mut cuts, mut second_cuts) = (0, 0);
        for lives in 0..12 {
            let before = || {
                let mut chip = Chip::new();
                (0..lives).for_each(|life| assert_eq!(chip.boot(), Ok(life + 1)));
                chip
            };
            for power in 0.. {
                let mut chip = before();
                chip.power = power;
                if chip.boot().is_ok() {
                    break;
                }
                cuts += 1;
                for second in 0.. {
                    let mut chip = Chip { bytes: chip.bytes.clone(), power: second, worn: Vec::new() };
                    let interrupted = chip.boot();
                    chip.power = usize::MAX;
                    let counts = [interrupted.unwrap_or(lives), chip.boot().unwrap(), chip.boot().unwrap()];
                    assert!(counts[0] >= lives && counts[1] > counts[0] && counts[2] > counts[1], "{counts:?}");
                    if interrupted.is_ok() {
                        break;
                    }
                    second_cuts += 1;
                }
            }
        }
        assert!(cuts > 100 && second_cuts > 1_000, "{cuts} {second_cuts}");
    }

    /// A bit of the newest record has changed, in whichever life, and then power is cut in each word that the next two lives write
    /// or erase: each record may have been the only one that said that its count was returned.
    #[test]
    fn wherever_power_is_cut_behind_a_rotten_record_counts_rise() {
        let mut second_cuts = 0;
        for lives in 1..12 {
            let before = || {
                let mut chip = Chip::new();
                (1..=lives).for_each(|life| assert_eq!(chip.boot(), Ok(life)));
                let record = record(lives, &StoredClaim::default());
                let newest = chip.bytes.chunks(RECORD_BYTES).position(|bytes| bytes == record).unwrap();
                chip.bytes[newest * RECORD_BYTES + 5] ^= 1;
                chip
            };
            for power in 0.. {
                let mut chip = before();
                chip.power = power;
                let first = chip.boot();
                for second in 0.. {
                    let mut chip = Chip { bytes: chip.bytes.clone(), power: second, worn: Vec::new() };
                    let interrupted = chip.boot();
                    chip.power = usize::MAX;
                    let counts = [Ok(lives), first, interrupted, chip.boot(), chip.boot()];
                    let returned: Vec<_> = counts.iter().flatten().collect();
                    assert!(
                        returned.is_sorted_by(|one, next| one < next),
                        "{lives} lives, {power}, {second}: {counts:?}"
                    );
                    if interrupted.is_ok() {
                        break;
                    }
                    second_cuts += 1;
                }
                if first.is_ok() {
                    break;
                }
            }
        }
        assert!(second_cuts > 1_000, "{second_cuts}");
    }

    #[test]
    fn no_flipped_bit_of_the_newest_record_repeats_a_count() {
        for lives in 1..12 {
            for bit in 0..RECORD_BYTES * 8 {
                let mut chip = Chip::new();
                let last = (0..lives).map(|_| chip.boot().unwrap()).last().unwrap();
                let newest =
                    chip.bytes.chunks(RECORD_BYTES).position(|bytes| bytes == record(last, &StoredClaim::default()));
                chip.bytes[newest.unwrap() * RECORD_BYTES + bit / 8] ^= 1 << (bit % 8);
                let counts = [last, chip.boot().unwrap(), chip.boot().unwrap()];
                assert!(counts.is_sorted_by(|one, next| one < next), "{lives} lives, bit {bit}: {counts:?}");
            }
        }
    }

    fn claim(term: u64) -> StoredClaim {
        let claim = Claim { term, claimant: !term };
        StoredClaim { tagged: TaggedClaim { claim, tag: [term as u8; 16] }, key: [9; 6] }
    }

    #[test]
    fn a_claim_is_stored_through_starts_and_pages() {
        let mut chip = Chip::new();
        assert_eq!(chip.claim(), StoredClaim::default());
        let mut count = 0;
        for stored in [claim(1), claim(2), claim(u64::MAX), claim(1)] {
            chip.keep(&stored).unwrap();
            let bytes = chip.bytes.clone();
            chip.keep(&stored).unwrap();
            assert_eq!(chip.bytes, bytes, "nothing is written for the same one");
            for _ in 0..11 {
                let next = chip.boot().unwrap();
                assert!(next > count && chip.claim() == stored);
                count = next;
            }
        }
    }

    /// Power is cut in each word that is written or erased for a claim: the one before it is stored, or the new one.
    #[test]
    fn wherever_power_is_cut_there_is_a_claim() {
        let (old, new) = (claim(4), claim(5));
        for lives in 0..12 {
            for power in 0.. {
                let mut chip = Chip::new();
                chip.keep(&old).unwrap();
                (0..lives).for_each(|_| assert!(chip.boot().is_ok()));
                chip.power = power;
                let kept = chip.keep(&new).is_ok();
                chip.power = usize::MAX;
                let found = chip.claim();
                assert!(found == new || (found == old && !kept), "{lives}, {power}: {found:?}");
                chip.boot().unwrap();
                assert_eq!(chip.claim(), found);
                if kept {
                    break;
                }
            }
        }
    }

    #[test]
    fn places_that_are_worn_are_passed_over_until_none_is_left() {
        let mut chip = Chip::new();
        chip.worn = std::vec![1, 2, 4];
        for life in 1..40 {
            assert_eq!(chip.boot(), Ok(life));
        }
        chip.worn = (0..8).collect();
        let mut last = Ok(0);
        for _ in 0..8 {
            last = chip.boot();
        }
        assert_eq!(last, Err(BootError::Worn));
    }

    /// Before its first life a board's pages hold anything, old code for example.
    #[test]
    fn what_stood_there_before_is_erased() {
        let mut chip = Chip::new();
        chip.bytes.fill(0x5A);
        assert_eq!([chip.boot(), chip.boot(), chip.boot()], [Ok(1), Ok(2), Ok(3)]);
    }

    proptest! {
        /// Whatever stands in the pages: there is a count, and the next life has a greater one.
        #[test]
        fn nothing_in_flash_panics(bytes in prop::collection::vec(any::<u8>(), 2 * PAGE), sound in 0_usize..8, high: u64) {
            let mut chip = Chip::new();
            chip.bytes = bytes;
            chip.bytes[sound * RECORD_BYTES..][..RECORD_BYTES].copy_from_slice(&record(high, &claim(7)));
            match chip.boot() {
                Ok(count) => {
                    prop_assert!(count > high);
                    match chip.boot() {
                        Ok(next) => prop_assert!(next > count),
                        Err(error) => prop_assert_eq!((error, count), (BootError::Worn, u64::MAX)),
                    }
                }
                Err(error) => prop_assert_eq!((error, high), (BootError::Worn, u64::MAX)),
            }
        }
    }
}
