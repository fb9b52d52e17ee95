//! The other end of a board's serial line, paced as the line would be: between the emulator's UART and either a TUN device of this
//! network, in SLIP (RFC 1055), or a pseudo-terminal with `cara line`. The emulated UART has no rate of its own: it takes what the
//! board writes at once.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{ErrorKind, Read, Write};
use std::os::fd::{AsRawFd, RawFd};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use cara_processes::{Process, network};
use fastrand::Rng;
use rustix::fs::{OFlags, fcntl_setfl};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use smoltcp::phy::{Device, Medium, RxToken, TunTapInterface, TxToken, wait};
use smoltcp::time::{Duration as StackDuration, Instant as StackInstant};

use crate::board::{FLEET, LONG};
use crate::keys::Keys;

/// Its device.
const DEVICE: &str = "tun0";
/// This end's address, and the board's.
const ADDRESS: &str = "10.78.0.1/24";
pub(crate) const BOARD: &str = "10.78.0.2/24";
/// As the image has it.
const MTU: u32 = 576;
/// Packets that wait in the device, as many as in the kernel's own SLIP. Where fewer do, what comes at once gets lost.
const WAITING: u32 = 10;
/// How often bytes are passed on, and the line is looked at.
const TICK: Duration = Duration::from_millis(1);

const END: u8 = 0xC0;
const ESCAPE: u8 = 0xDB;
const ESCAPED_END: u8 = 0xDC;
const ESCAPED_ESCAPE: u8 = 0xDD;

/// A serial line with this computer at one end.
pub(crate) struct Line {
    socket: PathBuf,
    state: Arc<State>,
    thread: Option<JoinHandle<Result<()>>>,
    _bridge: Option<Process>,
}

#[derive(Default)]
struct State {
    is_pulled: AtomicBool,
    /// One byte in so many is changed; 0: none.
    noise: AtomicU32,
    changed: AtomicU32,
    /// To the board and from it.
    bytes: [AtomicU64; 2],
    is_over: AtomicBool,
}

impl Line {
    /// A line with IP at this end.
    pub(crate) fn slip(keys: &Keys, baud: u32) -> Result<Self> {
        network::run(&format!("ip tuntap add name {DEVICE} mode tun"))?;
        network::run(&format!("ip address add {ADDRESS} dev {DEVICE}"))?;
        network::run(&format!("ip link set {DEVICE} mtu {MTU} txqueuelen {WAITING} up"))?;
        let device = || TunTapInterface::new(DEVICE, Medium::Ip).context("the TUN device cannot be opened");
        Self::open(keys, baud, move || Ok(End::Slip(device()?, Packet::default())), None)
    }

    /// A line without IP, and `cara line` at this end.
    pub(crate) fn native(keys: &Keys, baud: u32) -> Result<Self> {
        let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
        grantpt(&terminal)?;
        unlockpt(&terminal)?;
        let name = ptsname(&terminal, Vec::new())?.into_string()?;
        fcntl_setfl(&terminal, OFlags::NONBLOCK)?;
        let (rate, fleet) = (baud.to_string(), FLEET.to_string());
        let words = ["line", &name, "--baud", &rate, "--fleet", &fleet];
        let mut bridge = keys.process("line", &[&words, keys.words()].concat())?;
        bridge.expect("open", LONG)?;
        Self::open(keys, baud, || Ok(End::Native(terminal.into())), Some(bridge))
    }

    /// Waits for a board at a socket in the keys' folder.
    fn open(
        keys: &Keys,
        baud: u32,
        end: impl FnOnce() -> Result<End> + Send + 'static,
        bridge: Option<Process>,
    ) -> Result<Self> {
        let socket = keys.folder().join("line");
        let listener = UnixListener::bind(&socket).context("the line has no socket")?;
        listener.set_nonblocking(true)?;
        let state = Arc::<State>::default();
        let shared = Arc::clone(&state);
        let thread = std::thread::spawn(move || carry(&listener, end()?, baud, &shared));
        Ok(Self { socket, state, thread: Some(thread), _bridge: bridge })
    }

    /// Where the emulator's UART connects.
    pub(crate) fn socket(&self) -> &Path {
        &self.socket
    }

    /// Plugs it in, or pulls it: nothing goes either way then, and neither end is told.
    pub(crate) fn plug(&self, is_plugged: bool) {
        self.state.is_pulled.store(!is_plugged, Ordering::Relaxed);
    }

    /// Changes one byte in so many on its way; 0: none.
    pub(crate) fn disturb(&self, one_in: u32) {
        self.state.noise.store(one_in, Ordering::Relaxed);
    }

    /// Bytes that were changed.
    pub(crate) fn changed(&self) -> u32 {
        self.state.changed.load(Ordering::Relaxed)
    }

    /// Bytes that have gone to the board and come from it.
    pub(crate) fn bytes(&self) -> [u64; 2] {
        self.state.bytes.each_ref().map(|bytes| bytes.load(Ordering::Relaxed))
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        self.state.is_over.store(true, Ordering::Relaxed);
        match self.thread.take().map(JoinHandle::join) {
            Some(Ok(Ok(()))) | None => {}
            Some(failed) => eprintln!("the serial line: {failed:?}"),
        }
    }
}

/// This computer's end.
enum End {
    Slip(TunTapInterface, Packet),
    Native(File),
}

