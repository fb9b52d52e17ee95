//! ergot over TCP: the service is the edge that a device would be, the caller the router that its host would be.

use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Result, anyhow, ensure};
use cara_bench_ends::{Caller, Delivery, Executed, Peer, Place, Server};
use cara_peers::{connect, listen, runtime};
use ergot::toolkits::tokio_tcp::{
    RouterStack, new_std_queue, new_target_stack, register_edge_interface, register_router_interface,
};
use ergot::{Address, endpoint, topic};
use tokio::runtime::Runtime;

endpoint!(EchoEndpoint, String, String, "echo");
topic!(TakeTopic, String, "take");

/// Longest packet; a length in ergot has 16 bits.
const PACKET_BYTES: u16 = u16::MAX;
/// Longest text: a packet without its headers and what COBS adds.
const TEXT_BYTES: usize = 60_000;
/// Packets that wait to be sent.
const QUEUE_BYTES: usize = 1 << 20;
/// What waits to be sent leaves only while the runtime works.
const FLUSH: Duration = Duration::from_millis(5);
/// Requests and messages that wait for their service.
const WAITING: usize = 4_096;

struct Ergot;

impl Peer for Ergot {
    fn start_server(&self, _: &Place) -> Result<Server> {
        let executed = Arc::new(Executed::default());
        let counted = executed.clone();
        let address = listen(move |stream| {
            let counted = counted.clone();
            async move {
                let queue = new_std_queue(QUEUE_BYTES);
                let stack = new_target_stack(&queue, PACKET_BYTES);
                if register_edge_interface(&stack, stream, &queue).await.is_err() {
                    return;
                }
                let echo = pin!(stack.endpoints().heap_bounded_server::<EchoEndpoint>(WAITING, None));
                let take = pin!(stack.topics().heap_bounded_receiver::<TakeTopic>(WAITING, None));
                let (mut echo, mut take) = (echo.attach(), take.subscribe());
                let answer = async { while echo.serve(async |text: &String| text.clone()).await.is_ok() {} };
                let count = async {
                    loop {
                        take.recv().await;
                        counted.note();
                    }
                };
                tokio::select! {
                    () = answer => {}
                    () = count => {}
                }
            }
        })?;
        Ok(Server::new(address, executed, ()))
    }

    fn connect(&self, _: &Place, address: &str) -> Result<Box<dyn Caller>> {
        let runtime = runtime()?;
        let stack = RouterStack::new();
        runtime.block_on(async {
            let stream = connect(address).await?;
            register_router_interface(&stack, stream, PACKET_BYTES, QUEUE_BYTES)
                .await
                .map_err(|error| anyhow!("ergot: {error:?}"))
        })?;
        Ok(Box::new(Calls { runtime, stack }))
    }
}

struct Calls {
    runtime: Runtime,
    stack: RouterStack,
}

/// The only edge of a router's only interface, whichever of its sockets takes the message.
const SERVICE: Address = Address { network_id: 1, node_id: 2, port_id: 0 };

impl Caller for Calls {
    fn echo(&mut self, text: &str) -> Result<usize> {
        ensure!(text.len() <= TEXT_BYTES, "a packet of ergot holds at most {TEXT_BYTES} characters");
        let text = text.to_owned();
        let request = self.stack.endpoints().request::<EchoEndpoint>(SERVICE, &text, None);
        let answer = self.runtime.block_on(request).map_err(|error| anyhow!("ergot: {error:?}"))?;
        Ok(answer.len())
    }

    fn send(&mut self, text: &str, _: Delivery) -> Result<(), String> {
        let sent = self.stack.topics().broadcast::<TakeTopic>(&text.to_owned(), None);
        // What was sent leaves, and the queue has room again, only while the runtime works.
        self.runtime.block_on(tokio::task::yield_now());
        sent.map_err(|error| format!("{error:?}"))
    }

    fn flush(&mut self) {
        self.runtime.block_on(async { tokio::time::sleep(FLUSH).await });
    }
}

fn main() -> Result<()> {
    cara_bench_ends::main(&Ergot)
}
