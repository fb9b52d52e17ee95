//! The processes of one peer at one place: server, client and, in distribution 2, the further nodes.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use cara_bench_ends::{
    Burst, ClientQuestion, Counters, End, Limits, Offered, Order, Outcome, Pin, Place, ServerQuestion, pin,
};
use cara_processes::cable::{Cable, Wire};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::child::Handle;
use crate::peers::Contender;
use crate::statistics::Turn;

/// The further nodes are left alone for so long before anything is measured, so that all of them are under way.
const UNDER_WAY: Duration = Duration::from_millis(20);
/// A message that was neither executed nor reported for so long is lost. Longer than a request may take.
const QUIET: Duration = Duration::from_secs(4);

/// Where a pair is measured, and beside which others.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Setting {
    pub(crate) pin: Pin,
    /// The paper's node distribution, 1 or 2.
    pub(crate) distribution: u8,
    /// The service prints what it gets.
    pub(crate) print: bool,
    /// The pair has such a cable to itself; `None` for loopback.
    pub(crate) wire: Option<Wire>,
}

impl Setting {
    /// The rate of the cable; 0 for loopback.
    pub(crate) fn mbit(&self) -> u32 {
        self.wire.map_or(0, |wire| wire.mbit)
    }
}

/// One peer's processes.
pub(crate) struct Pair {
    peer: String,
    server: Handle,
    clients: Vec<Handle>,
    further: Option<Handle>,
    /// Laid for as long as the processes run.
    _cable: Option<Cable>,
}

/// A burst, as both ends saw it.
#[derive(Debug, Clone, Default)]
pub(crate) struct Delivered {
    pub(crate) offered: Offered,
    /// Counted by the service.
    pub(crate) executed: u64,
    /// Taken, and reported as not executed later.
    pub(crate) failed: u64,
    /// Executed when the burst had to be over, where that was looked at.
    pub(crate) in_time: u64,
    /// From the first offer to the last execution, in nanoseconds.
    pub(crate) elapsed: u64,
}

impl Delivered {
    /// Taken, and neither executed nor reported.
    pub(crate) fn lost(&self) -> u64 {
        self.offered.taken.saturating_sub(self.executed + self.failed)
    }
}

impl Pair {
    /// Starts the processes of `peer`; they share no network with any other pair.
    pub(crate) fn start(contender: &Contender, setting: Setting) -> Result<Self> {
        Self::with_clients(1, contender, setting)
    }

    /// As [`start`](Self::start), with so many processes that call.
    pub(crate) fn with_clients(count: usize, contender: &Contender, setting: Setting) -> Result<Self> {
        let peer = contender.name();
        let [client_cpu, server_cpu] = pin::cpus(setting.pin)?;
        let cable = setting.wire.map(Cable::lay).transpose()?;
        let [far, near] = [0, 1].map(|end| cable.as_ref().map(|cable| &cable.hosts[end]));
        let place = Place { run: fastrand::u32(1..), print: setting.print, client: 0 };
        let mut end = End { peer: peer.to_owned(), cpu: server_cpu, place, address: String::new() };
        let mut server = Handle::of_pair("serve", contender, &end, far)?;
        end.address = server.line().with_context(|| format!("starting the server of {peer}"))?;
        end.cpu = client_cpu;
        let mut clients = Vec::new();
        for client in 0..count {
            end.place.client = u32::try_from(client)?;
            clients.push(Handle::of_pair("call", contender, &end, near)?);
        }
        let further = (setting.distribution == 2).then(|| Handle::of_pair("further", contender, &end, near));
        let further = further.transpose()?;
        Ok(Self { peer: peer.to_owned(), server, clients, further, _cable: cable })
    }

    /// The ids of the processes of the first client and of the server.
    pub(crate) fn processes(&self) -> [u32; 2] {
        [self.clients.first().unwrap_or(&self.server), &self.server].map(Handle::id)
    }

    /// One block of echo calls.
    pub(crate) fn block(&mut self, order: &Order) -> Result<Turn> {
        let used = self.begin_blocks(std::slice::from_ref(order))?;
        self.end_blocks(used)?.pop().context("a pair has a client")
    }

    /// As [`block`](Self::block) in two parts, so that several pairs can be under way, with an order for each client;
    /// returns what the end needs.
    pub(crate) fn begin_blocks(&mut self, orders: &[Order]) -> Result<u64> {
        self.begin_further()?;
        let used = self.ask_server(&ServerQuestion::CpuTime)?;
        let ask = |(client, order): (&mut Handle, &Order)| client.ask(&ClientQuestion::Echo(order.clone()));
        self.clients.iter_mut().zip(orders).try_for_each(ask)?;
        Ok(used)
    }