impl End {
    /// What is to be sent next.
    fn read(&mut self) -> Option<Vec<u8>> {
        match self {
            Self::Slip(device, _) => {
                let (received, _) = device.receive(StackInstant::ZERO)?;
                Some(received.consume(encoded))
            }
            Self::Native(terminal) => {
                let mut bytes = [0; 4096];
                let length = terminal.read(&mut bytes).ok()?;
                bytes.get(..length).map(<[u8]>::to_vec)
            }
        }
    }

    fn write(&mut self, received: Vec<u8>) {
        match self {
            Self::Slip(device, packet) => {
                for whole in received.into_iter().filter_map(|byte| packet.push(byte)) {
                    if let Some(free) = device.transmit(StackInstant::ZERO) {
                        free.consume(whole.len(), |bytes| bytes.copy_from_slice(&whole));
                    }
                }
            }
            // What nobody reads is lost, as on a wire.
            Self::Native(terminal) => drop(terminal.write(&received)),
        }
    }
}

impl AsRawFd for End {
    fn as_raw_fd(&self) -> RawFd {
        match self {
            Self::Slip(device, _) => device.as_raw_fd(),
            Self::Native(terminal) => terminal.as_raw_fd(),
        }
    }
}

/// Passes bytes on until the line is dropped.
fn carry(listener: &UnixListener, mut end: End, baud: u32, state: &State) -> Result<()> {
    let mut board: Option<UnixStream> = None;
    let [mut to_board, mut from_board] = [1, 3].map(|seed| Way::new(baud, seed));
    while !state.is_over.load(Ordering::Relaxed) {
        if to_board.queue.is_empty() {
            wait(end.as_raw_fd(), Some(StackDuration::from_micros(TICK.as_micros() as u64)))?;
        } else {
            std::thread::sleep(TICK);
        }
        if let Ok((connected, _)) = listener.accept() {
            connected.set_nonblocking(true)?;
            board = Some(connected);
        }
        while to_board.queue.is_empty()
            && let Some(bytes) = end.read()
        {
            to_board.add(bytes);
        }
        if let Some(socket) = &mut board {
            let mut bytes = [0; 4096];
            match socket.read(&mut bytes) {
                Ok(0) => board = None,
                Ok(length) => from_board.add(bytes.iter().take(length).copied()),
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                // The board has lost its power.
                Err(_) => board = None,
            }
        }
        let [sent, received] = [&mut to_board, &mut from_board].map(|way| way.arrived(state));
        state.bytes[0].fetch_add(sent.len() as u64, Ordering::Relaxed);
        state.bytes[1].fetch_add(received.len() as u64, Ordering::Relaxed);
        if state.is_pulled.load(Ordering::Relaxed) {
            continue;
        }
        if let Some(socket) = &mut board {
            // It does not end the line: the next read says that the board is gone.
            let _ = socket.write_all(&sent);
        }
        end.write(received);
    }
    Ok(())
}

/// One way through the line: each byte takes ten bits' time.
struct Way {
    queue: VecDeque<u8>,
    /// When the first byte of the queue began.
    since: Instant,
    byte: Duration,
    random: Rng,
}

impl Way {
    fn new(baud: u32, seed: u64) -> Self {
        Self {
            queue: VecDeque::new(),
            since: Instant::now(),
            byte: Duration::from_secs(10) / baud,
            random: Rng::with_seed(seed),
        }
    }

    fn add(&mut self, bytes: impl IntoIterator<Item = u8>) {
        if self.queue.is_empty() {
            self.since = Instant::now();
        }
        self.queue.extend(bytes);
    }

    /// The bytes that have arrived since the last time.
    fn arrived(&mut self, state: &State) -> Vec<u8> {
        let passed = self.since.elapsed().as_nanos() / self.byte.as_nanos();
        let count = self.queue.len().min(usize::try_from(passed).unwrap_or(usize::MAX));
        self.since += self.byte * count as u32;
        let noise = state.noise.load(Ordering::Relaxed);
        let random = &mut self.random;
        let disturbed = |byte| {
            if noise == 0 || random.u32(..noise) > 0 {
                return byte;
            }
            state.changed.fetch_add(1, Ordering::Relaxed);
            byte ^ 0x10
        };
        self.queue.drain(..count).map(disturbed).collect()
    }
}

fn encoded(packet: &[u8]) -> Vec<u8> {
    let escaped = packet.iter().flat_map(|byte| match *byte {
        END => vec![ESCAPE, ESCAPED_END],
        ESCAPE => vec![ESCAPE, ESCAPED_ESCAPE],
        other => vec![other],
    });
    std::iter::once(END).chain(escaped).chain([END]).collect()
}

/// A packet that has come in part.
#[derive(Default)]
struct Packet {
    bytes: Vec<u8>,
    is_escaped: bool,
}

impl Packet {
    /// The packet that this byte ends, if it may be one of IPv4: the device takes no other.
    fn push(&mut self, byte: u8) -> Option<Vec<u8>> {
        let is_escaped = std::mem::take(&mut self.is_escaped);
        match byte {
            END => {
                let whole = std::mem::take(&mut self.bytes);
                return Some(whole).filter(|packet| packet.first().is_some_and(|first| first >> 4 == 4));
            }
            ESCAPE => self.is_escaped = true,
            ESCAPED_END if is_escaped => self.bytes.push(END),
            ESCAPED_ESCAPE if is_escaped => self.bytes.push(ESCAPE),
            other => self.bytes.push(other),
        }
        None
    }
}
