//! The wire between a TAP device and an emulator that cannot open one: frames on a Unix socket, each behind its length in four
//! bytes, as QEMU's `-netdev stream` has them.

use std::io::{ErrorKind, Read, Write};
use std::os::fd::AsRawFd;
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use smoltcp::phy::{Device, Medium, RxToken, TunTapInterface, TxToken, wait};
use smoltcp::time::{Duration as StackDuration, Instant as StackInstant};

/// How often the board's end is looked at. A shorter wait would be none.
const TICK: StackDuration = StackDuration::from_millis(1);
/// Bytes of a frame's length.
const LENGTH: usize = 4;

/// A wire whose far end is a socket, for one board after the other.
pub(crate) struct Wire {
    socket: PathBuf,
    state: Arc<State>,
    thread: Option<JoinHandle<Result<()>>>,
}

#[derive(Default)]
struct State {
    is_pulled: AtomicBool,
    is_over: AtomicBool,
}

impl Wire {
    /// From this device to a socket in this folder.
    pub(crate) fn lay(tap: &str, folder: &Path) -> Result<Self> {
        let socket = folder.join(tap);
        let listener = UnixListener::bind(&socket).context("the wire has no socket")?;
        listener.set_nonblocking(true)?;
        let state = Arc::<State>::default();
        let (tap, shared) = (tap.to_owned(), Arc::clone(&state));
        let thread = std::thread::spawn(move || carry(&tap, &listener, &shared));
        Ok(Self { socket, state, thread: Some(thread) })
    }

    /// Where the emulator connects.
    pub(crate) fn socket(&self) -> &Path {
        &self.socket
    }

    /// Plugs it in, or pulls it: nothing goes either way then, and neither end is told.
    pub(crate) fn plug(&self, is_plugged: bool) {
        self.state.is_pulled.store(!is_plugged, Ordering::Relaxed);
    }
}

impl Drop for Wire {
    fn drop(&mut self) {
        self.state.is_over.store(true, Ordering::Relaxed);
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(Ok(()))) | None => {}
            Some(failed) => eprintln!("a wire: {failed:?}"),
        }
    }
}

fn carry(tap: &str, listener: &UnixListener, state: &State) -> Result<()> {
    let mut device = TunTapInterface::new(tap, Medium::Ethernet).context("the TAP device cannot be opened")?;
    let mut board: Option<UnixStream> = None;
    let mut arrived = Vec::new();
    while !state.is_over.load(Ordering::Relaxed) {
        let passes = !state.is_pulled.load(Ordering::Relaxed);
        wait(device.as_raw_fd(), Some(TICK))?;
        if let Ok((connected, _)) = listener.accept() {
            connected.set_nonblocking(true)?;
            (board, arrived) = (Some(connected), Vec::new());
        }
        while let Some((frame, _)) = device.receive(StackInstant::ZERO) {
            frame.consume(|bytes| {
                let whole = [&(bytes.len() as u32).to_be_bytes(), bytes].concat();
                // A board that takes no more has hung, or lost its power.
                if passes && board.as_mut().is_some_and(|board| written(board, &whole).is_err()) {
                    board = None;
                }
            });
        }
        if board.as_mut().is_some_and(|board| !read(board, &mut arrived)) {
            board = None;
        }
        while let Some((length, rest)) = arrived.split_first_chunk::<LENGTH>()
            && let Some(frame) = rest.get(..u32::from_be_bytes(*length) as usize)
        {
            if passes && let Some(free) = device.transmit(StackInstant::ZERO) {
                free.consume(frame.len(), |bytes| bytes.copy_from_slice(frame));
            }
            arrived.drain(..LENGTH + frame.len());
        }
    }
    Ok(())
}

/// Reads what is there; `false` once there is no board any more.
fn read(board: &mut UnixStream, arrived: &mut Vec<u8>) -> bool {
    let mut bytes = [0; 4096];
    match board.read(&mut bytes) {
        Ok(0) => false,
        Ok(length) => {
            arrived.extend(bytes.iter().take(length));
            true
        }
        Err(error) => error.kind() == ErrorKind::WouldBlock,
    }
}

/// Writes a frame, for which a socket that is full gets a second.
fn written(board: &mut UnixStream, mut bytes: &[u8]) -> std::io::Result<()> {
    let deadline = Instant::now() + Duration::from_secs(1);
    while !bytes.is_empty() {
        match board.write(bytes) {
            Ok(length) => bytes = bytes.get(length..).unwrap_or_default(),
            Err(error) if error.kind() == ErrorKind::WouldBlock && Instant::now() < deadline => {
                std::thread::sleep(Duration::from_millis(1));
            }
            Err(error) => return Err(error),
        }
    }
    Ok(())
}
