//! A connection through user space, over loopback: what the network between two units does to a stream.
//!
//! A unit that dials the relay reaches the manager behind it. Datagrams do not pass here.

use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use socket2::{Domain, SockRef, Socket, Type};

/// How often a pump looks whether it may go on.
const LOOK: Duration = Duration::from_millis(5);
/// Bytes that the kernel keeps of what the relay does not read: no more than a small board would.
const KERNEL_BYTES: usize = 4 * 1024;

/// Which way something goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Way {
    /// From the manager to the dialling end.
    Down,
    /// From the dialling end to the manager.
    Up,
}

/// Takes connections and passes on what they carry.
pub(super) struct Relay {
    address: SocketAddr,
    shared: Arc<Shared>,
}

#[derive(Default)]
struct Shared {
    over: AtomicBool,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// Nothing passes until then, down and up.
    frozen: [Option<Instant>; 2],
    /// Bytes a second, down and up; `None` for as fast as it goes.
    pace: [Option<usize>; 2],
    streams: Vec<TcpStream>,
}

impl Relay {
    /// A relay to a manager on this machine.
    pub(super) fn to(port: u16) -> Self {
        let socket = small_socket();
        socket.bind(&SocketAddr::from((Ipv4Addr::LOCALHOST, 0)).into()).expect("a port of its own");
        socket.listen(16).expect("it can listen");
        let listener = TcpListener::from(socket);
        let address = listener.local_addr().expect("it is bound");
        let shared = Arc::<Shared>::default();
        let accepting = Arc::clone(&shared);
        thread::spawn(move || {
            for stream in listener.incoming().map_while(Result::ok) {
                if accepting.is_over() {
                    return;
                }
                accepting.connect(&stream, port);
            }
        });
        Self { address, shared }
    }

    /// Where to dial.
    pub(super) const fn address(&self) -> SocketAddr {
        self.address
    }

    /// Nothing passes this way for so long; what is sent meanwhile arrives after that.
    pub(super) fn freeze(&self, way: Way, span: Duration) {
        self.shared.lock().frozen[way as usize] = Some(Instant::now() + span);
    }

    /// At most so many bytes a second pass this way.
    pub(super) fn slow_down(&self, way: Way, bytes_per_second: usize) {
        self.shared.lock().pace[way as usize] = Some(bytes_per_second);
    }

    /// Resets every stream, at both ends.
    pub(super) fn reset(&self) {
        for stream in self.shared.lock().streams.drain(..) {
            let _ = SockRef::from(&stream).set_linger(Some(Duration::ZERO));
            // The pumps have descriptors of their own: the reset goes out with the last of them.
            let _ = stream.shutdown(Shutdown::Read);
        }
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::SeqCst);
        self.reset();
        // Wakes the accepting thread.
        drop(TcpStream::connect(self.address));
    }
}

fn small_socket() -> Socket {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, None).expect("a socket");
    socket.set_recv_buffer_size(KERNEL_BYTES).expect("a size that the kernel rounds");
    socket
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn is_over(&self) -> bool {
        self.over.load(Ordering::SeqCst)
    }

    fn connect(self: &Arc<Self>, near: &TcpStream, port: u16) {
        let far = small_socket();
        if far.connect(&SocketAddr::from((Ipv4Addr::LOCALHOST, port)).into()).is_err() {
            return;
        }
        let far = TcpStream::from(far);
        for stream in [near, &far] {
            let _ = stream.set_nodelay(true);
            let _ = stream.set_read_timeout(Some(LOOK));
            self.lock().streams.extend(stream.try_clone());
        }
        for (way, from, to) in [(Way::Down, &far, near), (Way::Up, near, &far)] {
            let (Ok(from), Ok(to)) = (from.try_clone(), to.try_clone()) else { return };
            let shared = Arc::clone(self);
            thread::spawn(move || shared.pump(way, from, to));
        }
    }

    /// How many bytes may pass now.
    fn allowed(&self, way: Way) -> usize {
        let state = self.lock();
        match (state.frozen[way as usize], state.pace[way as usize]) {
            (Some(until), _) if Instant::now() < until => 0,
            (_, pace) => pace.unwrap_or(usize::MAX),
        }
    }

    fn pump(&self, way: Way, mut from: TcpStream, mut to: TcpStream) {
        let mut buffer = [0; 4096];
        while !self.is_over() {
            let allowed = self.allowed(way);
            if allowed == 0 {
                thread::sleep(LOOK);
                continue;
            }
            let room = allowed.min(buffer.len());
            match from.read(&mut buffer[..room]) {
                Ok(count) if count > 0 => {
                    // What was read while it froze waits for the thaw.
                    while self.allowed(way) == 0 && !self.is_over() {
                        thread::sleep(LOOK);
                    }
                    if to.write_all(&buffer[..count]).is_err() {
                        break;
                    }
                    if allowed < usize::MAX {
                        thread::sleep(Duration::from_secs_f64(count as f64 / allowed as f64));
                    }
                }
                Err(error)
                    if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => {
                }
                _ => break,
            }
        }
        // Of a stream that is to be reset the last descriptor goes without a farewell.
        if SockRef::from(&to).linger().ok().flatten().is_none() {
            let _ = to.shutdown(Shutdown::Write);
        }
    }
}
