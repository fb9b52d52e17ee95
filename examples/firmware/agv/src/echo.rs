//! A bare TCP echo: what a board, embassy and the network cost without CARA.

use embassy_net::Stack;
use embassy_net::tcp::TcpSocket;
use embassy_time::Duration;
use embedded_io_async::Write;

const PORT: u16 = 7777;
const BUFFER: usize = 2048;
const SILENCE: Duration = Duration::from_secs(10);

/// Its memory.
pub struct Buffers {
    receive: [u8; BUFFER],
    send: [u8; BUFFER],
    piece: [u8; BUFFER],
}

impl Buffers {
    /// Empty.
    pub const fn new() -> Self {
        Self { receive: [0; BUFFER], send: [0; BUFFER], piece: [0; BUFFER] }
    }
}

impl Default for Buffers {
    fn default() -> Self {
        Self::new()
    }
}

/// The network of a board that is not provisioned.
pub fn dhcp() -> embassy_net::Config {
    embassy_net::Config::dhcpv4(Default::default())
}

/// Returns what it is sent on port 7777, to one caller at a time.
pub async fn run(stack: Stack<'static>, buffers: &'static mut Buffers) -> ! {
    let Buffers { receive, send, piece } = buffers;
    let mut socket = TcpSocket::new(stack, receive, send);
    socket.set_nagle_enabled(false);
    loop {
        socket.set_timeout(Some(SILENCE));
        if socket.accept(PORT).await.is_ok() {
            serve(&mut socket, piece).await;
            socket.close();
            let _ = socket.flush().await;
        }
        socket.abort();
        let _ = socket.flush().await;
    }
}

async fn serve(socket: &mut TcpSocket<'_>, piece: &mut [u8]) {
    while let Ok(length @ 1..) = socket.read(piece).await {
        let Some(received) = piece.get(..length) else { return };
        if socket.write_all(received).await.is_err() {
            return;
        }
    }
}
