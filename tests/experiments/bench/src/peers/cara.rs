//! CARA through its public API, discovery on: a passive m_unit that echoes and takes, a main m_unit that calls it,
//! s_units that call beside it, and those of distribution 2. Both ends read the string as `&str`.
//!
//! Further callers are s_units, which have a link to the passive m_unit only, and share threads. Every two m_units of a
//! fleet connect: 64 would have 2,016 links among themselves.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use cara_bench_ends::{Caller, Delivery, Executed, Limits, Peer, Place, Printer, Server, cable_end};
use cara_std::keys::{FleetKeys, Store, location::file_name};
use cara_std::{
    Builder, CommunicationSystem, Constraints, Delivery as CaraDelivery, Fleet, Identity, Interfaces, Parameters,
    ParametersView, Peer as Node, RequestOptions, Served, ServiceError, Threads, Unit, UnitEvent,
};

/// Longest text in bytes.
pub(crate) const TEXT_BYTES: u32 = 100_000;
/// Longest block: the text and its length.
const MESSAGE_BYTES: u32 = TEXT_BYTES + 64;
/// Room of the caller's parameters.
const PARAMETERS_BYTES: usize = TEXT_BYTES as usize + 1_024;
/// How long the two may take to find each other.
const PATIENCE: Duration = Duration::from_secs(60);

/// Parameters with one text.
pub(crate) type Text = Parameters<PARAMETERS_BYTES>;

/// How callers share links. All but [`Secured`](Self::Secured) are in plain mode.
pub(crate) enum Cara {
    /// Each caller is a unit of its own: the first one the main m_unit, the others s_units.
    LinkEach,
    /// As `LinkEach`, with keys.
    Secured,
    /// Both ends spin before they sleep, without keys or with.
    Spinning {
        /// With keys.
        secured: bool,
    },
    /// All callers of a process use one link.
    OneLink(Mutex<Option<CommunicationSystem>>),
    /// As `LinkEach`, and [`IDLE_LINKS`] s_units are connected to the passive m_unit and do nothing.
    AmongIdle,
}

/// How long [`Cara::Spinning`] spins.
const SPIN: Duration = Duration::from_micros(100);

/// Most callers of one process.
const CALLERS: u32 = 64;
/// The ID number of the first caller.
const FIRST_CALLER: u32 = 2;
/// The ID number of the first of the further nodes of distribution 2.
const FIRST_FURTHER: u32 = 100;
const FURTHER: u32 = 5;
/// What the ID numbers of callers that are s_units have more than the callers' own.
const FIRST_UNIT: u32 = 200;

/// Links that do nothing but keep alive, for [`Cara::AmongIdle`].
const IDLE_LINKS: usize = 1_000;

/// The process that holds the idle s_units; ends when its standard input does.
pub(crate) fn idle(place: &Place) -> Result<()> {
    let threads = Threads::new()?;
    let mut units = Vec::new();
    for id in 0..IDLE_LINKS {
        let builder = Unit::builder(&format!("idle-{id}"), id as u32, "passive", 1)?;
        let unit = placed(builder, place).insecure().threads(&threads).build()?;
        unit.start()?;
        units.push(unit);
    }
    let _ = std::io::stdin().lines().next();
    Ok(())
}

