//! CARA through its public API, discovery on: a passive m_unit that echoes, and main m_units that call it. Both ends
//! read the string as `&str`.

use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use cara_std::{
    Call, CommunicationSystem, Constraints, Interfaces, Parameters, ParametersView, Peer as Node, ServiceError, Unit,
};

use super::{Caller, Peer, Server};

/// Longest text in bytes.
const TEXT_BYTES: u32 = 100_000;
/// Longest block: the text and its length.
const MESSAGE_BYTES: u32 = TEXT_BYTES + 64;
/// Room of the caller's parameters.
const PARAMETERS_BYTES: usize = TEXT_BYTES as usize + 1_024;
/// How long the two may take to find each other.
const PATIENCE: Duration = Duration::from_secs(10);

/// How callers share links.
pub(crate) enum Cara {
    /// Each caller is an m_unit of its own.
    LinkEach,
    /// All callers of a process use one link.
    OneLink(OnceLock<CommunicationSystem>),
    /// As `LinkEach`, and [`IDLE_LINKS`] s_units are connected to the passive m_unit and do nothing.
    AmongIdle,
}

/// Links that do nothing but keep alive, for [`Cara::AmongIdle`].
const IDLE_LINKS: usize = 1_000;

/// The process that holds the idle s_units; ends when its standard input does.
pub(crate) fn idle(run: u32) -> Result<()> {
    let mut units = Vec::new();
    for id in 0..IDLE_LINKS {
        let builder = Unit::builder(&format!("idle-{id}"), id as u32, "passive", 1)?;
        let unit = builder.fleet(run).interfaces(Interfaces::Loopback).build_unit()?;
        unit.start()?;
        units.push(unit);
    }
    let _ = std::io::stdin().lines().next();
    Ok(())
}

/// Starts the idle s_units and waits until they have joined.
fn start_idle(run: u32, passive: &CommunicationSystem) -> Result<Child> {
    let program = std::env::current_exe()?;
    let mut command = Command::new(program);
    command.args(["idle", "--peer", "cara", "--run", &run.to_string()]).stdin(Stdio::piped());
    let child = command.spawn()?;
    let end = std::time::Instant::now() + 6 * PATIENCE;
    while passive.number_of_s_units() < IDLE_LINKS {
        ensure!(std::time::Instant::now() < end, "only {} idle s_units joined", passive.number_of_s_units());
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(child)
}

fn system(run: u32, name: &str, id: u32) -> Result<CommunicationSystem> {
    let constraints = Constraints { message_size: MESSAGE_BYTES, maximum_nodes: 2_000, ..Constraints::M_UNIT };
    let builder = CommunicationSystem::builder(name, id)?.fleet(run).interfaces(Interfaces::Loopback);
    let system = builder.constraints(constraints).build_system()?;
    system.start()?;
    Ok(system)
}

fn echo(_: &Call, view: &mut ParametersView) -> Result<(), ServiceError> {
    let text: &str = view.variable("text").map_err(|_| ServiceError::BadResults)?;
    std::hint::black_box(text.len());
    Ok(())
}

impl Peer for Cara {
    fn start_server(&self, run: u32) -> Result<Server> {
        let passive = system(run, "passive", 1)?;
        let text = parameters()?;
        passive.my_function_list().add_function("echo", &*text, echo)?;
        passive.publish_my_function_list()?;
        let idle = match self {
            Self::AmongIdle => Some(start_idle(run, &passive)?),
            _ => None,
        };
        Ok(Server { address: String::from("by discovery"), keep: Box::new((passive, idle)) })
    }

    fn connect(&self, run: u32, _address: &str) -> Result<Box<dyn Caller>> {
        static NEXT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(2);
        let new = || {
            let id = NEXT.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
            system(run, &format!("main-{}-{id}", std::process::id()), id)
        };
        let main = match self {
            Self::LinkEach | Self::AmongIdle => new()?,
            Self::OneLink(shared) => match shared.get() {
                Some(main) => main.clone(),
                None => {
                    let main = new()?;
                    shared.get_or_init(|| main).clone()
                }
            },
        };
        let passive = find(&main)?;
        Ok(Box::new(Echo { _main: main, passive, parameters: parameters()? }))
    }
}

fn parameters() -> Result<Box<Parameters<PARAMETERS_BYTES>>> {
    let mut parameters = Box::new(Parameters::<PARAMETERS_BYTES>::sized());
    parameters.add_string("text", TEXT_BYTES)?;
    Ok(parameters)
}

fn find(main: &CommunicationSystem) -> Result<Node> {
    let end = std::time::Instant::now() + PATIENCE;
    loop {
        if let Some(passive) = main.m_unit("passive") {
            ensure!(passive.wait_for_function("echo", cara_std::Duration::from(PATIENCE)), "nothing was published");
            return Ok(passive);
        }
        ensure!(std::time::Instant::now() < end, "the passive m_unit was not found");
        std::thread::sleep(Duration::from_millis(2));
    }
}

struct Echo {
    _main: CommunicationSystem,
    passive: Node,
    parameters: Box<Parameters<PARAMETERS_BYTES>>,
}

impl Caller for Echo {
    fn echo(&mut self, text: &str) -> Result<usize> {
        self.parameters.set_value("text", text)?;
        self.passive.block_request("echo", &mut *self.parameters).context("the call failed")?;
        Ok(self.parameters.variable::<&str>("text")?.len())
    }
}
