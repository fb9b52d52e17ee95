//! The count of the board's lives and the claim that it obeys, in a file of the host: QEMU's board has no flash that can be written, and none that
//! outlives it. The file stands for two small pages of such flash; what is written to them is what a real board writes.

use core::ffi::CStr;

use cara_core::distribution::claim::StoredClaim;
use cara_secure::random::BootCounter;
use cara_settings::boots::{BootError, Boots, ClaimStore};
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash};
use semihosting::fs;
use semihosting::io::{Read, Seek, SeekFrom, Write};

use crate::arguments::Path;

/// Of each of the two pages: small, so that tests come to their ends.
const PAGE: u32 = 1_024;

/// The count and the claim in a file, which stays open for this life of the board.
pub(crate) struct File(Boots<Pages>);

impl File {
    /// The file with this path, which is made where there is none. Of one that cannot be opened nothing can be read.
    pub(crate) fn open(path: &Path) -> Self {
        Self(Boots::new(Pages(open(path).ok()), [0, PAGE], PAGE))
    }
}

/// The host does not let the board read or write the file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Refused;

impl NorFlashError for Refused {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl BootCounter for File {
    type Error = BootError<Refused>;

    fn advance(&mut self) -> Result<u64, Self::Error> {
        let count = self.0.advance()?;
        cara_vehicle::info!("start number {}", count);
        Ok(count)
    }
}

impl ClaimStore for File {
    fn stored(&mut self) -> Option<StoredClaim> {
        self.0.stored()
    }

    fn store(&mut self, claim: &StoredClaim) -> bool {
        self.0.store(claim)
    }
}

struct Pages(Option<fs::File>);

fn open(path: &Path) -> Result<fs::File, Refused> {
    let mut path = path.clone();
    path.push('\0').map_err(|_| Refused)?;
    let path = CStr::from_bytes_with_nul(path.as_bytes()).map_err(|_| Refused)?;
    if path.is_empty() {
        return Err(Refused);
    }
    let mut options = fs::File::options();
    options.read(true).write(true);
    let file = options.open(path).or_else(|_| options.create(true).truncate(true).open(path));
    let mut file = file.map_err(|_| Refused)?;
    // Flash is all there from the beginning. The file is not: the power may have gone while it was made.
    let length = file.seek(SeekFrom::End(0)).map_err(|_| Refused)?;
    erase(&mut file, (2 * PAGE).saturating_sub(length as u32))?;
    Ok(file)
}

fn erase(file: &mut fs::File, bytes: u32) -> Result<(), Refused> {
    (0..bytes).try_for_each(|_| file.write_all(&[0xFF])).map_err(|_| Refused)
}

impl Pages {
    /// The file, at this place of it.
    fn at(&mut self, offset: u32) -> Result<&mut fs::File, Refused> {
        let file = self.0.as_mut().ok_or(Refused)?;
        file.seek(SeekFrom::Start(offset.into())).map_err(|_| Refused)?;
        Ok(file)
    }
}

impl ErrorType for Pages {
    type Error = Refused;
}

impl ReadNorFlash for Pages {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Refused> {
        self.at(offset)?.read_exact(bytes).map_err(|_| Refused)
    }

    fn capacity(&self) -> usize {
        2 * PAGE as usize
    }
}

impl NorFlash for Pages {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = PAGE as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Refused> {
        erase(self.at(from)?, to.saturating_sub(from))
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Refused> {
        self.at(offset)?.write_all(bytes).map_err(|_| Refused)
    }
}