/// Starts the idle s_units and waits until they have joined.
fn start_idle(place: &Place, passive: &CommunicationSystem) -> Result<Child> {
    let program = std::env::current_exe()?;
    let mut command = Command::new(program);
    command.args(["idle", "--run", &place.run.to_string()]).stdin(Stdio::piped());
    let child = command.spawn()?;
    let end = Instant::now() + PATIENCE;
    while passive.number_of_s_units() < IDLE_LINKS {
        ensure!(Instant::now() < end, "only {} idle s_units joined", passive.number_of_s_units());
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(child)
}

fn placed<R>(builder: Builder<(), R>, place: &Place) -> Builder<(), R> {
    let interfaces = if cable_end().is_some() { Interfaces::All } else { Interfaces::Loopback };
    builder.fleet(place.run).discovery_port(place.discovery_port()).interfaces(interfaces)
}

fn main_name(id: u32) -> String {
    format!("main-{id}")
}

fn caller_name(id: u32) -> String {
    format!("caller-{id}")
}

fn further_name(number: u32) -> String {
    format!("further-{number}")
}

/// Draws keys for a run's units into a folder of their own.
fn draw_keys(place: &Place) -> Result<tempfile::TempDir> {
    let folder = tempfile::tempdir()?;
    let mut keys = FleetKeys::draw(Fleet(place.run))?;
    let passive = Identity::m_unit("passive", 1)?;
    keys.add(&passive, &[])?;
    let ids = FIRST_CALLER..FIRST_CALLER + CALLERS;
    for id in ids.clone() {
        keys.add(&Identity::m_unit(&main_name(id), id)?, &[])?;
    }
    let callers = ids.map(|id| (caller_name(id), FIRST_UNIT + id));
    let further = (0..FURTHER).map(|number| (further_name(number), FIRST_FURTHER + number));
    for (name, id) in callers.chain(further) {
        keys.add(&Identity::s_unit(&name, id)?, std::slice::from_ref(&passive))?;
    }
    Store::create(folder.path(), keys)?.save()?;
    Ok(folder)
}

impl Cara {
    /// Its keys from the folder that the server's address tells, or none.
    fn keyed<R>(&self, builder: Builder<(), R>, place: &Place, address: &str, identity: &Identity) -> Builder<(), R> {
        let builder = placed(builder, place);
        let builder = if let Self::Spinning { .. } = self { builder.spin(SPIN) } else { builder };
        if self.has_keys() {
            builder.key_file(Path::new(address).join(file_name(identity, Fleet(place.run))))
        } else {
            builder.insecure()
        }
    }

    /// A manager that calls the passive one, once it has found that.
    pub(crate) fn manager(
        &self,
        place: &Place,
        address: &str,
        id: u32,
    ) -> Result<(CommunicationSystem, Box<dyn Caller>)> {
        let system = self.system(place, address, &main_name(id), id)?;
        Ok((system.clone(), Echo::of_system(system)?))
    }

    fn has_keys(&self) -> bool {
        matches!(self, Self::Secured | Self::Spinning { secured: true })
    }

    fn system(&self, place: &Place, address: &str, name: &str, id: u32) -> Result<CommunicationSystem> {
        let constraints = Constraints { message_size: MESSAGE_BYTES, maximum_nodes: 2_000, ..Constraints::M_UNIT };
        let builder = CommunicationSystem::builder(name, id)?;
        let builder = self.keyed(builder, place, address, &Identity::m_unit(name, id)?);
        let system = builder.constraints(constraints).build()?;
        system.start()?;
        Ok(system)
    }

    fn unit(&self, place: &Place, address: &str, name: &str, id: u32, threads: Option<Threads>) -> Result<Unit> {
        let builder = Unit::builder(name, id, "passive", 1)?;
        let builder = self.keyed(builder, place, address, &Identity::s_unit(name, id)?);
        let builder = threads.iter().fold(builder, Builder::threads);
        let constraints = Constraints { message_size: MESSAGE_BYTES, maximum_nodes: 1, ..Constraints::M_UNIT };
        Ok(builder.constraints(constraints).build()?)
    }
}

/// What the service does with a text: reads it, and prints it where that is asked for.
fn look_at(view: &ParametersView, printer: Printer) -> Result<(), ServiceError> {
    let text: &str = view.variable("text").map_err(|_| ServiceError::BadResults)?;
    std::hint::black_box(text.len());
    printer.print(text);
    Ok(())
}

impl Peer for Cara {
    fn start_server(&self, place: &Place) -> Result<Server> {
        let keys = self.has_keys().then(|| draw_keys(place)).transpose()?;
        let address = keys.as_ref().map_or("by discovery", |keys| keys.path().to_str().unwrap_or_default());
        let address = address.to_owned();
        let passive = self.system(place, &address, "passive", 1)?;
        let (text, printer, executed) = (parameters()?, place.printer(), Arc::new(Executed::default()));
        let counted = executed.clone();
        let functions = passive.my_function_list();
        functions.add_function("echo", &*text, move |_: &Served, view: &mut ParametersView| look_at(view, printer))?;
        functions.add_function("take", &*text, move |_: &Served, view: &mut ParametersView| {
            counted.note();
            look_at(view, printer)
        })?;
        passive.publish_my_function_list()?;
        let idle = match self {
            Self::AmongIdle => Some(start_idle(place, &passive)?),
            _ => None,
        };
        let constrained = passive.clone();
        let constrain = move |limits: Limits| -> Result<()> {
            let minimum_interval = cara_std::Duration::from_millis(limits.minimum_interval_ms);
            let wanted =
                Constraints { minimum_interval, message_size: limits.message_size, ..constrained.constraints() };
            Ok(constrained.set_constraints(wanted)?)
        };
        let counted = passive.clone();
        let counters = move || counted.counters().into_iter().map(|(name, count)| (name.to_owned(), count)).collect();
        let (constrain, counters) = (Some(Box::new(constrain) as _), Box::new(counters));
        Ok(Server { address, executed, constrain, counters, keep: Box::new((passive, idle, keys)) })
    }

    fn connect(&self, place: &Place, address: &str) -> Result<Box<dyn Caller>> {
        static NEXT: AtomicU32 = AtomicU32::new(FIRST_CALLER);
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        // Where a pair has several client processes, each has one caller.
        let id = number + place.client;
        match self {
            Self::OneLink(shared) => {
                let mut shared = shared.lock().unwrap_or_else(PoisonError::into_inner);
                let main = match shared.take() {
                    Some(main) => main,
                    None => self.system(place, address, &main_name(id), id)?,
                };
                Echo::of_system(shared.insert(main).clone())
            }
            _ if number == FIRST_CALLER => Ok(self.manager(place, address, id)?.1),
            _ => {
                let threads = Some(shared_threads()?);
                Echo::of_unit(self.unit(place, address, &caller_name(id), FIRST_UNIT + id, threads)?)
            }
        }
    }

    fn connect_further(&self, place: &Place, address: &str, number: u32) -> Result<Box<dyn Caller>> {
        Echo::of_unit(self.unit(place, address, &further_name(number), FIRST_FURTHER + number, None)?)
    }
}

/// The threads of all callers that are s_units.
fn shared_threads() -> Result<Threads> {
    static SHARED: Mutex<Option<Threads>> = Mutex::new(None);
    let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
    let threads = match shared.take() {
        Some(threads) => threads,
        None => Threads::new()?,
    };
    Ok(shared.insert(threads).clone())
}

/// An argument and result with one text.
pub(crate) fn parameters() -> Result<Box<Text>> {
    let mut parameters = Box::new(Text::sized());
    parameters.add_string("text", TEXT_BYTES)?;
    Ok(parameters)
}

fn found(passive: impl Fn() -> Option<Node>) -> Result<Node> {
    let end = Instant::now() + PATIENCE;
    loop {
        if let Some(passive) = passive().filter(Node::is_connected) {
            ensure!(passive.wait_for_function("take", PATIENCE), "nothing was published");
            return Ok(passive);
        }
        ensure!(Instant::now() < end, "the passive m_unit was not found");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Counts requests that were reported as not executed.
struct Failures(Arc<AtomicU64>);

impl Failures {
    /// In a thread of its own, so that none of the events finds the channel full.
    fn watch(events: std::sync::mpsc::Receiver<UnitEvent>) -> Self {
        let count = Arc::new(AtomicU64::new(0));
        let counted = count.clone();
        std::thread::spawn(move || {
            let failed = events.iter().filter(|event| matches!(event, UnitEvent::RequestFailed { .. }));
            failed.for_each(|_| {
                counted.fetch_add(1, Ordering::Relaxed);
            });
        });
        Self(count)
    }
}

/// Keeps the unit of a caller.
enum Kept {
    Main(#[expect(dead_code, reason = "kept, not read")] CommunicationSystem),
    Unit(#[expect(dead_code, reason = "kept, not read")] Unit),
}

struct Echo {
    _kept: Kept,
    passive: Node,
    parameters: Box<Text>,
    failures: Failures,
}

impl Echo {
    fn of_system(main: CommunicationSystem) -> Result<Box<dyn Caller>> {
        let failures = Failures::watch(main.events());
        let passive = found(|| main.m_unit("passive").ok())?;
        Ok(Box::new(Self { _kept: Kept::Main(main), passive, parameters: parameters()?, failures }))
    }

    fn of_unit(unit: Unit) -> Result<Box<dyn Caller>> {
        let failures = Failures::watch(unit.events());
        unit.start()?;
        let passive = found(|| unit.manager())?;
        Ok(Box::new(Self { _kept: Kept::Unit(unit), passive, parameters: parameters()?, failures }))
    }
}

impl Caller for Echo {
    fn echo(&mut self, text: &str) -> Result<usize> {
        self.parameters.set_value("text", text)?;
        self.passive.block_request("echo", &mut *self.parameters).context("the call failed")?;
        Ok(self.parameters.variable::<&str>("text")?.len())
    }

    fn send(&mut self, text: &str, delivery: Delivery) -> Result<(), String> {
        let delivery = match delivery {
            Delivery::Reliable => CaraDelivery::Reliable,
            Delivery::BestEffort => CaraDelivery::BestEffort,
        };
        let options = RequestOptions { delivery, ..RequestOptions::default() };
        let sent = self.parameters.set_value("text", text);
        let sent = sent
            .and_then(|()| self.passive.call("take", &mut *self.parameters).with(options).send().map_err(Into::into));
        sent.map(|_| ()).map_err(|error| error.to_string())
    }

    fn flush(&mut self) {
        // A link that has ended has nothing to flush, and its requests are reported.
        let _ = self.passive.flush();
    }

    fn failed(&mut self) -> u64 {
        self.failures.0.swap(0, Ordering::Relaxed)
    }
}
