//! UF2, the file form that a boot loader on a USB drive takes: blocks of 512 bytes, each with 256 bytes of flash, their
//! address, and the family of chips that they are for. (Microsoft, *USB Flashing Format*; Raspberry Pi, *RP2350 data
//! sheet*, "UF2 format details".)

/// Bytes of flash in a block. The boot ROMs of RP2040 and RP2350 take this many and no other number.
pub const PAYLOAD: usize = 256;
/// Bytes of a block.
pub const BLOCK: usize = 512;

const FIRST_MAGIC: u32 = 0x0A32_4655;
const SECOND_MAGIC: u32 = 0x9E5D_5157;
const LAST_MAGIC: u32 = 0x0AB1_6F30;
const HAS_FAMILY: u32 = 0x2000;
const HEADER: usize = 32;

/// Where a block stands in its file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Place {
    /// Where its bytes go; a multiple of 256.
    pub address: u32,
    /// Its number, from 0.
    pub number: u32,
    /// Blocks of the file.
    pub total: u32,
    /// The chip family that accepts it.
    pub family: u32,
}

/// Makes a block.
pub fn block(place: Place, payload: &[u8; PAYLOAD]) -> [u8; BLOCK] {
    let Place { address, number, total, family } = place;
    let fields = [FIRST_MAGIC, SECOND_MAGIC, HAS_FAMILY, address, PAYLOAD as u32, number, total, family];
    let mut block = [0; BLOCK];
    let (head, rest) = block.split_at_mut(HEADER);
    for (place, field) in head.chunks_exact_mut(4).zip(fields) {
        place.copy_from_slice(&field.to_le_bytes());
    }
    let (data, rest) = rest.split_at_mut(PAYLOAD);
    data.copy_from_slice(payload);
    let (_, magic) = rest.split_at_mut(BLOCK - HEADER - PAYLOAD - 4);
    magic.copy_from_slice(&LAST_MAGIC.to_le_bytes());
    block
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    #[test]
    fn every_field_is_where_the_format_says() {
        let place = Place { address: 0x101F_E000, number: 1, total: 2, family: 0xE48B_FF56 };
        let block = block(place, &[0xA5; PAYLOAD]);
        let word = |at: usize| u32::from_le_bytes(block[at..at + 4].try_into().unwrap());
        assert_eq!(&block[..4], b"UF2\n");
        assert_eq!((word(4), word(8)), (0x9E5D_5157, 0x2000));
        assert_eq!((word(12), word(16), word(20), word(24), word(28)), (0x101F_E000, 256, 1, 2, 0xE48B_FF56));
        assert!(block[32..288].iter().all(|byte| *byte == 0xA5));
        assert!(block[288..508].iter().all(|byte| *byte == 0));
        assert_eq!(word(508), 0x0AB1_6F30);
    }

    /// Another's reader understands what is written here.
    #[test]
    fn a_decoder_reads_it() {
        let mut file = Vec::new();
        for number in 0..3_u32 {
            let place = Place { address: 0x1000_0000 + 256 * number, number, total: 3, family: 0xE48B_FF59 };
            file.extend(block(place, &[number as u8; PAYLOAD]));
        }
        let (bytes, families) = uf2_decode::convert_from_uf2(&file).unwrap();
        let expected: Vec<u8> = (0..3).flat_map(|number| [number; PAYLOAD]).collect();
        assert_eq!((bytes, families.get(&0xE48B_FF59)), (expected, Some(&0x1000_0000)));
    }
}
