//! Files that the command line names, to be read.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use zeroize::Zeroizing;

/// The bytes of a file, up to one more than the longest that is taken, and whether it is longer than that.
///
/// Anything but a regular file is refused: a pipe would block until its other end writes.
pub fn read(path: &Path, longest: u64) -> io::Result<(Zeroizing<Vec<u8>>, bool)> {
    if !path.metadata()?.is_file() {
        return Err(io::Error::other("it is no file"));
    }
    let mut bytes = Zeroizing::new(Vec::new());
    File::open(path)?.take(longest.saturating_add(1)).read_to_end(&mut bytes)?;
    let is_longer = bytes.len() as u64 > longest;
    Ok((bytes, is_longer))
}
