//! A serial device: raw bytes at a rate, without waiting.

use std::fs::{File, OpenOptions};
use std::io::{self, Read, Write};
use std::net::Ipv4Addr;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use rustix::fs::OFlags;
use rustix::termios::{ControlModes, OptionalActions, QueueSelector, ioctl_tiocexcl, tcflush, tcgetattr, tcsetattr};

pub(crate) struct Tty(File);

impl Tty {
    /// Opens `device` for this process alone.
    pub(crate) fn open(device: &Path, baud: u32) -> io::Result<Self> {
        let flags = (OFlags::NONBLOCK | OFlags::NOCTTY).bits();
        let file = OpenOptions::new().read(true).write(true).custom_flags(flags.cast_signed()).open(device)?;
        let mut settings = tcgetattr(&file)?;
        ioctl_tiocexcl(&file)?;
        settings.make_raw();
        settings.control_modes |= ControlModes::CLOCAL | ControlModes::CREAD;
        settings.control_modes &= !(ControlModes::CRTSCTS | ControlModes::CSTOPB);
        settings.set_speed(baud)?;
        tcsetattr(&file, OptionalActions::Now, &settings)?;
        // What came before the rate was set is junk.
        tcflush(&file, QueueSelector::IOFlush)?;
        Ok(Self(file))
    }

    /// A loopback address that no other device of this host has, as far as 65,536 of them go.
    pub(crate) fn address(&self) -> anyhow::Result<Ipv4Addr> {
        let device = self.0.metadata()?.rdev();
        let (major, minor) = (rustix::fs::major(device), rustix::fs::minor(device));
        let [.., major] = major.to_be_bytes();
        let [.., minor] = minor.to_be_bytes();
        Ok(Ipv4Addr::new(127, 67, major, minor))
    }

    /// What has come; 0 if nothing has.
    pub(crate) fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self.0.read(buffer) {
            Ok(0) => Err(io::ErrorKind::UnexpectedEof.into()),
            read => none_if_waiting(read),
        }
    }

    /// How many bytes were taken.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        none_if_waiting(self.0.write(bytes))
    }
}

/// 0 for what would have to wait.
pub(crate) fn none_if_waiting(outcome: io::Result<usize>) -> io::Result<usize> {
    match outcome {
        Err(error) if matches!(error.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) => Ok(0),
        outcome => outcome,
    }
}

impl AsFd for Tty {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.as_fd()
    }
}
