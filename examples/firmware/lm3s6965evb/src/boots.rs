//! The count of the board's lives and the term that it obeys, in a file of the host: QEMU's board has no flash that can be written, and none that
//! outlives it. The file stands for two small pages of such flash; what is written to them is what a real board writes.

use core::ffi::CStr;

use cara_core::term::Term;
use cara_secure::random::BootCounter;
use cara_settings::boots::{BootError, Boots, TermStore};
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash};
use semihosting::fs;
use semihosting::io::{Read, Seek, SeekFrom, Write};

use crate::arguments::Path;

/// Of each of the two pages: small, so that tests come to their ends.
const PAGE: u32 = 512;

/// The file with this path, which is made where there is none.
pub(crate) struct File(pub(crate) Path);

impl File {
    fn boots(&self) -> Result<Boots<Pages>, Refused> {
        Ok(Boots::new(Pages::open(&self.0)?, [0, PAGE], PAGE))
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
        let count = self.boots()?.advance()?;
        cara_vehicle::info!("start number {}", count);
        Ok(count)
    }
}

impl TermStore for File {
    fn stored(&mut self) -> Option<Term> {
        self.boots().ok()?.term().ok()
    }

    fn store(&mut self, term: Term) -> bool {
        self.boots().is_ok_and(|mut boots| boots.keep_term(term).is_ok())
    }
}

struct Pages(fs::File);

impl Pages {
    fn open(path: &Path) -> Result<Self, Refused> {
        let mut path = path.clone();
        path.push('\0').map_err(|_| Refused)?;
        let path = CStr::from_bytes_with_nul(path.as_bytes()).map_err(|_| Refused)?;
        if path.is_empty() {
            return Err(Refused);
        }
        if let Ok(file) = fs::File::options().read(true).write(true).open(path) {
            return Ok(Self(file));
        }
        let file = fs::File::options().read(true).write(true).create(true).truncate(true).open(path);
        let mut pages = Self(file.map_err(|_| Refused)?);
        pages.erase(0, 2 * PAGE)?;
        Ok(pages)
    }

    fn seek(&mut self, offset: u32) -> Result<(), Refused> {
        self.0.seek(SeekFrom::Start(offset.into())).map(drop).map_err(|_| Refused)
    }
}

impl ErrorType for Pages {
    type Error = Refused;
}

impl ReadNorFlash for Pages {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Refused> {
        self.seek(offset)?;
        self.0.read_exact(bytes).map_err(|_| Refused)
    }

    fn capacity(&self) -> usize {
        2 * PAGE as usize
    }
}

impl NorFlash for Pages {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = PAGE as usize;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Refused> {
        self.seek(from)?;
        (from..to).try_for_each(|_| self.0.write_all(&[0xFF])).map_err(|_| Refused)
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Refused> {
        self.seek(offset)?;
        self.0.write_all(bytes).map_err(|_| Refused)
    }
}
