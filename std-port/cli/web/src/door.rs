//! Connections of browsers: so many at a time, with TLS where that is asked for, closed when nothing travels on them.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use axum::serve::Listener;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::time::{Instant, Sleep, sleep, timeout};
use tokio_rustls::TlsAcceptor;

use crate::limits::{CONNECTIONS, Limits, Place};

/// A connection on which nothing travels for so long is closed.
const IDLE: Duration = Duration::from_secs(60);
/// How long TLS may take to begin.
const HANDSHAKE: Duration = Duration::from_secs(5);

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
        tokio::spawn(take(listener, tls, limits, to));
        Ok(Self { ready, address })
    }
}

/// One that is slow with its handshake keeps no other one out.
async fn take(
    mut listener: TcpListener,
    tls: Option<TlsAcceptor>,
    limits: Arc<Limits>,
    to: mpsc::Sender<(Connection, SocketAddr)>,
) {
    let free = Arc::new(Semaphore::new(CONNECTIONS));
    // The semaphore is never closed.
    while let Ok(place) = free.clone().acquire_owned().await {
        let (stream, address) = Listener::accept(&mut listener).await;
        let shown = Place::take(&limits, |limits| &limits.connections);
        let (tls, limits, to) = (tls.clone(), limits.clone(), to.clone());
        tokio::spawn(async move {
            let stream: Box<dyn Duplex> = match tls {
                None => Box::new(stream),
                Some(tls) => match secured(&tls, stream).await {
                    Some(stream) => stream,
                    None => return limits.connections.refuse(),
                },
            };
            let idle = Box::pin(sleep(IDLE));
            // Fails once nothing is served any more.
            let _ = to.send((Connection { stream, idle, _shown: shown, _place: place }, address)).await;
        });
    }
}

async fn secured(tls: &TlsAcceptor, stream: TcpStream) -> Option<Box<dyn Duplex>> {
    let stream = timeout(HANDSHAKE, tls.accept(stream)).await.ok()?.ok()?;
    Some(Box::new(stream))
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
    idle: Pin<Box<Sleep>>,
    /// As the page shows it; given back before the place is.
    _shown: Option<Place>,
    _place: OwnedSemaphorePermit,
}

impl Connection {
    fn travelled(&mut self) {
        self.idle.as_mut().reset(Instant::now() + IDLE);
    }
}

impl AsyncRead for Connection {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let read = Pin::new(&mut self.stream).poll_read(cx, buffer);
        if read.is_ready() {
            self.travelled();
            return read;
        }
        self.idle.as_mut().poll(cx).map(|()| Err(io::ErrorKind::TimedOut.into()))
    }
}

impl AsyncWrite for Connection {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = Pin::new(&mut self.stream).poll_write(cx, bytes);
        if written.is_ready() {
            self.travelled();
        }
        written
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}
