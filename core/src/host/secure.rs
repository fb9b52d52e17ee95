//! The place of the cipher: a trait for sealing and opening frames in place, and the plain mode that does nothing.

use crate::error::CloseReason;

/// Seals and opens the frames of one link, in place, without IO.
pub trait Secure {
    /// Bytes that sealing adds behind a frame's body. With 0, sealing changes nothing, and frames may be written in
    /// another order than they were sealed in.
    const OVERHEAD: usize;

    /// Seals `frame`, whose last [`OVERHEAD`](Self::OVERHEAD) bytes are room for the tag.
    fn seal(&mut self, frame: &mut [u8]) -> Result<(), CloseReason>;

    /// Opens `frame` and returns its body, which is [`OVERHEAD`](Self::OVERHEAD) bytes shorter.
    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason>;
}

/// Plain mode: frames travel as they are. It has its own magic and port and never talks to a secured unit.
#[derive(Clone, Copy, Debug, Default)]
pub struct Plain;

impl Secure for Plain {
    const OVERHEAD: usize = 0;

    fn seal(&mut self, _frame: &mut [u8]) -> Result<(), CloseReason> {
        Ok(())
    }

    fn open<'f>(&mut self, frame: &'f mut [u8]) -> Result<&'f mut [u8], CloseReason> {
        Ok(frame)
    }
}
