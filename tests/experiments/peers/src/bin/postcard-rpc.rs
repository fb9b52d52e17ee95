//! postcard-rpc over TCP: it has no such transport, so each frame gets a length in front.

#![allow(unreachable_pub, reason = "define_dispatch makes a public type of these")]

use std::convert::Infallible;
use std::future::Future;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Result, anyhow};
use cara_bench_ends::{Caller, Delivery, Executed, Peer, Place, Server};
use cara_peers::{connect, listen, runtime};
use postcard_rpc::header::{VarHeader, VarKey, VarKeyKind, VarSeq, VarSeqKind};
use postcard_rpc::host_client::{self, HostClient};
use postcard_rpc::server::{self, AsWireRxErrorKind, AsWireTxErrorKind, Dispatch, WireRxErrorKind, WireTxErrorKind};
use postcard_rpc::standard_icd::{ERROR_PATH, LoggingTopic, WireError};
use postcard_rpc::{Topic, TopicDirection, define_dispatch, endpoints, topics};
use serde::Serialize;
use tokio::io::{AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::runtime::Runtime;
use tokio::sync::Mutex;

/// Longest frame.
const FRAME_BYTES: usize = 128 * 1_024;
/// What waits to be sent leaves only while the runtime works.
const FLUSH: Duration = Duration::from_millis(5);
/// Bytes of the length in front of each frame.
const PREFIX: usize = 4;

endpoints! {
    list = ENDPOINT_LIST;
    | EndpointTy    | RequestTy | ResponseTy | Path   |
    | ----------    | --------- | ---------- | ----   |
    | EchoEndpoint  | String    | String     | "echo" |
}

topics! {
    list = TOPICS_IN_LIST;
    direction = TopicDirection::ToServer;
    | TopicTy   | MessageTy | Path   |
    | -------   | --------- | ----   |
    | TakeTopic | String    | "take" |
}

topics! {
    list = TOPICS_OUT_LIST;
    direction = TopicDirection::ToClient;
    | TopicTy | MessageTy | Path |
    | ------- | --------- | ---- |
}

/// What the handlers are given.
pub struct Context(Arc<Executed>);

fn echo(_: &mut Context, _: VarHeader, text: String) -> String {
    text
}

fn take(context: &mut Context, _: VarHeader, _: String, _: &server::Sender<Outgoing>) {
    context.0.note();
}

#[expect(dead_code, reason = "define_dispatch wants one; no handler of ours is spawned")]
fn spawn<Sp>(_: &Sp, future: impl Future<Output = ()> + Send + 'static) -> Result<(), Infallible> {
    tokio::spawn(future);
    Ok(())
}

define_dispatch! {
    app: App;
    spawn_fn: spawn;
    tx_impl: Outgoing;
    spawn_impl: Spawn;
    context: Context;

    endpoints: {
        list: ENDPOINT_LIST;

        | EndpointTy    | kind      | handler |
        | ----------    | ----      | ------- |
        | EchoEndpoint  | blocking  | echo    |
    };
    topics_in: {
        list: TOPICS_IN_LIST;

        | TopicTy       | kind      | handler |
        | -------       | ----      | ------- |
        | TakeTopic     | blocking  | take    |
    };
    topics_out: {
        list: TOPICS_OUT_LIST;
    };
}

/// Spawns on the runtime of the thread.
#[derive(Clone)]
pub struct Spawn;

impl server::WireSpawn for Spawn {
    type Error = Infallible;
    type Info = ();

    fn info(&self) -> &() {
        &()
    }
}

impl host_client::WireSpawn for Spawn {
    fn spawn(&mut self, future: impl Future<Output = ()> + Send + 'static) {
        tokio::spawn(future);
    }
}

/// Why a frame did not come or go.
#[derive(Debug)]
pub struct Broken(io::Error);

impl std::fmt::Display for Broken {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

impl std::error::Error for Broken {}

impl AsWireTxErrorKind for Broken {
    fn as_kind(&self) -> WireTxErrorKind {
        WireTxErrorKind::ConnectionClosed
    }
}

impl AsWireRxErrorKind for Broken {
    fn as_kind(&self) -> WireRxErrorKind {
        WireRxErrorKind::ConnectionClosed
    }
}

/// The sending half; each frame is one write.
#[derive(Clone)]
pub struct Outgoing(Arc<Mutex<OwnedWriteHalf>>);

impl Outgoing {
    async fn write(&self, frame: &[u8]) -> Result<(), Broken> {
        let length = u32::try_from(frame.len()).unwrap_or(u32::MAX).to_le_bytes();
        self.0.lock().await.write_all(&[&length, frame].concat()).await.map_err(Broken)
    }
}

impl server::WireTx for Outgoing {
    type Error = Broken;

    async fn send<T: Serialize + ?Sized>(&self, header: VarHeader, message: &T) -> Result<(), Broken> {
        let mut frame = vec![0; PREFIX];
        frame.extend(header.write_to_vec());
        let mut frame = postcard::to_extend(message, frame).map_err(|error| Broken(io::Error::other(error)))?;
        let length = u32::try_from(frame.len() - PREFIX).unwrap_or(u32::MAX).to_le_bytes();
        frame[..PREFIX].copy_from_slice(&length);
        self.0.lock().await.write_all(&frame).await.map_err(Broken)
    }

    async fn send_raw(&self, frame: &[u8]) -> Result<(), Broken> {
        self.write(frame).await
    }

    async fn send_log_str(&self, _: VarKeyKind, text: &str) -> Result<(), Broken> {
        let header = VarHeader { key: VarKey::Key8(LoggingTopic::TOPIC_KEY), seq_no: VarSeq::Seq4(0) };
        self.send(header, text).await
    }

    async fn send_log_fmt<'a>(&self, kind: VarKeyKind, text: std::fmt::Arguments<'a>) -> Result<(), Broken> {
        self.send_log_str(kind, &text.to_string()).await
    }
}

impl host_client::WireTx for Outgoing {
    type Error = Broken;

    async fn send(&mut self, frame: Vec<u8>) -> Result<(), Broken> {
        self.write(&frame).await
    }
}

/// The receiving half.
struct Incoming(BufReader<OwnedReadHalf>);

impl Incoming {
    fn new(half: OwnedReadHalf) -> Self {
        Self(BufReader::with_capacity(FRAME_BYTES, half))
    }

    async fn length(&mut self) -> io::Result<usize> {
        let length = self.0.read_u32_le().await? as usize;
        if length > FRAME_BYTES { Err(io::Error::other("a frame is too long")) } else { Ok(length) }
    }
}

impl server::WireRx for Incoming {
    type Error = Broken;

    async fn receive<'a>(&mut self, buffer: &'a mut [u8]) -> Result<&'a mut [u8], Broken> {
        let length = self.length().await.map_err(Broken)?;
        let frame = &mut buffer[..length];
        self.0.read_exact(frame).await.map_err(Broken)?;
        Ok(frame)
    }
}

