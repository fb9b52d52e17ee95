//! What the peers that stand on tokio share: one thread for each end, and calls that wait.
//!
//! One thread is the setting that serves them best here: no call crosses from one of tokio's threads to another.

#![cfg(any(feature = "ergot", feature = "postcard-rpc", feature = "tarpc"))]

use std::future::Future;
use std::net::SocketAddr;
use std::thread;

use anyhow::{Context, Result};
use tokio::net::{TcpListener, TcpStream};
use tokio::runtime::{Builder, Runtime};
use tokio::task;

/// A runtime that works in the thread that waits for it.
pub fn runtime() -> Result<Runtime> {
    Builder::new_current_thread().enable_all().build().context("tokio's runtime")
}

/// Accepts connections in a thread of its own, and does `serve` with each; returns the address.
pub fn listen<F>(serve: impl Fn(TcpStream) -> F + Send + 'static) -> Result<String>
where
    F: Future<Output = ()> + 'static,
{
    let runtime = runtime()?;
    let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0"))?;
    let address = listener.local_addr()?.to_string();
    thread::spawn(move || {
        task::LocalSet::new().block_on(&runtime, async {
            while let Ok((stream, _)) = listener.accept().await {
                if stream.set_nodelay(true).is_ok() {
                    task::spawn_local(serve(stream));
                }
            }
        });
    });
    Ok(address)
}

/// A connection without Nagle.
pub async fn connect(address: &str) -> Result<TcpStream> {
    let stream = TcpStream::connect(address.parse::<SocketAddr>()?).await?;
    stream.set_nodelay(true)?;
    Ok(stream)
}
