//! What an image takes of a board, read from its ELF file.

use std::path::Path;

use anyhow::{Context, Result};
use object::{Object, ObjectSection, SectionFlags, SectionKind, elf};

/// Bytes that an image takes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Footprint {
    /// Code, constants, and the first values of variables.
    pub(crate) flash: u64,
    /// Variables that are always there.
    pub(crate) static_ram: u64,
}

/// Reads an image.
pub(crate) fn footprint(path: &Path) -> Result<Footprint> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let file = object::File::parse(&*bytes).with_context(|| format!("{} is no ELF file", path.display()))?;
    let mut sum = Footprint::default();
    for section in file.sections() {
        let SectionFlags::Elf { sh_flags, .. } = section.flags() else { continue };
        let loaded = sh_flags.contains(elf::SHF_ALLOC);
        let is_variable = sh_flags.contains(elf::SHF_WRITE);
        let in_file = !matches!(section.kind(), SectionKind::UninitializedData);
        sum.flash += if loaded && in_file { section.size() } else { 0 };
        sum.static_ram += if loaded && is_variable { section.size() } else { 0 };
    }
    Ok(sum)
}
