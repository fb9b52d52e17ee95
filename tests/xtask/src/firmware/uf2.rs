//! The files that are flashed: what an ELF file puts into flash, as plain bytes and as UF2.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use cara_settings::board::Board;
use cara_settings::uf2::{PAYLOAD, Place, block};
use object::Endianness;
use object::elf::PT_LOAD;
use object::read::elf::{ElfFile32, ProgramHeader};

/// What lies in flash from `address` on. Gaps are as erased flash is.
#[derive(Debug, PartialEq, Eq)]
struct Flash {
    address: u32,
    bytes: Vec<u8>,
}

const ERASED: u8 = 0xFF;
/// Flash is at most this long; more would be a hole between flash and RAM.
const LONGEST: usize = 16 * 1024 * 1024;

/// Writes the file that the board's own boot loader or probe takes, beside the ELF file.
pub(crate) fn write_beside(elf: &Path, board: &Board) -> Result<PathBuf> {
    let bytes = std::fs::read(elf).with_context(|| format!("cannot read {}", elf.display()))?;
    let flash = flash_of(&bytes).with_context(|| elf.display().to_string())?;
    let [end, _] = board.boots;
    if flash.address as usize + flash.bytes.len() > end as usize {
        bail!("{}: code lies in the pages of the count of lives or of the settings, from {end:#x}", elf.display());
    }
    let (extension, bytes) = match board.uf2 {
        Some(families) => ("uf2", uf2(&flash, families.image)),
        None => ("bin", flash.bytes),
    };
    let file = elf.with_extension(extension);
    std::fs::write(&file, bytes).with_context(|| format!("cannot write {}", file.display()))?;
    Ok(file)
}

fn flash_of(elf: &[u8]) -> Result<Flash> {
    let file: ElfFile32<'_, Endianness> = ElfFile32::parse(elf).context("no ELF file of 32 bits")?;
    let endian = file.endian();
    let mut parts = Vec::new();
    for header in file.elf_program_headers() {
        if header.p_type(endian) == PT_LOAD && header.p_filesz(endian) > 0 {
            let bytes = ProgramHeader::data(header, endian, elf).ok().context("a segment outside of the file")?;
            parts.push((header.p_paddr(endian), bytes));
        }
    }
    joined(parts)
}

fn joined(mut parts: Vec<(u32, &[u8])>) -> Result<Flash> {
    parts.sort_by_key(|(address, _)| *address);
    let Some((address, _)) = parts.first().copied() else { bail!("nothing goes into flash") };
    let mut bytes = Vec::new();
    for (start, part) in parts {
        let at = (start - address) as usize;
        if at < bytes.len() || at + part.len() > LONGEST {
            bail!("segments overlap, or lie too far apart, at {start:#x}");
        }
        bytes.resize(at, ERASED);
        bytes.extend_from_slice(part);
    }
    Ok(Flash { address, bytes })
}

fn uf2(flash: &Flash, family: u32) -> Vec<u8> {
    let blocks = flash.bytes.chunks(PAYLOAD);
    let total = blocks.len() as u32;
    let mut file = Vec::new();
    for (number, bytes) in (0..).zip(blocks) {
        let mut payload = [ERASED; PAYLOAD];
        payload.iter_mut().zip(bytes).for_each(|(place, byte)| *place = *byte);
        let address = flash.address + number * PAYLOAD as u32;
        file.extend(block(Place { address, number, total, family }, &payload));
    }
    file
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_as_erased_flash() {
        let flash = joined(vec![(0x104, &[3]), (0x100, &[1, 2])]).unwrap();
        assert_eq!(flash, Flash { address: 0x100, bytes: vec![1, 2, 0xFF, 0xFF, 3] });
    }

    #[test]
    fn what_makes_no_flash_is_refused() {
        assert!(joined(vec![]).is_err());
        assert!(joined(vec![(0x100, &[1, 2]), (0x101, &[3])]).is_err());
        assert!(joined(vec![(0x1000_0000, &[1]), (0x2000_0000, &[2])]).is_err());
        assert!(flash_of(b"no ELF").is_err());
    }

    #[test]
    fn blocks_follow_each_other() {
        let flash = Flash { address: 0x1000_0000, bytes: vec![7; PAYLOAD + 1] };
        let file = uf2(&flash, 0xE48B_FF56);
        let word = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap());
        assert_eq!(file.len(), 1024);
        assert_eq!((word(12), word(20), word(24)), (0x1000_0000, 0, 2));
        assert_eq!((word(512 + 12), word(512 + 20), word(512 + 24)), (0x1000_0100, 1, 2));
        assert_eq!(&file[512 + 32..512 + 34], &[7, ERASED]);
    }
}
