//! The board of an unknown client: it has sockets of its own and no unit.

use std::cell::{Cell, RefCell};
use std::net::Ipv4Addr;
use std::rc::Rc;

use cara_core::config::PLAIN_PORT;
use cara_core::time::Duration;
use cara_embassy_host::{Bench, Board};
use embassy_net::Stack;
use embassy_net::tcp::TcpSocket;
use embassy_net::udp::{PacketMetadata, UdpSocket};
use embassy_time::with_timeout;

use crate::unknown_client::Visit;

/// How long it listens to what comes back.
const ANSWER: Duration = Duration::from_secs(5);
/// How long it says something on which it hangs up.
const SHORT: Duration = Duration::from_millis(200);
/// As many connections as its stack has sockets for.
const MOST: usize = 100;
/// Bytes of each buffer of a socket.
const ROOM: usize = 2_048;

pub(super) struct Visitor {
    board: Board,
    host: Ipv4Addr,
}

impl Visitor {
    pub(super) fn new(bench: &Bench, host: Ipv4Addr) -> Self {
        let board = bench.board();
        let stack = board.stack();
        assert!(bench.run_until(|| stack.is_link_up(), ANSWER), "its cable is plugged in");
        Self { board, host }
    }

    /// Sends datagrams to the discovery port.
    pub(super) fn sends(&self, datagrams: Vec<Vec<u8>>) {
        let (stack, to) = (self.board.stack(), (self.host, PLAIN_PORT));
        self.board.spawn(async move {
            let meta = || -> &'static mut [PacketMetadata] { Box::leak(Box::new([PacketMetadata::EMPTY; 4])) };
            let mut socket = UdpSocket::new(stack, meta(), room(), meta(), room());
            socket.bind(PLAIN_PORT).expect("the port is free");
            for datagram in datagrams {
                socket.send_to(&datagram, to).await.expect("it has a network");
            }
            socket.flush().await;
        });
    }

    /// Connects, speaks, and hangs up or listens; what it heard.
    pub(super) fn pays(&self, bench: &Bench, visit: Visit) -> Vec<u8> {
        let (stack, to) = (self.board.stack(), (self.host, PLAIN_PORT));
        let (heard, over) = (Rc::new(RefCell::new(Vec::new())), Rc::new(Cell::new(false)));
        let (recorded, ended) = (Rc::clone(&heard), Rc::clone(&over));
        self.board.spawn(async move {
            let mut socket = connection(stack, to).await;
            // The unit may close the connection while garbage is still being written.
            let mut says = &visit.says[..];
            while let Ok(count @ 1..) = socket.write(says).await {
                says = &says[count..];
                if says.is_empty() {
                    break;
                }
            }
            let listens = if visit.closes { SHORT } else { ANSWER };
            let listening = async {
                let mut bytes = [0; 512];
                while let Ok(count @ 1..) = socket.read(&mut bytes).await {
                    recorded.borrow_mut().extend_from_slice(&bytes[..count]);
                }
            };
            let _ = with_timeout(embassy_time::Duration::from_micros(listens.as_micros()), listening).await;
            socket.close();
            let _ = socket.flush().await;
            ended.set(true);
        });
        assert!(bench.run_until(|| over.get(), Duration::from_secs(60)), "a visit ends");
        if visit.closes { Vec::new() } else { heard.take() }
    }

    /// Opens connections and says nothing on them.
    pub(super) fn stays(&self, connections: usize) {
        let (stack, to) = (self.board.stack(), (self.host, PLAIN_PORT));
        for _ in 0..connections.min(MOST) {
            self.board.spawn(async move {
                let _held = connection(stack, to).await;
                std::future::pending::<()>().await;
            });
        }
    }
}

fn room() -> &'static mut [u8] {
    Box::leak(Box::new([0; ROOM]))
}

/// An open connection; one that is refused is as silent.
async fn connection(stack: Stack<'static>, to: (Ipv4Addr, u16)) -> TcpSocket<'static> {
    let mut socket = TcpSocket::new(stack, room(), room());
    let _ = socket.connect(to).await;
    socket
}
