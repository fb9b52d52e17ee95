//! tarpc over TCP with bincode.

use anyhow::Result;
use cara_bench_ends::{Caller, Delivery, Executed, Peer, Place, Server};
use cara_peers::{connect, listen, runtime};
use futures::StreamExt;
use std::sync::Arc;
use tarpc::serde_transport::Transport;
use tarpc::server::{BaseChannel, Channel};
use tarpc::tokio_serde::formats::Bincode;
use tarpc::{client, context};
use tokio::runtime::Runtime;

#[tarpc::service]
trait Echo {
    async fn echo(text: String) -> String;
}

#[derive(Clone)]
struct Echoes;

impl Echo for Echoes {
    async fn echo(self, _: context::Context, text: String) -> String {
        text
    }
}

struct Tarpc;

impl Peer for Tarpc {
    fn start_server(&self, _: &Place) -> Result<Server> {
        let address = listen(|stream| async move {
            let channel = BaseChannel::with_defaults(Transport::from((stream, Bincode::default())));
            let requests = channel.execute(Echoes.serve());
            requests.for_each(|answer| async move { drop(tokio::spawn(answer)) }).await;
        })?;
        Ok(Server::new(address, Arc::new(Executed::default()), ()))
    }

    fn connect(&self, _: &Place, address: &str) -> Result<Box<dyn Caller>> {
        let runtime = runtime()?;
        let client = runtime.block_on(async {
            let transport = Transport::from((connect(address).await?, Bincode::default()));
            anyhow::Ok(EchoClient::new(client::Config::default(), transport).spawn())
        })?;
        Ok(Box::new(Calls { runtime, client }))
    }
}

struct Calls {
    runtime: Runtime,
    client: EchoClient,
}

impl Caller for Calls {
    fn echo(&mut self, text: &str) -> Result<usize> {
        Ok(self.runtime.block_on(self.client.echo(context::current(), text.to_owned()))?.len())
    }

    fn send(&mut self, _: &str, _: Delivery) -> Result<(), String> {
        Err("tarpc has no messages without an answer".into())
    }
}

fn main() -> Result<()> {
    cara_bench_ends::main(&Tarpc)
}