impl host_client::WireRx for Incoming {
    type Error = Broken;

    async fn receive(&mut self) -> Result<Vec<u8>, Broken> {
        let mut frame = vec![0; self.length().await.map_err(Broken)?];
        self.0.read_exact(&mut frame).await.map_err(Broken)?;
        Ok(frame)
    }
}

struct PostcardRpc;

impl Peer for PostcardRpc {
    fn start_server(&self, _: &Place) -> Result<Server> {
        let executed = Arc::new(Executed::default());
        let counted = executed.clone();
        let address = listen(move |stream| {
            let (incoming, outgoing) = stream.into_split();
            let app = App::new(Context(counted.clone()), Spawn);
            let keys = app.min_key_len();
            let outgoing = Outgoing(Arc::new(Mutex::new(outgoing)));
            let buffer = vec![0; FRAME_BYTES];
            let mut server = server::Server::new(outgoing, Incoming::new(incoming), buffer, app, keys);
            async move { drop(server.run().await) }
        })?;
        Ok(Server::new(address, executed, ()))
    }

    fn connect(&self, _: &Place, address: &str) -> Result<Box<dyn Caller>> {
        let runtime = runtime()?;
        let client = runtime.block_on(async {
            let (incoming, outgoing) = connect(address).await?.into_split();
            let outgoing = Outgoing(Arc::new(Mutex::new(outgoing)));
            let incoming = Incoming::new(incoming);
            anyhow::Ok(HostClient::new_with_wire(outgoing, incoming, Spawn, VarSeqKind::Seq2, ERROR_PATH, 64))
        })?;
        Ok(Box::new(Calls { runtime, client, sent: 0 }))
    }
}

struct Calls {
    runtime: Runtime,
    client: HostClient<WireError>,
    sent: u16,
}

impl Caller for Calls {
    fn echo(&mut self, text: &str) -> Result<usize> {
        let answer = self.runtime.block_on(self.client.send_resp::<EchoEndpoint>(&text.to_owned()));
        Ok(answer.map_err(|error| anyhow!("{error:?}"))?.len())
    }

    fn send(&mut self, text: &str, _: Delivery) -> Result<(), String> {
        self.sent = self.sent.wrapping_add(1);
        let text = text.to_owned();
        let sent = self.client.publish::<TakeTopic>(VarSeq::Seq2(self.sent), &text);
        self.runtime.block_on(sent).map_err(|error| format!("{error:?}"))
    }

    fn flush(&mut self) {
        self.runtime.block_on(async { tokio::time::sleep(FLUSH).await });
    }
}

fn main() -> Result<()> {
    cara_bench_ends::main(&PostcardRpc)
}
