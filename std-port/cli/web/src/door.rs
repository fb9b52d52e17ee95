//! Connections of browsers, with TLS where that is asked for. Each phase of a request has a deadline, which no byte extends.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::time::{Instant, Sleep, sleep, timeout};
use tokio_rustls::TlsAcceptor;

use crate::limits::Limits;
use crate::lines::{Entry, HEAD, Line, Lines};

/// How long TLS may take to begin.
const HANDSHAKE: Duration = Duration::from_secs(5);
/// A browser that takes nothing of what waits for it is given up after so long.
const TAKES: Duration = Duration::from_secs(10);
/// Before the next attempt, where the system has no file for another connection.
const RETRY: Duration = Duration::from_millis(20);

/// A listener whose connections are ready for HTTP.
pub(crate) struct Door {
    ready: mpsc::Receiver<(Connection, SocketAddr)>,
    address: SocketAddr,
}

impl Door {
    /// Takes connections from here on.
    pub(crate) fn open(listener: TcpListener, tls: Option<TlsAcceptor>, limits: Arc<Limits>) -> io::Result<Self> {
        let address = listener.local_addr()?;
        let (to, ready) = mpsc::channel(1);
        tokio::spawn(take(listener, tls, Lines::new(limits), to));
        Ok(Self { ready, address })
    }
}

/// Takes whatever comes, and waits for no handshake and no place: the next one may be a stop.
async fn take(
    listener: TcpListener,
    tls: Option<TlsAcceptor>,
    lines: Arc<Lines>,
    to: mpsc::Sender<(Connection, SocketAddr)>,
) {
    loop {
        let Ok((stream, address)) = listener.accept().await else {
            lines.one_gives_way();
            sleep(RETRY).await;
            continue;
        };
        let Some(entry) = lines.enter(address.ip()) else { continue };
        let (tls, to) = (tls.clone(), to.clone());
        tokio::spawn(async move {
            let stream: Box<dyn Duplex> = match tls {
                None => Box::new(stream),
                Some(tls) => match secured(&tls, stream, &entry.line).await {
                    Some(stream) => stream,
                    None => return entry.limits().handshakes.refuse(),
                },
            };
            entry.line.begins();
            let timer = || Box::pin(sleep(HEAD));
            let connection = Connection { stream, entry, reads: timer(), writes: timer(), is_blocked: false };
            // Fails once nothing is served any more.
            let _ = to.send((connection, address)).await;
        });
    }
}

async fn secured(tls: &TlsAcceptor, stream: TcpStream, line: &Line) -> Option<Box<dyn Duplex>> {
    let gives_way = std::future::poll_fn(|cx| if line.gives_way(cx) { Poll::Ready(()) } else { Poll::Pending });
    tokio::select! {
        stream = timeout(HANDSHAKE, tls.accept(stream)) => Some(Box::new(stream.ok()?.ok()?)),
        () = gives_way => None,
    }
}

impl Listener for Door {
    type Io = Connection;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Connection, SocketAddr) {
        match self.ready.recv().await {
            Some(ready) => ready,
            // The runtime is ending.
            None => std::future::pending().await,
        }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        Ok(self.address)
    }
}

/// What can be read from and written to.
trait Duplex: AsyncRead + AsyncWrite + Send + Unpin {}

impl<S: AsyncRead + AsyncWrite + Send + Unpin> Duplex for S {}

/// A connection that has a place.
pub(crate) struct Connection {
    stream: Box<dyn Duplex>,
    entry: Entry,
    reads: Pin<Box<Sleep>>,
    writes: Pin<Box<Sleep>>,
    /// What is to be written waits for the browser, until `writes` at most.
    is_blocked: bool,
}

impl Connection {
    pub(crate) fn line(&self) -> Arc<Line> {
        self.entry.line.clone()
    }

    /// An error once it has to end: for another connection, or since its phase has taken too long.
    fn continues(&mut self, cx: &mut Context<'_>) -> io::Result<()> {
        if self.entry.line.gives_way(cx) {
            return Err(io::ErrorKind::ConnectionAborted.into());
        }
        let Some((deadline, counted)) = self.entry.line.deadline() else { return Ok(()) };
        // An answer that waits for its browser is no idle connection: `writes` has the time of that.
        if counted.is_none() && self.is_blocked {
            return Ok(());
        }
        if self.reads.deadline() != deadline {
            self.reads.as_mut().reset(deadline);
        }
        if self.reads.as_mut().poll(cx).is_pending() {
            return Ok(());
        }
        counted.into_iter().for_each(|counted| counted(self.entry.limits()).refuse());
        Err(io::ErrorKind::TimedOut.into())
    }

    /// Passes on what became of writing, and gives up where the browser takes nothing for too long.
    fn taken<T>(&mut self, cx: &mut Context<'_>, written: Poll<io::Result<T>>) -> Poll<io::Result<T>> {
        self.continues(cx)?;
        if written.is_ready() {
            self.is_blocked = false;
            return written;
        }
        if !self.is_blocked {
            self.is_blocked = true;
            self.writes.as_mut().reset(Instant::now() + TAKES);
        }
        ready!(self.writes.as_mut().poll(cx));
        self.entry.limits().takes.refuse();
        Poll::Ready(Err(io::ErrorKind::TimedOut.into()))
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.continues(cx)?;
        let before = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(cx, buffer);
        if buffer.filled().len() > before {
            self.entry.line.heard();
        }
        read
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, bytes);
        self.taken(cx, written)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let flushed = Pin::new(&mut self.stream).poll_flush(cx);
        self.taken(cx, flushed)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let closed = Pin::new(&mut self.stream).poll_shutdown(cx);
        self.taken(cx, closed)
    }
}
