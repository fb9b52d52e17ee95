//! What an operator holds ends with the operator, not with the process: when standard input or output hangs up or reaches
//! its end, as those of a cut ssh session do.

use std::io::{self, stdin, stdout};
use std::os::fd::AsFd;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{FileType, fstat};
use rustix::io::{Errno, read};

use cara_tools::exit::Ended;

/// Input that is typed and not asked for is dropped in pieces of so many bytes, at most one in each pause.
const PIECE: usize = 4096;
const PAUSE: Duration = Duration::from_millis(20);
/// Pieces that may stand in standard input when the command starts.
const PIECES: usize = 64;
const HUNG_UP: PollFlags = PollFlags::HUP.union(PollFlags::ERR).union(PollFlags::NVAL);

/// Watches the operator's end of standard input and output.
pub(crate) struct Attended {
    end: Arc<OnceLock<&'static str>>,
}

impl Attended {
    /// Refuses what would end at once. `what` names the option whose use it is.
    pub(crate) fn check(what: &str) -> anyhow::Result<()> {
        match is_at_end()? {
            false => Ok(()),
            true => Err(Ended::usage(format!(
                "standard input is at its end or a file, as that of a background job or with /dev/null: {what} ends with it, so \
                 that nothing goes on that nobody attends. Give it a terminal or a pipe that stays open, or add --detached: \
                 then only the end of this command ends it"
            ))),
        }
    }

    /// Starts to watch; `release` is called at the end, in a thread of its own.
    pub(crate) fn watch(release: impl FnOnce() + Send + 'static) -> io::Result<Self> {
        let end = Arc::<OnceLock<&'static str>>::default();
        let recorded = end.clone();
        std::thread::Builder::new().name("attended".into()).spawn(move || {
            let _ = recorded.set(await_end());
            release();
        })?;
        Ok(Self { end })
    }

    /// What has ended, if something has.
    pub(crate) fn end(&self) -> Option<&'static str> {
        self.end.get().copied()
    }
}

fn is_at_end() -> io::Result<bool> {
    // Such a file is the script's, as that of a loop that reads it: nothing of it is read.
    if FileType::from_raw_mode(fstat(stdin())?.st_mode).is_file() {
        return Ok(true);
    }
    let now = Timespec { tv_sec: 0, tv_nsec: 0 };
    for _ in 0..PIECES {
        let (stdin, stdout) = (stdin(), stdout());
        let mut fds = [PollFd::new(&stdin, PollFlags::IN), PollFd::new(&stdout, PollFlags::empty())];
        match poll(&mut fds, Some(&now)) {
            Ok(0) => return Ok(false),
            Ok(_) if end_of(&fds).is_some() => return Ok(true),
            Ok(_) | Err(Errno::INTR) => {}
            Err(errno) => return Err(errno.into()),
        }
    }
    Ok(false)
}

fn await_end() -> &'static str {
    let (stdin, stdout) = (stdin(), stdout());
    loop {
        let mut fds = [PollFd::new(&stdin, PollFlags::IN), PollFd::new(&stdout, PollFlags::empty())];
        match poll(&mut fds, None) {
            Ok(_) => {}
            Err(Errno::INTR) => continue,
            Err(_) => return "standard input and output cannot be watched",
        }
        if let Some(end) = end_of(&fds) {
            return end;
        }
        std::thread::sleep(PAUSE);
    }
}

/// What has ended; drops input that has come.
fn end_of([input, output]: &[PollFd<'_>; 2]) -> Option<&'static str> {
    if output.revents().intersects(HUNG_UP) {
        return Some("what read standard output has gone");
    }
    if input.revents().is_empty() {
        return None;
    }
    match read(input.as_fd(), &mut [0; PIECE]) {
        Ok(1..) | Err(Errno::INTR | Errno::AGAIN) => None,
        Ok(0) | Err(_) => Some("standard input has ended"),
    }
}
