//! Raw sockets in the place of nodes: how much more a message costs that goes to each of many in turn instead of to
//! one, without anything of CARA. What the caches of the machine and the kernel's tables make of it.

use std::io::{Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::time::Instant;

use anyhow::{Context, Result};
use cara_std::sys::epoll::{Epoll, Events, Interest};
use cara_std::sys::limits;
use serde_json::json;

use crate::child::{self, Block, Question};
use crate::proc;

/// As long as a request with one int and its reply.
const MESSAGE: [u8; 48] = [7; 48];

/// The process that sends back whatever comes on any of its connections, in one thread.
pub(crate) fn serve(port: u16, count: usize) -> Result<()> {
    limits::make_room_for(count);
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port))?;
    std::thread::spawn(move || echo(&listener, count));
    child::serve(|question| anyhow::bail!("a floor does not answer {question:?}"))
}

fn echo(listener: &TcpListener, count: usize) -> Result<()> {
    let epoll = Epoll::new()?;
    let mut streams = Vec::new();
    for token in 0..count {
        let (stream, _) = listener.accept()?;
        stream.set_nodelay(true)?;
        epoll.add(&stream, token as u64, Interest::READ_LEVEL)?;
        streams.push(stream);
    }
    let (mut events, mut buffer) = (Events::new(1), [0; MESSAGE.len()]);
    loop {
        epoll.wait(&mut events, None)?;
        for ready in events.iter() {
            let mut stream = streams.get(ready.token as usize).context("no such stream")?;
            stream.read_exact(&mut buffer)?;
            stream.write_all(&buffer)?;
        }
    }
}

/// The process that sends.
pub(crate) fn call(port: u16, count: usize) -> Result<()> {
    limits::make_room_for(count);
    let connect = || -> Result<TcpStream> {
        let stream = TcpStream::connect((Ipv4Addr::LOCALHOST, port))?;
        stream.set_nodelay(true)?;
        Ok(stream)
    };
    let mut streams = (0..count).map(|_| connect()).collect::<Result<Vec<_>>>()?;
    child::serve(|question| match question {
        Question::Block { node, calls } => {
            let chosen = if node.is_some() { 1 } else { streams.len() };
            Ok(json!(block(streams.get_mut(..chosen).unwrap_or_default(), calls)?))
        }
        question => anyhow::bail!("a floor does not answer {question:?}"),
    })
}

fn block(streams: &mut [TcpStream], calls: usize) -> Result<Block> {
    let mut buffer = [0; MESSAGE.len()];
    let mut round_trips = Vec::with_capacity(calls);
    let cpu = proc::own_cpu_time()?;
    for index in (0..streams.len()).cycle().take(calls) {
        let stream = streams.get_mut(index).context("no stream")?;
        let began = Instant::now();
        stream.write_all(&MESSAGE)?;
        stream.read_exact(&mut buffer)?;
        round_trips.push(began.elapsed().as_nanos() as u64);
    }
    Ok(Block::new(round_trips, proc::own_cpu_time()?.saturating_sub(cpu)))
}