    /// The turn of each client; they share the time of the server evenly.
    pub(crate) fn end_blocks(&mut self, used: u64) -> Result<Vec<Turn>> {
        let outcomes: Vec<Result<Outcome>> = self.clients.iter_mut().map(Handle::answer).collect();
        let server_cpu = self.ask_server::<u64>(&ServerQuestion::CpuTime)?.saturating_sub(used);
        self.end_further()?;
        let share = server_cpu / outcomes.len().max(1) as u64;
        let turn = |outcome: Result<Outcome>| outcome.map(|outcome| Turn::new(outcome, share));
        outcomes.into_iter().map(turn).collect::<Result<_>>().with_context(|| format!("calls of {}", self.peer))
    }

    /// One burst of one-way messages, and what became of each.
    pub(crate) fn burst(&mut self, burst: &Burst) -> Result<Delivered> {
        self.burst_within(burst, None)
    }

    /// As [`burst`](Self::burst), and counts those that were executed when so much time had passed since it began.
    pub(crate) fn burst_within(&mut self, burst: &Burst, within: Option<Duration>) -> Result<Delivered> {
        self.begin_further()?;
        let (before, _): (u64, u64) = self.ask_server(&ServerQuestion::Executed)?;
        let mut delivered = Delivered::default();
        self.client()?.ask(&ClientQuestion::Burst(burst.clone()))?;
        if let Some(within) = within {
            std::thread::sleep(within);
            delivered.in_time = self.ask_server::<(u64, u64)>(&ServerQuestion::Executed)?.0 - before;
        }
        delivered.offered = self.client()?.answer()?;
        self.settle(before, &mut delivered)?;
        self.end_further()?;
        if delivered.lost() > 0 {
            let counters = self.server_counters()?;
            eprintln!("{}: {} messages vanished; the server counts {counters:?}", self.peer, delivered.lost());
        }
        Ok(delivered)
    }

    /// Waits until each message was executed or reported, or nothing has happened for long.
    fn settle(&mut self, before: u64, delivered: &mut Delivered) -> Result<()> {
        let mut changed = Instant::now();
        loop {
            let known = (delivered.executed, delivered.failed);
            delivered.failed += self.client()?.order::<u64>(&ClientQuestion::Failed)?;
            let (count, last): (u64, u64) = self.ask_server(&ServerQuestion::Executed)?;
            delivered.executed = count - before;
            delivered.elapsed = last.saturating_sub(delivered.offered.start);
            if delivered.executed + delivered.failed >= delivered.offered.taken {
                return Ok(());
            }
            if known != (delivered.executed, delivered.failed) {
                changed = Instant::now();
            }
            if changed.elapsed() > QUIET {
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Tells the server's callers other limits, and leaves time for them to hear of it.
    pub(crate) fn constrain(&mut self, limits: Limits) -> Result<()> {
        self.ask_server::<()>(&ServerQuestion::Constrain(limits))?;
        std::thread::sleep(10 * UNDER_WAY);
        Ok(())
    }

    /// What the server has counted of its own accord, without zeros.
    pub(crate) fn server_counters(&mut self) -> Result<Counters> {
        let mut counters: Counters = self.ask_server(&ServerQuestion::Counters)?;
        counters.retain(|_, count| *count > 0);
        Ok(counters)
    }

    /// Asks the client anything else.
    pub(crate) fn ask_client<T: DeserializeOwned>(&mut self, question: &impl Serialize) -> Result<T> {
        self.client()?.order(question)
    }

    fn client(&mut self) -> Result<&mut Handle> {
        self.clients.first_mut().context("a pair has a client")
    }

    fn ask_server<T: DeserializeOwned>(&mut self, question: &ServerQuestion) -> Result<T> {
        self.server.order(question)
    }

    fn begin_further(&mut self) -> Result<()> {
        let Some(further) = &mut self.further else { return Ok(()) };
        let () = further.order(&true)?;
        std::thread::sleep(UNDER_WAY);
        Ok(())
    }

    fn end_further(&mut self) -> Result<()> {
        let Some(further) = &mut self.further else { return Ok(()) };
        further.order(&false).map(|_: u64| ())
    }
}

impl Drop for Pair {
    /// All of them end at the same time.
    fn drop(&mut self) {
        self.clients.iter_mut().chain(&mut self.further).chain([&mut self.server]).for_each(Handle::dismiss);
    }
}
